-- A robot that came by a token with approval has nothing until a person approves it.
ALTER TABLE robots ADD COLUMN awaits_approval BIGINT NOT NULL DEFAULT 0;
-- The enrolment token it came by, and the address.
ALTER TABLE robots ADD COLUMN enrolled_by TEXT;
ALTER TABLE robots ADD COLUMN enrolled_from TEXT;
ALTER TABLE tokens ADD COLUMN approval BIGINT NOT NULL DEFAULT 0;
CREATE INDEX robots_awaiting ON robots (enrolled_at_ms) WHERE awaits_approval = 1;
