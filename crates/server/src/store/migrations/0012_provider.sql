-- Users who sign in by a provider: the issuer and whom it means, which are never anybody else's.
ALTER TABLE users ADD COLUMN subject TEXT;
CREATE UNIQUE INDEX users_by_subject ON users (subject);
