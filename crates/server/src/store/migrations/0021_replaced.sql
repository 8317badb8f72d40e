-- The manifest that a forced push gave this package's version to. Robots that have it show a version whose content is another.
ALTER TABLE packages ADD COLUMN replaced_by TEXT;
