//! Roles and their permissions. The server assigns roles to users.
//!
//! ```
//! use task_proto::people::roles::{Permission, Roles};
//! let roles: Roles = "operator,publisher".parse()?;
//! assert!(roles.allow(Permission::Operate) && !roles.allow(Permission::Administer));
//! # Ok::<(), <Roles as std::str::FromStr>::Err>(())
//! ```

use std::collections::BTreeSet;
use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// Permission that an API route, or a part of it, requires.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum Permission {
    /// See robots, deployments, packages, logs and outputs, and pull packages.
    Read,
    /// Order deployments and task actions on robots.
    Operate,
    /// Push and delete packages.
    Publish,
    /// Change robots: their names and labels, and remove them.
    Maintain,
    /// Manage matters of all users: people and their tokens, enrollment, the list of publishers,
    /// the broker's files, the audit. Only for users who may see all robots.
    Administer,
}

impl Permission {
    /// Every permission.
    pub const ALL: [Self; 5] =
        [Self::Read, Self::Operate, Self::Publish, Self::Maintain, Self::Administer];

    /// The permission's name.
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
    /// May read.
    Viewer,
    /// May read and order actions on robots.
    Operator,
    /// May read and push packages.
    Publisher,
    /// Has every permission.
    Admin,
}

impl Role {
    /// Every role.
    pub const ALL: [Self; 4] = [Self::Viewer, Self::Operator, Self::Publisher, Self::Admin];

    /// The role's name.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Viewer => "viewer",
            Self::Operator => "operator",
            Self::Publisher => "publisher",
            Self::Admin => "admin",
        }
    }

    /// Permissions of the role.
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
    "{given:?} is not a role: \
     expected viewer, operator, publisher or admin, or several separated by commas"
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

/// One or more roles, which combine their permissions. On the wire, a list of names.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(
    feature = "openapi",
    derive(utoipa::ToSchema),
    schema(value_type = Vec<Role>, min_items = 1)
)]
#[serde(try_from = "Vec<Role>", into = "Vec<Role>")]
pub struct Roles(BTreeSet<Role>);

impl Roles {
    /// A set of one role.
    pub fn one(role: Role) -> Self {
        Self(BTreeSet::from([role]))
    }

    /// Whether at least one of the roles has this permission.
    pub fn allow(&self, permission: Permission) -> bool {
        self.0.iter().any(|role| role.permissions().contains(&permission))
    }

    /// The roles of this set with no permission beyond `limit`: `None` if there are none.
    pub fn within(&self, limit: &Self) -> Option<Self> {
        let is_allowed =
            |role: &&Role| role.permissions().iter().all(|&permission| limit.allow(permission));
        let common: BTreeSet<Role> = self.0.iter().filter(is_allowed).copied().collect();
        (!common.is_empty()).then_some(Self(common))
    }

    /// Each of the roles.
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
    fn role_is_a_fixed_set_of_permissions() {
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
