//! `taskd robot top`: load of the robots' machines, the busiest first; once, or repeatedly.

use std::time::Duration;

use clap::Args;
use task_proto::api::{RobotList, RobotView};
use task_proto::ids::selector::Selector;
use task_proto::size::{format_bytes, format_rate};
use task_proto::telemetry::vitals::Vitals;
use task_proto::time::span;
use tokio::time::sleep;

use super::selection;
use crate::api::{complete, wait};
use crate::display::output::table::Columns;
use crate::display::output::{Format, say, stderr_is_terminal, stream_text};
use crate::{CommandError, Outcome, Session, clock};

/// Interval between two polls; robots report once a minute.
const POLL_INTERVAL: Duration = Duration::from_secs(5);
/// Cursor home, and clear to the end of the screen.
const CLEAR: &str = "\x1b[H\x1b[J";

/// The robots to show.
#[derive(Debug, Args)]
pub struct TopArgs {
    /// Robots: *, names or ids, label=value, !TERM to exclude
    #[arg(default_value = "*", add = complete::selectors())]
    selector: Selector,
    /// Refresh until Ctrl-C
    #[arg(short, long)]
    follow: bool,
}

pub(crate) async fn run(session: &Session, args: TopArgs) -> Result<Outcome, CommandError> {
    if !args.follow {
        let list = busiest_first(selection::list_robots(session, &args.selector).await?);
        print(session, &list)?;
        return Ok(Outcome::Succeeded);
    }
    loop {
        match selection::list_robots(session, &args.selector).await {
            Ok(list) => {
                // Without a screen to overwrite, each table is printed below the previous one.
                let is_overwritten =
                    session.output.has_colours() && session.output.format() == Format::Table;
                if !stream_text(if is_overwritten { CLEAR } else { "" })?
                    || !print(session, &busiest_first(list))?
                {
                    return Ok(Outcome::Succeeded);
                }
            }
            Err(CommandError::Client(error)) if wait::is_transient(&error) => {
                if stderr_is_terminal() {
                    say(&format!("{error}; retrying"));
                }
            }
            Err(error) => return Err(error),
        }
        sleep(POLL_INTERVAL).await;
    }
}

/// The busiest first, robots without vitals last.
fn busiest_first(mut list: RobotList) -> RobotList {
    let load =
        |robot: &RobotView| robot.vitals.and_then(|vitals| vitals.cpu_percent).unwrap_or(-1.0);
    list.robots.sort_by(|one, other| {
        load(other).total_cmp(&load(one)).then_with(|| one.name.cmp(&other.name))
    });
    list
}

const COLUMNS: Columns = Columns {
    name: "name",
    narrow: &["name", "state", "cpu", "memory", "disk", "in", "out", "age"],
    wide: &["load", "battery", "temperature", "rtt", "agent"],
};

/// False once the reader has closed the pipe.
fn print(session: &Session, list: &RobotList) -> Result<bool, CommandError> {
    let now_ms = clock::now_ms();
    session.output.print_next_list(list, &COLUMNS, |list| {
        list.robots.iter().map(|robot| row(robot, now_ms)).collect()
    })
}

fn row(robot: &RobotView, now_ms: u64) -> Vec<String> {
    let vitals = robot.vitals.unwrap_or_default();
    let shown = |text: Option<String>| text.unwrap_or_else(|| "-".to_owned());
    let Vitals { memory_used_bytes, memory_total_bytes, disk_used_bytes, disk_total_bytes, .. } =
        vitals;
    let age =
        robot.vitals.map(|vitals| span(Duration::from_millis(now_ms.saturating_sub(vitals.at_ms))));
    let per_s = |rate: Option<u64>| shown(rate.map(format_rate));
    vec![
        robot.name.to_string(),
        if robot.online { "online" } else { "offline" }.to_owned(),
        shown(vitals.cpu_percent.map(|percent| format!("{percent:.0}%"))),
        shown(used_share(memory_used_bytes, memory_total_bytes)),
        shown(used_share(disk_used_bytes, disk_total_bytes)),
        per_s(vitals.network_in_bytes_per_s),
        per_s(vitals.network_out_bytes_per_s),
        shown(age),
        shown(vitals.load_1m.map(|load| format!("{load:.1}"))),
        shown(vitals.battery_percent.map(|percent| format!("{percent}%"))),
        shown(vitals.temperature_c.map(|degrees| format!("{degrees:.0} °C"))),
        shown(robot.link.and_then(|link| link.rtt_ms).map(|rtt_ms| format!("{rtt_ms} ms"))),
        shown(robot.host.as_ref().map(|host| host.agent_version.clone())),
    ]
}

/// Load of a machine, in a line.
pub(crate) fn summary(vitals: &Vitals) -> String {
    let parts = [
        vitals.cpu_percent.map(|percent| format!("cpu {percent:.0}%")),
        used_share(vitals.memory_used_bytes, vitals.memory_total_bytes)
            .map(|share| format!("memory {share}")),
        used_share(vitals.disk_used_bytes, vitals.disk_total_bytes)
            .map(|share| format!("disk {share}")),
        vitals.temperature_c.map(|degrees| format!("{degrees:.0} °C")),
    ];
    parts.into_iter().flatten().collect::<Vec<_>>().join(", ")
}

/// `41% of 8 GiB`.
fn used_share(used: Option<u64>, total: Option<u64>) -> Option<String> {
    let (used, total) = (used?, total.filter(|total| *total > 0)?);
    Some(format!(
        "{}% of {}",
        u128::from(used.min(total)) * 100 / u128::from(total),
        format_bytes(total)
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn used_share_is_relative_to_the_total() {
        assert_eq!(used_share(Some(1 << 30), Some(4 << 30)), Some("25% of 4 GB".to_owned()));
        assert_eq!(used_share(Some(5), Some(4)), Some("100% of 4 B".to_owned()));
        assert_eq!((used_share(None, Some(4)), used_share(Some(1), Some(0))), (None, None));
    }
}
