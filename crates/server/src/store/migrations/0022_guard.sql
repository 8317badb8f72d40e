-- The server that may write, by its name for this run, and since when; NULL: any.
ALTER TABLE write_lock ADD COLUMN holder TEXT;
ALTER TABLE write_lock ADD COLUMN held_since_ms BIGINT;

-- What all servers of one fleet have in common, in one row.
CREATE TABLE fleet (
    id BIGINT PRIMARY KEY,
    key_id TEXT NOT NULL,
    topic_prefix TEXT NOT NULL
);
