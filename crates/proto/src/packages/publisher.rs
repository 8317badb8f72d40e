//! Signatures of publishers: the statement that they sign, the list of trusted publishers, and the
//! verification of both. After TUF and Uptane: a statement pins digests and sizes; a list has a
//! version and a lifetime, and is signed by the keepers of the list before it. Pure, and the same
//! on both sides; the server verifies only to report mistakes early.

use serde::{Deserialize, Serialize};

use crate::Digest;
use crate::desired::PackageRef;
use crate::trust::envelope::{Envelope, EnvelopeError, MAX_KEYS, PublicKey, SigningKey};

/// The payload type of a signed [`PackageStatement`].
pub const STATEMENT_TYPE: &str = "application/vnd.taskd.package-statement.v1+json";
/// The payload type of a signed [`PublisherList`].
pub const LIST_TYPE: &str = "application/vnd.taskd.publisher-list.v1+json";
/// `artifactType` of a package's signature.
pub const SIGNATURE_ARTIFACT: &str = "application/vnd.taskd.signature.v1";
/// `artifactType` of a list of publishers.
pub const LIST_ARTIFACT: &str = "application/vnd.taskd.publisher-list.v1";
/// The repository of the lists; each has its version as tag.
pub const LIST_REPOSITORY: &str = "taskd/publishers";
/// The most packages a list withdraws.
pub const MAX_WITHDRAWN: usize = 256;
/// The largest envelope about a package, as JSON.
pub const MAX_SIGNATURE_BYTES: u64 = 16 * 1024;
/// The most envelopes about one package that we examine.
pub const MAX_SIGNATURES: usize = 16;
/// The largest envelope of a list, as JSON.
pub const MAX_LIST_BYTES: u64 = 64 * 1024;
/// The most lists that one robot is told about.
pub const MAX_LISTS: usize = 16;

/// Keys, and the number of signatures required.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "RoleFields")]
pub struct Role {
    keys: Vec<PublicKey>,
    threshold: u32,
}

#[derive(Deserialize)]
struct RoleFields {
    keys: Vec<PublicKey>,
    threshold: u32,
}

/// Why keys and a threshold do not form a role.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum InvalidRole {
    /// No keys, or too many.
    #[error("{0} keys, expected 1 to {MAX_KEYS}")]
    Keys(usize),
    /// A key is listed twice and would count twice.
    #[error("key {0} is listed twice")]
    Twice(String),
    /// A threshold of zero, or one that can't be reached.
    #[error("a threshold of {threshold} with {keys} keys")]
    Threshold {
        /// The requested threshold.
        threshold: u32,
        /// The number of keys.
        keys: usize,
    },
}

impl Role {
    /// A role that requires `threshold` of `keys`.
    pub fn new(keys: Vec<PublicKey>, threshold: u32) -> Result<Self, InvalidRole> {
        if keys.is_empty() || keys.len() > MAX_KEYS {
            return Err(InvalidRole::Keys(keys.len()));
        }
        if let Some(twice) = keys.iter().enumerate().find(|(at, key)| keys[..*at].contains(key)) {
            return Err(InvalidRole::Twice(twice.1.id()));
        }
        if threshold == 0 || threshold as usize > keys.len() {
            return Err(InvalidRole::Threshold { threshold, keys: keys.len() });
        }
        Ok(Self { keys, threshold })
    }

    /// The keys that count towards the threshold.
    pub fn keys(&self) -> &[PublicKey] {
        &self.keys
    }

    /// The number of signatures required.
    pub fn threshold(&self) -> u32 {
        self.threshold
    }

    /// Whether this number of distinct signers reaches the threshold.
    fn is_reached_by(&self, signers: usize) -> bool {
        signers >= self.threshold as usize
    }
}

impl TryFrom<RoleFields> for Role {
    type Error = InvalidRole;
    fn try_from(fields: RoleFields) -> Result<Self, InvalidRole> {
        Self::new(fields.keys, fields.threshold)
    }
}

/// The statement that a publisher signs: exactly this package may be run. The statement has all
/// blobs of the package with digest and size, so that no part can be exchanged for another
/// package's and none can have more bytes than were signed. It has nothing else: signing the same
/// package twice signs the same bytes.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct PackageStatement {
    /// The package.
    pub package: PackageRef,
}

impl PackageStatement {
    /// Signs the statement.
    pub fn seal(&self, key: &SigningKey) -> Envelope {
        let payload = serde_json::to_vec(self).expect("a statement always has a JSON form");
        Envelope::seal(STATEMENT_TYPE, &payload, key)
    }

    /// The statement in an envelope, without verification.
    pub fn unverified(envelope: &Envelope) -> Result<Self, PublisherError> {
        let payload = envelope.unverified_payload(STATEMENT_TYPE)?;
        serde_json::from_slice(&payload)
            .map_err(|error| PublisherError::Malformed(error.to_string()))
    }
}

/// The keys that may publish from now on, and the keys that sign the next list.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct PublisherList {
    /// Starts at 1 and only grows: a robot never goes back to a version below its own.
    pub version: u64,
    /// When the list was made: milliseconds since the Unix epoch.
    pub issued_at_ms: u64,
    /// When the list expires: no new work starts by it afterwards. Milliseconds since the Unix
    /// epoch.
    pub expires_at_ms: u64,
    /// The role that signs packages.
    pub publishers: Role,
    /// The role that signs the next list.
    pub keepers: Role,
    /// Packages that must not be run any more, regardless of signatures, by their manifests.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub withdrawn: Vec<Digest>,
}

/// Why a list, or an envelope about a package, is refused.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum PublisherError {
    /// The envelope can't be read.
    #[error("its envelope is invalid: {0}")]
    Envelope(#[from] EnvelopeError),
    /// The signed payload can't be read.
    #[error("its signed content can't be read: {0}")]
    Malformed(String),
    /// Too few of the responsible keepers have signed the list.
    #[error(
        "signed by {signed} of the {needed} required keepers \
         (of the previous list, or for the first list, of the robot)"
    )]
    TooFewKeepers {
        /// The number of signatures.
        signed: usize,
        /// The number required.
        needed: u32,
    },
    /// Too few of the keepers named in the list itself have proved that they hold their keys.
    #[error("signed by {signed} of the {needed} required keepers that it names itself")]
    TooFewOwnKeepers {
        /// The number of signatures.
        signed: usize,
        /// The number required.
        needed: u32,
    },
    /// The list is not newer than the known one.
    #[error("its version {offered} is not newer than the known version {known}")]
    NotNewer {
        /// The version offered.
        offered: u64,
        /// The known version.
        known: u64,
    },
    /// The list expires before its issue date, so it would never be valid.
    #[error("it expires before its issue date")]
    NoLifetime,
    /// The list withdraws more packages than the limit.
    #[error("it withdraws {0} packages; at most {MAX_WITHDRAWN} are allowed")]
    TooManyWithdrawn(usize),
}

impl PublisherList {
    /// Signs the list.
    pub fn seal(&self, key: &SigningKey) -> Envelope {
        let payload = serde_json::to_vec(self).expect("a list always has a JSON form");
        Envelope::seal(LIST_TYPE, &payload, key)
    }

    /// The list in `envelope`, if it may follow the list with `version` (0: none) and the keepers
    /// `keepers`.
    pub fn verify_successor(
        envelope: &Envelope,
        keepers: &Role,
        version: u64,
    ) -> Result<Self, PublisherError> {
        let (payload, signers) = envelope.signers(LIST_TYPE, &keepers.keys)?;
        if !keepers.is_reached_by(signers.len()) {
            return Err(PublisherError::TooFewKeepers {
                signed: signers.len(),
                needed: keepers.threshold,
            });
        }
        let list = Self::read(&payload)?;
        list.check_own_keepers(envelope)?;
        if list.version <= version {
            return Err(PublisherError::NotNewer { offered: list.version, known: version });
        }
        Ok(list)
    }

    /// The list in `envelope`, if its own keepers have signed it: the only possible check of a
    /// first list.
    pub fn verify_self_signed(envelope: &Envelope) -> Result<Self, PublisherError> {
        let list = Self::unverified(envelope)?;
        list.check_own_keepers(envelope)?;
        Ok(list)
    }

    /// The list in an envelope, without verification.
    pub fn unverified(envelope: &Envelope) -> Result<Self, PublisherError> {
        Self::read(&envelope.unverified_payload(LIST_TYPE)?)
    }

    /// Whether the list has expired.
    pub fn is_expired(&self, now_ms: u64) -> bool {
        now_ms >= self.expires_at_ms
    }

    fn read(payload: &[u8]) -> Result<Self, PublisherError> {
        let list: Self = serde_json::from_slice(payload)
            .map_err(|error| PublisherError::Malformed(error.to_string()))?;
        if list.withdrawn.len() > MAX_WITHDRAWN {
            return Err(PublisherError::TooManyWithdrawn(list.withdrawn.len()));
        }
        if list.expires_at_ms <= list.issued_at_ms {
            return Err(PublisherError::NoLifetime);
        }
        Ok(list)
    }

    fn check_own_keepers(&self, envelope: &Envelope) -> Result<(), PublisherError> {
        let (_, own) = envelope.signers(LIST_TYPE, &self.keepers.keys)?;
        if self.keepers.is_reached_by(own.len()) {
            return Ok(());
        }
        Err(PublisherError::TooFewOwnKeepers { signed: own.len(), needed: self.keepers.threshold })
    }
}

/// Too few trusted publishers have signed a package.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "signed by {signed} of the {needed} required trusted publishers (missing: {})",
    missing.join(", ")
)]
pub struct MissingSignatures {
    /// The number of signatures.
    pub signed: usize,
    /// The number required.
    pub needed: u32,
    /// The ids of the trusted keys that have not signed.
    pub missing: Vec<String>,
}

/// The envelopes by which a threshold of `publishers` state that exactly this package may be run.
pub fn check_threshold<'a>(
    publishers: &Role,
    package: &PackageRef,
    envelopes: &'a [Envelope],
) -> Result<Vec<&'a Envelope>, MissingSignatures> {
    let mut signers: Vec<&PublicKey> = Vec::new();
    let mut counted = Vec::new();
    for envelope in envelopes.iter().take(MAX_SIGNATURES) {
        let Ok((payload, by)) = envelope.signers(STATEMENT_TYPE, &publishers.keys) else {
            continue;
        };
        let is_meant = serde_json::from_slice::<PackageStatement>(&payload)
            .is_ok_and(|said| said.package == *package);
        let new: Vec<&PublicKey> =
            by.into_iter().filter(|key| is_meant && !signers.contains(key)).collect();
        if !new.is_empty() {
            signers.extend(new);
            counted.push(envelope);
        }
    }
    if publishers.is_reached_by(signers.len()) {
        return Ok(counted);
    }
    let missing =
        publishers.keys.iter().filter(|key| !signers.contains(key)).map(PublicKey::id).collect();
    Err(MissingSignatures { signed: signers.len(), needed: publishers.threshold, missing })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::desired::BlobRef;

    fn key(seed: u8) -> SigningKey {
        SigningKey::from_bytes([seed; 32])
    }

    fn role(seeds: &[u8], threshold: u32) -> Role {
        Role::new(seeds.iter().map(|seed| key(*seed).public_key()).collect(), threshold)
            .expect("a role")
    }

    fn package(name: &str) -> PackageRef {
        let blob = |part: &str| BlobRef::of(format!("{name} {part}").as_bytes());
        PackageRef {
            name: name.parse().expect("valid"),
            version: "1.0".parse().expect("valid"),
            manifest: blob("manifest"),
            config: blob("config"),
            content: blob("content"),
        }
    }

    fn signed_by(seed: u8, package: &PackageRef) -> Envelope {
        PackageStatement { package: package.clone() }.seal(&key(seed))
    }

    fn list(version: u64, publishers: Role, keepers: Role) -> PublisherList {
        PublisherList {
            version,
            issued_at_ms: 10,
            expires_at_ms: 20,
            publishers,
            keepers,
            withdrawn: Vec::new(),
        }
    }

    fn sealed(list: &PublisherList, seeds: &[u8]) -> Envelope {
        let mut envelope = list.seal(&key(seeds[0]));
        seeds[1..]
            .iter()
            .for_each(|seed| envelope.add_signature(LIST_TYPE, &key(*seed)).expect("signed"));
        envelope
    }

    #[test]
    fn threshold_counts_distinct_trusted_keys() {
        let (talker, publishers) = (package("talker"), role(&[1, 2, 3], 2));
        let [ada, bob, eve] = [1, 2, 9].map(|seed| signed_by(seed, &talker));
        let signed = |envelopes: &[&Envelope]| {
            let envelopes: Vec<Envelope> =
                envelopes.iter().map(|envelope| (*envelope).clone()).collect();
            match check_threshold(&publishers, &talker, &envelopes) {
                Ok(counted) => counted.len(),
                Err(unsigned) => panic!("{unsigned}"),
            }
        };
        assert_eq!(signed(&[&eve, &ada, &ada, &bob]), 2);
        for few in [vec![], vec![&ada, &ada], vec![&ada, &eve], vec![&eve, &eve]] {
            let few: Vec<Envelope> = few.into_iter().cloned().collect();
            let unsigned = check_threshold(&publishers, &talker, &few).expect_err("too few");
            assert_eq!((unsigned.needed, unsigned.signed + unsigned.missing.len()), (2, 3));
        }
        // Both signatures in one envelope.
        let mut both = ada.clone();
        both.add_signature(STATEMENT_TYPE, &key(2)).expect("signed");
        assert_eq!(signed(&[&both]), 1);
    }

    #[test]
    fn signature_covers_one_package_with_all_digests_and_sizes() {
        let (talker, publishers) = (package("talker"), role(&[1], 1));
        let envelopes = [signed_by(1, &talker)];
        assert!(check_threshold(&publishers, &talker, &envelopes).is_ok());
        let other = package("other");
        // Mix and match: parts of other packages, also of signed ones, in place of the package's
        // own; and more bytes than were signed.
        let endless = BlobRef { size: u64::MAX, ..talker.content };
        for changed in [
            PackageRef { content: other.content, ..talker.clone() },
            PackageRef { config: other.config, ..talker.clone() },
            PackageRef { manifest: other.manifest, ..talker.clone() },
            PackageRef { name: other.name.clone(), ..talker.clone() },
            PackageRef { version: "2.0".parse().expect("valid"), ..talker.clone() },
            PackageRef { content: endless, ..talker.clone() },
        ] {
            let envelopes = [signed_by(1, &talker), signed_by(1, &other)];
            assert!(check_threshold(&publishers, &changed, &envelopes).is_err(), "{changed:?}");
        }
    }

    #[test]
    fn payload_of_another_type_is_not_a_statement() {
        let (talker, publishers) = (package("talker"), role(&[1], 1));
        let statement = PackageStatement { package: talker.clone() };
        let payload = serde_json::to_vec(&statement).expect("json");
        for kind in [LIST_TYPE, crate::trust::envelope::DESIRED_STATE_TYPE] {
            assert!(
                check_threshold(&publishers, &talker, &[Envelope::seal(kind, &payload, &key(1))])
                    .is_err()
            );
        }
    }

    #[test]
    fn publisher_list_follows_if_old_and_new_keepers_signed_it() {
        let before = role(&[1, 2], 2);
        let next = list(2, role(&[5], 1), role(&[2, 3], 1));
        assert_eq!(
            PublisherList::verify_successor(&sealed(&next, &[1, 2]), &before, 1),
            Ok(next.clone())
        );
        let refused = |seeds: &[u8]| {
            PublisherList::verify_successor(&sealed(&next, seeds), &before, 1).expect_err("refused")
        };
        assert_eq!(refused(&[1, 3]), PublisherError::TooFewKeepers { signed: 1, needed: 2 });
        assert_eq!(refused(&[5]), PublisherError::TooFewKeepers { signed: 0, needed: 2 });
        let strangers = list(2, role(&[5], 1), role(&[3], 1));
        let without_their_say =
            PublisherList::verify_successor(&sealed(&strangers, &[1, 2]), &before, 1);
        assert_eq!(
            without_their_say,
            Err(PublisherError::TooFewOwnKeepers { signed: 0, needed: 1 })
        );
        assert!(PublisherList::verify_self_signed(&sealed(&strangers, &[3])).is_ok());
        assert!(PublisherList::verify_self_signed(&sealed(&strangers, &[1])).is_err());
    }

    #[test]
    fn largest_roles_can_sign() {
        let most = MAX_KEYS as u8;
        let seeds = |from: u8| (from..from + most).collect::<Vec<_>>();
        let all_of = |from: u8| role(&seeds(from), u32::from(most));
        // The longest possible list, which all keepers hand over to the same number of new keepers.
        let withdrawn = vec![Digest::of(b"x"); MAX_WITHDRAWN];
        let next = PublisherList {
            issued_at_ms: u64::MAX - 1,
            expires_at_ms: u64::MAX,
            withdrawn,
            ..list(u64::MAX, all_of(0), all_of(most))
        };
        let envelope = sealed(&next, &(0..2 * most).collect::<Vec<_>>());
        assert_eq!(PublisherList::verify_successor(&envelope, &all_of(0), 1), Ok(next));
        assert!(serde_json::to_vec_pretty(&envelope).expect("json").len() as u64 <= MAX_LIST_BYTES);
        let talker = package("talker");
        let mut envelope = signed_by(0, &talker);
        seeds(1)
            .iter()
            .for_each(|seed| envelope.add_signature(STATEMENT_TYPE, &key(*seed)).expect("signed"));
        assert!(
            serde_json::to_vec_pretty(&envelope).expect("json").len() as u64 <= MAX_SIGNATURE_BYTES
        );
        assert!(check_threshold(&all_of(0), &talker, &[envelope]).is_ok());
    }

    #[test]
    fn older_publisher_list_never_follows() {
        let keepers = role(&[1], 1);
        for (version, known) in [(1, 1), (1, 2), (0, 0)] {
            let old = sealed(&list(version, role(&[5], 1), keepers.clone()), &[1]);
            let refused = PublisherList::verify_successor(&old, &keepers, known);
            assert_eq!(refused, Err(PublisherError::NotNewer { offered: version, known }));
        }
    }

    #[test]
    fn publisher_list_has_limits() {
        let keepers = role(&[1], 1);
        let follow = |list: &PublisherList| {
            PublisherList::verify_successor(&sealed(list, &[1]), &keepers, 0)
        };
        let good = list(1, role(&[5], 1), keepers.clone());
        assert!(follow(&good).is_ok_and(|list| list.is_expired(20) && !list.is_expired(19)));
        assert_eq!(
            follow(&PublisherList { expires_at_ms: 10, ..good.clone() }),
            Err(PublisherError::NoLifetime)
        );
        let withdrawn = vec![Digest::of(b"x"); MAX_WITHDRAWN + 1];
        assert_eq!(
            follow(&PublisherList { withdrawn, ..good }),
            Err(PublisherError::TooManyWithdrawn(MAX_WITHDRAWN + 1))
        );
        let keys = |count: u8| (0..count).map(|seed| key(seed).public_key()).collect::<Vec<_>>();
        assert_eq!(Role::new(keys(0), 1), Err(InvalidRole::Keys(0)));
        assert_eq!(Role::new(keys(17), 1), Err(InvalidRole::Keys(17)));
        assert_eq!(Role::new(keys(2), 3), Err(InvalidRole::Threshold { threshold: 3, keys: 2 }));
        assert_eq!(Role::new(keys(2), 0), Err(InvalidRole::Threshold { threshold: 0, keys: 2 }));
        let twice = [keys(2), keys(1)].concat();
        assert_eq!(Role::new(twice, 1), Err(InvalidRole::Twice(keys(1)[0].id())));
    }
}
