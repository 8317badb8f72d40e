//! `taskd output`: lists and fetches tasks' outputs from robots.

use std::path::{Path, PathBuf};

use clap::Subcommand;
use task_proto::api::{OutputList, OutputView};
use task_proto::packages::output::OutputFile;
use task_proto::size::format_bytes;
use task_proto::{RobotName, Tag, TaskName};

use crate::api::complete;
use crate::api::download::{download, put};
use crate::display::output::table::Columns;
use crate::display::output::{say, time};
use crate::{CommandError, Outcome, Session};

#[derive(Debug, Subcommand)]
pub enum Action {
    /// List output files, newest first
    List {
        /// Only this robot, by name or id
        #[arg(add = complete::robots())]
        robot: Option<RobotName>,
        /// Only this task
        #[arg(long, add = complete::tasks())]
        task: Option<TaskName>,
    },
    /// Download the output files of a run
    Get {
        /// Robot name or id
        #[arg(add = complete::robots())]
        robot: RobotName,
        /// Task name
        #[arg(add = complete::tasks())]
        task: TaskName,
        /// Run, as shown by taskd output list [default: the newest]
        #[arg(long, value_name = "RUN")]
        run: Option<Tag>,
        /// Directory to write to, created if missing; existing files are replaced
        #[arg(long, value_name = "DIR", default_value = ".")]
        into: PathBuf,
    },
}

pub(crate) async fn run(session: &Session, action: Action) -> Result<Outcome, CommandError> {
    match action {
        Action::List { robot, task } => {
            let list = list(session, robot.as_ref(), task.as_ref()).await?;
            session
                .output
                .print_list(&list, &COLUMNS, |list| list.outputs.iter().flat_map(rows).collect())?;
        }
        Action::Get { robot, task, run, into } => {
            let list = list(session, Some(&robot), Some(&task)).await?;
            let mut outputs = list.outputs.iter();
            let found = match &run {
                Some(run) => outputs.find(|view| view.output.tag().as_ref() == Some(run)),
                None => outputs.next(),
            };
            let Some(view) = found else {
                let which = run.map_or_else(String::new, |run| format!(" for run {run}"));
                return Err(CommandError::Usage(format!(
                    "no outputs of task {task} from {robot}{which}"
                )));
            };
            for file in &view.output.files {
                fetch(session, view, file, &into).await?;
            }
            let files = view.output.files.len();
            say(&format!(
                "downloaded {files} file{} to {}",
                if files == 1 { "" } else { "s" },
                into.display()
            ));
        }
    }
    Ok(Outcome::Succeeded)
}

async fn list(
    session: &Session,
    robot: Option<&RobotName>,
    task: Option<&TaskName>,
) -> Result<OutputList, CommandError> {
    let of_robot = robot.map(|robot| ("robot", robot.to_string()));
    let of_task = task.map(|task| ("task", task.to_string()));
    let query: Vec<_> = [of_robot, of_task].into_iter().flatten().collect();
    session.client.get("/outputs", &query).await.map_err(|error| match robot {
        Some(robot) => error.for_robot(robot),
        None => error.into(),
    })
}

const COLUMNS: Columns = Columns {
    name: "file",
    narrow: &["robot", "task", "version", "run", "pushed", "file", "size"],
    wide: &["robot id", "digest"],
};

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
            format_bytes(file.blob.size),
            view.output.robot_id.to_string(),
            file.blob.digest.to_string(),
        ]
    };
    view.output.files.iter().map(row).collect()
}

/// Fetches one file beside its destination and moves the file there once its bytes are verified.
async fn fetch(
    session: &Session,
    view: &OutputView,
    file: &OutputFile,
    into: &Path,
) -> Result<(), CommandError> {
    // An output's path has no `..` and is not absolute, so this stays below `into`.
    let path = into.join(file.path.as_str());
    let parent = path.parent().unwrap_or(into);
    tokio::fs::create_dir_all(parent).await.map_err(|source| CommandError::Io {
        what: format!("can't create {}", parent.display()),
        source,
    })?;
    let (robot, task) = (&view.output.robot_id, &view.output.task);
    let url = format!("/v2/outputs/{robot}/{task}/blobs/{}", file.blob.digest);
    put(download(session, &url, file.blob.digest, parent).await?, &path)?;
    say(&path.display().to_string());
    Ok(())
}
