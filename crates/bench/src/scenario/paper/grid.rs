//! The runs of the paper's experiment: mechanisms × payloads × robots × repetitions, in a shuffled
//! order that a seed repeats, and the plots of the results.

use std::collections::BTreeMap;
use std::fmt;

use rand::SeedableRng as _;
use rand::rngs::SmallRng;
use rand::seq::SliceRandom as _;
use task_proto::api::DeliveryChoice;

use crate::results::run::{Figure, Plot};

/// The largest package that is sent inside the announcement: the server's setting is 32 KiB, the
/// package's frame is within.
const MAX_INLINE_BYTES: u64 = 30_000;
/// The most robots, as in the paper.
pub const MAX_ROBOTS: usize = 8;
/// The paper's package sizes in Fig. 11.
const FIGURE_11_BYTES: [u64; 2] = [2_000_000, 9_700_000];

/// A delivery mechanism of a run, with its settings.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Mechanism {
    /// MQTT announces, the robot pulls.
    PushPull,
    /// Parts inside MQTT, with a quality of service.
    DirectPush(u8),
    /// The whole package as one MQTT message, the paper's form.
    OneMessage,
    /// Nothing is announced; robots ask on their timer.
    Poll,
    /// Inside the announcement's message.
    Inline,
    /// The server's rules decide.
    Adaptive,
}

impl Mechanism {
    /// All, with every quality of service.
    pub const ALL: [Self; 8] = [
        Self::PushPull,
        Self::DirectPush(1),
        Self::OneMessage,
        Self::Poll,
        Self::Inline,
        Self::Adaptive,
        Self::DirectPush(0),
        Self::DirectPush(2),
    ];

    /// The choice for the order.
    pub fn choice(self) -> DeliveryChoice {
        match self {
            Self::PushPull => DeliveryChoice::PushPull,
            Self::DirectPush(_) | Self::OneMessage => DeliveryChoice::DirectPush,
            Self::Poll => DeliveryChoice::Poll,
            Self::Inline => DeliveryChoice::Inline,
            Self::Adaptive => DeliveryChoice::Adaptive,
        }
    }

    /// Whether a package of this size may be ordered with this mechanism.
    fn takes(self, payload_bytes: u64) -> bool {
        self != Self::Inline || payload_bytes <= MAX_INLINE_BYTES
    }
}

impl fmt::Display for Mechanism {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::PushPull => f.write_str("push-pull"),
            Self::DirectPush(1) => f.write_str("direct-push"),
            Self::DirectPush(qos) => write!(f, "direct-push QoS {qos}"),
            Self::OneMessage => f.write_str("direct-push, one message"),
            Self::Poll => f.write_str("poll"),
            Self::Inline => f.write_str("inline"),
            Self::Adaptive => f.write_str("adaptive"),
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Cell {
    /// The mechanism of delivery.
    pub mechanism: Mechanism,
    /// Size of the payload, in bytes.
    pub payload_bytes: u64,
    pub robots: usize,
}

/// The size of the experiment.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Extent {
    /// Enough to see that all works.
    Quick,
    /// Under half an hour on two cores.
    Normal,
    /// Every number of robots at every size.
    Full,
}

/// All runs in the order of their execution.
pub fn runs(extent: Extent, repetitions: usize, seed: u64) -> Vec<Cell> {
    let cells = cells(extent);
    let mut runs: Vec<Cell> =
        cells.iter().flat_map(|cell| std::iter::repeat_n(*cell, repetitions)).collect();
    runs.shuffle(&mut SmallRng::seed_from_u64(seed));
    runs
}

fn cells(extent: Extent) -> Vec<Cell> {
    let payloads: &[u64] = match extent {
        Extent::Quick => &[1_000, 200_000],
        Extent::Normal => &[1_000, 10_000, 100_000, 1_000_000, 2_000_000, 9_700_000, 100_000_000],
        Extent::Full => &[
            1_000,
            3_000,
            10_000,
            30_000,
            100_000,
            300_000,
            1_000_000,
            2_000_000,
            5_000_000,
            9_700_000,
            30_000_000,
            100_000_000,
        ],
    };
    let mut cells = Vec::new();
    for mechanism in Mechanism::ALL {
        for &payload_bytes in payloads.iter().filter(|bytes| mechanism.takes(**bytes)) {
            let robots = robots(extent, mechanism, payload_bytes);
            cells.extend(robots.iter().map(|&robots| Cell { mechanism, payload_bytes, robots }));
        }
    }
    cells
}

fn robots(extent: Extent, mechanism: Mechanism, payload_bytes: u64) -> &'static [usize] {
    let other_qos = matches!(mechanism, Mechanism::DirectPush(0 | 2));
    match extent {
        Extent::Quick => &[1, 3],
        Extent::Full => &[1, 2, 3, 4, 5, 6, 7, 8],
        Extent::Normal if other_qos => &[1, 5],
        Extent::Normal if FIGURE_11_BYTES.contains(&payload_bytes) => &[1, 2, 3, 4, 5, 6, 7, 8],
        Extent::Normal => &[1, 4, 5, 8],
    }
}

/// The paper's figures, and the further quantities in its text.
pub fn plots() -> Vec<Plot> {
    let bytes = |title: &str, y: &str, least: f64, most: f64| Plot {
        title: title.to_owned(),
        x: "payload_bytes".to_owned(),
        x_label: "payload".to_owned(),
        y: y.to_owned(),
        x_log: true,
        y_log: true,
        only: BTreeMap::from([("robots".to_owned(), (least, most))]),
        ..Plot::default()
    };
    let delay = |title: &str, least, most| Plot {
        y_label: "delay, order to last verified answer".to_owned(),
        ..bytes(title, "delay", least, most)
    };
    let robots = |title: &str, size: u64| Plot {
        title: title.to_owned(),
        x: "robots".to_owned(),
        x_label: "robots".to_owned(),
        x_log: false,
        only: BTreeMap::from([("payload_bytes".to_owned(), (size as f64, size as f64))]),
        ..delay(title, 1.0, 8.0)
    };
    let [two, nine] = FIGURE_11_BYTES;
    let most = MAX_ROBOTS as f64;
    vec![
        delay("Fig. 9a: payload against delay, 1 to 4 robots", 1.0, 4.0),
        delay("Fig. 9b: payload against delay, 5 to 8 robots", 5.0, 8.0),
        delay("Fig. 10a: payload against delay, 1 robot", 1.0, 1.0),
        delay("Fig. 10b: payload against delay, 5 robots", 5.0, 5.0),
        robots("Fig. 11a: robots against delay, 2 MB", two),
        robots("Fig. 11b: robots against delay, 9.7 MB", nine),
        Plot {
            y_label: "99th percentile of the delay".to_owned(),
            figure: Figure::P99,
            ..delay("Payload against the delay's 99th percentile, 5 to 8 robots", 5.0, most)
        },
        Plot {
            y_label: "arrival rate".to_owned(),
            y_log: false,
            ..bytes("Message arrival rate, 1 to 8 robots", "arrival", 1.0, most)
        },
        Plot {
            y_label: "bytes on the wire".to_owned(),
            ..bytes("Transmission load, 5 robots, both ways, MQTT and HTTP", "load", 5.0, 5.0)
        },
        Plot {
            y_label: "bytes on the wire for each of the payload's".to_owned(),
            y_log: true,
            ..bytes("Transmission load for each byte of payload and robot", "load_ratio", 1.0, most)
        },
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn grid_repeats_each_point_in_a_seeded_order() {
        let grid = runs(Extent::Normal, 5, 7);
        let distinct: std::collections::BTreeSet<Cell> = grid.iter().copied().collect();
        assert_eq!(grid.len(), 5 * distinct.len());
        assert_eq!(grid, runs(Extent::Normal, 5, 7));
        assert_ne!(grid, runs(Extent::Normal, 5, 8));
        let inline = distinct.iter().filter(|cell| cell.mechanism == Mechanism::Inline);
        assert!(
            inline.clone().count() > 0
                && inline.clone().all(|cell| cell.payload_bytes <= MAX_INLINE_BYTES)
        );
        for bytes in FIGURE_11_BYTES {
            let of =
                |cell: &&Cell| cell.mechanism == Mechanism::PushPull && cell.payload_bytes == bytes;
            assert_eq!(distinct.iter().filter(of).count(), MAX_ROBOTS);
        }
        assert!(distinct.iter().all(|cell| (1..=MAX_ROBOTS).contains(&cell.robots)));
    }
}
