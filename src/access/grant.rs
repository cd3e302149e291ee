//! Scopes, the requirements of a request, and the decision whether it is allowed.

use std::collections::BTreeSet;
use std::fmt;
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::quantity::{shown, StructureId};

/// A right of a token.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
#[schema(as = TokenScope)]
pub enum Scope {
    /// Post batches.
    Ingest,
    /// Read everything except tokens, audit and other settings of the service.
    Read,
    /// Everything, including the other two.
    Admin,
}

impl Scope {
    /// All scopes.
    pub const ALL: [Self; 3] = [Self::Ingest, Self::Read, Self::Admin];

    /// Name as text.
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
        found.ok_or_else(|| format!("{} is not one of ingest, read, admin", shown(text)))
    }
}

/// A set of scopes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Scopes(u8);

impl Scopes {
    /// The scopes that were granted, without those that `admin` includes.
    pub fn iter(self) -> impl Iterator<Item = Scope> {
        Scope::ALL.into_iter().filter(move |scope| self.0 & bit(*scope) != 0)
    }

    /// No scope at all.
    pub const fn is_empty(self) -> bool {
        self.0 == 0
    }

    /// Whether a request that needs `scope` is allowed; `admin` includes all scopes.
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

/// The maker of a request.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub enum Actor {
    /// A user of this machine: the command line, or a client of an open service.
    Local,
    /// The holder of a token.
    Token {
        /// Its public id.
        id: String,
        /// Its name.
        name: String,
    },
    /// The client of a route that needs no token.
    Nobody,
}

impl Actor {
    /// Name of the maker in the audit and the log: the id of the token, `local` or `nobody`.
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

/// The rights of a request.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Grant {
    actor: Actor,
    scopes: Scopes,
    /// Structures to which it is limited; `None` means all.
    structures: Option<Arc<BTreeSet<StructureId>>>,
    /// Sources to which its posts are limited; `None` means all.
    sources: Option<Arc<BTreeSet<String>>>,
}

impl Grant {
    /// A grant of these scopes, for these structures and all sources.
    pub fn new(actor: Actor, scopes: Scopes, structures: Option<Arc<BTreeSet<StructureId>>>) -> Self {
        Self { actor, scopes, structures, sources: None }
    }

    /// The same grant, whose posts are limited to these sources; `None` means all.
    #[must_use]
    pub fn of_sources(self, sources: Option<Arc<BTreeSet<String>>>) -> Self {
        Self { sources, ..self }
    }

    /// The grant of a user of this machine: everything.
    pub fn local() -> Self {
        Self::new(Actor::Local, Scopes::from_iter([Scope::Admin]), None)
    }

    /// The grant of a request without a token: only routes that need none.
    pub fn nobody() -> Self {
        Self::new(Actor::Nobody, Scopes::default(), Some(Arc::default()))
    }

    /// The maker of the request.
    pub fn actor(&self) -> &Actor {
        &self.actor
    }

    /// The structures to which it is limited; `None` means all.
    pub fn structures(&self) -> Option<&BTreeSet<StructureId>> {
        self.structures.as_deref()
    }

    /// Whether a list may show this structure and the data that belong to it.
    pub fn may_see(&self, structure: &StructureId) -> bool {
        self.scopes.cover(Scope::Read) && self.reaches(structure.as_str())
    }

    /// Whether lists are shown in full.
    pub fn sees_all(&self) -> bool {
        self.scopes.cover(Scope::Read) && self.structures.is_none()
    }

    /// The source of a batch that its holder posts: the one that is `named`; without one, the only source that it may post under, otherwise
    /// `default`.
    ///
    /// # Errors
    /// [`Denied::Source`] if its posts are limited to other sources.
    pub fn source(&self, named: Option<String>, default: &str) -> Result<String, Denied> {
        let only = self.sources.as_ref().filter(|allowed| allowed.len() == 1).and_then(|allowed| allowed.first());
        let is_named = named.is_some();
        let source = named.or_else(|| only.cloned()).unwrap_or_else(|| default.to_owned());
        match &self.sources {
            Some(allowed) if !allowed.contains(&source) => {
                Err(Denied::Source { given: source, is_named, allowed: Arc::clone(allowed) })
            }
            _ => Ok(source),
        }
    }

    fn reaches(&self, structure: &str) -> bool {
        // Compared as text: an invalid structure id equals none of the allowed ones.
        self.structures.as_ref().is_none_or(|allowed| allowed.iter().any(|id| id.as_str() == structure))
    }
}

/// What a route requires.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Need {
    /// No token is needed.
    Nothing,
    /// A token with this scope.
    Scope(Scope),
}

/// What a request is about.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum About<'a> {
    /// One structure, by its id as it came.
    Structure(&'a str),
    /// A list that shows only structures that [`Grant::may_see`].
    Filtered,
    /// The whole service; refused to tokens that are limited to structures.
    Service,
}

/// Why a valid token may not make a request.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Denied {
    /// It does not have the scope.
    #[error("this request needs a token with the scope {needed}; this token has {}", listed(*.scopes))]
    Scope {
        /// The required scope.
        needed: Scope,
        /// The scopes of the token.
        scopes: Scopes,
    },
    /// It is limited to other structures.
    #[error("this token is limited to structures other than {}", shown(.structure))]
    Structure {
        /// The requested structure.
        structure: String,
    },
    /// It is limited to structures, and the request concerns the whole service.
    #[error("this request concerns the whole service, and this token is limited to certain structures")]
    WholeService,
    /// Its posts are limited to other sources.
    #[error("{}", other_source(.given, *.is_named, .allowed))]
    Source {
        /// The source of the batch.
        given: String,
        /// Whether the post has named it; otherwise it is that of posts that name none.
        is_named: bool,
        /// The sources to which posts with the token are limited.
        allowed: Arc<BTreeSet<String>>,
    },
}

/// Sources that a refusal names at most: a request with many batches repeats it for each of them.
const MOST_NAMED: usize = 10;

fn other_source(given: &str, is_named: bool, allowed: &BTreeSet<String>) -> String {
    let mut names: Vec<String> = allowed.iter().take(MOST_NAMED).map(|name| shown(name)).collect();
    if allowed.len() > MOST_NAMED {
        names.push(format!("and {} more", allowed.len() - MOST_NAMED));
    }
    let (names, given) = (names.join(", "), shown(given));
    let allowed = if allowed.len() == 1 { format!("the source {names}") } else { format!("the sources {names}") };
    if is_named {
        format!("with this token, only batches of {allowed} can be posted, and not of {given}")
    } else {
        format!(
            "with this token, only batches of {allowed} can be posted: name the source (a batch that names none is of \
             {given})"
        )
    }
}

fn listed(scopes: Scopes) -> String {
    let names: Vec<&str> = scopes.iter().map(Scope::as_str).collect();
    if names.is_empty() {
        "none".to_owned()
    } else {
        names.join(", ")
    }
}

/// Decides whether a request is allowed: first by scope, then by structure.
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

    /// The scopes of a token, and whether it is limited to the structure "mine"; then, for read, ingest and admin,
    /// whether a request about (mine, another structure, a list, the service) is allowed.
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
    fn a_missing_scope_is_reported_before_a_wrong_structure() {
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

    fn of_sources(sources: &[&str]) -> Grant {
        let sources = sources.iter().map(|&source| source.to_owned()).collect();
        grant(&[Scope::Ingest], None).of_sources(Some(Arc::new(sources)))
    }

    #[test]
    fn a_batch_has_the_source_that_its_token_may_post_under() {
        let source = |grant: &Grant, named: Option<&str>| grant.source(named.map(str::to_owned), "default");
        for free in [Grant::local(), grant(&[Scope::Ingest], Some(&["mine"]))] {
            assert_eq!(source(&free, Some("b")).unwrap(), "b");
            assert_eq!(source(&free, None).unwrap(), "default");
        }
        let one = of_sources(&["a"]);
        assert_eq!(source(&one, Some("a")).unwrap(), "a");
        assert_eq!(source(&one, None).unwrap(), "a", "the only source needs no name");
        for refused in ["b", "A", "", "default"] {
            assert!(matches!(source(&one, Some(refused)), Err(Denied::Source { is_named: true, .. })), "{refused}");
        }
        let two = of_sources(&["a", "c"]);
        assert_eq!(source(&two, Some("c")).unwrap(), "c");
        assert!(matches!(source(&two, None), Err(Denied::Source { is_named: false, .. })));
        assert_eq!(source(&of_sources(&["a", "default"]), None).unwrap(), "default");
        assert!(source(&of_sources(&[]), None).is_err(), "a token limited to no source posts nothing");
    }

    #[test]
    fn a_refused_source_is_told_with_the_allowed_ones() {
        let message = |grant: &Grant, named: Option<&str>| {
            grant.source(named.map(str::to_owned), "default").unwrap_err().to_string()
        };
        let named = message(&of_sources(&["a", "c"]), Some("b"));
        assert!(["\"a\", \"c\"", "not of \"b\""].iter().all(|part| named.contains(part)), "{named}");
        let without = message(&of_sources(&["a", "c"]), None);
        assert!(without.contains("name the source") && without.contains("\"default\""), "{without}");
        let many: Vec<String> = (0..100).map(|i| format!("{i:064}")).collect();
        let many: Vec<&str> = many.iter().map(String::as_str).collect();
        let long = message(&of_sources(&many), Some("b"));
        assert!(long.contains("and 90 more") && long.len() < 1_000, "{long}");
    }

    #[test]
    fn a_token_limited_to_no_structure_reaches_none() {
        let nothing = grant(&[Scope::Admin], Some(&[]));
        for about in [About::Structure("a"), About::Structure(""), About::Service] {
            assert!(allow(&nothing, Need::Scope(Scope::Read), about).is_err(), "{about:?}");
        }
    }
}
