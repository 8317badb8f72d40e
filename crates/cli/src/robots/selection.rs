//! Resolves a selector or a name to robots known to the server now. The robots are not changed.

use task_proto::RobotName;
use task_proto::api::{MatchedRobot, MatchedRobots, RobotList, RobotView};
use task_proto::ids::selector::Selector;

use crate::api::client::{no_such_robots, unknown_robot};
use crate::{CommandError, Session};

/// The robots that `selector` matches now.
pub(crate) async fn list_robots(
    session: &Session,
    selector: &Selector,
) -> Result<RobotList, CommandError> {
    Ok(session.client.get("/robots", &[("selector", selector.to_string())]).await?)
}

/// The selected robots by name; an empty selection and an unknown name are mistakes in the command.
pub(crate) async fn resolve_robots(
    session: &Session,
    selector: &Selector,
) -> Result<MatchedRobots, CommandError> {
    let RobotList { robots, unknown, .. } = list_robots(session, selector).await?;
    if !unknown.is_empty() {
        return Err(CommandError::Usage(no_such_robots(&unknown)));
    }
    if robots.is_empty() {
        return Err(CommandError::Usage(format!("no robots match {selector}")));
    }
    Ok(to_matched(robots))
}

/// Robots as an order lists them.
pub(crate) fn to_matched(robots: Vec<RobotView>) -> MatchedRobots {
    let matched =
        |robot: RobotView| MatchedRobot { id: robot.id, name: robot.name, online: robot.online };
    MatchedRobots { robots: robots.into_iter().map(matched).collect() }
}

/// The robot with this name or id.
pub(crate) async fn resolve_robot(
    session: &Session,
    name: &RobotName,
) -> Result<RobotView, CommandError> {
    let selector =
        name.as_str().parse().map_err(|error| CommandError::Usage(format!("{error}")))?;
    let mut robots = list_robots(session, &selector).await?.robots;
    match robots.len() {
        0 => Err(unknown_robot(name)),
        1 => Ok(robots.remove(0)),
        _ => Err(CommandError::Usage(format!(
            "{name} is ambiguous: the name of one robot and the id of another"
        ))),
    }
}
