//! Selectors and scopes as the database evaluates them, compared with the matcher of the wire
//! types, on every database.

use std::cell::RefCell;
use std::collections::BTreeSet;

use proptest::prelude::*;
use task_proto::ids::Labels;
use task_proto::ids::selector::Selector;
use task_proto::trust::token::{Token, TokenKind};
use task_proto::{RobotId, RobotName};
use taskd::domain::person::Scope;
use taskd::store::{KnownRobot, SelectedRobot, Store};

use crate::database::{TestDatabase, on_both_databases, postgres, sqlite};
use crate::fleet::mac;

on_both_databases! {
    selector_with_as_many_names_and_labels_as_fit_is_evaluated,
    labels_of_earlier_robots_are_indexed_by_the_migration,
}

/// The most robots of a generated fleet.
const ROBOTS: usize = 12;

/// A robot of a generated fleet.
#[derive(Debug, Clone)]
struct Generated {
    /// The labels at its registration.
    before: Labels,
    labels: Labels,
    waits: bool,
    is_removed: bool,
}

/// A robot as stored.
#[derive(Debug, Clone)]
struct Stored {
    robot: KnownRobot,
    waits: bool,
    is_removed: bool,
}

fn labels() -> impl Strategy<Value = Labels> {
    proptest::collection::btree_map(
        proptest::sample::select(vec!["site", "base", "Site"]),
        proptest::sample::select(vec!["lab", "field", "Lab", "x86_64"]),
        0..3,
    )
    .prop_map(|labels| {
        let parsed = |(key, value): (&str, &str)| {
            (key.parse().expect("a key"), value.parse().expect("a value"))
        };
        labels.into_iter().map(parsed).collect()
    })
}

fn generated() -> impl Strategy<Value = Generated> {
    (labels(), labels(), prop::bool::weighted(0.1), prop::bool::weighted(0.1)).prop_map(
        |(before, labels, waits, is_removed)| Generated { before, labels, waits, is_removed },
    )
}

/// A selector's text, in which `@7` stands for the id of robot 7.
fn selector() -> impl Strategy<Value = String> {
    let name = (0..ROBOTS + 2).prop_map(|number| format!("r{number}"));
    let id = (0..ROBOTS).prop_map(|number| format!("@{number}"));
    let label = (
        proptest::sample::select(vec!["site", "base", "Site", "none"]),
        proptest::sample::select(vec!["lab", "field", "Lab", "x86_64"]),
    )
        .prop_map(|(key, value)| format!("{key}={value}"));
    let condition = prop_oneof![4 => label, 2 => name, 2 => id, 1 => Just("*".to_owned())];
    let term = (any::<bool>(), proptest::collection::vec(condition, 1..4));
    let term = term.prop_map(|(is_excluded, conditions)| {
        format!("{}{}", if is_excluded { "!" } else { "" }, conditions.join("&"))
    });
    proptest::collection::vec(term, 1..5).prop_map(|terms| terms.join(","))
}

/// Stores the fleet in place of the one before.
async fn store_fleet(store: &Store, before: &[Stored], fleet: &[Generated]) -> Vec<Stored> {
    let mut write = store.begin().await.expect("begins");
    let old: Vec<RobotId> = before.iter().map(|stored| stored.robot.id.clone()).collect();
    write.robots().remove(&old, 1).await.expect("removed");
    let token = Token::random(TokenKind::Enrollment);
    let mut stored = Vec::new();
    for (number, generated) in fleet.iter().enumerate() {
        let robot = KnownRobot {
            id: RobotId::random(),
            name: format!("r{number}").parse().expect("a name"),
            mac: mac(number as u32),
            labels: generated.before.clone(),
        };
        write.robots().insert(&robot, 1).await.expect("inserted");
        write.enrollments().record(&robot.id, &token, None, generated.waits).await.expect("done");
        let robot = KnownRobot { labels: generated.labels.clone(), ..robot };
        match number % 2 {
            0 => write.robots().update(&robot).await.expect("updated"),
            _ => write.robots().update_labels(&[&robot]).await.expect("updated"),
        }
        if generated.is_removed {
            write.robots().remove(std::slice::from_ref(&robot.id), 1).await.expect("removed");
        }
        let Generated { waits, is_removed, .. } = *generated;
        stored.push(Stored { robot, waits, is_removed });
    }
    write.commit().await.expect("written");
    stored
}

fn parse(text: &str, fleet: &[Stored]) -> Selector {
    let text = (0..ROBOTS).rev().fold(text.to_owned(), |text, number| {
        let id = fleet.get(number).map_or("0", |stored| stored.robot.id.as_str());
        text.replace(&format!("@{number}"), id)
    });
    text.parse().expect("a selector")
}

/// The robots of the fleet that meet both conditions, sorted by name.
fn expected(
    fleet: &[Stored],
    is_among: impl Fn(&Stored) -> bool,
    matches: impl Fn(&KnownRobot) -> bool,
) -> Vec<&KnownRobot> {
    let among = fleet.iter().filter(|stored| is_among(stored));
    let mut robots: Vec<_> =
        among.map(|stored| &stored.robot).filter(|robot| matches(robot)).collect();
    robots.sort_by(|one, other| one.name.cmp(&other.name));
    robots
}

fn covers(scope: &Scope, robot: &KnownRobot) -> bool {
    scope.covers(&robot.id, &robot.name, &robot.labels)
}

fn matches(selector: &Selector, robot: &KnownRobot) -> bool {
    selector.matches(&robot.id, &robot.name, &robot.labels)
}

/// The names in a selector that belong to none of these robots.
fn unknown(selector: &Selector, robots: &[&KnownRobot]) -> Vec<RobotName> {
    let mut names = selector.names();
    names.retain(|name| {
        !robots.iter().any(|robot| robot.name == *name || robot.id.as_str() == name.as_str())
    });
    names.into_iter().collect()
}

async fn compare(store: &Store, fleet: &[Stored], selector: &Selector, scope: &Scope) {
    let orderable = |stored: &Stored| !stored.is_removed && !stored.waits;
    let registered = |stored: &Stored| !stored.is_removed;
    let selected = expected(fleet, orderable, |robot| matches(selector, robot));
    let in_scope: Vec<bool> = selected.iter().map(|robot| covers(scope, robot)).collect();
    let named: Vec<_> = selected
        .iter()
        .map(|robot| SelectedRobot { id: robot.id.clone(), name: robot.name.clone() })
        .collect();
    let own_orderable = expected(fleet, orderable, |robot| covers(scope, robot));
    let unknown_to_orders = unknown(selector, &own_orderable);
    let mut write = store.begin().await.expect("begins");
    let found = write.robots().matching_known(selector, scope).await.expect("reads");
    assert_eq!(found.robots.iter().collect::<Vec<_>>(), selected);
    assert_eq!((&found.in_scope, &found.unknown), (&in_scope, &unknown_to_orders));
    let found = write.robots().matching(selector, scope, None).await.expect("reads");
    assert_eq!((found.robots, found.in_scope), (named.clone(), in_scope.clone()));
    let ids = write.robots().ids_ever_in(scope).await.expect("reads");
    let ids: BTreeSet<_> = ids.into_iter().collect();
    for stored in fleet {
        assert_eq!(ids.contains(&stored.robot.id), covers(scope, &stored.robot), "{stored:?}");
    }
    drop(write);
    let robots = store.robots();
    let found = robots.matching(selector, scope, None).await.expect("reads");
    assert_eq!((found.robots, found.in_scope), (named, in_scope));
    assert_eq!(found.unknown, unknown_to_orders);
    let own = expected(fleet, registered, |robot| covers(scope, robot));
    let found = robots.unknown(selector, scope).await.expect("reads");
    assert_eq!(found, unknown(selector, &own));
    let mut found = robots.known(scope).await.expect("reads");
    found.sort_by(|one, other| one.name.cmp(&other.name));
    assert_eq!(found.iter().collect::<Vec<_>>(), own);
    let listed =
        expected(fleet, registered, |robot| covers(scope, robot) && matches(selector, robot));
    let found = robots.list(&scope.and(Some(selector))).await.expect("reads");
    assert_eq!(found.iter().map(|row| &row.robot).collect::<Vec<_>>(), listed);
    let page = robots.page(scope, Some(selector), None, 3).await.expect("reads");
    assert_eq!(page.total, listed.len() as u64);
    let first: Vec<_> = listed.iter().take(3).copied().collect();
    assert_eq!(page.robots.iter().map(|row| &row.robot).collect::<Vec<_>>(), first);
}

/// Compares random fleets, selectors and scopes.
fn compare_random(database: impl Future<Output = TestDatabase>, cases: u32) {
    let runtime = tokio::runtime::Runtime::new().expect("a runtime");
    let database = runtime.block_on(database);
    let stored = RefCell::new(Vec::new());
    let config = ProptestConfig {
        cases,
        max_shrink_iters: 200,
        failure_persistence: None,
        ..ProptestConfig::default()
    };
    let fleets = proptest::collection::vec(generated(), 0..ROBOTS);
    let selectors = proptest::collection::vec(selector(), 8);
    let scopes = proptest::collection::vec(selector(), 0..3);
    proptest!(config, |(fleet in fleets, selectors in selectors, scopes in scopes)| {
        runtime.block_on(async {
            let before = stored.take();
            let fleet = store_fleet(&database.store, &before, &fleet).await;
            let scope = Scope::of(scopes.iter().map(|text| parse(text, &fleet)));
            for text in &selectors {
                compare(&database.store, &fleet, &parse(text, &fleet), &scope).await;
                compare(&database.store, &fleet, &parse(text, &fleet), &Scope::everything()).await;
            }
            stored.replace(fleet);
        });
    });
}

#[test]
fn selectors_in_sqlite_match_as_in_memory() {
    compare_random(sqlite(), 60);
}

#[test]
fn selectors_in_postgres_match_as_in_memory() {
    compare_random(postgres(), 20);
}

async fn selector_with_as_many_names_and_labels_as_fit_is_evaluated(database: TestDatabase) {
    let fleet = vec![
        Generated {
            before: Labels::new(),
            labels: Labels::new(),
            waits: false,
            is_removed: false
        };
        3
    ];
    let fleet = store_fleet(&database.store, &[], &fleet).await;
    let names: Vec<String> = (1..20_000).map(|number| format!("r{number}")).collect();
    let labels: Vec<String> = (0..20_000).map(|number| format!("k{number}=v")).collect();
    let compound: Vec<String> =
        (0..128).map(|number| format!("site=s{number}&r{number}")).collect();
    for text in [names.join(","), labels.join(",") + ",r1", compound.join(",")] {
        let excluded = format!("!{}", text.replace(',', ",!"));
        for text in [text, excluded] {
            let selector = text.parse().expect("it fits");
            let scope = Scope::of(["!r2".parse().expect("a selector")]);
            compare(&database.store, &fleet, &selector, &scope).await;
        }
    }
}

async fn labels_of_earlier_robots_are_indexed_by_the_migration(database: TestDatabase) {
    let site: Labels = [
        ("site".parse().expect("a key"), "lab".parse().expect("a value")),
        ("base".parse().expect("a key"), "x86_64".parse().expect("a value")),
    ]
    .into();
    let robot = Generated { before: site.clone(), labels: site, waits: false, is_removed: false };
    let bare = Generated { before: Labels::new(), labels: Labels::new(), ..robot.clone() };
    let fleet = store_fleet(&database.store, &[], &[robot.clone(), bare, robot]).await;
    database.store.close().await;
    crate::database::undo_order_chunks(&database.url).await;
    let store = Store::open(&database.url).await.expect("migrates");
    for text in ["site=lab", "!site=lab", "base=x86_64&site=lab", "base=lab"] {
        let selector = text.parse().expect("a selector");
        compare(&store, &fleet, &selector, &Scope::everything()).await;
    }
}
