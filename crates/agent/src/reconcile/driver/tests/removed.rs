//! A robot that its server no longer knows, and the messages that make the robot known again.

use super::*;

#[tokio::test]
async fn removed_robot_keeps_tasks_and_starts_nothing_new() {
    let bench = Bench::new().await;
    bench.order(1, vec![order("1.0")]).await;
    bench.phase(Phase::Running).await;
    bench.say(ServerMessage::TokenRefused("this robot was revoked".to_owned())).await;
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
async fn removed_robot_starts_nothing_after_a_restart_until_accepted_again() {
    let bench = Bench::new().await;
    bench.fake.state(|state| state.held = true);
    bench.order(1, vec![order("1.0")]).await;
    bench.phase(Phase::Deferred).await;
    bench.say(ServerMessage::TokenRefused(String::new())).await;
    bench.report(|report| has(report, "removed")).await;
    let fake = bench.fake.clone();
    let key = SigningKey::from_bytes(bench.key.to_bytes());
    let robot = bench.robot.clone();
    let ledger = bench.end().await;

    fake.state(|state| state.held = false);
    let bench = Bench::with(fake, ledger, key, robot).await;
    let report = bench.report(|report| has(report, "removed") && !has(report, "held")).await;
    assert_eq!((report.start, bench.fake.state(|state| state.started.len())), (2, 0));
    bench.say(ServerMessage::Unchanged).await;
    bench.phase(Phase::Running).await;
}

#[tokio::test]
async fn only_the_server_clears_a_removal() {
    let bench = Bench::new().await;
    let tasks = vec![order("1.0")];
    let ServerMessage::Desired { envelope, inline, .. } =
        bench.sealed(1, tasks.clone(), &bench.key)
    else {
        panic!("sealed")
    };
    let again = |was_asked_for| ServerMessage::Desired {
        envelope: envelope.clone(),
        inline: inline.clone(),
        was_asked_for,
    };
    bench.say(again(false)).await;
    bench.phase(Phase::Running).await;
    // Other messages on the broker do not count: those signed by others, and old ones from the
    // server.
    for message in [bench.sealed(2, tasks.clone(), &SigningKey::random()), again(false)] {
        bench.say(ServerMessage::TokenRefused("revoked".to_owned())).await;
        bench.report(|report| has(report, "removed")).await;
        bench.say(message).await;
        bench
            .say(ServerMessage::StateUnavailable {
                code: "after_it".to_owned(),
                text: String::new(),
            })
            .await;
        bench.report(|report| has(report, "after_it") && has(report, "removed")).await;
        bench.say(ServerMessage::Unchanged).await;
        bench.report(|report| !has(report, "after_it") && !has(report, "removed")).await;
    }
    // The server's answer, and a newly signed state.
    for message in [again(true), bench.sealed(2, tasks, &bench.key)] {
        bench.say(ServerMessage::TokenRefused("revoked".to_owned())).await;
        bench.report(|report| has(report, "removed")).await;
        bench.say(message).await;
        bench.report(|report| !has(report, "removed")).await;
    }
}
