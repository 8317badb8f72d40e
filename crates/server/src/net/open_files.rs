//! The process's limit on open files, and the number of connections within that limit.

use nix::sys::resource::{Resource, getrlimit, setrlimit};

use crate::config::Config;

/// Open files besides connections: the database, blobs in transfer, the operating system's own.
pub const OTHER_FILES: usize = 500;
/// Minimum limit: with fewer files, too few connections remain to be useful.
pub const MIN_FILES: usize = 1024;

/// The operating system grants too few open files.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error(
    "only {allowed} files may be open, {needed} are needed: raise the limit (LimitNOFILE={needed} or more in the unit, \
     ulimit -n {needed} in the shell)"
)]
pub struct TooFewFiles {
    pub allowed: usize,
    pub needed: usize,
}

/// Raises the process's limit to the maximum that the operating system grants, and returns it.
/// Usually only 1,024 are available without raising.
pub fn raise() -> nix::Result<usize> {
    let (allowed, max) = getrlimit(Resource::RLIMIT_NOFILE)?;
    if allowed < max {
        setrlimit(Resource::RLIMIT_NOFILE, max, max)?;
    }
    Ok(usize::try_from(max).unwrap_or(usize::MAX))
}

/// The number of files needed for all connections that the settings permit.
pub fn files_needed(config: &Config) -> usize {
    config
        .max_http_connections
        .saturating_add(config.max_mqtt_connections)
        .saturating_add(OTHER_FILES)
}

/// Refuses a limit with which the server could serve hardly any client.
pub fn check(config: &Config, allowed: usize) -> Result<(), TooFewFiles> {
    let needed = files_needed(config).min(MIN_FILES);
    if allowed < needed { Err(TooFewFiles { allowed, needed }) } else { Ok(()) }
}

/// Reserves files for the database and blobs, and prefers robots' sessions to HTTP requests, which
/// come and go.
pub fn fit(config: &mut Config, allowed: usize) -> Result<(), TooFewFiles> {
    check(config, allowed)?;
    if files_needed(config) <= allowed {
        return Ok(());
    }
    let room = allowed - OTHER_FILES;
    config.max_http_connections = config.max_http_connections.min(room / 3);
    config.max_mqtt_connections =
        config.max_mqtt_connections.min(room - config.max_http_connections);
    let (http, mqtt) = (config.max_http_connections, config.max_mqtt_connections);
    tracing::warn!(
        files = allowed,
        http,
        mqtt,
        "the limit on open files is low, so fewer connections are allowed; see ulimit -n"
    );
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn config(http: usize, mqtt: usize) -> Config {
        let data = std::path::PathBuf::from("/nowhere");
        Config { max_http_connections: http, max_mqtt_connections: mqtt, ..Config::with_data(data) }
    }

    #[test]
    fn connections_are_fitted_to_the_limit_and_too_low_a_limit_is_refused() {
        let fitted = |http, mqtt, allowed| {
            let mut config = config(http, mqtt);
            fit(&mut config, allowed)
                .map(|()| (config.max_http_connections, config.max_mqtt_connections))
        };
        assert_eq!(fitted(20_000, 20_000, 40_500), Ok((20_000, 20_000)));
        assert_eq!(fitted(20_000, 20_000, 1024), Ok((174, 350)));
        assert_eq!(fitted(20_000, 20_000, 1023), Err(TooFewFiles { allowed: 1023, needed: 1024 }));
        assert_eq!(fitted(10, 10, 520), Ok((10, 10)));
        assert_eq!(fitted(10, 10, 519), Err(TooFewFiles { allowed: 519, needed: 520 }));
    }
}
