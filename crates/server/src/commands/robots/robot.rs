//! `taskd robot`: shows, approves, changes, revokes and removes robots.

use std::str::FromStr;

use clap::{ArgGroup, Subcommand};
use task_proto::RobotName;
use task_proto::api::{
    BulkLabels, BulkRemove, EditRobot, MatchedRobot, MatchedRobots, PendingRobotList, RobotView,
};
use task_proto::id::{LabelKey, LabelValue, Labels};
use task_proto::selector::Selector;

use super::robot_settings::{Setting, changed};
use super::robot_view::{COLUMNS, PENDING, describe, pending_row, row};
use super::selection::{matched, matching, one};
use super::top;
use crate::commands::api::client::{nobody, random_key};
use crate::commands::api::complete;
use crate::commands::display::confirm::{always, confirm};
use crate::commands::display::output::{robots, say};
use crate::commands::display::view::print_matched;
use crate::commands::{CommandError, Outcome, Session};

/// Up to this number, changed robots are listed by name.
const MAX_NAMED: usize = 10;

/// What to do with robots.
#[derive(Debug, Subcommand)]
pub enum Action {
    /// List robots
    List {
        /// Which robots: *, names, label=value; commas separate alternatives, & joins conditions, !
        /// takes away
        #[arg(default_value = "*", add = complete::selectors())]
        selector: Selector,
    },
    /// Show everything about one robot
    Info {
        /// Its name or id
        #[arg(add = complete::robots())]
        robot: RobotName,
    },
    /// Change a robot's name or settings
    #[command(group = ArgGroup::new("change").required(true).multiple(true).args(["name", "settings", "unset"]))]
    Edit {
        /// Its name or id
        #[arg(add = complete::robots())]
        robot: RobotName,
        /// The name it has from now on
        #[arg(long, value_name = "NAME")]
        name: Option<RobotName>,
        /// A setting: underlays, workspace, ros_domain_id, forward_level or limits.…; what the
        /// robot has of its own in agent.toml wins; may be repeated
        #[arg(long = "set", value_name = "KEY=VALUE")]
        settings: Vec<Setting>,
        /// The key of a setting that the robot is to have no more from here; may be repeated
        #[arg(long, value_name = "KEY")]
        unset: Vec<String>,
    },
    /// Show processor, memory, disk and network of robots, the busiest first
    Top(top::TopOrder),
    /// Set labels of robots, or take them away: site=lab, and arm- for without
    Label {
        /// Which robots
        #[arg(add = complete::selectors())]
        selector: Selector,
        /// KEY=VALUE to set one, KEY- to take one away
        #[arg(required = true, value_name = "KEY=VALUE|KEY-")]
        labels: Vec<LabelChange>,
        /// Only list the robots that are meant
        #[arg(long)]
        dry_run: bool,
        /// Don't ask, however many robots are meant
        #[arg(short, long)]
        yes: bool,
    },
    /// List robots that wait to be approved
    Pending,
    /// Let robots in that wait
    Approve {
        /// Their names or ids
        #[arg(required = true)]
        robots: Vec<RobotName>,
    },
    /// Turn away a robot that waits, and forget it
    Reject {
        /// Its name or id
        robot: RobotName,
    },
    /// End a robot's tokens and whatever it does by them, now; it comes back only by enrolling with
    /// a token made for it
    Revoke {
        /// Its name or id
        #[arg(add = complete::robots())]
        robot: RobotName,
        /// Don't ask
        #[arg(short, long)]
        yes: bool,
    },
    /// Remove robots; their tokens end, their tasks run on but nothing new starts
    Rm {
        /// Which robots
        #[arg(add = complete::selectors())]
        selector: Selector,
        /// Only list the robots that are meant
        #[arg(long)]
        dry_run: bool,
        /// Don't ask
        #[arg(short, long)]
        yes: bool,
    },
}

/// A label that robots get, or lose.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum LabelChange {
    /// Sets the label to this value.
    Set(LabelKey, LabelValue),
    Remove(LabelKey),
}

impl FromStr for LabelChange {
    type Err = String;
    fn from_str(text: &str) -> Result<Self, String> {
        let invalid = |error: task_proto::id::InvalidId| error.to_string();
        match (text.split_once('='), text.strip_suffix('-')) {
            (Some((key, value)), _) => {
                Ok(Self::Set(key.parse().map_err(invalid)?, value.parse().map_err(invalid)?))
            }
            (None, Some(key)) => Ok(Self::Remove(key.parse().map_err(invalid)?)),
            (None, None) => {
                Err("expected KEY=VALUE to set a label, or KEY- to take it away".to_owned())
            }
        }
    }
}

pub(in crate::commands) async fn run(
    session: &Session,
    action: Action,
) -> Result<Outcome, CommandError> {
    match action {
        Action::List { selector } => {
            let list = matching(session, &selector).await?;
            session.output.result(&list, &COLUMNS, |list| list.robots.iter().map(row).collect())?;
            if !list.unknown.is_empty() {
                say(&nobody(&list.unknown));
                return Ok(Outcome::Failed);
            }
        }
        Action::Info { robot } => {
            let robot = one(session, &robot).await?.id;
            print(session, &session.client.get(&format!("/robots/{robot}"), &[]).await?)?;
        }
        Action::Edit { robot, name, settings, unset } => {
            let robot = one(session, &robot).await?;
            let settings = match settings.is_empty() && unset.is_empty() {
                true => None,
                false => Some(changed(robot.settings.as_ref(), &settings, &unset)?),
            };
            let edit = EditRobot { name, settings, ..EditRobot::default() };
            let robot: RobotView =
                session.client.change(&format!("/robots/{}", robot.id), &edit).await?;
            print(session, &robot)?;
        }
        Action::Top(order) => return top::run(session, order).await,
        Action::Label { selector, labels, dry_run, yes } => {
            label(session, selector, labels, dry_run, yes).await?
        }
        Action::Pending => {
            let list: PendingRobotList = session.client.get("/pending-robots", &[]).await?;
            session
                .output
                .result(&list, &PENDING, |list| list.robots.iter().map(pending_row).collect())?;
        }
        Action::Approve { robots } => {
            for robot in robots {
                let robot = one(session, &robot).await?;
                session.client.act(&format!("/robots/{}/approve", robot.id)).await?;
                say(&format!("approved {} ({})", robot.name, robot.id));
            }
        }
        Action::Reject { robot } => {
            let robot = one(session, &robot).await?;
            session.client.act(&format!("/robots/{}/reject", robot.id)).await?;
            say(&format!("rejected {} ({})", robot.name, robot.id));
        }
        Action::Revoke { robot, yes } => {
            let robot = one(session, &robot).await?;
            always(&format!("revoke the robot {}", robot.name), yes)?;
            session.client.act(&format!("/robots/{}/revoke", robot.id)).await?;
            say(&format!("revoked {} ({})", robot.name, robot.id));
            say(&format!(
                "it comes back with: taskd enroll-token create --uses 1 --robot {}",
                robot.name
            ));
        }
        Action::Rm { selector, dry_run, yes } => remove(session, selector, dry_run, yes).await?,
    }
    Ok(Outcome::Succeeded)
}

fn print(session: &Session, robot: &RobotView) -> Result<(), CommandError> {
    let name = |robot: &RobotView| robot.name.to_string();
    session.output.described(robot, name, |robot| describe(robot, &session.output))
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
        return Err(CommandError::Usage(format!("{key}: is to be set and taken away")));
    }
    let matched = matched(session, &selector).await?;
    if dry_run {
        return print_matched(session, &matched);
    }
    confirm(&format!("label {selector}"), matched.robots.len(), yes)?;
    let order = BulkLabels { selector, set, remove, dry_run: false };
    let done: MatchedRobots = session.client.order("/bulk/labels", &order, &random_key()).await?;
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
    let matched = matched(session, &selector).await?;
    if dry_run {
        return print_matched(session, &matched);
    }
    let what = match &matched.robots[..] {
        [robot] => format!("remove the robot {}", robot.name),
        many => format!("remove {} robots", many.len()),
    };
    always(&what, yes)?;
    let done = match &matched.robots[..] {
        [robot] => {
            session.client.delete(&format!("/robots/{}", robot.id)).await?;
            matched
        }
        _ => {
            // A robot that appears between the question and its answer was not shown.
            let selector = if yes { selector } else { those(&matched).unwrap_or(selector) };
            let order = BulkRemove { selector, dry_run: false };
            session.client.order("/bulk/remove", &order, &random_key()).await?
        }
    };
    match &done.robots[..] {
        few if few.len() <= MAX_NAMED => few.iter().for_each(say_removed),
        many => say(&format!("removed {}", robots(many.len() as u64))),
    }
    Ok(())
}

fn say_removed(robot: &MatchedRobot) {
    say(&format!("removed {} ({})", robot.name, robot.id));
}

/// A selector for exactly these robots; `None`: too many to list in a selector.
fn those(matched: &MatchedRobots) -> Option<Selector> {
    let ids: Vec<&str> = matched.robots.iter().map(|robot| robot.id.as_str()).collect();
    ids.join(",").parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn labels_are_set_and_taken_away() {
        let change = |text: &str| text.parse::<LabelChange>();
        assert_eq!(
            change("site=lab-"),
            Ok(LabelChange::Set("site".parse().expect("a key"), "lab-".parse().expect("a value")))
        );
        assert_eq!(change("arm-"), Ok(LabelChange::Remove("arm".parse().expect("a key"))));
        assert!(change("arm").is_err() && change("-").is_err() && change("=x").is_err());
    }
}
