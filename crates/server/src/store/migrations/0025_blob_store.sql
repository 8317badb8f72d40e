-- The object in the servers' common store that holds a blob's bytes; rows exist only if there is such a store.
-- touched_ms: the last request of a pusher, on the clock of a server.
CREATE TABLE blobs (
    digest TEXT PRIMARY KEY,
    bytes BIGINT NOT NULL,
    object TEXT NOT NULL,
    touched_ms BIGINT NOT NULL
);
CREATE INDEX blobs_by_touch ON blobs (touched_ms);
CREATE INDEX blobs_by_object ON blobs (object);

-- The name that the store of these objects has in itself, in one row.
CREATE TABLE blob_store (
    id BIGINT PRIMARY KEY,
    name TEXT NOT NULL
);
