-- Whether a package has run on a robot in some order, or succeeded: what one can go back to.
ALTER TABLE assignments ADD COLUMN ran BIGINT NOT NULL DEFAULT 0;
UPDATE assignments SET ran = 1 WHERE phase IN ('running', 'succeeded', 'stopped');
-- All that was ever ordered of one robot, of one task or of all.
DROP INDEX assignments_by_robot;
CREATE INDEX assignments_by_robot ON assignments (robot_id, task);
