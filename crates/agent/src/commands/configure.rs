//! `task-agent configure`: the settings form from the paper. The command shows the MAC that was
//! found, asks for the values that it can't determine, and writes the property file. Flags answer
//! questions; with `--yes` the other settings keep their values.

use std::io::{IsTerminal as _, Write as _};
use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::{Context as _, bail};
use task_proto::RobotName;
use task_proto::ids::{LabelKey, LabelValue};

use super::enroll::parse_label;
use super::{DataDir, say};
use crate::config::{FILE_NAME, Settings, parse_server};
use crate::setup::underlay::{self, SearchPaths};
use crate::system::durable;
use crate::system::identity;
use crate::system::layout::DataDir as Layout;

#[derive(Debug, clap::Args)]
pub struct Arguments {
    /// URL of the server
    #[arg(long, value_name = "URL")]
    server: Option<String>,
    /// Name of the robot
    #[arg(long)]
    name: Option<RobotName>,
    /// Label of the robot, in place of all existing labels; may be repeated
    #[arg(long = "label", value_name = "K=V", value_parser = parse_label)]
    labels: Vec<(LabelKey, LabelValue)>,
    /// Setup file to source before a task is built or run; may be repeated
    #[arg(long = "underlay", value_name = "FILE")]
    underlays: Vec<PathBuf>,
    /// Do not prompt; settings that are not given keep their values
    #[arg(long, short)]
    yes: bool,
    #[command(flatten)]
    data: DataDir,
}

/// Asks the questions, and writes the property file.
pub fn run(arguments: Arguments) -> anyhow::Result<ExitCode> {
    let data = Layout::new(&arguments.data.data)?;
    let mut settings = Settings::read(data.root())?;
    match identity::find_own_mac() {
        Ok(mac) => say(format_args!("MAC address: {mac}")),
        Err(error) => say(format_args!("MAC address: {error} when you enroll")),
    }
    if !arguments.yes && !std::io::stdin().is_terminal() {
        bail!("no terminal for prompts: pass the values as flags, with --yes");
    }
    apply_flags(&mut settings, &arguments)?;
    if !arguments.yes {
        prompt_for_missing(&mut settings, &arguments)?;
    }
    durable::create_dir_all(data.root())
        .with_context(|| format!("cannot make {}", data.root().display()))?;
    settings.write(data.root())?;
    say(format_args!("wrote {}", data.root().join(FILE_NAME).display()));
    Ok(ExitCode::SUCCESS)
}

fn apply_flags(settings: &mut Settings, arguments: &Arguments) -> anyhow::Result<()> {
    if let Some(server) = &arguments.server {
        settings.server = Some(parse_server(server)?.to_string());
    }
    if let Some(name) = &arguments.name {
        settings.name = Some(name.clone());
    }
    if !arguments.labels.is_empty() {
        settings.labels = Some(arguments.labels.iter().cloned().collect());
    }
    if !arguments.underlays.is_empty() {
        settings.underlays = Some(arguments.underlays.clone());
    }
    Ok(())
}

fn prompt_for_missing(settings: &mut Settings, arguments: &Arguments) -> anyhow::Result<()> {
    if arguments.server.is_none() {
        let server = settings.server.clone().unwrap_or_else(|| "http://localhost:8080".to_owned());
        settings.server = prompt("Server", &server, |text| Ok(parse_server(text)?.to_string()))?;
    }
    if arguments.name.is_none() {
        let hostname = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
        let name = settings.name.as_ref().map_or(hostname.trim().to_owned(), ToString::to_string);
        settings.name = prompt("Name", &name, |text| Ok(text.parse()?))?;
    }
    if arguments.labels.is_empty() {
        let pairs = settings.labels.iter().flatten().map(|(key, value)| format!("{key}={value}"));
        settings.labels =
            prompt("Labels (key=value,…)", &pairs.collect::<Vec<_>>().join(","), |text| {
                let labels = text.split(',').filter(|pair| !pair.trim().is_empty());
                labels.map(|pair| parse_label(pair.trim()).map_err(anyhow::Error::msg)).collect()
            })?;
    }
    if arguments.underlays.is_empty() {
        let underlays = match &settings.underlays {
            Some(underlays) => underlays.clone(),
            None => underlay::find(&[], &SearchPaths::of_this_machine())
                .pop()
                .map(|best| best.setups)
                .unwrap_or_default(),
        };
        let shown =
            underlays.iter().map(|path| path.display().to_string()).collect::<Vec<_>>().join(":");
        settings.underlays = prompt("ROS setup file (a:b for several)", &shown, |text| {
            Ok(text.split(':').filter(|path| !path.is_empty()).map(PathBuf::from).collect())
        })?;
    }
    Ok(())
}

/// Asks until the answer is valid. An empty answer selects the default, or no value where there is
/// no default.
fn prompt<T>(
    question: &str,
    default: &str,
    parse: impl Fn(&str) -> anyhow::Result<T>,
) -> anyhow::Result<Option<T>> {
    loop {
        let mut out = std::io::stdout().lock();
        write!(out, "{question} [{default}]: ")?;
        out.flush()?;
        let mut answer = String::new();
        if std::io::stdin().read_line(&mut answer)? == 0 {
            bail!("input ended: nothing was written");
        }
        let answer = if answer.trim().is_empty() { default } else { answer.trim() };
        if answer.is_empty() {
            return Ok(None);
        }
        match parse(answer) {
            Ok(value) => return Ok(Some(value)),
            Err(error) => say(format_args!("  {error:#}")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn configure_flags_keep_other_settings() {
        let dir = tempfile::tempdir().expect("a directory");
        let arguments = |name: Option<&str>, server: Option<&str>| Arguments {
            server: server.map(str::to_owned),
            name: name.map(|name| name.parse().expect("valid")),
            labels: vec![parse_label("site=lab").expect("valid")],
            underlays: Vec::new(),
            yes: true,
            data: DataDir { data: dir.path().to_owned() },
        };
        run(arguments(None, Some("http://server:8080"))).expect("written");
        run(arguments(Some("atlas"), None)).expect("written");
        let settings = Settings::read(dir.path()).expect("read");
        assert_eq!(settings.server.as_deref(), Some("http://server:8080/"));
        assert_eq!(settings.name.expect("given").as_str(), "atlas");
        assert_eq!(settings.labels.expect("given").len(), 1);
        assert!(run(arguments(None, Some("nonsense"))).is_err());
    }
}
