-- A robot has up to two valid tokens: the one it uses, and one that is made but not used yet. The first use of that one
-- ends the other.

ALTER TABLE tokens ADD COLUMN used_at_ms BIGINT;
-- The enrolment token that made it; empty: the robot asked for it itself.
ALTER TABLE tokens ADD COLUMN made_by TEXT;
-- Grows from one token to the next: a report by a lower one than the robot uses comes too late.
ALTER TABLE tokens ADD COLUMN number BIGINT NOT NULL DEFAULT 0;
ALTER TABLE robots ADD COLUMN token_number BIGINT NOT NULL DEFAULT 0;
CREATE INDEX tokens_by_maker ON tokens (made_by);
UPDATE tokens SET used_at_ms = created_at_ms WHERE kind = 'robot';
