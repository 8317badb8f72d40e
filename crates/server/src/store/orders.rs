//! Idempotency keys of orders and the answers that were given.
