//! What people may do: roles, and the permissions each of them is made of. Who has which role is
//! the server's to know.
//!
//! ```
//! use task_proto::person::{Permission, Roles};
//! let roles: Roles = "operator,publisher".parse()?;
//! assert!(roles.allow(Permission::Operate) && !roles.allow(Permission::Administer));
//! # Ok::<(), <Roles as std::str::FromStr>::Err>(())
//! ```

use std::collections::BTreeSet;
use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// What a route of the API, or a part of it, takes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum Permission {
    /// See robots, deployments, packages, logs and outputs, and pull packages.
    Read,
    /// Order what robots do.
    Operate,
    /// Push and delete packages.
    Publish,
    /// Change robots themselves: their names and labels, and whether they are there at all.
    Maintain,
    /// What concerns everybody: people and their tokens, enrolment, the list of publishers, the
    /// broker's files, the audit. Only ever for who is limited to no robots.
    Administer,
}

impl Permission {
    /// All there are.
    pub const ALL: [Self; 5] =
        [Self::Read, Self::Operate, Self::Publish, Self::Maintain, Self::Administer];

    /// Its name.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Read => "read",
            Self::Operate => "operate",
            Self::Publish => "publish",
            Self::Maintain => "maintain",
            Self::Administer => "administer",
        }
    }
}

impl fmt::Display for Permission {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

/// A fixed set of permissions.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum Role {
    /// Looks.
    Viewer,
    /// Looks and orders what robots do.
    Operator,
    /// Looks and pushes packages.
    Publisher,
    /// Does everything.
    Admin,
}

impl Role {
    /// All there are.
    pub const ALL: [Self; 4] = [Self::Viewer, Self::Operator, Self::Publisher, Self::Admin];

    /// Its name.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Viewer => "viewer",
            Self::Operator => "operator",
            Self::Publisher => "publisher",
            Self::Admin => "admin",
        }
    }

    /// What it allows.
    pub fn permissions(self) -> &'static [Permission] {
        match self {
            Self::Viewer => &[Permission::Read],
            Self::Operator => &[Permission::Read, Permission::Operate],
            Self::Publisher => &[Permission::Read, Permission::Publish],
            Self::Admin => &Permission::ALL,
        }
    }
}

impl fmt::Display for Role {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

/// A text that names no role.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "{given:?} is not a role: expected viewer, operator, publisher or admin, or several joined by commas"
)]
pub struct InvalidRole {
    given: String,
}

impl FromStr for Role {
    type Err = InvalidRole;
    fn from_str(text: &str) -> Result<Self, InvalidRole> {
        let found = Self::ALL.into_iter().find(|role| role.as_str() == text);
        found.ok_or_else(|| InvalidRole { given: text.chars().take(40).collect() })
    }
}

/// One role or several: who has several may do what any of them allows. On the wire a list of
/// names.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(value_type = Vec<Role>, min_items = 1))]
#[serde(try_from = "Vec<Role>", into = "Vec<Role>")]
pub struct Roles(BTreeSet<Role>);

impl Roles {
    /// Just one.
    pub fn one(role: Role) -> Self {
        Self(BTreeSet::from([role]))
    }

    /// Whether one of them allows it.
    pub fn allow(&self, permission: Permission) -> bool {
        self.0.iter().any(|role| role.permissions().contains(&permission))
    }

    /// What both allow, as the roles that are allowed by both: `None` if nothing is.
    pub fn within(&self, limit: &Self) -> Option<Self> {
        let is_allowed =
            |role: &&Role| role.permissions().iter().all(|&permission| limit.allow(permission));
        let common: BTreeSet<Role> = self.0.iter().filter(is_allowed).copied().collect();
        (!common.is_empty()).then_some(Self(common))
    }

    /// Each of them.
    pub fn iter(&self) -> impl Iterator<Item = Role> {
        self.0.iter().copied()
    }
}

impl TryFrom<Vec<Role>> for Roles {
    type Error = InvalidRole;
    fn try_from(roles: Vec<Role>) -> Result<Self, InvalidRole> {
        if roles.is_empty() {
            return Err(InvalidRole { given: String::new() });
        }
        Ok(Self(roles.into_iter().collect()))
    }
}

impl From<Roles> for Vec<Role> {
    fn from(roles: Roles) -> Self {
        roles.0.into_iter().collect()
    }
}

impl FromStr for Roles {
    type Err = InvalidRole;
    fn from_str(text: &str) -> Result<Self, InvalidRole> {
        text.split(',').map(|role| role.trim().parse()).collect::<Result<_, _>>().map(Self)
    }
}

impl fmt::Display for Roles {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (i, role) in self.0.iter().enumerate() {
            write!(f, "{}{role}", if i > 0 { "," } else { "" })?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn roles(text: &str) -> Roles {
        text.parse().expect("roles")
    }

    #[test]
    fn a_role_is_a_fixed_set_of_permissions() {
        let allowed = |text: &str| -> Vec<&str> {
            Permission::ALL
                .into_iter()
                .filter(|&p| roles(text).allow(p))
                .map(Permission::as_str)
                .collect()
        };
        assert_eq!(allowed("viewer"), ["read"]);
        assert_eq!(allowed("operator"), ["read", "operate"]);
        assert_eq!(allowed("publisher"), ["read", "publish"]);
        assert_eq!(allowed("operator,publisher"), ["read", "operate", "publish"]);
        assert_eq!(allowed("admin"), ["read", "operate", "publish", "maintain", "administer"]);
    }

    #[test]
    fn roles_within_others_never_allow_more() {
        let within = |one: &str, other: &str| {
            roles(one).within(&roles(other)).map(|found| found.to_string())
        };
        assert_eq!(within("viewer", "operator").as_deref(), Some("viewer"));
        assert_eq!(within("admin", "operator"), None);
        assert_eq!(within("operator,publisher", "publisher").as_deref(), Some("publisher"));
        assert_eq!(within("operator,publisher", "admin").as_deref(), Some("operator,publisher"));
        assert_eq!(within("operator", "viewer"), None);
    }

    #[test]
    fn roles_are_words_or_a_list() {
        assert_eq!(roles("publisher, operator").to_string(), "operator,publisher");
        for bad in ["", "root", "Admin", "viewer,", "viewer;admin"] {
            assert!(bad.parse::<Roles>().is_err(), "{bad:?}");
        }
        let wire: Roles = serde_json::from_str(r#"["admin","viewer"]"#).expect("roles");
        assert_eq!(serde_json::to_string(&wire).expect("json"), r#"["viewer","admin"]"#);
        assert!(serde_json::from_str::<Roles>("[]").is_err());
    }
}
