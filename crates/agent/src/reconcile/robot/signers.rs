//! Signature checks for the robot's steps: before the first fetch, and again at each step that
//! fetches, builds or starts, whatever was planned.

use task_proto::desired::PackageRef;
use tokio_util::sync::CancellationToken;

use super::Robot;
use super::outcomes::fetch_failure;
use crate::config::trust::{PackageUse, TrustError};
use crate::install::signature_policy::SignatureError;
use crate::task::plan::StepFailure;

impl Robot {
    /// Checks that the signatures permit this use of the package. Missing evidence is fetched.
    pub(super) async fn check_signatures(
        &self,
        package: &PackageRef,
        purpose: PackageUse,
        cancel: &CancellationToken,
    ) -> Result<(), StepFailure> {
        let Some(signature_policy) = &self.signature_policy else { return Ok(()) };
        signature_policy.ensure_trusted(package, purpose, cancel).await.map_err(|error| match error
        {
            SignatureError::Distrusted(trust_error) => refusal(&trust_error, package),
            SignatureError::Fetch(error) => fetch_failure(error),
        })
    }

    /// Checks again that a package found trusted a moment ago still is. If not, the step is retried
    /// after a full check.
    pub(super) fn recheck_signatures(&self, package: &PackageRef) -> Result<(), StepFailure> {
        let Some(signature_policy) = &self.signature_policy else { return Ok(()) };
        let judged = signature_policy.check_package(package, PackageUse::New);
        judged.map_err(|trust_error| StepFailure {
            retry_after_ms: Some(0),
            ..refusal(&trust_error, package)
        })
    }
}

/// The failure for a distrusted package. A retry helps only with the list of publishers, which is
/// updated by itself: other signatures come with another order.
fn refusal(trust_error: &TrustError, package: &PackageRef) -> StepFailure {
    StepFailure {
        failure: trust_error.failure(package),
        retry_after_ms: trust_error.may_pass().then_some(0),
    }
}

#[cfg(test)]
mod tests {
    use std::io;
    use std::path::Path;

    use nix::mount::{MsFlags, mount};
    use task_proto::desired::{BlobRef, DesiredState, Evidence, SignatureRef};
    use task_proto::messages::report::FailureCode;
    use task_proto::packages::publisher::PackageStatement;
    use task_proto::trust::envelope::SigningKey;
    use task_proto::{DeploymentId, Digest, Generation, RobotId};

    use super::super::tests::robot;
    use super::*;
    use crate::system::durable::own_mounts::with_own_mounts;
    use crate::task::effects::Effects as _;

    /// Runs `step` without room for one more file, expecting a failure that may pass, and again
    /// with room.
    async fn try_full(dir: &Path, step: impl AsyncFn() -> Result<(), StepFailure>) {
        let files = dir.join("files");
        std::fs::create_dir(&files).expect("made");
        let refused =
            (0..).find_map(|number: u32| std::fs::write(files.join(number.to_string()), b"").err());
        assert_eq!(refused.expect("full").kind(), io::ErrorKind::StorageFull);
        let failure = step().await.expect_err("there is no room");
        assert_eq!(failure.failure.code, FailureCode::DISK_FULL, "{}", failure.failure);
        assert!(failure.retry_after_ms.is_some_and(|least_ms| least_ms > 0), "{}", failure.failure);
        std::fs::remove_dir_all(&files).expect("removed");
        step().await.expect("there is room");
    }

    async fn prepare_on_a_full_disk(dir: &Path) {
        let key = SigningKey::from_bytes([1; 32]);
        let trusted = format!(
            "task_user = \"root\"\n[trusted_publishers]\nkeys = [\"{}\"]\n",
            key.public_key()
        );
        let robot = robot(dir, &trusted);
        let manifest = serde_json::json!({
            "name": "talker", "version": "1.0", "run": { "exec": ["true"] },
            "content": { "tar_digest": Digest::of(b""), "tar_size": 0, "entries": 0 },
        });
        let manifest = serde_json::to_vec(&manifest).expect("json");
        let package = PackageRef {
            name: "talker".parse().expect("valid"),
            version: "1.0".parse().expect("valid"),
            manifest: BlobRef::of(b"manifest"),
            config: BlobRef::of(&manifest),
            content: BlobRef::of(b"content"),
        };
        let statement = PackageStatement { package: package.clone() }.seal(&key);
        let statement = serde_json::to_vec(&statement).expect("json");
        let envelope = BlobRef::of(&statement);
        robot.offer(vec![(envelope, statement.into()), (package.config, manifest.into())]);
        let signatures = vec![SignatureRef { manifest: package.manifest.digest, envelope }];
        robot.apply_state(&DesiredState {
            robot_id: RobotId::random(),
            generation: Generation(1),
            issued_at_ms: 0,
            expires_at_ms: u64::MAX,
            tasks: Vec::new(),
            evidence: Evidence { lists: Vec::new(), signatures },
            settings: Default::default(),
            robot: Default::default(),
        });
        let cancel = CancellationToken::new();
        try_full(dir, async || robot.check_signers(&package, &cancel).await).await;
        try_full(dir, async || robot.pull_manifest(&package, &cancel).await.map(drop)).await;
        try_full(dir, async || robot.build(&package, &DeploymentId::random(), &cancel).await).await;
    }

    #[test]
    fn full_disk_is_retryable_in_every_step() {
        let temp = tempfile::tempdir().expect("a directory");
        with_own_mounts(|| {
            mount(
                Some("tmpfs"),
                temp.path(),
                Some("tmpfs"),
                MsFlags::empty(),
                Some("nr_inodes=64"),
            )
            .expect("mounted");
            // The mounts are visible only to this thread.
            let runtime = tokio::runtime::Builder::new_current_thread()
                .enable_all()
                .build()
                .expect("a runtime");
            runtime.block_on(prepare_on_a_full_disk(temp.path()));
        });
    }
}
