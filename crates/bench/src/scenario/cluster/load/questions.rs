//! Questions for the vitals of a random robot at a random server. Robots that move and
//! servers that are away leave questions unanswered.

use std::time::{Duration, Instant};

use rand::RngExt as _;
use task_proto::messages::request::Ask;

use super::{Client, TRY_TIMEOUT, ticks};
use crate::programs::server::ServerError;
use crate::simulated::fleet::name;

const INTERVAL: Duration = Duration::from_millis(250);

pub(super) async fn run(client: Client) -> anyhow::Result<()> {
    let mut random = client.random(4);
    let mut tick = ticks(INTERVAL);
    while client.goes_on(&mut tick).await {
        let server = &client.servers[random.random_range(0..client.servers.len())];
        let robot = name(random.random_range(0..client.args.robots));
        let begun = Instant::now();
        let asked = tokio::time::timeout(TRY_TIMEOUT, server.ask(&robot, &Ask::Vitals)).await;
        let mut record = client.record();
        let reason = match asked {
            Ok(Ok(())) => {
                record.answers_ms.push(begun.elapsed().as_secs_f64() * 1000.0);
                continue;
            }
            Ok(Err(ServerError::Refused(_, status, _))) => status.to_string(),
            Ok(Err(ServerError::NoAnswer(..))) => "no connection".to_owned(),
            Err(_) => format!("silent for {TRY_TIMEOUT:?}"),
        };
        *record.unanswered.entry(reason).or_default() += 1;
    }
    Ok(())
}
