//! The story of tokens and their holders, told on every database: enrollment, rotation to a new
//! token, lost answers.

use task_proto::RobotId;
use task_proto::api::CreateEnrollmentToken;
use task_proto::trust::token::{Token, TokenKind};
use taskd::domain::person::Person;
use taskd::net::tls::ClientProof;
use taskd::orders::actions::{Enrolled, OrderError, RobotError};
use taskd::orders::report_writer::ReportError;
use taskd::store::{Admitted, Store, StoreError, TokenHolder};

use crate::database::{TestDatabase, on_both_databases};
use crate::fleet::{Fleet, Robot, mac};
use crate::story::code;

on_both_databases! {
    enrollment_gives_identities_by_mac,
    tokens_identify_their_holder_until_they_end,
    first_use_of_a_new_token_ends_the_old_one,
    concurrent_first_uses_count_once,
    whole_fleet_authenticates_at_once,
    repeated_enrollment_recovers_a_lost_answer,
    revoked_robots_tokens_and_late_reports_are_refused,
}

async fn enrollment_gives_identities_by_mac(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let labels = [("site".parse().expect("key"), "lab".parse().expect("value"))].into();
    let token = fleet
        .enrollment_token(CreateEnrollmentToken { uses: Some(2), labels, ..Default::default() })
        .await;
    let one = fleet.try_enroll(&token, mac(1), Some("atlas")).await.expect("enrolls");
    let now_ms = fleet.clock.now_ms();
    let store = fleet.database.store.clone();
    assert!(
        store
            .tokens()
            .admit(&one.token, &ClientProof::NotRequested, now_ms)
            .await
            .expect("reads")
            .is_some()
    );
    assert_eq!(code(fleet.try_enroll(&token, mac(1), Some("other")).await), "mac_known");
    assert_eq!(code(fleet.try_enroll(&token, mac(2), Some("atlas")).await), "name_taken");
    let two = fleet.try_enroll(&token, mac(2), None).await.expect("enrolls");
    assert_eq!(code(fleet.try_enroll(&token, mac(3), None).await), "unauthorized");
    assert_ne!(one.robot_id, two.robot_id);
    let rows = fleet.database.store.robots().list(&Default::default()).await.expect("reads");
    assert_eq!(
        rows.iter().map(|row| row.robot.name.as_str()).collect::<Vec<_>>(),
        ["atlas", two.name.as_str()]
    );
    assert!(rows.iter().all(|row| row.robot.labels.len() == 1));
    assert_eq!(
        fleet.database.store.robots().find("atlas").await.expect("reads").map(|robot| robot.id),
        Some(one.robot_id.clone())
    );

    // With a token made for one robot, only that robot comes back as itself.
    let bound = CreateEnrollmentToken { robot: Some("atlas".to_owned()), ..Default::default() };
    let bound = fleet.enrollment_token(bound).await;
    assert_eq!(code(fleet.try_enroll(&bound, mac(9), None).await), "token_for_other_robot");
    assert_eq!(code(fleet.try_enroll(&bound, mac(2), None).await), "mac_known");
    let again = fleet.try_enroll(&bound, mac(1), Some("renamed")).await.expect("enrolls");
    assert_eq!((again.robot_id.clone(), again.name.as_str()), (one.robot_id.clone(), "atlas"));
    assert_eq!(robot_of(&store, &again.token).await, Some(one.robot_id));
}

async fn tokens_identify_their_holder_until_they_end(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let store = &fleet.database.store;
    let operator = Token::random(TokenKind::Operator);
    let now_ms = fleet.clock.now_ms();
    assert_eq!(store.tokens().holder(&operator, now_ms).await.expect("reads"), None);
    store.tokens().create_first(&operator, now_ms).await.expect("stored");
    assert_eq!(
        store.tokens().holder(&operator, now_ms).await.expect("reads"),
        Some(TokenHolder::Person(Person::first(operator.id().parse().expect("an id"))))
    );
    let enrollment = fleet
        .enrollment_token(CreateEnrollmentToken { ttl_s: Some(60), ..Default::default() })
        .await;
    assert_eq!(
        store.tokens().holder(&enrollment, now_ms).await.expect("reads"),
        Some(TokenHolder::Enrollment)
    );
    fleet.clock.advance_ms(60_000);
    let now_ms = fleet.clock.now_ms();
    assert_eq!(store.tokens().holder(&enrollment, now_ms).await.expect("reads"), None);
    assert_eq!(code(fleet.try_enroll(&enrollment, mac(1), None).await), "unauthorized");
    assert_eq!(code(fleet.try_enroll(&operator, mac(1), None).await), "unauthorized");
    let lasting = fleet.enrollment_token(CreateEnrollmentToken::default()).await;
    fleet.actions.expire().await.expect("forgets the one that has ended");
    assert_eq!(
        store.tokens().holder(&lasting, now_ms).await.expect("reads"),
        Some(TokenHolder::Enrollment)
    );
    let mut write = store.begin().await.expect("begins");
    assert_eq!(
        write.enrollments().terms(&enrollment, now_ms - 60_000).await.expect("reads"),
        None,
        "it is gone"
    );
    drop(write);
    for unusable in ["no robot\0", "rob\u{e9}"] {
        let order =
            CreateEnrollmentToken { robot: Some(unusable.to_owned()), ..Default::default() };
        assert_eq!(
            code(fleet.robots.create_enrollment_token(&fleet.operator, &order).await),
            "not_found"
        );
    }
    for ttl_s in [0, u64::MAX] {
        let order = CreateEnrollmentToken { ttl_s: Some(ttl_s), ..Default::default() };
        assert_eq!(
            code(fleet.robots.create_enrollment_token(&fleet.operator, &order).await),
            "invalid_request"
        );
    }
}

/// The robot that `token` stands for; looking changes nothing.
async fn robot_of(store: &Store, token: &Token) -> Option<RobotId> {
    match store.tokens().holder(token, 1_000_000).await.expect("reads")? {
        TokenHolder::Robot { robot, .. } => Some(robot),
        other => panic!("{other:?} is no robot"),
    }
}

async fn first_use_of_a_new_token_ends_the_old_one(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let store = fleet.database.store.clone();
    let admit = async |token: &Token| match store
        .tokens()
        .admit(token, &ClientProof::NotRequested, 1_000_000)
        .await
        .expect("reads")
    {
        Some(Admitted { holder: TokenHolder::Robot { token_number, .. }, is_first_use }) => {
            Some((token_number, is_first_use))
        }
        _ => None,
    };
    let token = fleet.enrollment_token(CreateEnrollmentToken::default()).await;
    let old = fleet.try_enroll(&token, mac(1), Some("atlas")).await.expect("enrolls");
    let (old_number, is_first_use) = admit(&old.token).await.expect("valid");
    assert!(is_first_use && old_number > 0);
    assert_eq!(admit(&old.token).await, Some((old_number, false)));
    let mut old_agent = Robot::new(old.robot_id.clone());
    old_agent.start = 57;
    fleet.writer.submit(old_agent.next_report(), old_number).await.expect("stored");

    let bound = CreateEnrollmentToken {
        robot: Some("atlas".to_owned()),
        uses: Some(1),
        ..Default::default()
    };
    let bound = fleet.enrollment_token(bound).await;
    let new = fleet.try_enroll(&bound, mac(1), None).await.expect("enrolls");
    assert_eq!(new.robot_id, old.robot_id);
    // Both are good, and the old agent's reports count, until the new one is used.
    assert_eq!(admit(&old.token).await, Some((old_number, false)));
    fleet.writer.submit(old_agent.next_report(), old_number).await.expect("stored");
    assert_eq!(code(fleet.robots.next_token(&old.robot_id, old_number).await), "enrolled_anew");
    let (new_number, is_first_use) = admit(&new.token).await.expect("valid");
    assert!(is_first_use && new_number > old_number);
    assert_eq!(admit(&old.token).await, None);
    // The old agent's pending report comes too late, and does not stand before the new agent's
    // first start.
    let late = fleet.writer.submit(old_agent.next_report(), old_number);
    let mut new_agent = Robot::new(new.robot_id.clone());
    let first = fleet.writer.submit(new_agent.next_report(), new_number);
    let (late, first) = tokio::join!(late, first);
    assert!(matches!(late, Err(ReportError::TokenEnded(_))), "{late:?}");
    first.expect("stored");
    let write = store.begin_report(&[&new.robot_id].into()).await.expect("begins");
    let stored = &write.robots()[0];
    assert_eq!((stored.last_report, stored.token_number), ((1, 1), new_number));
    drop(write);

    // The robot goes over by itself: its reports go on counting, and there are never more than two.
    let late = fleet.robots.next_token(&new.robot_id, old_number).await;
    let Err(RobotError::Order(OrderError::Store(StoreError::RightsEnded))) = late else {
        panic!("{late:?}")
    };
    let next = fleet.robots.next_token(&new.robot_id, new_number).await.expect("made");
    let later = fleet.robots.next_token(&new.robot_id, new_number).await.expect("made");
    assert_eq!(admit(&next).await, None, "the one after it took its place");
    assert_eq!(admit(&new.token).await, Some((new_number, false)));
    let (later_number, is_first_use) = admit(&later).await.expect("valid");
    assert!(is_first_use);
    assert_eq!(admit(&new.token).await, None);
    let write = store.begin_report(&[&new.robot_id].into()).await.expect("begins");
    let stored = &write.robots()[0];
    assert_eq!((stored.last_report, stored.token_number), ((1, 1), later_number));
    drop(write);
    fleet.robots.remove(&fleet.operator, &new.robot_id).await.expect("removed");
    assert_eq!(admit(&later).await, None);
}

async fn concurrent_first_uses_count_once(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let token = fleet.enrollment_token(CreateEnrollmentToken::default()).await;
    let robot = fleet.try_enroll(&token, mac(1), None).await.expect("enrolls");
    let mut uses = tokio::task::JoinSet::new();
    for _ in 0..8 {
        let (store, token) = (fleet.database.store.clone(), robot.token.clone());
        uses.spawn(async move {
            store
                .tokens()
                .admit(&token, &ClientProof::NotRequested, 1_000_000)
                .await
                .expect("reads")
                .expect("valid")
                .is_first_use
        });
    }
    let uses = uses.join_all().await;
    assert_eq!(uses.iter().filter(|is_first_use| **is_first_use).count(), 1, "{uses:?}");
}

async fn whole_fleet_authenticates_at_once(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let token = fleet.enrollment_token(CreateEnrollmentToken::default()).await;
    let mut robots = Vec::new();
    for number in 0..100 {
        robots.push(fleet.try_enroll(&token, mac(number), None).await.expect("enrolls"));
    }
    let admit = |robot: &Enrolled| {
        let (store, token) = (fleet.database.store.clone(), robot.token.clone());
        tokio::spawn(async move {
            store
                .tokens()
                .admit(&token, &ClientProof::NotRequested, 1_000_000)
                .await
                .expect("reads")
                .expect("valid")
        })
    };
    let (impatient, patient): (Vec<_>, Vec<_>) =
        robots.iter().map(|robot| (admit(robot), admit(robot))).unzip();
    // A caller that goes away, also in the middle of writing for the others, does not cancel the
    // others.
    impatient.iter().for_each(tokio::task::JoinHandle::abort);
    for (admitted, robot) in patient.into_iter().zip(&robots) {
        let TokenHolder::Robot { robot: holder, .. } = admitted.await.expect("let in").holder
        else {
            panic!("no robot's token")
        };
        assert_eq!(holder, robot.robot_id);
    }
    for robot in &robots {
        assert!(!admit(robot).await.expect("let in").is_first_use);
    }
}

async fn repeated_enrollment_recovers_a_lost_answer(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let store = fleet.database.store.clone();
    let order = || CreateEnrollmentToken { uses: Some(1), ..Default::default() };
    let (token, other) =
        (fleet.enrollment_token(order()).await, fleet.enrollment_token(order()).await);
    let lost = fleet.try_enroll(&token, mac(1), Some("atlas")).await.expect("enrolls");
    // No other robot is admitted by this: not by another token, and not under another MAC.
    assert_eq!(code(fleet.try_enroll(&other, mac(1), None).await), "mac_known");
    assert_eq!(code(fleet.try_enroll(&token, mac(2), None).await), "unauthorized");
    fleet.actions.expire().await.expect("expired tokens are deleted, this one is valid");
    let again = fleet.try_enroll(&token, mac(1), Some("atlas")).await.expect("mended");
    assert_eq!((&again.robot_id, &again.name), (&lost.robot_id, &lost.name));
    assert_eq!(robot_of(&store, &lost.token).await, None);
    store
        .tokens()
        .admit(&again.token, &ClientProof::NotRequested, 1_000_000)
        .await
        .expect("reads")
        .expect("valid");
    assert_eq!(code(fleet.try_enroll(&token, mac(1), Some("atlas")).await), "unauthorized");
    fleet.actions.expire().await.expect("forgets it now");
    assert_eq!(store.tokens().holder(&token, 0).await.expect("reads"), None);
    assert_eq!(robot_of(&store, &again.token).await, Some(lost.robot_id));

    // The same where a robot comes back as itself.
    let bound = CreateEnrollmentToken { robot: Some("atlas".to_owned()), ..order() };
    let bound = fleet.enrollment_token(bound).await;
    let lost = fleet.try_enroll(&bound, mac(1), None).await.expect("enrolls");
    let mended = fleet.try_enroll(&bound, mac(1), None).await.expect("mended");
    assert_eq!(robot_of(&store, &lost.token).await, None);
    assert_eq!(
        robot_of(&store, &again.token).await,
        Some(again.robot_id.clone()),
        "until the new one is used"
    );
    store
        .tokens()
        .admit(&mended.token, &ClientProof::NotRequested, 1_000_000)
        .await
        .expect("reads")
        .expect("valid");
    assert_eq!(robot_of(&store, &again.token).await, None);
    // A token for many is spent on a robot as soon as that one is in.
    let many = fleet.enrollment_token(CreateEnrollmentToken::default()).await;
    let first = fleet.try_enroll(&many, mac(3), None).await.expect("enrolls");
    let first = fleet.try_enroll(&many, mac(3), None).await.map(|_| first).expect("mended");
    assert_eq!(robot_of(&store, &first.token).await, None);
    assert_eq!(code(fleet.try_enroll(&many, mac(1), None).await), "mac_known");
}

async fn revoked_robots_tokens_and_late_reports_are_refused(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let store = fleet.database.store.clone();
    let order = || CreateEnrollmentToken { robot: Some("atlas".to_owned()), ..Default::default() };
    let token = fleet.enrollment_token(CreateEnrollmentToken::default()).await;
    let came = fleet.try_enroll(&token, mac(1), Some("atlas")).await.expect("enrolls");
    let admitted = store
        .tokens()
        .admit(&came.token, &ClientProof::NotRequested, 1_000_000)
        .await
        .expect("reads")
        .expect("valid");
    let TokenHolder::Robot { token_number, .. } = admitted.holder else { panic!("{admitted:?}") };
    let next = fleet.robots.next_token(&came.robot_id, token_number).await.expect("a token");
    let before = fleet.enrollment_token(order()).await;
    let mut robot = Robot::new(came.robot_id.clone());
    fleet.writer.submit(robot.next_report(), token_number).await.expect("stored");

    for _ in 0..2 {
        fleet.robots.revoke(&fleet.operator, &came.robot_id).await.expect("revoked");
    }
    let late = fleet.writer.submit(robot.next_report(), token_number).await;
    assert!(matches!(late, Err(ReportError::TokenEnded(_))), "{late:?}");
    let late = fleet.robots.next_token(&came.robot_id, token_number).await;
    let Err(RobotError::Order(OrderError::Store(StoreError::RightsEnded))) = late else {
        panic!("{late:?}")
    };
    assert!(fleet.desired(&robot).await.is_err(), "nothing is signed for it");
    fleet.actions.expire().await.expect("expired tokens are deleted, except these");
    for token in [&came.token, &next] {
        assert_eq!(
            store
                .tokens()
                .admit(token, &ClientProof::NotRequested, 1_000_000)
                .await
                .expect("reads"),
            None
        );
        assert!(store.tokens().belongs_to_revoked_robot(token).await.expect("reads"));
    }
    assert!(
        !store
            .tokens()
            .belongs_to_revoked_robot(&Token::random(TokenKind::Robot))
            .await
            .expect("reads")
    );
    assert!(!store.tokens().belongs_to_revoked_robot(&token).await.expect("reads"));
    assert_eq!(code(fleet.try_enroll(&token, mac(1), None).await), "mac_known");
    assert_eq!(code(fleet.try_enroll(&before, mac(1), None).await), "unauthorized");
    assert_eq!(store.robots().broker_credentials().await.expect("reads"), []);

    let after = fleet.enrollment_token(order()).await;
    let back = fleet.try_enroll(&after, mac(1), None).await.expect("enrolls");
    assert_eq!(back.robot_id, came.robot_id);
    for token in [&came.token, &next] {
        assert_eq!(
            store
                .tokens()
                .admit(token, &ClientProof::NotRequested, 1_000_000)
                .await
                .expect("reads"),
            None
        );
        assert!(!store.tokens().belongs_to_revoked_robot(token).await.expect("reads"));
    }
    assert_eq!(robot_of(&store, &back.token).await, Some(came.robot_id));
    assert_eq!(store.robots().broker_credentials().await.expect("reads").len(), 1);
}
