//! Scopes, what a request needs, and the decision.

use std::collections::BTreeSet;
use std::fmt;
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::quantity::StructureId;

/// What a token is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
#[schema(as = TokenScope)]
pub enum Scope {
    /// Post batches.
    Ingest,
    /// Read everything but tokens, audit and other settings of the service.
    Read,
    /// Everything, the other two included.
    Admin,
}

impl Scope {
    /// All scopes.
    pub const ALL: [Self; 3] = [Self::Ingest, Self::Read, Self::Admin];

    /// As it is written.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Ingest => "ingest",
            Self::Read => "read",
            Self::Admin => "admin",
        }
    }
}

impl fmt::Display for Scope {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

impl std::str::FromStr for Scope {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let found = Self::ALL.into_iter().find(|scope| scope.as_str() == text);
        found.ok_or_else(|| format!("{} is none of ingest, read, admin", crate::quantity::shown(text)))
    }
}

/// A set of scopes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Scopes(u8);

impl Scopes {
    /// The scopes that were given, without what `admin` includes.
    pub fn iter(self) -> impl Iterator<Item = Scope> {
        Scope::ALL.into_iter().filter(move |scope| self.0 & bit(*scope) != 0)
    }

    /// No scope at all.
    pub const fn is_empty(self) -> bool {
        self.0 == 0
    }

    /// Whether a request that needs `scope` is covered; `admin` covers all.
    pub const fn cover(self, scope: Scope) -> bool {
        self.0 & (bit(scope) | bit(Scope::Admin)) != 0
    }
}

impl FromIterator<Scope> for Scopes {
    fn from_iter<I: IntoIterator<Item = Scope>>(scopes: I) -> Self {
        Self(scopes.into_iter().fold(0, |set, scope| set | bit(scope)))
    }
}

const fn bit(scope: Scope) -> u8 {
    match scope {
        Scope::Ingest => 1,
        Scope::Read => 2,
        Scope::Admin => 4,
    }
}

/// Who makes a request.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub enum Actor {
    /// Somebody on this machine: the command line, or a client of an open service.
    Local,
    /// The holder of a token.
    Token {
        /// Its public id.
        id: String,
        /// Its name.
        name: String,
    },
    /// Somebody who asks for what needs no token.
    Nobody,
}

impl Actor {
    /// As the audit and the log write it.
    pub fn as_str(&self) -> &str {
        match self {
            Self::Local => "local",
            Self::Token { id, .. } => id,
            Self::Nobody => "nobody",
        }
    }

    /// Name of the token.
    pub fn name(&self) -> Option<&str> {
        match self {
            Self::Token { name, .. } => Some(name),
            Self::Local | Self::Nobody => None,
        }
    }
}

/// What the maker of a request may do.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Grant {
    actor: Actor,
    scopes: Scopes,
    /// The only structures; `None` stands for all.
    structures: Option<Arc<BTreeSet<StructureId>>>,
}

impl Grant {
    /// Of a token.
    pub fn new(actor: Actor, scopes: Scopes, structures: Option<Arc<BTreeSet<StructureId>>>) -> Self {
        Self { actor, scopes, structures }
    }

    /// Everything, on this machine.
    pub fn local() -> Self {
        Self::new(Actor::Local, Scopes::from_iter([Scope::Admin]), None)
    }

    /// Nothing but what needs no token.
    pub fn nobody() -> Self {
        Self::new(Actor::Nobody, Scopes::default(), Some(Arc::default()))
    }

    /// Who it is.
    pub fn actor(&self) -> &Actor {
        &self.actor
    }

    /// Whether a list may show this structure, and what hangs on it.
    pub fn may_see(&self, structure: &StructureId) -> bool {
        self.scopes.cover(Scope::Read) && self.reaches(structure.as_str())
    }

    /// Whether nothing has to be left out of a list.
    pub fn sees_all(&self) -> bool {
        self.scopes.cover(Scope::Read) && self.structures.is_none()
    }

    fn reaches(&self, structure: &str) -> bool {
        // Compared as text: what is no structure id is none of those allowed.
        self.structures.as_ref().is_none_or(|allowed| allowed.iter().any(|id| id.as_str() == structure))
    }
}

/// What a route asks for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Need {
    /// Anybody may.
    Nothing,
    /// A token with this scope.
    Scope(Scope),
}

/// What a request is about.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum About<'a> {
    /// One structure, by its id as it came.
    Structure(&'a str),
    /// A list that shows only what [`Grant::may_see`].
    Filtered,
    /// The whole service: not for tokens limited to structures.
    Service,
}

/// Why a known token may not do what it asked for.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Denied {
    /// It lacks the scope.
    #[error("this needs a token with the scope {needed}; this one has {}", listed(*.scopes))]
    Scope {
        /// The scope.
        needed: Scope,
        /// Those it has.
        scopes: Scopes,
    },
    /// It is limited to other structures.
    #[error("this token is limited to other structures than {}", crate::quantity::shown(.structure))]
    Structure {
        /// The structure asked for.
        structure: String,
    },
    /// It is limited to structures, and this concerns all.
    #[error("this concerns the whole service, and this token is limited to single structures")]
    WholeService,
}

fn listed(scopes: Scopes) -> String {
    let names: Vec<&str> = scopes.iter().map(Scope::as_str).collect();
    if names.is_empty() {
        "none".to_owned()
    } else {
        names.join(", ")
    }
}

/// The decision: scope first, then structure.
///
/// # Errors
/// [`Denied`] with the reason.
pub fn allow(grant: &Grant, need: Need, about: About<'_>) -> Result<(), Denied> {
    let Need::Scope(needed) = need else { return Ok(()) };
    if !grant.scopes.cover(needed) {
        return Err(Denied::Scope { needed, scopes: grant.scopes });
    }
    match about {
        About::Filtered => Ok(()),
        About::Structure(id) if grant.reaches(id) => Ok(()),
        About::Structure(id) => Err(Denied::Structure { structure: id.to_owned() }),
        About::Service if grant.structures.is_none() => Ok(()),
        About::Service => Err(Denied::WholeService),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grant(scopes: &[Scope], structures: Option<&[&str]>) -> Grant {
        let structures = structures.map(|ids| ids.iter().map(|id| StructureId::parse(id).unwrap()).collect());
        let actor = Actor::Token { id: "t".to_owned(), name: "test".to_owned() };
        Grant::new(actor, scopes.iter().copied().collect(), structures.map(Arc::new))
    }

    /// Scopes, whether limited to "mine"; then what is allowed of (mine, other, list, service) for read, ingest, admin.
    type Row = (&'static [Scope], bool, [[bool; 4]; 3]);

    #[test]
    fn the_decision_is_this_table() {
        use Scope::{Admin, Ingest, Read};
        let mine = About::Structure("mine");
        let other = About::Structure("other");
        let all = [mine, other, About::Filtered, About::Service];
        let table: [Row; 10] = [
            (&[], false, [[false; 4]; 3]),
            (&[], true, [[false; 4]; 3]),
            (&[Read], false, [[true; 4], [false; 4], [false; 4]]),
            (&[Read], true, [[true, false, true, false], [false; 4], [false; 4]]),
            (&[Ingest], false, [[false; 4], [true; 4], [false; 4]]),
            (&[Ingest], true, [[false; 4], [true, false, true, false], [false; 4]]),
            (&[Ingest, Read], false, [[true; 4], [true; 4], [false; 4]]),
            (&[Ingest, Read], true, [[true, false, true, false], [true, false, true, false], [false; 4]]),
            (&[Admin], false, [[true; 4]; 3]),
            (&[Admin], true, [[true, false, true, false]; 3]),
        ];
        for (scopes, limited, expected) in table {
            let grant = grant(scopes, limited.then_some(&["mine"]));
            for (scope, expected) in [Read, Ingest, Admin].into_iter().zip(expected) {
                for (about, expected) in all.into_iter().zip(expected) {
                    let found = allow(&grant, Need::Scope(scope), about);
                    assert_eq!(found.is_ok(), expected, "{scopes:?}, limited {limited}: {scope} {about:?}: {found:?}");
                }
            }
            assert!(all.into_iter().all(|about| allow(&grant, Need::Nothing, about).is_ok()));
        }
    }

    #[test]
    fn a_missing_scope_is_named_before_the_structure() {
        let denied = allow(&grant(&[Scope::Ingest], Some(&["a"])), Need::Scope(Scope::Read), About::Structure("b"));
        assert!(matches!(denied, Err(Denied::Scope { needed: Scope::Read, .. })), "{denied:?}");
    }

    #[test]
    fn lists_show_what_may_be_read() {
        let (a, b) = (StructureId::parse("a").unwrap(), StructureId::parse("b").unwrap());
        let reader = grant(&[Scope::Read], Some(&["a"]));
        assert!(reader.may_see(&a) && !reader.may_see(&b) && !reader.sees_all());
        assert!(!grant(&[Scope::Ingest], None).may_see(&a), "an ingest token reads nothing");
        assert!(!Grant::nobody().may_see(&a) && !Grant::nobody().sees_all());
        assert!(Grant::local().may_see(&b) && Grant::local().sees_all());
    }

    #[test]
    fn a_token_limited_to_no_structure_reaches_none() {
        let nothing = grant(&[Scope::Admin], Some(&[]));
        for about in [About::Structure("a"), About::Structure(""), About::Service] {
            assert!(allow(&nothing, Need::Scope(Scope::Read), about).is_err(), "{about:?}");
        }
    }
}
