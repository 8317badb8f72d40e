-- The labels of robots, which robots.labels has as JSON: for selectors. Every write of that column
-- also writes these.
CREATE TABLE robot_labels (
    robot_id TEXT NOT NULL REFERENCES robots (id),
    key TEXT NOT NULL,
    value TEXT NOT NULL,
    PRIMARY KEY (robot_id, key)
);
CREATE INDEX robot_labels_by_value ON robot_labels (key, value, robot_id);
INSERT INTO robot_labels (robot_id, key, value)
SELECT r.id, label.key, label.value FROM robots r CROSS JOIN json_each(r.labels) AS label;

-- A large order is placed in chunks. These are the selected robots that have no assignment yet.
-- place: the place of the chunk's first robot in the order. robots: their ids, separated by commas;
-- a minus sign before an id: an order to stop or remove the task came before the chunk was placed.
CREATE TABLE order_chunks (
    deployment_id TEXT NOT NULL REFERENCES deployments (id),
    place BIGINT NOT NULL,
    robots TEXT NOT NULL,
    PRIMARY KEY (deployment_id, place)
);
-- selected: the number of robots that the order selected. placed: the number of those that it was
-- placed for so far. NULL: placed at once, by an earlier version. restart: whether the order
-- restarts services that run.
ALTER TABLE deployments ADD COLUMN selected BIGINT;
ALTER TABLE deployments ADD COLUMN placed BIGINT;
ALTER TABLE deployments ADD COLUMN restart BIGINT NOT NULL DEFAULT 0;
-- cancel_from: a cancelled deployment is still to be taken away from its robots, from this place
-- on.
ALTER TABLE deployments ADD COLUMN cancel_from BIGINT;
CREATE INDEX deployments_cancelling ON deployments (number) WHERE cancel_from IS NOT NULL;
