-- Sessions of the web page. digest: the SHA-256 of the cookie's value, which is stored nowhere. A session has the
-- rights that its token has now, and ends with the token.
CREATE TABLE page_sessions (
    digest TEXT PRIMARY KEY,
    token_id TEXT NOT NULL,
    token_digest TEXT NOT NULL,
    user_name TEXT NOT NULL,
    expires_at_ms BIGINT NOT NULL
);
CREATE INDEX page_sessions_by_user ON page_sessions (user_name, expires_at_ms);
CREATE INDEX page_sessions_by_expiry ON page_sessions (expires_at_ms);

-- Wrong passwords, since the beginning of the window that counts. name_digest: an HMAC of the name, which may be a
-- password in the wrong field.
CREATE TABLE sign_in_failures (
    name_digest TEXT PRIMARY KEY,
    began_ms BIGINT NOT NULL,
    count BIGINT NOT NULL
);

-- The newest entries of the feed. entry: the entry as people see it. audience: the people who may see it.
CREATE TABLE feed (
    number BIGINT PRIMARY KEY,
    at_ms BIGINT NOT NULL,
    entry TEXT NOT NULL,
    audience TEXT NOT NULL
);
