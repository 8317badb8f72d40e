-- Who needs a blob is asked of each that may be collected, while pushes wait.
CREATE INDEX manifests_by_digest ON manifests (digest);
CREATE INDEX manifest_parts_by_digest ON manifest_parts (digest);
