-- Robots whose batch has not begun, looked up each time that a robot comes back.
CREATE INDEX assignments_waiting ON assignments (deployment_id) WHERE released = 0 AND ended = 0;
