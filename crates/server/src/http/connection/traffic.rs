//! Counts HTTP traffic at the sockets: heads, bodies and bytes sent in vain. Does nothing else.

use std::sync::atomic::{AtomicU64, Ordering};

use task_proto::api::HttpTraffic;

/// The totals of all connections since the server began.
#[derive(Debug, Default)]
pub struct HttpTotals {
    connections: AtomicU64,
    requests: AtomicU64,
    bytes_in: AtomicU64,
    bytes_out: AtomicU64,
}

impl HttpTotals {
    pub(in crate::http) fn connection(&self) {
        self.connections.fetch_add(1, Ordering::Relaxed);
    }

    pub(in crate::http) fn request(&self) {
        self.requests.fetch_add(1, Ordering::Relaxed);
    }

    pub(in crate::http) fn bytes_in(&self, count: usize) {
        self.bytes_in.fetch_add(count as u64, Ordering::Relaxed);
    }

    pub(in crate::http) fn bytes_out(&self, count: usize) {
        self.bytes_out.fetch_add(count as u64, Ordering::Relaxed);
    }

    /// The figures, which may be some packets apart from each other.
    pub fn read(&self) -> HttpTraffic {
        HttpTraffic {
            connections: self.connections.load(Ordering::Relaxed),
            requests: self.requests.load(Ordering::Relaxed),
            bytes_in: self.bytes_in.load(Ordering::Relaxed),
            bytes_out: self.bytes_out.load(Ordering::Relaxed),
        }
    }
}
