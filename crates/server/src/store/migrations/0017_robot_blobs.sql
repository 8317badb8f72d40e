-- What each robot has brought, until it is collected; what it dropped goes sooner. What came before is not counted.
CREATE TABLE robot_blobs (
    robot_id TEXT NOT NULL,
    digest TEXT NOT NULL,
    bytes BIGINT NOT NULL,
    dropped BIGINT NOT NULL DEFAULT 0,
    PRIMARY KEY (robot_id, digest)
);
CREATE INDEX robot_blobs_by_digest ON robot_blobs (digest, dropped);
CREATE INDEX robot_blobs_dropped ON robot_blobs (digest) WHERE dropped = 1;
-- The sums of these, which every request asks for.
CREATE TABLE robot_bytes (
    robot_id TEXT PRIMARY KEY,
    bytes BIGINT NOT NULL
);
ALTER TABLE outputs ADD COLUMN bytes BIGINT NOT NULL DEFAULT 0;
