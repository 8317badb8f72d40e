//! Answers the server's questions. Each question is answered independently, within its time limit,
//! and a few run concurrently. Answers only read and forward; lasting changes come with the desired
//! state and go through the driver.

use std::sync::Arc;
use std::time::Duration;

use task_proto::RobotId;
use task_proto::log::LogBatch;
use task_proto::request::{
    Answer, Ask, MAX_REPLY_BYTES, MAX_TTL_MS, Outcome, Refusal, Reply, Request,
};
use task_proto::topic::RobotTopic;
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use tokio::time::Instant;

use crate::link::state::Message;
use crate::logs::Logs;
use crate::logs::archive::Wanted;
use crate::reconcile::graph_answers::GraphAnswers;
use crate::reconcile::orders::{Orders, refusal};
use crate::system::clock;
use crate::telemetry::vitals;

/// The maximum number of questions answered concurrently. A lifecycle transition may take seconds
/// and should not hold up a list.
const AT_A_TIME: usize = 8;

/// Answers the server's questions.
pub struct Answers {
    pub robot_id: RobotId,
    /// Verifies the requests that change something.
    pub orders: Orders,
    /// The log lines of the robot's tasks.
    pub logs: Logs,
    /// Answers questions about the ROS graph.
    pub graph: GraphAnswers,
    /// The machine's vital signs.
    pub vitals: vitals::Asked,
}

impl Answers {
    /// Answers questions until the channel closes.
    pub async fn run(
        self,
        mut requests: mpsc::Receiver<(Request, Instant)>,
        messages: mpsc::Sender<Message>,
    ) {
        let answers = Arc::new(self);
        let mut under_way = JoinSet::new();
        loop {
            tokio::select! {
                // Cancel-safe: a request stays in the channel until it is received.
                request = requests.recv(), if under_way.len() < AT_A_TIME => {
                    let Some((request, came)) = request else { return };
                    let (answers, messages) = (answers.clone(), messages.clone());
                    under_way.spawn(async move { answers.reply(request, came, &messages).await });
                }
                // Cancel-safe: an ended task stays in the set until it is taken.
                Some(_) = under_way.join_next() => {}
            }
        }
    }

    /// Answers a request that arrived at `came`, before its time limit.
    async fn reply(&self, request: Request, came: Instant, messages: &mpsc::Sender<Message>) {
        let meant = self.orders.meant(&request);
        let Request { id, ttl_ms, .. } = request;
        let until = came + Duration::from_millis(ttl_ms.min(MAX_TTL_MS));
        let late = || Err(refusal("timeout", "the robot had no answer in time"));
        // We begin no work for a request that has timed out.
        let answer = match meant {
            Ok(ask) if Instant::now() < until => {
                tokio::time::timeout_at(until, self.answer(ask)).await.unwrap_or_else(|_| late())
            }
            Ok(_) => late(),
            Err(refusal) => Err(refusal),
        };
        let written = |answer: Result<Answer, Refusal>| {
            let outcome = answer.map_or_else(Outcome::Refusal, Outcome::Answer);
            serde_json::to_vec(&Reply { robot_id: self.robot_id.clone(), id: id.clone(), outcome })
        };
        let payload = match written(answer) {
            Ok(payload) if payload.len() > MAX_REPLY_BYTES => {
                let text =
                    format!("the answer has {} bytes, more than a message may have", payload.len());
                written(Err(refusal("too_large", text)))
            }
            written => written,
        };
        match payload {
            // Without a session, or with one that is too slow, the answer has no further use.
            Ok(payload) => drop(messages.try_send(Message { topic: RobotTopic::Reply, payload })),
            Err(error) => tracing::error!(%error, "an answer can't be written as JSON"),
        }
    }

    async fn answer(&self, ask: Ask) -> Result<Answer, Refusal> {
        match ask {
            Ask::Logs { task, level, since_ms, max_lines } => {
                self.kept_lines(Wanted { task, level, since_ms, max_lines }).await
            }
            Ask::Follow { level, lease_ms } => {
                self.logs.follow(level, Duration::from_millis(lease_ms));
                Ok(Answer::Following)
            }
            Ask::Nodes => self.graph.nodes().await,
            Ask::Node { name } => self.graph.node(&name).await,
            Ask::Topics => self.graph.topics().await,
            Ask::Parameters { node } => self.graph.parameters(&node).await,
            Ask::Parameter { node, name } => self.graph.parameter(&node, &name).await,
            Ask::SetParameter { node, parameter } => {
                self.graph.set_parameter(&node, &parameter).await
            }
            Ask::Lifecycle { node, transition } => self.graph.lifecycle(&node, transition).await,
            Ask::Vitals => Ok(Answer::Vitals(self.vitals.now().await)),
            Ask::Unknown => Err(refusal(
                "unsupported",
                "this agent does not know the question; it may be too old",
            )),
        }
    }

    async fn kept_lines(&self, wanted: Wanted) -> Result<Answer, Refusal> {
        let lines = self.logs.kept(wanted).await;
        let lines = lines.map_err(|error| refusal("no_such_task", error.to_string()))?;
        let robot_id = self.robot_id.clone();
        Ok(Answer::Logs(LogBatch { robot_id, now_ms: clock::wall_ms(), lines, suppressed: 0 }))
    }
}
