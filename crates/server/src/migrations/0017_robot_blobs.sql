-- What each robot has brought, until it is collected. What came before is not counted.
CREATE TABLE robot_blobs (
    robot_id TEXT NOT NULL,
    digest TEXT NOT NULL,
    bytes BIGINT NOT NULL,
    PRIMARY KEY (robot_id, digest)
);
CREATE INDEX robot_blobs_by_digest ON robot_blobs (digest);
