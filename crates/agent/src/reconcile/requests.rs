//! Answers the server's questions. Each question is answered independently, within its time limit,
//! and a few run concurrently. Answers only read and forward; lasting changes come with the desired
//! state and go through the driver.

use std::sync::Arc;
use std::time::Duration;

use task_proto::RobotId;
use task_proto::messages::request::{
    Answer, Ask, MAX_REPLY_BYTES, MAX_TTL_MS, Outcome, Refusal, Reply, Request,
};
use task_proto::messages::topic::RobotTopic;
use task_proto::telemetry::log::LogBatch;
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use tokio::time::Instant;

use crate::link::state::Message;
use crate::logs::Logs;
use crate::logs::archive::LogQuery;
use crate::reconcile::graph_requests::GraphRequests;
use crate::reconcile::request_verifier::{RequestVerifier, refusal};
use crate::system::clock;
use crate::telemetry::vitals;

/// The maximum number of questions answered concurrently. A lifecycle transition may take seconds
/// and should not hold up a list.
const MAX_CONCURRENT_REQUESTS: usize = 8;

/// Answers the server's questions.
pub struct RequestHandler {
    pub robot_id: RobotId,
    /// Verifies the requests that change something.
    pub verifier: RequestVerifier,
    /// The log lines of the robot's tasks.
    pub logs: Logs,
    /// Answers questions about the ROS graph.
    pub graph: GraphRequests,
    /// The machine's vital signs.
    pub vitals: vitals::OnDemandVitals,
}

impl RequestHandler {
    /// Answers questions until the channel closes.
    pub async fn run(
        self,
        mut requests: mpsc::Receiver<(Request, Instant)>,
        messages: mpsc::Sender<Message>,
    ) {
        let handler = Arc::new(self);
        let mut under_way = JoinSet::new();
        loop {
            tokio::select! {
                // Cancel-safe: a request stays in the channel until it is received.
                request = requests.recv(), if under_way.len() < MAX_CONCURRENT_REQUESTS => {
                    let Some((request, received_at)) = request else { return };
                    let handler = handler.clone();
                    let messages = messages.clone();
                    under_way.spawn(async move { handler.reply(request, received_at, &messages).await });
                }
                // Cancel-safe: an ended task stays in the set until it is taken.
                Some(_) = under_way.join_next() => {}
            }
        }
    }

    /// Answers a request that arrived at `received_at`, before its time limit.
    async fn reply(
        &self,
        request: Request,
        received_at: Instant,
        messages: &mpsc::Sender<Message>,
    ) {
        let verified = self.verifier.verify(&request);
        let Request { id, ttl_ms, .. } = request;
        let until = received_at + Duration::from_millis(ttl_ms.min(MAX_TTL_MS));
        let late = || Err(refusal("timeout", "the robot did not answer in time"));
        // We begin no work for a request that has timed out.
        let answer = match verified {
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
                    format!("the answer has {} bytes, more than the message limit", payload.len());
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
                self.log_lines(LogQuery { task, level, since_ms, max_lines }).await
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
                "this agent does not know the request; the agent may be too old",
            )),
        }
    }

    async fn log_lines(&self, query: LogQuery) -> Result<Answer, Refusal> {
        let lines = self.logs.query(query).await;
        let lines = lines.map_err(|error| refusal("no_such_task", error.to_string()))?;
        let robot_id = self.robot_id.clone();
        Ok(Answer::Logs(LogBatch { robot_id, now_ms: clock::wall_ms(), lines, suppressed: 0 }))
    }
}
