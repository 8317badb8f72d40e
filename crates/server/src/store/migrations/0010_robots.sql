-- A robot that was revoked: its tokens have ended, all else of it stays until it is registered anew or removed.
ALTER TABLE robots ADD COLUMN revoked_at_ms BIGINT;
