//! `task-agent status`: the state of this robot's tasks, read from the agent's files. The command
//! works without a server and without a running agent.

use std::process::ExitCode;

use serde_json::json;

use super::{DataDir, Output, say};
use crate::system::identity::Identity;
use crate::system::layout::DataDir as Layout;
use crate::system::layout::HOLD_FILE;
use crate::task::ledger::{Ledger, TaskRecord};
use crate::task::run::ActiveRun;

#[derive(Debug, clap::Args)]
pub struct Arguments {
    /// Output format
    #[arg(short, long, value_enum, default_value_t = Output::Table, value_name = "FORMAT")]
    output: Output,
    #[command(flatten)]
    data: DataDir,
}

pub fn run(arguments: Arguments) -> anyhow::Result<ExitCode> {
    let data = Layout::new(&arguments.data.data)?;
    let identity = Identity::read(&data.identity())?;
    let ledger = Ledger::peek(&data.ledger())?.unwrap_or_else(|| Ledger::new(0));
    let held = data.root().join(HOLD_FILE).exists();
    let agent = agent_runs(&data);
    match arguments.output {
        Output::Json => {
            let status = json!({
                "robot_id": identity.robot_id,
                "mac": identity.mac,
                "server": identity.server,
                "agent_running": agent,
                "held": held,
                "removed": ledger.removed,
                "removed_because": ledger.removed_because,
                "generation": ledger.accepted.as_ref().map(|accepted| accepted.generation),
                "tasks": ledger.tasks.values().map(task_json).collect::<Vec<_>>(),
            });
            say(format_args!("{status:#}"));
        }
        Output::Table => {
            say(format_args!(
                "robot    {} ({}) at {}",
                identity.robot_id, identity.mac, identity.server
            ));
            say(format_args!("agent    {}", if agent { "runs" } else { "does not run" }));
            if held {
                say(format_args!("held     no starts or switches until task-agent release"));
            }
            if let Some(text) = ledger.removal_message() {
                say(format_args!("removed  {}", text));
            }
            say(format_args!(
                "{:<24} {:<14} {:<11} {:<9} FAILURE",
                "TASK", "VERSION", "PHASE", "PID"
            ));
            for record in ledger.tasks.values() {
                say(format_args!("{}", task_row(record)));
            }
        }
    }
    Ok(ExitCode::SUCCESS)
}

fn pid(record: &TaskRecord) -> Option<u32> {
    record.active.as_ref()?.process()?.pid
}

fn task_row(record: &TaskRecord) -> String {
    let (phase, failure) = record.order_phase();
    let pid = pid(record).map_or_else(|| "-".to_owned(), |pid| pid.to_string());
    let failure = failure.map(ToString::to_string).unwrap_or_default();
    let order = &record.order;
    let row = format!(
        "{:<24} {:<14} {phase:<11} {pid:<9} {}",
        order.task.as_str(),
        order.package.version.as_str(),
        failure.lines().collect::<Vec<_>>().join(" ")
    );
    row.trim_end().to_owned()
}

fn task_json(record: &TaskRecord) -> serde_json::Value {
    let (phase, failure) = record.order_phase();
    json!({
        "task": record.order.task,
        "version": record.order.package.version,
        "deployment": record.order.deployment,
        "wanted": record.order.wanted,
        "run": record.order.run,
        "phase": phase,
        "failure": failure,
        "restarts": record.active.as_ref().map_or(0, ActiveRun::restarts),
        "active_version": record.active.as_ref().map(|active| &active.package.version),
        "pid": pid(record),
    })
}

/// Whether an agent holds the data directory's lock.
pub(super) fn agent_runs(data: &Layout) -> bool {
    let lock = std::fs::File::open(data.root().join("lock"));
    lock.is_ok_and(|file| matches!(file.try_lock_shared(), Err(std::fs::TryLockError::WouldBlock)))
}
