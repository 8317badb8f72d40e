-- What is fanned out is looked for many times a second; of millions of assignments it is a few.
CREATE INDEX assignments_direct_push ON assignments (deployment_id) WHERE mechanism = 'direct-push' AND ended = 0;
