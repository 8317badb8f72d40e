//! `taskbench broker`: how soon a different short message reaches each of many connected robots,
//! compared with mosquitto in the same run. Both send with QoS 1 to clients of the same
//! implementation. The MQTT front of taskd sends from within; mosquitto receives the messages from
//! one publisher, all at once, which is the highest load it can be given.

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context as _, ensure};
use clap::Args;
use futures_util::{StreamExt as _, TryStreamExt as _};
use task_proto::RobotId;
use task_proto::messages::topic::{RobotTopic, Topic, TopicPrefix};
use tokio::io::{AsyncBufReadExt as _, AsyncWriteExt as _, BufReader};
use tokio::process::ChildStdin;
use tokio::sync::Notify;
use tokio::task::JoinHandle;

use crate::measure::mqtt::{Link, Login, Packet, acknowledgement, message};
use crate::programs::peer::Peer;
use crate::results::run::{Plot, Point, Run, RunFlags, Unit};
use crate::system::machine::allow_files;
use crate::system::process::{Process, Program, Usage};
use crate::system::progress::{RunProgress, print_line};

const RATIO: &str = "taskd / mosquitto";
/// Bytes of a message. The front's own program sends as many.
const PAYLOAD_BYTES: usize = 300;
/// Connections opened at a time.
const CONCURRENT_CONNECTS: usize = 64;
/// Messages to each client after its first one.
const WARM_ROUNDS: usize = 5;
/// Time limit of one round.
const ROUND_LIMIT: Duration = Duration::from_secs(60);

#[derive(Debug, Args)]
pub struct BrokerFlags {
    /// How many clients; may be given more than once
    #[arg(long, value_name = "N", default_values_t = [1000, 10_000],
          value_parser = clap::value_parser!(u32).range(1..=40_000))]
    clients: Vec<u32>,
    /// How often everything is measured, in turns with mosquitto
    #[arg(long, value_name = "N", default_value_t = 7, value_parser = clap::value_parser!(u32).range(1..=100))]
    runs: u32,
    /// The front as a program of its own [default: examples/front beside taskbench; build it with
    /// cargo build --release -p taskd --example front]
    #[arg(long, value_name = "PATH")]
    front: Option<std::path::PathBuf>,
    #[command(flatten)]
    run: RunFlags,
}

/// The sender of the messages.
enum Sender {
    Front { process: Process, input: ChildStdin },
    Mosquitto(Peer),
}

/// Measurements of one server.
#[derive(Default)]
struct Figures {
    connected_s: Vec<f64>,
    first_ms: Vec<f64>,
    warm_ms: Vec<f64>,
    cpu_us: Vec<f64>,
    anonymous_bytes: Vec<f64>,
}

pub async fn run(flags: BrokerFlags) -> anyhow::Result<Run> {
    let began = Instant::now();
    let mut run = Run::begin("broker", flags.run.seed()).await;
    allow_files(u64::from(flags.clients.iter().copied().max().unwrap_or(0)) + 200)?;
    let dir = tempfile::tempdir().context("a temporary directory")?;
    let mut progress = RunProgress::new(flags.clients.len() * flags.runs as usize);
    for &clients in &flags.clients {
        let mut figures = [Figures::default(), Figures::default()];
        for turn in 0..flags.runs {
            progress.set_message(&format!("{clients} clients"));
            for side in if turn % 2 == 0 { [0, 1] } else { [1, 0] } {
                let (sender, address) = if side == 0 {
                    start_front(&flags, dir.path()).await?
                } else {
                    let Some(peer) = Peer::mosquitto(dir.path()).await? else { continue };
                    run.versions.insert("mosquitto".to_owned(), peer.version.clone());
                    let address = peer.address;
                    (Sender::Mosquitto(peer), address)
                };
                let name = sender.name();
                measure(sender, address, clients as usize, &mut figures[side])
                    .await
                    .context(name)?;
            }
            progress.step();
        }
        let settings = || [("clients", f64::from(clients))];
        let [own, others] = figures;
        if others.warm_ms.is_empty() {
            print_line("mosquitto is not installed: the front is measured alone");
            run.notes.push("mosquitto was not installed, so there are no ratios.".to_owned());
        } else {
            run.points.push(own.ratio(&others, Point::new(RATIO, settings())));
            run.points.push(others.point(Point::new("mosquitto", settings())));
        }
        run.points.push(own.point(Point::new("taskd", settings())));
    }
    run.plots = vec![Plot {
        title: "A message of 300 bytes to every client".to_owned(),
        x: "clients".to_owned(),
        x_label: "clients".to_owned(),
        y: "time_to_last".to_owned(),
        y_label: "time to the last one".to_owned(),
        x_log: true,
        y_log: true,
        series: ["taskd", "mosquitto"].map(str::to_owned).to_vec(),
        ..Plot::default()
    }];
    for path in run.write(&flags.run.out, began)? {
        print_line(&format!("wrote {}", path.display()));
    }
    Ok(run)
}

async fn start_front(
    flags: &BrokerFlags,
    dir: &std::path::Path,
) -> anyhow::Result<(Sender, SocketAddr)> {
    let program = Program::beside("examples/front", flags.front.as_deref()).context(
        "build it with cargo build --release -p taskd --example front, or give --front PATH",
    )?;
    let (process, input, output) = program.converse(&dir.join("front.log"))?;
    let mut line = String::new();
    let mut output = BufReader::new(output);
    let reading = output.read_line(&mut line);
    tokio::time::timeout(ROUND_LIMIT, reading)
        .await
        .context("the front does not print its address")??;
    let address = line
        .trim()
        .parse()
        .with_context(|| format!("the front says {line:?} instead of its address"))?;
    Ok((Sender::Front { process, input }, address))
}

/// Connects all clients, sends to each of them again and again, and ends the server.
async fn measure(
    sender: Sender,
    address: SocketAddr,
    count: usize,
    figures: &mut Figures,
) -> anyhow::Result<()> {
    let robots: Vec<RobotId> = (0..count).map(|_| RobotId::random()).collect();
    let topics: Vec<String> = robots
        .iter()
        .map(|robot| {
            TopicPrefix::default().format(&Topic::Robot(robot.clone(), RobotTopic::Desired))
        })
        .collect();
    let begun = Instant::now();
    let clients = Clients::connect(address, &robots, &topics).await?;
    figures.connected_s.push(begun.elapsed().as_secs_f64());
    let mut publisher = Publisher::connect(sender, address, &topics).await?;
    let before = publisher.usage();
    figures.first_ms.push(clients.round(&mut publisher).await?);
    let mut warm = Vec::new();
    for _ in 0..WARM_ROUNDS {
        warm.push(clients.round(&mut publisher).await?);
    }
    let after = publisher.usage();
    warm.sort_unstable_by(f64::total_cmp);
    figures.warm_ms.push(warm[warm.len() / 2]);
    figures.cpu_us.push((after.cpu_s - before.cpu_s) * 1e6 / (count * (1 + WARM_ROUNDS)) as f64);
    figures.anonymous_bytes.push(after.anonymous_bytes as f64);
    drop(clients);
    publisher.end().await;
    Ok(())
}

/// Connected and subscribed clients, each in a task that acknowledges and counts. Dropping them
/// hangs up.
struct Clients {
    tasks: Vec<JoinHandle<()>>,
    shared: Arc<Shared>,
}

struct Shared {
    clients: usize,
    received: AtomicUsize,
    all: Notify,
    lost: AtomicU64,
}

impl Clients {
    async fn connect(
        address: SocketAddr,
        robots: &[RobotId],
        topics: &[String],
    ) -> anyhow::Result<Self> {
        let connecting =
            robots.iter().zip(topics).enumerate().map(|(number, (robot, topic))| async move {
                let credentials = Some((robot.as_str(), "any"));
                let mut link = Link::connect(
                    address,
                    number,
                    &Login { client_id: robot.as_str(), credentials },
                )
                .await?;
                link.subscribe(topic).await?;
                anyhow::Ok(link)
            });
        let links: Vec<Link> = futures_util::stream::iter(connecting)
            .buffered(CONCURRENT_CONNECTS)
            .try_collect()
            .await?;
        let shared = Arc::new(Shared {
            clients: links.len(),
            received: AtomicUsize::new(0),
            all: Notify::new(),
            lost: AtomicU64::new(0),
        });
        let tasks =
            links.into_iter().map(|link| tokio::spawn(listen(link, shared.clone()))).collect();
        Ok(Self { tasks, shared })
    }

    /// Sends one message to every client; returns the milliseconds until the last client has
    /// received its message.
    async fn round(&self, publisher: &mut Publisher) -> anyhow::Result<f64> {
        self.shared.received.store(0, Ordering::SeqCst);
        let all = self.shared.all.notified();
        tokio::pin!(all);
        all.as_mut().enable();
        let begun = Instant::now();
        publisher.send().await?;
        let arrived = tokio::time::timeout(ROUND_LIMIT, all).await;
        let received = self.shared.received.load(Ordering::SeqCst);
        ensure!(
            arrived.is_ok(),
            "{received} of {} messages came within {ROUND_LIMIT:?}",
            self.shared.clients
        );
        let lost = self.shared.lost.load(Ordering::SeqCst);
        ensure!(lost == 0, "{lost} clients lost their connection");
        Ok(begun.elapsed().as_secs_f64() * 1000.0)
    }
}

impl Drop for Clients {
    fn drop(&mut self) {
        for task in &self.tasks {
            task.abort();
        }
    }
}

async fn listen(link: Link, shared: Arc<Shared>) {
    let Link { mut reader, mut writer } = link;
    loop {
        let packet_id = match reader.next().await {
            Ok(Packet::Message { packet_id, payload }) if payload.len() == PAYLOAD_BYTES => {
                packet_id
            }
            Ok(_) => continue,
            Err(_) => break,
        };
        if shared.received.fetch_add(1, Ordering::SeqCst) + 1 == shared.clients {
            shared.all.notify_waiters();
        }
        if packet_id != 0 && writer.write_all(&acknowledgement(packet_id)).await.is_err() {
            break;
        }
    }
    shared.lost.fetch_add(1, Ordering::SeqCst);
}

/// Sends one message to every client.
struct Publisher {
    sender: Sender,
    /// For mosquitto: a connection, and all the messages. A separate task reads the answers.
    link: Option<(tokio::net::tcp::OwnedWriteHalf, Vec<u8>, JoinHandle<()>)>,
}

impl Publisher {
    async fn connect(
        sender: Sender,
        address: SocketAddr,
        topics: &[String],
    ) -> anyhow::Result<Self> {
        if let Sender::Front { .. } = sender {
            return Ok(Self { sender, link: None });
        }
        let Link { mut reader, writer } =
            Link::connect(address, 0, &Login { client_id: "publisher", credentials: None }).await?;
        let mut messages = Vec::new();
        for (number, topic) in topics.iter().enumerate() {
            let packet_id = u16::try_from(number % 65_535)? + 1;
            messages.extend(message(topic, packet_id, &[b'x'; PAYLOAD_BYTES])?);
        }
        let acknowledged = tokio::spawn(async move { while reader.next().await.is_ok() {} });
        Ok(Self { sender, link: Some((writer, messages, acknowledged)) })
    }

    async fn send(&mut self) -> anyhow::Result<()> {
        match (&mut self.sender, &mut self.link) {
            (Sender::Front { input, .. }, _) => {
                input.write_all(b"ring\n").await.context("the front does not listen")?;
                input.flush().await.context("the front does not listen")
            }
            (Sender::Mosquitto(_), Some((writer, messages, _))) => {
                writer.write_all(messages).await.context("mosquitto does not take the messages")
            }
            (Sender::Mosquitto(_), None) => Ok(()),
        }
    }

    fn usage(&self) -> Usage {
        match &self.sender {
            Sender::Front { process, .. } => process.usage(),
            Sender::Mosquitto(peer) => peer.usage(),
        }
    }

    async fn end(self) {
        if let Some((_, _, acknowledged)) = self.link {
            acknowledged.abort();
        }
        match self.sender {
            Sender::Front { process, .. } => process.end().await,
            Sender::Mosquitto(peer) => peer.end().await,
        }
    }
}

impl Sender {
    fn name(&self) -> &'static str {
        match self {
            Self::Front { .. } => "taskd",
            Self::Mosquitto(_) => "mosquitto",
        }
    }
}

impl Figures {
    fn point(self, mut point: Point) -> Point {
        point.measure("time_to_last", Unit::Milliseconds, self.warm_ms);
        point.measure("first_time_to_last", Unit::Milliseconds, self.first_ms);
        point.measure("all_subscribed", Unit::Seconds, self.connected_s);
        point.measure("server_cpu_us_per_message", Unit::Number, self.cpu_us);
        point.measure("anonymous_memory", Unit::Bytes, self.anonymous_bytes);
        point
    }

    fn ratio(&self, other: &Self, mut point: Point) -> Point {
        let of = |own: &[f64], others: &[f64]| {
            own.iter().zip(others).map(|(own, other)| own / other).collect::<Vec<_>>()
        };
        point.measure("time_to_last", Unit::Number, of(&self.warm_ms, &other.warm_ms));
        point.measure("first_time_to_last", Unit::Number, of(&self.first_ms, &other.first_ms));
        point.measure("all_subscribed", Unit::Number, of(&self.connected_s, &other.connected_s));
        point.measure("server_cpu_us_per_message", Unit::Number, of(&self.cpu_us, &other.cpu_us));
        point
    }
}
