//! Runs whose files were changed on the disk: each is prepared anew before it starts, the ordered
//! run, and a run that stayed or came back when the ordered version failed.

use super::*;

/// Ends the process of the active run, whose next start finds changed files.
fn crash_and_find_change(world: &mut World) {
    world.apply(WorldEvent::ProcessEnds { code: 1 });
    world.apply(WorldEvent::Wait { ms: 90_000 });
    assert!(matches!(world.steps[..], [(Step::Start(_), false)]), "{:?}", world.steps);
    world.apply(WorldEvent::FindsChange);
}

/// A robot that has gone back to its first version, with the second one on order, and is about to
/// start the first one.
fn starting_fallback() -> World {
    let mut world = running(Run::default());
    bad_switch(&mut world);
    world.apply(WorldEvent::Wait { ms: 30_000 });
    world.apply(WorldEvent::Effect { succeeds: true });
    world.apply(WorldEvent::Learn);
    assert_starts(&world, 0);
    world
}

#[track_caller]
fn assert_starts(world: &World, number: u8) {
    let starts =
        matches!(&world.steps[..], [(Step::Start(run), false)] if run.package == package(number));
    assert!(starts, "{:?}", world.steps);
}

#[track_caller]
fn assert_pulls(world: &World, number: u8) {
    let pull = Step::PullContent { package: package(number), is_pushed: false };
    assert_eq!(world.steps, [(pull, false)]);
}

fn order_phase(world: &World) -> (Phase, Option<FailureCode>) {
    let (phase, failure) = world.record.as_ref().expect("a record").order_phase();
    (phase, failure.map(|failure| failure.code.clone()))
}

fn runs(world: &World, number: u8) -> bool {
    let active = world.record.as_ref().and_then(|record| record.active.as_ref());
    world.alive.len() == 1 && active.is_some_and(|active| active.package == package(number))
}

#[test]
fn changed_tree_is_fetched_and_built_again_before_the_start() {
    let mut world = running(Run::default());
    crash_and_find_change(&mut world);
    assert_pulls(&world, 0);
    assert_eq!(order_phase(&world), (Phase::Fetching, Some(FailureCode::TREE_CHANGED)));
    world.apply(WorldEvent::Wait { ms: 90_000 });
    assert!(world.alive.is_empty(), "it is not started before it is there");
    world.settle();
    assert_eq!((order_phase(&world), runs(&world, 0)), ((Phase::Running, None), true));
}

#[test]
fn changed_tree_of_the_fallback_is_fetched_and_built_again_before_the_start() {
    let mut world = starting_fallback();
    world.apply(WorldEvent::FindsChange);
    assert_pulls(&world, 0);
    assert_eq!(order_phase(&world), (Phase::RolledBack, Some(FailureCode::NOT_READY)));
    world.apply(WorldEvent::Wait { ms: 90_000 });
    assert!(world.alive.is_empty(), "it is not started before it is there");
    for expected in ["pull", "build", "start"] {
        let task = "talker".parse().expect("valid");
        let step = describe(&task, &world.steps[0].0);
        assert!(step.starts_with(&format!("{expected} talker 1.0")), "{step}");
        world.apply(WorldEvent::Effect { succeeds: true });
        world.apply(WorldEvent::Learn);
    }
    world.settle();
    let record = world.record.as_ref().expect("a record");
    assert_eq!(
        (phase(&world), runs(&world, 0), &record.restoring),
        (Phase::RolledBack, true, &None)
    );
}

#[test]
fn restoring_the_fallback_survives_a_power_cut_before_and_after_every_step() {
    for cut in 0..12 {
        let mut world = starting_fallback();
        world.apply(WorldEvent::FindsChange);
        for at in 0..12 {
            if at == cut {
                world.apply(WorldEvent::Reboot);
            }
            world.apply(if at % 2 == 0 {
                WorldEvent::Effect { succeeds: true }
            } else {
                WorldEvent::Learn
            });
        }
        world.settle();
        assert_eq!((phase(&world), runs(&world, 0)), (Phase::RolledBack, true), "cut at {cut}");
    }
}

#[test]
fn changed_tree_is_fetched_again_after_the_ordered_version_failed_to_prepare() {
    let mut world = running(Run::default());
    world.checks_signatures = true;
    world.apply(WorldEvent::Signed(false));
    world.apply(WorldEvent::Order { deployment: 1, run: 1, stop: false });
    world.apply(WorldEvent::Effect { succeeds: true });
    let failed = (Phase::Failed, Some(FailureCode::UNTRUSTED_PACKAGE));
    assert_eq!((order_phase(&world), runs(&world, 0)), (failed.clone(), true));
    world.apply(WorldEvent::Signed(true));
    crash_and_find_change(&mut world);
    assert!(matches!(world.steps[..], [(Step::CheckSigners(_), false)]), "{:?}", world.steps);
    world.settle();
    assert_eq!((order_phase(&world), runs(&world, 0)), (failed, true));
}

#[test]
fn changed_tree_waits_for_the_ordered_version_to_be_prepared() {
    let mut world = running(Run::default());
    world.apply(WorldEvent::Order { deployment: 1, run: 1, stop: false });
    world.apply(WorldEvent::RetryLater { ms: 300_000 });
    crash_and_find_change(&mut world);
    assert!(world.steps.is_empty(), "the ordered version waits: {:?}", world.steps);
    world.apply(WorldEvent::Wait { ms: 90_000 });
    assert!(world.steps.is_empty(), "it is not started in vain: {:?}", world.steps);
    world.settle();
    assert_eq!((order_phase(&world), runs(&world, 1)), ((Phase::Running, None), true));
}

#[test]
fn new_order_interrupts_the_restoring_of_the_fallback() {
    let mut world = starting_fallback();
    world.apply(WorldEvent::FindsChange);
    assert_pulls(&world, 0);
    world.apply(WorldEvent::Order { deployment: 2, run: 1, stop: true });
    let prepares = world.steps.iter().any(|(step, _)| step.lane() == Lane::Prepare);
    assert!(!prepares, "the pull is interrupted: {:?}", world.steps);
    assert_eq!((phase(&world), world.alive.len()), (Phase::Stopped, 0));
    world.apply(WorldEvent::Order { deployment: 2, run: 2, stop: false });
    world.settle();
    assert_eq!((order_phase(&world), runs(&world, 0)), ((Phase::Running, None), true));
}

#[test]
fn fallback_that_cannot_be_restored_has_failed_with_both_reasons() {
    let mut world = starting_fallback();
    world.checks_signatures = true;
    world.apply(WorldEvent::Signed(false));
    world.apply(WorldEvent::FindsChange);
    assert!(matches!(world.steps[..], [(Step::CheckSigners(_), false)]), "{:?}", world.steps);
    world.apply(WorldEvent::Effect { succeeds: true });
    world.apply(WorldEvent::Wait { ms: 90_000 });
    let (phase, failure) = world.record.as_ref().expect("a record").order_phase();
    let text = &failure.expect("why").text;
    assert_eq!((phase, world.alive.len()), (Phase::Failed, 0));
    assert!(
        text.contains("within 30 s\n1.0, which had been restored, failed: nobody has signed it"),
        "{text}"
    );
}
