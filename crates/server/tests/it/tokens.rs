//! The story of tokens and their holders, told on every database: enrollment, rotation to a new
//! token, lost answers.

use task_proto::RobotId;
use task_proto::api::CreateEnrollmentToken;
use task_proto::token::{Token, TokenKind};
use taskd::domain::person::Person;
use taskd::net::tls::ClientProof;
use taskd::orders::actions::{ActionError, Enrolled};
use taskd::orders::report_writer::ReportError;
use taskd::store::{Admitted, Store, StoreError, TokenHolder};

use crate::database::{TestDatabase, on_both_databases};
use crate::fleet::{Fleet, Robot, mac};
use crate::story::code;

on_both_databases! {
    enrolment_gives_identities_by_mac,
    tokens_stand_for_their_holder_until_they_end,
    a_new_token_ends_the_old_one_when_it_is_first_used,
    a_first_use_by_two_at_once_is_one,
    a_fleet_that_comes_at_once_is_let_in_whole,
    a_lost_answer_to_an_enrolment_is_mended_by_asking_again,
    a_revoked_robots_tokens_end_and_its_late_reports_come_too_late,
}

async fn enrolment_gives_identities_by_mac(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let labels = [("site".parse().expect("key"), "lab".parse().expect("value"))].into();
    let token = fleet
        .enrolment_token(CreateEnrollmentToken { uses: Some(2), labels, ..Default::default() })
        .await;
    let one = fleet.try_enroll(&token, mac(1), Some("atlas")).await.expect("enrols");
    let now_ms = fleet.clock.now_ms();
    let store = fleet.database.store.clone();
    assert!(
        store.admit(&one.token, &ClientProof::NotAsked, now_ms).await.expect("reads").is_some()
    );
    assert_eq!(code(fleet.try_enroll(&token, mac(1), Some("other")).await), "mac_known");
    assert_eq!(code(fleet.try_enroll(&token, mac(2), Some("atlas")).await), "name_taken");
    let two = fleet.try_enroll(&token, mac(2), None).await.expect("enrols");
    assert_eq!(code(fleet.try_enroll(&token, mac(3), None).await), "unauthorized");
    assert_ne!(one.robot_id, two.robot_id);
    let views = fleet.database.store.robots().await.expect("reads");
    assert_eq!(
        views.iter().map(|view| view.name.as_str()).collect::<Vec<_>>(),
        ["atlas", two.name.as_str()]
    );
    assert!(views.iter().all(|view| view.labels.len() == 1));
    assert_eq!(
        fleet.database.store.find_robot("atlas").await.expect("reads").map(|robot| robot.id),
        Some(one.robot_id.clone())
    );

    // With a token made for one robot, only that robot comes back as itself.
    let bound = CreateEnrollmentToken { robot: Some("atlas".to_owned()), ..Default::default() };
    let bound = fleet.enrolment_token(bound).await;
    assert_eq!(code(fleet.try_enroll(&bound, mac(9), None).await), "token_for_other_robot");
    assert_eq!(code(fleet.try_enroll(&bound, mac(2), None).await), "mac_known");
    let again = fleet.try_enroll(&bound, mac(1), Some("renamed")).await.expect("enrols");
    assert_eq!((again.robot_id.clone(), again.name.as_str()), (one.robot_id.clone(), "atlas"));
    assert_eq!(robot_of(&store, &again.token).await, Some(one.robot_id));
}

async fn tokens_stand_for_their_holder_until_they_end(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let store = &fleet.database.store;
    let operator = Token::random(TokenKind::Operator);
    let now_ms = fleet.clock.now_ms();
    assert_eq!(store.token_holder(&operator, now_ms).await.expect("reads"), None);
    store.create_operator_token(&operator, now_ms).await.expect("stored");
    assert_eq!(
        store.token_holder(&operator, now_ms).await.expect("reads"),
        Some(TokenHolder::Person(Person::first(operator.id().parse().expect("an id"))))
    );
    let enrolment = fleet
        .enrolment_token(CreateEnrollmentToken { ttl_s: Some(60), ..Default::default() })
        .await;
    assert_eq!(
        store.token_holder(&enrolment, now_ms).await.expect("reads"),
        Some(TokenHolder::Enrolment)
    );
    fleet.clock.advance_ms(60_000);
    let now_ms = fleet.clock.now_ms();
    assert_eq!(store.token_holder(&enrolment, now_ms).await.expect("reads"), None);
    assert_eq!(code(fleet.try_enroll(&enrolment, mac(1), None).await), "unauthorized");
    assert_eq!(code(fleet.try_enroll(&operator, mac(1), None).await), "unauthorized");
    let lasting = fleet.enrolment_token(CreateEnrollmentToken::default()).await;
    fleet.actions.expire().await.expect("forgets the one that has ended");
    assert_eq!(
        store.token_holder(&lasting, now_ms).await.expect("reads"),
        Some(TokenHolder::Enrolment)
    );
    let mut write = store.begin().await.expect("begins");
    assert_eq!(
        write.enrolment_terms(&enrolment, now_ms - 60_000).await.expect("reads"),
        None,
        "it is gone"
    );
    drop(write);
    for unusable in ["no robot\0", "rob\u{e9}"] {
        let order =
            CreateEnrollmentToken { robot: Some(unusable.to_owned()), ..Default::default() };
        assert_eq!(
            code(fleet.actions.create_enrollment_token(&fleet.operator, &order).await),
            "not_found"
        );
    }
    for ttl_s in [0, u64::MAX] {
        let order = CreateEnrollmentToken { ttl_s: Some(ttl_s), ..Default::default() };
        assert_eq!(
            code(fleet.actions.create_enrollment_token(&fleet.operator, &order).await),
            "invalid_request"
        );
    }
}

/// The robot that `token` stands for; looking changes nothing.
async fn robot_of(store: &Store, token: &Token) -> Option<RobotId> {
    match store.token_holder(token, 1_000_000).await.expect("reads")? {
        TokenHolder::Robot { robot, .. } => Some(robot),
        other => panic!("{other:?} is no robot"),
    }
}

async fn a_new_token_ends_the_old_one_when_it_is_first_used(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let store = fleet.database.store.clone();
    let admit = async |token: &Token| match store
        .admit(token, &ClientProof::NotAsked, 1_000_000)
        .await
        .expect("reads")
    {
        Some(Admitted { holder: TokenHolder::Robot { token_number, .. }, is_first_use }) => {
            Some((token_number, is_first_use))
        }
        _ => None,
    };
    let token = fleet.enrolment_token(CreateEnrollmentToken::default()).await;
    let old = fleet.try_enroll(&token, mac(1), Some("atlas")).await.expect("enrols");
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
    let bound = fleet.enrolment_token(bound).await;
    let new = fleet.try_enroll(&bound, mac(1), None).await.expect("enrols");
    assert_eq!(new.robot_id, old.robot_id);
    // Both are good, and the old agent's reports count, until the new one is used.
    assert_eq!(admit(&old.token).await, Some((old_number, false)));
    fleet.writer.submit(old_agent.next_report(), old_number).await.expect("stored");
    assert_eq!(
        code(fleet.actions.next_robot_token(&old.robot_id, old_number).await),
        "enrolled_anew"
    );
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
    let mut write = store.begin().await.expect("begins");
    let stored = write.reported_robots(std::slice::from_ref(&new.robot_id)).await.expect("reads");
    assert_eq!((stored[0].last_report, stored[0].token_number), ((1, 1), new_number));
    drop(write);

    // The robot goes over by itself: its reports go on counting, and there are never more than two.
    let late = fleet.actions.next_robot_token(&new.robot_id, old_number).await;
    assert!(matches!(late, Err(ActionError::Store(StoreError::RightsEnded))), "{late:?}");
    let next = fleet.actions.next_robot_token(&new.robot_id, new_number).await.expect("made");
    let later = fleet.actions.next_robot_token(&new.robot_id, new_number).await.expect("made");
    assert_eq!(admit(&next).await, None, "the one after it took its place");
    assert_eq!(admit(&new.token).await, Some((new_number, false)));
    let (later_number, is_first_use) = admit(&later).await.expect("valid");
    assert!(is_first_use);
    assert_eq!(admit(&new.token).await, None);
    let mut write = store.begin().await.expect("begins");
    let stored = write.reported_robots(std::slice::from_ref(&new.robot_id)).await.expect("reads");
    assert_eq!((stored[0].last_report, stored[0].token_number), ((1, 1), later_number));
    drop(write);
    fleet.actions.remove_robot(&fleet.operator, &new.robot_id).await.expect("removed");
    assert_eq!(admit(&later).await, None);
}

async fn a_first_use_by_two_at_once_is_one(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let token = fleet.enrolment_token(CreateEnrollmentToken::default()).await;
    let robot = fleet.try_enroll(&token, mac(1), None).await.expect("enrols");
    let mut uses = tokio::task::JoinSet::new();
    for _ in 0..8 {
        let (store, token) = (fleet.database.store.clone(), robot.token.clone());
        uses.spawn(async move {
            store
                .admit(&token, &ClientProof::NotAsked, 1_000_000)
                .await
                .expect("reads")
                .expect("valid")
                .is_first_use
        });
    }
    let uses = uses.join_all().await;
    assert_eq!(uses.iter().filter(|is_first_use| **is_first_use).count(), 1, "{uses:?}");
}

async fn a_fleet_that_comes_at_once_is_let_in_whole(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let token = fleet.enrolment_token(CreateEnrollmentToken::default()).await;
    let mut robots = Vec::new();
    for number in 0..100 {
        robots.push(fleet.try_enroll(&token, mac(number), None).await.expect("enrols"));
    }
    let admit = |robot: &Enrolled| {
        let (store, token) = (fleet.database.store.clone(), robot.token.clone());
        tokio::spawn(async move {
            store
                .admit(&token, &ClientProof::NotAsked, 1_000_000)
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

async fn a_lost_answer_to_an_enrolment_is_mended_by_asking_again(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let store = fleet.database.store.clone();
    let order = || CreateEnrollmentToken { uses: Some(1), ..Default::default() };
    let (token, other) =
        (fleet.enrolment_token(order()).await, fleet.enrolment_token(order()).await);
    let lost = fleet.try_enroll(&token, mac(1), Some("atlas")).await.expect("enrols");
    // No other robot is admitted by this: not by another token, and not under another MAC.
    assert_eq!(code(fleet.try_enroll(&other, mac(1), None).await), "mac_known");
    assert_eq!(code(fleet.try_enroll(&token, mac(2), None).await), "unauthorized");
    fleet.actions.expire().await.expect("forgets what has ended, which this token has not");
    let again = fleet.try_enroll(&token, mac(1), Some("atlas")).await.expect("mended");
    assert_eq!((&again.robot_id, &again.name), (&lost.robot_id, &lost.name));
    assert_eq!(robot_of(&store, &lost.token).await, None);
    store
        .admit(&again.token, &ClientProof::NotAsked, 1_000_000)
        .await
        .expect("reads")
        .expect("valid");
    assert_eq!(code(fleet.try_enroll(&token, mac(1), Some("atlas")).await), "unauthorized");
    fleet.actions.expire().await.expect("forgets it now");
    assert_eq!(store.token_holder(&token, 0).await.expect("reads"), None);
    assert_eq!(robot_of(&store, &again.token).await, Some(lost.robot_id));

    // The same where a robot comes back as itself.
    let bound = CreateEnrollmentToken { robot: Some("atlas".to_owned()), ..order() };
    let bound = fleet.enrolment_token(bound).await;
    let lost = fleet.try_enroll(&bound, mac(1), None).await.expect("enrols");
    let mended = fleet.try_enroll(&bound, mac(1), None).await.expect("mended");
    assert_eq!(robot_of(&store, &lost.token).await, None);
    assert_eq!(
        robot_of(&store, &again.token).await,
        Some(again.robot_id.clone()),
        "until the new one is used"
    );
    store
        .admit(&mended.token, &ClientProof::NotAsked, 1_000_000)
        .await
        .expect("reads")
        .expect("valid");
    assert_eq!(robot_of(&store, &again.token).await, None);
    // A token for many is spent on a robot as soon as that one is in.
    let many = fleet.enrolment_token(CreateEnrollmentToken::default()).await;
    let first = fleet.try_enroll(&many, mac(3), None).await.expect("enrols");
    let first = fleet.try_enroll(&many, mac(3), None).await.map(|_| first).expect("mended");
    assert_eq!(robot_of(&store, &first.token).await, None);
    assert_eq!(code(fleet.try_enroll(&many, mac(1), None).await), "mac_known");
}

async fn a_revoked_robots_tokens_end_and_its_late_reports_come_too_late(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let store = fleet.database.store.clone();
    let order = || CreateEnrollmentToken { robot: Some("atlas".to_owned()), ..Default::default() };
    let token = fleet.enrolment_token(CreateEnrollmentToken::default()).await;
    let came = fleet.try_enroll(&token, mac(1), Some("atlas")).await.expect("enrols");
    let admitted = store
        .admit(&came.token, &ClientProof::NotAsked, 1_000_000)
        .await
        .expect("reads")
        .expect("valid");
    let TokenHolder::Robot { token_number, .. } = admitted.holder else { panic!("{admitted:?}") };
    let next = fleet.actions.next_robot_token(&came.robot_id, token_number).await.expect("a token");
    let before = fleet.enrolment_token(order()).await;
    let mut robot = Robot::new(came.robot_id.clone());
    fleet.writer.submit(robot.next_report(), token_number).await.expect("stored");

    for _ in 0..2 {
        fleet.actions.revoke_robot(&fleet.operator, &came.robot_id).await.expect("revoked");
    }
    let late = fleet.writer.submit(robot.next_report(), token_number).await;
    assert!(matches!(late, Err(ReportError::TokenEnded(_))), "{late:?}");
    let late = fleet.actions.next_robot_token(&came.robot_id, token_number).await;
    assert!(matches!(late, Err(ActionError::Store(StoreError::RightsEnded))), "{late:?}");
    assert!(fleet.desired(&robot).await.is_err(), "nothing is signed for it");
    fleet.actions.expire().await.expect("forgets what has ended, but for these");
    for token in [&came.token, &next] {
        assert_eq!(
            store.admit(token, &ClientProof::NotAsked, 1_000_000).await.expect("reads"),
            None
        );
        assert!(store.is_of_revoked_robot(token).await.expect("reads"));
    }
    assert!(!store.is_of_revoked_robot(&Token::random(TokenKind::Robot)).await.expect("reads"));
    assert!(!store.is_of_revoked_robot(&token).await.expect("reads"));
    assert_eq!(code(fleet.try_enroll(&token, mac(1), None).await), "mac_known");
    assert_eq!(code(fleet.try_enroll(&before, mac(1), None).await), "unauthorized");
    assert_eq!(store.broker_credentials().await.expect("reads"), []);

    let after = fleet.enrolment_token(order()).await;
    let back = fleet.try_enroll(&after, mac(1), None).await.expect("enrols");
    assert_eq!(back.robot_id, came.robot_id);
    for token in [&came.token, &next] {
        assert_eq!(
            store.admit(token, &ClientProof::NotAsked, 1_000_000).await.expect("reads"),
            None
        );
        assert!(!store.is_of_revoked_robot(token).await.expect("reads"));
    }
    assert_eq!(robot_of(&store, &back.token).await, Some(came.robot_id));
    assert_eq!(store.broker_credentials().await.expect("reads").len(), 1);
}
