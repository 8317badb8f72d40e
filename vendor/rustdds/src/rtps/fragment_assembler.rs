use std::{
  collections::{
    btree_map::{self, Entry},
    BTreeMap,
  },
  fmt, iter,
  sync::atomic::{AtomicUsize, Ordering},
};

use enumflags2::BitFlags;
use bytes::{Bytes, BytesMut};
#[allow(unused_imports)]
use log::{debug, error, info, trace, warn};

use crate::{
  dds::ddsdata::DDSData,
  messages::submessages::{
    elements::serialized_payload::SerializedPayload,
    submessages::{DATAFRAG_Flags, DataFrag},
  },
  structure::{
    cache_change::ChangeKind,
    sequence_number::{FragmentNumber, SequenceNumber},
    time::Timestamp,
  },
};

/// The largest sample that is assembled from fragments. A DATAFRAG that states a
/// larger `data_size` is dropped.
pub(crate) const MAX_ASSEMBLED_SAMPLE_BYTES: usize = 32 * 1024 * 1024;
/// How much all partly assembled samples of this process may occupy together.
pub(crate) const MAX_ASSEMBLY_BYTES: usize = 2 * MAX_ASSEMBLED_SAMPLE_BYTES;
/// What a fragment counts for beside its bytes.
const FRAGMENT_OVERHEAD_BYTES: usize = 128;
/// What a partly assembled sample counts for beside its fragments.
const ASSEMBLY_BUFFER_OVERHEAD_BYTES: usize = 512;
/// A NACKFRAG names no fragment further than this from its first.
const MAX_MISSING_FRAGMENTS: usize = 256;

static ASSEMBLY_BYTES: AtomicUsize = AtomicUsize::new(0);

// A part of `MAX_ASSEMBLY_BYTES`. It is given back on drop.
#[derive(Default)]
struct Reserved(usize);

impl Reserved {
  // Returns `false`, and takes nothing, if there is not as much left.
  fn grow(&mut self, bytes: usize) -> bool {
    let taken = ASSEMBLY_BYTES.fetch_update(Ordering::Relaxed, Ordering::Relaxed, |used| {
      used
        .checked_add(bytes)
        .filter(|used| *used <= MAX_ASSEMBLY_BYTES)
    });
    if taken.is_ok() {
      self.0 += bytes;
    }
    taken.is_ok()
  }
}

impl Drop for Reserved {
  fn drop(&mut self) {
    ASSEMBLY_BYTES.fetch_sub(self.0, Ordering::Relaxed);
  }
}

// This is for the assembly of a single object
struct AssemblyBuffer {
  // By their numbers, from 0. Only what has arrived is allocated: `data_size` is
  // the sender's claim.
  fragments: BTreeMap<usize, Bytes>,
  reserved: Reserved,
  data_size: usize,
  fragment_size: usize,
  fragment_count: usize,

  #[allow(dead_code)] // TODO: Purpose is to use this later for e.g.
  // garbage collection, in case some buffer is not completed within reasonable time.
  created_time: Timestamp,
  modified_time: Timestamp,
}

impl AssemblyBuffer {
  pub fn new(datafrag: &DataFrag) -> Option<Self> {
    let data_size: usize = datafrag.data_size.try_into().ok()?;
    let fragment_size = usize::from(datafrag.fragment_size);
    debug!("new AssemblyBuffer data_size={data_size} frag_size={fragment_size}");

    if fragment_size == 0 || fragment_size > data_size {
      debug!("Cannot create AssemblyBuffer: fragment_size={fragment_size} data_size={data_size}");
      return None;
    }
    if data_size > MAX_ASSEMBLED_SAMPLE_BYTES {
      debug!("Cannot create AssemblyBuffer: data_size={data_size} is over the limit");
      return None;
    }
    let mut reserved = Reserved::default();
    if !reserved.grow(ASSEMBLY_BUFFER_OVERHEAD_BYTES) {
      debug!("Cannot create AssemblyBuffer: too much is being assembled");
      return None;
    }

    let now = Timestamp::now();

    Some(Self {
      fragments: BTreeMap::new(),
      reserved,
      data_size,
      fragment_size,
      fragment_count: data_size.div_ceil(fragment_size),
      created_time: now,
      modified_time: now,
    })
  }

  /// Returns `false` if the fragment run is invalid, out of bounds, contradicts
  /// those before it, or finds no room.
  ///
  /// A Writer must keep the fragment size constant per SequenceNumber. RTPS spec
  /// v2.5 Section 8.4.14.1.1 "How to select the fragment size" even says that it
  /// is fixed per Writer.
  pub fn insert_frags(&mut self, datafrag: &DataFrag) -> bool {
    let same_size = usize::try_from(datafrag.data_size) == Ok(self.data_size);
    if usize::from(datafrag.fragment_size) != self.fragment_size || !same_size {
      debug!("insert_frags: sizes differ from those of an earlier fragment of the sample");
      return false;
    }
    let count = usize::from(datafrag.fragments_in_submessage);
    let first = match usize::from(datafrag.fragment_starting_num).checked_sub(1) {
      Some(first) if count > 0 && first + count <= self.fragment_count => first,
      _ => {
        debug!(
          "insert_frags: fragment span out of bounds: start={:?} count={count} total={}",
          datafrag.fragment_starting_num, self.fragment_count
        );
        return false;
      }
    };
    // Only the last fragment of the sample may be shorter than the others.
    let from_byte = first * self.fragment_size;
    let to_before_byte = ((first + count) * self.fragment_size).min(self.data_size);
    let Some(payload) = datafrag
      .serialized_payload
      .get(..to_before_byte - from_byte)
    else {
      debug!(
        "insert_frags: {} bytes of payload for {count} fragments of {} bytes",
        datafrag.serialized_payload.len(),
        self.fragment_size
      );
      return false;
    };

    for (number, fragment) in (first..).zip(payload.chunks(self.fragment_size)) {
      if let btree_map::Entry::Vacant(place) = self.fragments.entry(number) {
        if !self
          .reserved
          .grow(fragment.len() + FRAGMENT_OVERHEAD_BYTES)
        {
          debug!("insert_frags: too much is being assembled");
          return false;
        }
        // Copied, so that it does not hold on to the whole datagram.
        place.insert(Bytes::copy_from_slice(fragment));
      }
    }
    self.modified_time = Timestamp::now();
    true
  }

  pub fn is_complete(&self) -> bool {
    self.fragments.len() == self.fragment_count
  }

  // The sample, once it is complete.
  pub fn into_bytes(mut self) -> Bytes {
    let mut whole = BytesMut::with_capacity(self.data_size);
    // The fragments go one by one, so that the sample is not there twice.
    while let Some((_, fragment)) = self.fragments.pop_first() {
      whole.extend_from_slice(&fragment);
    }
    whole.freeze()
  }
}

// Upper bound on the number of concurrent (incomplete) reassembly buffers kept
// per writer. Fragments belonging to one sample normally arrive back-to-back,
// so only a handful of samples are ever mid-reassembly at once; this cap is far
// above that. Its purpose is to bound memory when samples never complete, e.g.
// under best-effort overload where fragments are dropped: without it, one
// incomplete `AssemblyBuffer` (a full sample-sized allocation) accrues per lost
// sample and is only reclaimed by a 10 s idle timeout, growing to gigabytes.
// When exceeded we evict the oldest (lowest sequence number) buffer, which
// under best effort is lost anyway and under reliable will be re-requested.
const MAX_ASSEMBLY_BUFFERS: usize = 128;

// Assembles fragments from a single (remote) Writer
// So there is only one sequence of SNs
pub(crate) struct FragmentAssembler {
  assembly_buffers: BTreeMap<SequenceNumber, AssemblyBuffer>,
  // Whether the owning reader is Reliable. This decides which buffer to drop
  // when `MAX_ASSEMBLY_BUFFERS` is exceeded (see `new_datafrag`).
  reliable: bool,
}

impl fmt::Debug for FragmentAssembler {
  fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
    f.debug_struct("FragmentAssembler - fields omitted")
      // insert field printing here, if you really need it.
      .finish()
  }
}

impl FragmentAssembler {
  pub fn new(reliable: bool) -> Self {
    debug!("new FragmentAssembler. reliable = {reliable}");
    Self {
      assembly_buffers: BTreeMap::new(),
      reliable,
    }
  }

  // Returns completed DDSData, when complete, and disposes the assembly buffer.
  pub fn new_datafrag(
    &mut self,
    datafrag: &DataFrag,
    flags: BitFlags<DATAFRAG_Flags>,
  ) -> Option<DDSData> {
    let writer_sn = datafrag.writer_sn;

    let sn = datafrag.writer_sn;
    match self.assembly_buffers.entry(sn) {
      Entry::Vacant(v) => {
        let Some(buf) = AssemblyBuffer::new(datafrag) else {
          return None;
        };
        v.insert(buf);
      }
      Entry::Occupied(_) => {}
    }

    let Some(assembly_buffer) = self.assembly_buffers.get_mut(&sn) else {
      error!("new_datafrag: AssemblyBuffer missing for {sn:?}");
      return None;
    };

    if !assembly_buffer.insert_frags(datafrag) {
      // A buffer that its first fragment did not get into is of no use.
      if assembly_buffer.fragments.is_empty() {
        self.assembly_buffers.remove(&sn);
      }
      return None;
    }

    if assembly_buffer.is_complete() {
      debug!("new_datafrag: COMPLETED FRAGMENT");
      if let Some(assembly_buffer) = self.assembly_buffers.remove(&writer_sn) {
        // Return what we have assembled.
        let serialized_data_or_key =
          SerializedPayload::from_bytes(&assembly_buffer.into_bytes()).map_or_else(
            |e| {
              error!("Deserializing SerializedPayload from DATAFRAG: {:?}", e);
              None
            },
            Some,
          )?;
        let dds_data = if flags.contains(DATAFRAG_Flags::Key) {
          DDSData::new_disposed_by_key(ChangeKind::NotAliveDisposed, serialized_data_or_key)
        } else {
          // it is data
          DDSData::new(serialized_data_or_key)
        };
        Some(dds_data) // completed data from fragments
      } else {
        error!("Assembly buffer mysteriously lost");
        None
      }
    } else {
      debug!("new_dataFrag: FRAGMENT NOT COMPLETED YET");
      // Bound memory: never keep more than MAX_ASSEMBLY_BUFFERS incomplete
      // reassemblies.
      //
      // Which one to evict depends on reliability:
      //  * Reliable: the reader delivers strictly in order, so it must complete the
      //    LOWEST sequence number first; that buffer is exactly the one blocking
      //    progress. Dropping it would livelock, because a writer that bursts many
      //    large samples ahead (e.g. Connext) would make the reader perpetually evict
      //    the very sample it is waiting for. So evict the HIGHEST (newest) sequence
      //    number instead; the writer keeps unacked samples in its history and
      //    re-sends them once we catch up.
      //  * Best effort: there is no retransmission, so a low incomplete buffer is
      //    lost anyway. Evict the OLDEST (lowest SN) to free room for newer samples
      //    that may still complete.
      while self.assembly_buffers.len() > MAX_ASSEMBLY_BUFFERS {
        let evicted = if self.reliable {
          self.assembly_buffers.pop_last()
        } else {
          self.assembly_buffers.pop_first()
        };
        if evicted.is_none() {
          break;
        }
      }
      None
    }
  }

  pub fn garbage_collect_before(&mut self, expire_before: Timestamp) {
    self.assembly_buffers.retain(|sn, ab| {
      let retain = ab.modified_time >= expire_before;
      if !retain {
        info!("AssemblyBuffer dropping {sn:?}");
      }
      retain
    });
  }

  /// Whether nothing is being assembled.
  pub fn is_empty(&self) -> bool {
    self.assembly_buffers.is_empty()
  }

  // pub fn partially_received_sequence_numbers_iterator(&self) -> Box<dyn
  // Iterator<Item=SequenceNumber>> {   // Since we should only know about SNs
  // via DATAFRAG messages   // and AssemblyBuffers are removed immediately on
  // completion,   // the list should be just the list of current
  // AssemblyBuffers   self.assembly_buffers.keys()
  // }

  pub fn is_partially_received(&self, sn: SequenceNumber) -> bool {
    self.assembly_buffers.contains_key(&sn)
    // assembly buffers map contains a key (SN) if and only if we have some
    // frags but not all
  }

  pub fn missing_frags_for(
    &self,
    seq: SequenceNumber,
  ) -> Box<dyn '_ + Iterator<Item = FragmentNumber>> {
    match self.assembly_buffers.get(&seq) {
      None => Box::new(iter::empty()),
      Some(ab) => {
        let iter = (0..ab.fragment_count)
          .filter(move |f| !ab.fragments.contains_key(f))
          .take(MAX_MISSING_FRAGMENTS)
          .map(|f| FragmentNumber::new((f + 1).try_into().unwrap()));
        Box::new(iter)
      }
    }
  }
}

#[cfg(test)]
mod tests {
  use bytes::Bytes;

  use super::AssemblyBuffer;
  use crate::{
    messages::submessages::submessages::DataFrag, structure::sequence_number::FragmentNumber,
  };

  // Build a DATAFRAG submessage carrying the contiguous run of `k` fragments
  // starting at 1-based `start`, with the given payload bytes.
  fn datafrag(start: u32, k: u16, frag_size: u16, data_size: u32, payload: Vec<u8>) -> DataFrag {
    DataFrag {
      fragment_starting_num: FragmentNumber::new(start),
      fragments_in_submessage: k,
      fragment_size: frag_size,
      data_size,
      serialized_payload: Bytes::from(payload),
      ..Default::default()
    }
  }

  // A DATAFRAG that packs K > 1 fragments in one submessage must reassemble the
  // same bytes as one-fragment-per-submessage would. This exercises the
  // adaptive-packing writer path against the (unchanged) receiver.
  #[test]
  fn reassemble_multi_fragment_datafrag() {
    let frag_size = 1024u16;
    let data_size = 2600u32; // 3 fragments: 1024, 1024, 552
    let whole: Vec<u8> = (0..data_size as usize).map(|i| (i % 251) as u8).collect();

    // First submessage packs fragments 1 and 2 (K = 2, 2048 payload bytes).
    let first = datafrag(1, 2, frag_size, data_size, whole[0..2048].to_vec());
    let mut ab = AssemblyBuffer::new(&first).expect("valid first fragment");
    assert!(!ab.is_complete());
    ab.insert_frags(&first);
    assert!(!ab.is_complete(), "still missing the tail fragment");

    // Trailing submessage carries the shorter final fragment 3 (552 bytes).
    let tail = datafrag(3, 1, frag_size, data_size, whole[2048..2600].to_vec());
    ab.insert_frags(&tail);
    assert!(ab.is_complete(), "all fragments received");
    assert_eq!(
      &ab.into_bytes()[..],
      &whole[..],
      "reassembled bytes must match the original sample"
    );
  }

  // A single DATAFRAG carrying the whole sample in one multi-fragment run.
  #[test]
  fn reassemble_single_submessage_all_fragments() {
    let frag_size = 512u16;
    let data_size = 1500u32; // 3 fragments: 512, 512, 476
    let whole: Vec<u8> = (0..data_size as usize).map(|i| (i % 97) as u8).collect();

    let all = datafrag(1, 3, frag_size, data_size, whole.clone());
    let mut ab = AssemblyBuffer::new(&all).expect("valid fragment set");
    ab.insert_frags(&all);
    assert!(ab.is_complete());
    assert_eq!(&ab.into_bytes()[..], &whole[..]);
  }

  // Malformed span (starting at last fragment but claiming multiple fragments)
  // must not panic and must not falsely complete reassembly.
  #[test]
  fn reject_fragment_span_beyond_total() {
    let frag_size = 256u16;
    let data_size = 512u32; // 2 fragments total
    let bad = datafrag(2, 2, frag_size, data_size, vec![0u8; 256]);
    let mut ab = AssemblyBuffer::new(&bad).expect("buffer for valid data_size");
    assert!(!ab.insert_frags(&bad));
    assert!(!ab.is_complete());
  }

  #[test]
  fn fragment_assembler_rejects_span_beyond_total() {
    use enumflags2::BitFlags;

    use super::FragmentAssembler;
    use crate::messages::submessages::submessages::DATAFRAG_Flags;

    let frag_size = 256u16;
    let data_size = 512u32;
    let bad = datafrag(2, 2, frag_size, data_size, vec![0u8; 256]);
    let mut fa = FragmentAssembler::new(true);
    assert!(fa
      .new_datafrag(&bad, BitFlags::<DATAFRAG_Flags>::empty())
      .is_none());
  }

  #[test]
  fn stated_size_is_not_allocated_and_too_large_ones_are_refused() {
    use super::{Reserved, MAX_ASSEMBLED_SAMPLE_BYTES};

    let largest = u32::try_from(MAX_ASSEMBLED_SAMPLE_BYTES).unwrap();
    assert!(AssemblyBuffer::new(&datafrag(1, 1, 64, largest + 1, vec![0; 64])).is_none());
    assert!(AssemblyBuffer::new(&datafrag(1, 1, 64, u32::MAX, vec![0; 64])).is_none());
    let last = datafrag(largest / 64, 1, 64, largest, vec![0; 64]);
    let mut ab = AssemblyBuffer::new(&last).expect("within the limit");
    assert!(ab.insert_frags(&last));
    let Reserved(bytes) = ab.reserved;
    assert!(bytes < 1024, "{bytes} bytes for a fragment of 64");
  }

  #[test]
  fn fragments_that_contradict_each_other_are_dropped() {
    let first = datafrag(1, 1, 64, 200, vec![1; 64]);
    let mut ab = AssemblyBuffer::new(&first).expect("valid first fragment");
    assert!(ab.insert_frags(&first));
    assert!(!ab.insert_frags(&datafrag(2, 1, 64, 300, vec![1; 64])), "another size");
    assert!(!ab.insert_frags(&datafrag(2, 1, 65, 200, vec![1; 65])), "another fragment size");
    assert!(!ab.insert_frags(&datafrag(2, 1, 64, 200, vec![1; 63])), "too short");
    assert_eq!(ab.fragments.len(), 1);
  }

  #[test]
  fn all_samples_together_are_bounded() {
    use enumflags2::BitFlags;

    use super::{FragmentAssembler, ASSEMBLY_BYTES, MAX_ASSEMBLY_BYTES};
    use crate::{
      messages::submessages::submessages::DATAFRAG_Flags, structure::sequence_number::SequenceNumber,
    };

    let mut assemblers: Vec<_> = (0..64).map(|_| FragmentAssembler::new(false)).collect();
    for number in 0..40_000_i64 {
      let mut frag = datafrag(1, 1, 60_000, 120_000, vec![0; 60_000]);
      frag.writer_sn = SequenceNumber::new(1 + number / 64);
      let assembler = &mut assemblers[usize::try_from(number % 64).unwrap()];
      assembler.new_datafrag(&frag, BitFlags::<DATAFRAG_Flags>::empty());
      assert!(ASSEMBLY_BYTES.load(std::sync::atomic::Ordering::Relaxed) <= MAX_ASSEMBLY_BYTES);
    }
    drop(assemblers);
  }
}
