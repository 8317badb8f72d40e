-- The highest run that was ever ordered of it, where that was taken back since: its robot may have begun it all the same.
ALTER TABLE assignments ADD COLUMN last_run BIGINT NOT NULL DEFAULT 0;
