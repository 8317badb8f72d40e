//! Admits a client: the TLS handshake if there is one, then one CONNECT, which is checked and then
//! admitted or refused with the right CONNACK. Until then a client gets little memory and little
//! time. This module never builds a session.

mod connection_limit;
mod other_protocol;

use std::io;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use bytes::BytesMut;
use rumqttd::protocol::{ConnAck, ConnectReturnCode, Packet};
use subtle::ConstantTimeEq;
use task_proto::RobotId;
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::sync::OwnedSemaphorePermit;
use tokio::time::{timeout, timeout_at};

pub(super) use self::connection_limit::{ConnectionLimit, PendingPermit};
pub(super) use self::other_protocol::OtherProtocols;
use super::Context;
use super::access::{Client, may_publish};
use super::codec::{Connect, DecodeError, Received, Will, decode, encode};
use super::slots::SlotKey;
use crate::broker::{Login, Principal, Refusal};
use crate::domain::limits::robot_limiter::{Channel, RobotChannel, SESSION_COST, Verdict};
use crate::net::tls::ClientProof;
use crate::net::unauthenticated::UnauthenticatedConnection;

/// Maximum size of CONNECT, in bytes after the fixed header.
const MAX_CONNECT_BYTES: usize = 4 * 1024;
/// Maximum length of an operator's client id.
const MAX_CLIENT_ID_BYTES: usize = 256;
/// The watchdog's client id.
pub(in crate::broker) const CANARY_ID: &str = "router canary";

pub(super) struct AuthenticatedClient {
    pub(super) client: Client,
    pub(super) slot_key: SlotKey,
    pub(super) keep_alive: Option<Duration>,
    pub(super) will: Option<Will>,
    /// Bytes that the client sent after CONNECT without waiting for the answer.
    pub(super) input: BytesMut,
    /// The rate limits, if the client is a robot.
    pub(super) rate_limit: Option<RobotChannel>,
    login: Login,
    /// How often robots had been evicted before the gatekeeper was asked.
    evictions: u64,
}

impl AuthenticatedClient {
    /// Asks the gatekeeper again, now that the client has a slot. If its rights ended before it had
    /// the slot, the eviction could not reach it. For robots this happens only if one was
    /// evicted meanwhile, because robots connect in thousands.
    pub(super) async fn recheck(&self, context: &Context) -> Result<(), Rejection> {
        let before = match &self.client {
            Client::Operator(user) => Principal::Operator(user.clone()),
            Client::Robot { robot, token_number }
                if context.slots.evictions() != self.evictions =>
            {
                Principal::Robot {
                    robot: robot.clone(),
                    token_number: *token_number,
                    is_first_use: false,
                }
            }
            Client::Robot { .. } | Client::Canary => return Ok(()),
        };
        let asked = context.gatekeeper.admit(self.login.clone());
        match timeout(context.limits.admit_timeout, asked).await {
            Ok(Ok(again)) if again == before => Ok(()),
            _ => Err(answer(
                ConnectReturnCode::NotAuthorized,
                "credentials that were revoked meanwhile",
            )),
        }
    }
}

/// A connection whose client has not identified itself.
pub(super) struct PendingConnection {
    pub(super) peer: SocketAddr,
    /// The proof from the TLS handshake.
    pub(super) proof: ClientProof,
    /// The deadline for identifying itself.
    deadline: tokio::time::Instant,
    registration: UnauthenticatedConnection,
}

/// The reason why a client is not admitted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub(super) enum Rejection {
    /// No answer is possible: the client disconnected, was too slow, or does not speak MQTT.
    #[error("{0}")]
    Silent(&'static str),
    #[error(transparent)]
    Malformed(DecodeError),
    /// Answered with a CONNACK.
    #[error("{reason}")]
    Answered { code: ConnectReturnCode, reason: &'static str },
}

impl PendingConnection {
    pub(super) fn new(context: &Context, peer: SocketAddr) -> Self {
        let deadline = tokio::time::Instant::now() + context.limits.connect_timeout;
        Self {
            peer,
            proof: ClientProof::NotRequested,
            deadline,
            registration: context.unauthenticated.add(peer.ip(), Instant::now()),
        }
    }

    /// Waits for the client's next step, until the deadline.
    pub(super) async fn step<T>(
        &self,
        late: &'static str,
        step: impl Future<Output = Result<T, Rejection>>,
    ) -> Result<T, Rejection> {
        tokio::select! {
            done = timeout_at(self.deadline, step) => done.unwrap_or(Err(Rejection::Silent(late))),
            () = self.registration.evicted().cancelled() => Err(Rejection::Silent("evicted before authentication, to admit a newer connection")),
        }
    }

    /// Waits for a connection to close in favour of this one, if that is necessary.
    pub(super) async fn acquire_permit(
        &self,
        permit: PendingPermit,
    ) -> Result<OwnedSemaphorePermit, Rejection> {
        const NO_PERMIT: &str = "the connection limit is reached";
        let permit = async { permit.permit().await.ok_or(Rejection::Silent(NO_PERMIT)) };
        self.step(NO_PERMIT, permit).await
    }

    /// The TLS handshake of a client, if TLS is required.
    pub(super) async fn handshake<S>(
        &self,
        handshake: impl Future<Output = io::Result<S>>,
    ) -> Result<S, Rejection> {
        let handshake =
            async { handshake.await.map_err(|_| Rejection::Silent("the TLS handshake failed")) };
        self.step("the TLS handshake timed out", handshake).await
    }
}

/// The watchdog's password: valid for one login, then replaced.
#[derive(Default)]
pub(in crate::broker) struct CanaryPass(Mutex<Option<String>>);

impl CanaryPass {
    /// Replaces the password by a new one.
    pub(in crate::broker) fn renew(&self) -> String {
        let secret = format!("{:032x}", rand::random::<u128>());
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = Some(secret.clone());
        secret
    }

    /// Whether `password` is the valid one; if so it is used up.
    fn redeem(&self, password: &str) -> bool {
        let mut secret = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let good = secret
            .as_ref()
            .is_some_and(|secret| secret.as_bytes().ct_eq(password.as_bytes()).into());
        if good {
            *secret = None;
        }
        good
    }
}

/// Reads CONNECT and determines the client's identity.
pub(super) async fn authenticate<S>(
    context: &Arc<Context>,
    stream: &mut S,
    pending: PendingConnection,
) -> Result<AuthenticatedClient, Rejection>
where
    S: AsyncRead + AsyncWrite + Unpin,
{
    let mut input = BytesMut::new();
    let connect = pending.step("no CONNECT in time", read_connect(stream, &mut input)).await?;
    let (peer, proof) = (pending.peer, pending.proof.clone());
    drop(pending);
    if connect.client_id.is_empty() && !connect.clean_session {
        return Err(answer(
            ConnectReturnCode::ClientIdentifierNotValid,
            "an empty client id without a clean session",
        ));
    }
    let login = Login {
        client_id: connect.client_id.clone(),
        user_name: connect.user_name.clone(),
        password: connect.password.clone(),
        peer,
        proof,
    };
    let evictions = context.slots.evictions();
    let client = admit(context, &connect, login.clone()).await?;
    if let Some(will) = &connect.will
        && may_publish(&client, &context.prefix, &will.topic).is_none()
    {
        return Err(answer(
            ConnectReturnCode::NotAuthorized,
            "a will on a topic that the client may not publish to",
        ));
    }
    let rate_limit = match &client {
        Client::Robot { robot, .. } => Some(open_channel(context, robot)?),
        Client::Operator(_) | Client::Canary => None,
    };
    let slot_key = match &client {
        Client::Robot { robot, .. } => SlotKey::Robot(robot.clone()),
        Client::Canary => SlotKey::Canary,
        Client::Operator(user) if connect.client_id.is_empty() => {
            SlotKey::Unnamed(user.clone(), rand::random())
        }
        Client::Operator(user) => SlotKey::Operator(user.clone(), connect.client_id.clone()),
    };
    // 3.1.2.10: one and a half times the client's keepalive.
    let keep_alive = match connect.keep_alive_s {
        0 => None,
        seconds => Some(Duration::from_millis(u64::from(seconds) * 1500)),
    };
    Ok(AuthenticatedClient {
        client,
        slot_key,
        keep_alive,
        will: connect.will,
        input,
        rate_limit,
        login,
        evictions,
    })
}

/// Opens the robot's channel in the rate limiter, unless it was cut off and its backoff still runs.
fn open_channel(context: &Context, robot: &RobotId) -> Result<RobotChannel, Rejection> {
    let now = tokio::time::Instant::now();
    let rate_limit = context.robot_limiter.channel(robot, Channel::Mqtt, now);
    let may_connect = rate_limit.backoff_until(now).is_none();
    if may_connect && !matches!(rate_limit.count(SESSION_COST, 0, now), Verdict::Cut(_)) {
        return Ok(rate_limit);
    }
    Err(answer(
        ConnectReturnCode::ServiceUnavailable,
        "the robot was cut off, and its backoff has not ended",
    ))
}

pub(super) fn connack(code: ConnectReturnCode, output: &mut BytesMut) {
    // Sessions are always clean, so there is never one to resume.
    encode(Packet::ConnAck(ConnAck { session_present: false, code }, None), output);
}

/// Sends the reason to the client, as far as the protocol has a code. Bounded by the write timeout.
pub(super) async fn reject<S: AsyncWrite + Unpin>(
    context: &Context,
    stream: &mut S,
    rejection: Rejection,
) {
    let code = match rejection {
        Rejection::Answered { code, .. } => code,
        Rejection::Malformed(DecodeError::UnknownProtocol(_)) => {
            ConnectReturnCode::RefusedProtocolVersion
        }
        // The client asked to retain its will.
        Rejection::Malformed(DecodeError::Retained) => ConnectReturnCode::NotAuthorized,
        Rejection::Malformed(_) | Rejection::Silent(_) => return,
    };
    let mut output = BytesMut::new();
    connack(code, &mut output);
    // If the answer does not arrive, the client sees the connection end, which is enough.
    let _ = timeout(context.limits.write_timeout, stream.write_all(&output)).await;
}

fn answer(code: ConnectReturnCode, reason: &'static str) -> Rejection {
    Rejection::Answered { code, reason }
}

async fn read_connect<S: AsyncRead + Unpin>(
    stream: &mut S,
    input: &mut BytesMut,
) -> Result<Connect, Rejection> {
    loop {
        if input.first().is_some_and(|first| first >> 4 != 1) {
            return Err(Rejection::Silent("the first packet is not CONNECT"));
        }
        match decode(input, MAX_CONNECT_BYTES).map_err(Rejection::Malformed)? {
            Some(Received::Connect(connect)) => return Ok(connect),
            Some(_) => return Err(Rejection::Silent("the first packet is not CONNECT")),
            None => {}
        }
        input.reserve(512);
        match stream.read_buf(input).await {
            Ok(0) | Err(_) => return Err(Rejection::Silent("disconnected before CONNECT")),
            Ok(_) => {}
        }
    }
}

async fn admit(
    context: &Arc<Context>,
    connect: &Connect,
    login: Login,
) -> Result<Client, Rejection> {
    if connect.client_id == CANARY_ID {
        let pass = connect.password.as_deref().unwrap_or_default();
        return match context.canary_pass.redeem(pass) {
            true => Ok(Client::Canary),
            false => Err(answer(
                ConnectReturnCode::BadUserNamePassword,
                "the watchdog's client id without its password",
            )),
        };
    }
    match ask_gatekeeper(context, login).await {
        Err(Refusal::BadCredentials) => {
            Err(answer(ConnectReturnCode::BadUserNamePassword, "a bad user name or password"))
        }
        Err(Refusal::NotAuthorised) => {
            Err(answer(ConnectReturnCode::NotAuthorized, "credentials that allow nothing"))
        }
        Err(Refusal::Unavailable) => Err(answer(
            ConnectReturnCode::ServiceUnavailable,
            "credentials that can't be checked now",
        )),
        Ok(Principal::Operator(_)) if connect.client_id.len() > MAX_CLIENT_ID_BYTES => {
            Err(answer(ConnectReturnCode::ClientIdentifierNotValid, "a client id that is too long"))
        }
        Ok(Principal::Operator(user)) => Ok(Client::Operator(user)),
        // A robot's name on another robot's token, or the other way round.
        Ok(Principal::Robot { robot, .. })
            if connect.user_name.as_deref() != Some(robot.as_str()) =>
        {
            Err(answer(
                ConnectReturnCode::NotAuthorized,
                "a user name that is not the token's robot id",
            ))
        }
        Ok(Principal::Robot { robot, .. }) if connect.client_id != robot.as_str() => Err(answer(
            ConnectReturnCode::ClientIdentifierNotValid,
            "a client id that is not the robot's id",
        )),
        Ok(Principal::Robot { robot, token_number, .. }) => {
            Ok(Client::Robot { robot, token_number })
        }
    }
}

/// Asks the gatekeeper for the client's identity. The lookup runs to its end even if the client is
/// no longer waited for: a robot's first use of a token has ended the robot's other tokens by then,
/// and sessions admitted by those must close.
async fn ask_gatekeeper(context: &Arc<Context>, login: Login) -> Result<Principal, Refusal> {
    let shared = context.clone();
    let asked = tokio::spawn(async move {
        let principal = shared.gatekeeper.admit(login).await;
        if let Ok(Principal::Robot { robot, is_first_use: true, .. }) = &principal {
            // No session of an ended token keeps or gets a slot; this client has none yet.
            shared.slots.evict(robot);
        }
        principal
    });
    match timeout(context.limits.admit_timeout, asked).await {
        Ok(Ok(principal)) => principal,
        // The lookup timed out or panicked.
        Ok(Err(_)) | Err(_) => Err(Refusal::Unavailable),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn canary_password_works_once() {
        let pass = CanaryPass::default();
        assert!(!pass.redeem(""));
        let first = pass.renew();
        assert!(!pass.redeem("x"));
        assert!(pass.redeem(&first));
        assert!(!pass.redeem(&first));
        let second = pass.renew();
        assert!(!pass.redeem(&first));
        assert!(pass.redeem(&second));
    }
}
