-- The person who ordered, and the size of this person's orders up to this one. NULL: an order from before this migration.
ALTER TABLE orders ADD COLUMN person TEXT;
ALTER TABLE orders ADD COLUMN bytes_until BIGINT NOT NULL DEFAULT 0;
CREATE INDEX orders_by_person ON orders (person, bytes_until);
CREATE INDEX orders_by_time ON orders (created_at_ms);

-- Networks from which people have signed in with their password, so that failures of others do not lock them out there.
-- network_digest: an HMAC of user and network.
CREATE TABLE familiar_networks (
    user_name TEXT NOT NULL,
    network_digest TEXT NOT NULL,
    used_ms BIGINT NOT NULL,
    PRIMARY KEY (user_name, network_digest)
);
CREATE INDEX familiar_networks_by_use ON familiar_networks (used_ms);
