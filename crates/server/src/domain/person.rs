//! The person behind a request: name, permissions, robots, and address. These are values only; the
//! store knows the holder of each token.

use std::fmt;
use std::net::IpAddr;

use task_proto::api::TokenOrigin;
use task_proto::ids::Labels;
use task_proto::ids::selector::Selector;
use task_proto::people::roles::{Permission, Role, Roles};
use task_proto::{RobotId, RobotName, TokenId, UserName};

/// The name that stands for the holder of the first token, the one in the data directory. No user
/// has this name.
const FIRST: &str = "operator.token";

/// The person behind a request.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Person {
    pub name: UserName,
    /// The roles that the presented token allows.
    pub roles: Roles,
    /// The robots within the person's rights.
    pub scope: Scope,
    pub token: TokenId,
    /// The origin of that token.
    pub origin: TokenOrigin,
    /// The address of the request; only known after admission.
    pub address: Option<IpAddr>,
}

impl Person {
    /// The holder of `token`, the first one: an administrator of everything.
    pub fn first(token: TokenId) -> Self {
        let (roles, scope, origin) =
            (Roles::one(Role::Admin), Scope::everything(), TokenOrigin::First);
        Self { name: first_name(), roles, scope, token, origin, address: None }
    }

    /// Whether this is the holder of the first token, and so no user.
    pub fn is_first(&self) -> bool {
        self.name.as_str() == FIRST
    }

    /// Whether this is the same person by the same token with the same rights, from any address.
    pub fn has_the_rights_of(&self, other: &Self) -> bool {
        let Self { name, roles, scope, token, origin, address: _ } = self;
        (name, roles, scope, token, origin)
            == (&other.name, &other.roles, &other.scope, &other.token, &other.origin)
    }

    /// Whether the person has the permission. A person who is limited to some robots has none for
    /// matters of all users.
    pub fn may(&self, permission: Permission) -> bool {
        self.roles.allow(permission)
            && (permission != Permission::Administer || self.scope.is_everything())
    }
}

/// The name of the holder of the first token.
pub fn first_name() -> UserName {
    FIRST.parse().expect("it has the form of a name")
}

/// A set of robots: those that match every selector, so all robots if there is none.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Scope(Vec<Selector>);

impl Scope {
    pub fn everything() -> Self {
        Self::default()
    }

    /// The robots that match all of these selectors.
    pub fn of(selectors: impl IntoIterator<Item = Selector>) -> Self {
        Self(selectors.into_iter().collect())
    }

    /// The robots of this scope that also match `selector`, if there is one.
    pub fn and(&self, selector: Option<&Selector>) -> Self {
        Self(self.0.iter().chain(selector).cloned().collect())
    }

    /// Whether the scope has no limit.
    pub fn is_everything(&self) -> bool {
        self.0.is_empty()
    }

    /// Whether the scope contains this robot.
    pub fn covers(&self, id: &RobotId, name: &RobotName, labels: &Labels) -> bool {
        self.0.iter().all(|selector| selector.matches(id, name, labels))
    }

    /// The selectors of the scope.
    pub fn selectors(&self) -> &[Selector] {
        &self.0
    }
}

impl fmt::Display for Scope {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.is_everything() {
            return f.write_str("*");
        }
        for (i, selector) in self.0.iter().enumerate() {
            write!(f, "{}{selector}", if i > 0 { " and " } else { "" })?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn selector(text: &str) -> Selector {
        text.parse().expect("a selector")
    }

    #[test]
    fn limited_person_may_not_administer() {
        let mut person = Person::first("0123456789ab".parse().expect("an id"));
        assert!(
            person.is_first()
                && Permission::ALL.into_iter().all(|permission| person.may(permission))
        );
        person.scope = Scope::of([selector("site=lab")]);
        assert!(person.may(Permission::Maintain) && !person.may(Permission::Administer));
    }

    #[test]
    fn scope_covers_robots_that_match_all_its_selectors() {
        let (id, name) = (RobotId::random(), "atlas".parse().expect("a name"));
        let labels: Labels =
            [("site".parse().expect("a key"), "lab".parse().expect("a value"))].into();
        let covers = |texts: &[&str]| {
            Scope::of(texts.iter().map(|text| selector(text))).covers(&id, &name, &labels)
        };
        assert!(
            covers(&[])
                && covers(&["*"])
                && covers(&["site=lab"])
                && covers(&["site=lab", "atlas"])
        );
        assert!(!covers(&["site=field"]) && !covers(&["site=lab", "boreas"]));
        assert_eq!(
            Scope::of([selector("site=lab"), selector("a,b")]).to_string(),
            "site=lab and a,b"
        );
    }
}
