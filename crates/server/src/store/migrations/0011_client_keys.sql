-- The key with which a robot has to prove, besides showing its token, that it is the one that was given the token.
ALTER TABLE tokens ADD COLUMN client_key TEXT;
