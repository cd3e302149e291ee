//! Ids of batches: UUIDv7, in the order in which the batches of a structure were stored, whatever the clock does.

use uuid::Uuid;

/// Bits of the time in an id, which is in milliseconds.
const TIME_BITS: u32 = 48;

/// The id of a batch that is stored after the one with the id `newest`: its own, which was made by the clock, or one a millisecond after the
/// newest if the clock was set back since then.
pub(super) fn following(newest: Option<&str>, own: &str) -> String {
    newest.filter(|newest| *newest >= own).and_then(|newest| later(newest, own)).unwrap_or_else(|| own.to_owned())
}

/// The id `own` with the time after that of `newest`; `None` if one of them is no UUID, as in an archive that was written by hand.
fn later(newest: &str, own: &str) -> Option<String> {
    let (newest, own) = (Uuid::parse_str(newest).ok()?, Uuid::parse_str(own).ok()?);
    let time = (newest.as_u128() >> (128 - TIME_BITS)) + 1;
    let rest = own.as_u128() & (u128::MAX >> TIME_BITS);
    (time < 1 << TIME_BITS).then(|| Uuid::from_u128((time << (128 - TIME_BITS)) | rest).to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    const AHEAD: &str = "019f0000-0000-7abc-8def-0123456789ab";
    const BEHIND: &str = "019e0000-0000-7123-9456-00000000000f";

    #[test]
    fn an_id_follows_the_newest_one_although_the_clock_was_set_back() {
        assert_eq!(following(None, BEHIND), BEHIND);
        assert_eq!(following(Some(BEHIND), AHEAD), AHEAD);
        let next = following(Some(AHEAD), BEHIND);
        assert_eq!(next, "019f0000-0001-7123-9456-00000000000f");
        assert!(next.as_str() > AHEAD && following(Some(&next), BEHIND) > next);
        let uuid = Uuid::parse_str(&next).unwrap();
        assert_eq!((uuid.get_version_num(), uuid.get_variant()), (7, uuid::Variant::RFC4122));
        assert!(following(Some(AHEAD), AHEAD).as_str() > AHEAD, "the clock stands still");
    }

    #[test]
    fn ids_of_another_form_are_left_as_they_are() {
        assert_eq!(following(Some("first"), BEHIND), BEHIND);
        assert_eq!(following(Some("b2"), "b1"), "b1");
        let last = "ffffffff-ffff-7abc-8def-0123456789ab";
        assert_eq!(following(Some(last), BEHIND), BEHIND, "there is no later time");
    }
}
