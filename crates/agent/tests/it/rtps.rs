//! RTPS datagrams as an attacker writes them, and how much memory a process has.

use std::net::{Ipv4Addr, SocketAddr, UdpSocket};
use std::time::Duration;

/// `DATA_FRAG`: states the size of the whole sample.
pub fn data_frag(
    prefix: [u8; 12],
    endpoints: Endpoints,
    number: u32,
    stated_bytes: u32,
) -> Vec<u8> {
    let payload = [0x5a; 64];
    let mut body = vec![0, 0, 28, 0];
    body.extend(endpoints.ids());
    body.extend(sequence_number(number.into()));
    body.extend(1_u32.to_le_bytes());
    body.extend(1_u16.to_le_bytes());
    body.extend(64_u16.to_le_bytes());
    body.extend(stated_bytes.to_le_bytes());
    body.extend(payload);
    datagram(prefix, 0x16, &body)
}

/// `HEARTBEAT`: states the available samples.
pub fn heartbeat(prefix: [u8; 12], endpoints: Endpoints, last: i64, count: u32) -> Vec<u8> {
    let mut body = endpoints.ids().to_vec();
    body.extend(sequence_number(1));
    body.extend(sequence_number(last));
    body.extend(count.to_le_bytes());
    datagram(prefix, 0x07, &body)
}

/// `GAP`: states the unavailable samples.
pub fn gap(prefix: [u8; 12], endpoints: Endpoints, from: i64, to: i64) -> Vec<u8> {
    let mut body = endpoints.ids().to_vec();
    body.extend(sequence_number(from));
    body.extend(sequence_number(to));
    body.extend(0_u32.to_le_bytes());
    datagram(prefix, 0x08, &body)
}

/// `INFO_REPLY` before the submessages of `datagram`: asks for replies to this port of loopback.
/// `rest` follows the list of locators.
pub fn with_info_reply(port: u16, rest: &[u8], datagram: &[u8]) -> Vec<u8> {
    let (header, submessages) = datagram.split_at(20);
    let mut reply = 1_u32.to_le_bytes().to_vec();
    reply.extend(loopback(port));
    reply.extend(rest);
    let length = u16::try_from(reply.len()).expect("short").to_le_bytes();
    [header, &[0x0f, 1], &length, &reply, submessages].concat()
}

/// The locator of a port of loopback.
fn loopback(port: u16) -> Vec<u8> {
    let mut locator = 1_u32.to_le_bytes().to_vec();
    locator.extend(u32::from(port).to_le_bytes());
    locator.extend([0; 12]);
    locator.extend(Ipv4Addr::LOCALHOST.octets());
    locator
}

/// The announcement of a participant that listens at `at`.
pub fn announcement(prefix: [u8; 12], number: u32, at: u16) -> Vec<u8> {
    let mut parameters = vec![0, 3, 0, 0];
    let mut parameter = |id: u16, value: &[u8]| {
        parameters.extend(id.to_le_bytes());
        parameters.extend(u16::try_from(value.len()).expect("short").to_le_bytes());
        parameters.extend(value);
    };
    let mut guid = prefix.to_vec();
    guid.extend([0, 0, 1, 0xc1]);
    let locator = loopback(at);
    parameter(0x0015, &[2, 4, 0, 0]);
    parameter(0x0016, &[1, 0x0f, 0, 0]);
    parameter(0x0050, &guid);
    parameter(0x0058, &0x0c3f_u32.to_le_bytes());
    parameter(0x0032, &locator);
    parameter(0x0031, &locator);
    parameter(0x0002, &[100, 0, 0, 0, 0, 0, 0, 0]);
    parameter(0x0001, &[]);
    let mut body = vec![0, 0, 16, 0];
    body.extend(PARTICIPANTS.ids());
    body.extend(sequence_number(number.into()));
    body.extend(parameters);
    let mut datagram = datagram(prefix, 0x15, &body);
    // With data.
    datagram[21] = 0x05;
    datagram
}

/// A reader and its writer.
#[derive(Clone, Copy)]
pub struct Endpoints([u8; 8]);

/// Those by which participants find each other.
pub const PARTICIPANTS: Endpoints = Endpoints([0, 1, 0, 0xc7, 0, 1, 0, 0xc2]);
/// The endpoints that announce publications.
pub const PUBLICATIONS: Endpoints = Endpoints([0, 0, 3, 0xc7, 0, 0, 3, 0xc2]);

impl Endpoints {
    fn ids(self) -> [u8; 8] {
        self.0
    }
}

fn sequence_number(number: i64) -> Vec<u8> {
    let high = i32::try_from(number >> 32).expect("32 bits").to_le_bytes();
    let low = u32::try_from(number & 0xffff_ffff).expect("32 bits").to_le_bytes();
    [high, low].concat()
}

fn datagram(prefix: [u8; 12], kind: u8, body: &[u8]) -> Vec<u8> {
    let mut datagram = b"RTPS\x02\x04\x01\x0f".to_vec();
    datagram.extend(prefix);
    datagram.extend([kind, 1]);
    datagram.extend(u16::try_from(body.len()).expect("short").to_le_bytes());
    datagram.extend(body);
    datagram
}

/// The kind of the submessage by which a reader asks for samples.
const ACKNACK: u8 = 0x06;

/// The kinds of a datagram's submessages.
fn kinds(datagram: &[u8]) -> Vec<u8> {
    let mut kinds = Vec::new();
    let mut rest = datagram.get(20..).unwrap_or_default();
    while let [kind, _, low, high, behind @ ..] = rest {
        kinds.push(*kind);
        rest = behind.get(usize::from(u16::from_le_bytes([*low, *high]))..).unwrap_or_default();
    }
    kinds
}

/// The ports of the first participant of this domain: for discovery and for user traffic.
fn ports(domain_id: u16) -> [u16; 2] {
    [10, 11].map(|port| 7400 + 250 * domain_id + port)
}

/// The ports of all participants of this domain on a host, and of their multicast group.
pub fn all_ports(domain_id: u16) -> impl Iterator<Item = u16> {
    [0, 1].into_iter().chain(10..24).map(move |port| 7400 + 250 * domain_id + port)
}

/// Whether a datagram that asks for samples arrives within a moment.
pub fn is_asked(socket: &UdpSocket) -> bool {
    socket.set_read_timeout(Some(Duration::from_millis(100))).expect("a time limit");
    let mut bytes = [0; 65_536];
    while let Ok(length) = socket.recv(&mut bytes) {
        if kinds(&bytes[..length]).contains(&ACKNACK) {
            return true;
        }
    }
    false
}

/// Sends each of these to the first participant of this domain on this host. The others have
/// parsers of their own, some of which have lower limits.
pub fn send(socket: &UdpSocket, domain_id: u16, datagrams: impl IntoIterator<Item = Vec<u8>>) {
    for datagram in datagrams {
        for port in ports(domain_id) {
            socket.send_to(&datagram, SocketAddr::from((Ipv4Addr::LOCALHOST, port))).expect("sent");
        }
    }
}

/// The resident and the whole address space of a process, in bytes.
pub fn memory_of(pid: u32) -> (u64, u64) {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).expect("its status");
    let of = |name: &str| {
        let line = status.lines().find_map(|line| line.strip_prefix(name)).expect("in its status");
        line.trim().trim_end_matches(" kB").parse::<u64>().expect("a number") * 1024
    };
    (of("VmRSS:"), of("VmSize:"))
}
