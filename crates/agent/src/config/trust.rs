//! The publishers that this robot trusts to publish packages: at first those in its settings, later
//! those in the newest list of publishers that the robot received and stored on disk. This module
//! judges lists and packages. It fetches nothing, and the server cannot influence its decisions.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::{PoisonError, RwLock, RwLockReadGuard};

use serde::{Deserialize, Serialize};
use task_proto::Digest;
use task_proto::desired::PackageRef;
use task_proto::messages::report::{Failure, FailureCode};
use task_proto::packages::publisher::{
    MAX_LIST_BYTES, MAX_SIGNATURE_BYTES, MAX_SIGNATURES, MissingSignatures, PublisherError,
    PublisherList, Role, check_threshold,
};
use task_proto::trust::envelope::Envelope;

use crate::system::clock::PROGRAM_EXISTS_SINCE_MS;
use crate::system::durable;
use crate::system::untrusted_file;

/// The trust settings of the robot.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct TrustSettings {
    /// The keys that may publish until a list replaces them.
    pub publishers: Role,
    /// The keys that may sign the first list.
    pub keepers: Role,
    /// Whether nothing is run before there is a list.
    pub requires_list: bool,
}

/// The intended use of a package.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PackageUse {
    /// The package is new on this robot.
    New,
    /// The package has run on this robot and is started again.
    Restart,
}

/// Reasons why a package is not run.
#[derive(Debug, thiserror::Error)]
pub enum TrustError {
    /// Too few publishers have signed the package.
    #[error(transparent)]
    Unsigned(#[from] MissingSignatures),
    /// The publishers have withdrawn the package.
    #[error("version {0} of the list of publishers withdraws it")]
    Withdrawn(u64),
    /// An attacker may be withholding a newer list from the robot.
    #[error(
        "version {version} of the list of publishers, the newest that this robot has, has expired"
    )]
    Expired {
        /// Version of the list.
        version: u64,
    },
    /// The list that applied is no longer known. A fallback to the settings could be a rollback to
    /// older keys.
    #[error("cannot read the list of publishers in {path}: an operator must remove it")]
    Unreadable {
        /// Path of the stored list.
        path: PathBuf,
    },
    /// The settings require a list and there is none.
    #[error("trusted_publishers.require_list is set, and this robot has no list of publishers")]
    NoList,
}

impl TrustError {
    /// The error as a failure of the order for `package`.
    pub fn failure(&self, package: &PackageRef) -> Failure {
        let code = if self.may_pass() {
            FailureCode::PUBLISHERS_EXPIRED
        } else {
            FailureCode::UNTRUSTED_PACKAGE
        };
        Failure::new(code, format!("{} {} may not run here: {self}", package.name, package.version))
    }

    /// Whether a newer list alone, which may come at any time, resolves the error.
    pub fn may_pass(&self) -> bool {
        matches!(self, Self::Expired { .. } | Self::NoList)
    }
}

/// Reasons why a list was not accepted.
#[derive(Debug, thiserror::Error)]
pub enum ListError {
    /// The list is no valid successor of the current one.
    #[error(transparent)]
    Refused(#[from] PublisherError),
    /// The list could not be stored, and a list that is lost at the next start must not apply now.
    #[error("cannot store the list")]
    Disk(#[source] io::Error),
}

/// The robot's current trust decisions.
pub struct Trust {
    settings: TrustSettings,
    path: PathBuf,
    /// Whether the list at `path` exists and can't be read.
    is_unreadable: bool,
    list: RwLock<Option<CurrentList>>,
}

/// The list that applies.
struct CurrentList {
    list: PublisherList,
    /// Digest of the bytes in which the list arrived.
    digest: Digest,
}

/// Content of the stored file.
#[derive(Serialize, Deserialize)]
struct StoredList {
    /// The list with its signatures.
    envelope: Envelope,
    /// Digest by which the list was fetched.
    digest: Digest,
    /// The settings under which the list was accepted.
    settings: TrustSettings,
}

impl Trust {
    /// The trust given by `settings`, and by the list at `path` if one is stored there.
    pub fn open(settings: TrustSettings, path: PathBuf) -> Self {
        let list = match untrusted_file::read(&path, 2 * MAX_LIST_BYTES) {
            Ok(bytes) => StoredList::read(&bytes).and_then(|kept| kept.list(&settings)),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(error),
        };
        if let Err(error) = &list {
            tracing::error!(path = %path.display(), %error, "cannot read the list of publishers: no task is started");
        }
        Self {
            settings,
            path,
            is_unreadable: list.is_err(),
            list: RwLock::new(list.unwrap_or_default()),
        }
    }

    /// The version of the list that applies; 0: the settings apply.
    pub fn version(&self) -> u64 {
        self.list().as_ref().map_or(0, |current| current.list.version)
    }

    /// The digest of the list that applies.
    pub fn list_digest(&self) -> Option<Digest> {
        self.list().as_ref().map(|current| current.digest)
    }

    /// Accepts a list, which arrived in bytes with this digest, if it may follow the current one.
    pub fn accept_list(&self, envelope: &Envelope, digest: Digest) -> Result<(), ListError> {
        if self.is_unreadable {
            return Err(ListError::Disk(io::Error::other("the stored list can't be read")));
        }
        // The lock is held during the write to the disk: lists are accepted one after another.
        let mut current = self.list.write().unwrap_or_else(PoisonError::into_inner);
        let (keepers, version) =
            current.as_ref().map_or((&self.settings.keepers, 0), |CurrentList { list, .. }| {
                (&list.keepers, list.version)
            });
        let list = PublisherList::verify_successor(envelope, keepers, version)?;
        let kept =
            StoredList { envelope: envelope.clone(), digest, settings: self.settings.clone() };
        let bytes = serde_json::to_vec(&kept).map_err(|error| ListError::Disk(error.into()))?;
        durable::write(&self.path, &bytes, 0o600).map_err(ListError::Disk)?;
        *current = Some(CurrentList { list, digest });
        Ok(())
    }

    /// The envelopes of `envelopes` that allow this use of `package`; or the reason why the use is
    /// refused.
    pub fn check_package<'a>(
        &self,
        package: &PackageRef,
        envelopes: &'a [Envelope],
        purpose: PackageUse,
        wall_ms: u64,
    ) -> Result<Vec<&'a Envelope>, TrustError> {
        if self.is_unreadable {
            return Err(TrustError::Unreadable { path: self.path.clone() });
        }
        let list = self.list();
        let Some(CurrentList { list, .. }) = &*list else {
            if self.settings.requires_list {
                return Err(TrustError::NoList);
            }
            return Ok(check_threshold(&self.settings.publishers, package, envelopes)?);
        };
        if list.withdrawn.contains(&package.manifest.digest) {
            return Err(TrustError::Withdrawn(list.version));
        }
        let counted = check_threshold(&list.publishers, package, envelopes)?;
        if purpose == PackageUse::New && is_list_expired(list, wall_ms) {
            return Err(TrustError::Expired { version: list.version });
        }
        Ok(counted)
    }

    /// Whether the list that applies has expired.
    pub fn is_list_expired(&self, wall_ms: u64) -> bool {
        self.list().as_ref().is_some_and(|CurrentList { list, .. }| is_list_expired(list, wall_ms))
    }

    fn list(&self) -> RwLockReadGuard<'_, Option<CurrentList>> {
        // A list is always replaced as a whole.
        self.list.read().unwrap_or_else(PoisonError::into_inner)
    }
}

impl StoredList {
    fn read(bytes: &[u8]) -> io::Result<Self> {
        Ok(serde_json::from_slice(bytes)?)
    }

    /// The list, if it applies under `settings`. The settings have the last word: after a change of
    /// the settings the list applies only if the keepers in the new settings have signed it.
    fn list(&self, settings: &TrustSettings) -> io::Result<Option<CurrentList>> {
        let list = if self.settings.keepers == settings.keepers {
            Some(PublisherList::unverified(&self.envelope).map_err(io::Error::other)?)
        } else {
            PublisherList::verify_successor(&self.envelope, &settings.keepers, 0).ok()
        };
        Ok(list.map(|list| CurrentList { list, digest: self.digest }))
    }
}

/// As with desired states: a clock that shows a time before this program existed is wrong and must
/// not lock the robot out.
fn is_list_expired(list: &PublisherList, wall_ms: u64) -> bool {
    wall_ms >= PROGRAM_EXISTS_SINCE_MS && list.is_expired(wall_ms)
}

/// The stored envelopes of a package; none if there are no readable ones.
pub fn read_signatures(path: &Path) -> Vec<Envelope> {
    let bytes = untrusted_file::read(path, (MAX_SIGNATURES as u64 + 1) * MAX_SIGNATURE_BYTES)
        .unwrap_or_default();
    serde_json::from_slice(&bytes).unwrap_or_default()
}

/// Stores the envelopes of a package.
pub fn write_signatures(path: &Path, envelopes: &[&Envelope]) -> io::Result<()> {
    if let Some(parent) = path.parent() {
        durable::create_dir_all(parent)?;
    }
    durable::write(path, &serde_json::to_vec(envelopes)?, 0o600)
}

#[cfg(test)]
mod tests {
    use std::fs;

    use task_proto::desired::BlobRef;
    use task_proto::packages::publisher::{LIST_TYPE, PackageStatement};
    use task_proto::trust::envelope::SigningKey;

    use super::*;

    const NOW_MS: u64 = PROGRAM_EXISTS_SINCE_MS + 1_000_000;

    fn key(seed: u8) -> SigningKey {
        SigningKey::from_bytes([seed; 32])
    }

    fn role(seeds: &[u8]) -> Role {
        Role::new(seeds.iter().map(|seed| key(*seed).public_key()).collect(), 1).expect("a role")
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

    fn signed(seed: u8, package: &PackageRef) -> Vec<Envelope> {
        vec![PackageStatement { package: package.clone() }.seal(&key(seed))]
    }

    /// A list of publishers with one key each for the publishers and the keepers.
    fn list(version: u64, publisher: u8, keeper: u8) -> PublisherList {
        PublisherList {
            version,
            issued_at_ms: NOW_MS - 1000,
            expires_at_ms: NOW_MS + 1000,
            publishers: role(&[publisher]),
            keepers: role(&[keeper]),
            withdrawn: Vec::new(),
        }
    }

    struct Robot {
        trust: Trust,
        dir: tempfile::TempDir,
    }

    impl Robot {
        /// A robot whose settings name publisher 1 and keeper 2.
        fn new() -> Self {
            let dir = tempfile::tempdir().expect("a directory");
            Self { trust: Self::open(&dir, 1, 2, false), dir }
        }

        fn open(dir: &tempfile::TempDir, publisher: u8, keeper: u8, requires_list: bool) -> Trust {
            let settings = TrustSettings {
                publishers: role(&[publisher]),
                keepers: role(&[keeper]),
                requires_list,
            };
            Trust::open(settings, dir.path().join("publishers.json"))
        }

        fn take(&self, envelope: &Envelope) -> Result<(), ListError> {
            self.trust
                .accept_list(envelope, Digest::of(&serde_json::to_vec(envelope).expect("json")))
        }

        fn restart(&mut self) {
            self.trust = Self::open(&self.dir, 1, 2, false);
        }

        fn check_package(
            &self,
            seed: u8,
            purpose: PackageUse,
            wall_ms: u64,
        ) -> Result<usize, String> {
            let talker = package("talker");
            let envelopes = signed(seed, &talker);
            let judged = self.trust.check_package(&talker, &envelopes, purpose, wall_ms);
            judged
                .map(|counted| counted.len())
                .map_err(|trust_error| trust_error.failure(&talker).code.as_str().to_owned())
        }

        fn trusts(&self, seed: u8) -> bool {
            self.check_package(seed, PackageUse::New, NOW_MS).is_ok()
        }
    }

    #[test]
    fn publisher_list_rotates_and_revokes_keys_across_restarts() {
        let mut robot = Robot::new();
        assert!(robot.trusts(1) && !robot.trusts(3));
        robot.take(&list(1, 3, 2).seal(&key(2))).expect("follows");
        for _ in 0..2 {
            assert!(!robot.trusts(1) && robot.trusts(3));
            assert_eq!(
                robot.check_package(1, PackageUse::Restart, NOW_MS),
                Err("untrusted_package".to_owned()),
                "nor started again"
            );
            assert_eq!(robot.trust.version(), 1);
            robot.restart();
        }
        // Neither the publisher's key nor a former keeper's key may sign a list.
        assert!(matches!(robot.take(&list(2, 9, 9).seal(&key(3))), Err(ListError::Refused(_))));
        let mut handed_on = list(2, 4, 5).seal(&key(2));
        handed_on.add_signature(LIST_TYPE, &key(5)).expect("signed");
        robot.take(&handed_on).expect("follows");
        robot.restart();
        assert!(matches!(robot.take(&list(3, 1, 2).seal(&key(2))), Err(ListError::Refused(_))));
        robot.take(&list(7, 6, 5).seal(&key(5))).expect("versions may be left out");
        assert!(robot.trusts(6) && !robot.trusts(4));
    }

    #[test]
    fn older_publisher_list_is_refused_across_restarts() {
        let mut robot = Robot::new();
        let (old, new) = (list(1, 1, 2).seal(&key(2)), list(2, 3, 2).seal(&key(2)));
        robot.take(&old).expect("follows");
        robot.take(&new).expect("follows");
        for _ in 0..2 {
            let refused = robot.take(&old);
            assert!(matches!(
                refused,
                Err(ListError::Refused(PublisherError::NotNewer { offered: 1, known: 2 }))
            ));
            assert!(robot.take(&new).is_err() && robot.trust.list_digest().is_some());
            let forked = list(2, 1, 2).seal(&key(2));
            assert!(robot.take(&forked).is_err(), "another of the same version");
            assert!(!robot.trusts(1));
            robot.restart();
        }
    }

    #[test]
    fn expired_publisher_list_blocks_new_packages_only() {
        let robot = Robot::new();
        robot.take(&list(1, 3, 2).seal(&key(2))).expect("follows");
        assert_eq!(robot.check_package(3, PackageUse::New, NOW_MS + 999), Ok(1));
        assert_eq!(
            robot.check_package(3, PackageUse::New, NOW_MS + 1000),
            Err("publishers_expired".to_owned())
        );
        assert_eq!(
            robot.check_package(3, PackageUse::Restart, NOW_MS + 1000),
            Ok(1),
            "running tasks continue"
        );
        assert_eq!(
            robot.check_package(9, PackageUse::New, NOW_MS + 1000),
            Err("untrusted_package".to_owned())
        );
        // A clock value that can't be right.
        assert_eq!(robot.check_package(3, PackageUse::New, 0), Ok(1));
        let renewed = PublisherList { expires_at_ms: NOW_MS + 9000, ..list(2, 3, 2) };
        robot.take(&renewed.seal(&key(2))).expect("follows");
        assert_eq!(robot.check_package(3, PackageUse::New, NOW_MS + 1000), Ok(1));
    }

    #[test]
    fn required_publisher_list_missing_blocks_all_packages() {
        let dir = tempfile::tempdir().expect("a directory");
        let robot = Robot { trust: Robot::open(&dir, 1, 2, true), dir };
        for purpose in [PackageUse::New, PackageUse::Restart] {
            assert_eq!(
                robot.check_package(1, purpose, NOW_MS),
                Err("publishers_expired".to_owned())
            );
        }
        robot.take(&list(1, 1, 2).seal(&key(2))).expect("follows");
        assert!(robot.trusts(1));
    }

    #[test]
    fn withdrawn_package_is_refused_despite_valid_signatures() {
        let robot = Robot::new();
        let withdrawn = vec![Digest::of(b"talker manifest")];
        let list = PublisherList { withdrawn, ..list(1, 1, 2) };
        robot.take(&list.seal(&key(2))).expect("follows");
        for purpose in [PackageUse::New, PackageUse::Restart] {
            assert_eq!(
                robot.check_package(1, purpose, NOW_MS),
                Err("untrusted_package".to_owned())
            );
        }
        let other = package("other");
        assert!(
            robot.trust.check_package(&other, &signed(1, &other), PackageUse::New, NOW_MS).is_ok()
        );
    }

    #[test]
    fn changed_keeper_settings_void_the_stored_list() {
        let robot = Robot::new();
        robot.take(&list(5, 3, 2).seal(&key(2))).expect("follows");
        // Other publishers, the same keeper: the list and its version still apply.
        let trust = Robot::open(&robot.dir, 9, 2, false);
        assert_eq!(trust.version(), 5);
        // Another keeper: the list no longer applies.
        assert_eq!(Robot::open(&robot.dir, 1, 7, false).version(), 0);
    }

    #[test]
    fn unreadable_publisher_list_blocks_all_packages() {
        let mut robot = Robot::new();
        let path = robot.dir.path().join("publishers.json");
        fs::create_dir(path.with_extension("json.tmp")).expect("in the way");
        assert!(matches!(robot.take(&list(1, 3, 2).seal(&key(2))), Err(ListError::Disk(_))));
        assert_eq!((robot.trust.version(), robot.trusts(3)), (0, false));
        fs::write(&path, "{").expect("written");
        robot.restart();
        assert!(!robot.trusts(1) && robot.take(&list(1, 3, 2).seal(&key(2))).is_err());
    }

    #[test]
    fn stored_signatures_read_back() {
        let dir = tempfile::tempdir().expect("a directory");
        let path = dir.path().join("tasks/talker/x.signatures");
        assert!(read_signatures(&path).is_empty());
        let envelopes = signed(1, &package("talker"));
        write_signatures(&path, &envelopes.iter().collect::<Vec<_>>()).expect("written");
        assert_eq!(read_signatures(&path), envelopes);
    }
}
