//! One client's session, from its slot to its end: a single task that reads, handles packets,
//! answers and enforces timeouts. All its buffers are bounded; it stops reading while a message is
//! being stored or while the client leaves answers unread.

mod outgoing;
mod output;
mod parts;
mod presence_guard;
mod subscriptions;
mod unreleased;
mod violations;

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
use task_proto::messages::topic::{RobotTopic, Topic};
use task_proto::{Digest, RobotId};
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt, ReadHalf, WriteHalf};
use tokio::time::{Instant, sleep_until, timeout};

use self::outgoing::Outgoing;
use self::output::{Output, release_if_idle};
use self::parts::{Parts, due};
use self::presence_guard::PresenceGuard;
use self::subscriptions::lower;
use self::unreleased::Unreleased;
use self::violations::until;
use super::Context;
use super::access::{Client, MessageSource, Route, may_publish};
use super::admission::{
    AuthenticatedClient, PendingConnection, Rejection, authenticate, connack, reject,
};
use super::codec::{DecodeError, Publish, Received, Will, decode, encode, encode_publish};
use super::parts::Due;
use super::slots::SessionSlot;
use super::traffic::{Count, Meter, Metered};
use crate::broker::router::{Message, RouterError, Subscriber, Topics};
use crate::broker::{NotStored, RobotMessage};
use crate::domain::limits::robot_limiter::RobotChannel;

/// Maximum unread answers before we stop reading from the client.
const MAX_UNREAD_BYTES: usize = 64 * 1024;
/// How long a connection stays open for the client to read the last bytes.
const LINGER: Duration = Duration::from_secs(1);

/// The reason why a session ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
enum End {
    /// DISCONNECT: the only end that discards the will.
    #[error("the client sent DISCONNECT")]
    Disconnected,
    #[error("the connection was lost")]
    ConnectionLost,
    #[error("keepalive timeout")]
    KeepAliveTimeout,
    #[error("write timeout: the client does not read, or does not acknowledge messages")]
    WriteTimeout,
    #[error("the client {0}")]
    Malformed(#[from] DecodeError),
    #[error("the client {0}")]
    Violation(&'static str),
    #[error("a message of the client could not be stored")]
    NotStored,
    #[error("the client keeps exceeding its rate limit")]
    RateLimited,
    #[error("evicted, by a newer session or by the server")]
    Evicted,
    /// In the middle of a part.
    #[error("the permission for the part being sent was withdrawn")]
    Withdrawn,
    #[error("the link to the router was lost")]
    RouterLost,
    #[error("the server is shutting down")]
    Stopped,
}

/// Serves one connection to its end. For TLS, `stream` is what the handshake returns.
pub(super) async fn serve<S>(context: Arc<Context>, stream: S, pending: PendingConnection)
where
    S: AsyncRead + AsyncWrite + Send + Unpin,
{
    let peer = pending.peer;
    let meter = Arc::new(Meter::default());
    let mut stream = Metered { stream, meter: meter.clone() };
    let established = tokio::select! {
        established = establish(&context, &mut stream, pending, &meter) => established,
        () = context.stop.cancelled() => return,
    };
    match established {
        Err(rejection) => {
            tracing::debug!(%peer, "MQTT client rejected: {rejection}");
            if let Rejection::Malformed(DecodeError::UnknownProtocol(level)) = rejection {
                context.other_protocols.refused(peer, level);
            }
            context.totals.refuse(Some(&meter));
            reject(&context, &mut stream, rejection).await;
        }
        Ok((authenticated, slot, subscriber)) => {
            if authenticated.client != Client::Canary {
                context.totals.accept(&meter);
            }
            let end =
                run_session(&context, &mut stream, peer, authenticated, slot, subscriber).await;
            tracing::debug!(%peer, "MQTT session ended: {end}");
        }
    }
    linger(&mut stream).await;
}

/// All steps before the session is live: the client's identity, the slot, and a link to the router
/// if the session needs one.
async fn establish<S>(
    context: &Arc<Context>,
    stream: &mut S,
    pending: PendingConnection,
    meter: &Arc<Meter>,
) -> Result<(AuthenticatedClient, SessionSlot, Option<Subscriber>), Rejection>
where
    S: AsyncRead + AsyncWrite + Unpin,
{
    let authenticated = authenticate(context, stream, pending).await?;
    let unavailable =
        |reason| Rejection::Answered { code: ConnectReturnCode::ServiceUnavailable, reason };
    let token_number = match authenticated.client {
        Client::Robot { token_number, .. } => Some(token_number),
        Client::Operator(_) | Client::Canary => None,
    };
    let key = authenticated.slot_key.clone();
    let slot = context.slots.take(key, token_number, meter.clone()).await;
    let slot = slot.ok_or(unavailable("the person has the maximum number of sessions"))?;
    authenticated.recheck(context).await?;
    let topics = match authenticated.client {
        Client::Robot { .. } => return Ok((authenticated, slot, None)),
        Client::Operator(_) => Topics::Everything,
        Client::Canary => Topics::Canary,
    };
    let subscriber = context.router.subscribe(topics).await.map_err(|error| match error {
        RouterError::Full => unavailable("the maximum number of operators is connected"),
        RouterError::Gone | RouterError::Stuck => unavailable("the router does not answer"),
    })?;
    Ok((authenticated, slot, Some(subscriber)))
}

/// Runs the session, and then its cleanup in this order: the link to the router ends, the will is
/// published, the inbox is told of the end, and the slot is free.
async fn run_session<S>(
    context: &Context,
    stream: &mut S,
    peer: SocketAddr,
    authenticated: AuthenticatedClient,
    slot: SessionSlot,
    subscriber: Option<Subscriber>,
) -> End
where
    S: AsyncRead + AsyncWrite + Unpin,
{
    // The payload may have been meant for the previous session of the slot. The code that is told
    // of this session sends it again.
    slot.mailbox().clear_desired();
    let _presence = PresenceGuard::begin(context, &authenticated.client, peer, slot.number());
    let (reader, writer) = tokio::io::split(stream);
    let mut output = Output::default();
    connack(ConnectReturnCode::Success, output.packets());
    slot.meter().add(Count::PacketsIn, 1);
    slot.meter().add(Count::PacketsOut, 1);
    let now = Instant::now();
    let mut session = Session {
        context,
        client: authenticated.client,
        peer,
        slot: &slot,
        reader,
        writer,
        input: authenticated.input,
        output,
        is_flushed: true,
        subscriber,
        subscriptions: HashMap::new(),
        rate_limit: authenticated.rate_limit.as_ref(),
        slowed_until: None,
        refused_filters: 0,
        parts: Parts::default(),
        outgoing: Outgoing::default(),
        unreleased: Unreleased::default(),
        storing: None,
        keep_alive: authenticated.keep_alive.unwrap_or(context.limits.max_silence),
        received_at: now,
        received_bytes: 0,
        progress_at: now,
    };
    let end = session.run().await;
    if let (Some(rate_limit), Some(violation)) = (session.rate_limit, end.violation()) {
        rate_limit.cut_off(violation, Instant::now());
    }
    session.subscriber = None;
    if !matches!(end, End::Disconnected | End::Stopped)
        && let Some(will) = authenticated.will
    {
        session.publish_will(will).await;
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
    client: Client,
    peer: SocketAddr,
    slot: &'a SessionSlot,
    reader: ReadHalf<&'a mut S>,
    writer: WriteHalf<&'a mut S>,
    input: BytesMut,
    output: Output,
    /// Whether the bytes that left `output` have left the stream's own buffers as well.
    is_flushed: bool,
    subscriber: Option<Subscriber>,
    subscriptions: HashMap<String, (MessageSource, QoS)>,
    /// The rate limits of the robot.
    rate_limit: Option<&'a RobotChannel>,
    /// Nothing more is read from the robot before this time.
    slowed_until: Option<Instant>,
    refused_filters: u32,
    parts: Parts,
    outgoing: Outgoing,
    unreleased: Unreleased,
    storing: Option<Storing<'a>>,
    keep_alive: Duration,
    /// When the last packet arrived, or enough of the incoming one.
    received_at: Instant,
    /// Bytes of the incoming packet that were present at that time.
    received_bytes: usize,
    /// When the client last read some of our bytes, or there was nothing to read.
    progress_at: Instant,
}

/// A message that is being stored by the inbox, and the pending acknowledgement.
struct Storing<'a> {
    publish: Publish,
    stored: BoxFuture<'a, Result<(), NotStored>>,
}

/// An event that wakes a session.
enum Event {
    Read(io::Result<usize>),
    Wrote(io::Result<()>),
    Stored(Result<(), NotStored>),
    Desired(Bytes),
    Request(Bytes),
    RouterMessage(Result<Message, RouterError>),
    /// The slowed period is over.
    Resumed,
    PartDue(Digest, Due),
    Timeout(End),
}

impl<S: AsyncRead + AsyncWrite + Unpin> Session<'_, S> {
    async fn run(&mut self) -> End {
        let end = loop {
            if let Err(end) = self.handle_input() {
                break end;
            }
            let event = tokio::select! {
                biased;
                () = self.slot.evicted().cancelled() => return End::Evicted,
                () = self.context.stop.cancelled() => return End::Stopped,
                event = self.wait() => event,
            };
            if let Err(end) = self.handle(event) {
                break end;
            }
        };
        if !matches!(end, End::WriteTimeout | End::Withdrawn) {
            // Answers from before the end are still due. If the client can't receive them, the
            // connection is over anyway.
            let _ = timeout(LINGER, self.writer.write_all_buf(&mut self.output)).await;
        }
        end
    }

    /// Waits for the first event. Every branch is cancel-safe: bytes stay in the socket or the
    /// buffers, payloads in the mailbox or the link, and the message that is being stored is
    /// polled in place.
    async fn wait(&mut self) -> Event {
        let (deadline, reason) = self.deadline();
        let may_read = self.may_read();
        let may_write = !self.output.is_empty() || !self.is_flushed;
        let may_send = self.caught_up();
        let may_send_part = may_send && self.outgoing.has_room_for_part();
        let wants_desired = self.qos_of(MessageSource::Desired).is_some();
        let wants_requests = self.qos_of(MessageSource::Request).is_some();
        if may_read {
            self.input.reserve(1024);
        }
        let event = tokio::select! {
            stored = stored(&mut self.storing) => Event::Stored(stored),
            wrote = write(&mut self.writer, &mut self.output, &mut self.is_flushed), if may_write => Event::Wrote(wrote),
            read = self.reader.read_buf(&mut self.input), if may_read => Event::Read(read),
            payload = self.slot.mailbox().next_desired(), if may_send && wants_desired => Event::Desired(payload),
            payload = self.slot.mailbox().next_request(), if may_send && wants_requests => Event::Request(payload),
            (digest, due) = due(&self.parts, may_send_part) => Event::PartDue(digest, due),
            message = next_message(&mut self.subscriber), if may_send => Event::RouterMessage(message),
            () = until(self.slowed_until) => Event::Resumed,
            () = sleep_until(deadline) => Event::Timeout(reason),
        };
        if may_send {
            // Until now there was nothing to read, for any length of time.
            self.progress_at = Instant::now();
        }
        event
    }

    /// The next deadline, and the reason for ending the session if the deadline passes.
    fn deadline(&mut self) -> (Instant, End) {
        if self.caught_up() {
            self.progress_at = Instant::now();
        }
        let unread_until = self.progress_at + self.context.limits.write_timeout;
        let silent_until = self.received_at + self.keep_alive;
        // While we don't read, the client is not responsible for its silence.
        if self.may_read() && silent_until < unread_until || self.caught_up() && !self.is_busy() {
            (silent_until, End::KeepAliveTimeout)
        } else {
            (unread_until, End::WriteTimeout)
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

    fn handle(&mut self, event: Event) -> Result<(), End> {
        match event {
            Event::Read(Ok(0) | Err(_)) | Event::Wrote(Err(_)) => return Err(End::ConnectionLost),
            Event::Read(Ok(_)) => {}
            Event::Wrote(Ok(())) => {
                self.progress_at = Instant::now();
                self.output.release_if_idle();
                if self.output.is_empty() {
                    self.parts.written();
                }
            }
            Event::Stored(stored) => self.acknowledge_stored(stored)?,
            Event::Desired(payload) => {
                self.send_own(RobotTopic::Desired, MessageSource::Desired, payload)
            }
            Event::Request(payload) => {
                self.send_own(RobotTopic::Request, MessageSource::Request, payload)
            }
            Event::PartDue(digest, due) => self.handle_part(digest, due)?,
            Event::RouterMessage(message) => self.deliver(message.map_err(|_| End::RouterLost)?),
            // We did not read, so the silence does not count.
            Event::Resumed => (self.slowed_until, self.received_at) = (None, Instant::now()),
            Event::Timeout(end) => return Err(end),
        }
        Ok(())
    }

    fn handle_input(&mut self) -> Result<(), End> {
        while self.may_read() {
            let before = self.input.len();
            let Some(received) = decode(&mut self.input, self.context.limits.max_packet_bytes)?
            else {
                self.note_progress();
                break;
            };
            (self.received_at, self.received_bytes) = (Instant::now(), 0);
            self.count_packet(&received, before - self.input.len())?;
            self.handle_packet(received)?;
        }
        release_if_idle(&mut self.input);
        Ok(())
    }

    fn handle_packet(&mut self, received: Received) -> Result<(), End> {
        self.count(Count::PacketsIn);
        match received {
            Received::Connect(_) => return Err(End::Violation("sends a second CONNECT")),
            Received::Publish(publish) => self.publish(publish)?,
            Received::PubAck(id) => {
                self.count(Count::AcksIn);
                if self.outgoing.acknowledged(id) {
                    self.parts.acknowledged(id);
                }
                self.progress_at = self.received_at;
            }
            Received::PubRec(pkid) => {
                self.outgoing.received(pkid);
                self.progress_at = self.received_at;
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
                self.progress_at = self.received_at;
            }
            Received::Subscribe { packet_id, filters } => self.subscribe(packet_id, filters)?,
            Received::Unsubscribe { packet_id, filters } => self.unsubscribe(packet_id, &filters),
            Received::PingReq => self.send(Packet::PingResp(PingResp)),
            Received::Disconnect => return Err(End::Disconnected),
        }
        Ok(())
    }

    fn publish(&mut self, publish: Publish) -> Result<(), End> {
        self.count(Count::MessagesIn);
        let Some(route) = may_publish(&self.client, &self.context.prefix, &publish.topic) else {
            self.context.totals.refuse_message();
            return Err(End::Violation("publishes to a topic that it may not write"));
        };
        if publish.qos == QoS::ExactlyOnce && self.unreleased.contains(publish.packet_id) {
            self.acknowledge(&publish);
            return Ok(());
        }
        match (route, &self.client) {
            (Route::Inbox(topic), &Client::Robot { ref robot, token_number }) => {
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
        self.received_at = Instant::now();
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

    fn qos_of(&self, source: MessageSource) -> Option<QoS> {
        self.subscriptions
            .values()
            .find(|(subscribed, _)| *subscribed == source)
            .map(|(_, qos)| *qos)
    }

    /// Sends a message that is for this robot alone.
    fn send_own(&mut self, last: RobotTopic, source: MessageSource, payload: Bytes) {
        if let (Client::Robot { robot, .. }, Some(granted)) = (&self.client, self.qos_of(source)) {
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
        self.slot.meter().add(count, 1);
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
        let (peer, connection) = (Some(self.peer), self.slot.number());
        RobotMessage {
            robot: robot.clone(),
            topic,
            payload,
            peer,
            connection,
            token_number: Some(token_number),
        }
    }

    async fn publish_will(&mut self, will: Will) {
        match (may_publish(&self.client, &self.context.prefix, &will.topic), &self.client) {
            (Some(Route::Inbox(topic)), &Client::Robot { ref robot, token_number }) => {
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
async fn next_message(subscriber: &mut Option<Subscriber>) -> Result<Message, RouterError> {
    match subscriber {
        Some(subscriber) => subscriber.next().await,
        None => std::future::pending().await,
    }
}
