//! The documents about packages and about bulk actions on robots.

use task_proto::Digest;
use task_proto::api::{
    BulkLabels, BulkRemove, ChangedFile, DeploymentList, MatchedRobot, PackageDiff, PackageFile,
    PackageFileKind, PackageFiles, PackageUse, PackageVersions, PackageView, RetryDeployment,
    RobotList, RolledBack,
};
use task_proto::messages::report::FailureCode;

use crate::golden::{check, check_text, check_tolerance, manifest, package, parsed, robot};

fn file(text: &str, mode: u32) -> PackageFile {
    PackageFile {
        path: "src/talker.py".to_owned(),
        kind: PackageFileKind::File,
        mode,
        size: text.len() as u64,
        digest: Some(Digest::of(text.as_bytes())),
        target: None,
    }
}

#[test]
fn package_content_documents() {
    let view =
        PackageView { package: package(), pushed_at_ms: 1_800_000_000_000, manifest: manifest() };
    let running = vec![PackageUse { manifest: package().manifest.digest, robots: 12 }];
    check(
        "package_versions.json",
        &PackageVersions { name: parsed("talker"), versions: vec![view], running },
    );
    let directory = PackageFile {
        path: "src".to_owned(),
        kind: PackageFileKind::Directory,
        size: 0,
        digest: None,
        ..file("", 0o755)
    };
    let link = PackageFile {
        path: "src/newest.py".to_owned(),
        kind: PackageFileKind::Link,
        target: Some("talker.py".to_owned()),
        ..directory.clone()
    };
    check(
        "package_files.json",
        &PackageFiles { files: vec![directory, link.clone(), file("old", 0o644)] },
    );
    check_tolerance::<PackageFiles>("package_files.json");
    let changed = ChangedFile {
        path: "src/talker.py".to_owned(),
        from: file("old", 0o644),
        to: file("newer", 0o755),
    };
    let diff = PackageDiff {
        added: vec![link],
        removed: vec![],
        changed: vec![changed],
        manifest_changed: true,
    };
    check("package_diff.json", &diff);
    check_tolerance::<PackageDiff>("package_diff.json");
}

#[test]
fn bulk_documents() {
    let set = [(parsed("site"), parsed("lab"))].into();
    let selector = parsed("site=field,!arm");
    check(
        "bulk_labels.json",
        &BulkLabels { selector, set, remove: vec![parsed("room")], dry_run: false },
    );
    check("bulk_remove.json", &BulkRemove { selector: parsed("!site=lab"), dry_run: true });
    let code = Some(FailureCode::DISK_FULL);
    check("retry_deployment.json", &RetryDeployment { selector: None, code, dry_run: false });
    let matched = |name: &str| MatchedRobot { id: robot(), name: parsed(name), online: true };
    let (robots, without) = (vec![matched("atlas")], vec![matched("boreas")]);
    check("rolled_back.json", &RolledBack { deployments: vec![], robots, without });
    check_tolerance::<RolledBack>("rolled_back.json");
}

#[test]
fn paged_list_document() {
    let next = Some(parsed("atlas"));
    check_text(
        "robot_list.json",
        &RobotList { robots: vec![], unknown: vec![], next, total: Some(1_204) },
    );
    let next = Some(parsed("d00000000000000b2"));
    check_text("deployment_list.json", &DeploymentList { deployments: vec![], next });
}
