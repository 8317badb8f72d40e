//! A robot that its server no longer knows, and the messages that make the robot known again.

use super::*;

#[tokio::test]
async fn a_removed_robot_goes_on_and_begins_nothing_new() {
    let bench = Bench::new().await;
    bench.order(1, vec![order("1.0")]).await;
    bench.phase(Phase::Running).await;
    bench.say(Heard::TokenRefused("this robot was revoked".to_owned())).await;
    let report = bench.report(|report| has(report, "removed")).await;
    assert_eq!(report.tasks[0].phase, Phase::Running);
    assert!(
        report.conditions[0].text.contains("(this robot was revoked)"),
        "{:?}",
        report.conditions
    );
    let ledger = bench.end().await;
    assert!(ledger.removed, "it is remembered over a restart");
}

#[tokio::test]
async fn a_removed_robot_begins_nothing_after_a_restart_until_it_is_known_again() {
    let bench = Bench::new().await;
    bench.fake.state(|state| state.held = true);
    bench.order(1, vec![order("1.0")]).await;
    bench.phase(Phase::Deferred).await;
    bench.say(Heard::TokenRefused(String::new())).await;
    bench.report(|report| has(report, "removed")).await;
    let (fake, key, robot) =
        (bench.fake.clone(), SigningKey::from_bytes(bench.key.to_bytes()), bench.robot.clone());
    let ledger = bench.end().await;

    fake.state(|state| state.held = false);
    let bench = Bench::with(fake, ledger, key, robot).await;
    let report = bench.report(|report| has(report, "removed") && !has(report, "held")).await;
    assert_eq!((report.start, bench.fake.state(|state| state.started.len())), (2, 0));
    bench.say(Heard::Unchanged).await;
    bench.phase(Phase::Running).await;
}

#[tokio::test]
async fn nobody_but_the_server_makes_a_removed_robot_known_again() {
    let bench = Bench::new().await;
    let tasks = vec![order("1.0")];
    let Heard::Desired { envelope, inline, .. } = bench.sealed(1, tasks.clone(), &bench.key) else {
        panic!("sealed")
    };
    let again = |was_asked_for| Heard::Desired {
        envelope: envelope.clone(),
        inline: inline.clone(),
        was_asked_for,
    };
    bench.say(again(false)).await;
    bench.phase(Phase::Running).await;
    // Other messages on the broker do not count: those signed by others, and old ones from the
    // server.
    for message in [bench.sealed(2, tasks.clone(), &SigningKey::random()), again(false)] {
        bench.say(Heard::TokenRefused("revoked".to_owned())).await;
        bench.report(|report| has(report, "removed")).await;
        bench.say(message).await;
        bench.say(Heard::Withheld { code: "after_it".to_owned(), text: String::new() }).await;
        bench.report(|report| has(report, "after_it") && has(report, "removed")).await;
        bench.say(Heard::Unchanged).await;
        bench.report(|report| !has(report, "after_it") && !has(report, "removed")).await;
    }
    // The server's answer, and a newly signed state.
    for message in [again(true), bench.sealed(2, tasks, &bench.key)] {
        bench.say(Heard::TokenRefused("revoked".to_owned())).await;
        bench.report(|report| has(report, "removed")).await;
        bench.say(message).await;
        bench.report(|report| !has(report, "removed")).await;
    }
}
