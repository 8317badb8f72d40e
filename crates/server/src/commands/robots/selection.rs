//! Resolves a selector or a name to robots known to the server now. The robots are not changed.

use task_proto::RobotName;
use task_proto::api::{MatchedRobot, MatchedRobots, RobotList, RobotView};
use task_proto::selector::Selector;

use crate::commands::api::client::{nobody, unknown};
use crate::commands::{CommandError, Session};

/// The robots that `selector` matches now.
pub(in crate::commands) async fn matching(
    session: &Session,
    selector: &Selector,
) -> Result<RobotList, CommandError> {
    Ok(session.client.get("/robots", &[("selector", selector.to_string())]).await?)
}

/// The selected robots by name; an empty selection and an unknown name are mistakes in the command.
pub(in crate::commands) async fn matched(
    session: &Session,
    selector: &Selector,
) -> Result<MatchedRobots, CommandError> {
    let RobotList { robots, unknown, .. } = matching(session, selector).await?;
    if !unknown.is_empty() {
        return Err(CommandError::Usage(nobody(&unknown)));
    }
    if robots.is_empty() {
        return Err(CommandError::Usage(format!("{selector}: no robot matches")));
    }
    Ok(named(robots))
}

/// Robots as an order lists them.
pub(in crate::commands) fn named(robots: Vec<RobotView>) -> MatchedRobots {
    let matched =
        |robot: RobotView| MatchedRobot { id: robot.id, name: robot.name, online: robot.online };
    MatchedRobots { robots: robots.into_iter().map(matched).collect() }
}

/// The robot with this name or id.
pub(in crate::commands) async fn one(
    session: &Session,
    name: &RobotName,
) -> Result<RobotView, CommandError> {
    let selector =
        name.as_str().parse().map_err(|error| CommandError::Usage(format!("{error}")))?;
    let mut robots = matching(session, &selector).await?.robots;
    match robots.len() {
        0 => Err(unknown(name)),
        1 => Ok(robots.remove(0)),
        _ => Err(CommandError::Usage(format!(
            "{name} is the name of one robot and the id of another"
        ))),
    }
}
