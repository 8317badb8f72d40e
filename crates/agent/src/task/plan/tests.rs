//! Properties of the plan, shown in a small simulated world with events in any order: no job runs
//! twice, no task has two processes, unwanted steps are interrupted, and the world converges once
//! it is quiet.

mod changed_trees;
mod world;

use std::time::Duration;

use proptest::prelude::*;
use task_proto::messages::report::{FailureCode, Phase};
use task_proto::packages::manifest::{OnBoot, Outputs, Restart, Run, TaskKind};

use self::world::{HealthSample, World, WorldEvent, event, health, manifest, order, package};
use super::*;
use crate::task::ledger::GateStep;
use crate::task::observed::Missing;
use crate::task::timing::backoff_ms;

fn run_rules() -> impl Strategy<Value = Run> {
    let kind = prop_oneof![Just(TaskKind::Service), Just(TaskKind::Job)];
    let on_boot = prop_oneof![Just(OnBoot::Start), Just(OnBoot::Hold)];
    let restart =
        prop_oneof![Just(Restart::Always), Just(Restart::OnFailure), Just(Restart::Never)];
    (kind, on_boot, restart, any::<bool>()).prop_map(|(kind, on_boot, restart, idempotent)| Run {
        kind,
        on_boot,
        restart,
        idempotent,
        ..Run::default()
    })
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 512, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn any_event_sequence_is_safe_and_converges(
        rules in run_rules(),
        outputs in prop::bool::ANY,
        checks_signatures in any::<bool>(),
        bad in prop_oneof![Just(None), Just(Some(0)), Just(Some(1))],
        happenings in prop::collection::vec(event(), 1..80),
    ) {
        let outputs = Outputs { paths: outputs.then(|| "maps/*".to_owned()).into_iter().collect() };
        let mut world = World::new(rules);
        (world.bad, world.outputs, world.checks_signatures) = (bad, outputs, checks_signatures);
        for event in happenings {
            world.apply(event);
            prop_assert!(world.alive.len() <= 1);
        }
        world.settle();
        match (&world.desired, &world.record) {
            (None, record) => {
                prop_assert!(record.is_none() && world.alive.is_empty() && world.disk.is_empty());
            }
            (Some(order), Some(record)) => {
                prop_assert_eq!(&record.order, order);
                let phase = record.order_phase().0;
                let written = serde_json::to_value(record).expect("json");
                prop_assert_eq!(&serde_json::json!(phase), &written["phase"]);
                match order.wanted {
                    TargetState::Stopped => prop_assert!(world.alive.is_empty() && phase == Phase::Stopped),
                    TargetState::Running => {
                        let active = record.active.as_ref().filter(|active| active.is_for(order));
                        let runs = active.is_some_and(|active| active.process().is_some()) && world.alive.len() == 1;
                        prop_assert!(runs == (phase == Phase::Running), "{phase} {active:?} {:?}", world.alive);
                        prop_assert!(runs || phase.is_final(), "stuck in {phase}: {record:?}");
                        let old_runs = active.is_none() && world.alive.len() == 1;
                        prop_assert!(phase != Phase::RolledBack || old_runs, "nothing came back: {record:?}");
                        let bad = bad.is_some_and(|number| order.package == package(number));
                        prop_assert!(!(bad && runs), "it runs, and is not ready");
                    }
                }
                prop_assert!(world.disk.len() <= 3);
                prop_assert!(record.collections.is_empty());
            }
            (Some(_), None) => prop_assert!(false, "an order without a record"),
        }
    }

    #[test]
    fn backoff_stays_in_its_bounds(attempt in 0..u32::MAX, jitter in 0.0..1.0f64) {
        prop_assert!(backoff_ms(attempt, 60_000, jitter) <= 60_000);
        prop_assert!(backoff_ms(attempt, 60_000, 1.0) >= backoff_ms(attempt, 60_000, jitter));
    }
}

fn running(run: Run) -> World {
    let mut world = World::new(run);
    world.apply(WorldEvent::Order { deployment: 0, run: 1, stop: false });
    while world.alive.is_empty() {
        world.apply(WorldEvent::Effect { succeeds: true });
        world.apply(WorldEvent::Learn);
    }
    world.apply(WorldEvent::Wait { ms: 2000 });
    assert_eq!(world.record.as_ref().expect("a record").phase(), Phase::Running);
    world
}

fn phase(world: &World) -> Phase {
    world.record.as_ref().expect("a record").phase()
}

#[test]
fn old_version_runs_until_the_new_one_is_staged_and_after_a_cancel() {
    let mut world = running(Run::default());
    let old = world.alive.clone();
    world.apply(WorldEvent::Order { deployment: 1, run: 1, stop: false });
    assert!(matches!(world.steps[..], [(Step::PullManifest(_), false)]));
    assert_eq!((phase(&world), &world.alive), (Phase::Fetching, &old));
    world.apply(WorldEvent::Order { deployment: 0, run: 1, stop: false });
    assert_eq!((phase(&world), &world.alive), (Phase::Running, &old));
    assert!(world.steps.is_empty(), "the cancelled step is interrupted: {:?}", world.steps);
}

#[test]
fn old_version_comes_back_after_a_reboot_while_the_new_one_is_pulled() {
    let mut world = running(Run::default());
    world.apply(WorldEvent::Order { deployment: 1, run: 1, stop: false });
    world.apply(WorldEvent::Reboot);
    let mut lanes: Vec<Lane> = world.steps.iter().map(|(step, _)| step.lane()).collect();
    lanes.sort();
    assert_eq!(lanes, [Lane::Prepare, Lane::Run]);
    assert_eq!(phase(&world), Phase::Fetching);
}

#[test]
fn apparently_failed_start_is_stopped_before_the_failure_counts() {
    let mut world = World::new(Run::default());
    world.apply(WorldEvent::Order { deployment: 0, run: 1, stop: false });
    while !matches!(world.steps[..], [(Step::Start(_), false)]) {
        world.apply(WorldEvent::Effect { succeeds: true });
        world.apply(WorldEvent::Learn);
    }
    let (Step::Start(run), _) = world.steps[0].clone() else { panic!("looked for") };
    // The shim did not answer in time but has started the process.
    world.alive.push(run.process().expect("begun").dir.clone());
    world.apply(WorldEvent::Effect { succeeds: false });
    assert!(matches!(world.steps[..], [(Step::Stop(_), false)]), "{:?}", world.steps);
    world.apply(WorldEvent::Effect { succeeds: true });
    world.apply(WorldEvent::Learn);
    let active = |world: &World| {
        world.record.as_ref().and_then(|record| record.active.clone()).expect("active")
    };
    assert_eq!(
        (world.alive.len(), active(&world).restarts(), active(&world).process()),
        (0, 1, None)
    );
    world.settle();
    assert_eq!((phase(&world), world.alive.len()), (Phase::Running, 1));
}

#[test]
fn oversized_retry_delay_saturates() {
    let mut world = World::new(Run::default());
    world.apply(WorldEvent::Order { deployment: 0, run: 1, stop: false });
    world.apply(WorldEvent::RetryLater { ms: u64::MAX });
    assert_eq!(world.record.as_ref().expect("a record").preparation.retry_at_ms, u64::MAX);
    assert!(world.steps.is_empty(), "{:?}", world.steps);
}

#[test]
fn hold_starts_nothing_and_stops_nothing() {
    let mut world = running(Run::default());
    let old = world.alive.clone();
    world.apply(WorldEvent::Hold(true));
    world.apply(WorldEvent::Order { deployment: 1, run: 1, stop: false });
    for _ in 0..4 {
        world.apply(WorldEvent::Effect { succeeds: true });
        world.apply(WorldEvent::Learn);
    }
    assert_eq!((phase(&world), &world.alive), (Phase::Deferred, &old));
    world.apply(WorldEvent::Hold(false));
    assert!(matches!(world.steps[..], [(Step::Stop(_), false)]));
}

#[test]
fn lost_job_is_interrupted_unless_idempotent() {
    for (idempotent, expected) in [(false, Phase::Failed), (true, Phase::Starting)] {
        let mut world = running(Run { kind: TaskKind::Job, idempotent, ..Run::default() });
        world.apply(WorldEvent::Reboot);
        assert_eq!(phase(&world), expected);
    }
}

#[test]
fn start_cut_by_power_loss_is_repeated_except_for_jobs() {
    let job = |idempotent| Run { kind: TaskKind::Job, idempotent, ..Run::default() };
    for (run, may_have_begun, expected) in [
        (job(false), true, Phase::Failed),
        (job(false), false, Phase::Starting),
        (job(true), true, Phase::Starting),
        (Run::default(), true, Phase::Starting),
    ] {
        let mut world = World::new(run);
        world.apply(WorldEvent::Order { deployment: 0, run: 1, stop: false });
        while !matches!(world.steps[..], [(Step::Start(_), false)]) {
            world.apply(WorldEvent::Effect { succeeds: true });
            world.apply(WorldEvent::Learn);
        }
        if may_have_begun {
            world.apply(WorldEvent::Effect { succeeds: true });
        }
        world.apply(WorldEvent::Reboot);
        assert_eq!(phase(&world), expected, "{may_have_begun}");
        assert_eq!(
            matches!(world.steps[..], [(Step::Start(_), false)]),
            expected == Phase::Starting
        );
    }
}

#[test]
fn job_that_never_ran_is_started_again() {
    let mut world = World::new(Run { kind: TaskKind::Job, ..Run::default() });
    world.apply(WorldEvent::Order { deployment: 0, run: 1, stop: false });
    while !matches!(world.steps[..], [(Step::Start(_), false)]) {
        world.apply(WorldEvent::Effect { succeeds: true });
        world.apply(WorldEvent::Learn);
    }
    world.apply(WorldEvent::Effect { succeeds: false });
    world.apply(WorldEvent::Learn);
    assert_eq!((phase(&world), world.alive.len()), (Phase::Starting, 0));
    world.settle();
    assert_eq!((phase(&world), world.alive.len()), (Phase::Running, 1));
}

#[test]
fn outputs_of_a_run_replaced_before_ready_are_uploaded() {
    let mut world = World::new(Run::default());
    world.outputs = Outputs { paths: vec!["maps/*".to_owned()] };
    world.health = health(HealthSample::NotAll, 0);
    world.apply(WorldEvent::Order { deployment: 0, run: 1, stop: false });
    while world.alive.is_empty() {
        world.apply(WorldEvent::Effect { succeeds: true });
        world.apply(WorldEvent::Learn);
    }
    world.apply(WorldEvent::Order { deployment: 1, run: 1, stop: false });
    let mut collected = Vec::new();
    for _ in 0..20 {
        collected.extend(world.steps.iter().filter_map(|(step, _)| match step {
            Step::UploadOutputs(files) => Some(files.package.clone()),
            _ => None,
        }));
        world.apply(WorldEvent::Effect { succeeds: true });
        world.apply(WorldEvent::Learn);
    }
    assert_eq!(collected.first(), Some(&package(0)), "{collected:?}");
}

#[test]
fn service_that_never_gets_ready_fails_with_its_exit_code() {
    let mut world = World::new(Run::default());
    world.apply(WorldEvent::Order { deployment: 1, run: 1, stop: false });
    for _ in 0..200 {
        world.apply(WorldEvent::Effect { succeeds: true });
        world.apply(WorldEvent::Learn);
        if world.alive.iter().any(|dir| dir.starts_with("d0000000000000001")) {
            world.apply(WorldEvent::ProcessEnds { code: 3 });
        }
        world.apply(WorldEvent::Wait { ms: 500 });
    }
    let (phase, failure) = world.record.as_ref().expect("a record").order_phase();
    assert_eq!(phase, Phase::Failed);
    assert!(failure.expect("a failure").text.contains("exited with code 3"));
}

fn bad_switch(world: &mut World) -> String {
    let old = world.alive[0].clone();
    world.bad = Some(1);
    world.apply(WorldEvent::Order { deployment: 1, run: 1, stop: false });
    while !world.alive.iter().any(|dir| dir.starts_with("d0000000000000001")) {
        world.apply(WorldEvent::Effect { succeeds: true });
        world.apply(WorldEvent::Learn);
    }
    old
}

#[test]
fn version_that_does_not_get_ready_is_stopped_and_the_old_one_started_again() {
    let mut world = running(Run::default());
    bad_switch(&mut world);
    assert_eq!(phase(&world), Phase::Starting);
    world.apply(WorldEvent::Wait { ms: 30_000 });
    assert!(matches!(world.steps[..], [(Step::Stop(_), false)]), "{:?}", world.steps);
    assert_eq!(phase(&world), Phase::Starting, "it is not final before the process is gone");
    world.apply(WorldEvent::Effect { succeeds: true });
    world.apply(WorldEvent::Learn);
    let record = world.record.as_ref().expect("a record");
    let (phase, failure) = record.order_phase();
    assert_eq!(phase, Phase::RolledBack);
    assert_eq!(failure.expect("why").to_string(), "not_ready: `/mapper` is gone within 30 s");
    assert!(
        matches!(&world.steps[..], [(Step::Start(run), false)] if run.package == package(0)),
        "{:?}",
        world.steps
    );
    world.settle();
    assert_eq!(
        (world.alive.len(), world.record.as_ref().expect("a record").phase()),
        (1, Phase::RolledBack)
    );
    // A reboot brings the old run back, and the order is not retried by itself.
    world.apply(WorldEvent::Reboot);
    world.settle();
    let record = world.record.as_ref().expect("a record");
    assert_eq!(
        (record.phase(), &record.active.as_ref().expect("active").package),
        (Phase::RolledBack, &package(0))
    );
    world.bad = None;
    world.apply(WorldEvent::Order { deployment: 1, run: 2, stop: false });
    world.settle();
    assert_eq!(world.record.as_ref().expect("a record").phase(), Phase::Running);
}

#[test]
fn restored_run_continues_when_ordered_again() {
    let mut world = running(Run::default());
    bad_switch(&mut world);
    world.apply(WorldEvent::Wait { ms: 30_000 });
    world.settle();
    let old = world.alive.clone();
    assert_eq!((phase(&world), old.len()), (Phase::RolledBack, 1));
    world.apply(WorldEvent::Order { deployment: 0, run: 1, stop: false });
    world.settle();
    assert_eq!((phase(&world), &world.alive), (Phase::Running, &old));
}

#[test]
fn rollback_survives_a_power_cut_before_and_after_every_step() {
    for cut in 0..12 {
        let mut world = running(Run::default());
        bad_switch(&mut world);
        for at in 0..12 {
            if at == cut {
                world.apply(WorldEvent::Reboot);
            }
            world.apply(if at % 2 == 0 {
                WorldEvent::Wait { ms: 15_000 }
            } else {
                WorldEvent::Effect { succeeds: true }
            });
            world.apply(WorldEvent::Learn);
        }
        world.settle();
        assert_eq!((phase(&world), world.alive.len()), (Phase::RolledBack, 1), "cut at {cut}");
    }
}

#[test]
fn order_fails_when_the_restored_version_fails() {
    let mut world = running(Run::default());
    bad_switch(&mut world);
    for _ in 0..10_000 {
        world.apply(WorldEvent::Effect { succeeds: true });
        world.apply(WorldEvent::Learn);
        if phase(&world) == Phase::RolledBack {
            world.apply(WorldEvent::ProcessEnds { code: 3 });
        }
        world.apply(WorldEvent::Wait { ms: 30_000 });
    }
    let (phase, failure) = world.record.as_ref().expect("a record").order_phase();
    let text = &failure.expect("why").text;
    assert_eq!((phase, world.alive.len()), (Phase::Failed, 0));
    assert!(
        text.contains("within 30 s\n1.0, which had been restored, failed: the process ended"),
        "{text}"
    );
}

#[test]
fn stopped_run_does_not_come_back() {
    let mut world = running(Run::default());
    world.apply(WorldEvent::Order { deployment: 0, run: 2, stop: true });
    world.settle();
    assert_eq!(phase(&world), Phase::Stopped);
    world.apply(WorldEvent::Order { deployment: 1, run: 1, stop: false });
    assert!(
        world.steps.iter().all(|(step, _)| step.lane() == Lane::Prepare),
        "the old one stays down meanwhile"
    );
    bad_order(&mut world);
    assert_eq!((phase(&world), world.alive.len()), (Phase::Failed, 0));
}

#[test]
fn first_version_and_a_job_that_do_not_get_ready_have_failed() {
    let mut world = World::new(Run::default());
    bad_order(&mut world);
    assert_eq!((phase(&world), world.alive.len()), (Phase::Failed, 0));
    let mut world = running(Run::default());
    world.manifest.kind = TaskKind::Job;
    bad_order(&mut world);
    assert_eq!((phase(&world), world.alive.len()), (Phase::Failed, 0));
}

fn bad_order(world: &mut World) {
    world.bad = Some(1);
    world.apply(WorldEvent::Order { deployment: 1, run: 1, stop: false });
    world.settle();
}

#[test]
fn task_that_stays_degraded_is_started_again_unless_its_policy_is_never() {
    for (restart, again) in
        [(Restart::OnFailure, true), (Restart::Always, true), (Restart::Never, false)]
    {
        let mut world = running(Run { restart, ..Run::default() });
        world.apply(WorldEvent::Sees(HealthSample::NotAll));
        world.apply(WorldEvent::Wait { ms: 29_999 });
        assert!(world.steps.is_empty());
        world.apply(WorldEvent::Wait { ms: 1 });
        assert_eq!(matches!(world.steps[..], [(Step::Stop(_), false)]), again, "{restart:?}");
        assert_eq!(phase(&world), Phase::Running);
        world.settle();
        let active = world.record.as_ref().expect("a record").active.as_ref().expect("active");
        assert_eq!((phase(&world), active.restarts()), (Phase::Running, u32::from(again)));
    }
}

#[test]
fn readiness_must_hold_without_interruption() {
    let mut world = World::new(Run::default());
    world.health = Health::Unknown;
    world.apply(WorldEvent::Order { deployment: 0, run: 1, stop: false });
    while world.alive.is_empty() {
        world.apply(WorldEvent::Effect { succeeds: true });
        world.apply(WorldEvent::Learn);
    }
    for sample in [HealthSample::All, HealthSample::NotAll, HealthSample::All] {
        world.apply(WorldEvent::Sees(sample));
        world.apply(WorldEvent::Wait { ms: 1999 });
        assert_eq!(phase(&world), Phase::Starting);
    }
    world.apply(WorldEvent::Wait { ms: 1 });
    assert_eq!(phase(&world), Phase::Running);
    let mut world = running(Run::default());
    world.apply(WorldEvent::Sees(HealthSample::Refused));
    assert_eq!(
        (phase(&world), world.steps.len()),
        (Phase::Running, 0),
        "only a start can be refused"
    );
}

#[test]
fn run_ready_before_a_power_cut_is_retried_after_a_refusal() {
    let mut world = running(Run::default());
    world.apply(WorldEvent::Reboot);
    world.health = health(HealthSample::Refused, 0);
    for _ in 0..20 {
        world.apply(WorldEvent::Effect { succeeds: true });
        world.apply(WorldEvent::Learn);
        world.apply(WorldEvent::Wait { ms: 30_000 });
    }
    let active = world.record.as_ref().expect("a record").active.as_ref().expect("active");
    assert!(active.end().is_none() && active.restarts() > 0, "{active:?}");
    world.health = health(HealthSample::All, 0);
    world.settle();
    assert_eq!((phase(&world), world.alive.len()), (Phase::Running, 1));
}

#[test]
fn external_fault_does_not_stop_a_run() {
    let mut world = running(Run::default());
    let Health::Missing(missing) = health(HealthSample::NotAll, 0) else { panic!("it is missing") };
    for (is_own_fault, stops) in [(false, 0), (true, 1)] {
        world.health = Health::Missing(Missing { is_own_fault, ..missing.clone() });
        world.apply(WorldEvent::Wait { ms: 600_000 });
        assert_eq!(world.steps.len(), stops, "{:?}", world.steps);
    }
    assert!(matches!(world.steps[..], [(Step::Stop(_), false)]), "{:?}", world.steps);
}

#[test]
fn job_is_stopped_at_its_deadline() {
    let mut world = running(Run { kind: TaskKind::Job, deadline_s: Some(60), ..Run::default() });
    world.apply(WorldEvent::Wait { ms: 57_999 });
    assert!(world.steps.is_empty());
    world.apply(WorldEvent::Wait { ms: 1 });
    assert!(matches!(world.steps[..], [(Step::Stop(_), false)]), "{:?}", world.steps);
    world.settle();
    let (phase, failure) = world.record.as_ref().expect("a record").order_phase();
    assert_eq!(
        (phase, &failure.expect("why").code),
        (Phase::Failed, &FailureCode::DEADLINE_EXCEEDED)
    );
}

#[test]
fn gate_allows_a_switch_as_a_whole() {
    let mut world = running(Run::default());
    world.gated = true;
    let old = world.alive.clone();
    world.apply(WorldEvent::Order { deployment: 1, run: 1, stop: false });
    while !matches!(world.steps[..], [(Step::QueryGate(_), _)]) {
        world.apply(WorldEvent::Effect { succeeds: true });
        world.apply(WorldEvent::Learn);
    }
    let step = |world: &World| match &world.steps[..] {
        [(Step::QueryGate(question), false)] => Some(question.step),
        _ => None,
    };
    assert_eq!(step(&world), Some(GateStep::Switch));
    for _ in 0..3 {
        world.apply(WorldEvent::Effect { succeeds: false });
        assert_eq!((phase(&world), &world.alive), (Phase::Deferred, &old));
        assert!(world.steps.is_empty(), "it is asked again later");
        world.apply(WorldEvent::Wait { ms: 60_000 });
        assert_eq!((phase(&world), step(&world)), (Phase::Deferred, Some(GateStep::Switch)));
    }
    world.apply(WorldEvent::Effect { succeeds: true });
    world.apply(WorldEvent::Learn);
    assert!(matches!(world.steps[..], [(Step::Stop(_), false)]), "{:?}", world.steps);
    world.apply(WorldEvent::Effect { succeeds: true });
    world.apply(WorldEvent::Learn);
    assert!(matches!(world.steps[..], [(Step::Start(_), false)]), "{:?}", world.steps);
    world.settle();
    // A crash is not a new start, a reboot is.
    world.apply(WorldEvent::ProcessEnds { code: 1 });
    world.apply(WorldEvent::Wait { ms: 60_000 });
    assert!(matches!(world.steps[..], [(Step::Start(_), false)]), "{:?}", world.steps);
    world.settle();
    world.apply(WorldEvent::Reboot);
    assert_eq!(step(&world), Some(GateStep::Start));
    world.apply(WorldEvent::Effect { succeeds: false });
    assert_eq!(phase(&world), Phase::Deferred);
}

#[test]
fn stop_refused_by_the_gate_waits_under_supervision() {
    let mut world = running(Run::default());
    world.gated = true;
    world.apply(WorldEvent::Order { deployment: 0, run: 2, stop: true });
    world.apply(WorldEvent::Effect { succeeds: false });
    assert_eq!((phase(&world), world.alive.len()), (Phase::Deferred, 1));
    world.apply(WorldEvent::Sees(HealthSample::NotAll));
    world.apply(WorldEvent::Wait { ms: 30_000 });
    assert!(
        world.steps.iter().any(|(step, _)| matches!(step, Step::Stop(_))),
        "a failed run is stopped without an order"
    );
    world.settle();
    assert_eq!((phase(&world), world.alive.len()), (Phase::Stopped, 0));
}

#[test]
fn on_boot_hold_leaves_a_service_down_after_a_reboot() {
    let mut world = running(Run { on_boot: OnBoot::Hold, ..Run::default() });
    world.apply(WorldEvent::Reboot);
    world.settle();
    assert_eq!((phase(&world), world.alive.len()), (Phase::Stopped, 0));
    world.apply(WorldEvent::Order { deployment: 0, run: 2, stop: false });
    world.settle();
    assert_eq!((phase(&world), world.alive.len()), (Phase::Running, 1));
}

#[test]
fn every_step_of_the_run_lane_has_a_deadline() {
    let order = order(1, 1, 1, TargetState::Running);
    let stop_timeout_s = 3600;
    let run = ActiveRun::of(
        &order,
        RunRules::from(&manifest(&Run { stop_timeout_s, ..Run::default() })),
        0,
    );
    let steps = [
        Step::Start(Box::new(run.clone())),
        Step::Stop(Box::new(run)),
        Step::Prune { kept: Vec::new() },
        Step::Remove,
    ];
    assert!(steps.iter().all(|step| step.lane() == Lane::Run && step.deadline().is_some()));
    let stop = steps[1].deadline().expect("checked");
    assert!(
        stop > Duration::from_secs(2 * u64::from(stop_timeout_s)),
        "both signals have their time: {stop:?}"
    );
}

#[test]
fn signers_are_checked_before_any_fetch() {
    let mut world = World::new(Run::default());
    world.checks_signatures = true;
    world.apply(WorldEvent::Order { deployment: 0, run: 1, stop: false });
    assert!(matches!(world.steps[..], [(Step::CheckSigners(_), false)]), "{:?}", world.steps);
    world.apply(WorldEvent::Effect { succeeds: true });
    world.apply(WorldEvent::Learn);
    assert!(matches!(world.steps[..], [(Step::PullManifest(_), false)]), "{:?}", world.steps);
    // The publisher loses its trust during the pull.
    world.apply(WorldEvent::Signed(false));
    world.apply(WorldEvent::Effect { succeeds: true });
    world.apply(WorldEvent::Learn);
    assert!(matches!(world.steps[..], [(Step::CheckSigners(_), false)]), "{:?}", world.steps);
    world.apply(WorldEvent::Effect { succeeds: true });
    assert_eq!(phase(&world), Phase::Failed);
    let failure =
        world.record.as_ref().expect("a record").preparation.failure.clone().expect("a reason");
    assert_eq!(failure.code, FailureCode::UNTRUSTED_PACKAGE);
    assert!(
        world.steps.is_empty() && world.disk.iter().all(|(_, level)| *level < 2),
        "{:?}",
        world.disk
    );
}
