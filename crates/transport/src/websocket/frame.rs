//! WebSocket frames (RFC 6455, section 5), both ways. Payload bytes are passed on as they arrive
//! and never gathered, so a long frame takes no memory. The module does no I/O.

use bytes::{Buf as _, BufMut as _, BytesMut};

/// The most a frame of control carries.
const MAX_CONTROL_BYTES: usize = 125;
/// Maximum size of an encoded header.
const MAX_HEADER_BYTES: usize = 14;
/// Close codes: the normal end, a protocol error, and a type of data that is not accepted.
pub(super) const NORMAL: u16 = 1000;
const PROTOCOL_ERROR: u16 = 1002;
const UNSUPPORTED_DATA: u16 = 1003;
const FIN: u8 = 0x80;
const RESERVED: u8 = 0x70;
const MASKED: u8 = 0x80;

/// Which end of a connection this is: the client masks its frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Role {
    /// The end that requested the connection.
    Client,
    /// The end that granted the connection.
    Server,
}

/// The type of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Opcode {
    /// Further bytes of the current message.
    Continuation,
    /// A message of bytes.
    Binary,
    /// The end of the connection.
    Close,
    /// A request for a pong.
    Ping,
    /// The answer to a ping.
    Pong,
}

/// A decoded part of the input.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Piece {
    /// Payload bytes for the reader.
    Data(BytesMut),
    /// To be answered with the same bytes.
    Ping(BytesMut),
    /// A pong, which needs no answer.
    Pong,
    /// A close frame, with its code if the other end sent one (RFC 6455, section 7.4).
    Close(Option<u16>),
}

/// The other end violated the protocol.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("invalid WebSocket frame: {reason}")]
pub struct Violation {
    reason: &'static str,
    code: u16,
}

impl Violation {
    pub(super) const fn new(reason: &'static str) -> Self {
        Self { reason, code: PROTOCOL_ERROR }
    }

    /// The code for the close frame.
    pub fn code(&self) -> u16 {
        self.code
    }
}

/// A decoder of frames that takes input in any pieces.
#[derive(Debug)]
pub struct Decoder {
    /// The role of this end of the connection.
    role: Role,
    frame: Option<Frame>,
    /// Whether a message has begun and not ended.
    is_in_message: bool,
}

/// A frame whose header has been read.
#[derive(Debug)]
struct Frame {
    opcode: Opcode,
    mask: [u8; 4],
    /// Of the payload, from its beginning.
    passed: u64,
    left: u64,
}

impl Decoder {
    /// For this end of a connection.
    pub fn new(role: Role) -> Self {
        Self { role, frame: None, is_in_message: false }
    }

    /// Decodes the next piece from the front of `input`; `None` until more bytes arrive.
    pub fn decode(&mut self, input: &mut BytesMut) -> Result<Option<Piece>, Violation> {
        let frame = match &mut self.frame {
            Some(frame) => frame,
            none => {
                let Some(frame) = read_header(self.role, &mut self.is_in_message, input)? else {
                    return Ok(None);
                };
                none.insert(frame)
            }
        };
        let is_data = matches!(frame.opcode, Opcode::Binary | Opcode::Continuation);
        let here = usize::try_from(frame.left).unwrap_or(usize::MAX).min(input.len());
        if (here as u64) < frame.left && (here == 0 || !is_data) {
            return Ok(None);
        }
        let mut payload = input.split_to(here);
        apply_mask(&mut payload, frame.mask, frame.passed);
        frame.passed += here as u64;
        frame.left -= here as u64;
        let opcode = frame.opcode;
        if frame.left == 0 {
            self.frame = None;
        }
        Ok(Some(match opcode {
            Opcode::Binary | Opcode::Continuation => Piece::Data(payload),
            Opcode::Ping => Piece::Ping(payload),
            Opcode::Pong => Piece::Pong,
            Opcode::Close => Piece::Close(close_code(&payload)?),
        }))
    }
}

fn read_header(
    role: Role,
    is_in_message: &mut bool,
    input: &mut BytesMut,
) -> Result<Option<Frame>, Violation> {
    let &[first, second, ..] = &input[..] else { return Ok(None) };
    if first & RESERVED != 0 {
        return Err(Violation::new("an extension that was not agreed on"));
    }
    let opcode = match first & 0x0f {
        0 => Opcode::Continuation,
        2 => Opcode::Binary,
        8 => Opcode::Close,
        9 => Opcode::Ping,
        10 => Opcode::Pong,
        1 => {
            return Err(Violation {
                reason: "a text frame; MQTT needs binary frames",
                code: UNSUPPORTED_DATA,
            });
        }
        _ => return Err(Violation::new("an unknown opcode")),
    };
    let is_masked = second & MASKED != 0;
    if is_masked != (role == Role::Server) {
        return Err(Violation::new(
            "the masking is wrong: clients mask their frames, servers do not",
        ));
    }
    let short = second & !MASKED;
    let length_bytes = match short {
        126 => 2,
        127 => 8,
        _ => 0,
    };
    if input.len() < 2 + length_bytes + if is_masked { 4 } else { 0 } {
        return Ok(None);
    }
    let is_last = first & FIN != 0;
    match opcode {
        Opcode::Binary if *is_in_message => {
            return Err(Violation::new("a new message inside of another"));
        }
        Opcode::Continuation if !*is_in_message => {
            return Err(Violation::new("a continuation without a message"));
        }
        Opcode::Binary | Opcode::Continuation => *is_in_message = !is_last,
        _ if !is_last || usize::from(short) > MAX_CONTROL_BYTES => {
            return Err(Violation::new("a frame of control that is long or in parts"));
        }
        _ => {}
    }
    input.advance(2);
    let left = match length_bytes {
        2 => u64::from(input.get_u16()),
        8 => input.get_u64(),
        _ => u64::from(short),
    };
    if left > u64::MAX >> 1 {
        return Err(Violation::new("a length of more than 63 bits"));
    }
    let mut mask = [0; 4];
    if is_masked {
        input.copy_to_slice(&mut mask);
    }
    Ok(Some(Frame { opcode, mask, passed: 0, left }))
}

/// The close code of the other end; absent if its close frame has none.
fn close_code(payload: &[u8]) -> Result<Option<u16>, Violation> {
    let &[high, low, ..] = payload else {
        return if payload.is_empty() {
            Ok(None)
        } else {
            Err(Violation::new("a truncated close code"))
        };
    };
    let code = u16::from_be_bytes([high, low]);
    // The others are reserved, or never sent.
    let is_valid = matches!(code, 1000..=1003 | 1007..=1014 | 3000..=4999);
    if is_valid { Ok(Some(code)) } else { Err(Violation::new("an invalid close code")) }
}

/// Appends a whole frame to `output`. `mask` is random for a client.
pub fn encode(opcode: Opcode, payload: &[u8], mask: Option<[u8; 4]>, output: &mut BytesMut) {
    output.reserve(MAX_HEADER_BYTES + payload.len());
    output.put_u8(
        FIN | match opcode {
            Opcode::Continuation => 0,
            Opcode::Binary => 2,
            Opcode::Close => 8,
            Opcode::Ping => 9,
            Opcode::Pong => 10,
        },
    );
    let masked = if mask.is_some() { MASKED } else { 0 };
    match payload.len() {
        length @ 0..=125 => output.put_u8(masked | length as u8),
        length @ 126..=0xffff => {
            output.put_u8(masked | 126);
            output.put_u16(length as u16);
        }
        length => {
            output.put_u8(masked | 127);
            output.put_u64(length as u64);
        }
    }
    if let Some(mask) = mask {
        output.put_slice(&mask);
    }
    let begin = output.len();
    output.put_slice(payload);
    apply_mask(&mut output[begin..], mask.unwrap_or_default(), 0);
}

/// Masks or unmasks `bytes`; `passed` bytes of the same payload came before.
fn apply_mask(bytes: &mut [u8], mask: [u8; 4], passed: u64) {
    if mask == [0; 4] {
        return;
    }
    let rotated: [u8; 4] = std::array::from_fn(|at| mask[(at + (passed % 4) as usize) % 4]);
    for chunk in bytes.chunks_mut(4) {
        chunk.iter_mut().zip(rotated).for_each(|(byte, mask)| *byte ^= mask);
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn pieces(role: Role, bytes: &[u8], step: usize) -> Result<Vec<Piece>, Violation> {
        let (mut decoder, mut input, mut pieces) =
            (Decoder::new(role), BytesMut::new(), Vec::new());
        for chunk in bytes.chunks(step.max(1)) {
            input.extend_from_slice(chunk);
            while let Some(piece) = decoder.decode(&mut input)? {
                pieces.push(piece);
            }
        }
        Ok(pieces)
    }

    #[test]
    fn frames_match_the_examples_of_the_rfc() {
        // RFC 6455, section 5.7, in binary: "Hello" masked, and in two fragments.
        let masked = [0x82, 0x85, 0x37, 0xfa, 0x21, 0x3d, 0x7f, 0x9f, 0x4d, 0x51, 0x58];
        assert_eq!(pieces(Role::Server, &masked, 99), Ok(vec![Piece::Data(b"Hello"[..].into())]));
        let mut encoded = BytesMut::new();
        encode(Opcode::Binary, b"Hello", Some([0x37, 0xfa, 0x21, 0x3d]), &mut encoded);
        assert_eq!(&encoded[..], masked);
        let fragments = [0x02, 0x03, 0x48, 0x65, 0x6c, 0x80, 0x02, 0x6c, 0x6f];
        let came = vec![Piece::Data(b"Hel"[..].into()), Piece::Data(b"lo"[..].into())];
        assert_eq!(pieces(Role::Client, &fragments, 99), Ok(came));
        let ping = [0x89, 0x05, 0x48, 0x65, 0x6c, 0x6c, 0x6f];
        assert_eq!(pieces(Role::Client, &ping, 1), Ok(vec![Piece::Ping(b"Hello"[..].into())]));
    }

    #[test]
    fn invalid_frames_are_refused() {
        for (bytes, role) in [
            (&[0x82, 0x05][..], Role::Server),
            (&[0x82, 0x85], Role::Client),
            (&[0xc2, 0x00], Role::Client),
            (&[0x81, 0x00], Role::Client),
            (&[0x83, 0x00], Role::Client),
            (&[0x80, 0x00], Role::Client),
            (&[0x09, 0x00], Role::Client),
            (&[0x89, 0x7e, 0x00, 0x7e], Role::Client),
            (&[0x02, 0x00, 0x82, 0x00], Role::Client),
            (&[0x82, 0x7f, 0x80, 0, 0, 0, 0, 0, 0, 0], Role::Client),
            (&[0x88, 0x01, 3], Role::Client),
            (&[0x88, 0x02, 0x03, 0xed], Role::Client),
        ] {
            let code = pieces(role, bytes, 99).expect_err("refused").code();
            assert_eq!(code, if bytes[0] == 0x81 { 1003 } else { 1002 }, "{bytes:x?}");
        }
        let close = [0x88, 0x05, 0x03, 0xe9, b'b', b'y', b'e'];
        assert_eq!(pieces(Role::Client, &close, 1), Ok(vec![Piece::Close(Some(1001))]));
        assert_eq!(pieces(Role::Client, &[0x88, 0], 1), Ok(vec![Piece::Close(None)]));
    }

    #[test]
    fn endless_frame_takes_no_memory() {
        let (mut decoder, mut input) = (Decoder::new(Role::Client), BytesMut::new());
        input.extend_from_slice(&[0x82, 0x7f, 0x7f, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff]);
        for _ in 0..1000 {
            input.extend_from_slice(&[7; 1000]);
            let piece = decoder.decode(&mut input).expect("a frame").expect("a piece");
            assert_eq!(piece, Piece::Data([7; 1000][..].into()));
            assert!(input.is_empty());
        }
    }

    proptest! {
        #[test]
        fn sent_bytes_arrive_however_they_are_split(
            messages in prop::collection::vec(prop::collection::vec(any::<u8>(), 0..300), 1..8),
            mask in any::<[u8; 4]>(),
            step in 1usize..400,
        ) {
            for (role, mask) in [(Role::Server, Some(mask)), (Role::Client, None)] {
                let mut sent = BytesMut::new();
                for message in &messages {
                    encode(Opcode::Binary, message, mask, &mut sent);
                    encode(Opcode::Ping, &message[..message.len().min(125)], mask, &mut sent);
                }
                let (mut data, mut pings) = (Vec::new(), Vec::new());
                for piece in pieces(role, &sent, step).expect("valid") {
                    match piece {
                        Piece::Data(bytes) => data.extend_from_slice(&bytes),
                        Piece::Ping(bytes) => pings.push(bytes.to_vec()),
                        other => prop_assert!(false, "{other:?}"),
                    }
                }
                prop_assert_eq!(data, messages.concat());
                let first = |m: &Vec<u8>| m[..m.len().min(125)].to_vec();
                let asked: Vec<Vec<u8>> = messages.iter().map(first).collect();
                prop_assert_eq!(pings, asked);
            }
        }

        #[test]
        fn arbitrary_bytes_do_not_panic(
            bytes in prop::collection::vec(any::<u8>(), 0..600), step in 1usize..64
        ) {
            for role in [Role::Client, Role::Server] {
                let pieces = pieces(role, &bytes, step).unwrap_or_default();
                let handed_out: usize = pieces.iter().map(|piece| match piece {
                    Piece::Data(bytes) | Piece::Ping(bytes) => bytes.len(),
                    Piece::Pong | Piece::Close(_) => 0,
                }).sum();
                prop_assert!(handed_out <= bytes.len());
            }
        }
    }
}
