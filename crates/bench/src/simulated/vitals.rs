//! Vitals of simulated robots, which have no machine: figures that wander, so that dashboards show
//! movement. Nothing is measured.

use std::time::Duration;

use task_agent::telemetry::vitals::Source;
use task_proto::telemetry::vitals::Vitals;

/// The interval of real robots.
pub const VITALS_INTERVAL: Duration = Duration::from_secs(60);

const GIB: f64 = (1u64 << 30) as f64;

#[derive(Debug, Clone)]
pub struct Machine {
    cpu: f64,
    memory: f64,
    disk: f64,
    network: f64,
    battery: f64,
}

impl Machine {
    /// A machine with medium figures.
    pub fn new() -> Self {
        let within = |least: f64, most: f64| least + (most - least) * rand::random::<f64>();
        Self {
            cpu: within(0.05, 0.6),
            memory: within(0.2, 0.7),
            disk: within(0.1, 0.8),
            network: within(1e3, 1e6),
            battery: within(0.3, 1.0),
        }
    }
}

impl Default for Machine {
    fn default() -> Self {
        Self::new()
    }
}

impl Source for Machine {
    fn read(&mut self) -> Vitals {
        let wander =
            |value: f64, by: f64| (value + by * (rand::random::<f64>() - 0.5)).clamp(0.01, 0.99);
        self.cpu = wander(self.cpu, 0.2);
        self.memory = wander(self.memory, 0.02);
        self.disk = wander(self.disk, 0.001);
        self.network *= 0.8 + 0.4 * rand::random::<f64>();
        // An empty battery is charged.
        self.battery = if self.battery < 0.15 { 1.0 } else { self.battery - 0.002 };
        let bytes = |share: f64, gib: f64| (share * gib * GIB) as u64;
        Vitals {
            // The receiver uses its own clock.
            at_ms: 0,
            cpu_percent: Some((self.cpu * 1000.0).round() as f32 / 10.0),
            memory_used_bytes: Some(bytes(self.memory, 4.0)),
            memory_total_bytes: Some(bytes(1.0, 4.0)),
            disk_used_bytes: Some(bytes(self.disk, 32.0)),
            disk_total_bytes: Some(bytes(1.0, 32.0)),
            network_in_bytes_per_s: Some(self.network as u64),
            network_out_bytes_per_s: Some((self.network / 8.0) as u64),
            load_1m: Some((self.cpu * 400.0).round() as f32 / 100.0),
            battery_percent: Some((self.battery * 100.0) as u8),
            temperature_c: Some((400.0 + self.cpu * 300.0).round() as f32 / 10.0),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn simulated_vitals_stay_plausible() {
        let mut machine = Machine::new();
        for _ in 0..1000 {
            let seen = machine.read();
            assert!(
                seen.cpu_percent.is_some_and(|percent| (0.0..=100.0).contains(&percent)),
                "{seen:?}"
            );
            assert!(
                seen.memory_used_bytes < seen.memory_total_bytes
                    && seen.disk_used_bytes < seen.disk_total_bytes
            );
            assert!(seen.battery_percent.is_some_and(|percent| percent <= 100), "{seen:?}");
        }
    }
}
