//! One client's session, from its slot to its end: a single task that reads, handles packets,
//! answers and enforces timeouts. All its buffers are bounded; it stops reading while a message is
//! being stored or while the client leaves answers unread.

use std::collections::HashMap;
use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use bytes::{Bytes, BytesMut};
use futures_util::future::BoxFuture;
use rumqttd::protocol::{
    ConnectReturnCode, Packet, PingResp, PubAck, PubAckReason, PubComp, PubCompReason, PubRec,
    PubRecReason, PubRel, PubRelReason, QoS,
};
use task_proto::topic::{RobotTopic, Topic};
use task_proto::{Digest, RobotId};
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt, ReadHalf, WriteHalf};
use tokio::time::{Instant, sleep_until, timeout};

use super::Context;
use super::access::{Hearing, Route, Visitor, may_publish};
use super::attendance::Attendance;
use super::codec::{DecodeError, Publish, Received, Will, decode, encode, encode_publish};
use super::entrance::{Arrival, Guest, Rejection, connack, reject, welcome};
use super::outgoing::Outgoing;
use super::output::{Output, give_back};
use super::parts::Due;
use super::takeover::Seat;
use super::traffic::{Count, Meter, Metered};
use crate::broker::router::{Heard, Listener, Listening, RouterError};
use crate::broker::{NotStored, RobotMessage};
use crate::limits::conduct::Watched;

mod conduct;
mod parts;
mod subscriptions;
mod unreleased;

use conduct::until;
use parts::{Parts, due};
use subscriptions::lower;
use unreleased::Unreleased;

/// Maximum unread answers before we stop reading from the client.
const MAX_UNREAD_BYTES: usize = 64 * 1024;
/// How long a connection stays open for the client to read the last bytes.
const LINGER: Duration = Duration::from_secs(1);

/// The reason why a session ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
enum End {
    /// DISCONNECT: the only end that discards the will.
    #[error("says goodbye")]
    Goodbye,
    #[error("goes away without a word")]
    Gone,
    #[error("is silent for longer than its keepalive")]
    Silent,
    #[error("does not read, or does not acknowledge, what it is sent")]
    Deaf,
    #[error("{0}")]
    Malformed(#[from] DecodeError),
    #[error("{0}")]
    Violation(&'static str),
    #[error("sent a message that could not be stored")]
    NotStored,
    #[error("goes on sending more than it may")]
    Flood,
    #[error("must leave: a newer session, or the server's decision")]
    Asked,
    /// In the middle of a part.
    #[error("may no longer have what it is being sent")]
    Withdrawn,
    #[error("lost the router")]
    RouterLost,
    #[error("ends with the server")]
    Stopped,
}

/// Serves one connection to its end. For TLS, `stream` is what the handshake returns.
pub(super) async fn serve<S>(context: Arc<Context>, stream: S, arrival: Arrival)
where
    S: AsyncRead + AsyncWrite + Send + Unpin,
{
    let peer = arrival.peer;
    let meter = Arc::new(Meter::default());
    let mut stream = Metered { stream, meter: meter.clone() };
    let entered = tokio::select! {
        entered = enter(&context, &mut stream, arrival, &meter) => entered,
        () = context.stop.cancelled() => return,
    };
    match entered {
        Err(rejection) => {
            tracing::debug!(%peer, "MQTT client turned away: {rejection}");
            if let Rejection::Malformed(DecodeError::UnknownProtocol(level)) = rejection {
                context.other_protocols.refused(peer, level);
            }
            context.totals.refuse(Some(&meter));
            reject(&context, &mut stream, rejection).await;
        }
        Ok((guest, seat, listener)) => {
            if guest.visitor != Visitor::Canary {
                context.totals.accept(&meter);
            }
            let end = live(&context, &mut stream, peer, guest, seat, listener).await;
            tracing::debug!(%peer, "MQTT client {end}");
        }
    }
    linger(&mut stream).await;
}

/// All steps before the session is live: the client's identity, the slot, and a link to the router
/// if the session needs one.
async fn enter<S>(
    context: &Arc<Context>,
    stream: &mut S,
    arrival: Arrival,
    meter: &Arc<Meter>,
) -> Result<(Guest, Seat, Option<Listener>), Rejection>
where
    S: AsyncRead + AsyncWrite + Unpin,
{
    let guest = welcome(context, stream, arrival).await?;
    let unavailable =
        |reason| Rejection::Answered { code: ConnectReturnCode::ServiceUnavailable, reason };
    let seat = context.seats.take(guest.seat_name.clone(), meter.clone()).await;
    let seat = seat.ok_or(unavailable("the person has as many sessions as there may be"))?;
    guest.check_again(context).await?;
    let listening = match guest.visitor {
        Visitor::Robot { .. } => return Ok((guest, seat, None)),
        Visitor::Operator(_) => Listening::Everything,
        Visitor::Canary => Listening::Canary,
    };
    let listener = context.router.listen(listening).await.map_err(|error| match error {
        RouterError::Full => unavailable("there are as many operators as there may be"),
        RouterError::Gone | RouterError::Stuck => unavailable("the router does not answer"),
    })?;
    Ok((guest, seat, Some(listener)))
}

/// Runs the session, and then its cleanup in this order: the link to the router ends, the will is
/// published, the inbox is told of the end, and the slot is free.
async fn live<S>(
    context: &Context,
    stream: &mut S,
    peer: SocketAddr,
    guest: Guest,
    seat: Seat,
    listener: Option<Listener>,
) -> End
where
    S: AsyncRead + AsyncWrite + Unpin,
{
    // The payload may have been meant for the previous session of the slot. The code that is told
    // of this session rings again.
    seat.doorbell().forget_state();
    let _attendance = Attendance::begin(context, &guest.visitor, peer, seat.number());
    let (reader, writer) = tokio::io::split(stream);
    let mut output = Output::default();
    connack(ConnectReturnCode::Success, output.packets());
    seat.meter().add(Count::PacketsIn, 1);
    seat.meter().add(Count::PacketsOut, 1);
    let now = Instant::now();
    let mut session = Session {
        context,
        visitor: guest.visitor,
        peer,
        seat: &seat,
        reader,
        writer,
        input: guest.input,
        output,
        is_flushed: true,
        listener,
        hearing: HashMap::new(),
        watched: guest.watched.as_ref(),
        slowed_until: None,
        refused_filters: 0,
        parts: Parts::default(),
        outgoing: Outgoing::default(),
        unreleased: Unreleased::default(),
        storing: None,
        keep_alive: guest.keep_alive.unwrap_or(context.limits.max_silence),
        heard_at: now,
        heard_bytes: 0,
        progress_at: now,
    };
    let end = session.run().await;
    if let (Some(watched), Some(offence)) = (session.watched, end.offence()) {
        watched.offends(offence, Instant::now());
    }
    session.listener = None;
    if !matches!(end, End::Goodbye | End::Stopped)
        && let Some(will) = guest.will
    {
        session.say_will(will).await;
    }
    end
}

/// Lets the client read the last bytes: closing with bytes unread on our side would reset the
/// connection.
async fn linger<S: AsyncRead + AsyncWrite + Unpin>(stream: &mut S) {
    let read_out = async {
        stream.shutdown().await?;
        let mut scrap = [0; 1024];
        while stream.read(&mut scrap).await? > 0 {}
        io::Result::Ok(())
    };
    // The connection is over in any case.
    let _ = timeout(LINGER, read_out).await;
}

struct Session<'a, S> {
    context: &'a Context,
    visitor: Visitor,
    peer: SocketAddr,
    seat: &'a Seat,
    reader: ReadHalf<&'a mut S>,
    writer: WriteHalf<&'a mut S>,
    input: BytesMut,
    output: Output,
    /// Whether the bytes that left `output` have left the stream's own buffers as well.
    is_flushed: bool,
    listener: Option<Listener>,
    hearing: HashMap<String, (Hearing, QoS)>,
    /// The rate limits of the robot.
    watched: Option<&'a Watched>,
    /// Nothing more is read from the robot before this time.
    slowed_until: Option<Instant>,
    refused_filters: u32,
    parts: Parts,
    outgoing: Outgoing,
    unreleased: Unreleased,
    storing: Option<Storing<'a>>,
    keep_alive: Duration,
    /// When the last packet arrived, or enough of the incoming one.
    heard_at: Instant,
    /// Bytes of the incoming packet that were present at that time.
    heard_bytes: usize,
    /// When the client last read some of our bytes, or there was nothing to read.
    progress_at: Instant,
}

/// A message that is being stored by the inbox, and the pending acknowledgement.
struct Storing<'a> {
    publish: Publish,
    stored: BoxFuture<'a, Result<(), NotStored>>,
}

/// An event that wakes a session.
enum Woken {
    Read(io::Result<usize>),
    Wrote(io::Result<()>),
    Stored(Result<(), NotStored>),
    Rung(Bytes),
    Asked(Bytes),
    Heard(Result<Heard, RouterError>),
    /// The slowed period is over.
    Due,
    PartDue(Digest, Due),
    Late(End),
}

impl<S: AsyncRead + AsyncWrite + Unpin> Session<'_, S> {
    async fn run(&mut self) -> End {
        let end = loop {
            if let Err(end) = self.act_on_input() {
                break end;
            }
            let woken = tokio::select! {
                biased;
                () = self.seat.leave().cancelled() => return End::Asked,
                () = self.context.stop.cancelled() => return End::Stopped,
                woken = self.wait() => woken,
            };
            if let Err(end) = self.act_on(woken) {
                break end;
            }
        };
        if !matches!(end, End::Deaf | End::Withdrawn) {
            // Answers from before the end are still due. If the client can't receive them, the
            // connection is over anyway.
            let _ = timeout(LINGER, self.writer.write_all_buf(&mut self.output)).await;
        }
        end
    }

    /// Waits for the first event. Every branch is cancel-safe: bytes stay in the socket or the
    /// buffers, payloads in the doorbell or the link, and the message that is being stored is
    /// polled in place.
    async fn wait(&mut self) -> Woken {
        let (deadline, lateness) = self.deadline();
        let may_read = self.may_read();
        let may_write = !self.output.is_empty() || !self.is_flushed;
        let may_send = self.caught_up();
        let may_send_part = may_send && self.outgoing.has_room_for_part();
        let hears_desired = self.qos_of(Hearing::Desired).is_some();
        let hears_request = self.qos_of(Hearing::Request).is_some();
        if may_read {
            self.input.reserve(1024);
        }
        let woken = tokio::select! {
            stored = stored(&mut self.storing) => Woken::Stored(stored),
            wrote = write(&mut self.writer, &mut self.output, &mut self.is_flushed), if may_write => Woken::Wrote(wrote),
            read = self.reader.read_buf(&mut self.input), if may_read => Woken::Read(read),
            payload = self.seat.doorbell().answer(), if may_send && hears_desired => Woken::Rung(payload),
            payload = self.seat.doorbell().question(), if may_send && hears_request => Woken::Asked(payload),
            (digest, due) = due(&self.parts, may_send_part) => Woken::PartDue(digest, due),
            heard = heard(&mut self.listener), if may_send => Woken::Heard(heard),
            () = until(self.slowed_until) => Woken::Due,
            () = sleep_until(deadline) => Woken::Late(lateness),
        };
        if may_send {
            // Until now there was nothing to read, for any length of time.
            self.progress_at = Instant::now();
        }
        woken
    }

    /// The next deadline, and the reason for ending the session if the deadline passes.
    fn deadline(&mut self) -> (Instant, End) {
        if self.caught_up() {
            self.progress_at = Instant::now();
        }
        let unread_until = self.progress_at + self.context.limits.write_timeout;
        let silent_until = self.heard_at + self.keep_alive;
        // While we don't read, the client is not responsible for its silence.
        if self.may_read() && silent_until < unread_until || self.caught_up() && !self.is_busy() {
            (silent_until, End::Silent)
        } else {
            (unread_until, End::Deaf)
        }
    }

    /// Whether the client has read all our bytes.
    fn caught_up(&self) -> bool {
        self.output.is_empty() && self.is_flushed && self.outgoing.has_room()
    }

    fn may_read(&self) -> bool {
        !self.is_busy() && self.output.own_bytes() < MAX_UNREAD_BYTES
    }

    /// Whether the last packet is still being handled, or exceeded the limits.
    fn is_busy(&self) -> bool {
        self.storing.is_some() || self.slowed_until.is_some()
    }

    fn act_on(&mut self, woken: Woken) -> Result<(), End> {
        match woken {
            Woken::Read(Ok(0) | Err(_)) | Woken::Wrote(Err(_)) => return Err(End::Gone),
            Woken::Read(Ok(_)) => {}
            Woken::Wrote(Ok(())) => {
                self.progress_at = Instant::now();
                self.output.give_back();
                if self.output.is_empty() {
                    self.parts.written();
                }
            }
            Woken::Stored(stored) => self.acknowledge_stored(stored)?,
            Woken::Rung(payload) => self.send_own(RobotTopic::Desired, Hearing::Desired, payload),
            Woken::Asked(payload) => self.send_own(RobotTopic::Request, Hearing::Request, payload),
            Woken::PartDue(digest, due) => self.act_on_part(digest, due)?,
            Woken::Heard(heard) => self.pass_on(heard.map_err(|_| End::RouterLost)?),
            // We did not read, so the silence does not count.
            Woken::Due => (self.slowed_until, self.heard_at) = (None, Instant::now()),
            Woken::Late(end) => return Err(end),
        }
        Ok(())
    }

    fn act_on_input(&mut self) -> Result<(), End> {
        while self.may_read() {
            let before = self.input.len();
            let Some(received) = decode(&mut self.input, self.context.limits.max_packet_bytes)?
            else {
                self.hear_progress();
                break;
            };
            (self.heard_at, self.heard_bytes) = (Instant::now(), 0);
            self.weigh(&received, before - self.input.len())?;
            self.act_on_packet(received)?;
        }
        give_back(&mut self.input);
        Ok(())
    }

    fn act_on_packet(&mut self, received: Received) -> Result<(), End> {
        self.count(Count::PacketsIn);
        match received {
            Received::Connect(_) => return Err(End::Violation("sends a second CONNECT")),
            Received::Publish(publish) => self.publish(publish)?,
            Received::PubAck(id) => {
                self.count(Count::AcksIn);
                if self.outgoing.acknowledged(id) {
                    self.parts.acknowledged(id);
                }
                self.progress_at = self.heard_at;
            }
            Received::PubRec(pkid) => {
                self.outgoing.received(pkid);
                self.progress_at = self.heard_at;
                self.send(Packet::PubRel(PubRel { pkid, reason: PubRelReason::Success }, None));
            }
            Received::PubRel(pkid) => {
                self.unreleased.remove(pkid);
                self.send(Packet::PubComp(PubComp { pkid, reason: PubCompReason::Success }, None));
            }
            Received::PubComp(id) => {
                if self.outgoing.completed(id) {
                    self.parts.acknowledged(id);
                }
                self.progress_at = self.heard_at;
            }
            Received::Subscribe { packet_id, filters } => self.subscribe(packet_id, filters)?,
            Received::Unsubscribe { packet_id, filters } => self.unsubscribe(packet_id, &filters),
            Received::PingReq => self.send(Packet::PingResp(PingResp)),
            Received::Disconnect => return Err(End::Goodbye),
        }
        Ok(())
    }

    fn publish(&mut self, publish: Publish) -> Result<(), End> {
        self.count(Count::MessagesIn);
        let Some(route) = may_publish(&self.visitor, &self.context.prefix, &publish.topic) else {
            self.context.totals.refuse_message();
            return Err(End::Violation("publishes where it may not"));
        };
        if publish.qos == QoS::ExactlyOnce && self.unreleased.contains(publish.packet_id) {
            self.acknowledge(&publish);
            return Ok(());
        }
        match (route, &self.visitor) {
            (Route::Inbox(topic), &Visitor::Robot { ref robot, token_number }) => {
                let message = self.message(robot, token_number, topic, publish.payload.clone());
                let stored = Box::pin(store(self.context, message));
                self.storing = Some(Storing { publish, stored });
            }
            _ => {
                self.context.router.publish(&publish.topic, publish.qos, publish.payload.clone());
                self.acknowledge(&publish);
            }
        }
        Ok(())
    }

    fn acknowledge_stored(&mut self, stored: Result<(), NotStored>) -> Result<(), End> {
        let Some(Storing { publish, .. }) = self.storing.take() else { return Ok(()) };
        if let Err(NotStored) = stored {
            self.context.totals.refuse_message();
            return Err(End::NotStored);
        }
        self.acknowledge(&publish);
        self.context.router.publish(&publish.topic, publish.qos, publish.payload);
        self.heard_at = Instant::now();
        Ok(())
    }

    fn acknowledge(&mut self, publish: &Publish) {
        let pkid = publish.packet_id;
        match publish.qos {
            QoS::AtMostOnce => {}
            QoS::AtLeastOnce => {
                self.count(Count::AcksOut);
                self.send(Packet::PubAck(PubAck { pkid, reason: PubAckReason::Success }, None));
            }
            QoS::ExactlyOnce => {
                self.unreleased.insert(pkid);
                self.send(Packet::PubRec(PubRec { pkid, reason: PubRecReason::Success }, None));
            }
        }
    }

    fn qos_of(&self, wanted: Hearing) -> Option<QoS> {
        self.hearing.values().find(|(hearing, _)| *hearing == wanted).map(|(_, qos)| *qos)
    }

    /// Sends a message that is for this robot alone.
    fn send_own(&mut self, last: RobotTopic, hearing: Hearing, payload: Bytes) {
        if let (Visitor::Robot { robot, .. }, Some(granted)) = (&self.visitor, self.qos_of(hearing))
        {
            let topic = self.context.prefix.format(&Topic::Robot(robot.clone(), last));
            self.send_message(topic, payload, lower(granted, QoS::AtLeastOnce));
        }
    }

    fn send_message(&mut self, topic: String, payload: Bytes, qos: QoS) {
        let packet_id = self.outgoing.begin(qos);
        self.count(Count::PacketsOut);
        self.count(Count::MessagesOut);
        encode_publish(&Publish { topic, qos, packet_id, payload }, self.output.packets());
    }

    fn count(&self, count: Count) {
        self.seat.meter().add(count, 1);
    }

    fn send(&mut self, packet: Packet) {
        self.count(Count::PacketsOut);
        encode(packet, self.output.packets());
    }

    fn message(
        &self,
        robot: &RobotId,
        token_number: u64,
        topic: RobotTopic,
        payload: Bytes,
    ) -> RobotMessage {
        let (peer, connection) = (Some(self.peer), self.seat.number());
        RobotMessage {
            robot: robot.clone(),
            topic,
            payload,
            peer,
            connection,
            token_number: Some(token_number),
        }
    }

    async fn say_will(&mut self, will: Will) {
        match (may_publish(&self.visitor, &self.context.prefix, &will.topic), &self.visitor) {
            (Some(Route::Inbox(topic)), &Visitor::Robot { ref robot, token_number }) => {
                if store(
                    self.context,
                    self.message(robot, token_number, topic, will.payload.clone()),
                )
                .await
                .is_err()
                {
                    tracing::warn!(%robot, "a robot's will could not be stored");
                    return;
                }
            }
            (Some(_), _) => {}
            (None, _) => return,
        }
        self.context.router.publish(&will.topic, will.qos, will.payload);
    }
}

/// Hands a message to the inbox, within the inbox's time limit.
async fn store(context: &Context, message: RobotMessage) -> Result<(), NotStored> {
    timeout(context.limits.inbox_timeout, context.inbox.receive(message))
        .await
        .unwrap_or(Err(NotStored))
}

/// Writes some of the output, and waits until the stream has flushed all of it. If the call is
/// dropped, the written bytes are gone from `output`, and `is_flushed` tells whether more is to be
/// done.
async fn write<W: AsyncWrite + Unpin>(
    writer: &mut W,
    output: &mut Output,
    is_flushed: &mut bool,
) -> io::Result<()> {
    if !output.is_empty() {
        *is_flushed = false;
        if writer.write_buf(output).await? == 0 {
            return Err(io::ErrorKind::WriteZero.into());
        }
    }
    writer.flush().await?;
    *is_flushed = true;
    Ok(())
}

/// Resolves when the pending message is stored; never if there is none.
async fn stored(storing: &mut Option<Storing<'_>>) -> Result<(), NotStored> {
    match storing {
        Some(storing) => (&mut storing.stored).await,
        None => std::future::pending().await,
    }
}

/// The next message from the router; never if there is no link.
async fn heard(listener: &mut Option<Listener>) -> Result<Heard, RouterError> {
    match listener {
        Some(listener) => listener.next().await,
        None => std::future::pending().await,
    }
}
