//! A launch file and arguments from `taskd run`, in place of a package's own `[run]`. They become
//! part of the manifest, so that everything that ran on a robot is pinned by its digest.

use std::collections::BTreeMap;

use task_proto::packages::manifest::{Ready, Run, TaskManifest};

/// A launch file and its arguments.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Launch {
    /// The ROS package of the file; absent: that of the manifest's own launch file, otherwise the
    /// package named like the manifest.
    pub ros_package: Option<String>,
    /// The file's name in that package.
    pub file: String,
    /// Launch arguments by name.
    pub arguments: BTreeMap<String, String>,
}

impl Launch {
    /// The manifest with this launch file.
    pub fn apply_to(&self, mut manifest: TaskManifest) -> TaskManifest {
        let name = manifest.name.to_string();
        self.apply(&mut manifest.run, &mut manifest.ready, &name);
        manifest
    }

    /// The package's own arguments stay if the launch file is the package's own; given arguments
    /// override them. The package's promises about its graph hold for its own launch file alone.
    pub(super) fn apply(&self, run: &mut Run, ready: &mut Ready, name: &str) {
        let own = run.launch.take();
        let ros_package =
            self.ros_package.clone().or_else(|| own.as_ref().map(|[package, _]| package.clone()));
        let launch = [ros_package.unwrap_or_else(|| name.to_owned()), self.file.clone()];
        if own.as_ref() != Some(&launch) {
            run.args.clear();
            *ready = Ready::default();
        }
        run.exec = None;
        run.launch = Some(launch);
        run.args.extend(self.arguments.clone());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn launch(file: &str) -> Launch {
        let arguments = [("rate".to_owned(), "5".to_owned())].into();
        Launch { ros_package: None, file: file.to_owned(), arguments }
    }

    fn own() -> (Run, Ready) {
        let args = [("rate", "1"), ("map", "m")]
            .map(|(key, value)| (key.to_owned(), value.to_owned()))
            .into();
        let run = Run {
            launch: Some(["say".to_owned(), "own.launch.py".to_owned()]),
            args,
            ..Run::default()
        };
        (run, Ready { nodes: vec!["/talker".to_owned()], ..Ready::default() })
    }

    #[test]
    fn own_launch_file_keeps_arguments_that_are_not_overridden() {
        let (mut run, mut ready) = own();
        launch("own.launch.py").apply(&mut run, &mut ready, "talker");
        assert_eq!(
            run.args.iter().map(|(k, v)| format!("{k}:={v}")).collect::<Vec<_>>(),
            ["map:=m", "rate:=5"]
        );
        assert_eq!(ready.nodes, ["/talker"]);
    }

    #[test]
    fn other_launch_file_replaces_arguments_and_readiness() {
        let (mut run, mut ready) = own();
        launch("other.launch.py").apply(&mut run, &mut ready, "talker");
        assert_eq!(run.launch, Some(["say".to_owned(), "other.launch.py".to_owned()]));
        assert_eq!((run.args.len(), ready), (1, Ready::default()));
        let (mut run, mut ready) =
            (Run { exec: Some(vec!["x".to_owned()]), ..Run::default() }, Ready::default());
        launch("a.launch.py").apply(&mut run, &mut ready, "talker");
        assert_eq!(
            (run.launch.map(|[package, _]| package), run.exec),
            (Some("talker".to_owned()), None)
        );
    }
}
