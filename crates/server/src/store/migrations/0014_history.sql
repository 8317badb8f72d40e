-- When an assignment came into each phase: see store/timelines.rs. It grows with writes of the row that are made anyway.
ALTER TABLE assignments ADD COLUMN timeline TEXT NOT NULL DEFAULT '';
-- A robot's history, the newest order first.
CREATE INDEX assignments_by_robot ON assignments (robot_id);
-- What was set for a robot here.
ALTER TABLE robots ADD COLUMN settings TEXT;
