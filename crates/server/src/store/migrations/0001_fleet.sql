-- Times are milliseconds since the Unix epoch by the server's clock; columns named after a wire type hold its JSON.

-- Every write begins by updating the one row of this table: a lock that both databases understand.
CREATE TABLE write_lock (
    id BIGINT PRIMARY KEY,
    turn BIGINT NOT NULL
);
INSERT INTO write_lock (id, turn) VALUES (1, 0);

-- A removed robot's row stays, so that its id is never used again.
CREATE TABLE robots (
    id TEXT PRIMARY KEY,
    name TEXT NOT NULL,
    mac TEXT NOT NULL,
    labels TEXT NOT NULL,
    enrolled_at_ms BIGINT NOT NULL,
    removed_at_ms BIGINT,
    generation BIGINT NOT NULL DEFAULT 0,
    observed_generation BIGINT NOT NULL DEFAULT 0,
    report_start BIGINT NOT NULL DEFAULT 0,
    report_seq BIGINT NOT NULL DEFAULT 0,
    report TEXT,
    last_seen_ms BIGINT
);
CREATE UNIQUE INDEX robots_by_mac ON robots (mac) WHERE removed_at_ms IS NULL;
CREATE UNIQUE INDEX robots_by_name ON robots (name) WHERE removed_at_ms IS NULL;
CREATE INDEX robots_diverged ON robots (id) WHERE observed_generation > generation;

CREATE TABLE tokens (
    id TEXT PRIMARY KEY,
    kind TEXT NOT NULL,
    digest TEXT NOT NULL,
    robot_id TEXT REFERENCES robots (id),
    labels TEXT,
    uses_left BIGINT,
    created_at_ms BIGINT NOT NULL,
    expires_at_ms BIGINT,
    revoked_at_ms BIGINT
);
CREATE INDEX tokens_by_robot ON tokens (robot_id);

CREATE TABLE deployments (
    id TEXT PRIMARY KEY,
    number BIGINT NOT NULL,
    task TEXT NOT NULL,
    version TEXT NOT NULL,
    package TEXT NOT NULL,
    kind TEXT NOT NULL,
    selector TEXT NOT NULL,
    delivery TEXT NOT NULL,
    batch BIGINT,
    max_failures BIGINT,
    forgiven BIGINT NOT NULL DEFAULT 0,
    paused BIGINT NOT NULL DEFAULT 0,
    created_at_ms BIGINT NOT NULL,
    expires_at_ms BIGINT NOT NULL,
    cancelled_at_ms BIGINT
);
CREATE INDEX deployments_by_number ON deployments (number);

-- released: its batch has begun. desired: it is what the robot should have of the task now. ended: its phase is final.
-- previous: the deployment it took the place of, which a cancel puts back. removed_generation: the first generation of
-- the robot's desired state without it.
CREATE TABLE assignments (
    deployment_id TEXT NOT NULL REFERENCES deployments (id),
    robot_id TEXT NOT NULL REFERENCES robots (id),
    task TEXT NOT NULL,
    place BIGINT NOT NULL,
    released BIGINT NOT NULL DEFAULT 0,
    desired BIGINT NOT NULL DEFAULT 0,
    ended BIGINT NOT NULL DEFAULT 0,
    wanted TEXT NOT NULL DEFAULT 'running',
    run BIGINT NOT NULL DEFAULT 1,
    phase TEXT NOT NULL DEFAULT 'assigned',
    progress TEXT,
    failure TEXT,
    attempts BIGINT NOT NULL DEFAULT 0,
    previous TEXT,
    superseded_by TEXT,
    removed_generation BIGINT,
    expires_at_ms BIGINT,
    updated_at_ms BIGINT NOT NULL,
    PRIMARY KEY (deployment_id, robot_id)
);
CREATE UNIQUE INDEX assignments_desired ON assignments (robot_id, task) WHERE desired = 1;
CREATE INDEX assignments_live ON assignments (robot_id) WHERE desired = 1 OR ended = 0;
CREATE INDEX assignments_open ON assignments (robot_id) WHERE ended = 0;
CREATE INDEX assignments_waiting ON assignments (deployment_id, place) WHERE released = 0 AND ended = 0;
CREATE INDEX assignments_expiring ON assignments (expires_at_ms) WHERE ended = 0;
CREATE INDEX assignments_by_phase ON assignments (deployment_id, released, phase);
CREATE INDEX assignments_superseded ON assignments (superseded_by, deployment_id) WHERE superseded_by IS NOT NULL;
CREATE INDEX assignments_previous ON assignments (previous, robot_id) WHERE previous IS NOT NULL;

-- Answers already given, by the key the operator's order came with.
CREATE TABLE orders (
    key TEXT PRIMARY KEY,
    request TEXT NOT NULL,
    answer TEXT NOT NULL,
    created_at_ms BIGINT NOT NULL
);
