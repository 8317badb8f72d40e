//! `taskd logs`: past log lines of a robot's tasks, and with `-f` new lines as they appear. The two
//! join without a gap: the stream is opened first, the past is requested once the robot has
//! confirmed that it publishes, and again whenever the stream broke.

use std::time::Duration;

use task_proto::api::{LogEvent, LogsFrom, LogsQuery, LogsView};
use task_proto::telemetry::log::{LogLevel, LogLine, MAX_KEPT_LINES};
use task_proto::time::parse_lifetime;
use task_proto::time::timestamp;
use task_proto::{RobotName, TaskName};
use tokio::time::{Instant, sleep};

use crate::api::client::ClientError;
use crate::api::sse::Events;
use crate::api::{complete, wait};
use crate::display::output::{Format, printable, say, stream_text};
use crate::display::printed_lines::PrintedLines;
use crate::{CommandError, Outcome, Session};

/// A stream without data for this long is broken: the server sends something every 15 s.
const IDLE_TIMEOUT: Duration = Duration::from_secs(60);
/// How far before the break the past is requested: clocks differ, and lines arrive late.
const OVERLAP: Duration = Duration::from_secs(120);

/// The robot, and filters of its log lines.
#[derive(Debug, clap::Args)]
pub struct LogsArgs {
    /// Robot name or id
    #[arg(add = complete::robots())]
    robot: RobotName,
    /// Only this task
    #[arg(add = complete::tasks())]
    task: Option<TaskName>,
    /// Follow new lines until Ctrl-C
    #[arg(short, long)]
    follow: bool,
    /// Minimum level: debug, info, warn, error or fatal
    #[arg(long, value_name = "LEVEL", default_value = "info")]
    level: LogLevel,
    /// Only lines newer than this, by the robot's clock, such as 10m
    #[arg(long, value_name = "TIME", value_parser = parse_lifetime)]
    since: Option<Duration>,
    /// Maximum number of past lines [default: 500; with --since, as many as fit]
    #[arg(short = 'n', long, value_name = "N")]
    lines: Option<u64>,
}

pub(crate) async fn run(session: &Session, args: LogsArgs) -> Result<Outcome, CommandError> {
    if session.output.format() == Format::Name {
        return Err(CommandError::Usage(
            "-o name: log lines have no names; use table, wide or json".to_owned(),
        ));
    }
    if args.follow {
        return follow(session, &args).await;
    }
    let view = stored_lines(session, &args, args.since, args.lines)
        .await
        .map_err(|error| error.for_robot(&args.robot))?;
    report_source(&view);
    match session.output.format() {
        Format::Json => session.output.print_json(&view)?,
        _ => drop(LogPrinter::new(session).print(&view.lines)?),
    }
    Ok(Outcome::Succeeded)
}

/// Follows a task's log, as `taskd logs -f`.
pub(crate) async fn follow_task(
    session: &Session,
    robot: RobotName,
    task: TaskName,
) -> Result<Outcome, CommandError> {
    let level = LogLevel::Info;
    follow(
        session,
        &LogsArgs { robot, task: Some(task), follow: true, level, since: None, lines: None },
    )
    .await
}

async fn stored_lines(
    session: &Session,
    args: &LogsArgs,
    since: Option<Duration>,
    lines: Option<u64>,
) -> Result<LogsView, ClientError> {
    let query = LogsQuery {
        task: args.task.clone(),
        level: Some(args.level),
        since_s: since.map(|since| since.as_secs().max(1)),
        max_lines: lines.or_else(|| since.map(|_| MAX_KEPT_LINES as u64)),
        follow: false,
    };
    session.client.get_with(&format!("/robots/{}/logs", args.robot), &query).await
}

/// Explains on stderr which lines are missing, and why.
fn report_source(view: &LogsView) {
    if view.from == LogsFrom::Server {
        let reason = view.reason.as_deref().unwrap_or("the robot did not answer");
        say(&match view.lines.is_empty() {
            true => format!("{}; the server has no recent lines of it", printable(reason)),
            false => format!(
                "{}; these are the server's copies of recent lines, {} old",
                printable(reason),
                age(view.age_ms)
            ),
        });
    }
    report_suppressed(view.suppressed);
}

fn report_suppressed(count: u64) {
    if count > 0 {
        say(&format!(
            "{count} more lines were dropped by the rate limit; the robot still has them"
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

/// Why reading a stream ended.
enum StreamEnd {
    /// The reader has closed the pipe.
    ReaderClosed,
    /// The stream broke, or the server stops.
    Broken(String),
}

async fn follow(session: &Session, args: &LogsArgs) -> Result<Outcome, CommandError> {
    let mut printer = LogPrinter::new(session);
    let mut broken: Option<String> = None;
    loop {
        let query = LogsQuery {
            task: args.task.clone(),
            level: Some(args.level),
            follow: true,
            ..LogsQuery::default()
        };
        let opened = session.client.stream(&format!("/robots/{}/logs", args.robot), &query).await;
        let end = match opened {
            Ok(response) => read_stream(session, args, Events::of(response), &mut printer).await?,
            // A stream that never worked is not retried.
            Err(error) if printer.received_at.is_none() || !wait::is_transient(&error) => {
                return Err(error.for_robot(&args.robot));
            }
            Err(error) => StreamEnd::Broken(error.to_string()),
        };
        match end {
            StreamEnd::ReaderClosed => return Ok(Outcome::Succeeded),
            StreamEnd::Broken(reason) => {
                if broken.as_ref() != Some(&reason) {
                    say(&format!("{reason}; retrying"));
                }
                broken = Some(reason);
            }
        }
        sleep(wait::MAX_PAUSE).await;
    }
}

async fn read_stream(
    session: &Session,
    args: &LogsArgs,
    mut events: Events,
    printer: &mut LogPrinter,
) -> Result<StreamEnd, CommandError> {
    let mut away_reason: Option<String> = None;
    loop {
        let event = match tokio::time::timeout(IDLE_TIMEOUT, events.next::<LogEvent>()).await {
            Ok(Ok(Some(event))) => event,
            Ok(Ok(None)) | Err(_) => {
                return Ok(StreamEnd::Broken("the server closed the stream".to_owned()));
            }
            Ok(Err(error)) => {
                return Ok(StreamEnd::Broken(session.client.unreachable(error).to_string()));
            }
        };
        let is_open = match event {
            LogEvent::Following => {
                away_reason = None;
                catch_up(session, args, printer).await?
            }
            LogEvent::Away { reason } if away_reason.as_ref() != Some(&reason) => {
                say(&format!("{}; waiting for the robot", printable(&reason)));
                away_reason = Some(reason);
                // Until the stream is back, the server's own memory of the log is the only source.
                if printer.received_at.is_some() {
                    true
                } else {
                    catch_up(session, args, printer).await?
                }
            }
            LogEvent::Away { .. } => true,
            LogEvent::Lines { lines, suppressed } => {
                report_suppressed(suppressed);
                printer.print_new(&lines)?
            }
        };
        if !is_open {
            return Ok(StreamEnd::ReaderClosed);
        }
    }
}

/// Prints the lines from before the stream began, or from while the stream was broken; false once
/// the reader has closed the pipe.
async fn catch_up(
    session: &Session,
    args: &LogsArgs,
    printer: &mut LogPrinter,
) -> Result<bool, CommandError> {
    // The line limit applies to the past, not to lines missed during a break.
    let (since, lines) = match printer.received_at {
        Some(received_at) => (Some(received_at.elapsed() + OVERLAP), None),
        None => (args.since, args.lines),
    };
    let view = match stored_lines(session, args, since, lines).await {
        Ok(view) => view,
        Err(error) if wait::is_transient(&error) => return Ok(true),
        Err(error) => return Err(error.into()),
    };
    if printer.received_at.is_none() {
        report_source(&view);
    }
    printer.print_past(&view.lines)
}

/// Prints log lines in columns, or each as JSON.
struct LogPrinter {
    format: Format,
    colours: bool,
    task_width: usize,
    node_width: usize,
    printed: PrintedLines,
    received_at: Option<Instant>,
}

impl LogPrinter {
    fn new(session: &Session) -> Self {
        let colours = session.output.has_colours();
        let printed = PrintedLines::default();
        Self {
            format: session.output.format(),
            colours,
            task_width: 0,
            node_width: 0,
            printed,
            received_at: None,
        }
    }

    /// Prints lines that came by the stream, unless the past had them.
    fn print_new(&mut self, lines: &[LogLine]) -> Result<bool, CommandError> {
        let new: Vec<LogLine> =
            lines.iter().filter(|line| self.printed.accept_streamed(line)).cloned().collect();
        self.received_at = Some(Instant::now());
        self.print(&new)
    }

    /// Prints the past lines that are newer than the lines already printed.
    fn print_past(&mut self, lines: &[LogLine]) -> Result<bool, CommandError> {
        let new = self.printed.unprinted(lines);
        self.received_at = Some(Instant::now());
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
                Format::Json => text.push_str(&crate::display::output::json_line(line)?),
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
    use task_proto::telemetry::log::LogSource;

    #[test]
    fn line_has_its_columns_and_no_control_characters() {
        let line = LogLine {
            at_ms: 1_700_000_000_123,
            level: LogLevel::Warn,
            source: LogSource::Stderr,
            task: Some("talker".parse().unwrap()),
            node: None,
            text: "low\u{1b}[31m".to_owned(),
        };
        let mut printer = LogPrinter {
            format: Format::Table,
            colours: false,
            task_width: 8,
            node_width: 3,
            printed: PrintedLines::default(),
            received_at: None,
        };
        assert_eq!(printer.row(&line), "2023-11-14 22:13:20.123Z  WARN   talker    -    low [31m");
        printer.colours = true;
        assert!(printer.row(&line).contains("  \x1b[33mWARN \x1b[0m  talker"));
    }

    #[test]
    fn ages_have_one_unit() {
        assert_eq!(
            [0, 119_000, 600_000, 7_200_000, 200_000_000].map(age),
            ["0 s", "119 s", "10 min", "2 h", "2 days"]
        );
    }
}
