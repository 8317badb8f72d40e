-- The number of the password that a robot has at an external broker; it grows when the robot registers again.
ALTER TABLE robots ADD COLUMN broker_credential BIGINT NOT NULL DEFAULT 0;
