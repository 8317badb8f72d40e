//! What people may add to the database: rows with a bound for each person.

use std::net::IpAddr;

use task_proto::UserName;
use task_proto::packages::manifest::TaskKind;
use taskd::auth::sign_ins::{MAX_FAMILIAR, NetworkDigest};
use taskd::domain::person::Person;
use taskd::orders::actions::{IdempotencyKey, MAX_BYTES_OF_PERSON};
use taskd::store::{AuditAction, AuditEvent, IdempotencyRecord, StoreError};

use crate::database::{TestDatabase, on_both_databases, rows};
use crate::fleet::{Fleet, key, order_of, package, random_key};
use crate::people::{PASSWORD, name};
use crate::story::{code, refusal};

on_both_databases! {
    orders_of_one_person_are_remembered_up_to_a_size,
    familiar_networks_are_bounded_by_person_and_forgotten,
    blocks_of_sign_ins_are_recorded_up_to_a_rate,
}

async fn orders_of_one_person_are_remembered_up_to_a_size(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    fleet.enroll(1).await;
    fleet.add("alice", "operator", None).await;
    fleet.add("bob", "operator", None).await;
    let (alice, bob) = (fleet.signed_in("alice").await, fleet.signed_in("bob").await);
    let bundle = package("1", TaskKind::Service);
    let order = async |by: &Person| {
        let key = random_key();
        let id = fleet.deployments.create(by, &key, &order_of(&bundle), &bundle).await;
        (key, id.expect("ordered"))
    };
    let repeated = async |by: &Person, key: &IdempotencyKey| {
        fleet.deployments.repeated(by, key, &order_of(&bundle)).await.expect("reads")
    };
    let (first, bobs) = (order(&alice).await, order(&bob).await);
    // An answer with many robots leaves room for about one more order.
    let answer = "x".repeat(MAX_BYTES_OF_PERSON as usize - 600);
    let large = IdempotencyRecord { request: String::new(), answer };
    let mut write = fleet.database.store.begin().await.expect("begins");
    let mut orders = write.idempotency();
    orders.insert("large", &large, &alice.name, u64::MAX, 1_000_000).await.expect("stored");
    write.commit().await.expect("stored");
    assert_eq!(repeated(&alice, &first.0).await, Some(first.1));
    let second = order(&alice).await;
    assert_eq!(repeated(&alice, &first.0).await, None, "the oldest made room");
    assert_eq!(repeated(&alice, &second.0).await, Some(second.1));
    assert_eq!(repeated(&bob, &bobs.0).await, Some(bobs.1), "another person's orders stay");
    let stored = rows(&fleet.database.url, "orders").await;
    assert_eq!(stored.iter().filter(|row| row.contains("alice")).count(), 2);
}

async fn familiar_networks_are_bounded_by_person_and_forgotten(database: TestDatabase) {
    const DAY_MS: u64 = 24 * 60 * 60 * 1000;
    let fleet = Fleet::new(database).await;
    let (alice, bob, carol) = (name("alice"), name("bob"), name("carol"));
    let network = |user: &UserName, n: u32| {
        let address = IpAddr::from((0x0a00_0000 + n).to_be_bytes());
        NetworkDigest::of(user, address.into(), &key())
    };
    let sign_in = async |user: &UserName, n: u32, at_ms: u64| {
        let mut write = fleet.database.store.begin().await.expect("begins");
        write
            .familiar_networks()
            .put(user, &network(user, n), MAX_FAMILIAR, at_ms)
            .await
            .expect("stored");
        write.commit().await.expect("stored");
    };
    let known = async |user: &UserName, n: u32| {
        fleet
            .database
            .store
            .familiar_networks()
            .contains(user, &network(user, n))
            .await
            .expect("reads")
    };
    let now_ms = fleet.clock.now_ms();
    sign_in(&bob, 0, now_ms).await;
    for n in 0..MAX_FAMILIAR {
        sign_in(&alice, n, now_ms + u64::from(n)).await;
    }
    // She comes from the first one again, so the second one is the oldest.
    sign_in(&alice, 0, now_ms + 1_000).await;
    sign_in(&alice, MAX_FAMILIAR, now_ms + 1_001).await;
    assert!(known(&alice, 0).await && !known(&alice, 1).await && known(&alice, 2).await);
    assert!(known(&alice, MAX_FAMILIAR).await);
    assert!(known(&bob, 0).await, "others keep theirs");
    assert!(!known(&carol, 0).await);

    fleet.clock.advance_ms(90 * DAY_MS + 1);
    sign_in(&bob, 1, fleet.clock.now_ms()).await;
    fleet.actions.expire().await.expect("done");
    assert!(!known(&bob, 0).await && known(&bob, 1).await);
    fleet.add("bob", "viewer", None).await;
    fleet.people.remove_user(&fleet.operator, &bob).await.expect("removed");
    assert!(!known(&bob, 1).await, "the next user with this name inherits nothing");
}

async fn blocks_of_sign_ins_are_recorded_up_to_a_rate(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    fleet.add("alice", "viewer", None).await;
    let record = async || {
        let mut write = fleet.database.store.begin().await?;
        let server = "server".to_owned();
        let event = AuditEvent::new(server, None, None, AuditAction::SignInBlocked, "nobody");
        write.audit().record(&event, 1_000_000).await?;
        write.commit().await
    };
    let mut recorded = 0;
    let refused = loop {
        match record().await {
            Ok(()) => recorded += 1,
            Err(refused) => break refused,
        }
        assert!(recorded < 1_000, "it goes on without end");
    };
    assert!(matches!(refused, StoreError::TooManyActs { .. }), "{refused}");
    assert!(recorded < 210, "{recorded}");
    let before = fleet.audit().await.len();
    let stranger = IpAddr::from([203, 0, 113, 1]);
    for _ in 0..10 {
        assert_eq!(code(fleet.sign_in("alice", "wrong", stranger).await), "unauthorized");
    }
    let blocked = refusal(fleet.sign_in("alice", PASSWORD, stranger).await);
    assert_eq!(blocked.message, "too many wrong passwords; try again in 900 s");
    assert_eq!(fleet.audit().await.len(), before, "the block holds without an entry");
    // The acts of people are counted apart.
    let elsewhere = IpAddr::from([203, 0, 113, 2]);
    fleet.add("bob", "viewer", None).await;
    fleet.sign_in("bob", PASSWORD, elsewhere).await.expect("signed in");
}
