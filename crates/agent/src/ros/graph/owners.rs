//! Determines the owner of a participant. DDS does not name the process of a participant, but every
//! participant announces the UDP addresses that it listens at, and on this host the kernel knows
//! the owners of those sockets. This works with every vendor. Where the owner can't be determined
//! (another network namespace, no permission, an address that other hosts have too, no UDP at all),
//! the result is unknown, and [`Participant::first_seen`] is the only evidence left.
//!
//! A killed process's participant stays on the graph until its lease ends, and another process may
//! have its ports by then. So a participant that was seen before a process was started never
//! belongs to that process.

use std::collections::{BTreeMap, BTreeSet};
use std::net::{IpAddr, SocketAddr};
use std::os::unix::fs::MetadataExt;
use std::path::Path;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;
use std::{fs, io};

use nix::ifaddrs::getifaddrs;

use crate::process::program::ProcessIdentity;
use crate::ros::graph::dds::snapshot::{Participant, ParticipantId};

/// Resolution of the kernel's process start times, and of the age computed from them.
const CLOCK_STEP: Duration = Duration::from_millis(20);
/// Maximum number of former addresses of this host that are remembered; beyond that, all are
/// forgotten.
const MAX_FORMER: usize = 256;
/// Maximum number of open files of one process that are examined.
const MAX_FILES: usize = 65_536;

/// Participants, grouped by whether they live in the given processes.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Owners {
    /// Participants in one of these processes.
    pub theirs: BTreeSet<ParticipantId>,
    /// Participants in another process, on this host or elsewhere.
    pub others: BTreeSet<ParticipantId>,
    /// Participants in no living process: all their addresses belong to this host, and no possible
    /// owner listens there. Discovery knows of them until their lease ends.
    pub gone: BTreeSet<ParticipantId>,
    /// Participants with an unknown owner.
    pub unknown: BTreeSet<ParticipantId>,
}

/// This host's data about UDP sockets and about the processes in question.
#[derive(Debug, Default)]
struct Host {
    addresses: BTreeSet<IpAddr>,
    /// Former addresses of this host. Processes that were started then go on announcing them.
    former: BTreeSet<IpAddr>,
    /// Sockets by the port they are bound to.
    sockets: BTreeMap<u16, BTreeSet<u64>>,
    /// The sockets that the processes hold, with the age of the oldest holder.
    held: BTreeMap<u64, Duration>,
    /// Whether every process could be examined and shares the agent's network.
    complete: bool,
}

impl Owners {
    /// Reads the data from the kernel. This reads `/proc`, so it belongs on a thread that may
    /// block.
    pub(super) fn of(participants: &BTreeMap<ParticipantId, Participant>, pids: &[u32]) -> Self {
        let host = Host::read(Path::new("/proc"), pids).unwrap_or_else(|error| {
            tracing::warn!(error = %error, "cannot determine the owners of DDS participants");
            Host::default()
        });
        host.classify(participants)
    }

    /// The process on this host that contains the participant, if it can be determined. This
    /// examines every process.
    pub(super) fn process_of(participant: &Participant) -> Option<u32> {
        let host = Host::read(Path::new("/proc"), &[]).ok()?;
        host.holder(Path::new("/proc"), &participant.locators)
    }
}

impl Host {
    fn read(proc: &Path, pids: &[u32]) -> io::Result<Self> {
        let mut host = Self { complete: true, ..Self::default() };
        host.addresses = getifaddrs()?.filter_map(|interface| ip_of(&interface)).collect();
        host.former = former(&host.addresses);
        for table in ["net/udp", "net/udp6"] {
            match fs::read_to_string(proc.join(table)) {
                Ok(text) => text.lines().skip(1).filter_map(socket_of).for_each(|(port, inode)| {
                    host.sockets.entry(port).or_default().insert(inode);
                }),
                // A kernel without IPv6 has no such table.
                Err(error) if error.kind() == io::ErrorKind::NotFound => {}
                Err(error) => return Err(error),
            }
        }
        let network = fs::metadata(proc.join("self/ns/net"))?.ino();
        for pid in pids {
            match held_by(*pid, &proc.join(pid.to_string()), network) {
                Ok(Some((age, sockets))) => sockets.into_iter().for_each(|socket| {
                    let oldest = host.held.entry(socket).or_default();
                    *oldest = age.max(*oldest);
                }),
                Ok(None) => host.complete = false,
                // The process has ended, and its sockets with it.
                Err(error) if error.kind() == io::ErrorKind::NotFound => {}
                Err(error) => {
                    tracing::debug!(pid, error = %error, "cannot see a process's sockets");
                    host.complete = false;
                }
            }
        }
        Ok(host)
    }

    fn classify(&self, participants: &BTreeMap<ParticipantId, Participant>) -> Owners {
        let mut owners = Owners::default();
        for (id, participant) in participants {
            let seen_for = participant.first_seen.elapsed();
            let class = match self.holds(&participant.locators, seen_for) {
                _ if self.is_deserted(&participant.locators, seen_for) => &mut owners.gone,
                Some(true) => &mut owners.theirs,
                Some(false) => &mut owners.others,
                None => &mut owners.unknown,
            };
            class.insert(*id);
        }
        owners
    }

    /// Whether one of the processes listens at these addresses, and did when they were first seen;
    /// `None`: unknown.
    fn holds(&self, locators: &BTreeSet<SocketAddr>, seen_for: Duration) -> Option<bool> {
        let ports =
            locators.iter().filter(|locator| self.is_here(locator.ip())).map(SocketAddr::port);
        let mut theirs = false;
        let mut others = false;
        let mut shared = false;
        let is_held =
            |socket: &u64| self.held.get(socket).is_some_and(|age| *age + CLOCK_STEP >= seen_for);
        for sockets in ports.filter_map(|port| self.sockets.get(&port)) {
            match sockets.iter().filter(|socket| is_held(socket)).count() {
                0 => others = true,
                held if held == sockets.len() => theirs = true,
                _ => shared = true,
            }
        }
        // The address may have a new owner that listens at the same port, so a local holder of the
        // port proves nothing.
        let former = locators.iter().filter(|locator| self.former.contains(&locator.ip()));
        let may_be_here =
            former.filter_map(|locator| self.sockets.get(&locator.port())).flatten().any(is_held);
        // Another host may have one of our addresses too (a container bridge's), but hardly all of
        // them.
        let all_here = locators.iter().all(|locator| self.is_here(locator.ip()));
        match (theirs, others, shared) {
            _ if locators.is_empty() => None,
            (true, false, _) => all_here.then_some(true),
            (true, true, _) | (false, false, true) => None,
            (false, ..) => (self.complete && !may_be_here).then_some(false),
        }
    }

    /// Whether all these addresses belong to this host, and one of them has no listener that
    /// existed when they were first seen. One is enough: a participant listens at all addresses
    /// that it announces, and some of its ports are shared with others.
    fn is_deserted(&self, locators: &BTreeSet<SocketAddr>, seen_for: Duration) -> bool {
        let is_too_young =
            |socket: &u64| self.held.get(socket).is_some_and(|age| *age + CLOCK_STEP < seen_for);
        let is_left = |locator: &SocketAddr| {
            let sockets = self.sockets.get(&locator.port());
            sockets.is_none_or(|sockets| sockets.iter().all(is_too_young))
        };
        let all_here = locators.iter().all(|locator| self.is_here(locator.ip()));
        !self.sockets.is_empty() && all_here && locators.iter().any(is_left)
    }

    /// The one process that listens at one of these addresses; `None`: unknown.
    fn holder(&self, proc: &Path, locators: &BTreeSet<SocketAddr>) -> Option<u32> {
        let here = locators.iter().filter(|locator| self.is_here(locator.ip()));
        let ports = here.filter_map(|locator| self.sockets.get(&locator.port()));
        let own: BTreeSet<u64> =
            ports.filter(|sockets| sockets.len() == 1).flatten().copied().collect();
        let network = fs::metadata(proc.join("self/ns/net")).ok()?.ino();
        let processes = fs::read_dir(proc)
            .ok()?
            .filter_map(|entry| entry.ok()?.file_name().to_str()?.parse().ok());
        processes.into_iter().find(|pid: &u32| {
            // A process that another user hides stays unnamed.
            let held = held_by(*pid, &proc.join(pid.to_string()), network).ok().flatten();
            held.is_some_and(|(_, sockets)| !sockets.is_disjoint(&own))
        })
    }

    fn is_here(&self, address: IpAddr) -> bool {
        address.is_loopback() || self.addresses.contains(&address)
    }
}

/// The addresses that this host had at an earlier call since the agent was started, and has no
/// longer.
fn former(now: &BTreeSet<IpAddr>) -> BTreeSet<IpAddr> {
    static EVER: Mutex<BTreeSet<IpAddr>> = Mutex::new(BTreeSet::new());
    let mut ever = EVER.lock().unwrap_or_else(PoisonError::into_inner);
    if ever.len() > MAX_FORMER {
        ever.clear();
    }
    ever.extend(now);
    ever.difference(now).copied().collect()
}

fn ip_of(interface: &nix::ifaddrs::InterfaceAddress) -> Option<IpAddr> {
    let address = interface.address.as_ref()?;
    let v4 = address.as_sockaddr_in().map(|v4| IpAddr::V4(v4.ip()));
    v4.or_else(|| address.as_sockaddr_in6().map(|v6| IpAddr::V6(v6.ip())))
}

/// Port and inode of a line of `/proc/net/udp`.
fn socket_of(line: &str) -> Option<(u16, u64)> {
    let mut words = line.split_whitespace();
    let (_, port) = words.nth(1)?.rsplit_once(':')?;
    let inode = words.nth(7)?;
    Some((u16::from_str_radix(port, 16).ok()?, inode.parse().ok()?))
}

/// The age of a process and the sockets it holds; `None`: the process has another network than this
/// one.
fn held_by(
    pid: u32,
    process: &Path,
    network: u64,
) -> io::Result<Option<(Duration, BTreeSet<u64>)>> {
    if fs::metadata(process.join("ns/net"))?.ino() != network {
        return Ok(None);
    }
    let Some(identity) = ProcessIdentity::of(pid)? else {
        return Err(io::ErrorKind::NotFound.into());
    };
    let mut sockets = BTreeSet::new();
    for file in fs::read_dir(process.join("fd"))?.take(MAX_FILES) {
        // A file that was closed in between is no socket any more.
        let Ok(target) = fs::read_link(file?.path()) else { continue };
        let inode =
            target.to_str().and_then(|text| text.strip_prefix("socket:[")?.strip_suffix(']'));
        sockets.extend(inode.and_then(|inode| inode.parse::<u64>().ok()));
    }
    Ok(Some((identity.age()?, sockets)))
}

#[cfg(test)]
mod tests {
    use std::net::UdpSocket;
    use std::time::Instant;

    use super::*;

    fn participant(locators: &[&str]) -> Participant {
        let locators = locators.iter().map(|text| text.parse().expect("address")).collect();
        Participant { locators, first_seen: Instant::now() }
    }

    fn host(complete: bool) -> Host {
        Host {
            addresses: BTreeSet::from([
                "192.168.1.5".parse().expect("ip"),
                "172.17.0.1".parse().expect("ip"),
            ]),
            former: BTreeSet::from(["192.168.1.4".parse().expect("ip")]),
            sockets: BTreeMap::from([
                (7411, BTreeSet::from([1])),
                (7413, BTreeSet::from([2])),
                (7417, BTreeSet::from([3, 4])),
            ]),
            held: BTreeMap::from([(1, Duration::from_secs(10)), (3, Duration::from_secs(10))]),
            complete,
        }
    }

    #[test]
    fn port_identifies_the_owner_only_on_this_host() {
        for (locators, complete, expected) in [
            (&["192.168.1.5:7411"][..], true, Some(true)),
            (&["192.168.1.5:7411", "172.17.0.1:7411"], true, Some(true)),
            (&["127.0.0.1:7411"], false, Some(true)),
            (&["192.168.1.5:7413"], true, Some(false)),
            (&["192.168.1.5:7415"], true, Some(false)),
            (&["192.168.1.7:7411"], true, Some(false)),
            // The same container bridge on another host.
            (&["192.168.1.7:7411", "172.17.0.1:7411"], true, None),
            (&["192.168.1.7:7413", "172.17.0.1:7413"], true, Some(false)),
            (&["192.168.1.5:7413"], false, None),
            (&["192.168.1.7:7411"], false, None),
            // A port that two processes share proves nothing, and neither do two ports that
            // contradict each other.
            (&["192.168.1.5:7417"], true, None),
            (&["192.168.1.5:7417", "192.168.1.5:7411"], true, Some(true)),
            (&["192.168.1.5:7411", "192.168.1.5:7413"], true, None),
            // It announces an address that this host has lost; the participant may also belong to
            // the address's new owner.
            (&["192.168.1.4:7411"], true, None),
            (&["192.168.1.4:7413"], true, Some(false)),
            (&["192.168.1.4:7411", "192.168.1.5:7411"], true, None),
            (&[], true, None),
        ] {
            let found =
                host(complete).holds(&participant(locators).locators, Duration::from_secs(1));
            assert_eq!(found, expected, "{locators:?} {complete}");
        }
    }

    #[test]
    fn participant_seen_before_the_process_start_belongs_to_another() {
        let locators = participant(&["192.168.1.5:7411"]).locators;
        assert_eq!(host(true).holds(&locators, Duration::from_secs(10)), Some(true));
        assert_eq!(host(true).holds(&locators, Duration::from_secs(11)), Some(false));
    }

    #[test]
    fn participant_without_a_possible_process_is_gone() {
        for (locators, seen_for_s, expected) in [
            (&["192.168.1.5:7415"][..], 1, true),
            (&["192.168.1.5:7413"], 1, false),
            // A process that was started later took over its port.
            (&["192.168.1.5:7411"], 11, true),
            (&["192.168.1.5:7411"], 1, false),
            // One of its two ports is shared with other living participants.
            (&["192.168.1.5:7415", "192.168.1.5:7413"], 1, true),
            (&["192.168.1.7:7415"], 1, false),
            (&["192.168.1.4:7415"], 1, false),
            (&["192.168.1.5:7415", "192.168.1.7:7415"], 1, false),
            (&[], 1, false),
        ] {
            let found = host(true)
                .is_deserted(&participant(locators).locators, Duration::from_secs(seen_for_s));
            assert_eq!(found, expected, "{locators:?} {seen_for_s}");
        }
        assert!(
            !Host::default()
                .is_deserted(&participant(&["127.0.0.1:7415"]).locators, Duration::ZERO)
        );
    }

    #[test]
    fn socket_of_this_process_is_found() {
        let socket = UdpSocket::bind("127.0.0.1:0").expect("socket");
        let address = socket.local_addr().expect("address").to_string();
        let id = ParticipantId([1; 12]);
        let participants = BTreeMap::from([(id, participant(&[&address]))]);
        assert_eq!(Owners::of(&participants, &[std::process::id()]).theirs, BTreeSet::from([id]));
        assert_eq!(Owners::of(&participants, &[]).others, BTreeSet::from([id]));
        assert_eq!(Owners::process_of(&participants[&id]), Some(std::process::id()));
    }

    #[test]
    fn lines_of_the_table_are_read() {
        let line = "  512: 00000000:1CF3 00000000:0000 07 00000000:00000000 00:00000000 00000000  1000        0 41557 2 0 0";
        assert_eq!(socket_of(line), Some((7411, 41557)));
        assert_eq!(socket_of("   sl  local_address"), None);
    }
}
