//! Admits a client: the TLS handshake if there is one, then one CONNECT, which is checked and then
//! admitted or refused with the right CONNACK. Until then a client gets little memory and little
//! time. This module never builds a session.

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

use super::Context;
use super::access::{Visitor, may_publish};
use super::codec::{Connect, DecodeError, Received, Will, decode, encode};
use super::places::Claim;
use super::takeover::SeatName;
use crate::broker::{Login, Principal, Refusal};
use crate::limits::conduct::{SESSION_COST, Verdict, Watched, Way};
use crate::net::anteroom::Place;
use crate::net::tls::ClientProof;

/// Maximum size of CONNECT, in bytes after the fixed header.
const MAX_CONNECT_BYTES: usize = 4 * 1024;
/// Maximum length of an operator's client id.
const MAX_CLIENT_ID_BYTES: usize = 256;
/// The watchdog's client id.
pub(in crate::broker) const CANARY_ID: &str = "router canary";

pub(super) struct Guest {
    pub(super) visitor: Visitor,
    pub(super) seat_name: SeatName,
    pub(super) keep_alive: Option<Duration>,
    pub(super) will: Option<Will>,
    /// Bytes that the client sent after CONNECT without waiting for the answer.
    pub(super) input: BytesMut,
    /// The rate limits, if the client is a robot.
    pub(super) watched: Option<Watched>,
    login: Login,
    /// How often robots had been evicted before the gatekeeper was asked.
    put_out: u64,
}

impl Guest {
    /// Asks the gatekeeper again, now that the client has a slot. If its rights ended before it had
    /// the slot, the request to leave could not reach it. For robots this happens only if one was
    /// evicted meanwhile, because robots connect in thousands.
    pub(super) async fn check_again(&self, context: &Context) -> Result<(), Rejection> {
        let before = match &self.visitor {
            Visitor::Operator(user) => Principal::Operator(user.clone()),
            Visitor::Robot { robot, token_number } if context.seats.put_out() != self.put_out => {
                Principal::Robot {
                    robot: robot.clone(),
                    token_number: *token_number,
                    is_first_use: false,
                }
            }
            Visitor::Robot { .. } | Visitor::Canary => return Ok(()),
        };
        let asked = context.gatekeeper.admit(self.login.clone());
        match timeout(context.limits.admit_timeout, asked).await {
            Ok(Ok(again)) if again == before => Ok(()),
            _ => Err(answer(ConnectReturnCode::NotAuthorized, "credentials that have just ended")),
        }
    }
}

/// A connection whose client has not identified itself.
pub(super) struct Arrival {
    pub(super) peer: SocketAddr,
    /// The proof from the TLS handshake.
    pub(super) proof: ClientProof,
    /// The deadline for identifying itself.
    deadline: tokio::time::Instant,
    place: Place,
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

impl Arrival {
    pub(super) fn new(context: &Context, peer: SocketAddr) -> Self {
        let deadline = tokio::time::Instant::now() + context.limits.connect_timeout;
        Self {
            peer,
            proof: ClientProof::NotAsked,
            deadline,
            place: context.anteroom.enter(peer.ip(), Instant::now()),
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
            () = self.place.leave().cancelled() => Err(Rejection::Silent("gives way to a newcomer")),
        }
    }

    /// Waits for a connection to close in favour of this one, if that is necessary.
    pub(super) async fn find_place(&self, claim: Claim) -> Result<OwnedSemaphorePermit, Rejection> {
        let place =
            async { claim.place().await.ok_or(Rejection::Silent("comes when there is no place")) };
        self.step("comes when there is no place", place).await
    }

    /// The TLS handshake of a client, if TLS is required.
    pub(super) async fn shake_hands<S>(
        &self,
        handshake: impl Future<Output = io::Result<S>>,
    ) -> Result<S, Rejection> {
        let handshake = async {
            handshake.await.map_err(|_| Rejection::Silent("does not finish the TLS handshake"))
        };
        self.step("does not finish the TLS handshake in time", handshake).await
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
pub(super) async fn welcome<S>(
    context: &Arc<Context>,
    stream: &mut S,
    arrival: Arrival,
) -> Result<Guest, Rejection>
where
    S: AsyncRead + AsyncWrite + Unpin,
{
    let mut input = BytesMut::new();
    let connect =
        arrival.step("sends no CONNECT in time", read_connect(stream, &mut input)).await?;
    let (peer, proof) = (arrival.peer, arrival.proof.clone());
    drop(arrival);
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
    let put_out = context.seats.put_out();
    let visitor = admit(context, &connect, login.clone()).await?;
    if let Some(will) = &connect.will
        && may_publish(&visitor, &context.prefix, &will.topic).is_none()
    {
        return Err(answer(
            ConnectReturnCode::NotAuthorized,
            "a will on a topic that is not its own",
        ));
    }
    let watched = match &visitor {
        Visitor::Robot { robot, .. } => Some(watch(context, robot)?),
        Visitor::Operator(_) | Visitor::Canary => None,
    };
    let seat_name = match &visitor {
        Visitor::Robot { robot, .. } => SeatName::Robot(robot.clone()),
        Visitor::Canary => SeatName::Canary,
        Visitor::Operator(user) if connect.client_id.is_empty() => {
            SeatName::Unnamed(user.clone(), rand::random())
        }
        Visitor::Operator(user) => SeatName::Operator(user.clone(), connect.client_id.clone()),
    };
    // 3.1.2.10: one and a half times the client's keepalive.
    let keep_alive = match connect.keep_alive_s {
        0 => None,
        seconds => Some(Duration::from_millis(u64::from(seconds) * 1500)),
    };
    Ok(Guest { visitor, seat_name, keep_alive, will: connect.will, input, watched, login, put_out })
}

/// Watches the robot, unless it was cut off and its backoff still runs.
fn watch(context: &Context, robot: &RobotId) -> Result<Watched, Rejection> {
    let now = tokio::time::Instant::now();
    let watched = context.conduct.watch(robot, Way::Mqtt, now);
    let may_come = watched.barred_until(now).is_none();
    if may_come && !matches!(watched.sent(SESSION_COST, 0, now), Verdict::Cut(_)) {
        return Ok(watched);
    }
    Err(answer(
        ConnectReturnCode::ServiceUnavailable,
        "a robot that was cut off and comes back too early",
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
            return Err(Rejection::Silent("sends something before CONNECT"));
        }
        match decode(input, MAX_CONNECT_BYTES).map_err(Rejection::Malformed)? {
            Some(Received::Connect(connect)) => return Ok(connect),
            Some(_) => return Err(Rejection::Silent("sends something before CONNECT")),
            None => {}
        }
        input.reserve(512);
        match stream.read_buf(input).await {
            Ok(0) | Err(_) => return Err(Rejection::Silent("goes away before CONNECT")),
            Ok(_) => {}
        }
    }
}

async fn admit(
    context: &Arc<Context>,
    connect: &Connect,
    login: Login,
) -> Result<Visitor, Rejection> {
    if connect.client_id == CANARY_ID {
        let pass = connect.password.as_deref().unwrap_or_default();
        return match context.canary_pass.redeem(pass) {
            true => Ok(Visitor::Canary),
            false => Err(answer(
                ConnectReturnCode::BadUserNamePassword,
                "the watchdog's client id without its password",
            )),
        };
    }
    match ask(context, login).await {
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
        Ok(Principal::Operator(user)) => Ok(Visitor::Operator(user)),
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
            Ok(Visitor::Robot { robot, token_number })
        }
    }
}

/// Asks the gatekeeper for the client's identity. The lookup runs to its end even if the client is
/// no longer waited for: a robot's first use of a token has ended the robot's other tokens by then,
/// and sessions admitted by those must close.
async fn ask(context: &Arc<Context>, login: Login) -> Result<Principal, Refusal> {
    let shared = context.clone();
    let asked = tokio::spawn(async move {
        let principal = shared.gatekeeper.admit(login).await;
        if let Ok(Principal::Robot { robot, is_first_use: true, .. }) = &principal {
            // No session of an ended token keeps or gets a slot; this client has none yet.
            shared.seats.ask_to_leave(robot);
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
    fn a_canary_pass_is_good_once() {
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
