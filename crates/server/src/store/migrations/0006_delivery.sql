-- How bytes travel. deployments.delivery is what was ordered; an assignment's decision is made when its batch begins, so
-- older ones have none, and their mechanism is the order's.

ALTER TABLE deployments ADD COLUMN priority BIGINT NOT NULL DEFAULT 0;
ALTER TABLE assignments ADD COLUMN mechanism TEXT;
ALTER TABLE assignments ADD COLUMN rule TEXT;
ALTER TABLE assignments ADD COLUMN because TEXT;
-- JSON of what was known when it was decided.
ALTER TABLE assignments ADD COLUMN inputs TEXT;
-- What a robot last reported of its way to the server, and of its battery in percent.
ALTER TABLE robots ADD COLUMN link TEXT;
ALTER TABLE robots ADD COLUMN battery BIGINT;
