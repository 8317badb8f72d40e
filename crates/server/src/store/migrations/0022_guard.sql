-- The server that may write, by its name for this run, and the time since when; NULL: any server.
ALTER TABLE write_lock ADD COLUMN holder TEXT;
ALTER TABLE write_lock ADD COLUMN held_since_ms BIGINT;

-- The facts that all servers of one fleet share, in one row.
CREATE TABLE fleet (
    id BIGINT PRIMARY KEY,
    key_id TEXT NOT NULL,
    topic_prefix TEXT NOT NULL
);
