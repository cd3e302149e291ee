//! A token: its text, its secret, and the record that the service stores.

use std::collections::BTreeSet;
use std::fmt;
use std::sync::Arc;

use data_encoding::BASE32_DNSSEC as BASE32;
use rand::rngs::OsRng;
use rand::TryRngCore as _;
use sha2::{Digest as _, Sha256};
use subtle::{Choice, ConstantTimeEq};

use super::grant::{Actor, Grant, Scope, Scopes};
use crate::measurement::check::{check_source, Problem};
use crate::quantity::{shown, StructureId, Timestamp};

/// Prefix of every token, by which tools that search for leaked secrets can find it.
const PREFIX: &str = "mw_";
/// Bytes of an id: 80 bits, 16 characters of base32 (`0–9 a–v`, the alphabet that sorts like its bytes).
const ID_BYTES: usize = 10;
/// Characters of an id.
const ID_LENGTH: usize = 16;
/// Bytes of a secret: 256 bits, 52 characters of base32.
const SECRET_BYTES: usize = 32;
/// Longest name of a token.
const LONGEST_NAME: usize = 100;
/// Largest number of structures to which a token can be limited.
const MOST_STRUCTURES: usize = 1_000;
/// Largest number of sources to which the posts with a token can be limited.
const MOST_SOURCES: usize = 100;

/// The operating system provided no random bytes.
#[derive(Debug, thiserror::Error)]
#[error("the operating system provided no random numbers: {0}")]
pub struct NoRandomness(String);

/// Text that is not a token. The error does not contain the text, which may be part of a secret.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("a token has the form mw_<16 characters>_<52 characters>")]
pub struct Malformed;

/// The public part of a token.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct TokenId(String);

impl TokenId {
    /// Checks an id.
    ///
    /// # Errors
    /// [`Malformed`] unless the text has 16 characters of base32.
    pub fn parse(text: &str) -> Result<Self, Malformed> {
        let valid = text.len() == ID_LENGTH && text.bytes().all(|b| matches!(b, b'0'..=b'9' | b'a'..=b'v'));
        valid.then(|| Self(text.to_owned())).ok_or(Malformed)
    }

    /// The id as text.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl fmt::Display for TokenId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// SHA-256 of a secret. It can be compared only in constant time.
#[derive(Clone, Copy)]
pub struct SecretDigest([u8; 32]);

impl SecretDigest {
    /// A digest that no known secret has, for comparisons with an unknown id.
    pub(super) const DUMMY: Self = Self([0; 32]);

    /// A digest that was read from the store.
    pub const fn from_stored(bytes: [u8; 32]) -> Self {
        Self(bytes)
    }

    /// Bytes to be stored.
    pub const fn as_bytes(&self) -> &[u8; 32] {
        &self.0
    }
}

impl ConstantTimeEq for SecretDigest {
    fn ct_eq(&self, other: &Self) -> Choice {
        self.0.ct_eq(&other.0)
    }
}

impl fmt::Debug for SecretDigest {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("SecretDigest(…)")
    }
}

/// A token with its secret. `Debug` does not show the secret.
pub struct TokenText {
    id: TokenId,
    secret: [u8; SECRET_BYTES],
}

impl TokenText {
    /// A new token from random numbers of the operating system.
    ///
    /// # Errors
    /// [`NoRandomness`].
    pub fn generate() -> Result<Self, NoRandomness> {
        let mut id = [0; ID_BYTES];
        OsRng.try_fill_bytes(&mut id).map_err(|e| NoRandomness(e.to_string()))?;
        Self::with_id(TokenId(BASE32.encode(&id)))
    }

    /// A new secret for an existing id.
    ///
    /// # Errors
    /// [`NoRandomness`].
    pub fn with_id(id: TokenId) -> Result<Self, NoRandomness> {
        let mut secret = [0; SECRET_BYTES];
        OsRng.try_fill_bytes(&mut secret).map_err(|e| NoRandomness(e.to_string()))?;
        Ok(Self { id, secret })
    }

    /// Parses a token that a client sent.
    ///
    /// # Errors
    /// [`Malformed`].
    pub fn parse(text: &str) -> Result<Self, Malformed> {
        let (id, secret) = text.strip_prefix(PREFIX).and_then(|rest| rest.split_once('_')).ok_or(Malformed)?;
        let id = TokenId::parse(id)?;
        let secret = BASE32.decode(secret.as_bytes()).map_err(|_| Malformed)?;
        Ok(Self { id, secret: secret.try_into().map_err(|_| Malformed)? })
    }

    /// The public part.
    pub fn id(&self) -> &TokenId {
        &self.id
    }

    /// Digest of the secret.
    pub fn digest(&self) -> SecretDigest {
        SecretDigest(Sha256::digest(self.secret).into())
    }

    /// The whole token, to be shown once to the client that created it.
    pub fn reveal(&self) -> String {
        format!("{PREFIX}{}_{}", self.id, BASE32.encode(&self.secret))
    }
}

impl fmt::Debug for TokenText {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{PREFIX}{}_…", self.id)
    }
}

/// Whether a text contains something that looks like a token. Such text should not be stored or logged.
pub fn token_like(text: &str) -> bool {
    let secret = |rest: &str| rest.split_once('_').is_some_and(|(id, _)| TokenId::parse(id).is_ok());
    text.match_indices(PREFIX).any(|(at, _)| secret(&text[at + PREFIX.len()..]))
}

/// Properties of a token to be created.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NewToken {
    /// Name for people.
    pub name: String,
    /// Scopes.
    pub scopes: Scopes,
    /// Structures to which it is limited; `None` means all.
    pub structures: Option<BTreeSet<StructureId>>,
    /// Sources to which its posts are limited; `None` means all.
    pub sources: Option<BTreeSet<String>>,
    /// When it expires.
    pub expires_at: Option<Timestamp>,
}

impl NewToken {
    /// Invalid properties by JSON pointer.
    pub fn problems(&self, now: Timestamp) -> Vec<Problem> {
        let mut problems = Vec::new();
        let length = self.name.chars().count();
        if !(1..=LONGEST_NAME).contains(&length) || self.name.chars().any(char::is_control) {
            let message = format!("{} must have 1 to {LONGEST_NAME} printable characters", shown(&self.name));
            problems.push(Problem::new("/name", message));
        }
        if token_like(&self.name) {
            problems.push(Problem::new("/name", "a name is public: it must not contain a token"));
        }
        if self.scopes.is_empty() {
            problems.push(Problem::new("/scopes", "name at least one of ingest, read, admin"));
        }
        if let Some(count) = self.structures.as_ref().map(BTreeSet::len) {
            if !(1..=MOST_STRUCTURES).contains(&count) {
                let message =
                    format!("{count} structures: name 1 to {MOST_STRUCTURES}, or leave the field out for all");
                problems.push(Problem::new("/structures", message));
            }
        }
        problems.extend(self.sources.as_ref().and_then(|sources| self.problem_of_sources(sources)));
        if let Some(expires_at) = self.expires_at.filter(|at| *at <= now) {
            problems.push(Problem::new("/expires_at", format!("{expires_at} is not in the future")));
        }
        problems
    }

    /// What is wrong with the sources to which the posts are limited.
    fn problem_of_sources(&self, sources: &BTreeSet<String>) -> Option<Problem> {
        let count = sources.len();
        let message = if !(1..=MOST_SOURCES).contains(&count) {
            format!("{count} sources: name 1 to {MOST_SOURCES}, or leave the field out for all")
        } else if let Some(problem) = sources.iter().find_map(|source| check_source(source).err()) {
            problem.message
        } else if self.scopes.cover(Scope::Admin) || !self.scopes.cover(Scope::Ingest) {
            "only a token with the scope ingest, and without admin, can be limited to sources: without ingest it posts \
             nothing, and with admin it may do everything"
                .to_owned()
        } else {
            return None;
        };
        Some(Problem::new("/sources", message))
    }

    /// The record to be stored, with the digest of the secret.
    pub fn record(self, text: &TokenText, now: Timestamp) -> TokenRecord {
        TokenRecord {
            id: text.id().clone(),
            name: self.name,
            scopes: self.scopes,
            structures: self.structures.map(Arc::new),
            sources: self.sources.map(Arc::new),
            digest: text.digest(),
            previous: None,
            created_at: now,
            expires_at: self.expires_at,
            revoked_at: None,
        }
    }
}

/// A token as the service stores it.
#[derive(Debug, Clone)]
pub struct TokenRecord {
    /// Public id.
    pub id: TokenId,
    /// Name for people.
    pub name: String,
    /// Scopes.
    pub scopes: Scopes,
    /// Structures to which it is limited; `None` means all.
    pub structures: Option<Arc<BTreeSet<StructureId>>>,
    /// Sources to which its posts are limited; `None` means all.
    pub sources: Option<Arc<BTreeSet<String>>>,
    /// Digest of its secret.
    pub digest: SecretDigest,
    /// Digest of the secret from before the last rotation, and until when it is valid.
    pub previous: Option<(SecretDigest, Timestamp)>,
    /// When it was created.
    pub created_at: Timestamp,
    /// When it expires.
    pub expires_at: Option<Timestamp>,
    /// When it was revoked.
    pub revoked_at: Option<Timestamp>,
}

impl TokenRecord {
    /// Whether it is neither expired nor revoked.
    pub fn is_active(&self, now: Timestamp) -> bool {
        self.revoked_at.is_none() && self.expires_at.is_none_or(|at| now < at)
    }

    /// `active`, `expired` or `revoked`.
    pub fn state(&self, now: Timestamp) -> &'static str {
        match (self.revoked_at, self.is_active(now)) {
            (Some(_), _) => "revoked",
            (None, true) => "active",
            (None, false) => "expired",
        }
    }

    /// Whether it can manage the whole service.
    pub fn manages_service(&self) -> bool {
        self.scopes.cover(Scope::Admin) && self.structures.is_none()
    }

    /// Rights of its holder.
    pub fn grant(&self) -> Grant {
        let actor = Actor::Token { id: self.id.to_string(), name: self.name.clone() };
        Grant::new(actor, self.scopes, self.structures.clone()).of_sources(self.sources.clone())
    }

    /// The record with a new secret; the previous one stays valid until `overlap_until`.
    #[must_use]
    pub fn rotated(&self, text: &TokenText, overlap_until: Timestamp) -> Self {
        Self { digest: text.digest(), previous: Some((self.digest, overlap_until)), ..self.clone() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_token_reads_back_as_it_was_written_and_hides_its_secret() {
        let token = TokenText::generate().unwrap();
        let text = token.reveal();
        assert_eq!(text.len(), 3 + 16 + 1 + 52, "{text}");
        let read = TokenText::parse(&text).unwrap();
        assert_eq!(read.id(), token.id());
        assert!(bool::from(read.digest().ct_eq(&token.digest())));
        let secret = text.rsplit('_').next().unwrap();
        assert!(!format!("{token:?} {:?}", token.digest()).contains(&secret[..8]));
        assert_ne!(TokenText::generate().unwrap().reveal(), text);
    }

    #[test]
    fn anything_else_is_malformed() {
        let good = TokenText::generate().unwrap().reveal();
        let (short, long) = (good[..good.len() - 1].to_owned(), format!("{good}a"));
        let other_prefix = good.replacen("mw_", "xx_", 1);
        let wrong = ["", "mw_", "mw__", "mw_abc_def", &short, &long, &other_prefix, &good.replace('_', "-"), "mw_é_é"];
        for text in wrong {
            assert_eq!(TokenText::parse(text).err(), Some(Malformed), "{text}");
        }
    }

    #[test]
    fn a_token_inside_a_text_is_recognised() {
        let good = TokenText::generate().unwrap().reveal();
        assert!(token_like(&good) && token_like(&format!("a=1&b={good}")) && token_like(&good[..30]));
        assert!(!token_like("source=mw_1&x=mw_abc_d") && !token_like("mw_") && !token_like("é"));
    }

    #[test]
    fn invalid_properties_of_a_token_are_reported() {
        let now = crate::clock::now();
        let bad = NewToken {
            name: "\n".to_owned(),
            scopes: Scopes::default(),
            structures: Some(BTreeSet::new()),
            sources: Some(BTreeSet::new()),
            expires_at: Some(now),
        };
        let pointers: Vec<String> = bad.problems(now).into_iter().map(|p| p.pointer).collect();
        assert_eq!(pointers, ["/name", "/scopes", "/structures", "/sources", "/expires_at"]);
    }

    #[test]
    fn only_a_token_that_posts_and_does_nothing_else_to_data_is_limited_to_sources() {
        use Scope::{Admin, Ingest, Read};
        let problems = |scopes: &[Scope], sources: &[&str]| {
            let new = NewToken {
                name: "gateway".to_owned(),
                scopes: scopes.iter().copied().collect(),
                structures: None,
                sources: Some(sources.iter().map(|&source| source.to_owned()).collect()),
                expires_at: None,
            };
            new.problems(crate::clock::now()).into_iter().map(|problem| problem.message).collect::<String>()
        };
        assert_eq!(problems(&[Ingest], &["gateway-1"]), "");
        assert_eq!(problems(&[Ingest, Read], &["gateway-1", "gateway-2"]), "");
        for scopes in [&[Read][..], &[Admin], &[Admin, Ingest]] {
            assert!(problems(scopes, &["gateway-1"]).contains("scope ingest"), "{scopes:?}");
        }
        assert!(problems(&[Ingest], &["gateway-1", "a b"]).contains("\"a b\""));
    }
}
