//! An emulated slow link between the server and the robots: a network namespace for the robots, a
//! pair of virtual interfaces, a rate limit on both ends, and a delay if the kernel supports one.
//! All robots share the link, as they share an access point. Dropping the link removes it;
//! leftovers of a killed run are removed by the next run.

use std::net::{IpAddr, Ipv4Addr};
use std::path::Path;
use std::str::FromStr;

use anyhow::{Context as _, bail};

use crate::system::process::{ProcessError, Program, run_now};

/// Prefix of the namespaces' names; the pid of the run follows.
const PREFIX: &str = "taskbench-";
/// The system's directory of namespaces.
const NAMESPACES: &str = "/run/netns";
/// Minimum burst, so that a large segment passes.
const MIN_BURST_BYTES: u64 = 64 * 1024;
/// How long a packet may queue before it is dropped.
const MAX_WAIT: &str = "200ms";

/// A rate, and perhaps a delay: `20mbit,30ms`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LinkQuality {
    /// Bits per second, each way.
    pub bits_per_s: u64,
    pub delay_ms: Option<u32>,
}

impl FromStr for LinkQuality {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (rate, delay) =
            text.split_once(',').map_or((text, None), |(rate, delay)| (rate, Some(delay)));
        let units = [("kbit", 1_000), ("mbit", 1_000_000), ("gbit", 1_000_000_000)];
        let number = units.into_iter().find_map(|(unit, factor)| {
            let number: f64 = rate.strip_suffix(unit)?.parse().ok()?;
            Some(number * f64::from(factor))
        });
        let bits_per_s = number.filter(|bits| (8_000.0..=100e9).contains(bits));
        let bits_per_s = bits_per_s
            .ok_or_else(|| format!("{rate:?} is not a rate: expected for example 20mbit"))?
            as u64;
        let parse = |delay: &str| {
            delay.strip_suffix("ms")?.parse().ok().filter(|ms| (1..=10_000).contains(ms))
        };
        let wrong = |delay: &str| format!("{delay:?} is not a delay: expected for example 30ms");
        let delay_ms = delay.map(|delay| parse(delay).ok_or_else(|| wrong(delay))).transpose()?;
        Ok(Self { bits_per_s, delay_ms })
    }
}

/// The emulated link. Dropping the handle removes the link.
#[derive(Debug)]
pub struct Link {
    namespace: String,
    interface: String,
    server: Ipv4Addr,
}

impl Link {
    /// Creates the link. Needs root, `ip` and `tc`.
    pub async fn make(quality: LinkQuality) -> anyhow::Result<Self> {
        remove_leftovers();
        let pid = std::process::id();
        let subnet = u8::try_from(pid % 254)?;
        // 198.18.0.0/15 is reserved for benchmarks: no other interface uses these addresses.
        let server = Ipv4Addr::new(198, 18, subnet, 1);
        let robots = Ipv4Addr::new(198, 18, subnet, 2);
        let link =
            Self { namespace: format!("{PREFIX}{pid}"), interface: format!("tb{pid}"), server };
        let outer = link.interface.as_str();
        let inner = format!("tb{pid}r");
        let space = link.namespace.as_str();
        ip(&["netns", "add", space]).await.context("--link needs root and the tool ip")?;
        ip(&["link", "add", outer, "type", "veth", "peer", "name", &inner, "netns", space]).await?;
        ip(&["addr", "add", &format!("{server}/30"), "dev", outer]).await?;
        ip(&["link", "set", outer, "up"]).await?;
        ip(&["-n", space, "addr", "add", &format!("{robots}/30"), "dev", &inner]).await?;
        ip(&["-n", space, "link", "set", &inner, "up"]).await?;
        ip(&["-n", space, "link", "set", "lo", "up"]).await?;
        for (at, device) in [(None, outer), (Some(space), inner.as_str())] {
            limit(quality, at, device).await?;
        }
        Ok(link)
    }

    /// The server's address on the link.
    pub fn server(&self) -> IpAddr {
        self.server.into()
    }

    /// The program that starts other programs in the robots' namespace.
    pub fn inside(&self) -> Program {
        Program::named("ip").args(["netns", "exec", &self.namespace])
    }
}

impl Drop for Link {
    fn drop(&mut self) {
        // Either may be missing, if the setup failed half way.
        let _ = run_now("ip", &["link", "del", &self.interface]);
        let _ = run_now("ip", &["netns", "del", &self.namespace]);
    }
}

async fn limit(quality: LinkQuality, namespace: Option<&str>, device: &str) -> anyhow::Result<()> {
    let tc = |arguments: &[&str]| {
        let program = namespace
            .map_or(Program::named("tc"), |space| Program::named("tc").args(["-n", space]));
        program.args(["qdisc", "add", "dev", device]).args(arguments)
    };
    let rate = format!("{}bit", quality.bits_per_s);
    // A tenth of a second's worth would be a free ride for small packages: a hundredth, if a
    // segment fits.
    let burst = (quality.bits_per_s / 8 / 100).max(MIN_BURST_BYTES).to_string();
    tc(&["root", "handle", "1:", "tbf", "rate", &rate, "burst", &burst, "latency", MAX_WAIT])
        .output()
        .await
        .context("--link: the rate can't be limited")?;
    let Some(delay_ms) = quality.delay_ms else { return Ok(()) };
    let delay = format!("{delay_ms}ms");
    match tc(&["parent", "1:1", "handle", "10:", "netem", "delay", &delay, "limit", "100000"])
        .output()
        .await
    {
        Ok(_) => Ok(()),
        Err(ProcessError::Failed { message, .. }) => bail!(
            "--link: this kernel has no delay (netem: {message}); leave it out, as in --link {}kbit",
            quality.bits_per_s / 1000
        ),
        Err(error) => Err(error.into()),
    }
}

async fn ip(arguments: &[&str]) -> Result<String, ProcessError> {
    Program::named("ip").args(arguments).output().await
}

/// Removes the namespaces of runs that are no more; their interfaces go with them.
fn remove_leftovers() {
    for entry in std::fs::read_dir(NAMESPACES).into_iter().flatten().flatten() {
        let name = entry.file_name().to_string_lossy().into_owned();
        let pid = name.strip_prefix(PREFIX).filter(|pid| pid.parse::<u32>().is_ok());
        if pid.is_some_and(|pid| !Path::new("/proc").join(pid).exists()) {
            let _ = run_now("ip", &["netns", "del", &name]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn link_has_a_rate_and_an_optional_delay() {
        let link = |bits_per_s, delay_ms| Ok(LinkQuality { bits_per_s, delay_ms });
        assert_eq!("20mbit,30ms".parse(), link(20_000_000, Some(30)));
        assert_eq!("1.5gbit".parse(), link(1_500_000_000, None));
        for (wrong, named) in [
            ("20", "\"20\" is not a rate"),
            ("0mbit", "0mbit"),
            ("1mbit,3", "\"3\" is not a delay"),
        ] {
            let error = wrong.parse::<LinkQuality>().expect_err(wrong);
            assert!(error.contains(named), "{error}");
        }
    }
}
