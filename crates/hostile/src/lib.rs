//! One target function for each parser of untrusted bytes. A target takes any bytes and panics if
//! the parser panics, or if accepted input violates an invariant: a value that was read is written
//! and read back the same, and an archive leaves its directory alone. The fuzzer in `fuzz/` calls
//! the targets without end; the tests here call them with the stored corpora and mutations of them.

mod archive;
mod messages;
mod mqtt;
mod mutation;
mod names;
mod package;
mod proxy_header;
mod registry;
mod rtps;
mod signed;
mod websocket;

pub use archive::archive;
pub use messages::{part, reply, report};
pub use mqtt::{mqtt_packets, mqtt_session};
pub use mutation::Mutation;
pub use names::{names, selector, token};
pub use package::{manifest, package_xml, task_toml};
pub use proxy_header::proxy_header;
pub use registry::oci_manifest;
pub use rtps::{Counting, rtps};
pub use signed::{desired, envelope};
pub use websocket::websocket;

/// A parser and its test.
pub struct Target {
    /// The name of the program in `fuzz/` and of the directory in `fuzz/corpus`.
    pub name: &'static str,
    /// Parses any bytes; panics if a promise is broken.
    pub run: fn(&[u8]),
    /// The number of changed inputs in the tests, chosen to take about two seconds.
    pub tries: u32,
}

pub const TARGETS: [Target; 18] = [
    Target { name: "archive", run: archive, tries: 500 },
    Target { name: "desired", run: desired, tries: 1_000 },
    Target { name: "envelope", run: envelope, tries: 3_000 },
    Target { name: "manifest", run: manifest, tries: 4_000 },
    Target { name: "mqtt_packets", run: mqtt_packets, tries: 20_000 },
    Target { name: "mqtt_session", run: mqtt_session, tries: 400 },
    Target { name: "names", run: names, tries: 20_000 },
    Target { name: "oci_manifest", run: oci_manifest, tries: 5_000 },
    Target { name: "package_xml", run: package_xml, tries: 3_000 },
    Target { name: "part", run: part, tries: 20_000 },
    Target { name: "proxy_header", run: proxy_header, tries: 50_000 },
    Target { name: "reply", run: reply, tries: 3_000 },
    Target { name: "report", run: report, tries: 2_000 },
    Target { name: "rtps", run: rtps, tries: 5_000 },
    Target { name: "selector", run: selector, tries: 20_000 },
    Target { name: "task_toml", run: task_toml, tries: 1_000 },
    Target { name: "token", run: token, tries: 20_000 },
    Target { name: "websocket", run: websocket, tries: 10_000 },
];
