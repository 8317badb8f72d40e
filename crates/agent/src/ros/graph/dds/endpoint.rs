//! Readers and writers of DDS topics, whose messages are CDR bytes. This module is the interface to
//! the DDS library. Other modules interpret the bytes.

use std::convert::Infallible;

use futures_util::{Stream, StreamExt};
use ros2_client::dds::rustdds::bytes::Bytes;
use ros2_client::dds::rustdds::no_key::{
    DataWriter, Decode, DefaultDecoder, DeserializedCacheChange, DeserializerAdapter,
    SerializerAdapter, SimpleDataReader,
};
use ros2_client::dds::rustdds::policy::{Deadline, Durability, History, Lifespan, Ownership};
use ros2_client::dds::rustdds::serialization::{
    deserialize_from_cdr_with_rep_id, to_writer_with_rep_id,
};
use ros2_client::dds::rustdds::{
    DomainParticipant, Duration, GUID, Publisher, QosPolicies, QosPolicyBuilder, RTPSEntity,
    RepresentationIdentifier, Subscriber, Topic, TopicKind, WriteOptionsBuilder,
    rpc::SampleIdentity,
};
use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::ros::graph::{EndpointId, GraphError};

/// Maximum size of a message in bytes; a longer one is dropped.
pub const MAX_MESSAGE_BYTES: usize = 1024 * 1024;
/// Maximum time that a writer waits for room.
const WRITE_WAIT: Duration = Duration::from_millis(100);

/// QoS of a reader or writer: how messages are kept and delivered.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Delivery {
    /// Reliable delivery without history for late joiners: services.
    Reliable {
        /// Number of messages kept.
        depth: i32,
    },
    /// Reliable delivery, including the last messages from before: the graph, `/rosout`.
    Lasting {
        /// Number of messages kept.
        depth: i32,
    },
    /// Best-effort delivery, compatible with every publisher.
    BestEffort,
}

/// A CDR message without its header.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Cdr {
    encoding: RepresentationIdentifier,
    pub body: Bytes,
}

/// A message with its origin.
#[derive(Debug)]
pub struct Sample<M> {
    pub message: M,
    pub writer: EndpointId,
    /// Sequence number of the message at its writer.
    pub number: i64,
    /// For an answer: the identity of its request.
    pub answers: Option<SampleIdentity>,
}

/// Reads `M` from one topic.
pub struct Reader<M: Received> {
    reader: SimpleDataReader<M, Adapter>,
}

/// Writes to one topic.
pub struct Writer {
    writer: DataWriter<Cdr, Adapter>,
}

/// Makes the readers and writers of one participant.
pub struct Endpoints {
    participant: DomainParticipant,
    publisher: Publisher,
    subscriber: Subscriber,
}

impl Delivery {
    fn qos(self) -> QosPolicies {
        let (durability, depth) = match self {
            Self::Reliable { depth } => (Durability::Volatile, depth),
            Self::Lasting { depth } => (Durability::TransientLocal, depth),
            Self::BestEffort => (Durability::Volatile, 1),
        };
        let builder = QosPolicyBuilder::new()
            .ownership(Ownership::Shared)
            .deadline(Deadline(Duration::INFINITE))
            .lifespan(Lifespan { duration: Duration::INFINITE })
            .durability(durability)
            .history(History::KeepLast { depth });
        match self {
            Self::BestEffort => builder.best_effort(),
            Self::Reliable { .. } | Self::Lasting { .. } => builder.reliable(WRITE_WAIT),
        }
        .build()
    }
}

impl Cdr {
    /// `value` in little-endian CDR, after `header`, which must end at an offset where eight-byte
    /// values may begin.
    pub fn of(header: &[u8], value: &impl Serialize) -> Result<Self, GraphError> {
        let mut body = header.to_vec();
        let mut message = Vec::new();
        to_writer_with_rep_id(&mut message, value, RepresentationIdentifier::CDR_LE)
            .map_err(|source| GraphError::Encode { reason: source.to_string() })?;
        body.append(&mut message);
        Ok(Self::little_endian(body))
    }

    /// A body that is little-endian already.
    pub fn little_endian(body: Vec<u8>) -> Self {
        Self { encoding: RepresentationIdentifier::CDR_LE, body: body.into() }
    }

    /// Whether the bytes are little-endian.
    pub fn is_little_endian(&self) -> bool {
        self.encoding == RepresentationIdentifier::CDR_LE
    }

    /// The value at offset `skipped` of the body; `None`: there is none.
    pub fn value<T: DeserializeOwned>(&self, skipped: usize) -> Option<T> {
        let bytes = self.body.get(skipped..)?;
        deserialize_from_cdr_with_rep_id(bytes, self.encoding).ok().map(|(value, _read)| value)
    }
}

impl Endpoints {
    pub fn of(participant: &DomainParticipant) -> Result<Self, GraphError> {
        let failed = |source| GraphError::endpoint("the participant's groups", source);
        Ok(Self {
            participant: participant.clone(),
            publisher: participant.create_publisher(&QosPolicies::qos_none()).map_err(failed)?,
            subscriber: participant.create_subscriber(&QosPolicies::qos_none()).map_err(failed)?,
        })
    }

    /// A reader of the DDS topic `topic` with the DDS type `kind`.
    pub fn reader<M: Received>(
        &self,
        topic: &str,
        kind: &str,
        delivery: Delivery,
    ) -> Result<Reader<M>, GraphError> {
        let dds = self.topic(topic, kind, delivery)?;
        let reader = self.subscriber.create_simple_datareader_no_key(&dds, Some(delivery.qos()));
        Ok(Reader { reader: reader.map_err(|source| GraphError::endpoint(topic, source))? })
    }

    /// A writer to the DDS topic `topic` with the DDS type `kind`.
    pub fn writer(
        &self,
        topic: &str,
        kind: &str,
        delivery: Delivery,
    ) -> Result<Writer, GraphError> {
        let dds = self.topic(topic, kind, delivery)?;
        let writer = self.publisher.create_datawriter_no_key(&dds, Some(delivery.qos()));
        Ok(Writer { writer: writer.map_err(|source| GraphError::endpoint(topic, source))? })
    }

    fn topic(&self, topic: &str, kind: &str, delivery: Delivery) -> Result<Topic, GraphError> {
        self.participant
            .create_topic(topic.into(), kind.into(), &delivery.qos(), TopicKind::NoKey)
            .map_err(|source| GraphError::endpoint(topic, source))
    }
}

impl<M: Received> Reader<M> {
    pub fn id(&self) -> EndpointId {
        EndpointId::of(self.reader.guid())
    }

    /// The messages that arrive. Unreadable messages are left out. The stream never ends. Dropping
    /// it between two messages loses none.
    pub fn samples(&self) -> impl Stream<Item = Sample<M>> + Send + '_ {
        self.reader
            .as_async_stream()
            .filter_map(|read| std::future::ready(read.ok().map(Sample::of)))
    }
}

impl<M> Sample<M> {
    fn of(change: DeserializedCacheChange<M>) -> Self {
        let writer = EndpointId::of(change.writer_guid());
        let answers = change.related_sample_identity();
        let number = i64::from(change.sequence_number);
        Self { message: change.into_value(), writer, number, answers }
    }
}

impl Writer {
    pub fn id(&self) -> EndpointId {
        EndpointId::of(self.writer.guid())
    }

    /// The writer's id as the DDS library's type.
    pub fn guid(&self) -> GUID {
        self.writer.guid()
    }

    /// Sends one message; `related` is the identity of the related request, where one is needed.
    pub async fn write(
        &self,
        message: Cdr,
        related: Option<SampleIdentity>,
    ) -> Result<SampleIdentity, GraphError> {
        let options = WriteOptionsBuilder::new().related_sample_identity_opt(related).build();
        self.writer
            .async_write_with_options(message, options)
            .await
            .map_err(|error| GraphError::Write { reason: format!("{error:?}") })
    }

    /// Sends one message without waiting; for writers that keep only the last message.
    pub fn put(&self, message: Cdr) {
        if let Err(error) = self.writer.write(message, None) {
            tracing::warn!(?error, "cannot announce the agent's node on the ROS graph");
        }
    }
}

/// Conversion of a message's bytes by a reader.
pub trait Received: Send + Sized + 'static {
    /// The accepted encodings; messages in other encodings are left out.
    const ENCODINGS: &'static [RepresentationIdentifier];

    fn from_body(encoding: RepresentationIdentifier, body: &[u8]) -> Self;
}

impl Received for Cdr {
    const ENCODINGS: &'static [RepresentationIdentifier] =
        &[RepresentationIdentifier::CDR_LE, RepresentationIdentifier::CDR_BE];

    fn from_body(encoding: RepresentationIdentifier, body: &[u8]) -> Self {
        // An empty body is no valid message of any type that is read here.
        let body = if body.len() <= MAX_MESSAGE_BYTES {
            Bytes::copy_from_slice(body)
        } else {
            Bytes::new()
        };
        Self { encoding, body }
    }
}

/// A message of which only the length is kept: the message is counted, not decoded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Counted {
    /// Length of the body in bytes.
    pub bytes: usize,
}

impl Received for Counted {
    const ENCODINGS: &'static [RepresentationIdentifier] = &[
        RepresentationIdentifier::CDR_LE,
        RepresentationIdentifier::CDR_BE,
        RepresentationIdentifier::PL_CDR_LE,
        RepresentationIdentifier::PL_CDR_BE,
        RepresentationIdentifier::CDR2_LE,
        RepresentationIdentifier::CDR2_BE,
        RepresentationIdentifier::D_CDR_LE,
        RepresentationIdentifier::D_CDR_BE,
        RepresentationIdentifier::XCDR2_LE,
        RepresentationIdentifier::XCDR2_BE,
    ];

    fn from_body(_encoding: RepresentationIdentifier, body: &[u8]) -> Self {
        Self { bytes: body.len() }
    }
}

/// Passes bytes through where the library expects a codec.
pub struct Adapter;

#[derive(Clone)]
pub struct PassThrough;

impl<M: Received> DeserializerAdapter<M> for Adapter {
    type Error = Infallible;
    type Decoded = M;

    fn supported_encodings() -> &'static [RepresentationIdentifier] {
        M::ENCODINGS
    }

    fn transform_decoded(decoded: M) -> M {
        decoded
    }
}

impl<M: Received> DefaultDecoder<M> for Adapter {
    type Decoder = PassThrough;
    const DECODER: PassThrough = PassThrough;
}

impl<M: Received> Decode<'_, M> for PassThrough {
    type Error = Infallible;

    fn decode_bytes(
        self,
        body: &[u8],
        encoding: RepresentationIdentifier,
    ) -> Result<M, Infallible> {
        Ok(M::from_body(encoding, body))
    }
}

impl SerializerAdapter<Cdr> for Adapter {
    type Error = Infallible;

    fn output_encoding() -> RepresentationIdentifier {
        RepresentationIdentifier::CDR_LE
    }

    fn to_bytes(value: &Cdr) -> Result<Bytes, Infallible> {
        Ok(value.body.clone())
    }
}
