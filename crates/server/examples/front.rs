//! The MQTT front alone, for measurements. It admits every client that names a robot id, stores
//! nothing, and for each line on standard input sends one desired state to every connected robot.
//! It prints its address as the first line of its output, and ends with its input. It listens on
//! loopback and is not for a network.

use std::collections::BTreeSet;
use std::io::Write as _;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex, PoisonError};

use bytes::Bytes;
use futures_util::FutureExt as _;
use futures_util::future::BoxFuture;
use task_proto::RobotId;
use task_proto::messages::topic::TopicPrefix;
use taskd::broker::{
    Broker, BrokerConfig, Gatekeeper, Inbox, Limits, Login, NotStored, Principal, Refusal,
    RobotMessage,
};
use taskd::domain::limits::robot_limiter::{RobotLimiter, RobotLimits};
use taskd::net::proxy_protocol::ProxyProtocol;

/// As taskd itself has it.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// Size of a desired state.
const PAYLOAD_BYTES: usize = 300;

struct Open;

impl Gatekeeper for Open {
    fn admit(&self, login: Login) -> BoxFuture<'_, Result<Principal, Refusal>> {
        let robot = login.client_id.parse().map_err(|_| Refusal::BadCredentials);
        async move { Ok(Principal::Robot { robot: robot?, token_number: 0, is_first_use: false }) }
            .boxed()
    }
}

#[derive(Default)]
struct Connected(Mutex<BTreeSet<RobotId>>);

impl Inbox for Connected {
    fn receive(&self, _: RobotMessage) -> BoxFuture<'_, Result<(), NotStored>> {
        async { Ok(()) }.boxed()
    }

    fn connected(&self, robot: &RobotId, _: Option<SocketAddr>, _: u64, _: Option<u64>) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).insert(robot.clone());
    }

    fn disconnected(&self, robot: &RobotId, _: u64) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).remove(robot);
    }

    fn external_broker_connected(&self) {}
}

fn main() -> anyhow::Result<()> {
    let connected = Arc::new(Connected::default());
    let config = BrokerConfig {
        listen: ([127, 0, 0, 1], 0).into(),
        tls: None,
        proxy_protocol: ProxyProtocol::new(&[]),
        prefix: TopicPrefix::default(),
        limits: Limits { max_silent_per_address: 20_000, ..Limits::default() },
        robot_limiter: RobotLimiter::new(RobotLimits::default()),
    };
    let runtime = tokio::runtime::Runtime::new()?;
    let broker = runtime.block_on(Broker::start(config, Arc::new(Open), connected.clone()))?;
    let mut output = std::io::stdout();
    writeln!(output, "{}", broker.address())?;
    output.flush()?;
    let payload = Bytes::from(vec![b'x'; PAYLOAD_BYTES]);
    for line in std::io::stdin().lines() {
        line?;
        let robots: Vec<RobotId> =
            connected.0.lock().unwrap_or_else(PoisonError::into_inner).iter().cloned().collect();
        for robot in &robots {
            // A robot that has just disconnected is missing in the count.
            let _ = broker.send_desired(robot, payload.clone());
        }
    }
    Ok(())
}
