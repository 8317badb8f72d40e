//! Lists in pages: nothing twice, nothing left out, despite orders made meanwhile.

use std::collections::BTreeMap;

use serde_json::json;
use task_proto::api::{DeploymentList, DeploymentView, RobotList};
use task_proto::{DeploymentId, RobotName};
use taskd::domain::person::Scope;

use crate::database::{TestDatabase, on_both_databases};
use crate::fleet::{Fleet, Robot};
use crate::harness::{TestServer, answer, refusal};

on_both_databases! {
    pages_of_robots_list_each_robot_once,
    pages_of_deployments_list_each_deployment_once,
}

async fn pages_of_robots_list_each_robot_once(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    fleet.enroll(12).await;
    // The order is that of the bytes, on every database: capitals come first, r10 before r2.
    let everything = Scope::everything();
    let page =
        async |scope: &Scope, selector: Option<&str>, after: Option<&RobotName>, limit: usize| {
            let selector = selector.map(|selector| selector.parse().expect("a selector"));
            fleet
                .database
                .store
                .robots()
                .page(scope, selector.as_ref(), after, limit)
                .await
                .expect("reads")
        };
    let (mut names, mut after) = (Vec::new(), None);
    loop {
        let page = page(&everything, None, after.as_ref(), 5).await;
        assert_eq!(page.total, 12);
        names.extend(page.robots.into_iter().map(|row| row.robot.name.to_string()));
        after = page.next;
        match &after {
            Some(next) => assert_eq!(names.last().map(String::as_str), Some(next.as_str())),
            None => break,
        }
    }
    assert_eq!(names, ["r0", "r1", "r10", "r11", "r2", "r3", "r4", "r5", "r6", "r7", "r8", "r9"]);
    let some = page(&everything, Some("!r10,!r4"), Some(&"r1".parse().expect("a name")), 3).await;
    assert_eq!(
        some.robots.iter().map(|row| row.robot.name.as_str()).collect::<Vec<_>>(),
        ["r11", "r2", "r3"]
    );
    assert_eq!((some.total, some.next), (10, Some("r3".parse().expect("a name"))));
    // A page that holds all the remaining entries is the last one; a removed robot is still a valid
    // position to continue from.
    let scope = Scope::of(["r2,r3,r9".parse().expect("a selector")]);
    let last = page(&scope, None, Some(&"r2x".parse().expect("a name")), 2).await;
    assert_eq!((last.robots.len(), last.total, last.next), (2, 3, None));
}

async fn pages_of_deployments_list_each_deployment_once(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let robots = fleet.enroll(2).await;
    let mut ordered = Vec::new();
    for version in 0..7 {
        let selector = if version % 3 == 0 { "*" } else { "r0" };
        ordered.push(
            fleet
                .deploy(&version.to_string(), |order| {
                    order.selector = selector.parse().expect("a selector")
                })
                .await,
        );
    }
    ordered.reverse();
    let pages = async |robots: Option<&[Robot]>| {
        let robots: Option<Vec<_>> =
            robots.map(|robots| robots.iter().map(|robot| robot.id.clone()).collect());
        let (mut found, mut before) = (Vec::new(), None);
        loop {
            let page = fleet
                .database
                .store
                .deployments()
                .page(robots.as_deref(), before.as_ref(), 3)
                .await
                .expect("reads");
            let page = page.expect("it is there");
            found.push(page.deployments);
            before = page.next;
            if before.is_none() {
                return found;
            }
        }
    };
    let all = pages(None).await;
    assert_eq!(all.iter().map(Vec::len).collect::<Vec<_>>(), [3, 3, 1]);
    assert_eq!(all.iter().flatten().map(|view| view.id.clone()).collect::<Vec<_>>(), ordered);
    for view in all.iter().flatten() {
        let whole = fleet.deployment(&view.id).await;
        assert_eq!((&view.counts, &view.supersedes), (&whole.counts, &whole.supersedes));
    }
    // Of those that concern only others nothing is shown, yet the pages go on.
    let some = pages(Some(&robots[1..])).await;
    assert_eq!(some.iter().map(Vec::len).collect::<Vec<_>>(), [1, 1, 1]);
    assert!(
        some.iter()
            .flatten()
            .all(|view| view.counts.iter().map(|count| count.count).sum::<u64>() == 1)
    );
    let unknown = fleet
        .database
        .store
        .deployments()
        .page(None, Some(&DeploymentId::random()), 3)
        .await
        .expect("reads");
    assert!(unknown.is_none());
}

#[tokio::test(flavor = "multi_thread")]
async fn lists_come_in_pages() {
    let server = TestServer::start().await;
    for name in ["ceto", "atlas", "boreas"] {
        server.enroll(name).await;
    }
    let whole: BTreeMap<String, serde_json::Value> = server.get("/api/v1/robots").await;
    assert_eq!(whole.keys().collect::<Vec<_>>(), ["robots"], "without a limit nothing is new");
    let first: RobotList = server.get("/api/v1/robots?limit=2").await;
    assert_eq!(
        first.robots.iter().map(|robot| robot.name.as_str()).collect::<Vec<_>>(),
        ["atlas", "boreas"]
    );
    assert_eq!(
        (first.next.as_ref().map(RobotName::as_str), first.total),
        (Some("boreas"), Some(3))
    );
    let last: RobotList = server.get("/api/v1/robots?limit=2&after=boreas&selector=!atlas").await;
    assert_eq!(last.robots.iter().map(|robot| robot.name.as_str()).collect::<Vec<_>>(), ["ceto"]);
    assert_eq!((last.next, last.total), (None, Some(2)));

    let package = server.push("talker", "1.0.0").await;
    let old = server.deploy(&package, "*", "one").await;
    let new = server.deploy(&package, "atlas", "two").await;
    let first: DeploymentList = server.get("/api/v1/deployments?limit=1").await;
    assert_eq!((&first.deployments[0].id, first.next.as_ref()), (&new.id, Some(&new.id)));
    let last: DeploymentList =
        server.get(&format!("/api/v1/deployments?limit=1&before={}", new.id)).await;
    assert_eq!((&last.deployments[0].id, last.next), (&old.id, None));

    let get = |path: &str| server.request(reqwest::Method::GET, path);
    let nonsense = [
        "/api/v1/robots?limit=0",
        "/api/v1/robots?limit=1001",
        "/api/v1/robots?limit=many",
        "/api/v1/robots?after=atlas",
        "/api/v1/robots?limit=1&before=atlas",
        "/api/v1/deployments?limit=0",
        "/api/v1/deployments?before=atlas",
    ];
    for path in nonsense {
        assert_eq!(refusal(get(path)).await, (400, "invalid_request".to_owned()), "{path}");
    }
    let unknown = format!("/api/v1/deployments?before={}", DeploymentId::random());
    assert_eq!(refusal(get(&unknown)).await, (404, "not_found".to_owned()));
    // Removed entries are skipped.
    let gone = server
        .request(reqwest::Method::DELETE, "/api/v1/robots/boreas")
        .send()
        .await
        .expect("an answer");
    assert_eq!(gone.status(), 204);
    let last: RobotList = answer(get("/api/v1/robots?limit=2&after=boreas")).await;
    assert_eq!((last.robots.len(), last.total), (1, Some(2)));
    let refused: serde_json::Value =
        get("/api/v1/robots?limit=0").send().await.expect("an answer").json().await.unwrap();
    assert_eq!(refused["error"]["message"], json!("limit: expected 1 to 1000, not 0"));
}

#[tokio::test(flavor = "multi_thread")]
async fn long_selectors_are_omitted_from_lists() {
    let server = TestServer::start().await;
    server.enroll("atlas").await;
    let package = server.push("talker", "1.0.0").await;
    let others = (0..10_000).map(|number| format!("site=s{number:x}"));
    let selector = std::iter::once("atlas".to_owned()).chain(others).collect::<Vec<_>>().join(",");
    let ordered = server.deploy(&package, &selector, "one").await;
    assert_eq!(ordered.counts.iter().map(|count| count.count).sum::<u64>(), 1);
    let list: DeploymentList = server.get("/api/v1/deployments").await;
    assert_eq!((&list.deployments[0].id, &list.deployments[0].selector), (&ordered.id, &None));
    let whole: DeploymentView = server.get(&format!("/api/v1/deployments/{}", ordered.id)).await;
    assert_eq!(whole.selector.map(|selector| selector.to_string()), Some(selector));
}
