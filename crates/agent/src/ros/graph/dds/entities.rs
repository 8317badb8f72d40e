//! `rmw_dds_common/msg/ParticipantEntitiesInfo`, in which each participant lists its nodes and
//! their readers and writers. The message format changed: a gid is 24 bytes up to Humble and 16
//! from Iron on. No field of the message names the format, but only one of the two lengths fits the
//! message. The bytes come from untrusted senders: every count and length has a limit, and a
//! message that does not fit is refused as a whole.

use task_proto::telemetry::ros::GraphName;

use crate::ros::graph::{EndpointId, ParticipantId};

/// Maximum number of nodes of one participant.
pub const MAX_NODES: usize = 256;
/// Maximum number of readers, and of writers, of one node.
pub const MAX_ENDPOINTS: usize = 2048;
/// Maximum size of a message in bytes.
pub const MAX_BYTES: usize = 1024 * 1024;
/// Maximum length of a namespace and of a name, in bytes.
const MAX_NAME_BYTES: usize = 256;

/// The two lengths a gid can have.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum GidForm {
    /// Up to Humble: the 16 bytes of a DDS GUID and 8 zeros.
    Bytes24,
    Bytes16,
}

/// A participant's message about itself.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ParticipantEntities {
    pub participant: ParticipantId,
    pub nodes: Vec<NodeEntities>,
    /// Number of nodes that were left out because ROS does not allow their names.
    pub misnamed: usize,
}

/// One node of a participant.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NodeEntities {
    /// The node's full name.
    pub name: GraphName,
    pub readers: Vec<EndpointId>,
    pub writers: Vec<EndpointId>,
}

/// Reasons why bytes are not a valid message.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum EntitiesError {
    /// The message exceeds the size limit.
    #[error("{0} bytes, the limit is {MAX_BYTES}")]
    TooLong(usize),
    /// The message fits neither length of gid.
    #[error("not a ParticipantEntitiesInfo with gids of 16 or 24 bytes, or one beyond the limits")]
    Malformed,
}

impl GidForm {
    /// The form that nodes of this distribution use; an unknown distribution is treated as a new
    /// one.
    pub fn of_distro(distro: Option<&str>) -> Self {
        match distro {
            Some("dashing" | "eloquent" | "foxy" | "galactic" | "humble") => Self::Bytes24,
            _ => Self::Bytes16,
        }
    }

    fn bytes(self) -> usize {
        match self {
            Self::Bytes24 => 24,
            Self::Bytes16 => 16,
        }
    }
}

impl ParticipantEntities {
    /// Reads the CDR body (without its 4-byte header) in either form.
    pub fn decode(body: &[u8], little_endian: bool) -> Result<(Self, GidForm), EntitiesError> {
        if body.len() > MAX_BYTES {
            return Err(EntitiesError::TooLong(body.len()));
        }
        [GidForm::Bytes16, GidForm::Bytes24]
            .into_iter()
            .find_map(|form| {
                Reader { body, at: 0, little_endian, form }.message().map(|read| (read, form))
            })
            .ok_or(EntitiesError::Malformed)
    }

    /// The little-endian CDR body in this form.
    pub fn encode(&self, form: GidForm) -> Vec<u8> {
        let mut writer = Writer { body: Vec::new(), form };
        writer.gid(&self.participant.of_participant());
        writer.count(self.nodes.len());
        for node in &self.nodes {
            let (namespace, name) =
                node.name.as_str().rsplit_once('/').unwrap_or(("", node.name.as_str()));
            writer.text(if namespace.is_empty() { "/" } else { namespace });
            writer.text(name);
            for endpoints in [&node.readers, &node.writers] {
                writer.count(endpoints.len());
                endpoints.iter().for_each(|endpoint| writer.gid(endpoint));
            }
        }
        writer.body
    }
}

struct Reader<'a> {
    body: &'a [u8],
    at: usize,
    little_endian: bool,
    form: GidForm,
}

impl Reader<'_> {
    /// The whole message; `None` also if bytes are left over, because leftover bytes indicate the
    /// other form.
    fn message(mut self) -> Option<ParticipantEntities> {
        let participant = self.gid()?.participant();
        let mut misnamed = 0;
        let mut nodes = Vec::new();
        for _ in 0..self.count(MAX_NODES)? {
            let namespace = self.text()?;
            let name = self.text()?;
            let readers = self.gids(participant)?;
            let writers = self.gids(participant)?;
            match format!("{}/{name}", namespace.trim_end_matches('/')).parse() {
                Ok(name) => nodes.push(NodeEntities { name, readers, writers }),
                Err(_) => misnamed += 1,
            }
        }
        // Up to three bytes of padding are allowed at the end.
        let rest = self.body.get(self.at..)?;
        (rest.len() < 4 && rest.iter().all(|byte| *byte == 0)).then_some(ParticipantEntities {
            participant,
            nodes,
            misnamed,
        })
    }

    fn take(&mut self, length: usize) -> Option<&[u8]> {
        let bytes = self.body.get(self.at..self.at.checked_add(length)?)?;
        self.at += length;
        Some(bytes)
    }

    fn number(&mut self) -> Option<usize> {
        self.at = self.at.next_multiple_of(4);
        let little_endian = self.little_endian;
        let bytes = self.take(4)?.try_into().ok()?;
        let number =
            if little_endian { u32::from_le_bytes(bytes) } else { u32::from_be_bytes(bytes) };
        usize::try_from(number).ok()
    }

    fn count(&mut self, most: usize) -> Option<usize> {
        self.number().filter(|count| *count <= most)
    }

    /// A string: its length including the closing zero, then its bytes.
    fn text(&mut self) -> Option<String> {
        let length = self.count(MAX_NAME_BYTES + 1)?;
        let (last, text) = self.take(length)?.split_last()?;
        (*last == 0).then_some(())?;
        String::from_utf8(text.to_vec()).ok()
    }

    fn gid(&mut self) -> Option<EndpointId> {
        let length = self.form.bytes();
        // The bytes that pad the longer form are ignored.
        let id = self.take(length)?.first_chunk()?;
        Some(EndpointId(*id))
    }

    /// Gids, all of this participant: no participant may speak for another, and a wrong form fails
    /// this check.
    fn gids(&mut self, of: ParticipantId) -> Option<Vec<EndpointId>> {
        let count = self.count(MAX_ENDPOINTS)?;
        (0..count).map(|_| self.gid().filter(|gid| gid.participant() == of)).collect()
    }
}

struct Writer {
    body: Vec<u8>,
    form: GidForm,
}

impl Writer {
    fn count(&mut self, count: usize) {
        self.body.resize(self.body.len().next_multiple_of(4), 0);
        self.body.extend(u32::try_from(count).unwrap_or(u32::MAX).to_le_bytes());
    }

    fn text(&mut self, text: &str) {
        self.count(text.len() + 1);
        self.body.extend(text.as_bytes());
        self.body.push(0);
    }

    fn gid(&mut self, gid: &EndpointId) {
        self.body.extend(gid.0);
        self.body.resize(self.body.len() + self.form.bytes() - 16, 0);
    }
}

#[cfg(test)]
mod tests {
    use proptest::collection::vec;
    use proptest::prelude::*;

    use super::*;

    /// A message as `rmw_dds_common` defines it, put together by hand from the definitions and not
    /// by the code under test: `Gid { char data[16] }` (up to Humble `data[24]`, of which the last
    /// 8 are zero), `NodeEntitiesInfo { string node_namespace; string node_name; Gid[]
    /// reader_gid_seq; Gid[] writer_gid_seq }`, `ParticipantEntitiesInfo { Gid gid;
    /// NodeEntitiesInfo[] node_entities_info_seq }`. In CDR numbers are aligned to four bytes from
    /// the body's beginning, texts are their length with a closing zero, and then that.
    fn fixture(gid_bytes: usize) -> Vec<u8> {
        let gid = |entity: [u8; 4]| {
            let mut gid =
                [&[0x01, 0x0f, 0xa1, 0xa2, 0xa3, 0xa4, 0xa5, 0xa6, 0, 0, 0, 0][..], &entity]
                    .concat();
            gid.resize(gid_bytes, 0);
            gid
        };
        [
            gid([0, 0, 1, 0xc1]),
            vec![2, 0, 0, 0],
            // "/robot", 7 with its zero, and one of padding
            vec![7, 0, 0, 0],
            b"/robot\0\0".to_vec(),
            // "talker"
            vec![7, 0, 0, 0],
            b"talker\0\0".to_vec(),
            vec![1, 0, 0, 0],
            gid([0, 0, 1, 4]),
            vec![2, 0, 0, 0],
            gid([0, 0, 2, 3]),
            gid([0, 0, 3, 3]),
            // "/" and two of padding, then "ear" without any
            vec![2, 0, 0, 0],
            b"/\0\0\0".to_vec(),
            vec![4, 0, 0, 0],
            b"ear\0".to_vec(),
            vec![0, 0, 0, 0],
            vec![0, 0, 0, 0],
        ]
        .concat()
    }

    fn expected() -> ParticipantEntities {
        let participant =
            ParticipantId([0x01, 0x0f, 0xa1, 0xa2, 0xa3, 0xa4, 0xa5, 0xa6, 0, 0, 0, 0]);
        let endpoint = |entity: [u8; 4]| {
            let mut id = participant.of_participant();
            id.0[12..].copy_from_slice(&entity);
            id
        };
        let node = |name: &str, readers: Vec<_>, writers: Vec<_>| NodeEntities {
            name: name.parse().expect("a name"),
            readers,
            writers,
        };
        let writers = vec![endpoint([0, 0, 2, 3]), endpoint([0, 0, 3, 3])];
        let nodes = vec![
            node("/robot/talker", vec![endpoint([0, 0, 1, 4])], writers),
            node("/ear", vec![], vec![]),
        ];
        ParticipantEntities { participant, nodes, misnamed: 0 }
    }

    #[test]
    fn both_forms_are_read_and_written() {
        for (form, bytes) in [(GidForm::Bytes16, fixture(16)), (GidForm::Bytes24, fixture(24))] {
            assert_eq!(ParticipantEntities::decode(&bytes, true), Ok((expected(), form)));
            assert_eq!(expected().encode(form), bytes);
            let nothing = ParticipantEntities { nodes: vec![], ..expected() };
            assert_eq!(
                ParticipantEntities::decode(&nothing.encode(form), true),
                Ok((nothing, form))
            );
        }
    }

    #[test]
    fn message_form_follows_the_distribution() {
        for (distro, form) in [
            (Some("foxy"), GidForm::Bytes24),
            (Some("humble"), GidForm::Bytes24),
            (Some("iron"), GidForm::Bytes16),
            (Some("kilted"), GidForm::Bytes16),
            (Some("later"), GidForm::Bytes16),
            (None, GidForm::Bytes16),
        ] {
            assert_eq!(GidForm::of_distro(distro), form, "{distro:?}");
        }
    }

    #[test]
    fn inconsistent_message_is_refused() {
        for length in [16, 24] {
            let whole = fixture(length);
            // The longer form without its end, cut right behind its first gid's 16 bytes, is an
            // empty one of the shorter form.
            for shorter in (0..whole.len()).filter(|at| length == 16 || !(20..24).contains(at)) {
                assert_eq!(
                    ParticipantEntities::decode(&whole[..shorter], true),
                    Err(EntitiesError::Malformed)
                );
            }
            let longer = [&whole[..], &[0; 4]].concat();
            assert_eq!(ParticipantEntities::decode(&longer, true), Err(EntitiesError::Malformed));
            let padded = [&whole[..], &[0; 3]].concat();
            assert!(ParticipantEntities::decode(&padded, true).is_ok());
            assert_eq!(ParticipantEntities::decode(&whole, false), Err(EntitiesError::Malformed));
        }
        // A gid of another participant, a count without elements, and a truncated message.
        let mut stranger = fixture(16);
        stranger[48] ^= 1;
        assert_eq!(ParticipantEntities::decode(&stranger, true), Err(EntitiesError::Malformed));
        let mut endless = fixture(16);
        endless[16..20].copy_from_slice(&u32::MAX.to_le_bytes());
        assert_eq!(ParticipantEntities::decode(&endless, true), Err(EntitiesError::Malformed));
        let huge = vec![0; MAX_BYTES + 1];
        assert_eq!(
            ParticipantEntities::decode(&huge, true),
            Err(EntitiesError::TooLong(MAX_BYTES + 1))
        );
    }

    #[test]
    fn nodes_with_impossible_names_are_counted() {
        let mut bytes = fixture(16);
        let at = bytes.windows(6).position(|window| window == b"talker").expect("the name");
        bytes[at] = b' ';
        let (entities, _) = ParticipantEntities::decode(&bytes, true).expect("the rest is sound");
        assert_eq!((entities.misnamed, entities.nodes.len()), (1, 1));
    }

    proptest! {
        #[test]
        fn arbitrary_bytes_never_panic(bytes in vec(any::<u8>(), 0..400), little_endian: bool) {
            if let Ok((entities, _)) = ParticipantEntities::decode(&bytes, little_endian) {
                prop_assert!(entities.nodes.len() <= bytes.len());
            }
        }

        #[test]
        fn no_flipped_byte_panics(at in 0_usize..200, to: u8, long: bool) {
            let mut bytes = fixture(if long { 24 } else { 16 });
            if let Some(byte) = bytes.get_mut(at) {
                *byte = to;
            }
            let _ = ParticipantEntities::decode(&bytes, true);
        }
    }
}
