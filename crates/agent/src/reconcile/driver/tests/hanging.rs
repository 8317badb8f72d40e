//! A task with a process of undeterminable state is left alone, and the other tasks continue.

use super::*;

#[tokio::test]
async fn undeterminable_process_is_observed_rarely_and_does_not_block_other_tasks() {
    let bench = Bench::new().await;
    let talker = order("1.0");
    let mut other = order("2.0");
    other.task = "listener".parse().expect("valid");
    other.package.name = other.task.clone();
    bench.order(1, vec![talker.clone()]).await;
    bench.phase(Phase::Running).await;
    let began = Instant::now();
    bench.fake.state(|state| state.hangs = true);
    bench.fake.exit(1);
    let mut looked = bench.fake.looks.subscribe();
    let looked = tokio::time::timeout(PATIENCE, looked.wait_for(|looks| *looks > 0)).await;
    looked.expect("it is looked at").expect("the fake lives");
    bench.order(2, vec![talker.clone(), other.clone()]).await;
    let runs = |task: &task_proto::messages::report::TaskReport| {
        task.task == other.task && task.phase == Phase::Running
    };
    bench.report(|report| report.tasks.iter().any(runs)).await;
    let looks = *bench.fake.looks.borrow();
    let periods = began.elapsed().as_millis() as u64 / plan::OBSERVE_AGAIN_MS;
    assert!(looks <= periods + 1, "{looks} looks");
    bench.fake.state(|state| (state.hangs, state.alive) = (false, Default::default()));
    bench
        .report(|report| {
            report.tasks.iter().any(|task| task.task == talker.task && task.restarts == 1)
        })
        .await;
}
