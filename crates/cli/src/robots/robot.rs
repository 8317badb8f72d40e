//! `taskd robot`: shows, approves, changes, revokes and removes robots.

use std::str::FromStr;

use clap::{ArgGroup, Subcommand};
use task_proto::RobotName;
use task_proto::api::{
    BulkLabels, BulkRemove, EditRobot, MatchedRobot, MatchedRobots, PendingRobotList, RobotView,
};
use task_proto::ids::selector::Selector;
use task_proto::ids::{LabelKey, LabelValue, Labels};

use super::robot_settings::{Setting, apply_changes};
use super::robot_view::{COLUMNS, PENDING, describe, pending_row, row};
use super::selection::{list_robots, resolve_robot, resolve_robots};
use super::top;
use crate::api::client::{no_such_robots, random_key};
use crate::api::complete;
use crate::display::confirm::{confirm, confirm_irreversible};
use crate::display::output::{robots, say};
use crate::display::view::print_matched;
use crate::{CommandError, Outcome, Session};

/// Up to this number, changed robots are listed by name.
const MAX_NAMED: usize = 10;

#[derive(Debug, Subcommand)]
pub enum Action {
    /// List robots
    List {
        /// Robots: *, names or ids, label=value; a comma means or, & means and, ! excludes
        #[arg(default_value = "*", add = complete::selectors())]
        selector: Selector,
    },
    /// Show the details of a robot
    Info {
        /// Robot name or id
        #[arg(add = complete::robots())]
        robot: RobotName,
    },
    /// Change the name or the settings of a robot
    #[command(group = ArgGroup::new("change").required(true).multiple(true).args(["name", "settings", "unset"]))]
    Edit {
        /// Robot name or id
        #[arg(add = complete::robots())]
        robot: RobotName,
        /// New name
        #[arg(long, value_name = "NAME")]
        name: Option<RobotName>,
        /// Setting: underlays, workspace, ros_domain_id, forward_level or limits.…; the robot's own
        /// agent.toml takes precedence; may be repeated
        #[arg(long = "set", value_name = "KEY=VALUE")]
        settings: Vec<Setting>,
        /// Key of a setting to remove; may be repeated
        #[arg(long, value_name = "KEY")]
        unset: Vec<String>,
    },
    /// Show the processor, memory, disk and network load of robots, highest first
    Top(top::TopArgs),
    /// Set or remove labels of robots: site=lab sets, arm- removes
    Label {
        /// Robots: *, names or ids, label=value, !TERM to exclude
        #[arg(add = complete::selectors())]
        selector: Selector,
        /// KEY=VALUE to set a label, KEY- to remove it
        #[arg(required = true, value_name = "KEY=VALUE|KEY-")]
        labels: Vec<LabelChange>,
        /// Only list the matching robots
        #[arg(long)]
        dry_run: bool,
        /// Skip the confirmation prompt
        #[arg(short, long)]
        yes: bool,
    },
    /// List robots that await approval
    Pending,
    /// Approve robots that await approval
    Approve {
        /// Robot names or ids
        #[arg(required = true)]
        robots: Vec<RobotName>,
    },
    /// Reject a robot that awaits approval, and delete it
    Reject {
        /// Robot name or id
        robot: RobotName,
    },
    /// Revoke a robot's tokens and end its connections now; to return, it must enroll with a token
    /// created for it
    Revoke {
        /// Robot name or id
        #[arg(add = complete::robots())]
        robot: RobotName,
        /// Skip the confirmation prompt
        #[arg(short, long)]
        yes: bool,
    },
    /// Remove robots: their tokens are revoked, running tasks continue, nothing new starts
    Rm {
        /// Robots: *, names or ids, label=value, !TERM to exclude
        #[arg(add = complete::selectors())]
        selector: Selector,
        /// Only list the matching robots
        #[arg(long)]
        dry_run: bool,
        /// Skip the confirmation prompt
        #[arg(short, long)]
        yes: bool,
    },
}

/// A label to set or to remove.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum LabelChange {
    /// Sets the label to this value.
    Set(LabelKey, LabelValue),
    Remove(LabelKey),
}

impl FromStr for LabelChange {
    type Err = String;
    fn from_str(text: &str) -> Result<Self, String> {
        let invalid = |error: task_proto::ids::InvalidId| error.to_string();
        match (text.split_once('='), text.strip_suffix('-')) {
            (Some((key, value)), _) => {
                Ok(Self::Set(key.parse().map_err(invalid)?, value.parse().map_err(invalid)?))
            }
            (None, Some(key)) => Ok(Self::Remove(key.parse().map_err(invalid)?)),
            (None, None) => {
                Err("expected KEY=VALUE to set a label, or KEY- to remove it".to_owned())
            }
        }
    }
}

pub(crate) async fn run(session: &Session, action: Action) -> Result<Outcome, CommandError> {
    match action {
        Action::List { selector } => {
            let list = list_robots(session, &selector).await?;
            session
                .output
                .print_list(&list, &COLUMNS, |list| list.robots.iter().map(row).collect())?;
            if !list.unknown.is_empty() {
                say(&no_such_robots(&list.unknown));
                return Ok(Outcome::Failed);
            }
        }
        Action::Info { robot } => {
            let robot = resolve_robot(session, &robot).await?.id;
            print(session, &session.client.get(&format!("/robots/{robot}"), &[]).await?)?;
        }
        Action::Edit { robot, name, settings, unset } => {
            let robot = resolve_robot(session, &robot).await?;
            let settings = match settings.is_empty() && unset.is_empty() {
                true => None,
                false => Some(apply_changes(robot.settings.as_ref(), &settings, &unset)?),
            };
            let edit = EditRobot { name, settings, ..EditRobot::default() };
            let robot: RobotView =
                session.client.patch(&format!("/robots/{}", robot.id), &edit).await?;
            print(session, &robot)?;
        }
        Action::Top(args) => return top::run(session, args).await,
        Action::Label { selector, labels, dry_run, yes } => {
            label(session, selector, labels, dry_run, yes).await?
        }
        Action::Pending => {
            let list: PendingRobotList = session.client.get("/pending-robots", &[]).await?;
            session.output.print_list(&list, &PENDING, |list| {
                list.robots.iter().map(pending_row).collect()
            })?;
        }
        Action::Approve { robots } => {
            for robot in robots {
                let robot = resolve_robot(session, &robot).await?;
                session.client.post(&format!("/robots/{}/approve", robot.id)).await?;
                say(&format!("approved {} ({})", robot.name, robot.id));
            }
        }
        Action::Reject { robot } => {
            let robot = resolve_robot(session, &robot).await?;
            session.client.post(&format!("/robots/{}/reject", robot.id)).await?;
            say(&format!("rejected {} ({})", robot.name, robot.id));
        }
        Action::Revoke { robot, yes } => {
            let robot = resolve_robot(session, &robot).await?;
            confirm_irreversible(&format!("revoke robot {}", robot.name), yes)?;
            session.client.post(&format!("/robots/{}/revoke", robot.id)).await?;
            say(&format!("revoked {} ({})", robot.name, robot.id));
            say(&format!(
                "to enroll it again: taskd enroll-token create --uses 1 --robot {}",
                robot.name
            ));
        }
        Action::Rm { selector, dry_run, yes } => remove(session, selector, dry_run, yes).await?,
    }
    Ok(Outcome::Succeeded)
}

fn print(session: &Session, robot: &RobotView) -> Result<(), CommandError> {
    let name = |robot: &RobotView| robot.name.to_string();
    session.output.print_object(robot, name, |robot| describe(robot, &session.output))
}

async fn label(
    session: &Session,
    selector: Selector,
    changes: Vec<LabelChange>,
    dry_run: bool,
    yes: bool,
) -> Result<(), CommandError> {
    let (mut set, mut remove) = (Labels::default(), Vec::new());
    for change in changes {
        match change {
            LabelChange::Set(key, value) => drop(set.insert(key, value)),
            LabelChange::Remove(key) => remove.push(key),
        }
    }
    if let Some(key) = remove.iter().find(|key| set.contains_key(*key)) {
        return Err(CommandError::Usage(format!("{key}: can't be both set and removed")));
    }
    let matched = resolve_robots(session, &selector).await?;
    if dry_run {
        return print_matched(session, &matched);
    }
    confirm(&format!("label {selector}"), matched.robots.len(), yes)?;
    let order = BulkLabels { selector, set, remove, dry_run: false };
    let done: MatchedRobots =
        session.client.post_with_key("/bulk/labels", &order, &random_key()).await?;
    print_matched(session, &done)?;
    say(&format!("labelled {}", robots(done.robots.len() as u64)));
    Ok(())
}

async fn remove(
    session: &Session,
    selector: Selector,
    dry_run: bool,
    yes: bool,
) -> Result<(), CommandError> {
    let matched = resolve_robots(session, &selector).await?;
    if dry_run {
        return print_matched(session, &matched);
    }
    let what = match &matched.robots[..] {
        [robot] => format!("remove robot {}", robot.name),
        many => format!("remove {} robots", many.len()),
    };
    confirm_irreversible(&what, yes)?;
    let done = match &matched.robots[..] {
        [robot] => {
            session.client.delete(&format!("/robots/{}", robot.id)).await?;
            matched
        }
        _ => {
            // A robot that appears between the question and its answer was not shown.
            let selector = if yes { selector } else { selector_of(&matched).unwrap_or(selector) };
            let order = BulkRemove { selector, dry_run: false };
            session.client.post_with_key("/bulk/remove", &order, &random_key()).await?
        }
    };
    match &done.robots[..] {
        few if few.len() <= MAX_NAMED => few.iter().for_each(report_removed),
        many => say(&format!("removed {}", robots(many.len() as u64))),
    }
    Ok(())
}

fn report_removed(robot: &MatchedRobot) {
    say(&format!("removed {} ({})", robot.name, robot.id));
}

/// A selector for exactly these robots; `None`: too many to list in a selector.
fn selector_of(matched: &MatchedRobots) -> Option<Selector> {
    let ids: Vec<&str> = matched.robots.iter().map(|robot| robot.id.as_str()).collect();
    ids.join(",").parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn labels_are_set_and_removed() {
        let change = |text: &str| text.parse::<LabelChange>();
        assert_eq!(
            change("site=lab-"),
            Ok(LabelChange::Set("site".parse().expect("a key"), "lab-".parse().expect("a value")))
        );
        assert_eq!(change("arm-"), Ok(LabelChange::Remove("arm".parse().expect("a key"))));
        assert!(change("arm").is_err() && change("-").is_err() && change("=x").is_err());
    }
}
