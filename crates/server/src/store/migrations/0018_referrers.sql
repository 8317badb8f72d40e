-- In the order in which they are listed.
DROP INDEX manifests_by_subject;
CREATE INDEX manifests_by_subject ON manifests (repository, subject, digest) WHERE subject IS NOT NULL;
