//! Log files of tasks: written within a limit, read back on demand, forwarded to the server. They
//! never grow beyond their limit.
//!
//! A line is stored as it came, after the time and a letter for its stream (see [`record`]). The
//! level and the node are determined when the line is read. Control characters are also removed at
//! that point.

pub mod archive;
pub mod capture;
pub mod console;
pub mod forwarder;
pub mod line;
pub mod record;
pub mod rotated;
pub mod tail;

pub use rotated::RotatedLog;

use std::fs::File;
use std::io::{self, Read as _, Seek as _, SeekFrom};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};
use task_proto::TaskName;
use task_proto::telemetry::log::{LogLevel, LogLine, LogSource};
use tokio::sync::watch;

use crate::system::clock;
use crate::system::layout::DataDir;
use archive::LogQuery;
use line::LogFile;
use record::Record;

/// Maximum time that lines are published for one request; a client that still follows sends the
/// request again.
const MAX_LEASE: Duration = Duration::from_secs(120);

/// Location and size limits of a task's log.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct LogSpec {
    /// The current file; older ones are beside it with `.1`, `.2`, … added.
    pub path: PathBuf,
    /// The size at which a file is rotated.
    pub max_bytes: u64,
    /// Number of files that are kept, the current one included.
    pub files: u32,
}

/// Requests to a robot's logs.
#[derive(Debug, Clone)]
pub struct Logs {
    data: DataDir,
    following: watch::Sender<Option<Following>>,
}

impl LogSpec {
    /// A log at `path` of at most 50 MiB in five files.
    pub fn at(path: PathBuf) -> Self {
        Self { path, max_bytes: 10 * 1024 * 1024, files: 5 }
    }
}

/// A client's request to follow the logs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Following {
    /// Only lines of this level and more serious ones.
    pub level: LogLevel,
    /// End of the request.
    pub until: Instant,
}

/// No logs of this task exist on the robot: they were removed, or the task never ran here.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("there is no task {0} on this robot")]
pub struct NoSuchTask(pub TaskName);

impl Logs {
    /// The logs in `data`.
    pub fn new(data: DataDir) -> Self {
        Self { data, following: watch::Sender::new(None) }
    }

    /// The newest matching lines that fit into an answer, the oldest first.
    pub async fn query(&self, query: LogQuery) -> Result<Vec<LogLine>, NoSuchTask> {
        if let Some(task) = query.task.as_ref().filter(|task| !self.data.task(task).root().exists())
        {
            return Err(NoSuchTask(task.clone()));
        }
        let data = self.data.clone();
        let read = move || archive::newest(&files(&data), &query, clock::wall_ms());
        Ok(tokio::task::spawn_blocking(read).await.unwrap_or_default())
    }

    /// Publishes lines of `level` and above for `lease`.
    pub fn follow(&self, level: LogLevel, lease: Duration) {
        self.following
            .send_replace(Some(Following { level, until: Instant::now() + lease.min(MAX_LEASE) }));
    }

    /// The current request to follow, if any.
    pub fn following(&self) -> watch::Receiver<Option<Following>> {
        self.following.subscribe()
    }
}

/// All logs that may exist.
fn files(data: &DataDir) -> Vec<LogFile> {
    let ros_log = LogFile { path: data.ros_log(), task: None, unmarked: LogSource::Rosout };
    let mut files = vec![ros_log];
    for name in data.task_names().unwrap_or_default() {
        let task = data.task(&name);
        let logs = [
            (task.output_log(), LogSource::Stdout),
            (task.ros_log(), LogSource::Rosout),
            (task.build_log(), LogSource::Build),
        ];
        files.extend(logs.map(|(path, unmarked)| LogFile {
            path,
            task: Some(name.clone()),
            unmarked,
        }));
    }
    files
}

/// The last lines of the last run in the log at `path`, from its last `max_bytes`, without times;
/// empty when there is no log.
pub fn last_lines(path: &Path, max_bytes: u64) -> String {
    let read = || {
        let mut file = File::open(path)?;
        let begin = file.metadata()?.len().saturating_sub(max_bytes);
        file.seek(SeekFrom::Start(begin))?;
        let mut bytes = Vec::new();
        file.take(max_bytes).read_to_end(&mut bytes)?;
        // A partial first line is not worth showing.
        let cut = if begin == 0 {
            0
        } else {
            bytes.iter().position(|byte| *byte == b'\n').map_or(bytes.len(), |at| at + 1)
        };
        let records: Vec<Record> =
            bytes[cut..].split(|byte| *byte == b'\n').map(Record::parse).collect();
        let begin = records.iter().rposition(Record::is_start).map_or(0, |at| at + 1);
        let task_records =
            records[begin..].iter().filter(|record| record.source != Some(LogSource::Agent));
        let lines: Vec<String> =
            task_records.map(|record| console::printable(record.text)).collect();
        Ok::<_, io::Error>(lines.join("\n").trim_end().to_owned())
    };
    read().unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn last_lines_are_complete_and_of_the_last_run_only() {
        let temp = tempfile::tempdir().expect("temp dir");
        let path = temp.path().join("task.log");
        assert_eq!(last_lines(&path, 10), "");
        std::fs::write(&path, "one\ntwo\nthree\n").expect("write");
        assert_eq!(last_lines(&path, 100), "one\ntwo\nthree", "as earlier versions wrote it");
        assert_eq!(last_lines(&path, 8), "three");
        assert_eq!(last_lines(&path, 3), "");
        std::fs::write(&path, "[taskd: started]\nearlier\n").expect("write");
        assert_eq!(last_lines(&path, 100), "earlier");
        let mut log = std::fs::read(&path).expect("read");
        record::write_start(&mut log, 0);
        record::write(
            &mut log,
            "1970-01-01T00:00:00.000Z",
            LogSource::Stderr,
            false,
            b"\x1b[31mno\x1b[0m\tway",
        );
        record::write(
            &mut log,
            "1970-01-01T00:00:00.000Z",
            LogSource::Agent,
            false,
            b"[WARN] 4 bytes are missing",
        );
        std::fs::write(&path, log).expect("write");
        assert_eq!(
            last_lines(&path, 300),
            "no way",
            "an earlier run's lines say nothing about this one"
        );
    }
}
