//! The form of a program's own log: lines for people, or a JSON document on each line for programs.
//! Decides which, and writes nothing.

use std::fs::File;
use std::os::fd::AsFd as _;
use std::os::unix::fs::MetadataExt as _;
use std::str::FromStr;

/// The setting.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum LogFormat {
    /// JSON if the log goes to systemd's journal, else text.
    #[default]
    Auto,
    /// Lines for people.
    Text,
    /// One JSON document on each line.
    Json,
}

impl FromStr for LogFormat {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "auto" => Ok(Self::Auto),
            "text" => Ok(Self::Text),
            "json" => Ok(Self::Json),
            _ => Err(format!("{text:?} is none of \"auto\", \"text\" and \"json\"")),
        }
    }
}

impl LogFormat {
    /// Whether to write JSON to stderr.
    pub fn is_json_on_stderr(self) -> bool {
        let stream = std::io::stderr().as_fd().try_clone_to_owned().map(File::from);
        let stream = stream.and_then(|stream| stream.metadata()).ok();
        let stream = stream.map(|stream| (stream.dev(), stream.ino()));
        self.is_json(std::env::var("JOURNAL_STREAM").ok().as_deref(), stream)
    }

    /// `journal`: the variable `JOURNAL_STREAM`, by which systemd names the device and inode of the
    /// stream to its journal. `stream`: those of the log. A program that a service has started with
    /// its output elsewhere inherits the variable, so the two are compared.
    fn is_json(self, journal: Option<&str>, stream: Option<(u64, u64)>) -> bool {
        match self {
            Self::Text => false,
            Self::Json => true,
            Self::Auto => {
                let named = journal.and_then(|text| {
                    let (device, inode) = text.split_once(':')?;
                    Some((device.parse().ok()?, inode.parse().ok()?))
                });
                named.is_some() && named == stream
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn auto_is_json_only_on_the_stream_that_systemd_names() {
        assert!(LogFormat::Auto.is_json(Some("9:5163"), Some((9, 5163))));
        assert!(!LogFormat::Auto.is_json(Some("9:5163"), Some((9, 7))));
        assert!(!LogFormat::Auto.is_json(Some("journal"), None));
        assert!(!LogFormat::Auto.is_json(None, Some((9, 5163))));
        assert!(!LogFormat::Text.is_json(Some("9:5163"), Some((9, 5163))));
        assert!(LogFormat::Json.is_json(None, None));
    }
}
