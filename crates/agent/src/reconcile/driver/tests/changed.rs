//! A version whose files on the disk were changed, and which no order names.

use std::sync::atomic::Ordering;

use super::*;

#[tokio::test]
async fn changed_fallback_is_fetched_again_also_by_the_next_agent() {
    let bench = Bench::new().await;
    let (old, new) = (order("1.0"), order("2.0"));
    bench.order(1, vec![old.clone()]).await;
    bench.phase(Phase::Running).await;
    let [old_version, new_version] = [&old, &new].map(|order| order.package.manifest.digest);
    bench.fake.state(|state| {
        state.bad.insert(new_version);
        state.changed.insert(old_version);
        // Only the old version has to be pulled.
        state.manifests.insert(new_version);
        state.contents.insert(new_version);
        state.kept_parts.clear();
    });
    bench.fake.slow.store(true, Ordering::SeqCst);
    bench.order(2, vec![new.clone()]).await;
    let is_restoring = |report: &Report| {
        let degraded = report.tasks[0].degraded.as_ref().map(|failure| &failure.code);
        (report.tasks[0].phase, degraded) == (Phase::RolledBack, Some(&FailureCode::TREE_CHANGED))
    };
    let report = bench.report(is_restoring).await;
    assert_eq!((&report.tasks[0].deployment, &report.tasks[0].active), (&new.deployment, &None));
    let fake = bench.fake.clone();
    let key = SigningKey::from_bytes(bench.key.to_bytes());
    let robot = bench.robot.clone();
    let ledger = bench.end().await;
    fake.slow.store(false, Ordering::SeqCst);
    let bench = Bench::with(fake, ledger, key, robot).await;
    let report = bench.report(|report| report.tasks[0].active.is_some()).await;
    let task = &report.tasks[0];
    assert_eq!((task.phase, &task.degraded), (Phase::RolledBack, &None));
    assert_eq!(task.active.as_ref().expect("the old one").deployment, old.deployment);
    let (pulled, kept_parts) =
        bench.fake.state(|state| (state.pulled.len(), state.kept_parts.clone()));
    assert_eq!(pulled, 2, "the old version, twice");
    assert!(kept_parts.contains(&vec![old.package.content.digest]), "{kept_parts:?}");
}
