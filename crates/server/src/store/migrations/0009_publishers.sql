-- What publishers have signed, of what the registry holds: envelopes about packages, and lists of publishers.
CREATE TABLE signatures (
    repository TEXT NOT NULL,
    manifest TEXT NOT NULL,
    -- The manifest of the package it is about.
    package TEXT NOT NULL,
    envelope TEXT NOT NULL,
    size BIGINT NOT NULL,
    pushed_at_ms BIGINT NOT NULL,
    PRIMARY KEY (repository, manifest)
);
CREATE INDEX signatures_by_package ON signatures (package);
CREATE INDEX signatures_by_envelope ON signatures (envelope);

CREATE TABLE publisher_lists (
    version BIGINT PRIMARY KEY,
    manifest TEXT NOT NULL,
    envelope TEXT NOT NULL,
    size BIGINT NOT NULL,
    -- Its keepers are others than those of the list before it, so that nobody can follow without it.
    changes_keepers BIGINT NOT NULL
);
