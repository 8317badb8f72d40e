//! The effective settings, in the form that the effects use. They are rebuilt when the server sends
//! other settings.

use std::collections::BTreeMap;
use std::sync::{Arc, PoisonError};
use std::time::Duration;

use task_proto::desired::settings::{EffectiveSettings, RobotSettings};
use tokio::sync::watch;

use super::Robot;
use crate::config::Config;
use crate::config::settings::{MergedSettings, merge_settings};
use crate::install::builder::BuildLimits;
use crate::logs::forwarder::ForwardSettings;
use crate::process::cgroup::RunLimits;
use crate::setup::environment;
use crate::setup::installation::Installation;
use crate::setup::underlay;

/// The maximum bytes of output files per run, unless the robot's settings say otherwise.
const OUTPUT_BYTES: u64 = 4 << 30;

/// The effective settings, and the values derived from them.
pub(super) struct ResolvedSettings {
    /// The settings made at the server.
    pub(super) set: RobotSettings,
    pub(super) config: Config,
    /// The settings as reported.
    pub(super) effective: Option<EffectiveSettings>,
    pub(super) environment: BTreeMap<String, String>,
    pub(super) build_limits: BuildLimits,
    pub(super) task_limits: RunLimits,
    pub(super) output_bytes: u64,
}

impl ResolvedSettings {
    /// Combines a robot's `own` settings with those `set` at the server.
    pub(super) fn of(own: &Config, set: RobotSettings) -> Arc<Self> {
        let MergedSettings { config, effective } = merge_settings(own, &set);
        let mut variables: BTreeMap<String, String> = environment::ROS_VARIABLES
            .iter()
            .filter_map(|name| Some(((*name).to_owned(), std::env::var(name).ok()?)))
            .collect();
        variables
            .extend(config.ros_domain_id.map(|id| ("ROS_DOMAIN_ID".to_owned(), id.to_string())));
        let mut build_limits = BuildLimits::of_this_machine();
        if let Some(timeout_s) = config.limits.build_timeout_s {
            build_limits.timeout = Duration::from_secs(timeout_s);
        }
        build_limits.memory_bytes = config.limits.build_memory_bytes.or(build_limits.memory_bytes);
        build_limits.pids = Some(config.task_pids);
        let memory_bytes = config.limits.task_memory_mb.map(|megabytes| megabytes << 20);
        Arc::new(Self {
            set,
            environment: environment::robot_environment(&variables),
            build_limits,
            task_limits: RunLimits {
                memory_bytes,
                pids: Some(config.task_pids),
                ..RunLimits::default()
            },
            output_bytes: config.limits.output_bytes.unwrap_or(OUTPUT_BYTES),
            config,
            effective,
        })
    }

    /// The ROS installations found by these settings.
    pub(super) fn installations(&self) -> Vec<Installation> {
        underlay::by_settings(&self.config.underlays, self.config.workspace.as_deref())
    }
}

impl Robot {
    /// The settings for forwarding log lines to the server, now and after each change.
    pub fn forward(&self) -> watch::Receiver<ForwardSettings> {
        self.forward.subscribe()
    }

    pub(super) fn resolved(&self) -> Arc<ResolvedSettings> {
        self.resolved.read().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Adopts the settings made at the server. Running tasks keep the settings of their start.
    pub(super) fn adopt(&self, set: &RobotSettings) {
        let before = self.resolved();
        if before.set == *set {
            return;
        }
        let resolved = ResolvedSettings::of(&self.own, set.clone());
        let (own, refused) = resolved
            .effective
            .as_ref()
            .map(|e| (e.own.join(", "), e.refused.join(", ")))
            .unwrap_or_default();
        tracing::info!(own, "settings from the server in effect");
        if !refused.is_empty() {
            tracing::warn!(refused, "settings from the server are refused");
        }
        self.fetcher.limit(&resolved.config.limits);
        self.graph.limit(resolved.config.limits.log_bytes);
        self.forward.send_replace(resolved.config.forward);
        let same_ros = resolved.config.underlays == before.config.underlays
            && resolved.config.workspace == before.config.workspace;
        *self.resolved.write().unwrap_or_else(PoisonError::into_inner) = resolved;
        if !same_ros {
            self.find_installations();
        }
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt as _;

    use serde_json::json;
    use task_proto::DeploymentId;

    use super::super::tests::robot;
    use crate::task::effects::Effects as _;
    use crate::task::ledger::{GateQuestion, GateStep};

    #[tokio::test]
    async fn gate_gets_the_ros_domain_the_name_and_the_labels_of_the_server() {
        let temp = tempfile::tempdir().expect("a directory");
        let program = temp.path().join("gate.sh");
        std::fs::write(&program, "#!/bin/sh\necho \"$ROS_DOMAIN_ID $TASKD_ROBOT $TASKD_LABEL_SITE $TASKD_TASK\"\nexit 1\n")
            .expect("written");
        std::fs::set_permissions(&program, std::fs::Permissions::from_mode(0o755))
            .expect("executable");
        let robot = robot(temp.path(), &format!("[gate]\ncommand = [{program:?}]\n"));
        robot.adopt(&serde_json::from_value(json!({ "ros_domain_id": 7 })).expect("parses"));
        robot.describe(
            &serde_json::from_value(json!({"name": "atlas", "labels": {"site": "lab"}}))
                .expect("parses"),
        );
        let question = GateQuestion {
            step: GateStep::Start,
            deployment: DeploymentId::random(),
            run: 1,
            version: "1.0".parse().expect("valid"),
        };
        let refused =
            robot.query_gate(&"talker".parse().expect("valid"), &question).await.expect_err("no");
        assert_eq!(refused.failure.text, "7 atlas lab talker");
    }
}
