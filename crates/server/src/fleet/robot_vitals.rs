//! Vitals of robots' machines in the last hour. In memory only, and packed: a sample takes 16
//! bytes, so ten thousand robots take about 10 MB. Nothing is written to disk. This module never
//! sends requests to a robot.

use std::collections::{HashMap, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use task_proto::RobotId;
use task_proto::telemetry::vitals::Vitals;

/// Retention of a sample.
const RETENTION_MS: u64 = 60 * 60 * 1000;
/// Maximum samples of a robot.
const MAX_SAMPLES: usize = 60;
/// Samples with a shorter distance to the previous one are shown and not stored: the samples must
/// span an hour.
const MIN_GAP_MS: u64 = RETENTION_MS / MAX_SAMPLES as u64 * 9 / 10;
/// Maximum robots in memory; beyond the limit, the longest silent robots are forgotten.
const MAX_ROBOTS: usize = 50_000;

/// The vitals of all robots; clones share them.
#[derive(Clone, Default)]
pub struct RobotVitals(Arc<Mutex<HashMap<RobotId, VitalsHistory>>>);

#[derive(Default)]
struct VitalsHistory {
    newest: Vitals,
    /// When the last sample arrived.
    sampled_ms: u64,
    samples: VecDeque<Sample>,
}

/// A sample of a machine's vitals in 16 bytes. Sizes are fractions of the totals, which hardly ever
/// change.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Sample {
    /// Seconds since the previous sample.
    after_s: u16,
    /// In hundredths of a percent.
    cpu: u16,
    memory: u16,
    disk: u16,
    network_in: Rate,
    network_out: Rate,
    load: u16,
    battery: u8,
    /// In degrees Celsius above -50.
    temperature: u8,
}

const _: () = assert!(size_of::<Sample>() == 16, "the last hour of ten thousand robots fits 10 MB");

/// The encoding of "unknown".
const NONE: u16 = u16::MAX;
const NONE_8: u8 = u8::MAX;
const MIN_TEMPERATURE_C: f32 = -50.0;

/// Bytes per second, to a precision of a thousandth: eleven bits, and the number of bits by which
/// they are shifted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Rate(u16);

impl RobotVitals {
    /// Stores a robot's vitals, and returns them as displayed.
    pub fn record(&self, robot: &RobotId, reported: Vitals, now_ms: u64) -> Vitals {
        let mut robots = self.robots();
        if robots.len() >= MAX_ROBOTS && !robots.contains_key(robot) {
            make_room(&mut robots);
        }
        let history = robots.entry(robot.clone()).or_default();
        history.newest = Vitals { at_ms: now_ms, ..sanitized(reported) };
        if now_ms < history.sampled_ms {
            // This machine's clock was set back, so the stored samples lie in the future.
            history.samples.clear();
        }
        let gap_ms = now_ms.saturating_sub(history.sampled_ms);
        if history.samples.is_empty() || gap_ms >= MIN_GAP_MS {
            if history.samples.len() >= MAX_SAMPLES {
                history.samples.pop_front();
            }
            let after_s = u16::try_from(gap_ms / 1000).unwrap_or(u16::MAX);
            history.samples.push_back(Sample::pack(&history.newest, after_s));
            history.sampled_ms = now_ms;
        }
        history.newest
    }

    pub fn newest(&self, robot: &RobotId) -> Option<Vitals> {
        self.robots().get(robot).map(|history| history.newest)
    }

    /// The vitals of the last hour, the oldest first.
    pub fn last_hour(&self, robot: &RobotId, now_ms: u64) -> Vec<Vitals> {
        let robots = self.robots();
        let Some(history) = robots.get(robot) else { return Vec::new() };
        let mut at_ms = history.sampled_ms;
        let mut samples = Vec::with_capacity(history.samples.len() + 1);
        if history.newest.at_ms > history.sampled_ms {
            samples.push(history.newest);
        }
        for sample in history.samples.iter().rev() {
            samples.push(sample.unpack(at_ms, &history.newest));
            at_ms = at_ms.saturating_sub(u64::from(sample.after_s) * 1000);
        }
        samples.retain(|sample| now_ms.saturating_sub(sample.at_ms) <= RETENTION_MS);
        samples.reverse();
        samples
    }

    /// The robot was removed.
    pub fn forget(&self, robot: &RobotId) {
        self.robots().remove(robot);
    }

    fn robots(&self) -> MutexGuard<'_, HashMap<RobotId, VitalsHistory>> {
        // Every change under this lock is complete in itself, so a panic elsewhere leaves nothing
        // half-done.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Forgets the longest silent sixteenth of the robots, so that the next scan is far off.
fn make_room(robots: &mut HashMap<RobotId, VitalsHistory>) {
    let mut silent: Vec<(u64, RobotId)> =
        robots.iter().map(|(robot, history)| (history.newest.at_ms, robot.clone())).collect();
    silent.sort_unstable();
    for (_, robot) in silent.into_iter().take(MAX_ROBOTS / 16) {
        robots.remove(&robot);
    }
}

/// Removes impossible figures: a robot's data is not trusted.
fn sanitized(reported: Vitals) -> Vitals {
    let used = |used: Option<u64>, total: Option<u64>| {
        used.zip(total).map(|(used, total)| used.min(total))
    };
    let finite = |value: Option<f32>, least: f32, most: f32| {
        value.filter(|value| value.is_finite()).map(|value| value.clamp(least, most))
    };
    Vitals {
        cpu_percent: finite(reported.cpu_percent, 0.0, 100.0),
        memory_used_bytes: used(reported.memory_used_bytes, reported.memory_total_bytes),
        disk_used_bytes: used(reported.disk_used_bytes, reported.disk_total_bytes),
        load_1m: finite(reported.load_1m, 0.0, 100_000.0),
        battery_percent: reported.battery_percent.map(|percent| percent.min(100)),
        temperature_c: finite(reported.temperature_c, MIN_TEMPERATURE_C, 200.0),
        ..reported
    }
}

impl Sample {
    fn pack(vitals: &Vitals, after_s: u16) -> Self {
        let share = |used: Option<u64>, total: Option<u64>| {
            let shares = used.zip(total.filter(|total| *total > 0));
            shares.map_or(NONE, |(used, total)| {
                (used as f64 / total as f64 * f64::from(NONE - 1)).round() as u16
            })
        };
        let hundredths = |value: Option<f32>| {
            value.map_or(NONE, |value| (value * 100.0).round().min(65_534.0) as u16)
        };
        let above_minimum =
            |celsius: f32| (celsius - MIN_TEMPERATURE_C).round().clamp(0.0, 254.0) as u8;
        Self {
            after_s,
            cpu: hundredths(vitals.cpu_percent),
            memory: share(vitals.memory_used_bytes, vitals.memory_total_bytes),
            disk: share(vitals.disk_used_bytes, vitals.disk_total_bytes),
            network_in: Rate::pack(vitals.network_in_bytes_per_s),
            network_out: Rate::pack(vitals.network_out_bytes_per_s),
            load: hundredths(vitals.load_1m),
            battery: vitals.battery_percent.unwrap_or(NONE_8),
            temperature: vitals.temperature_c.map_or(NONE_8, above_minimum),
        }
    }

    /// The sample as vitals at `at_ms`, on a machine with the totals of `newest`.
    fn unpack(&self, at_ms: u64, newest: &Vitals) -> Vitals {
        let used = |share: u16, total: Option<u64>| {
            total
                .filter(|_| share != NONE)
                .map(|total| (total as f64 * f64::from(share) / f64::from(NONE - 1)) as u64)
        };
        let hundredths = |value: u16| (value != NONE).then(|| f32::from(value) / 100.0);
        let (memory, disk) = (newest.memory_total_bytes, newest.disk_total_bytes);
        Vitals {
            at_ms,
            cpu_percent: hundredths(self.cpu),
            memory_used_bytes: used(self.memory, memory),
            memory_total_bytes: memory.filter(|_| self.memory != NONE),
            disk_used_bytes: used(self.disk, disk),
            disk_total_bytes: disk.filter(|_| self.disk != NONE),
            network_in_bytes_per_s: self.network_in.unpack(),
            network_out_bytes_per_s: self.network_out.unpack(),
            load_1m: hundredths(self.load),
            battery_percent: (self.battery != NONE_8).then_some(self.battery),
            temperature_c: (self.temperature != NONE_8)
                .then(|| f32::from(self.temperature) + MIN_TEMPERATURE_C),
        }
    }
}

impl Rate {
    const BITS: u32 = 11;
    const MOST: u64 = ((1 << Self::BITS) - 2) << 31;

    fn pack(bytes_per_s: Option<u64>) -> Self {
        let Some(bytes_per_s) = bytes_per_s.map(|rate| rate.min(Self::MOST)) else {
            return Self(NONE);
        };
        let shift = (u64::BITS - bytes_per_s.leading_zeros()).saturating_sub(Self::BITS);
        let bits = bytes_per_s >> shift;
        // At most 11 bits above 5, so the value fits.
        Self(u16::try_from(bits << 5 | u64::from(shift)).unwrap_or(NONE))
    }

    fn unpack(self) -> Option<u64> {
        (self.0 != NONE).then(|| u64::from(self.0 >> 5) << (self.0 & 31))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MINUTE_MS: u64 = 60_000;

    fn vitals(cpu: f32) -> Vitals {
        Vitals {
            at_ms: 7,
            cpu_percent: Some(cpu),
            memory_used_bytes: Some(1_200_000_000),
            memory_total_bytes: Some(4_000_000_000),
            disk_used_bytes: Some(9_000_000_000),
            disk_total_bytes: Some(32_000_000_000),
            network_in_bytes_per_s: Some(2_400),
            network_out_bytes_per_s: Some(0),
            load_1m: Some(0.42),
            battery_percent: Some(80),
            temperature_c: Some(51.0),
        }
    }

    #[test]
    fn only_the_last_hour_is_kept() {
        let (all, robot) = (RobotVitals::default(), RobotId::random());
        for minute in 0..100 {
            all.record(&robot, vitals(minute as f32), minute * MINUTE_MS);
        }
        let shown = all.last_hour(&robot, 99 * MINUTE_MS);
        let of = |sample: &Vitals| (sample.at_ms / MINUTE_MS, sample.cpu_percent);
        assert_eq!(shown.len(), MAX_SAMPLES);
        assert_eq!((of(&shown[0]), of(&shown[59])), ((40, Some(40.0)), (99, Some(99.0))));
        assert_eq!(all.last_hour(&robot, 150 * MINUTE_MS).len(), 10, "older than an hour");
        assert_eq!(all.newest(&robot).and_then(|newest| newest.cpu_percent), Some(99.0));
        all.forget(&robot);
        assert_eq!((all.newest(&robot), all.last_hour(&robot, 0)), (None, Vec::new()));
    }

    #[test]
    fn clock_set_back_restarts_the_samples() {
        let (robots, robot) = (RobotVitals::default(), RobotId::random());
        robots.record(&robot, vitals(10.0), 7_200_000);
        robots.record(&robot, vitals(20.0), 60_000);
        robots.record(&robot, vitals(30.0), 120_000);
        let hour: Vec<_> = robots
            .last_hour(&robot, 120_000)
            .iter()
            .map(|reported| (reported.at_ms, reported.cpu_percent))
            .collect();
        assert_eq!(hour, [(60_000, Some(20.0)), (120_000, Some(30.0))]);
    }

    #[test]
    fn frequent_samples_take_no_more_memory() {
        let (all, robot) = (RobotVitals::default(), RobotId::random());
        for second in 0..1800 {
            all.record(&robot, vitals(1.0), second * 2000);
        }
        let shown = all.last_hour(&robot, 3_599_000);
        assert!((60..=MAX_SAMPLES + 1).contains(&shown.len()), "{}", shown.len());
        assert_eq!(shown.last().map(|newest| newest.at_ms), Some(3_598_000));
        assert!(shown[0].at_ms < 10 * MINUTE_MS, "{}", shown[0].at_ms);
    }

    #[test]
    fn packed_sample_keeps_its_values() {
        let given = vitals(12.34);
        let packed = Sample::pack(&given, 60).unpack(9, &given);
        let near = |one: Option<u64>, other: Option<u64>| {
            one.zip(other)
                .is_some_and(|(one, other)| one.abs_diff(other) as f64 <= one as f64 * 0.001)
        };
        assert_eq!(
            (packed.at_ms, packed.cpu_percent, packed.load_1m),
            (9, Some(12.34), Some(0.42))
        );
        assert_eq!((packed.battery_percent, packed.temperature_c), (Some(80), Some(51.0)));
        assert!(near(given.memory_used_bytes, packed.memory_used_bytes), "{packed:?}");
        assert!(near(given.disk_used_bytes, packed.disk_used_bytes), "{packed:?}");
        let nothing = Vitals::default();
        assert_eq!(Sample::pack(&nothing, 0).unpack(0, &nothing), nothing);
        for rate in [0, 1, 2047, 2048, 99_999, 1_250_000_000, Rate::MOST, u64::MAX] {
            assert!(near(Some(rate.min(Rate::MOST)), Rate::pack(Some(rate)).unpack()), "{rate}");
        }
    }

    #[test]
    fn impossible_values_are_clamped() {
        let reported = Vitals {
            cpu_percent: Some(f32::INFINITY),
            memory_used_bytes: Some(u64::MAX),
            memory_total_bytes: Some(0),
            disk_used_bytes: Some(7),
            network_in_bytes_per_s: Some(u64::MAX),
            load_1m: Some(-3.0),
            battery_percent: Some(255),
            temperature_c: Some(1e9),
            ..Vitals::default()
        };
        let (all, robot) = (RobotVitals::default(), RobotId::random());
        let newest = all.record(&robot, reported, 5);
        assert_eq!(
            (newest.cpu_percent, newest.memory_used_bytes, newest.disk_used_bytes),
            (None, Some(0), None)
        );
        assert_eq!(
            (newest.load_1m, newest.battery_percent, newest.temperature_c),
            (Some(0.0), Some(100), Some(200.0))
        );
        let packed = all.last_hour(&robot, 5).remove(0);
        assert_eq!(
            (packed.memory_used_bytes, packed.network_in_bytes_per_s),
            (None, Some(Rate::MOST))
        );
    }
}
