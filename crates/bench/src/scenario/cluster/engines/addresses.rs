//! Loopback addresses of a run's engines, and the names by which robots know them: each name leads
//! to all entrances, in another order, as a name with several addresses in DNS does.

use std::net::{Ipv4Addr, SocketAddr, TcpListener};
use std::path::Path;

use anyhow::Context as _;

use crate::simulated::robots::messages::Entrance;
use crate::system::process::Program;

/// The last byte of the first server's address.
const NODES: usize = 11;
/// The last byte of the first balancer's address.
const BALANCERS: usize = 101;
/// Bytes that name a network of the run's own. Robots have 127.0.0.0/16.
const NETWORKS: std::ops::RangeInclusive<u8> = 128..=254;
/// Starts a program with this file in the place of /etc/hosts. Other programs do not see it.
const WITH_HOSTS: &str = "mount --bind \"$1\" /etc/hosts && shift && exec \"$@\"";

/// The addresses of one run, all of them in a network of its own below 127.0.0.0/8.
#[derive(Debug, Clone)]
pub struct Addresses {
    network: [u8; 2],
    http_port: u16,
    mqtt_port: u16,
}

impl Addresses {
    /// A random network, and two ports that are free in it.
    pub fn choose() -> anyhow::Result<Self> {
        let byte = || rand::random_range(NETWORKS);
        let network = [byte(), byte()];
        let [http_port, mqtt_port] = free_ports(address(network, NODES))?;
        Ok(Self { network, http_port, mqtt_port })
    }

    pub fn node(&self, number: usize) -> Ipv4Addr {
        address(self.network, NODES + number)
    }

    pub fn balancer(&self, number: usize) -> Ipv4Addr {
        address(self.network, BALANCERS + number)
    }

    /// The port for HTTP, the same at all addresses.
    pub fn http(&self, at: Ipv4Addr) -> SocketAddr {
        (at, self.http_port).into()
    }

    /// The port for MQTT, the same at all addresses.
    pub fn mqtt(&self, at: Ipv4Addr) -> SocketAddr {
        (at, self.mqtt_port).into()
    }

    /// The entrances as robots see them, with a file that says which addresses the names have.
    pub fn entrances(&self, addresses: &[Ipv4Addr]) -> (Vec<Entrance>, String) {
        let names = (0..addresses.len()).map(|number| format!("fleet{number}"));
        let entrance = |name: String| Entrance {
            url: format!("http://{name}:{}", self.http_port),
            mqtt_host: name,
        };
        (names.map(entrance).collect(), hosts(addresses))
    }
}

/// The lines of a hosts file: each name has all addresses, beginning with the one at its number.
fn hosts(addresses: &[Ipv4Addr]) -> String {
    let mut text = "127.0.0.1 localhost\n".to_owned();
    for number in 0..addresses.len() {
        for address in addresses.iter().cycle().skip(number).take(addresses.len()) {
            text.push_str(&format!("{address} fleet{number}\n"));
        }
    }
    text
}

/// A program that starts another with this hosts file, in a mount namespace.
pub fn with_hosts(file: &Path) -> Program {
    // Without privileges, the namespace needs a user namespace around it.
    let namespaces = if nix::unistd::geteuid().is_root() { "-m" } else { "-rm" };
    let script = ["sh", "-c", WITH_HOSTS, "sh"].map(Path::new);
    Program::named("unshare").args([namespaces]).args(script).args([file])
}

fn address([b, c]: [u8; 2], last: usize) -> Ipv4Addr {
    Ipv4Addr::new(127, b, c, u8::try_from(last).unwrap_or(u8::MAX))
}

/// Ports that were free at this address a moment ago, for programs that can't report theirs.
pub fn free_ports<const N: usize>(at: Ipv4Addr) -> anyhow::Result<[u16; N]> {
    let mut kept = Vec::new();
    let mut ports = [0; N];
    for port in &mut ports {
        let listener = TcpListener::bind((at, 0)).context("no free port")?;
        *port = listener.local_addr().context("no free port")?.port();
        kept.push(listener);
    }
    Ok(ports)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_name_has_all_addresses_in_another_order() {
        let all = [1, 2, 3].map(|last| Ipv4Addr::new(127, 200, 0, last));
        let text = hosts(&all);
        let of = |name: &str| {
            let lines = text.lines().filter_map(|line| line.strip_suffix(name));
            lines.map(str::trim).map(str::to_owned).collect::<Vec<_>>()
        };
        assert_eq!(of("fleet0"), ["127.200.0.1", "127.200.0.2", "127.200.0.3"]);
        assert_eq!(of("fleet2"), ["127.200.0.3", "127.200.0.1", "127.200.0.2"]);
    }
}
