//! The reference of all settings, which the programs print, and the checks of their files. After an
//! intended change: `UPDATE_GOLDEN=1 cargo test -p taskbench --test it configuration`.

use std::path::Path;
use std::process::Command;

use serde_json::Value;

use crate::harness::program;

const DOCUMENT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/configuration.md");
const HEAD: &str = "# Configuration\n\n\
    All keys of all files, as `taskd config reference` and `task-agent config reference` print them.\n\
    Explanations are in [server.md](server.md), [agent.md](agent.md) and [package.md](package.md).\n\n\
    Flags win over variables, variables over the file, the file over defaults. `taskd serve` takes each\n\
    key as a flag as well: `tls.key` is `--tls-key`. `taskd config check FILE` and\n\
    `task-agent config check FILE` name line and key of every error and exit with 2.\n\n\
    Variables without a key: `TASKD_CONFIG` names the server's file, `TASKD_LOG` and `TASK_AGENT_LOG`\n\
    filter the logs (`debug,sqlx=warn`), `TASK_AGENT_LOG_FORMAT` is `auto`, `text` or `json` as\n\
    `log_format` of the server, `TASK_AGENT_DATA` names the agent's directory, and\n\
    `TASK_AGENT_ENROLL_TOKEN` holds the enrollment token.\n\n";

#[expect(clippy::disallowed_methods, reason = "the test starts the programs it tests")]
fn run(name: &str, arguments: &[&str], log_format: Option<(&str, &str)>) -> (i32, String, String) {
    let mut command = Command::new(program(name));
    command.args(arguments).env_clear().env("HOME", "/nonexistent").envs(log_format);
    let output = command.output().expect("started");
    let text = |bytes| String::from_utf8(bytes).expect("text");
    (output.status.code().expect("no signal"), text(output.stdout), text(output.stderr))
}

#[test]
fn configuration_reference_matches_the_document() {
    let print = |name| {
        let (code, text, error) = run(name, &["config", "reference"], None);
        assert_eq!((code, error.as_str()), (0, ""));
        text
    };
    let reference = format!("{HEAD}{}\n{}", print("taskd"), print("task-agent"));
    if std::env::var_os("UPDATE_GOLDEN").is_some() {
        std::fs::write(DOCUMENT, &reference).expect("written");
    }
    let document = std::fs::read_to_string(DOCUMENT).expect("docs/configuration.md");
    assert!(document == reference, "docs/configuration.md is not what the programs print");
}

fn check(name: &str, file: &Path) -> (i32, String, String) {
    run(name, &["config", "check", &file.display().to_string()], None)
}

#[test]
fn config_check_names_file_line_and_key_of_each_error() {
    let dir = tempfile::tempdir().expect("temp dir");
    let file = dir.path().join("a.toml");
    let path = file.display();
    for (name, content, errors) in [
        (
            "taskd",
            "mqtt = 3\n[blobs]\nstor = 1\n",
            [":1: mqtt: \"3\" is not", ":3: blobs.stor: there is"],
        ),
        (
            "task-agent",
            "mqtt = 3\n[limits]\nlog = 1\n",
            [":1: mqtt: invalid type", ":3: limits.log: there is"],
        ),
    ] {
        std::fs::write(&file, content).expect("written");
        let (code, stdout, stderr) = check(name, &file);
        assert_eq!((code, stdout.as_str(), stderr.lines().count()), (2, "", 2), "{stderr}");
        for error in errors {
            assert!(stderr.contains(&format!("{path}{error}")), "{stderr}");
        }
        std::fs::write(&file, "mqtt = \n").expect("written");
        assert!(check(name, &file).2.starts_with(&format!("{path}:1: not valid TOML: ")));
        let good = if name == "taskd" { "http = \"127.0.0.1:0\"\n" } else { "mqtt = false\n" };
        std::fs::write(&file, good).expect("written");
        assert_eq!(check(name, &file), (0, format!("{path} is valid\n"), String::new()));
        let (code, _, stderr) = check(name, Path::new("/nonexistent/a.toml"));
        assert!(code == 2 && stderr.contains("/nonexistent/a.toml"), "{code} {stderr}");
    }
    assert_eq!(std::fs::read_dir(dir.path()).expect("readable").count(), 1, "a check wrote a file");
}

#[test]
fn logs_are_text_unless_json_is_asked_for() {
    let dir = tempfile::tempdir().expect("temp dir");
    let data = dir.path().join("data").display().to_string();
    // The server can't bind this address of the range for documentation, and says so after it began
    // to log.
    let arguments = [
        "serve",
        "--data",
        &data,
        "--http",
        "192.0.2.1:0",
        "--mqtt",
        "127.0.0.1:0",
        "--allow-plaintext",
    ];
    for (format, is_json) in [(None, false), (Some("text"), false), (Some("json"), true)] {
        let format = format.map(|format| ("TASKD_LOG_FORMAT", format));
        let (code, _, stderr) = run("taskd", &arguments, format);
        assert_eq!(code, 1, "{stderr}");
        let log: Vec<&str> = stderr.lines().filter(|line| !line.starts_with("taskd: ")).collect();
        assert!(!log.is_empty(), "{stderr}");
        for line in log {
            let parsed = serde_json::from_str::<Value>(line).ok();
            let has_message = parsed.is_some_and(|line| line["fields"]["message"].is_string());
            assert_eq!(has_message, is_json, "{line}");
        }
    }
    let (code, _, stderr) = run("taskd", &arguments, Some(("TASKD_LOG_FORMAT", "xml")));
    assert!(code == 2 && stderr.contains("TASKD_LOG_FORMAT: \"xml\" is none of"), "{stderr}");
}
