//! `task-agent graph`: takes part in the ROS graph for an agent. Only the agent calls it.

use std::os::fd::{AsFd as _, BorrowedFd};
use std::process::ExitCode;

use anyhow::Context as _;
use tokio::net::unix::pipe;

use super::start_logging;
use crate::process::confinement;
use crate::ros::graph::process::serve;

/// Maximum number of threads for blocking work: opening the graph and leaving it.
const MAX_BLOCKING_THREADS: usize = 2;

/// Executes requests from standard input until its end.
pub fn run() -> anyhow::Result<ExitCode> {
    start_logging("warn,rustdds=off")?;
    confinement::hide_this_process();
    let runtime = tokio::runtime::Builder::new_current_thread()
        .max_blocking_threads(MAX_BLOCKING_THREADS)
        .enable_all()
        .build()?;
    let outcome = runtime.block_on(async {
        let input = std::io::stdin();
        let output = std::io::stdout();
        let input =
            pipe::Receiver::from_owned_fd(owned(input.as_fd())?).context("standard input")?;
        let output =
            pipe::Sender::from_owned_fd(owned(output.as_fd())?).context("standard output")?;
        serve::serve(input, output).await.context("the agent")
    });
    // The command does not wait for a thread of the DDS library that hangs.
    runtime.shutdown_background();
    outcome.map(|()| ExitCode::SUCCESS)
}

fn owned(stream: BorrowedFd<'_>) -> anyhow::Result<std::os::fd::OwnedFd> {
    stream.try_clone_to_owned().context("cannot use the pipes to the agent")
}
