//! All tokens, and authentication by them.

use std::collections::HashMap;

use subtle::ConstantTimeEq as _;

use super::token::{SecretDigest, TokenId, TokenRecord, TokenText};
use crate::quantity::Timestamp;

/// Why a token is refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum Refused {
    /// The id or the secret is wrong; the answer does not reveal which.
    #[error("this token is not known to the service")]
    Unknown,
    /// It has expired.
    #[error("this token expired at {0}")]
    Expired(Timestamp),
    /// Its secret was replaced, and the previous one is no longer valid.
    #[error("the secret of this token was replaced; the previous one was valid until {0}")]
    RotatedOut(Timestamp),
    /// It was revoked.
    #[error("this token was revoked at {0}")]
    Revoked(Timestamp),
}

/// All tokens, including revoked and expired ones.
#[derive(Debug, Default)]
pub struct TokenTable(HashMap<TokenId, TokenRecord>);

impl TokenTable {
    /// Whether no token was ever created.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// A token by its id.
    pub fn get(&self, id: &TokenId) -> Option<&TokenRecord> {
        self.0.get(id)
    }

    /// Adds or replaces a token.
    pub fn insert(&mut self, record: TokenRecord) {
        self.0.insert(record.id.clone(), record);
    }

    /// All tokens.
    pub fn records(&self) -> impl Iterator<Item = &TokenRecord> {
        self.0.values()
    }

    /// The token that a client presents.
    ///
    /// Both digests of the record are compared in constant time, and an unknown id is compared with a dummy digest, so
    /// that the time of the answer reveals nothing. Only a client that knows the secret learns that a token is expired
    /// or revoked.
    ///
    /// # Errors
    /// [`Refused`].
    pub fn authenticate(&self, presented: &TokenText, now: Timestamp) -> Result<&TokenRecord, Refused> {
        let digest = presented.digest();
        let found = self.0.get(presented.id());
        let current = found.map_or(SecretDigest::DUMMY, |record| record.digest);
        let previous = found.and_then(|record| record.previous);
        let is_current = current.ct_eq(&digest);
        let is_previous = previous.map_or(SecretDigest::DUMMY, |(digest, _)| digest).ct_eq(&digest);
        let known = bool::from(is_current | is_previous);
        let record = found.filter(|_| known).ok_or(Refused::Unknown)?;
        if let Some(at) = record.revoked_at {
            return Err(Refused::Revoked(at));
        }
        if let Some(at) = record.expires_at.filter(|at| *at <= now) {
            return Err(Refused::Expired(at));
        }
        match previous.filter(|(_, until)| !bool::from(is_current) && *until <= now) {
            Some((_, until)) => Err(Refused::RotatedOut(until)),
            None => Ok(record),
        }
    }
}

impl FromIterator<TokenRecord> for TokenTable {
    fn from_iter<I: IntoIterator<Item = TokenRecord>>(records: I) -> Self {
        Self(records.into_iter().map(|record| (record.id.clone(), record)).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::super::grant::Scope;
    use super::super::token::NewToken;
    use super::*;

    fn at(seconds: i64) -> Timestamp {
        Timestamp::from_micros(1_800_000_000_000_000 + seconds * 1_000_000).unwrap()
    }

    fn token(expires_at: Option<Timestamp>) -> (TokenText, TokenRecord) {
        let text = TokenText::generate().unwrap();
        let new = NewToken {
            name: "gateway".to_owned(),
            scopes: [Scope::Ingest].into_iter().collect(),
            structures: None,
            sources: None,
            expires_at,
        };
        let record = new.record(&text, at(0));
        (text, record)
    }

    fn ask(record: &TokenRecord, text: &TokenText, seconds: i64) -> Result<(), Refused> {
        let table: TokenTable = [record.clone()].into_iter().collect();
        table.authenticate(text, at(seconds)).map(|_| ())
    }

    #[test]
    fn only_the_secret_of_the_same_id_is_accepted() {
        let (text, record) = token(None);
        let (other, _) = token(None);
        let same_id = TokenText::with_id(text.id().clone()).unwrap();
        assert_eq!(ask(&record, &text, 1), Ok(()));
        assert_eq!(ask(&record, &other, 1), Err(Refused::Unknown));
        assert_eq!(ask(&record, &same_id, 1), Err(Refused::Unknown));
        assert_eq!(TokenTable::default().authenticate(&text, at(1)).err(), Some(Refused::Unknown));
    }

    #[test]
    fn a_token_ends_at_its_expiry_and_at_its_revocation() {
        let (text, record) = token(Some(at(10)));
        assert_eq!(ask(&record, &text, 9), Ok(()));
        assert_eq!(ask(&record, &text, 10), Err(Refused::Expired(at(10))));
        let revoked = TokenRecord { revoked_at: Some(at(5)), ..record };
        assert_eq!(ask(&revoked, &text, 6), Err(Refused::Revoked(at(5))));
        let guess = TokenText::with_id(text.id().clone()).unwrap();
        assert_eq!(ask(&revoked, &guess, 6), Err(Refused::Unknown), "its state is for its holder only");
    }

    #[test]
    fn the_old_secret_is_good_until_the_overlap_ends_and_the_one_before_is_not() {
        let (first, record) = token(None);
        let second = TokenText::with_id(first.id().clone()).unwrap();
        let rotated = record.rotated(&second, at(60));
        assert_eq!(ask(&rotated, &first, 59), Ok(()));
        assert_eq!(ask(&rotated, &second, 59), Ok(()));
        assert_eq!(ask(&rotated, &first, 60), Err(Refused::RotatedOut(at(60))));
        assert_eq!(ask(&rotated, &second, 60), Ok(()));
        let third = TokenText::with_id(first.id().clone()).unwrap();
        let again = rotated.rotated(&third, at(90));
        assert_eq!(ask(&again, &first, 59), Err(Refused::Unknown));
        assert_eq!((ask(&again, &second, 89), ask(&again, &third, 89)), (Ok(()), Ok(())));
    }
}
