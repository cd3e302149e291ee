//! Rows held out for measuring the gain.

use serde::{Deserialize, Serialize};

use super::data::{Data, Values};
use structures::quantity::{shown, Timestamp};

/// Which rows are held out for measuring the gain; written `last:0.25`, `since:2025-08-07` or `where:lab=de`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Holdout {
    /// The last share of the rows in time.
    Last(f64),
    /// The rows from a time on.
    Since(Timestamp),
    /// The rows in which a covariate has a given category.
    Where {
        /// Name of the covariate.
        covariate: String,
        /// Its category.
        level: String,
    },
}

impl std::str::FromStr for Holdout {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wrong =
            || format!("{} must read last:0.25, a share below 1, since:2025-08-07, or where:lab=de", shown(text));
        match text.split_once(':') {
            Some(("last", share)) => {
                let share: f64 = share.parse().map_err(|_| wrong())?;
                (0.0..1.0).contains(&share).then_some(Self::Last(share)).ok_or_else(wrong)
            }
            Some(("since", time)) => Timestamp::parse_day_or_time(time).map(Self::Since).map_err(|_| wrong()),
            Some(("where", rest)) => {
                let (covariate, level) = rest.split_once('=').ok_or_else(wrong)?;
                Ok(Self::Where { covariate: covariate.to_owned(), level: level.to_owned() })
            }
            _ => Err(wrong()),
        }
    }
}

impl Holdout {
    /// Splits the rows into those that are searched for causes and those held out. Rows that were measured after an earlier
    /// diagnosis are always searched.
    ///
    /// # Errors
    /// The reason, as the end of a sentence that starts with "the hold-out": a share outside 0 to 1, or a column or category
    /// that the data do not have.
    pub(super) fn split(&self, data: &Data) -> Result<(Vec<usize>, Vec<usize>), String> {
        let (further, all): (Vec<usize>, Vec<usize>) = (0..data.rows()).partition(|row| data.further[*row]);
        let (mut searched, held) = self.split_of(data, all)?;
        searched.extend(further);
        searched.sort_unstable();
        Ok((searched, held))
    }

    /// Splits `all` rows, which are in order of time.
    fn split_of(&self, data: &Data, all: Vec<usize>) -> Result<(Vec<usize>, Vec<usize>), String> {
        match self {
            Self::Last(share) => {
                if !(0.0..1.0).contains(share) {
                    return Err(format!("last:{share} must have a share from 0 to below 1"));
                }
                let first = all.len() - (share * all.len() as f64).round() as usize;
                Ok((all[..first].to_vec(), all[first..].to_vec()))
            }
            Self::Since(from) => {
                if data.measured_at.is_empty() {
                    return Err(format!("since:{from} needs the time of each row, and these rows have none"));
                }
                let (held, searched) = all.into_iter().partition(|row| data.measured_at[*row] >= *from);
                Ok((searched, held))
            }
            Self::Where { covariate, level } => {
                let column = data.column(covariate).ok_or_else(|| {
                    let names: Vec<&str> = data.columns.iter().map(|c| c.name.as_str()).collect();
                    format!("names the column {covariate}, but there are {}", names.join(", "))
                })?;
                let Values::Categories(names, indices) = &column.values else {
                    return Err(format!("names the column {covariate}, which holds numbers: it must hold categories"));
                };
                let Some(wanted) = names.iter().position(|n| n == level) else {
                    let names = names.join(", ");
                    return Err(format!("asks for {covariate} = {level}, but its categories are {names}"));
                };
                Ok(all.into_iter().partition(|row| indices[*row] != Some(wanted)))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_day_is_its_midnight_in_utc_and_a_time_is_itself() {
        let since = |text: &str| match text.parse::<Holdout>() {
            Ok(Holdout::Since(time)) => time.to_string(),
            other => panic!("{text} is read as {other:?}"),
        };
        assert_eq!(since("since:2025-08-07"), "2025-08-07T00:00:00Z");
        assert_eq!(since("since:2025-08-07T12:00:00+02:00"), "2025-08-07T10:00:00Z");
        for wrong in
            ["since:", "since:7.8.2025", "since:2025-08-07T12:00:00", "since:2025-02-30", "last:1", "first:0.2"]
        {
            let message = wrong.parse::<Holdout>().unwrap_err();
            assert!(message.contains("since:2025-08-07"), "{wrong}: {message}");
        }
    }
}
