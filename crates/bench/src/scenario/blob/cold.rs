//! The part of `taskbench blob` that tests whether control stays responsive: an API call is timed
//! over and over while different large blobs come from the disk, served by taskd itself, and then
//! by nginx on the same machine.

use std::time::{Duration, Instant};

use anyhow::{Context as _, ensure};
use nix::fcntl::{PosixFadviseAdvice, posix_fadvise};
use task_proto::RobotId;
use task_proto::api::EnrollResponse;
use task_proto::desired::BlobRef;

use super::{RATIO, at_nginx, at_taskd, order_blob};
use crate::measure::downloads::{Target, Until, download};
use crate::programs::peer::Peer;
use crate::programs::server::Server;
use crate::programs::taskd::Taskd;
use crate::results::run::{Point, Run, Unit};
use crate::system::progress::RunProgress;

/// Interval between API calls during the pulls.
const PROBE_INTERVAL: Duration = Duration::from_millis(5);

/// Parameters of the measurement.
pub struct Plan {
    pub runs: u32,
    /// Number of blobs, and of robots that pull one each.
    pub pulls: usize,
    /// The size of each.
    pub size: u64,
    /// The seed of the blobs' bytes.
    pub seed: u64,
}

/// Runs the measurement, and ends the server.
pub async fn measure(
    run: &mut Run,
    plan: &Plan,
    mut taskd: Taskd,
    nginx: Option<&Peer>,
    robots: &[EnrollResponse],
) -> anyhow::Result<()> {
    let mut progress = RunProgress::new(plan.runs as usize + 1);
    progress.set_message("pushing the blobs that are pulled from disk");
    let robots = robots.get(..plan.pulls).context("fewer robots than pulls")?;
    let mut blobs = Vec::new();
    for (number, robot) in robots.iter().enumerate() {
        let name = format!("cold-{number}");
        let seed = plan.seed + 2 + number as u64;
        blobs.push(order_blob(&taskd.server, &name, robot.name.as_str(), plan.size, seed).await?);
    }
    progress.step();
    let mut own = Vec::new();
    let mut others = Vec::new();
    let mut ratios = Vec::new();
    for turn in 0..plan.runs {
        progress.set_message("pulling from disk");
        let mut p99 = [None, None];
        for side in if turn % 2 == 0 { [0, 1] } else { [1, 0] } {
            // Mapped pages can't be evicted from the page cache; a fresh server maps nothing.
            taskd = taskd.restart().await?;
            make_cold(&taskd, &blobs)?;
            let each = |(index, robot): (usize, &EnrollResponse)| match (side, nginx) {
                (0, _) => at_taskd(&taskd, blobs[index], std::slice::from_ref(robot)),
                (_, Some(nginx)) => at_nginx(nginx, blobs[index], 1),
                (_, None) => Vec::new(),
            };
            let targets: Vec<Target> = robots.iter().enumerate().flat_map(each).collect();
            if !targets.is_empty() {
                let samples = probe_during(&taskd.server, &robots[0].robot_id, &targets).await?;
                p99[side] = percentile_99(&samples);
                if side == 0 { &mut own } else { &mut others }.extend(samples);
            }
        }
        if let [Some(own), Some(other)] = p99 {
            ratios.push(own / other);
        }
        progress.step();
    }
    let settings = || [("payload_bytes", plan.size as f64), ("cold_pulls", plan.pulls as f64)];
    for (series, unit, samples) in [
        ("taskd", Unit::Milliseconds, own),
        ("nginx", Unit::Milliseconds, others),
        (RATIO, Unit::Number, ratios),
    ] {
        let mut point = Point::new(series, settings());
        point.measure(if unit == Unit::Number { "api_p99" } else { "api" }, unit, samples);
        if !point.quantities.is_empty() {
            run.points.push(point);
        }
    }
    taskd.end().await
}

/// Latency of each API call while all of `targets` were fetched, in milliseconds.
async fn probe_during(
    server: &Server,
    robot: &RobotId,
    targets: &[Target],
) -> anyhow::Result<Vec<f64>> {
    let pulls = download(targets, Until::Fetches(1), || ());
    tokio::pin!(pulls);
    let mut tick = tokio::time::interval(PROBE_INTERVAL);
    let mut samples = Vec::new();
    loop {
        tokio::select! {
            done = &mut pulls => {
                done?;
                ensure!(!samples.is_empty(), "the pulls were over before the API answered once");
                return Ok(samples);
            }
            _ = tick.tick() => {}
        }
        let begun = Instant::now();
        // Downloads run in tasks of their own; they go on meanwhile.
        server.robot(robot).await?;
        samples.push(begun.elapsed().as_secs_f64() * 1000.0);
    }
}

fn percentile_99(samples: &[f64]) -> Option<f64> {
    crate::results::run::Quantity::of(Unit::Milliseconds, samples.iter().copied())
        .map(|quantity| quantity.p99)
}

/// Evicts the blobs from the page cache, so that they have to be read from the disk.
fn make_cold(taskd: &Taskd, blobs: &[BlobRef]) -> anyhow::Result<()> {
    for blob in blobs {
        let path = taskd.blobs().join(blob.digest.hex());
        let file = std::fs::File::open(&path).with_context(|| path.display().to_string())?;
        posix_fadvise(&file, 0, 0, PosixFadviseAdvice::POSIX_FADV_DONTNEED)
            .context("the page cache")?;
    }
    Ok(())
}
