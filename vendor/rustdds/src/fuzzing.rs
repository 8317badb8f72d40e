//! What a Participant does with the datagrams it receives, without sockets and
//! threads: for fuzzers, which can give it any bytes and see whether it panics,
//! hangs or takes memory for them.

use std::{
  cell::RefCell,
  net::{IpAddr, Ipv4Addr, SocketAddr},
  rc::Rc,
  sync::{Arc, Mutex, RwLock},
};

use bytes::Bytes;

use crate::{
  dds::{
    qos::{QosPolicies, QosPolicyBuilder},
    statusevents::sync_status_channel,
    typedesc::TypeDesc,
  },
  discovery::{
    discovery::Discovery,
    discovery_db::DiscoveryDB,
    sedp_messages::{DiscoveredReaderData, DiscoveredTopicData, DiscoveredWriterData},
    spdp_participant_data::SpdpDiscoveredParticipantData,
  },
  mio_source,
  network::{udp_listener::PacketOrigin, udp_sender::UDPSender},
  polling::{new_shared_timer, wake_channel, LoopWaker, WakeReceiver},
  rtps::{
    message_receiver::MessageReceiver,
    reader::{Reader, ReaderIngredients},
    rtps_writer_proxy::RtpsWriterProxy,
    transmit::InterfaceObservations,
  },
  serialization::pl_cdr_adapters::PlCdrDeserialize,
  structure::{
    dds_cache::DDSCache,
    duration::Duration,
    guid::{EntityId, EntityKind, GuidPrefix, GUID},
  },
  RepresentationIdentifier,
};

/// The GUID prefix of the remote Participant whose Writers are matched with the
/// Readers here.
pub const REMOTE_PREFIX: [u8; 12] = *b"\x01\x0fremotehost";

const OWN_PREFIX: [u8; 12] = *b"\x01\x0freceiving!";

/// Receives datagrams.
pub struct Receiver {
  receiver: MessageReceiver,
  dds_cache: Arc<RwLock<DDSCache>>,
  discovery_db: DiscoveryDB,
  // What is sent to these is of no use, but there must be somebody to send it to.
  _kept: Vec<Box<dyn std::any::Any>>,
}

impl Default for Receiver {
  fn default() -> Self {
    Self::new()
  }
}

impl Receiver {
  /// A receiver with the built-in Readers of discovery, and two of an
  /// application: a reliable and a best-effort one.
  ///
  /// # Panics
  ///
  /// If there are no sockets to be had.
  #[allow(clippy::unwrap_used)]
  pub fn new() -> Self {
    let waker = LoopWaker::new();
    let own = GuidPrefix::new(&OWN_PREFIX);
    let (acknack_sender, acknack_receiver) = wake_channel(64, &waker);
    let (spdp_liveness_sender, spdp_liveness_receiver) = wake_channel(64, &waker);
    let observations = Rc::new(RefCell::new(InterfaceObservations::new()));
    let mut receiver = MessageReceiver::new(
      own,
      acknack_sender,
      spdp_liveness_sender,
      None,
      observations,
    );
    let dds_cache = Arc::new(RwLock::new(DDSCache::new()));
    let mut kept: Vec<Box<dyn std::any::Any>> =
      vec![Box::new(acknack_receiver), Box::new(spdp_liveness_receiver)];
    let remote = GuidPrefix::new(&REMOTE_PREFIX);
    let user = |reader: bool, number: u8| {
      let kind = if reader {
        EntityKind::READER_NO_KEY_USER_DEFINED
      } else {
        EntityKind::WRITER_NO_KEY_USER_DEFINED
      };
      EntityId::new([0, 0, number], kind)
    };
    let sedp = Discovery::builtin_sedp_reader_qos();
    let best_effort = QosPolicyBuilder::new().best_effort().build();
    let readers = [
      (
        EntityId::SPDP_BUILTIN_PARTICIPANT_READER,
        EntityId::SPDP_BUILTIN_PARTICIPANT_WRITER,
        Discovery::create_spdp_participant_qos(),
      ),
      (
        EntityId::SEDP_BUILTIN_PUBLICATIONS_READER,
        EntityId::SEDP_BUILTIN_PUBLICATIONS_WRITER,
        sedp.clone(),
      ),
      (
        EntityId::SEDP_BUILTIN_SUBSCRIPTIONS_READER,
        EntityId::SEDP_BUILTIN_SUBSCRIPTIONS_WRITER,
        sedp.clone(),
      ),
      (user(true, 1), user(false, 1), sedp),
      (user(true, 2), user(false, 2), best_effort),
    ];
    let loopback = [IpAddr::V4(Ipv4Addr::LOCALHOST)];
    let sender = Rc::new(UDPSender::new_with_networks(0, Some(&loopback[..]), 0).unwrap());
    for (number, (reader, writer, qos)) in readers.into_iter().enumerate() {
      let reader = GUID::new_with_prefix_and_id(own, reader);
      let writer = GUID::new_with_prefix_and_id(remote, writer);
      let (reader, others) = make_reader(reader, number, &qos, &dds_cache, &sender);
      kept.extend(others);
      let mut reader = reader;
      let proxy = RtpsWriterProxy::new(writer, vec![], vec![], EntityId::UNKNOWN);
      reader.update_writer_proxy(proxy, &qos);
      receiver.add_reader(reader);
    }
    let (topic_sender, topic_receiver) = std::sync::mpsc::sync_channel(4);
    let (status_sender, status_receiver) = sync_status_channel(16).unwrap();
    kept.extend([
      Box::new(topic_receiver) as Box<dyn std::any::Any>,
      Box::new(status_receiver),
    ]);
    let own = GUID::new_with_prefix_and_id(own, EntityId::PARTICIPANT);
    Self {
      receiver,
      dds_cache,
      discovery_db: DiscoveryDB::new(own, topic_sender, status_sender),
      _kept: kept,
    }
  }

  /// Does with this datagram what a Participant does.
  pub fn datagram(&mut self, bytes: &[u8]) {
    let origin = PacketOrigin {
      source: Some(SocketAddr::from((Ipv4Addr::LOCALHOST, 7400))),
      local_if: None,
    };
    self
      .receiver
      .handle_received_packet(&Bytes::copy_from_slice(bytes), origin);
  }

  /// Does what is done now and then.
  pub fn idle(&mut self) {
    self.receiver.garbage_collect_fragments();
    if let Ok(mut cache) = self.dds_cache.write() {
      cache.garbage_collect();
    }
  }

  /// Reads a sample of a discovery topic as each of them, and remembers what it
  /// says as discovery does.
  pub fn discovery_sample(&mut self, bytes: &[u8]) {
    let encoding = RepresentationIdentifier::PL_CDR_LE;
    let db = &mut self.discovery_db;
    if let Ok(mut data) = SpdpDiscoveredParticipantData::from_pl_cdr_bytes(bytes, encoding) {
      // It is gone before the next one comes, or the limit would be all that is
      // seen.
      data.lease_duration = Some(Duration::ZERO);
      if db.has_room_for_participant(&data) {
        db.update_participant(&data);
        db.participant_cleanup();
      }
    }
    if let Ok(data) = DiscoveredReaderData::from_pl_cdr_bytes(bytes, encoding) {
      if db.has_room_for_reader(&data) {
        db.update_subscription(&data);
        db.remove_topic_reader(data.reader_proxy.remote_reader_guid);
      }
    }
    if let Ok(data) = DiscoveredWriterData::from_pl_cdr_bytes(bytes, encoding) {
      if db.has_room_for_writer(&data) {
        db.update_publication(&data);
        db.remove_topic_writer(data.writer_proxy.remote_writer_guid);
      }
    }
    let _ = DiscoveredTopicData::from_pl_cdr_bytes(bytes, encoding);
    db.topic_cleanup();
  }
}

#[allow(clippy::unwrap_used)]
fn make_reader(
  guid: GUID,
  number: usize,
  qos: &QosPolicies,
  dds_cache: &Arc<RwLock<DDSCache>>,
  sender: &Rc<UDPSender>,
) -> (Reader, Vec<Box<dyn std::any::Any>>) {
  let topic_name = format!("topic {number}");
  let topic_cache_handle = dds_cache.write().unwrap().add_new_topic(
    topic_name.clone(),
    TypeDesc::new("type".to_string()),
    qos,
  );
  let (notification_sender, notifications) = mio_source::notification_channel(4);
  let (poll_events, poll_event_sender) = mio_source::make_poll_channel().unwrap();
  let (status_sender, statuses) = sync_status_channel(4).unwrap();
  let (participant_status_sender, participant_statuses) = sync_status_channel(16).unwrap();
  let (commands, data_reader_command_receiver): (_, WakeReceiver<_>) =
    wake_channel(4, &LoopWaker::new());
  let ingredients = ReaderIngredients {
    guid,
    notification_sender,
    status_sender,
    topic_name,
    topic_cache_handle,
    like_stateless: false,
    qos_policy: qos.clone(),
    data_reader_command_receiver,
    data_reader_waker: Arc::new(Mutex::new(None)),
    poll_event_sender,
    security_plugins: None,
    discovery_notify: None,
  };
  let reader = Reader::new(
    ingredients,
    sender.clone(),
    new_shared_timer(),
    participant_status_sender,
  );
  let kept: Vec<Box<dyn std::any::Any>> = vec![
    Box::new(notifications),
    Box::new(poll_events),
    Box::new(statuses),
    Box::new(participant_statuses),
    Box::new(commands),
  ];
  (reader, kept)
}
