//! Decodes clients' packets: MQTT 3.1.1, strictly. We do not use rumqttd's decoder, because it
//! overlooks wrong flags, trailing bytes, zero packet ids and bad filters, some of which kill its
//! router; we do use its encoder. This module never answers and holds no state between packets.

use bytes::{Buf, BufMut, Bytes, BytesMut};
use rumqttd::protocol::v4::{V4, write_remaining_length};
use rumqttd::protocol::{Packet, Protocol, QoS};

/// A packet from a client. All checks that need no session state are done.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Received {
    Connect(Connect),
    Publish(Publish),
    /// PUBACK, of the packet with this id.
    PubAck(u16),
    /// PUBREC, of the packet with this id.
    PubRec(u16),
    /// PUBREL, of the packet with this id.
    PubRel(u16),
    /// PUBCOMP, of the packet with this id.
    PubComp(u16),
    Subscribe {
        /// The packet id that the SUBACK repeats.
        packet_id: u16,
        /// The filters and the requested QoS, at least one.
        filters: Vec<(String, QoS)>,
    },
    Unsubscribe {
        /// The packet id that the UNSUBACK repeats.
        packet_id: u16,
        /// The filters, at least one.
        filters: Vec<String>,
    },
    PingReq,
    Disconnect,
}

impl Received {
    /// Whether the packet only answers one of ours.
    pub(super) fn is_answer(&self) -> bool {
        matches!(self, Self::PubAck(_) | Self::PubRec(_) | Self::PubRel(_) | Self::PubComp(_))
    }
}

/// The fields of CONNECT.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Connect {
    /// Empty if the server chooses.
    pub client_id: String,
    /// Whether to discard the state of an earlier session.
    pub clean_session: bool,
    /// The keepalive in seconds; 0: none.
    pub keep_alive_s: u16,
    /// The message to publish when the client is gone.
    pub will: Option<Will>,
    /// The claimed user name.
    pub user_name: Option<String>,
    /// The credential for the user name.
    pub password: Option<String>,
}

/// A message to publish after an end without DISCONNECT.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Will {
    pub topic: String,
    pub payload: Bytes,
    /// The quality of service.
    pub qos: QoS,
}

/// A message. The packet id is 0 for QoS 0.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Publish {
    /// The topic: a name without wildcards.
    pub topic: String,
    /// The quality of service.
    pub qos: QoS,
    /// The packet id that the acknowledgement repeats.
    pub packet_id: u16,
    pub payload: Bytes,
}

/// The reason why bytes are not an acceptable packet.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum DecodeError {
    /// An MQTT version of this protocol level, which we do not support.
    #[error("requests protocol level {0}; only MQTT 3.1.1 (level 4) is supported")]
    UnknownProtocol(u8),
    /// A server must keep a retained message of QoS 1 or 2 (MQTT-3.3.1-5), and this server keeps
    /// none. A retained message without a payload asks to keep nothing.
    #[error("publishes a retained message; retained messages are not supported")]
    Retained,
    /// The packet has this many bytes, more than permitted.
    #[error("sends a packet of {0} bytes, which is too large")]
    TooLarge(usize),
    /// The bytes are not MQTT.
    #[error("sends a malformed packet: {0}")]
    Malformed(&'static str),
}

use DecodeError::Malformed;

/// Takes one packet off the front of `input`; `None` if more bytes are needed. Errors are reported
/// as early as the bytes show them, so that no session waits for the rest of a packet that will be
/// refused.
pub fn decode(input: &mut BytesMut, max_bytes: usize) -> Result<Option<Received>, DecodeError> {
    let Some(&first) = input.first() else { return Ok(None) };
    check_first_byte(first)?;
    let Some((length, header_bytes)) = remaining_length(&input[1..])? else { return Ok(None) };
    if length > max_bytes {
        return Err(DecodeError::TooLarge(length));
    }
    let whole = 1 + header_bytes + length;
    if input.len() < whole {
        return Ok(None);
    }
    let mut body = input.split_to(whole).freeze();
    body.advance(1 + header_bytes);
    decode_body(first, Body(body)).map(Some)
}

/// Encodes one of our own packets.
pub(super) fn encode(packet: Packet, output: &mut BytesMut) {
    if let Err(error) = V4.write(packet, output) {
        // Our packets are bounded and complete, so this is a bug; the client notices a missing
        // packet by itself.
        tracing::error!(%error, "could not encode an MQTT packet");
    }
}

/// Encodes a PUBLISH; rumqttd's API can't build one with a QoS.
pub fn encode_publish(publish: &Publish, output: &mut BytesMut) {
    let Publish { topic, qos, packet_id, payload } = publish;
    if encode_publish_head(topic, *qos, *packet_id, payload.len(), output) {
        output.put_slice(payload);
    }
}

/// Encodes a PUBLISH without its payload. Returns false and writes nothing if the packet would be
/// too large for MQTT.
pub(super) fn encode_publish_head(
    topic: &str,
    qos: QoS,
    packet_id: u16,
    payload_bytes: usize,
    output: &mut BytesMut,
) -> bool {
    let (has_id, before) = (qos != QoS::AtMostOnce, output.len());
    let length = 2 + topic.len() + if has_id { 2 } else { 0 } + payload_bytes;
    output.put_u8(0x30 | (qos as u8) << 1);
    let (Ok(topic_bytes), Ok(_)) =
        (u16::try_from(topic.len()), write_remaining_length(output, length))
    else {
        output.truncate(before);
        tracing::error!(length, "could not encode an MQTT message");
        return false;
    };
    output.put_u16(topic_bytes);
    output.put_slice(topic.as_bytes());
    if has_id {
        output.put_u16(packet_id);
    }
    true
}

/// Checks the packet type and its flags.
fn check_first_byte(first: u8) -> Result<(), DecodeError> {
    let flags = first & 0x0f;
    match first >> 4 {
        3 if flags & 0b0110 == 0b0110 => Err(Malformed("PUBLISH with QoS 3")),
        3 if flags & 0b1110 == 0b1000 => Err(Malformed("PUBLISH with DUP and QoS 0")),
        3 => Ok(()),
        6 | 8 | 10 if flags == 0b0010 => Ok(()),
        1 | 4 | 5 | 7 | 12 | 14 if flags == 0 => Ok(()),
        1 | 4..=8 | 10 | 12 | 14 => Err(Malformed("reserved flags are set")),
        2 | 9 | 11 | 13 => Err(Malformed("a packet that only servers send")),
        _ => Err(Malformed("unknown packet type")),
    }
}

/// The remaining length and the number of bytes that encode it; `None` if incomplete.
fn remaining_length(input: &[u8]) -> Result<Option<(usize, usize)>, DecodeError> {
    let mut length = 0;
    for (index, byte) in input.iter().take(4).enumerate() {
        length |= usize::from(byte & 0x7f) << (7 * index);
        if byte & 0x80 == 0 {
            return Ok(Some((length, index + 1)));
        }
    }
    if input.len() >= 4 {
        Err(Malformed("remaining length of more than four bytes"))
    } else {
        Ok(None)
    }
}

fn decode_body(first: u8, mut body: Body) -> Result<Received, DecodeError> {
    let received = match first >> 4 {
        1 => Received::Connect(connect(&mut body)?),
        3 => return publish(first, body).map(Received::Publish),
        4 => Received::PubAck(body.packet_id()?),
        5 => Received::PubRec(body.packet_id()?),
        6 => Received::PubRel(body.packet_id()?),
        7 => Received::PubComp(body.packet_id()?),
        8 => Received::Subscribe {
            packet_id: body.packet_id()?,
            filters: body.list(filter_with_qos)?,
        },
        10 => Received::Unsubscribe { packet_id: body.packet_id()?, filters: body.list(filter)? },
        12 => Received::PingReq,
        _ => Received::Disconnect,
    };
    if body.0.is_empty() {
        Ok(received)
    } else {
        Err(Malformed("bytes after the end of the packet"))
    }
}

fn connect(body: &mut Body) -> Result<Connect, DecodeError> {
    let name = body.binary()?;
    let level = body.byte()?;
    match (&name[..], level) {
        (b"MQTT", 4) => {}
        // 3.1, 5.0 and future versions: the answer is a CONNACK with that reason.
        (b"MQTT", level) | (b"MQIsdp", level @ 3) => {
            return Err(DecodeError::UnknownProtocol(level));
        }
        _ => return Err(Malformed("not the protocol name MQTT")),
    }
    let flags = body.byte()?;
    let will_bits = flags & 0b0011_1000;
    if flags & 1 != 0 {
        return Err(Malformed("CONNECT with the reserved flag"));
    }
    if flags & 0b100 == 0 && will_bits != 0 {
        return Err(Malformed("CONNECT with a will's flags, but no will"));
    }
    if flags & 0b1100_0000 == 0b0100_0000 {
        return Err(Malformed("CONNECT with a password, but no user name"));
    }
    let will_qos = qos((flags >> 3) & 0b11)?;
    let keep_alive_s = body.number()?;
    let client_id = body.text()?;
    let will = if flags & 0b100 == 0 {
        None
    } else {
        let will = Will { topic: topic_name(body)?, payload: body.binary()?, qos: will_qos };
        check_retained(flags & 0b10_0000 != 0, &will.payload)?;
        Some(will)
    };
    let user_name = if flags & 0b1000_0000 == 0 { None } else { Some(body.text()?) };
    // A password may be any bytes; ours are text, so a password that loses bytes here would have
    // been refused anyway.
    let password = match flags & 0b0100_0000 {
        0 => None,
        _ => Some(String::from_utf8_lossy(&body.binary()?).into_owned()),
    };
    Ok(Connect {
        client_id,
        clean_session: flags & 0b10 != 0,
        keep_alive_s,
        will,
        user_name,
        password,
    })
}

fn publish(first: u8, mut body: Body) -> Result<Publish, DecodeError> {
    let qos = qos((first >> 1) & 0b11)?;
    let topic = topic_name(&mut body)?;
    let packet_id = if qos == QoS::AtMostOnce { 0 } else { body.packet_id()? };
    check_retained(first & 1 != 0, &body.0)?;
    Ok(Publish { topic, qos, packet_id, payload: body.0 })
}

fn check_retained(is_retained: bool, payload: &[u8]) -> Result<(), DecodeError> {
    if is_retained && !payload.is_empty() { Err(DecodeError::Retained) } else { Ok(()) }
}

fn qos(bits: u8) -> Result<QoS, DecodeError> {
    rumqttd::protocol::qos(bits).ok_or(Malformed("QoS 3"))
}

fn topic_name(body: &mut Body) -> Result<String, DecodeError> {
    let name = body.text()?;
    if name.is_empty() || name.contains(['+', '#']) {
        return Err(Malformed("a topic name that is empty or has wildcards"));
    }
    Ok(name)
}

fn filter(body: &mut Body) -> Result<String, DecodeError> {
    let filter = body.text()?;
    let levels = filter.split('/').count();
    let level_ok = |(index, level): (usize, &str)| match level {
        "+" => true,
        "#" => index + 1 == levels,
        _ => !level.contains(['+', '#']),
    };
    if filter.is_empty() || !filter.split('/').enumerate().all(level_ok) {
        return Err(Malformed("a topic filter that is empty or has misplaced wildcards"));
    }
    Ok(filter)
}

fn filter_with_qos(body: &mut Body) -> Result<(String, QoS), DecodeError> {
    Ok((filter(body)?, qos(body.byte()?)?))
}

/// The undecoded rest of a packet.
struct Body(Bytes);

impl Body {
    fn byte(&mut self) -> Result<u8, DecodeError> {
        self.0.try_get_u8().map_err(|_| Malformed("the packet ends too early"))
    }

    fn number(&mut self) -> Result<u16, DecodeError> {
        self.0.try_get_u16().map_err(|_| Malformed("the packet ends too early"))
    }

    fn packet_id(&mut self) -> Result<u16, DecodeError> {
        match self.number()? {
            0 => Err(Malformed("packet id 0")),
            id => Ok(id),
        }
    }

    fn binary(&mut self) -> Result<Bytes, DecodeError> {
        let length = usize::from(self.number()?);
        if length > self.0.len() {
            return Err(Malformed("the packet ends too early"));
        }
        Ok(self.0.split_to(length))
    }

    fn text(&mut self) -> Result<String, DecodeError> {
        let bytes = self.binary()?;
        match std::str::from_utf8(&bytes) {
            Ok(text) if !text.contains('\0') => Ok(text.to_owned()),
            _ => Err(Malformed("text that is not UTF-8 or has a NUL")),
        }
    }

    /// One or more of `item`, to the end.
    fn list<T>(
        &mut self,
        item: fn(&mut Self) -> Result<T, DecodeError>,
    ) -> Result<Vec<T>, DecodeError> {
        let mut items = vec![item(self)?];
        while !self.0.is_empty() {
            items.push(item(self)?);
        }
        Ok(items)
    }
}
