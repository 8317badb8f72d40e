//! Shell completions, each from the script that `taskd completions` prints for the shell. A missing
//! shell is a failure.

use std::path::Path;
use std::process::Stdio;

use crate::cli::Ran;
use crate::commands::Lab;

/// Completions of bash where `$@` has been typed and the last word is unfinished.
const BASH: &str = r#"source <(taskd completions bash) || exit 9
    COMP_WORDS=("$@") COMP_CWORD=$(($# - 1)) COMP_TYPE=9
    _clap_complete_taskd taskd "${@: -1}" "${@: -2:1}"
    printf '%s\n' "${COMPREPLY[@]}""#;

/// Completions of fish for the line `$argv[1]`: a word, and its description behind a tab.
const FISH: &str = r#"taskd completions fish | source; or exit 9
    complete -C $argv[1]"#;

/// Completions of zsh for the typed line `$1`: a zsh in a terminal of its own writes the offered
/// words into the file `$2`. A call of `compadd` with -O, -A or -D only tests which words fit.
const ZSH: &str = r#"zmodload zsh/zpty && zpty terminal zsh -f -i || exit 9
    start='PROMPT= && autoload -U compinit && compinit -u -D'
    zpty -w terminal "$start && source <(taskd completions zsh)"
    zpty -w terminal "compadd() {
        if (( ! \${@[(I)-[OAD]]} )); then
            local -a offered
            builtin compadd -O offered \"\$@\"
            print -rl -- \$offered >>${(q)2}
        fi
        builtin compadd \"\$@\"
    }"
    # The words are joined only where they are printed: the terminal shows the typed text as
    # well.
    zpty -w terminal 'ended() { print -r "<""ended>" }; comppostfuncs=(ended); print -r "<""ready>"'
    zpty -r terminal shown '*<ready>*' && zpty -w -n terminal "$1"$'\t' &&
        zpty -r terminal shown '*<ended>*' || exit 9
    zpty -d terminal"#;

/// Runs a shell that finds the `taskd` that is tested.
#[expect(clippy::disallowed_methods, reason = "the test needs the shell that completes")]
async fn shell(environment: &[(&str, String)], program: &[&str]) -> Ran {
    let programs = Path::new(env!("CARGO_BIN_EXE_taskd")).parent().unwrap();
    let path = format!("{}:{}", programs.display(), std::env::var("PATH").unwrap());
    // A home directory where a shell may keep its files.
    let home = tempfile::tempdir().unwrap();
    // A shell that hangs is ended.
    let mut command = std::process::Command::new("timeout");
    command.arg("60").args(program).env("PATH", path).env("HOME", home.path()).stdin(Stdio::null());
    for directory in ["XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_CACHE_HOME", "XDG_STATE_HOME"] {
        command.env(directory, home.path());
    }
    command.env("TERM", "dumb").envs(environment.iter().cloned());
    let ran: Ran =
        tokio::task::spawn_blocking(move || command.output()).await.unwrap().unwrap().into();
    assert_eq!(
        (ran.code, ran.stderr.as_str()),
        (0, ""),
        "{program:?} (scripts/need debian zsh=zsh fish=fish)"
    );
    ran
}

fn lines(text: &str) -> Vec<String> {
    text.lines().filter(|line| !line.is_empty()).map(str::to_owned).collect()
}

/// The offered words, requested again while only options are offered: a server that takes longer
/// than a moment offers nothing.
async fn offered(ask: impl AsyncFn() -> Vec<String>) -> Vec<String> {
    for _ in 0..4 {
        let found = ask().await;
        if found.iter().any(|word| !word.starts_with('-')) {
            return found;
        }
    }
    Vec::new()
}

async fn bash(environment: &[(&str, String)], words: &[&str]) -> Vec<String> {
    let program = [&["bash", "--norc", "-c", BASH, "bash"], words].concat();
    offered(async || lines(&shell(environment, &program).await.stdout)).await
}

async fn fish(environment: &[(&str, String)], line: &str) -> Vec<String> {
    offered(async || {
        lines(&shell(environment, &["fish", "--no-config", "-c", FISH, line]).await.stdout)
    })
    .await
}

async fn zsh(environment: &[(&str, String)], line: &str) -> Vec<String> {
    offered(async || zsh_once(environment, line).await).await
}

async fn zsh_once(environment: &[(&str, String)], line: &str) -> Vec<String> {
    let dir = tempfile::tempdir().unwrap();
    let offered = dir.path().join("offered");
    // Nothing is offered until something is.
    std::fs::write(&offered, "").unwrap();
    shell(environment, &["zsh", "-f", "-c", ZSH, "zsh", line, offered.to_str().unwrap()]).await;
    let mut offered = lines(&std::fs::read_to_string(offered).unwrap());
    // It offers words with the same description row by row of its table, from the last.
    offered.sort();
    offered
}

#[tokio::test(flavor = "multi_thread")]
async fn bash_completes_names_from_the_server() {
    let lab = Lab::new().await;
    let here = lab.here();
    assert_eq!(bash(&here, &["taskd", "robot", "info", "ro"]).await, ["robot-1", "robot-2"]);
    assert_eq!(bash(&here, &["taskd", "logs", "robot-1", ""]).await[..1], ["hello"]);
    assert_eq!(bash(&here, &["taskd", "stop", "he"]).await, ["hello"]);
    assert_eq!(bash(&here, &["taskd", "package", "files", "hel"]).await, ["hello"]);
    assert_eq!(bash(&here, &["taskd", "package", "files", "hello:"]).await, ["hello:1", "hello:2"]);
    assert_eq!(bash(&here, &["taskd", "deploy", "watch", "d"]).await, [lab.deployment()]);
    let term = bash(&here, &["taskd", "stop", "hello", "--on", "robot-2,!ro"]).await;
    assert_eq!(term, ["robot-2,!robot-1", "robot-2,!robot-2"]);
    assert_eq!(bash(&here, &["taskd", "lifecycle", "robot-1", "/n", "act"]).await, ["activate"]);
    lab.bench.enroll(3).await;
    assert_eq!(bash(&here, &["taskd", "robot", "info", "robot-3"]).await, ["robot-3"]);

    // The line itself may say which server is meant; one that hangs or is away costs a moment and
    // no word.
    let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let silent = format!("http://{}", listener.local_addr().unwrap());
    for server in [silent.as_str(), "http://127.0.0.1:1"] {
        let words = ["taskd", "--server", server, "robot", "info", "ro"];
        assert_eq!(bash(&here, &words).await, [""; 0], "{server}");
    }
    assert_eq!(
        bash(&[("TASKD_TOKEN", "nonsense".to_owned())], &["taskd", "robot", "info", "ro"]).await,
        [""; 0]
    );
    assert_eq!(bash(&[], &["taskd", "rob"]).await, ["robot"]);
    lab.bench.server.unwrap().stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn fish_completes_names_from_the_server() {
    let lab = Lab::new().await;
    let here = lab.here();
    assert_eq!(fish(&here, "taskd robot info ro").await, ["robot-1\tonline", "robot-2\tonline"]);
    assert_eq!(fish(&here, "taskd logs robot-1 ").await[..1], ["hello"]);
    assert_eq!(fish(&here, "taskd package files hello:").await, ["hello:1", "hello:2"]);
    let deployment = format!("{}\thello 2, settled", lab.deployment());
    assert_eq!(fish(&here, "taskd deploy watch d").await, [deployment]);
    let term = fish(&here, "taskd stop hello --on robot-2,!ro").await;
    assert_eq!(term, ["robot-2,!robot-1\trobot", "robot-2,!robot-2\trobot"]);
    assert_eq!(fish(&here, "taskd lifecycle robot-1 /n act").await, ["activate"]);
    lab.bench.enroll(3).await;
    assert_eq!(fish(&here, "taskd robot info robot-3").await, ["robot-3\toffline"]);
    assert_eq!(fish(&here, "taskd --server http://127.0.0.1:1 robot info ro").await, [""; 0]);
    lab.bench.server.unwrap().stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn zsh_completes_names_from_the_server() {
    let lab = Lab::new().await;
    let here = lab.here();
    assert_eq!(zsh(&here, "taskd robot info ro").await, ["robot-1", "robot-2"]);
    assert!(zsh(&here, "taskd logs robot-1 ").await.contains(&"hello".to_owned()));
    assert_eq!(zsh(&here, "taskd package files hello:").await, ["hello:1", "hello:2"]);
    assert_eq!(zsh(&here, "taskd deploy watch d").await, [lab.deployment()]);
    let term = zsh(&here, "taskd stop hello --on robot-2,!ro").await;
    assert_eq!(term, ["robot-2,!robot-1", "robot-2,!robot-2"]);
    assert_eq!(zsh(&here, "taskd lifecycle robot-1 /n act").await, ["activate"]);
    lab.bench.enroll(3).await;
    assert_eq!(zsh(&here, "taskd robot info robot-3").await, ["robot-3"]);
    assert_eq!(zsh(&here, "taskd --server http://127.0.0.1:1 robot info ro").await, [""; 0]);
    lab.bench.server.unwrap().stop().await;
}
