//! Owns the HTTP edge: one table of routes, each with who may call it, and their handlers; it never
//! holds SQL and never decides what an order means.

pub mod accounts;
pub mod auth;
pub mod connection;
pub mod error;
pub mod events;
pub mod extract;
mod fleet;
mod openapi;
mod orders;
pub mod peers;
pub mod registry;
pub mod server;
pub mod shared_lists;
pub mod views;

use std::net::IpAddr;
use std::ops::Deref;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::extract::{DefaultBodyLimit, FromRef, Request};
use axum::handler::Handler;
use axum::middleware;
use axum::response::{IntoResponse, Response};
use axum::routing::{MethodFilter, MethodRouter, any, on};
use http::{HeaderValue, Method, StatusCode, header};
use task_proto::ids::selector::MAX_SELECTOR_BYTES;
use task_proto::people::roles::Permission;
use tokio_util::sync::CancellationToken;
use utoipa::OpenApi;

use self::accounts::person_sessions::PersonSessions;
use self::accounts::session::{PageCookies, PageSignIn};
use self::events::EventStreams;
use self::fleet::broker::BrokerAccounts;
use self::fleet::forward::{ForwardState, IfSilent, to_robots_server};
use self::fleet::live_robots::LiveRobots;
use self::peers::{FIGURES_PATH, Peers, SESSIONS_PATH, STATUS_PATH};
use self::registry::Registry;
use self::registry::archives::ArchiveReaders;
use self::registry::upload::UploadSpace;
use self::server::gauges::Gauges;
use self::server::node_drain::NodeDrain;
use self::server::readiness::Readiness;
use self::server::server_facts::ServerFacts;
use self::shared_lists::SharedLists;
use self::views::Views;
use crate::auth::oidc::Provider;
use crate::blobs::Blobs;
use crate::broker::Broker;
use crate::domain::limits::robot_limiter::RobotLimiter;
use crate::fleet::live_nodes::LiveNodes;
use crate::fleet::presence::Presence;
use crate::fleet::requests::Requests;
use crate::fleet::robot_logs::RobotLogs;
use crate::fleet::robot_vitals::RobotVitals;
use crate::link::mqtt_access::MqttAccess;
use crate::link::transfers::Transfers;
use crate::net::http_connections::HttpConnections;
use crate::orders::actions::{
    Actions, DeploymentActions, NodeActions, PersonActions, RobotActions,
};
use crate::orders::changes::Changes;
use crate::orders::desired_states::DesiredStates;
use crate::orders::report_writer::ReportWriter;
use crate::store::Store;
use crate::system::clock::Clock;
use accounts::{oidc, people, session};
use auth::{Access, GuardState, guard};
use error::ApiError;
use fleet::{ask, broker, bulk, enroll, feed, history, logs, mqtt, outputs, robots, vitals};
use openapi::{Describe as _, Draft};
use orders::{deployments, tasks};
use registry::{archives, oci, packages, upload};
use server::{health, nodes, status, web};

/// State for the handlers. Clones share the same parts: a request makes several clones on its way.
#[derive(Clone)]
pub struct App(Arc<AppParts>);

/// The parts of an [`App`].
pub struct AppParts {
    pub clock: Clock,
    pub store: Store,
    pub actions: Actions,
    pub desired_states: DesiredStates,
    pub changes: Changes,
    /// The writer that stores reports.
    pub reports: ReportWriter,
    /// Presence of the robots.
    pub presence: Arc<Presence>,
    pub broker: Broker,
    /// Requests to robots that are under way.
    pub requests: Requests,
    /// The latest log lines of robots, and their followers.
    pub logs: RobotLogs,
    /// Vitals of the robots' machines.
    pub vitals: RobotVitals,
    /// The blob store with the packages' bytes.
    pub blobs: Blobs,
    /// Scheduler of package transfers.
    pub transfers: Transfers,
    /// Workspace in which uploaded directories are packed.
    pub uploads: UploadSpace,
    /// Readers of whole archives.
    pub readers: ArchiveReaders,
    /// The form of the page's cookies.
    pub cookies: PageCookies,
    /// Robots' HTTP requests under way.
    pub http_connections: Arc<HttpConnections>,
    /// Rate-limit state of the robots.
    pub robot_limiter: Arc<RobotLimiter>,
    /// The OpenID provider, if one is configured.
    pub provider: Option<Arc<Provider>>,
    /// Request limits per person.
    pub people: Arc<auth::person_limits::PersonLimits>,
    /// Failed authentications by address.
    pub attempts: Arc<auth::attempts::FailedAttempts>,
    /// Facts that are fixed while the server runs.
    pub facts: Arc<ServerFacts>,
    /// Cached figures that are slow to compute.
    pub slow_figures: Arc<server::gauges::SlowFigures>,
    /// Long lists being rendered.
    pub lists: Arc<SharedLists>,
    /// The source of the event stream.
    pub events: events::EventFeed,
    /// Robots' MQTT address and password.
    pub mqtt: Arc<MqttAccess>,
    /// The addresses of reverse proxies with a trusted `X-Forwarded-For`.
    pub trusted_proxies: Arc<[IpAddr]>,
    pub http_traffic: Arc<connection::traffic::HttpTotals>,
    pub data: PathBuf,
    /// Health of the server's components.
    pub readiness: Readiness,
    /// The live servers of the cluster.
    pub nodes: LiveNodes,
    /// The way out of service.
    pub drain: NodeDrain,
    /// The other servers of the cluster.
    pub peers: Peers,
    /// Cancelled when the server stops.
    pub stop: CancellationToken,
}

impl App {
    /// Builds the state from these parts.
    pub fn new(parts: AppParts) -> Self {
        Self(Arc::new(parts))
    }
}

impl Deref for App {
    type Target = AppParts;

    fn deref(&self) -> &AppParts {
        &self.0
    }
}

/// The parts that handlers name in place of the whole state, as in `State<Store>`.
macro_rules! parts {
    ($($field:ident $(.$inner:ident)?: $part:ty),* $(,)?) => { $(
        impl FromRef<App> for $part {
            fn from_ref(app: &App) -> Self {
                app.$field$(.$inner)?.clone()
            }
        }
    )* };
}

parts! {
    actions.deployments: DeploymentActions,
    actions.nodes: NodeActions,
    actions.people: PersonActions,
    actions.robots: RobotActions,
    broker: Broker,
    clock: Clock,
    desired_states: DesiredStates,
    drain: NodeDrain,
    facts: Arc<ServerFacts>,
    lists: Arc<SharedLists>,
    mqtt: Arc<MqttAccess>,
    nodes: LiveNodes,
    peers: Peers,
    readiness: Readiness,
    reports: ReportWriter,
    stop: CancellationToken,
    store: Store,
    uploads: UploadSpace,
    vitals: RobotVitals,
}

/// Parts that consist of several fields of the state, which handlers always use together.
macro_rules! composite_parts {
    ($($part:ident { $($field:ident),* $(,)? })*) => { $(
        impl FromRef<App> for $part {
            fn from_ref(app: &App) -> Self {
                Self { $($field: app.$field.clone()),* }
            }
        }
    )* };
}

composite_parts! {
    BrokerAccounts { mqtt, store }
    EventStreams { changes, clock, events, stop, store }
    Gauges {
        blobs, broker, clock, data, facts, http_traffic, nodes, peers, presence, readiness, reports,
        robot_limiter, slow_figures, store, transfers,
    }
    LiveRobots {
        broker, changes, clock, desired_states, http_connections, logs, peers, presence, requests,
        vitals,
    }
    PageSignIn { changes, clock, cookies, provider, store }
    PersonSessions { broker, changes }
    Registry { blobs, changes, clock, peers, readers, store, transfers }
    Views { clock, peers, presence, robot_limiter, store, vitals }
}

/// The body limit of most routes, in bytes.
const SMALL_BODY_BYTES: usize = 64 * 1024;
/// The body limit of orders, in bytes: an order has one selector.
const ORDER_BODY_BYTES: usize = MAX_SELECTOR_BYTES + SMALL_BODY_BYTES;
/// The largest report, in bytes.
pub const REPORT_BODY_BYTES: usize = task_proto::messages::report::MAX_REPORT_BYTES;
/// Time limit from a request's head to its answer.
const DEADLINE: Duration = Duration::from_secs(30);

/// One route: its method and path, its access and its limits.
pub struct Route {
    /// The method; GET answers HEAD as well. `None`: the handler checks the method itself.
    pub method: Option<Method>,
    /// The path, with `{parameters}`.
    pub path: &'static str,
    /// The callers that the route admits.
    pub access: Access,
    body_bytes: usize,
    deadline: Option<Duration>,
    waits_for_robot: bool,
    /// Set if the server with the robot's session answers.
    forwarded: Option<IfSilent>,
    handler: MethodRouter<App>,
    describe: fn(&mut Draft),
}

impl Route {
    /// A route of the API, with a small body and the common deadline.
    #[expect(clippy::expect_used, reason = "the table is fixed, and a test builds it")]
    fn new<H, T>(
        method: Method,
        path: &'static str,
        access: Access,
        handler: H,
        describe: fn(&mut Draft),
    ) -> Self
    where
        H: Handler<T, App>,
        T: 'static,
    {
        let filter = MethodFilter::try_from(method.clone()).expect("a method that axum routes");
        let (body_bytes, deadline) = (SMALL_BODY_BYTES, Some(DEADLINE));
        let (waits_for_robot, handler) = (false, on(filter, handler));
        Self {
            method: Some(method),
            path,
            access,
            body_bytes,
            deadline,
            waits_for_robot,
            forwarded: None,
            handler,
            describe,
        }
    }

    /// A question of another server of the cluster, which is not part of the API.
    fn peer<H, T>(path: &'static str, handler: H) -> Self
    where
        H: Handler<T, App>,
        T: 'static,
    {
        Self::new(Method::POST, path, Access::Peer, handler, |_| {})
    }

    /// A route for every method. The handler streams and enforces its own limits.
    fn any<H, T>(path: &'static str, access: Access, handler: H, describe: fn(&mut Draft)) -> Self
    where
        H: Handler<T, App>,
        T: 'static,
    {
        let (body_bytes, waits_for_robot, handler) = (usize::MAX, false, any(handler));
        Self {
            method: None,
            path,
            access,
            body_bytes,
            deadline: None,
            waits_for_robot,
            forwarded: None,
            handler,
            describe,
        }
    }

    fn body_bytes(self, body_bytes: usize) -> Self {
        Self { body_bytes, ..self }
    }

    /// Sets a deadline for this route.
    fn within(self, deadline: Duration) -> Self {
        Self { deadline: Some(deadline), ..self }
    }

    /// Marks a route that waits for a robot's answer. Its requests are counted apart from the
    /// person's other requests under way.
    fn waiting_for_robot(self) -> Self {
        Self { waits_for_robot: true, ..self }
    }

    /// Marks a route about a robot that is answered by the server with the robot's session.
    fn by_robots_server(self, if_silent: IfSilent) -> Self {
        Self { forwarded: Some(if_silent), ..self }
    }

    /// Removes the deadline, for a streamed answer.
    fn streaming(self) -> Self {
        Self { deadline: None, ..self }
    }
}

/// A route and its OpenAPI description, taken from the handler's attribute and types.
macro_rules! route {
    (any $path:literal, $access:expr, $module:ident::$handler:ident) => {
        Route::any($path, $access, $module::$handler, route!(describe $module::$handler))
    };
    (describe $module:ident::$handler:ident) => {
        |draft| {
            #[derive(OpenApi)]
            #[openapi(paths($module::$handler))]
            struct Attribute;
            draft.begin(concat!(stringify!($module), "_", stringify!($handler)), Attribute::openapi());
            $module::$handler.describe(draft);
        }
    };
    ($method:ident $path:literal, $access:expr, $module:ident::$handler:ident) => {
        Route::new(Method::$method, $path, $access, $module::$handler, route!(describe $module::$handler))
    };
}

/// Every route, with its access. The server serves no other path.
pub fn routes() -> Vec<Route> {
    use Access::{Anyone, Enrollment, OwnRobot, Person};
    use Permission::{Administer, Maintain, Read};
    let mut routes = vec![
        route!(GET "/healthz", Anyone, health::healthz),
        route!(GET "/readyz", Anyone, health::readyz),
        route!(GET "/api/v1/server", Person(Read), health::server),
        route!(GET "/api/v1/server/status", Person(Read), status::status),
        route!(GET "/api/v1/server/sessions", Person(Read), status::sessions),
        route!(GET "/api/v1/server/rules", Person(Read), status::rules),
        route!(GET "/api/v1/cluster/nodes", Person(Read), nodes::list),
        route!(POST "/api/v1/cluster/nodes/{node}/drain", Person(Administer), nodes::drain),
        route!(GET "/api/v1/broker", Person(Administer), broker::files),
        route!(GET "/api/v1/broker/nats", Person(Administer), broker::nats_file),
        route!(GET "/api/v1/broker/check", Person(Administer), broker::check),
        route!(GET "/api/v1/session", Anyone, session::show),
        route!(POST "/api/v1/session", Anyone, session::sign_in),
        route!(DELETE "/api/v1/session", Person(Read), session::sign_out),
        route!(GET "/api/v1/oidc/sign-in", Anyone, oidc::begin),
        route!(GET "/api/v1/oidc/callback", Anyone, oidc::finish),
        route!(POST "/api/v1/login", Anyone, people::log_in),
        route!(GET "/api/v1/me", Person(Read), people::me),
        route!(PUT "/api/v1/password", Person(Read), people::change_password),
        route!(GET "/api/v1/users", Person(Administer), people::users),
        route!(POST "/api/v1/users", Person(Administer), people::add_user),
        route!(PATCH "/api/v1/users/{user}", Person(Administer), people::edit_user),
        route!(DELETE "/api/v1/users/{user}", Person(Administer), people::remove_user),
        route!(PUT "/api/v1/users/{user}/password", Person(Administer), people::set_password),
        route!(GET "/api/v1/tokens", Person(Read), people::tokens),
        route!(POST "/api/v1/tokens", Person(Read), people::create_token),
        route!(DELETE "/api/v1/tokens/{token}", Person(Read), people::revoke_token),
        route!(GET "/api/v1/audit", Person(Administer), people::audit),
        route!(POST "/api/v1/enroll", Enrollment, enroll::enroll),
        route!(GET "/api/v1/enrollment-tokens", Person(Administer), enroll::tokens),
        route!(POST "/api/v1/enrollment-tokens", Person(Administer), enroll::create_token),
        route!(DELETE "/api/v1/enrollment-tokens/{enrollment}", Person(Administer), enroll::revoke_token),
        route!(GET "/api/v1/robots", Person(Read), robots::list),
        route!(GET "/api/v1/robots/{robot}", Person(Read), robots::show)
            .by_robots_server(IfSilent::AnswerHere),
        route!(PATCH "/api/v1/robots/{robot}", Person(Maintain), robots::edit),
        route!(DELETE "/api/v1/robots/{robot}", Person(Maintain), robots::remove),
        route!(POST "/api/v1/bulk/labels", Person(Maintain), bulk::labels)
            .body_bytes(ORDER_BODY_BYTES),
        route!(POST "/api/v1/bulk/remove", Person(Maintain), bulk::remove)
            .body_bytes(ORDER_BODY_BYTES),
        route!(GET "/api/v1/pending-robots", Person(Administer), enroll::pending),
        route!(POST "/api/v1/robots/{robot}/approve", Person(Administer), enroll::approve),
        route!(POST "/api/v1/robots/{robot}/reject", Person(Administer), enroll::reject),
        route!(POST "/api/v1/robots/{robot}/revoke", Person(Maintain), robots::revoke),
        route!(GET "/api/v1/robots/{robot}/desired", OwnRobot, robots::desired),
        route!(GET "/api/v1/robots/{robot}/mqtt", OwnRobot, broker::endpoint),
        route!(POST "/api/v1/robots/{robot}/token", OwnRobot, robots::next_token),
        route!(POST "/api/v1/robots/{robot}/report", OwnRobot, robots::report)
            .body_bytes(REPORT_BODY_BYTES),
        route!(POST "/api/v1/robots/{robot}/telemetry", OwnRobot, vitals::telemetry),
        route!(GET "/api/v1/robots/{robot}/tasks", Person(Read), history::tasks),
        route!(GET "/api/v1/robots/{robot}/vitals", Person(Read), vitals::show)
            .by_robots_server(IfSilent::AnswerHere),
        route!(POST "/api/v1/robots/{robot}/ask", Person(Read), ask::ask)
            .waiting_for_robot()
            .by_robots_server(IfSilent::Refuse),
        route!(GET "/api/v1/robots/{robot}/logs", Person(Read), logs::show)
            .streaming()
            .by_robots_server(IfSilent::AnswerHere),
        Route::peer(STATUS_PATH, server::peers::status),
        Route::peer(SESSIONS_PATH, server::peers::sessions),
        Route::peer(FIGURES_PATH, server::peers::figures),
    ];
    routes.extend(order_routes());
    routes
}

/// Routes for orders on robots, and for callers other than people and the page.
fn order_routes() -> Vec<Route> {
    use Access::{Anyone, Person, PersonOrRobot};
    use Permission::{Operate, Publish, Read};
    vec![
        route!(GET "/api/v1/packages", Person(Read), packages::list),
        route!(POST "/api/v1/packages", Person(Publish), upload::package).streaming(),
        route!(GET "/api/v1/packages/{package}", Person(Read), packages::show),
        route!(GET "/api/v1/packages/{package}/diff", Person(Read), packages::diff)
            .within(archives::READ_TIMEOUT),
        route!(GET "/api/v1/packages/{package}/{version}/files", Person(Read), packages::files)
            .within(archives::READ_TIMEOUT),
        route!(DELETE "/api/v1/packages/{package}/{version}", Person(Publish), packages::remove),
        route!(GET "/api/v1/outputs", Person(Read), outputs::list),
        route!(GET "/api/v1/deployments", Person(Read), deployments::list),
        route!(POST "/api/v1/deployments", Person(Operate), deployments::create)
            .body_bytes(ORDER_BODY_BYTES),
        route!(GET "/api/v1/deployments/{deployment}", Person(Read), deployments::show),
        route!(POST "/api/v1/deployments/{deployment}/cancel", Person(Operate), deployments::cancel),
        route!(POST "/api/v1/deployments/{deployment}/resume", Person(Operate), deployments::resume),
        route!(POST "/api/v1/deployments/{deployment}/retry", Person(Operate), deployments::retry)
            .body_bytes(ORDER_BODY_BYTES),
        route!(POST "/api/v1/tasks/{task}/start", Person(Operate), tasks::start)
            .body_bytes(ORDER_BODY_BYTES),
        route!(POST "/api/v1/tasks/{task}/restart", Person(Operate), tasks::restart)
            .body_bytes(ORDER_BODY_BYTES),
        route!(POST "/api/v1/tasks/{task}/rollback", Person(Operate), tasks::rollback)
            .body_bytes(ORDER_BODY_BYTES),
        route!(POST "/api/v1/tasks/{task}/stop", Person(Operate), tasks::stop)
            .body_bytes(ORDER_BODY_BYTES),
        route!(POST "/api/v1/tasks/{task}/remove", Person(Operate), tasks::remove)
            .body_bytes(ORDER_BODY_BYTES),
        route!(GET "/api/v1/feed", Person(Read), feed::feed),
        route!(GET "/api/v1/events", Person(Read), events::stream).streaming(),
        route!(GET "/api/openapi.json", Anyone, openapi::show),
        route!(GET "/api/docs", Anyone, web::docs),
        route!(GET "/mqtt", Anyone, mqtt::upgrade),
        route!(GET "/", Anyone, web::index),
        route!(GET "/ui/{*file}", Anyone, web::file),
        route!(any "/v2", PersonOrRobot, oci::version),
        route!(any "/v2/", PersonOrRobot, oci::version),
        route!(any "/v2/{*path}", PersonOrRobot, oci::dispatch),
    ]
}

/// All routes behind their guards.
pub fn router(app: App) -> Router {
    let (mut router, trusted) = (Router::new(), app.trusted_proxies.clone());
    for route in routes() {
        let Route { access, deadline, waits_for_robot, .. } = route;
        let state = GuardState { app: app.clone(), access, deadline, waits_for_robot };
        let guard = middleware::from_fn_with_state(state, guard);
        let limit = DefaultBodyLimit::max(route.body_bytes);
        let forward = |handler: MethodRouter<App>| match route.forwarded {
            Some(if_silent) => {
                let (app, body_bytes) = (app.clone(), route.body_bytes);
                let state = ForwardState { app, if_silent, body_bytes };
                handler.route_layer(middleware::from_fn_with_state(state, to_robots_server))
            }
            None => handler,
        };
        let handler = match route.method {
            // The guard is not needed before the "method not allowed" answer.
            Some(_) => forward(route.handler.route_layer(limit)).route_layer(guard),
            None => route.handler.layer(limit).layer(guard),
        };
        router = router.route(route.path, handler);
    }
    let router = router
        .fallback(path_not_found)
        .method_not_allowed_fallback(method_not_allowed)
        .layer(middleware::map_response(harden))
        .layer(middleware::map_request(connection::drain::drain_unread));
    // Without trusted proxies we skip this layer, so that requests pay nothing.
    let router = match trusted.is_empty() {
        true => router,
        false => router.layer(middleware::map_request_with_state(
            trusted,
            connection::proxy::resolve_client_address,
        )),
    };
    router.with_state(app)
}

async fn path_not_found() -> ApiError {
    ApiError::not_found("there is nothing at this path")
}

async fn method_not_allowed(request: Request) -> Response {
    let message = format!("{} is not allowed at this path", request.method());
    ApiError::new(StatusCode::METHOD_NOT_ALLOWED, "method_not_allowed", message).into_response()
}

/// Content security policy of every answer that is not the page: browsers may load and run nothing.
const ANSWER_POLICY: &str =
    "default-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'; sandbox";

/// Security headers for browsers: no framing, no content sniffing, no access for other pages.
async fn harden(mut response: Response) -> Response {
    const HEADERS: [(header::HeaderName, &str); 5] = [
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::X_FRAME_OPTIONS, "DENY"),
        (header::REFERRER_POLICY, "no-referrer"),
        (header::HeaderName::from_static("cross-origin-opener-policy"), "same-origin"),
        (header::HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
    ];
    let headers = response.headers_mut();
    for (name, value) in HEADERS {
        headers.insert(name, HeaderValue::from_static(value));
    }
    headers
        .entry(header::CONTENT_SECURITY_POLICY)
        .or_insert(HeaderValue::from_static(ANSWER_POLICY));
    headers.entry(header::CACHE_CONTROL).or_insert(HeaderValue::from_static("no-store"));
    response
}
