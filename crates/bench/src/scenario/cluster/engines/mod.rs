//! Owns the engines of a run: the servers under measurement, their database, their store of
//! packages and the balancers in front; it never measures.

mod addresses;
mod balancer;
mod node;
mod objects;
mod postgres;
mod relay;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::Context as _;
use tempfile::TempDir;

use self::addresses::{Addresses, with_hosts};
use self::balancer::Balancer;
pub use self::node::Node;
use self::objects::Objects;
use self::postgres::Postgres;
use self::relay::Relay;
use crate::programs::server::Server;
use crate::programs::taskd::TaskdFlags;
use crate::simulated::fleet::{Fleet, FleetArgs};
use crate::system::process::Program;

/// Balancers in front of the servers: each carries some 9,000 sessions.
const BALANCERS: usize = 3;
/// As the agent's own default.
const POLL: std::time::Duration = std::time::Duration::from_secs(300);
/// After this time the collector deletes unneeded blobs, also while packages are pushed.
const BLOB_GRACE: &str = "20s";
/// Limits that a fleet at one address would meet, unlike a real one.
const NO_LIMIT: &str = "1000000";

/// The engines that a run needs.
#[derive(Debug, Clone)]
pub struct EngineArgs<'a> {
    pub taskd: &'a TaskdFlags,
    pub nodes: usize,
    /// Whether HAProxy is used, where it is installed.
    pub balanced: bool,
    /// Whether the database has a synchronous standby.
    pub standby: bool,
    /// Whether the servers reach the database through relays.
    pub relayed: bool,
    /// Whether the servers notify each other.
    pub bus: bool,
    pub versitygw: Option<&'a Path>,
}

/// The running engines. Dropping them kills all processes.
pub struct Engines {
    pub nodes: Vec<Node>,
    /// The API of each node, as the operator.
    pub servers: Vec<Arc<Server>>,
    pub balancers: Vec<Balancer>,
    pub objects: Objects,
    /// The relays of each node to the database, if it has any.
    pub relays: Vec<Vec<Relay>>,
    pub primary: Postgres,
    pub standby: Option<Postgres>,
    /// URLs of the database for the run itself.
    pub database: Vec<String>,
    pub version: String,
    addresses: Addresses,
    taskd: Program,
    directory: TempDir,
}

impl Engines {
    /// Starts all engines, and waits until each server is ready.
    pub async fn start(args: &EngineArgs<'_>) -> anyhow::Result<Self> {
        let mut builder = tempfile::Builder::new();
        builder.prefix("taskbench-");
        let directory = match &args.taskd.data {
            Some(dir) => {
                builder.tempdir_in(dir).with_context(|| format!("--data {}", dir.display()))?
            }
            None => builder.tempdir().context("a temporary directory")?,
        };
        // The database's account has to pass.
        permit(directory.path(), 0o711)?;
        let postgres = directory.path().join("postgres");
        std::fs::create_dir(&postgres).context("the database's directory")?;
        let primary = Postgres::primary(&postgres).await.context("the database")?;
        let standby = match args.standby {
            true => Some(primary.standby().await.context("the database's standby")?),
            false => None,
        };
        let objects = match args.versitygw {
            Some(program) => {
                let gateways = Objects::gateways(program, directory.path()).await;
                gateways.with_context(|| format!("--versitygw {}", program.display()))?
            }
            None => Objects::directory(directory.path())?,
        };
        let ports = [Some(primary.port), standby.as_ref().map(|standby| standby.port)];
        let ports: Vec<u16> = ports.into_iter().flatten().collect();
        let mut engines = Self {
            nodes: Vec::new(),
            servers: Vec::new(),
            balancers: Vec::new(),
            objects,
            relays: Vec::new(),
            primary,
            standby,
            database: ports.iter().map(|port| Postgres::url_at(*port)).collect(),
            version: String::new(),
            addresses: Addresses::choose()?,
            taskd: Program::beside("taskd", args.taskd.taskd.as_deref())?,
            directory,
        };
        engines.start_nodes(args, &ports).await?;
        engines.start_balancers(args).await?;
        Ok(engines)
    }

    async fn start_nodes(&mut self, args: &EngineArgs<'_>, ports: &[u16]) -> anyhow::Result<()> {
        for number in 0..args.nodes {
            let mut own_ports = ports.to_vec();
            let mut relays = Vec::new();
            if args.relayed {
                for port in &mut own_ports {
                    let relay = Relay::start(vec![([127, 0, 0, 1], *port).into()]).await?;
                    *port = relay.port;
                    relays.push(relay);
                }
            }
            self.relays.push(relays);
            let node = self.node(args, number, &own_ports);
            self.nodes.push(node);
        }
        // The first server makes the keys of all.
        for number in 0..self.nodes.len() {
            let (first, others) = self.nodes.split_first_mut().context("no servers")?;
            if number > 0 {
                others[number - 1].copy_keys(first)?;
            }
            self.nodes[number].start()?;
            let server = self.nodes[number].wait_ready().await?;
            self.servers.push(server);
        }
        let first = self.servers.first().context("no servers")?;
        self.version = first.info().await?.version;
        Ok(())
    }

    fn node(&self, args: &EngineArgs<'_>, number: usize, ports: &[u16]) -> Node {
        let name = format!("node-{}", number + 1);
        // The name shows the server of a database session that holds a lock.
        let url = |port: &u16| format!("{}?application_name={name}", Postgres::url_at(*port));
        let database: Vec<String> = ports.iter().map(url).collect();
        let address = self.addresses.node(number);
        let (http, mqtt) = (self.addresses.http(address), self.addresses.mqtt(address));
        let proxies = (0..BALANCERS).map(|number| self.addresses.balancer(number).to_string());
        let settings = [
            ("TASKD_DATABASE", database.join(",")),
            ("TASKD_BLOBS_STORE", self.objects.url.clone()),
            ("TASKD_CLUSTER_BUS", if args.bus { "postgres" } else { "off" }.to_owned()),
            ("TASKD_PROXIES", proxies.collect::<Vec<_>>().join(",")),
            ("TASKD_PUBLIC_MQTT_PORT", mqtt.port().to_string()),
            ("TASKD_BLOB_GRACE", BLOB_GRACE.to_owned()),
            ("TASKD_ENROLMENT_PER_MINUTE", NO_LIMIT.to_owned()),
            ("TASKD_MAX_SILENT_PER_ADDRESS", NO_LIMIT.to_owned()),
        ];
        let directory = self.directory.path().join(&name);
        Node::new(self.taskd.clone(), &name, directory, (http, mqtt), &settings)
    }

    async fn start_balancers(&mut self, args: &EngineArgs<'_>) -> anyhow::Result<()> {
        let Some(program) = Balancer::program().filter(|_| args.balanced) else { return Ok(()) };
        for number in 0..BALANCERS {
            let directory = self.directory.path();
            let balancer =
                Balancer::start(&program, directory, number, &self.addresses, &self.nodes).await;
            self.balancers.push(balancer.context("HAProxy")?);
        }
        Ok(())
    }

    /// Robots that connect to the balancers or, without balancers, to the servers themselves.
    pub async fn fleet(&self, robots: usize) -> anyhow::Result<Fleet> {
        let entrances: Vec<_> = match self.balancers.len() {
            0 => (0..self.nodes.len()).map(|number| self.addresses.node(number)).collect(),
            count => (0..count).map(|number| self.addresses.balancer(number)).collect(),
        };
        let (entrances, hosts) = self.addresses.entrances(&entrances);
        let file = self.directory.path().join("hosts");
        std::fs::write(&file, hosts).context("the robots' hosts file")?;
        let outer = Some(with_hosts(&file));
        Fleet::assemble_with(FleetArgs {
            server: self.servers.first().context("no servers")?,
            pin: None,
            entrances,
            robots,
            poll: POLL,
            own_addresses: true,
            outer,
            logged: true,
        })
        .await
        .context("the robots (they need namespaces: run as root, or allow user namespaces)")
    }

    /// Runs `taskd audit verify` against a server.
    pub async fn verify_audit(&self) -> anyhow::Result<()> {
        let node = self.nodes.first().context("no servers")?;
        let verify = self.taskd.clone().args(["audit", "--verify"]);
        let verify = verify.variable("TASKD_SERVER", &format!("http://{}", node.http));
        let verify = verify.variable("TASKD_TOKEN", &node.token()?.reveal());
        verify.output().await?;
        Ok(())
    }

    /// The directory with the objects of the store of packages.
    pub fn packages(&self) -> PathBuf {
        self.objects.directory.clone()
    }

    /// Ends all engines and removes their data.
    pub async fn end(self) -> anyhow::Result<()> {
        let Self { nodes, balancers, objects, primary, standby, relays, directory, .. } = self;
        drop(balancers);
        for mut node in nodes {
            node.end().await;
        }
        drop(relays);
        if let Some(standby) = standby {
            standby.end().await;
        }
        primary.end().await;
        drop(objects);
        directory.close().context("the servers' directory can't be removed")
    }
}

fn permit(path: &Path, mode: u32) -> anyhow::Result<()> {
    use std::os::unix::fs::PermissionsExt as _;
    let permissions = std::fs::Permissions::from_mode(mode);
    std::fs::set_permissions(path, permissions).context("the directory's mode")
}
