//! `taskd output`: what tasks brought back from robots, listed and fetched.

use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::Subcommand;
use reqwest::Method;
use sha2::{Digest as _, Sha256};
use task_proto::api::{OutputList, OutputView};
use task_proto::output::OutputFile;
use task_proto::{Digest, RobotName, Tag, TaskName};
use tokio::io::AsyncWriteExt as _;
use tokio::time::timeout;

use super::output::{bytes, say, time};
use super::{CommandError, Outcome, Session};

/// The longest the server may say nothing in the middle of a file.
const SILENCE: Duration = Duration::from_secs(60);
/// The longest one file may take.
const LONGEST: Duration = Duration::from_secs(24 * 60 * 60);

/// What to do with outputs.
#[derive(Debug, Subcommand)]
pub enum Action {
    /// List what came back, the newest first
    List {
        /// Only from this robot, by name or id
        robot: Option<RobotName>,
        /// Only of this task
        #[arg(long)]
        task: Option<TaskName>,
    },
    /// Fetch the files of a run, the newest unless --run says which
    Get {
        /// The robot's name or id
        robot: RobotName,
        /// The task
        task: TaskName,
        /// Which run, as the list shows it
        #[arg(long, value_name = "RUN")]
        run: Option<Tag>,
        /// Where to put the files; it is made if need be, files that are there are replaced
        #[arg(long, value_name = "DIR", default_value = ".")]
        into: PathBuf,
    },
}

pub(super) async fn run(session: &Session, action: Action) -> Result<Outcome, CommandError> {
    match action {
        Action::List { robot, task } => {
            let list = list(session, robot.as_ref(), task.as_ref()).await?;
            let header = ["robot", "task", "version", "run", "came", "file", "size"];
            session.output.result(&list, &header, |list| list.outputs.iter().flat_map(rows).collect())?;
        }
        Action::Get { robot, task, run, into } => {
            let list = list(session, Some(&robot), Some(&task)).await?;
            let mut outputs = list.outputs.iter();
            let found = match &run {
                Some(run) => outputs.find(|view| view.output.tag().as_ref() == Some(run)),
                None => outputs.next(),
            };
            let Some(view) = found else {
                let which = run.map_or_else(String::new, |run| format!(" of the run {run}"));
                return Err(CommandError::Usage(format!("{robot} has brought back nothing{which} of the task {task}")));
            };
            for file in &view.output.files {
                fetch(session, view, file, &into).await?;
            }
            let files = view.output.files.len();
            say(&format!("{files} file{} in {}", if files == 1 { "" } else { "s" }, into.display()));
        }
    }
    Ok(Outcome::Succeeded)
}

async fn list(
    session: &Session,
    robot: Option<&RobotName>,
    task: Option<&TaskName>,
) -> Result<OutputList, CommandError> {
    let robot = robot.map(|robot| ("robot", robot.to_string()));
    let task = task.map(|task| ("task", task.to_string()));
    let query: Vec<_> = [robot, task].into_iter().flatten().collect();
    Ok(session.client.get("/outputs", &query).await?)
}

fn rows(view: &OutputView) -> Vec<Vec<String>> {
    let run = view.output.tag().map_or_else(|| "-".to_owned(), |tag| tag.to_string());
    let row = |file: &OutputFile| {
        vec![
            view.robot_name.to_string(),
            view.output.task.to_string(),
            view.output.version.to_string(),
            run.clone(),
            time(view.pushed_at_ms),
            file.path.to_string(),
            bytes(file.blob.size),
        ]
    };
    view.output.files.iter().map(row).collect()
}

/// Fetches one file beside its place and moves it there once its bytes are proven.
async fn fetch(session: &Session, view: &OutputView, file: &OutputFile, into: &Path) -> Result<(), CommandError> {
    // An output's path has no `..` and is not absolute, so this stays below `into`.
    let path = into.join(file.path.as_str());
    let failed = |source| CommandError::Io { what: format!("can't write {}", path.display()), source };
    let parent = path.parent().unwrap_or(into);
    tokio::fs::create_dir_all(parent).await.map_err(failed)?;
    // As any new file of this person, once it is whole.
    let readable = std::fs::Permissions::from_mode(0o666);
    let beside = tempfile::Builder::new().permissions(readable).tempfile_in(parent).map_err(failed)?;
    let mut writer = tokio::fs::File::from_std(beside.reopen().map_err(failed)?);
    let (robot, task) = (&view.output.robot_id, &view.output.task);
    let url = format!("/v2/outputs/{robot}/{task}/blobs/{}", file.blob.digest);
    // A large file may take long, as long as it goes on.
    let mut response = session.client.send(|| session.client.request(Method::GET, &url).timeout(LONGEST)).await?;
    let mut hash = Sha256::new();
    loop {
        let chunk = timeout(SILENCE, response.chunk()).await;
        let chunk = chunk.map_err(|_| failed(std::io::Error::other("the server has stopped sending")))?;
        let Some(chunk) = chunk.map_err(|source| session.client.unreachable(source))? else { break };
        hash.update(&chunk);
        writer.write_all(&chunk).await.map_err(failed)?;
    }
    writer.flush().await.map_err(failed)?;
    let got = Digest::from_bytes(hash.finalize().into());
    if got != file.blob.digest {
        let text = format!("{}: the bytes hash to {got}, not to {}", file.path, file.blob.digest);
        return Err(failed(std::io::Error::other(text)));
    }
    beside.persist(&path).map_err(|error| failed(error.error))?;
    say(&path.display().to_string());
    Ok(())
}
