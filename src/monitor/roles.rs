//! What a process does for a database: it serves, it computes, or both.

use std::fmt;

use serde::de::Error as _;
use serde::ser::SerializeSeq as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::quantity::shown;

/// What a process does. At least one of the two is true.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Roles {
    /// It serves the API, or stands by to do so.
    pub api: bool,
    /// It computes assessments of batches that wait, for whichever process serves.
    pub worker: bool,
}

/// A list of roles that cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum RolesError {
    /// A name that is no role.
    #[error("{0} is not a role: the roles are api and worker, and `api,worker` is both")]
    Unknown(String),
    /// No name at all.
    #[error("there must be at least one role: api, worker, or `api,worker` for both")]
    None,
}

impl Default for Roles {
    fn default() -> Self {
        Self::ALL
    }
}

impl Roles {
    /// All roles.
    pub const ALL: Self = Self { api: true, worker: true };

    /// The roles of some names.
    ///
    /// # Errors
    /// [`RolesError`].
    pub fn of<'t>(names: impl IntoIterator<Item = &'t str>) -> Result<Self, RolesError> {
        let mut roles = Self { api: false, worker: false };
        for name in names {
            match name.trim() {
                "api" => roles.api = true,
                "worker" => roles.worker = true,
                "" => {}
                other => return Err(RolesError::Unknown(shown(other))),
            }
        }
        if roles.api || roles.worker {
            Ok(roles)
        } else {
            Err(RolesError::None)
        }
    }

    fn names(self) -> Vec<&'static str> {
        [("api", self.api), ("worker", self.worker)].into_iter().filter_map(|(name, is)| is.then_some(name)).collect()
    }
}

impl fmt::Display for Roles {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.names().join(","))
    }
}

impl Serialize for Roles {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut list = serializer.serialize_seq(None)?;
        for name in self.names() {
            list.serialize_element(name)?;
        }
        list.end()
    }
}

/// From a list, or from a text with commas as on the command line.
impl<'de> Deserialize<'de> for Roles {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        #[derive(Deserialize)]
        #[serde(untagged)]
        enum Given {
            Text(String),
            List(Vec<String>),
        }
        let names = match Given::deserialize(deserializer) {
            Ok(Given::Text(text)) => text.split(',').map(str::to_owned).collect(),
            Ok(Given::List(names)) => names,
            Err(_) => return Err(D::Error::custom("roles must be a list of names, such as [\"api\", \"worker\"]")),
        };
        Self::of(names.iter().map(String::as_str)).map_err(D::Error::custom)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn roles_are_read_from_lists_and_texts_and_wrong_ones_are_named() {
        let read = |json: &str| serde_json::from_str::<Roles>(json).map_err(|error| error.to_string());
        let worker = Roles { api: false, worker: true };
        for (json, roles) in [
            (r#"["api", "worker"]"#, Roles::ALL),
            (r#""worker, api""#, Roles::ALL),
            (r#"["worker"]"#, worker),
            (r#""worker,""#, worker),
        ] {
            assert_eq!(read(json), Ok(roles), "{json}");
            assert_eq!(read(&serde_json::to_string(&roles).unwrap()), Ok(roles));
            assert_eq!(Roles::of(roles.to_string().split(',')), Ok(roles));
        }
        for (json, says) in [
            (r#""alarm""#, "\"alarm\" is not a role"),
            (r#"["api", "Worker"]"#, "\"Worker\" is not a role"),
            ("[]", "at least one role"),
            (r#"" , ""#, "at least one role"),
            ("3", "must be a list of names"),
        ] {
            let said = read(json).unwrap_err();
            assert!(said.contains(says), "{json}: {said}");
        }
    }
}
