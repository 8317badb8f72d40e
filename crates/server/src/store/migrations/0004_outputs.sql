-- The manifests that are outputs of a run, one repository for each robot and task; output holds the wire type's JSON.
CREATE TABLE outputs (
    repository TEXT NOT NULL,
    manifest TEXT NOT NULL,
    robot_id TEXT NOT NULL,
    task TEXT NOT NULL,
    tag TEXT NOT NULL,
    output TEXT NOT NULL,
    pushed_at_ms BIGINT NOT NULL,
    PRIMARY KEY (repository, manifest)
);
CREATE INDEX outputs_by_time ON outputs (pushed_at_ms);
CREATE INDEX outputs_by_robot ON outputs (robot_id, pushed_at_ms);
