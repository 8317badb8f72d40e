//! The story of users, told on every database: permissions, tokens, passwords, and the audit log of
//! all three.

use std::net::IpAddr;

use task_proto::api::{
    AddUser, AuditPage, AuditQuery, ChangePassword, CreateToken, EditRobot, EditUser, LogIn,
    TokenOrigin,
};
use task_proto::ids::selector::Selector;
use task_proto::messages::report::Phase;
use task_proto::packages::manifest::TaskKind;
use task_proto::people::audit::{AuditEntry, ChainLink};
use task_proto::people::roles::{Permission, Roles};
use task_proto::trust::token::{Token, TokenKind};
use task_proto::{Digest, RobotId, TokenId, UserName};
use taskd::domain::person::Person;
use taskd::http::error::ApiError;
use taskd::net::tls::ClientProof;
use taskd::orders::actions::{PersonError, TaskOrder};
use taskd::store::{Deletion, Store, StoreError, TokenHolder};

use crate::database::{TestDatabase, on_both_databases};
use crate::fleet::{Fleet, order_of, package, random_key};
use crate::story::{code, refusal};

on_both_databases! {
    rights_are_those_allowed_by_role_and_token,
    order_beyond_the_scope_is_refused_as_a_whole,
    edited_robot_stays_in_the_editors_scope,
    password_change_ends_the_old_password_and_its_sign_ins,
    wrong_passwords_are_limited_by_account_and_address,
    last_administrator_is_not_removed,
    token_ends_with_its_parent,
    audit_has_every_change_and_no_read,
    failed_act_leaves_no_audit_entry,
    self_service_acts_are_rate_limited_and_orders_are_not,
    changed_audit_entry_breaks_the_chain,
    idempotency_key_of_another_person_is_refused,
}

pub const PASSWORD: &str = "correct horse battery";
const HERE: IpAddr = IpAddr::V4(std::net::Ipv4Addr::new(192, 0, 2, 1));

pub fn name(text: &str) -> UserName {
    text.parse().expect("a name")
}

pub fn roles(text: &str) -> Roles {
    text.parse().expect("roles")
}

pub fn selector(text: &str) -> Selector {
    text.parse().expect("a selector")
}

impl Fleet {
    pub async fn add(&self, who: &str, may: &str, scope: Option<&str>) {
        let (password, scope) = (Some(PASSWORD.to_owned()), scope.map(selector));
        let order = AddUser { name: name(who), roles: roles(may), scope, password };
        self.people.add_user(&self.operator, &order).await.expect("added");
    }

    pub async fn sign_in(
        &self,
        who: &str,
        password: &str,
        from: IpAddr,
    ) -> Result<Token, PersonError> {
        let order = LogIn { user: name(who), password: password.to_owned(), ttl_s: None };
        Ok(self.people.sign_in(&order, TokenOrigin::Login, from).await?.token)
    }

    /// The person that the token stands for now.
    async fn person(&self, token: &Token) -> Option<Person> {
        match self
            .database
            .store
            .tokens()
            .admit(token, &ClientProof::NotRequested, self.clock.now_ms())
            .await
            .expect("reads")?
            .holder
        {
            TokenHolder::Person(person) => Some(Person { address: Some(HERE), ..person }),
            other => panic!("{other:?} is no person"),
        }
    }

    pub async fn signed_in(&self, who: &str) -> Person {
        let token = self.sign_in(who, PASSWORD, HERE).await.expect("signed in");
        self.person(&token).await.expect("good")
    }

    async fn label(&self, robot: &crate::fleet::Robot, labels: &str) {
        let labels = labels.split_once('=').expect("a label");
        let labels =
            [(labels.0.parse().expect("a key"), labels.1.parse().expect("a value"))].into();
        let edit = EditRobot { labels: Some(labels), ..EditRobot::default() };
        self.robots.edit(&self.operator, &robot.id, &edit).await.expect("edited");
    }

    pub async fn audit(&self) -> Vec<AuditEntry> {
        let query = AuditQuery { after: Some(0), ..AuditQuery::default() };
        let page = self.database.store.audit().page(&query).await.expect("reads");
        verified(&page).expect("holds");
        page.records.iter().map(|record| record.read().expect("an entry")).collect()
    }

    /// Audit entries since there were `before` entries: user, action, target.
    async fn acts_since(&self, before: usize) -> Vec<(String, String, String)> {
        let entries = self.audit().await.split_off(before);
        entries.into_iter().map(|entry| (entry.who, entry.act, entry.target)).collect()
    }
}

fn verified(page: &AuditPage) -> Result<ChainLink, task_proto::people::audit::BrokenChain> {
    page.records.iter().try_fold(ChainLink::START, ChainLink::append)
}

fn act(who: &str, act: &str, target: impl ToString) -> (String, String, String) {
    (who.to_owned(), act.to_owned(), target.to_string())
}

async fn rights_are_those_allowed_by_role_and_token(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    fleet.add("alice", "operator,publisher", Some("site=lab")).await;
    let alice = fleet.signed_in("alice").await;
    let allowed = |person: &Person| {
        Permission::ALL.into_iter().filter(|&p| person.may(p)).collect::<Vec<_>>()
    };
    assert_eq!(allowed(&alice), [Permission::Read, Permission::Operate, Permission::Publish]);
    assert_eq!((alice.name.as_str(), alice.scope.to_string()), ("alice", "site=lab".to_owned()));

    let narrow = CreateToken {
        title: "a dashboard".to_owned(),
        roles: Some(roles("publisher")),
        scope: Some(selector("r1,r2")),
        ttl_s: Some(3600),
        ..CreateToken::default()
    };
    let made = fleet.people.create_token(&alice, &narrow).await.expect("made");
    let token: Token = made.token.parse().expect("a token");
    let dashboard = fleet.person(&token).await.expect("good");
    assert_eq!(allowed(&dashboard), [Permission::Read, Permission::Publish]);
    assert_eq!(dashboard.scope.to_string(), "site=lab and r1,r2");
    assert_eq!(made.expires_at_ms, fleet.clock.now_ms() + 3_600_000);
    // A token creates no other tokens, because the chain would never end; and no user creates a
    // token with more permissions than their own.
    assert_eq!(
        code(fleet.people.create_token(&dashboard, &CreateToken::default()).await),
        "forbidden"
    );
    let wide = CreateToken { roles: Some(roles("admin")), ..CreateToken::default() };
    assert_eq!(code(fleet.people.create_token(&alice, &wide).await), "invalid_request");
    let for_bob = CreateToken { user: Some(name("bob")), ..CreateToken::default() };
    assert_eq!(code(fleet.people.create_token(&alice, &for_bob).await), "forbidden");
    assert_eq!(code(fleet.people.create_token(&fleet.operator, &for_bob).await), "not_found");
    assert_eq!(
        code(fleet.people.create_token(&fleet.operator, &CreateToken::default()).await),
        "invalid_request"
    );

    // The token loses every permission that the user loses; without any permission left, the token
    // is gone.
    let edit = |may: &str| EditUser { roles: Some(roles(may)), scope: Some(selector("*")) };
    fleet
        .people
        .edit_user(&fleet.operator, &name("alice"), &edit("publisher"))
        .await
        .expect("edited");
    assert_eq!(fleet.person(&token).await.expect("good").scope.to_string(), "r1,r2");
    fleet.people.edit_user(&fleet.operator, &name("alice"), &edit("viewer")).await.expect("edited");
    assert_eq!(fleet.person(&token).await, None);
    // An administrator with a scope does not administer settings that concern all users.
    fleet.add("boss", "admin", Some("site=lab")).await;
    let boss = fleet.signed_in("boss").await;
    assert!(boss.may(Permission::Maintain) && !boss.may(Permission::Administer));
}

async fn order_beyond_the_scope_is_refused_as_a_whole(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let mut robots = fleet.enroll(3).await;
    fleet.label(&robots[0], "site=lab").await;
    fleet.label(&robots[1], "site=lab").await;
    fleet.add("alice", "operator", Some("site=lab")).await;
    let alice = fleet.signed_in("alice").await;
    let (bundle, before) = (package("1", TaskKind::Service), fleet.audit().await.len());
    let order = |to: &str| task_proto::api::CreateDeployment {
        selector: selector(to),
        ..order_of(&bundle)
    };
    let ordered = |to: &'static str| {
        let (fleet, alice, order, bundle) = (&fleet, &alice, order(to), &bundle);
        async move { fleet.deployments.create(alice, &random_key(), &order, bundle).await }
    };
    let refused = refusal(ordered("*").await);
    let expected =
        "1 of the 3 robots of \"*\" are outside of alice's scope \"site=lab\"; nothing was done";
    assert_eq!((refused.code, refused.message.as_str()), ("out_of_scope", expected));
    assert_eq!(code(ordered("r2").await), "unknown_robots");
    assert_eq!(code(ordered("r0,r2").await), "unknown_robots");
    assert_eq!(code(fleet.deployments.preview(&alice, &selector("*")).await), "out_of_scope");
    assert_eq!(code(ordered("site=mars").await), "no_robots_match");
    assert_eq!(fleet.acts_since(before).await, []);
    assert!(
        fleet.desired(&robots[0]).await.expect("state").tasks.is_empty(),
        "not even those that are hers"
    );
    let own = ordered("site=lab").await.expect("ordered");

    // Existing assignments count like new ones.
    let everywhere = fleet.deploy("2", |_| ()).await;
    for robot in &mut robots {
        fleet.follow(robot, Phase::Running).await;
    }
    let (task, key) = ("talker".parse().expect("a name"), random_key());
    let stop =
        fleet.deployments.order_task(&alice, &key, TaskOrder::Stop, &task, &selector("*")).await;
    assert_eq!(code(stop), "out_of_scope");
    assert_eq!(
        code(fleet.deployments.preview_task_order(&alice, &task, &selector("*")).await),
        "out_of_scope"
    );
    assert_eq!(code(fleet.deployments.cancel(&alice, &everywhere).await), "out_of_scope");
    assert_eq!(code(fleet.deployments.resume(&alice, &everywhere).await), "out_of_scope");
    let over = fleet.deployments.cancel(&alice, &own).await;
    assert_eq!(code(over), "nothing_to_cancel", "all of it is hers, and over");
    let lab = selector("site=lab");
    let stopped = fleet
        .deployments
        .order_task(&alice, &key, TaskOrder::Stop, &task, &lab)
        .await
        .expect("ordered");
    assert_eq!(stopped.len(), 2);
    assert_eq!(fleet.phases(&everywhere).await[2], Phase::Running);

    // And of lists she sees her part.
    let mine = fleet.database.store.robots().ids_in(&alice.scope).await.expect("reads");
    assert_eq!(mine.len(), 2);
    let parts = async |robots: &[RobotId]| {
        let page =
            fleet.database.store.deployments().page(Some(robots), None, 10).await.expect("reads");
        page.expect("no other was named").deployments
    };
    let (none, parts) = (parts(&[]).await, parts(&mine).await);
    let counted = parts
        .iter()
        .map(|part| (part.id.clone(), part.counts.iter().map(|count| count.count).sum::<u64>()));
    assert_eq!(counted.collect::<Vec<_>>(), [(everywhere, 2), (own, 2)]);
    assert_eq!(none, []);
}

async fn edited_robot_stays_in_the_editors_scope(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let robots = fleet.enroll(2).await;
    fleet.label(&robots[0], "site=lab").await;
    fleet.add("boss", "admin", Some("site=lab")).await;
    let boss = fleet.signed_in("boss").await;
    let field = [("site".parse().expect("a key"), "field".parse().expect("a value"))].into();
    let out = EditRobot { labels: Some(field), ..EditRobot::default() };
    assert_eq!(code(fleet.robots.edit(&boss, &robots[0].id, &out).await), "out_of_scope");
    let lab = [("site".parse().expect("a key"), "lab".parse().expect("a value"))].into();
    let pulled_in = EditRobot { labels: Some(lab), ..EditRobot::default() };
    assert_eq!(code(fleet.robots.edit(&boss, &robots[1].id, &pulled_in).await), "out_of_scope");
    assert_eq!(code(fleet.robots.remove(&boss, &robots[1].id).await), "out_of_scope");
    let renamed =
        EditRobot { name: Some("atlas".parse().expect("a name")), ..EditRobot::default() };
    fleet.robots.edit(&boss, &robots[0].id, &renamed).await.expect("it is his");
    fleet.robots.remove(&boss, &robots[0].id).await.expect("it is his");
}

async fn password_change_ends_the_old_password_and_its_sign_ins(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    fleet.add("alice", "operator", None).await;
    for (who, password) in [("alice", "wrong"), ("bob", PASSWORD), ("operator.token", PASSWORD)] {
        assert_eq!(code(fleet.sign_in(who, password, HERE).await), "unauthorized", "{who}");
    }
    let (token, other) = (
        fleet.sign_in("alice", PASSWORD, HERE).await,
        fleet.sign_in("alice", PASSWORD, HERE).await,
    );
    let (token, other) = (token.expect("signed in"), other.expect("signed in"));
    let alice = fleet.person(&token).await.expect("good");
    let made = fleet.people.create_token(&alice, &CreateToken::default()).await.expect("made");
    let change = |old: &str, new: &str| ChangePassword { old: old.to_owned(), new: new.to_owned() };
    let changed = fleet.people.change_password(&alice, &change("wrong", "another long one")).await;
    assert_eq!(changed.expect_err("refused").to_string(), "old: the old password is wrong");
    assert_eq!(
        code(fleet.people.change_password(&alice, &change(PASSWORD, "short")).await),
        "invalid_request"
    );
    fleet
        .people
        .change_password(&alice, &change(PASSWORD, "another long one"))
        .await
        .expect("changed");
    assert_eq!(code(fleet.sign_in("alice", PASSWORD, HERE).await), "unauthorized");
    fleet.sign_in("alice", "another long one", HERE).await.expect("signed in");
    assert!(fleet.person(&token).await.is_some(), "the session that changed it");
    assert_eq!(fleet.person(&other).await, None);
    assert!(
        fleet.person(&made.token.parse().expect("a token")).await.is_some(),
        "tokens made on purpose"
    );
    // An administrator who sets the password signs out all of the user's sessions.
    fleet.people.set_password(&fleet.operator, &name("alice"), PASSWORD).await.expect("set");
    assert_eq!(fleet.person(&token).await, None);
    assert_eq!(
        code(fleet.people.set_password(&fleet.operator, &name("bob"), PASSWORD).await),
        "not_found"
    );
    let first = fleet.people.change_password(&fleet.operator, &change(PASSWORD, PASSWORD)).await;
    assert_eq!(code(first), "forbidden");
    // Without a password, no sign-in by password succeeds.
    let order =
        AddUser { name: name("ci"), roles: roles("publisher"), scope: None, password: None };
    assert!(!fleet.people.add_user(&fleet.operator, &order).await.expect("added").has_password);
    assert_eq!(code(fleet.sign_in("ci", "", HERE).await), "unauthorized");
    assert_eq!(code(fleet.people.add_user(&fleet.operator, &order).await), "user_exists");
    let reserved = AddUser { name: name("operator.token"), ..order };
    assert_eq!(code(fleet.people.add_user(&fleet.operator, &reserved).await), "user_exists");
}

async fn wrong_passwords_are_limited_by_account_and_address(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    fleet.add("alice", "operator", None).await;
    fleet.sign_in("alice", PASSWORD, HERE).await.expect("signed in");
    let stranger = |n: u8| IpAddr::from([203, 0, 113, n]);
    for n in 0..10 {
        assert_eq!(code(fleet.sign_in("alice", "wrong", stranger(n)).await), "unauthorized");
    }
    let before = fleet.audit().await.len();
    for n in 10..13 {
        // Not even the right one is accepted.
        let refused = refusal(fleet.sign_in("alice", PASSWORD, stranger(n)).await);
        assert_eq!(refused.code, "too_many_requests");
        assert_eq!(refused.message, "too many wrong passwords; try again in 900 s");
    }
    assert_eq!(fleet.acts_since(before).await, [act("server", "sign_in.blocked", "alice")], "once");
    fleet.sign_in("alice", PASSWORD, HERE).await.expect("from where she came before she still can");
    for n in 0..50 {
        assert_eq!(
            code(fleet.sign_in(&format!("nobody{n}"), "wrong", stranger(99)).await),
            "unauthorized"
        );
    }
    fleet.add("bob", "viewer", None).await;
    assert_eq!(code(fleet.sign_in("bob", PASSWORD, stranger(99)).await), "too_many_requests");
    neighbours_of_a_failing_address(&fleet).await;
    fleet.clock.advance_ms(15 * 60 * 1000);
    fleet.sign_in("alice", PASSWORD, stranger(10)).await.expect("the time is over");
    fleet.sign_in("bob", PASSWORD, stranger(99)).await.expect("bob signs in");
}

/// A user known at an address can sign in there regardless of failing neighbours, and a failed
/// sign-in reveals no more than theirs.
async fn neighbours_of_a_failing_address(fleet: &Fleet) {
    for n in 0..51 {
        let _ = fleet.sign_in(&format!("neighbour{n}"), "wrong", HERE).await;
    }
    let [known, unknown] = ["alice", "ghost"].map(|name| fleet.sign_in(name, "wrong", HERE));
    let [known, unknown] =
        [known.await, unknown.await].map(|refused| refused.expect_err("refused").to_string());
    assert_eq!(known, "too many wrong passwords; try again in 900 s");
    assert_eq!(known, unknown);
    fleet.sign_in("alice", PASSWORD, HERE).await.expect("she is known here");
}

async fn last_administrator_is_not_removed(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let first = Token::random(TokenKind::Operator);
    fleet.database.store.tokens().create_first(&first, fleet.clock.now_ms()).await.expect("stored");
    let first_id: TokenId = first.id().parse().expect("an id");
    let by = fleet.person(&first).await.expect("good");
    assert!(by.is_first());
    let revoked = fleet.people.revoke_token(&by, &first_id).await;
    let said = "operator.token is the last administrator who can sign in; \
                give another administrator a password first";
    assert_eq!(revoked.expect_err("refused").to_string(), said);
    for (who, may, scope) in
        [("boss", "admin", None), ("other", "admin", Some("site=lab")), ("op", "operator", None)]
    {
        fleet.add(who, may, scope).await;
    }
    let boss = fleet.signed_in("boss").await;
    fleet.people.revoke_token(&boss, &fleet.operator.token).await.expect("there is another");
    fleet.people.revoke_token(&boss, &first_id).await.expect("there is another");
    fleet.people.revoke_token(&boss, &first_id).await.expect("twice is harmless");
    assert_eq!(fleet.person(&first).await, None);
    let demoted = EditUser { roles: Some(roles("viewer")), scope: None };
    let limited = EditUser { roles: None, scope: Some(selector("site=lab")) };
    assert_eq!(
        code(fleet.people.edit_user(&boss, &name("boss"), &demoted).await),
        "last_administrator"
    );
    assert_eq!(
        code(fleet.people.edit_user(&boss, &name("boss"), &limited).await),
        "last_administrator"
    );
    assert_eq!(code(fleet.people.remove_user(&boss, &name("boss")).await), "last_administrator");
    // The token in the data directory does not come back to life.
    fleet.actions.expire().await.expect("done");
    let stored = fleet.database.store.tokens().create_first(&first, fleet.clock.now_ms()).await;
    assert!(stored.is_err_and(|error| error.is_unique_violation()));
    fleet.people.remove_user(&boss, &name("other")).await.expect("she was none");
}

async fn token_ends_with_its_parent(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    fleet.add("alice", "operator", None).await;
    fleet.add("bob", "viewer", None).await;
    let token = fleet.sign_in("alice", PASSWORD, HERE).await.expect("signed in");
    let (alice, bob) = (fleet.person(&token).await.expect("good"), fleet.signed_in("bob").await);
    let listed = fleet.people.tokens(&alice, false).await.expect("reads").tokens;
    assert_eq!(listed.len(), 1);
    assert_eq!((&listed[0].id, listed[0].origin), (&alice.token, TokenOrigin::Login));
    assert_eq!(code(fleet.people.revoke_token(&bob, &alice.token).await), "not_found");
    fleet.people.sign_out(&alice, None).await.expect("out");
    assert_eq!(fleet.person(&token).await, None);

    let ttl = CreateToken { ttl_s: Some(60), ..CreateToken::default() };
    let alice = fleet.signed_in("alice").await;
    let made = fleet.people.create_token(&alice, &ttl).await.expect("made");
    let short: Token = made.token.parse().expect("a token");
    assert!(fleet.person(&short).await.is_some());
    fleet.clock.advance_ms(60_000);
    assert_eq!(fleet.person(&short).await, None);
    let ended = fleet.actions.expire().await.expect("done");
    assert!(ended.contains(&name("alice")) && !ended.contains(&name("bob")), "{ended:?}");
    let made = fleet.people.create_token(&alice, &CreateToken::default()).await.expect("made");
    let lasting: Token = made.token.parse().expect("a token");
    fleet.people.remove_user(&fleet.operator, &name("alice")).await.expect("removed");
    assert_eq!(fleet.person(&lasting).await, None);
    // The next user with this name inherits nothing.
    fleet.add("alice", "admin", None).await;
    assert_eq!(fleet.person(&lasting).await, None);
    // Signing in over and over leaves a bounded number of tokens.
    let newest = fleet.signed_in("alice").await;
    for _ in 0..3 {
        fleet.signed_in("alice").await;
    }
    assert!(fleet.people.tokens(&newest, false).await.expect("reads").tokens.len() <= 50);
}

async fn audit_has_every_change_and_no_read(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let mut robots = fleet.enroll(1).await;
    fleet.add("alice", "admin", None).await;
    let alice = fleet.signed_in("alice").await;
    let entries = fleet.audit().await;
    let said: Vec<_> =
        entries.iter().map(|entry| (entry.who.as_str(), entry.act.as_str())).collect();
    let expected = [
        ("operator.token", "enrolment_token.create"),
        ("enrolment", "robot.enroll"),
        ("operator.token", "user.add"),
        ("alice", "sign_in"),
    ];
    assert_eq!(said, expected);
    assert_eq!((entries[3].address, entries[3].number), (Some(HERE), 4));
    let text = serde_json::to_string(&entries).expect("json");
    assert!(!text.contains(PASSWORD) && !text.contains("argon2"), "no secret: {text}");

    let before = entries.len();
    let (task, all) = ("talker".parse().expect("a name"), selector("*"));
    let bundle = package("1", TaskKind::Service);
    let key = random_key();
    let id =
        fleet.deployments.create(&alice, &key, &order_of(&bundle), &bundle).await.expect("ordered");
    fleet
        .deployments
        .create(&alice, &key, &order_of(&bundle), &bundle)
        .await
        .expect("the same again");
    // Robots' reports are not people's acts.
    fleet.follow(&mut robots[0], Phase::Running).await;
    fleet.actions.expire().await.expect("expiry runs");
    for order in [TaskOrder::Stop, TaskOrder::Start, TaskOrder::Remove] {
        fleet
            .deployments
            .order_task(&alice, &random_key(), order, &task, &all)
            .await
            .expect("ordered");
    }
    fleet.deployments.cancel(&alice, &id).await.expect("cancelled");
    fleet.deployments.cancel(&alice, &id).await.expect("again is nothing");
    let made = fleet.people.create_token(&alice, &CreateToken::default()).await.expect("made");
    fleet.people.revoke_token(&alice, &made.id).await.expect("revoked");
    fleet.robots.remove(&alice, &robots[0].id).await.expect("removed");
    let expected = [
        act("alice", "deployment.create", &id),
        act("alice", "task.stop", "talker"),
        act("alice", "task.start", "talker"),
        act("alice", "task.remove", "talker"),
        act("alice", "deployment.cancel", &id),
        act("alice", "token.create", &made.id),
        act("alice", "token.revoke", &made.id),
        act("alice", "robot.remove", &robots[0].id),
    ];
    assert_eq!(fleet.acts_since(before).await, expected);
    let created = &fleet.audit().await[before];
    assert_eq!((created.token.as_ref(), created.address), (Some(&alice.token), Some(HERE)));
    assert_eq!(created.detail["package"], "talker 1");
    assert_eq!((created.detail["robots"].as_str(), created.detail["count"].as_str()), ("*", "1"));

    let found = async |query: AuditQuery| -> Vec<u64> {
        let page = fleet.database.store.audit().page(&query).await.expect("reads");
        page.records.iter().map(|record| record.read().expect("an entry").number).collect()
    };
    let by = |who: &str| AuditQuery { who: Some(who.to_owned()), ..AuditQuery::default() };
    assert_eq!(found(by("enrolment")).await, [2]);
    assert_eq!(found(AuditQuery { act: Some("task.".to_owned()), ..by("alice") }).await, [8, 7, 6]);
    assert_eq!(
        found(AuditQuery { target: Some(id.to_string()), ..AuditQuery::default() }).await,
        [9, 5]
    );
    assert_eq!(
        found(AuditQuery { before: Some(4), limit: Some(2), ..AuditQuery::default() }).await,
        [3, 2]
    );
    assert_eq!(found(AuditQuery { after: Some(10), ..AuditQuery::default() }).await, [11, 12]);
}

async fn failed_act_leaves_no_audit_entry(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let robots = fleet.enroll(2).await;
    let before = fleet.audit().await.len();
    let taken = EditRobot { name: Some("r1".parse().expect("a name")), ..EditRobot::default() };
    assert_eq!(code(fleet.robots.edit(&fleet.operator, &robots[0].id, &taken).await), "name_taken");
    let repository = "talker".parse().expect("a name");
    let event = taskd::store::AuditEvent::by(
        &fleet.operator,
        taskd::store::AuditAction::ManifestDelete,
        &repository,
    );
    let store = &fleet.database.store;
    let missing =
        store.manifests().delete(&repository, &Digest::of(b"x"), &event, 1).await.expect("reads");
    assert_eq!(missing, Deletion::Unknown);
    let missing = store
        .tags()
        .delete(&repository, &"latest".parse().expect("a tag"), &event, 1)
        .await
        .expect("reads");
    assert_eq!(missing, Deletion::Unknown);
    // A write that is dropped after its entry was written takes the entry with it.
    let mut write = store.begin().await.expect("begins");
    write.audit().record(&event, 1).await.expect("written");
    drop(write);
    assert_eq!(fleet.acts_since(before).await, []);
    let mut write = store.begin().await.expect("begins");
    write.audit().record(&event, 1).await.expect("written");
    write.commit().await.expect("stored");
    assert_eq!(
        fleet.acts_since(before).await,
        [act("operator.token", "manifest.delete", "talker")]
    );
}

async fn self_service_acts_are_rate_limited_and_orders_are_not(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    fleet.enroll(1).await;
    fleet.deploy("1", |_| {}).await;
    fleet.add("vera", "viewer", None).await;
    let vera = fleet.signed_in("vera").await;
    let order = CreateToken { ttl_s: Some(60), ..CreateToken::default() };
    let before = fleet.audit().await.len();
    let mut made = 0;
    let refused = loop {
        let token = match fleet.people.create_token(&vera, &order).await {
            Ok(token) => token,
            Err(refused) => break refused,
        };
        made += 1;
        fleet.people.revoke_token(&vera, &token.id).await.expect("one may always end one's own");
        assert!(made < 1_000, "it goes on without end");
    };
    let ApiError { status, code, message, retry_after_s } = refused.into();
    assert_eq!((status.as_u16(), code), (429, "too_many_requests"));
    assert!(message.starts_with("vera has ") && (1..=44).contains(&retry_after_s), "{message}");
    assert!(made < 210, "{made}");
    assert_eq!(fleet.audit().await.len(), before + 2 * made);
    // Other users are not held up, nor are her orders.
    fleet.add("ada", "operator", None).await;
    let ada = fleet.signed_in("ada").await;
    for _ in 0..250 {
        let task = "talker".parse().expect("a name");
        let all = "*".parse().expect("a selector");
        fleet
            .deployments
            .order_task(&ada, &random_key(), TaskOrder::Stop, &task, &all)
            .await
            .expect("ordered");
    }
}

async fn changed_audit_entry_breaks_the_chain(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    fleet.enroll(3).await;
    let url = fleet.database.url.clone();
    let whole = AuditQuery { after: Some(0), ..AuditQuery::default() };
    let page = fleet.database.store.audit().page(&whole).await.expect("reads");
    assert_eq!(verified(&page).expect("holds").number, page.last);
    fleet.database.forge_audit(2, "r0", "r9").await;
    let store = Store::open(&url).await.expect("opens");
    let page: Result<AuditPage, StoreError> = store.audit().page(&whole).await;
    let broken = verified(&page.expect("reads")).expect_err("found out");
    assert_eq!(broken, task_proto::people::audit::BrokenChain::Changed { number: 2 });
    fleet.database.drop_audit(2).await;
    let broken =
        verified(&store.audit().page(&whole).await.expect("reads")).expect_err("found out");
    assert_eq!(broken, task_proto::people::audit::BrokenChain::Missing { expected: 2, found: 3 });
}

async fn idempotency_key_of_another_person_is_refused(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    fleet.enroll(1).await;
    fleet.add("alice", "operator", None).await;
    fleet.add("bob", "operator", None).await;
    let (alice, bob) = (fleet.signed_in("alice").await, fleet.signed_in("bob").await);
    let (key, bundle) = (random_key(), package("1", TaskKind::Service));
    let id =
        fleet.deployments.create(&alice, &key, &order_of(&bundle), &bundle).await.expect("ordered");
    let again = fleet
        .deployments
        .create(&alice, &key, &order_of(&bundle), &bundle)
        .await
        .expect("the same");
    assert_eq!(again, id);
    let other = fleet.deployments.create(&bob, &key, &order_of(&bundle), &bundle).await;
    assert_eq!(code(other), "idempotency_key_reused");
}
