-- People and what they did. Roles are words joined by commas; a scope is a selector, and none means every robot.
CREATE TABLE users (
    name TEXT PRIMARY KEY,
    roles TEXT NOT NULL,
    scope TEXT,
    password TEXT,
    created_at_ms BIGINT NOT NULL
);

-- An operator's token without a user is the first one, in the data directory. A token's own roles and scope only narrow
-- what its user may.
ALTER TABLE tokens ADD COLUMN user_name TEXT;
ALTER TABLE tokens ADD COLUMN roles TEXT;
ALTER TABLE tokens ADD COLUMN scope TEXT;
ALTER TABLE tokens ADD COLUMN title TEXT;
ALTER TABLE tokens ADD COLUMN origin TEXT;
CREATE INDEX tokens_by_user ON tokens (user_name);

-- Only ever added to. The entry is what the digest covers; the other columns are there to find it by.
CREATE TABLE audit (
    number BIGINT PRIMARY KEY,
    who TEXT NOT NULL,
    act TEXT NOT NULL,
    target TEXT NOT NULL,
    entry TEXT NOT NULL,
    digest TEXT NOT NULL
);
CREATE INDEX audit_by_who ON audit (who, number);
CREATE INDEX audit_by_target ON audit (target, number);
