//! The page in a real browser, against a whole server: what an operator sees, live, and that nothing a robot says is
//! taken for more than text.

use reqwest::{Method, StatusCode};
use serde_json::{Value, json};
use task_proto::desired::DesiredState;
use task_proto::report::{Condition, Failure, FailureCode, Phase, Progress, Report};

use crate::browser::Browser;
use crate::harness::{TestRobot, TestServer};
use crate::outputs::{Push, file, output};

const HOSTILE: &str = "<img src=x onerror=\"document.title='owned'\"><script>document.title='owned'</script>";

async fn post(server: &TestServer, report: &Report, token: &str) {
    let path = format!("/api/v1/robots/{}/report", report.robot_id);
    let response = server.bare(Method::POST, &path).bearer_auth(token).json(report).send().await;
    assert_eq!(response.expect("an answer").status(), StatusCode::OK);
}

/// The robot says that its one task is being fetched, and how far.
fn fetching(robot: &mut TestRobot, state: &DesiredState, done: u64) -> Report {
    let mut report = robot.next_report(state, Phase::Fetching);
    report.tasks[0].progress = Some(Progress { done, total: 48_000_000 });
    report
}

/// The robot says hostile things wherever it may say anything.
fn hostile(robot: &mut TestRobot, state: &DesiredState) -> Report {
    let mut report = robot.next_report(state, Phase::Failed);
    report.tasks[0].failure = Some(Failure::new(FailureCode::BUILD_FAILED, HOSTILE));
    report.conditions = vec![Condition { code: "held".to_owned(), text: HOSTILE.to_owned() }];
    report.host.hostname = HOSTILE.to_owned();
    report
}

#[tokio::test(flavor = "multi_thread")]
async fn an_operator_watches_a_robot_through_its_life() {
    let server = TestServer::start().await;
    let browser = Browser::start().await;

    browser.open(&server.url(&format!("/#token={}", server.operator.reveal()))).await;
    browser.wait("document.body.innerText.includes('No robot is enrolled yet')").await;
    assert_eq!(browser.run("return location.href").await, json!(server.url("/")), "the token has left the address bar");
    browser.wait("document.querySelector('.stream').innerText.includes('Live')").await;
    browser.run("window.isSameDocument = true").await;

    let mut robot = server.enroll("atlas").await;
    browser.wait("document.querySelector('[data-robot] .name')?.innerText === 'atlas'").await;

    let package = server.push("talker", "1.2.0").await;
    server.deploy(&package, "*", "first").await;
    let state = server.desired(&robot).await;
    browser.wait("document.querySelector('[data-robot] .state').innerText === 'Online'").await;
    for done in [12_000_000, 36_000_000] {
        post(&server, &fetching(&mut robot, &state, done), &robot.token).await;
        browser.wait(&format!("document.querySelector('[data-task=talker] progress')?.value === {done}")).await;
    }
    browser.wait("document.querySelector('[data-deployment] .counts').innerText.trim() === '1 fetching'").await;
    post(&server, &robot.next_report(&state, Phase::Running), &robot.token).await;
    browser.wait("document.querySelector('[data-task=talker] .phase').innerText === 'running'").await;
    browser.wait("document.querySelector('[data-deployment] .counts').innerText.trim() === '1 running'").await;

    post(&server, &hostile(&mut robot, &state), &robot.token).await;
    browser.wait("document.querySelector('[data-task=talker] .failure')?.innerText.includes('<img src=x')").await;
    browser.wait("document.querySelector('[data-robot] .condition')?.innerText.includes('<img src=x')").await;
    browser.run("document.querySelector('[data-robot] .name button').click()").await;
    browser.wait("document.querySelector('dialog[open] dl')?.innerText.includes('<img src=x')").await;
    assert_eq!(browser.run("return document.querySelectorAll('body img, body script').length").await, json!(0));
    assert_eq!(browser.run("return document.title").await, json!("taskd"));
    assert_eq!(browser.run("return window.isSameDocument").await, json!(true), "the page was never loaded again");
    browser.run("document.querySelector('dialog').close()").await;

    assert_eq!(browser.console().await, Vec::<Value>::new(), "no error, no warning, no violated policy");
    // And one would have been seen:
    browser.run("document.body.setAttribute('style', 'color: red')").await;
    assert_eq!(browser.console().await.len(), 1);

    browser
        .run("[...document.querySelectorAll('button')].find((button) => button.innerText === 'Sign out').click()")
        .await;
    browser.wait("document.querySelector('label')?.innerText === 'Name'").await;
    let status = "return fetch('/api/v1/robots').then((response) => response.status)";
    assert_eq!(browser.run(status).await, json!(401));
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_wrong_token_is_refused_in_words_and_a_restarted_server_is_found_again() {
    let server = TestServer::start().await;
    let browser = Browser::start().await;

    browser.open(&server.url("/#token=tsko_wrong")).await;
    browser.wait("document.querySelector('[role=alert]')?.innerText.startsWith('token: ')").await;
    let form = "document.querySelector('form.by-token')";
    let sign_in = format!("{form}.elements.token.value = '{}'; {form}.requestSubmit()", server.operator.reveal());
    browser.run(&sign_in).await;
    browser.wait("document.querySelector('.stream')?.innerText.includes('Live')").await;

    let port = server.server.addresses().http.parse::<std::net::SocketAddr>().expect("an address").port();
    let directory = server.stop().await;
    browser.wait("document.querySelector('.stream')?.innerText.includes('Not live')").await;
    let server = TestServer::start_in(directory, |config| config.http.set_port(port)).await;
    // Sessions end with the server; the page finds it and asks to sign in again.
    browser.wait("document.querySelector('label')?.innerText === 'Name'").await;
    browser.run(&sign_in).await;
    browser.wait("document.querySelector('.stream')?.innerText.includes('Live')").await;
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_user_signs_in_with_a_password_and_sees_their_robots() {
    let server = TestServer::start().await;
    server.enroll("atlas").await;
    server.enroll("boreas").await;
    let user = json!({ "name": "alice", "roles": ["viewer"], "scope": "atlas", "password": "correct horse battery" });
    let added: Value = server.post("/api/v1/users", &user).await;
    assert_eq!(added["scope"], "atlas");
    let browser = Browser::start().await;
    browser.open(&server.url("/")).await;
    let sign_in = |password: &str| {
        let form = "document.querySelector('form.by-password')";
        format!(
            "const form = {form}; form.elements.user.value = 'alice'; form.elements.password.value = '{password}';
             form.requestSubmit()"
        )
    };
    browser.wait("document.querySelector('form.by-password') !== null").await;
    browser.run(&sign_in("wrong")).await;
    browser.wait("document.querySelector('[role=alert]')?.innerText.includes('or the password is wrong')").await;
    browser.run(&sign_in("correct horse battery")).await;
    browser.wait("document.querySelector('.stream')?.innerText.includes('Live')").await;
    browser.wait("document.querySelector('header.top').innerText.includes('alice')").await;
    let names = "return [...document.querySelectorAll('[data-robot] .name')].map((name) => name.innerText)";
    assert_eq!(browser.run(names).await, json!(["atlas"]));
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_map_that_came_back_is_shown_as_a_picture() {
    let server = TestServer::start().await;
    let robot = server.enroll("atlas").await;
    let push = Push::new(&server, &robot, format!("outputs/{}/mapping", robot.id));
    let map = push.blob(b"P5\n# drawn by a test\n3 2\n255\n\x00\xcd\xfe\xfe\xcd\x00").await;
    let broken = push.blob(b"P5 999 999 255 ").await;
    // Few bytes that claim to be a large picture, which would keep the browser busy or take its memory.
    let endless = push.blob(b"P2 3999 3999 255 0 0").await;
    let huge = push.blob(b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR\x00\x00\xff\xff\x00\x00\xff\xff\x08\x06").await;
    let mut files = vec![
        file("maps/broken.pgm", broken),
        file("maps/endless.pgm", endless),
        file("maps/huge.png", huge),
        file("maps/corridor.pgm", map),
    ];
    files.extend((0..30).map(|number| file(&format!("more/{number:02}.pgm"), map)));
    assert_eq!(push.output(&output(&robot, 1, files)).await, StatusCode::CREATED);

    let browser = Browser::start().await;
    browser.open(&server.url(&format!("/#token={}", server.operator.reveal()))).await;
    browser.wait("document.querySelector('[data-robot] .name button')?.innerText === 'atlas'").await;
    browser.run("document.querySelector('[data-robot] .name button').click()").await;
    let drawn = "dialog .outputs canvas:not([hidden])";
    browser.wait(&format!("document.querySelector('{drawn}')?.width === 3")).await;
    let grays = "const { data } = document.querySelector('.outputs canvas:not([hidden])').getContext('2d').getImageData(0, 0, 3, 2);
        return [0, 4, 8, 12, 16, 20].map((at) => data[at])";
    assert_eq!(browser.run(grays).await, json!([0, 205, 254, 254, 205, 0]));
    let problems = "return [...document.querySelectorAll('.outputs figure .bad')].map((said) => said.innerText)";
    let ends = "The picture can't be shown: it ends before its last row";
    let expected = json!([ends, ends, "The picture can't be shown: it is too large", ""]);
    assert_eq!(browser.run(problems).await, expected, "four of many are shown");
    browser.wait("document.querySelector('dialog .outputs').innerText.includes('14 more: taskd output get')").await;
    let link = "return document.querySelector('.outputs a[download=\"corridor.pgm\"]').getAttribute('href')";
    let expected = format!("/v2/outputs/{}/mapping/blobs/{}", robot.id, map.digest);
    assert_eq!(browser.run(link).await, json!(expected));
    assert_eq!(browser.console().await, Vec::<Value>::new(), "no error, no warning, no violated policy");
}
