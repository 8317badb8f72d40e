//! The table of repositories, one for each noun. A repository that borrows the store
//! (`Robots<&Store>`) reads, or runs a whole write. One that borrows a transaction
//! (`Robots<&mut Transaction>`) adds statements to that write. This file has no SQL: the methods
//! stand in the files of their noun.

use super::{Store, Transaction};

/// For each noun, defines the repository, and the methods of [`Store`] and [`Transaction`] that
/// lend it.
macro_rules! repositories {
    ($($(#[$doc:meta])+ $noun:ident: $Repository:ident;)+) => {
        $(
            $(#[$doc])+
            #[derive(Debug, Clone, Copy)]
            pub struct $Repository<S>(pub(in crate::store) S);
        )+

        impl Store {
            $(
                $(#[$doc])+
                pub fn $noun(&self) -> $Repository<&Self> {
                    $Repository(self)
                }
            )+
        }

        impl Transaction {
            $(
                $(#[$doc])+
                pub fn $noun(&mut self) -> $Repository<&mut Self> {
                    $Repository(self)
                }
            )+
        }
    };
}

repositories! {
    /// Registered robots, their settings, credentials and desired states.
    robots: Robots;
    /// Enrollment tokens, and the robots that wait for approval.
    enrollments: Enrollments;
    /// Robots' reports, and what they say about assignments.
    reports: Reports;
    /// Deployments: the orders to bring a package onto robots.
    deployments: Deployments;
    /// The rest of large orders: selected robots that have no assignment yet.
    order_chunks: OrderChunks;
    /// Assignments: each deployment's part for each robot.
    assignments: Assignments;
    /// Decisions on how each robot receives a package.
    deliveries: Deliveries;
    /// Packages that robots receive inside MQTT messages.
    fan_outs: FanOuts;
    /// Idempotency keys, and the answers to their requests.
    idempotency: Idempotency;
    /// People with an account.
    users: Users;
    /// Tokens of robots and people.
    tokens: Tokens;
    /// Sessions of the web page.
    page_sessions: PageSessions;
    /// Wrong passwords of accounts.
    sign_in_failures: SignInFailures;
    /// Networks from which people have signed in.
    familiar_networks: FamiliarNetworks;
    /// The audit log: who changed what, in a chain of hashes.
    audit: Audit;
    /// Manifests in the registry's repositories.
    manifests: Manifests;
    /// Tags: names of manifests in the registry's repositories.
    tags: Tags;
    /// Blobs in the registry's repositories. Their bytes are elsewhere.
    blobs: Blobs;
    /// Objects of the servers' common store, by the blob that each of them holds.
    stored_blobs: StoredBlobs;
    /// Disk usage of the blobs that robots have uploaded.
    robot_blobs: RobotBlobs;
    /// Task packages and their users.
    packages: Packages;
    /// Outputs: the files that runs have uploaded.
    outputs: Outputs;
    /// Documents that publishers have signed.
    publishers: Publishers;
    /// The newest entries of the feed.
    feed: Feed;
    /// The servers that share the database.
    nodes: Nodes;
    /// The last session of each robot at any of them.
    robot_sessions: RobotSessions;
}
