//! The frames that carry MQTT over HTTP, as either end takes them apart.

use bytes::BytesMut;
use task_transport::websocket::frame::{Decoder, Opcode, Piece, Role, Violation, encode};

/// Frames: the result does not depend on how the bytes are split, and the payload arrives unchanged
/// when sent on.
pub fn websocket(bytes: &[u8]) {
    for role in [Role::Server, Role::Client] {
        let whole = read(role, bytes, bytes.len());
        for piece_bytes in [1, 7] {
            assert_eq!(read(role, bytes, piece_bytes), whole, "it depends on the pieces");
        }
        let data: Vec<u8> = whole.0.iter().filter_map(Received::data).flatten().copied().collect();
        let mut sent = BytesMut::new();
        encode(Opcode::Binary, &data, (role == Role::Server).then_some([1, 2, 3, 4]), &mut sent);
        let again = if data.is_empty() { vec![] } else { vec![Received::Data(data)] };
        assert_eq!(read(role, &sent, sent.len()), (again, None));
    }
}

/// A received message, with fragmented data joined.
#[derive(Debug, PartialEq)]
enum Received {
    Data(Vec<u8>),
    Other(Piece),
}

impl Received {
    fn data(&self) -> Option<&Vec<u8>> {
        match self {
            Self::Data(data) => Some(data),
            Self::Other(_) => None,
        }
    }
}

fn read(role: Role, bytes: &[u8], piece_bytes: usize) -> (Vec<Received>, Option<Violation>) {
    let (mut all, mut decoder, mut input) = (Vec::new(), Decoder::new(role), BytesMut::new());
    for piece in bytes.chunks(piece_bytes.max(1)) {
        input.extend_from_slice(piece);
        loop {
            match (decoder.decode(&mut input), all.last_mut()) {
                (Ok(None), _) => break,
                (Ok(Some(Piece::Data(data))), _) if data.is_empty() => {}
                (Ok(Some(Piece::Data(data))), Some(Received::Data(before))) => {
                    before.extend_from_slice(&data)
                }
                (Ok(Some(Piece::Data(data))), _) => all.push(Received::Data(data.to_vec())),
                (Ok(Some(other)), _) => all.push(Received::Other(other)),
                (Err(violation), _) => return (all, Some(violation)),
            }
        }
    }
    (all, None)
}
