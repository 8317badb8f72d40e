-- Servers that share this database. run: one start of a server. heartbeat: a number that it raises while it lives.
-- url: where the others reach it. listeners: streams of events. transfers, backlog: its load.
CREATE TABLE nodes (
    name TEXT PRIMARY KEY,
    run TEXT NOT NULL,
    heartbeat BIGINT NOT NULL,
    url TEXT,
    version TEXT NOT NULL,
    listeners BIGINT NOT NULL,
    transfers BIGINT NOT NULL,
    backlog BIGINT NOT NULL
);

-- The last session of each robot at any of these servers. epoch grows with each write of the row. change grows with
-- each statement of the run. since_ms: the start of the MQTT connection; NULL: the robot polls over HTTP. agent: the
-- agent that serves the robot's work, as JSON.
CREATE TABLE robot_sessions (
    robot_id TEXT PRIMARY KEY,
    run TEXT NOT NULL,
    epoch BIGINT NOT NULL,
    change BIGINT NOT NULL,
    token_number BIGINT NOT NULL,
    since_ms BIGINT,
    seen_ms BIGINT NOT NULL,
    left_ms BIGINT,
    address TEXT,
    agent TEXT
);
CREATE INDEX robot_sessions_by_change ON robot_sessions (run, change);

-- Robots that have not reported their newest desired state.
CREATE INDEX robots_behind ON robots (id) WHERE generation > observed_generation;

-- The agents that displaced each other, as JSON.
ALTER TABLE robots ADD COLUMN instances TEXT;
