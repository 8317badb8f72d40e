//! Vitals of the machine, read from the kernel's /proc and /sys. A [`VitalsReader`] reads them. A
//! [`Sender`] sends them once a minute over the MQTT session, or over HTTP while no session is up.
//! No decision depends on vitals, and lost ones are not sent again.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use task_proto::RobotId;
use task_proto::api::AWAITS_APPROVAL;
use task_proto::error_chain::chain;
use task_proto::messages::topic::RobotTopic;
use task_proto::telemetry::vitals::{Telemetry, Vitals};
use tokio::sync::{Mutex, mpsc};
use tokio::time::Instant;

use crate::link::state::{LinkState, Message, REFUSED_POLL, spread};
use crate::system::battery;
use crate::system::clock;
use crate::system::disk;
use crate::transfer::server::{Server, ServerError};

/// Shortest time span for meaningful percentages and rates.
const MIN_SPAN: Duration = Duration::from_millis(250);
/// The first vitals are sent within this time, so that a fleet that starts at once spreads over it.
const FIRST_WITHIN: Duration = Duration::from_secs(10);
/// Pause after the server answers that it does not know telemetry: the server is older than this
/// agent.
const UNKNOWN_PAUSE: Duration = Duration::from_secs(3600);

/// Paths that vitals are read from.
#[derive(Debug, Clone)]
pub struct VitalsPaths {
    pub proc: PathBuf,
    pub sys: PathBuf,
    /// A path on the reported file system.
    pub data: PathBuf,
}

impl VitalsPaths {
    /// The paths of this machine, with the agent's data directory.
    pub fn of_this_machine(data: &Path) -> Self {
        Self { proc: "/proc".into(), sys: "/sys".into(), data: data.to_owned() }
    }
}

/// Cumulative counters. Two readings give percentages and rates.
#[derive(Debug, Clone, Copy, Default)]
struct Counters {
    /// Total and busy time of all processors, in kernel ticks.
    cpu: Option<(u64, u64)>,
    /// Bytes received and sent.
    network: Option<(u64, u64)>,
}

/// Reads the machine's vitals repeatedly.
pub struct VitalsReader {
    paths: VitalsPaths,
    before: Option<(Instant, Counters)>,
    last: Vitals,
}

impl VitalsReader {
    /// A gauge without a first reading.
    pub fn new(paths: VitalsPaths) -> Self {
        Self { paths, before: None, last: Vitals::default() }
    }

    /// Reads the vitals at `now`. The first reading has no percentages and rates. A reading too
    /// soon after the last one returns that one again.
    pub fn read(&mut self, now: Instant) -> Vitals {
        if self.before.is_some_and(|(at, _)| now.duration_since(at) < MIN_SPAN) {
            return self.last;
        }
        let counters = Counters { cpu: self.cpu(), network: self.network() };
        let (before_at, before) =
            self.before.replace((now, counters)).unwrap_or((now, Counters::default()));
        let seconds = now.duration_since(before_at).as_secs_f64();
        let network = counters.network.zip(before.network).filter(|_| seconds > 0.0);
        let rate = |now: u64, before: u64| (now.saturating_sub(before) as f64 / seconds) as u64;
        let (memory_total_bytes, memory_used_bytes) = self.memory().unzip();
        let room = disk::space(&self.paths.data).ok();
        self.last = Vitals {
            at_ms: clock::wall_ms(),
            cpu_percent: counters
                .cpu
                .zip(before.cpu)
                .and_then(|(now, before)| busy_percent(now, before)),
            memory_used_bytes,
            memory_total_bytes,
            disk_used_bytes: room.map(|room| room.total.saturating_sub(room.free)),
            disk_total_bytes: room.map(|room| room.total),
            network_in_bytes_per_s: network.map(|(now, before)| rate(now.0, before.0)),
            network_out_bytes_per_s: network.map(|(now, before)| rate(now.1, before.1)),
            load_1m: self
                .proc("loadavg")
                .and_then(|text| text.split_whitespace().next()?.parse().ok()),
            battery_percent: battery::percent(&self.paths.sys.join("class/power_supply")),
            temperature_c: self.temperature(),
        };
        self.last
    }

    fn proc(&self, name: &str) -> Option<String> {
        fs::read_to_string(self.paths.proc.join(name)).ok()
    }

    fn cpu(&self) -> Option<(u64, u64)> {
        let text = self.proc("stat")?;
        let line = text.lines().find_map(|line| line.strip_prefix("cpu "))?;
        // Guest time is already included in the time of the hosts.
        let ticks: Vec<u64> =
            line.split_whitespace().take(8).map_while(|number| number.parse().ok()).collect();
        let idle = ticks.get(3)?.saturating_add(ticks.get(4).copied().unwrap_or(0));
        let all = ticks.iter().copied().fold(0, u64::saturating_add);
        Some((all, all.saturating_sub(idle)))
    }

    /// Total memory, and the memory that is not available to programs.
    fn memory(&self) -> Option<(u64, u64)> {
        let text = self.proc("meminfo")?;
        let bytes = |key: &str| {
            let line = text.lines().find_map(|line| line.strip_prefix(key)?.strip_prefix(':'))?;
            line.split_whitespace().next()?.parse::<u64>().ok()?.checked_mul(1024)
        };
        let total = bytes("MemTotal")?;
        Some((total, total.saturating_sub(bytes("MemAvailable")?)))
    }

    /// Traffic of the interfaces that are devices. Without any, as in a container, traffic of all
    /// interfaces but the loopback. Bridges and similar interfaces would count all traffic twice.
    fn network(&self) -> Option<(u64, u64)> {
        let text = self.proc("net/dev")?;
        let all = text.lines().filter_map(|line| {
            let (name, figures) = line.split_once(':')?;
            let figures: Vec<&str> = figures.split_whitespace().collect();
            Some((
                name.trim(),
                figures.first()?.parse::<u64>().ok()?,
                figures.get(8)?.parse::<u64>().ok()?,
            ))
        });
        let all: Vec<_> = all.filter(|(name, ..)| *name != "lo").collect();
        let devices: BTreeSet<&str> =
            all.iter().map(|(name, ..)| *name).filter(|name| self.is_device(name)).collect();
        let counted = all.iter().filter(|(name, ..)| devices.is_empty() || devices.contains(name));
        Some(counted.fold((0, 0), |sum, (_, r#in, out)| {
            (sum.0.saturating_add(*r#in), sum.1.saturating_add(*out))
        }))
    }

    fn is_device(&self, interface: &str) -> bool {
        self.paths.sys.join("class/net").join(interface).join("device").exists()
    }

    fn temperature(&self) -> Option<f32> {
        let zones = fs::read_dir(self.paths.sys.join("class/thermal")).ok()?.flatten();
        let zones =
            zones.filter(|zone| zone.file_name().to_string_lossy().starts_with("thermal_zone"));
        let read = |zone: fs::DirEntry| {
            fs::read_to_string(zone.path().join("temp")).ok()?.trim().parse::<i32>().ok()
        };
        // Ignore impossible values, which a zone without a sensor reports.
        let hottest =
            zones.filter_map(read).filter(|milli| (-40_000..=150_000).contains(milli)).max()?;
        Some(tenths(f64::from(hottest) / 1000.0))
    }
}

fn busy_percent(now: (u64, u64), before: (u64, u64)) -> Option<f32> {
    let all = now.0.checked_sub(before.0).filter(|all| *all > 0)?;
    let busy = now.1.saturating_sub(before.1).min(all);
    Some(tenths(busy as f64 * 100.0 / all as f64))
}

fn tenths(value: f64) -> f32 {
    ((value * 10.0).round() / 10.0) as f32
}

/// A source of vitals: the machine, or a simulation of one.
pub trait Source: Send + 'static {
    fn read(&mut self) -> Vitals;
}

impl Source for VitalsReader {
    fn read(&mut self) -> Vitals {
        self.read(Instant::now())
    }
}

/// Vitals on request. Frequent requests get percentages and rates over the time since the last one.
#[derive(Clone)]
pub struct OnDemandVitals {
    reader: Arc<Mutex<VitalsReader>>,
}

impl OnDemandVitals {
    /// A source for the machine at `paths`.
    pub fn new(paths: VitalsPaths) -> Self {
        Self { reader: Arc::new(Mutex::new(VitalsReader::new(paths))) }
    }

    /// The current vitals. After a longer pause this takes two readings, because percentages and
    /// rates would otherwise cover the whole pause.
    pub async fn now(&self) -> Vitals {
        const FRESH: Duration = Duration::from_secs(10);
        let mut reader = self.reader.lock().await;
        let is_fresh = reader.before.is_some_and(|(at, _)| at.elapsed() < FRESH);
        if !is_fresh {
            reader.before = None;
            reader.read(Instant::now());
            tokio::time::sleep(MIN_SPAN).await;
        }
        reader.read(Instant::now())
    }
}

/// Sends the robot's vitals periodically.
pub struct Sender<S> {
    pub robot_id: RobotId,
    /// Interval between messages; zero disables them.
    pub interval: Duration,
    /// Source of the vitals.
    pub source: S,
    /// HTTP client for use while no session is up.
    pub server: Server,
}

impl<S: Source> Sender<S> {
    /// Sends until the agent ends, through `messages` while a session is up.
    pub async fn run(mut self, link_state: LinkState, messages: mpsc::Sender<Message>) {
        if self.interval.is_zero() {
            return;
        }
        // A session carries the same data at less cost, above all when a whole fleet starts at
        // once.
        if !link_state.first_attempt_ended().await {
            return;
        }
        // This reading is the start of the first message's percentages and rates.
        self.source.read();
        let first = FIRST_WITHIN.min(self.interval).mul_f64(0.1 + 0.9 * rand::random::<f64>());
        let mut ticks = tokio::time::interval_at(Instant::now() + first, self.interval);
        ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        let mut not_before = Instant::now();
        loop {
            tokio::select! {
                // Cancel-safe: an interval keeps its own time.
                _ = ticks.tick() => {}
                // Cancel-safe: a token can be awaited again.
                () = link_state.shutdown.cancelled() => return,
            }
            let telemetry =
                Telemetry { robot_id: self.robot_id.clone(), vitals: self.source.read() };
            if link_state.mqtt_now().is_up() {
                publish(&messages, &telemetry);
            } else if Instant::now() >= not_before
                && let Err(error) = self.server.telemetry(&telemetry).await
            {
                tracing::debug!(error = %chain(&error), "no vitals over HTTP");
                not_before = Instant::now() + pause(&error);
            }
        }
    }
}

/// Pause after this error before vitals are sent again.
fn pause(error: &ServerError) -> Duration {
    match error {
        ServerError::TokenRefused(_) => REFUSED_POLL.mul_f64(spread()),
        // The robot may be approved at any time.
        ServerError::Refused { code, .. } if code == AWAITS_APPROVAL => {
            REFUSED_POLL.mul_f64(spread())
        }
        ServerError::Refused { .. } => UNKNOWN_PAUSE,
        ServerError::Busy { retry_after: Some(wait), .. } => (*wait).min(REFUSED_POLL),
        ServerError::Busy { .. } | ServerError::Unreachable(_) | ServerError::NotTheServer(_) => {
            Duration::ZERO
        }
    }
}

fn publish(messages: &mpsc::Sender<Message>, telemetry: &Telemetry) {
    match serde_json::to_vec(telemetry) {
        // Drop the message if the session is too slow: the next vitals are more useful.
        Ok(payload) => drop(messages.try_send(Message { topic: RobotTopic::Telemetry, payload })),
        Err(error) => tracing::error!(%error, "vitals can't be written as JSON"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::link::state::MqttState;

    struct Machine {
        dir: tempfile::TempDir,
    }

    impl Machine {
        fn new() -> Self {
            Self { dir: tempfile::tempdir().expect("a directory") }
        }

        fn write(&self, path: &str, text: &str) {
            let path = self.dir.path().join(path);
            fs::create_dir_all(path.parent().expect("a parent")).expect("made");
            fs::write(path, text).expect("written");
        }

        fn reader(&self) -> VitalsReader {
            let root = self.dir.path();
            VitalsReader::new(VitalsPaths {
                proc: root.join("proc"),
                sys: root.join("sys"),
                data: root.to_owned(),
            })
        }
    }

    const NET_HEAD: &str = "Inter-|   Receive                            |  Transmit\n face |bytes    packets |bytes    packets\n";

    fn interface(name: &str, r#in: u64, out: u64) -> String {
        format!("  {name}: {in} 1 0 0 0 0 0 0 {out} 1 0 0 0 0 0 0\n")
    }

    #[test]
    fn vitals_rates_cover_the_time_between_readings() {
        let machine = Machine::new();
        machine.write("proc/stat", "cpu  100 0 100 700 100 0 0 0 50 0\ncpu0 1 2 3\n");
        machine.write(
            "proc/net/dev",
            &format!("{NET_HEAD}{}{}", interface("lo", 9, 9), interface("eth0", 1000, 100)),
        );
        let mut reader = machine.reader();
        let begun = Instant::now();
        let first = reader.read(begun);
        assert_eq!((first.cpu_percent, first.network_in_bytes_per_s), (None, None));
        machine.write("proc/stat", "cpu  150 0 125 900 125 0 0 0 60 0\n");
        machine.write(
            "proc/net/dev",
            &format!("{NET_HEAD}{}{}", interface("lo", 99, 99), interface("eth0", 3000, 400)),
        );
        assert_eq!(reader.read(begun + MIN_SPAN / 2), first, "too soon");
        let second = reader.read(begun + Duration::from_secs(2));
        assert_eq!(second.cpu_percent, Some(25.0));
        assert_eq!(
            (second.network_in_bytes_per_s, second.network_out_bytes_per_s),
            (Some(1000), Some(150))
        );
        // An interface was removed, and the counters were reset.
        machine.write("proc/net/dev", NET_HEAD);
        machine.write("proc/stat", "cpu  1 0 1 1 1 0 0 0 0 0\n");
        let third = reader.read(begun + Duration::from_secs(4));
        assert_eq!((third.cpu_percent, third.network_in_bytes_per_s), (None, Some(0)));
    }

    #[test]
    fn network_traffic_of_bridges_is_ignored() {
        let machine = Machine::new();
        let net = |eth, bridge| {
            format!("{NET_HEAD}{}{}", interface("eth0", eth, 0), interface("docker0", bridge, 0))
        };
        machine.write("proc/net/dev", &net(0, 0));
        machine.write("sys/class/net/eth0/device/uevent", "");
        let mut reader = machine.reader();
        let begun = Instant::now();
        reader.read(begun);
        machine.write("proc/net/dev", &net(500, 70_000));
        assert_eq!(reader.read(begun + Duration::from_secs(1)).network_in_bytes_per_s, Some(500));
    }

    #[test]
    fn memory_temperature_and_load_are_read() {
        let machine = Machine::new();
        machine.write(
            "proc/meminfo",
            "MemTotal:        4000 kB\nMemFree:  100 kB\nMemAvailable:    1000 kB\n",
        );
        machine.write("proc/loadavg", "0.42 0.30 0.20 1/100 4711\n");
        machine.write("sys/class/thermal/thermal_zone0/temp", "51340\n");
        machine.write("sys/class/thermal/thermal_zone1/temp", "-274000\n");
        machine.write("sys/class/thermal/cooling_device0/temp", "99000\n");
        machine.write("sys/class/power_supply/BAT0/type", "Battery\n");
        machine.write("sys/class/power_supply/BAT0/capacity", "80\n");
        let seen = machine.reader().read(Instant::now());
        assert_eq!(
            (seen.memory_total_bytes, seen.memory_used_bytes),
            (Some(4_096_000), Some(3_072_000))
        );
        assert_eq!(
            (seen.load_1m, seen.temperature_c, seen.battery_percent),
            (Some(0.42), Some(51.3), Some(80))
        );
        assert!(seen.disk_used_bytes <= seen.disk_total_bytes && seen.disk_total_bytes > Some(0));
    }

    #[test]
    fn missing_vitals_are_omitted() {
        let machine = Machine::new();
        machine.write("proc/stat", "intr 1\n");
        machine.write("proc/meminfo", "MemTotal: many kB\n");
        machine.write("proc/loadavg", "");
        let mut reader = machine.reader();
        let begun = Instant::now();
        reader.read(begun);
        let seen = reader.read(begun + Duration::from_secs(1));
        let disk = (seen.disk_used_bytes, seen.disk_total_bytes);
        let nothing = Vitals {
            at_ms: seen.at_ms,
            disk_used_bytes: disk.0,
            disk_total_bytes: disk.1,
            ..Vitals::default()
        };
        assert_eq!(seen, nothing);
    }

    #[test]
    fn refused_telemetry_pauses_sending() {
        let refused =
            |code: &str| ServerError::Refused { code: code.to_owned(), message: String::new() };
        let busy = |retry_after| ServerError::Busy { status: 503, retry_after };
        let some_minutes = REFUSED_POLL / 2..=REFUSED_POLL.mul_f64(1.5);
        assert!(
            some_minutes.contains(&pause(&ServerError::TokenRefused("no such token".to_owned())))
        );
        assert!(some_minutes.contains(&pause(&refused(AWAITS_APPROVAL))), "it may be let in soon");
        assert_eq!(pause(&refused("not_found")), UNKNOWN_PAUSE);
        assert_eq!(pause(&busy(Some(Duration::from_secs(7)))), Duration::from_secs(7));
        assert_eq!(pause(&busy(Some(Duration::from_secs(1 << 40)))), REFUSED_POLL);
        assert_eq!(pause(&ServerError::NotTheServer("a portal".to_owned())), Duration::ZERO);
    }

    /// Records for each reading whether a session had been tried before.
    struct Looks(LinkState, mpsc::UnboundedSender<bool>);

    impl Source for Looks {
        fn read(&mut self) -> Vitals {
            self.1.send(self.0.mqtt_now().was_tried()).expect("heard");
            Vitals::default()
        }
    }

    #[tokio::test]
    async fn vitals_wait_for_the_first_session_attempt() {
        let link_state = LinkState::new(tokio_util::sync::CancellationToken::new());
        let (looks, mut looked) = mpsc::unbounded_channel();
        let (messages, _said) = mpsc::channel(1);
        let tls = task_transport::Trust::by(None).client_config(clock::for_certificates());
        let client = crate::transfer::server::client(tls).expect("a client");
        let robot_id = RobotId::random();
        let base = "http://127.0.0.1:9/".parse().expect("a URL");
        let server = Server::new(client, base, robot_id.clone(), "tskr_x".to_owned());
        let source = Looks(link_state.clone(), looks);
        let sender = Sender { robot_id, interval: Duration::from_secs(60), source, server };
        let sending = tokio::spawn(sender.run(link_state.clone(), messages));
        tokio::task::yield_now().await;
        link_state.mqtt.send_replace(MqttState::Down);
        assert_eq!(looked.recv().await, Some(true));
        link_state.shutdown.cancel();
        sending.await.expect("ends");
    }

    #[tokio::test]
    async fn on_demand_vitals_read_this_machine() {
        let asked = OnDemandVitals::new(VitalsPaths::of_this_machine(Path::new("/")));
        let seen = asked.now().await;
        assert!(
            seen.cpu_percent.is_some_and(|percent| (0.0..=100.0).contains(&percent)),
            "{seen:?}"
        );
        assert!(seen.memory_used_bytes < seen.memory_total_bytes, "{seen:?}");
    }
}
