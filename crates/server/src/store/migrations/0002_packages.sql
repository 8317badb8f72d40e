-- The registry: which repository holds which blobs and manifests. The bytes lie in the blob store, manifests included.
CREATE TABLE repository_blobs (
    repository TEXT NOT NULL,
    digest TEXT NOT NULL,
    PRIMARY KEY (repository, digest)
);
CREATE INDEX repository_blobs_by_digest ON repository_blobs (digest);

CREATE TABLE manifests (
    repository TEXT NOT NULL,
    digest TEXT NOT NULL,
    size BIGINT NOT NULL,
    media_type TEXT NOT NULL,
    artifact_type TEXT,
    annotations TEXT NOT NULL,
    subject TEXT,
    pushed_at_ms BIGINT NOT NULL,
    PRIMARY KEY (repository, digest)
);
CREATE INDEX manifests_by_subject ON manifests (repository, subject) WHERE subject IS NOT NULL;

-- The blobs, and for an index the manifests, that a manifest is made of.
CREATE TABLE manifest_parts (
    repository TEXT NOT NULL,
    manifest TEXT NOT NULL,
    digest TEXT NOT NULL,
    PRIMARY KEY (repository, manifest, digest)
);

CREATE TABLE tags (
    repository TEXT NOT NULL,
    tag TEXT NOT NULL,
    manifest TEXT NOT NULL,
    PRIMARY KEY (repository, tag)
);
CREATE INDEX tags_by_manifest ON tags (repository, manifest);

-- The manifests that are task packages; a package's name is its repository.
CREATE TABLE packages (
    name TEXT NOT NULL,
    manifest TEXT NOT NULL,
    package TEXT NOT NULL,
    task_manifest TEXT NOT NULL,
    pushed_at_ms BIGINT NOT NULL,
    PRIMARY KEY (name, manifest)
);
