//! The audit log: actor, action, target and address of each change. Entries are numbered from 1 and
//! chained: each digest covers the entry's text and the previous digest, so changing, dropping or
//! inserting an entry changes all later digests. This module defines and verifies entries; the
//! server stores them.

use std::collections::BTreeMap;
use std::net::IpAddr;

use serde::{Deserialize, Serialize};
use serde_json::value::RawValue;

use crate::{Digest, TokenId};

/// One action in the audit. The chain covers its JSON, byte for byte.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct AuditEntry {
    /// Sequence number, from 1 and without gaps.
    pub number: u64,
    /// Time by the server's clock.
    pub at_ms: u64,
    /// The actor: a user's name, `operator.token` for the first token, or `enrolment` for a machine
    /// that enrolls.
    pub who: String,
    /// Id of the token used.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub token: Option<TokenId>,
    /// The actor's address.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(value_type = Option<String>))]
    pub address: Option<IpAddr>,
    /// The action, like `deployment.create`.
    pub act: String,
    /// The target: an id or a name.
    pub target: String,
    /// Further details, by key.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub detail: BTreeMap<String, String>,
}

/// An entry with its digest in the chain. Also a line of an export.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct AuditRecord {
    /// The SHA-256 of the previous digest, as text, and of the entry's bytes.
    pub digest: Digest,
    /// An [`AuditEntry`], byte for byte as chained.
    #[cfg_attr(feature = "openapi", schema(value_type = AuditEntry))]
    pub entry: Box<RawValue>,
}

impl AuditRecord {
    /// The entry. A newer server's entry may have further fields.
    pub fn read(&self) -> Option<AuditEntry> {
        serde_json::from_str(self.entry.get()).ok()
    }
}

/// The end of a chain.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ChainLink {
    /// The last entry's number; 0 before the first.
    pub number: u64,
    /// The last entry's digest.
    pub digest: Digest,
}

impl ChainLink {
    /// The start of every chain.
    pub const START: Self = Self { number: 0, digest: Digest::from_sha256([0; 32]) };

    /// The link after an entry with this text.
    pub fn next(&self, entry: &str) -> Self {
        let digest = Digest::of(format!("{}\n{entry}", self.digest).as_bytes());
        Self { number: self.number + 1, digest }
    }

    /// Appends one record; an error if the record does not fit.
    pub fn append(self, record: &AuditRecord) -> Result<Self, BrokenChain> {
        let next = self.next(record.entry.get());
        let Some(entry) = record.read() else {
            return Err(BrokenChain::Unreadable { number: next.number });
        };
        if entry.number != next.number {
            return Err(BrokenChain::Missing { expected: next.number, found: entry.number });
        }
        if record.digest == next.digest {
            Ok(next)
        } else {
            Err(BrokenChain::Changed { number: next.number })
        }
    }
}

/// Where a chain is broken.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum BrokenChain {
    /// An entry is missing, or the order differs.
    #[error("entry {expected} is missing: entry {found} is in its place")]
    Missing {
        /// The expected number.
        expected: u64,
        /// The number found.
        found: u64,
    },
    /// The entry, or an earlier one, has been changed.
    #[error("entry {number} does not match its digest: this or an earlier entry was changed")]
    Changed {
        /// The entry's number.
        number: u64,
    },
    /// The entry can't be parsed.
    #[error("entry {number} can't be read")]
    Unreadable {
        /// The entry's number.
        number: u64,
    },
}

#[cfg(test)]
mod tests {
    use super::*;

    fn entry(number: u64) -> AuditEntry {
        let (who, act) = ("alice".to_owned(), "robot.edit".to_owned());
        let target = format!("r{number}");
        AuditEntry {
            number,
            at_ms: 5,
            who,
            token: None,
            address: None,
            act,
            target,
            detail: BTreeMap::new(),
        }
    }

    fn chain(entries: impl IntoIterator<Item = AuditEntry>) -> Vec<AuditRecord> {
        let mut link = ChainLink::START;
        let record = |entry: AuditEntry| {
            let text = serde_json::to_string(&entry).expect("json");
            link = link.next(&text);
            AuditRecord { digest: link.digest, entry: RawValue::from_string(text).expect("json") }
        };
        entries.into_iter().map(record).collect()
    }

    fn verified(records: &[AuditRecord]) -> Result<ChainLink, BrokenChain> {
        records.iter().try_fold(ChainLink::START, ChainLink::append)
    }

    #[test]
    fn audit_chain_holds_and_survives_an_export() {
        let records = chain((1..=4).map(entry));
        let last = verified(&records).expect("holds");
        assert_eq!((last.number, last.digest), (4, records[3].digest));
        let lines: Vec<String> =
            records.iter().map(|record| serde_json::to_string(record).expect("json")).collect();
        let read: Vec<AuditRecord> =
            lines.iter().map(|line| serde_json::from_str(line).expect("a record")).collect();
        assert_eq!(verified(&read), Ok(last));
    }

    #[test]
    fn changed_dropped_or_moved_entry_breaks_the_chain() {
        let records = chain((1..=4).map(entry));
        let mut changed = records.clone();
        let text = changed[1].entry.get().replace("alice", "mallo");
        changed[1].entry = RawValue::from_string(text).expect("json");
        assert_eq!(verified(&changed), Err(BrokenChain::Changed { number: 2 }));
        // Chaining the changed entry anew breaks the next one.
        let forged =
            ChainLink::START.append(&records[0]).expect("holds").next(changed[1].entry.get());
        changed[1].digest = forged.digest;
        assert_eq!(verified(&changed), Err(BrokenChain::Changed { number: 3 }));
        let mut dropped = records.clone();
        dropped.remove(1);
        assert_eq!(verified(&dropped), Err(BrokenChain::Missing { expected: 2, found: 3 }));
        let mut moved = records.clone();
        moved.swap(1, 2);
        assert_eq!(verified(&moved), Err(BrokenChain::Missing { expected: 2, found: 3 }));
        let mut unreadable = records;
        unreadable[3].entry = RawValue::from_string("{}".to_owned()).expect("json");
        assert_eq!(verified(&unreadable), Err(BrokenChain::Unreadable { number: 4 }));
    }
}
