//! `taskd logs`: past log lines of a robot's tasks, and with `-f` new lines as they appear. The two
//! join without a gap: the stream is opened first, the past is requested once the robot has
//! confirmed that it publishes, and again whenever the stream broke.

use std::time::Duration;

use task_proto::api::{LogEvent, LogsFrom, LogsQuery, LogsView};
use task_proto::log::{LogLevel, LogLine, MAX_KEPT_LINES};
use task_proto::time::timestamp;
use task_proto::{RobotName, TaskName};
use tokio::time::{Instant, sleep};

use crate::commands::api::client::ClientError;
use crate::commands::api::sse::Events;
use crate::commands::api::{complete, wait};
use crate::commands::display::output::{Format, printable, say, stream_text};
use crate::commands::display::shown::Shown;
use crate::commands::{CommandError, Outcome, Session};
use crate::config::lifetime;

/// A stream without data for this long is broken: the server sends something every 15 s.
const SILENCE: Duration = Duration::from_secs(60);
/// How far before the break the past is requested: clocks differ, and lines arrive late.
const OVERLAP: Duration = Duration::from_secs(120);

/// Shows what a robot's tasks said.
#[derive(Debug, clap::Args)]
pub struct LogsOrder {
    /// The robot's name or id
    #[arg(add = complete::robots())]
    robot: RobotName,
    /// Only this task
    #[arg(add = complete::tasks())]
    task: Option<TaskName>,
    /// Go on with what comes, until Ctrl-C
    #[arg(short, long)]
    follow: bool,
    /// Only lines of this level and more serious ones: debug, info, warn, error or fatal
    #[arg(long, value_name = "LEVEL", default_value = "info")]
    level: LogLevel,
    /// Not older than this, by the robot's clock
    #[arg(long, value_name = "TIME", value_parser = lifetime)]
    since: Option<Duration>,
    /// At most so many lines of the past [default: 500, with --since all that fit]
    #[arg(short = 'n', long, value_name = "N")]
    lines: Option<u64>,
}

pub(in crate::commands) async fn run(
    session: &Session,
    order: LogsOrder,
) -> Result<Outcome, CommandError> {
    if session.output.format() == Format::Name {
        return Err(CommandError::Usage(
            "-o name: lines of a log have no names; give table, wide or json".to_owned(),
        ));
    }
    if order.follow {
        return follow(session, &order).await;
    }
    let view = past(session, &order, order.since, order.lines)
        .await
        .map_err(|error| error.about(&order.robot))?;
    explain(&view);
    match session.output.format() {
        Format::Json => session.output.json(&view)?,
        _ => drop(Screen::new(session).print(&view.lines)?),
    }
    Ok(Outcome::Succeeded)
}

/// Follows a task's log, as `taskd logs -f`.
pub(in crate::commands) async fn follow_task(
    session: &Session,
    robot: RobotName,
    task: TaskName,
) -> Result<Outcome, CommandError> {
    let level = LogLevel::Info;
    follow(
        session,
        &LogsOrder { robot, task: Some(task), follow: true, level, since: None, lines: None },
    )
    .await
}

async fn past(
    session: &Session,
    order: &LogsOrder,
    since: Option<Duration>,
    lines: Option<u64>,
) -> Result<LogsView, ClientError> {
    let query = LogsQuery {
        task: order.task.clone(),
        level: Some(order.level),
        since_s: since.map(|since| since.as_secs().max(1)),
        max_lines: lines.or_else(|| since.map(|_| MAX_KEPT_LINES as u64)),
        follow: false,
    };
    session.client.get_by(&format!("/robots/{}/logs", order.robot), &query).await
}

/// Explains on stderr which lines are missing, and why.
fn explain(view: &LogsView) {
    if view.from == LogsFrom::Server {
        let reason = view.reason.as_deref().unwrap_or("the robot did not answer");
        say(&match view.lines.is_empty() {
            true => format!("{}; the server remembers nothing of it", printable(reason)),
            false => format!(
                "{}; this is what the server remembers, {} old",
                printable(reason),
                age(view.age_ms)
            ),
        });
    }
    say_left_out(view.suppressed);
}

fn say_left_out(count: u64) {
    if count > 0 {
        say(&format!(
            "{count} more lines were left out because they were too many; the robot keeps them"
        ));
    }
}

fn age(ms: u64) -> String {
    match ms / 1000 {
        seconds @ ..120 => format!("{seconds} s"),
        seconds @ 120..7200 => format!("{} min", seconds / 60),
        seconds @ 7200..172_800 => format!("{} h", seconds / 3600),
        seconds => format!("{} days", seconds / 86_400),
    }
}

/// Why a stream was left.
enum Left {
    /// The reader has closed the pipe.
    Unread,
    /// The stream broke, or the server stops.
    Broken(String),
}

async fn follow(session: &Session, order: &LogsOrder) -> Result<Outcome, CommandError> {
    let mut screen = Screen::new(session);
    let mut broken: Option<String> = None;
    loop {
        let query = LogsQuery {
            task: order.task.clone(),
            level: Some(order.level),
            follow: true,
            ..LogsQuery::default()
        };
        let opened = session.client.stream(&format!("/robots/{}/logs", order.robot), &query).await;
        let left = match opened {
            Ok(response) => listen(session, order, Events::of(response), &mut screen).await?,
            // A stream that never worked is not retried.
            Err(error) if screen.heard_at.is_none() || !wait::may_pass(&error) => {
                return Err(error.about(&order.robot));
            }
            Err(error) => Left::Broken(error.to_string()),
        };
        match left {
            Left::Unread => return Ok(Outcome::Succeeded),
            Left::Broken(reason) => {
                if broken.as_ref() != Some(&reason) {
                    say(&format!("{reason}; trying again"));
                }
                broken = Some(reason);
            }
        }
        sleep(wait::MAX_PAUSE).await;
    }
}

async fn listen(
    session: &Session,
    order: &LogsOrder,
    mut events: Events,
    screen: &mut Screen,
) -> Result<Left, CommandError> {
    let mut away: Option<String> = None;
    loop {
        let event = match tokio::time::timeout(SILENCE, events.next::<LogEvent>()).await {
            Ok(Ok(Some(event))) => event,
            Ok(Ok(None)) | Err(_) => {
                return Ok(Left::Broken("the server has ended the stream".to_owned()));
            }
            Ok(Err(error)) => {
                return Ok(Left::Broken(session.client.unreachable(error).to_string()));
            }
        };
        let goes_on = match event {
            LogEvent::Following => {
                away = None;
                catch_up(session, order, screen).await?
            }
            LogEvent::Away { reason } if away.as_ref() != Some(&reason) => {
                say(&format!("{}; waiting for it", printable(&reason)));
                away = Some(reason);
                // Until the stream is back, the server's own memory of the log is the only source.
                if screen.heard_at.is_some() {
                    true
                } else {
                    catch_up(session, order, screen).await?
                }
            }
            LogEvent::Away { .. } => true,
            LogEvent::Lines { lines, suppressed } => {
                say_left_out(suppressed);
                screen.print_new(&lines)?
            }
        };
        if !goes_on {
            return Ok(Left::Unread);
        }
    }
}

/// Prints the lines from before the stream began, or from while the stream was broken; false once
/// the reader has closed the pipe.
async fn catch_up(
    session: &Session,
    order: &LogsOrder,
    screen: &mut Screen,
) -> Result<bool, CommandError> {
    // The line limit applies to the past, not to lines missed during a break.
    let (since, lines) = match screen.heard_at {
        Some(heard_at) => (Some(heard_at.elapsed() + OVERLAP), None),
        None => (order.since, order.lines),
    };
    let view = match past(session, order, since, lines).await {
        Ok(view) => view,
        Err(error) if wait::may_pass(&error) => return Ok(true),
        Err(error) => return Err(error.into()),
    };
    if screen.heard_at.is_none() {
        explain(&view);
    }
    screen.print_past(&view.lines)
}

/// Log lines for the reader: in columns, or each as JSON.
struct Screen {
    format: Format,
    colours: bool,
    task_width: usize,
    node_width: usize,
    shown: Shown,
    heard_at: Option<Instant>,
}

impl Screen {
    fn new(session: &Session) -> Self {
        let colours = session.output.has_colours();
        let shown = Shown::default();
        Self {
            format: session.output.format(),
            colours,
            task_width: 0,
            node_width: 0,
            shown,
            heard_at: None,
        }
    }

    /// Prints lines that came by the stream, unless the past had them.
    fn print_new(&mut self, lines: &[LogLine]) -> Result<bool, CommandError> {
        let new: Vec<LogLine> =
            lines.iter().filter(|line| self.shown.streamed(line)).cloned().collect();
        self.heard_at = Some(Instant::now());
        self.print(&new)
    }

    /// Prints the past lines that are newer than the lines already printed.
    fn print_past(&mut self, lines: &[LogLine]) -> Result<bool, CommandError> {
        let new = self.shown.missing(lines);
        self.heard_at = Some(Instant::now());
        self.print(&new)
    }

    fn print(&mut self, lines: &[LogLine]) -> Result<bool, CommandError> {
        let width = |text: Option<&str>| text.map_or(1, |text| text.chars().count()).min(32);
        for line in lines {
            self.task_width = self.task_width.max(width(line.task.as_ref().map(TaskName::as_str)));
            self.node_width =
                self.node_width.max(width(line.node.as_ref().map(|node| node.as_str())));
        }
        let mut text = String::new();
        for line in lines {
            match self.format {
                Format::Table | Format::Wide | Format::Name => text.push_str(&self.row(line)),
                Format::Json => text.push_str(&crate::commands::display::output::json_line(line)?),
            }
            text.push('\n');
        }
        stream_text(&text)
    }

    fn row(&self, line: &LogLine) -> String {
        let time = timestamp(line.at_ms);
        let task = line.task.as_ref().map_or("-", TaskName::as_str);
        let node = line.node.as_ref().map_or("-", |node| node.as_str());
        let (task_width, node_width) = (self.task_width, self.node_width);
        let level = format!("{:<5}", line.level.as_str().to_uppercase());
        let level = match colour(line.level).filter(|_| self.colours) {
            Some(colour) => format!("\x1b[{colour}m{level}\x1b[0m"),
            None => level,
        };
        let (day, time) = (&time[..10], &time[11..]);
        format!(
            "{day} {time}  {level}  {task:<task_width$}  {node:<node_width$}  {}",
            printable(&line.text)
        )
    }
}

fn colour(level: LogLevel) -> Option<&'static str> {
    match level {
        LogLevel::Debug => Some("2"),
        LogLevel::Info => None,
        LogLevel::Warn => Some("33"),
        LogLevel::Error => Some("31"),
        LogLevel::Fatal => Some("1;31"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use task_proto::log::LogSource;

    #[test]
    fn a_line_has_its_columns_and_no_control_characters() {
        let line = LogLine {
            at_ms: 1_700_000_000_123,
            level: LogLevel::Warn,
            source: LogSource::Stderr,
            task: Some("talker".parse().unwrap()),
            node: None,
            text: "low\u{1b}[31m".to_owned(),
        };
        let mut screen = Screen {
            format: Format::Table,
            colours: false,
            task_width: 8,
            node_width: 3,
            shown: Shown::default(),
            heard_at: None,
        };
        assert_eq!(screen.row(&line), "2023-11-14 22:13:20.123Z  WARN   talker    -    low [31m");
        screen.colours = true;
        assert!(screen.row(&line).contains("  \x1b[33mWARN \x1b[0m  talker"));
    }

    #[test]
    fn ages_are_said_in_one_unit() {
        assert_eq!(
            [0, 119_000, 600_000, 7_200_000, 200_000_000].map(age),
            ["0 s", "119 s", "10 min", "2 h", "2 days"]
        );
    }
}
