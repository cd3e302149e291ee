//! What people do with alarms: comments, an assignee, closing with a reason, reopening.
//!
//! Actions are rows that are only ever added, by the one writer of the store: two people who act at the same time both leave a trace. The
//! assignee and whether an alarm is closed follow from the rows.
//!
//! An alarm of a later undamaged reference about the same series and time continues an earlier one. It shows the actions of all earlier
//! alarms that overlap it, those on withdrawn alarms included; its assignee and its closing are those of the alarm that it continues until
//! it has its own.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use sqlx::FromRow;

use super::column::{bad_row, elements, list, timestamp};
use super::database::Database;
use super::error::Error;
use super::sql::{self, Whole};
use super::transaction::Transaction;
use crate::quantity::{StructureId, Timestamp};

/// Maximum number of actions on an alarm.
pub const MOST_ACTIONS: usize = 500;

/// Why an alarm is closed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
#[schema(as = ClosingReason)]
pub enum ClosingReason {
    /// The damage was found on the structure.
    DamageConfirmed,
    /// The structure was repaired.
    Repaired,
    /// A sensor or its acquisition failed.
    SensorFault,
    /// Weather, traffic or another condition that is no damage.
    EnvironmentalCause,
    /// Nothing was found.
    FalseAlarm,
    /// Something else, which the text says.
    Other,
}

impl ClosingReason {
    /// All reasons.
    pub const ALL: [Self; 6] = [
        Self::DamageConfirmed,
        Self::Repaired,
        Self::SensorFault,
        Self::EnvironmentalCause,
        Self::FalseAlarm,
        Self::Other,
    ];

    /// Its name, as stored and as answered.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::DamageConfirmed => "damage_confirmed",
            Self::Repaired => "repaired",
            Self::SensorFault => "sensor_fault",
            Self::EnvironmentalCause => "environmental_cause",
            Self::FalseAlarm => "false_alarm",
            Self::Other => "other",
        }
    }

    /// In words.
    pub fn words(self) -> String {
        self.as_str().replace('_', " ")
    }

    /// The reason with a name.
    pub fn of_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|reason| reason.as_str() == name)
    }
}

/// What was done.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ActionKind {
    /// A comment.
    Comment {
        /// The text.
        text: String,
    },
    /// The alarm was given to somebody, or `None`: to nobody any more.
    Assignment {
        /// The assignee.
        assignee: Option<String>,
    },
    /// The alarm was closed.
    Closing {
        /// Why.
        reason: ClosingReason,
        /// Explanation.
        text: Option<String>,
    },
    /// A closed alarm was opened again.
    Reopening {
        /// Explanation.
        text: Option<String>,
    },
}

impl ActionKind {
    /// Its name, as stored and as answered.
    pub const fn name(&self) -> &'static str {
        match self {
            Self::Comment { .. } => "comment",
            Self::Assignment { .. } => "assignment",
            Self::Closing { .. } => "closing",
            Self::Reopening { .. } => "reopening",
        }
    }

    /// Comment or explanation.
    pub fn text(&self) -> Option<&str> {
        match self {
            Self::Comment { text } => Some(text),
            Self::Closing { text, .. } | Self::Reopening { text } => text.as_deref(),
            Self::Assignment { .. } => None,
        }
    }

    /// Reason of a closing.
    pub const fn reason(&self) -> Option<ClosingReason> {
        match self {
            Self::Closing { reason, .. } => Some(*reason),
            _ => None,
        }
    }

    /// Assignee of an assignment.
    pub fn assignee(&self) -> Option<&str> {
        match self {
            Self::Assignment { assignee } => assignee.as_deref(),
            _ => None,
        }
    }
}

/// An action of a person on an alarm.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AlarmAction {
    /// Its number: later actions have larger ones.
    pub number: i64,
    /// The alarm on which it was done.
    pub alarm: i64,
    /// What was done.
    pub kind: ActionKind,
    /// When.
    pub at: Timestamp,
    /// By whom.
    pub author: String,
}

/// A new action.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NewAction {
    /// What is done.
    pub kind: ActionKind,
    /// When.
    pub at: Timestamp,
    /// By whom.
    pub author: String,
    /// The number of the last action that the person has seen; if a later one has changed the assignee or the closing, nothing is stored.
    pub seen: Option<i64>,
}

/// The result of an action.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ActionOutcome {
    /// It is stored.
    Stored,
    /// There is no such alarm.
    UnknownAlarm,
    /// The alarm is closed already.
    AlreadyClosed,
    /// The alarm is not closed.
    NotClosed,
    /// Somebody has changed the assignee or the closing since the person has read the alarm.
    Changed,
    /// The alarm has [`MOST_ACTIONS`] actions.
    TooMany,
}

/// What people have done with an alarm.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Handling {
    /// All actions, those on the earlier alarms that it continues included, in the order in which they were stored.
    pub actions: Vec<AlarmAction>,
    /// Who takes care of it.
    pub assignee: Option<String>,
    /// The closing, while the alarm is closed.
    pub closing: Option<AlarmAction>,
}

/// An alarm that an alarm continues, or the alarm itself.
#[derive(Debug, Clone, Copy, FromRow)]
struct Member {
    root: i64,
    episode: i64,
    undamaged_version: Whole<u32>,
    withdrawn: bool,
}

#[derive(FromRow)]
struct ActionRow {
    action_id: i64,
    episode: i64,
    kind: String,
    at_us: i64,
    author: String,
    text: Option<String>,
    reason: Option<String>,
    assignee: Option<String>,
}

/// The alarms of a list with all alarms that they continue, which overlap them in time.
const MEMBERS: &str = concat!(
    "with recursive chain (root, episode) as (
         select cast(value as bigint), cast(value as bigint) from ",
    elements!("$2"),
    "    union
         select c.root, o.episode from chain c
         join alarm_episode e on e.structure_id = $1 and e.episode = c.episode
         join alarm_episode o on o.structure_id = $1 and o.kind = e.kind and o.episode <> e.episode
             and (o.series = e.series or o.kind = 'damage' and 'structure:joint' in (o.series, e.series))
             and (o.undamaged_version < e.undamaged_version
                  or o.undamaged_version = e.undamaged_version and o.withdrawn = 1 and e.withdrawn = 0)
             and o.opened_at_us <= coalesce(e.ended_at_us, 9e18) and coalesce(o.ended_at_us, 9e18) >= e.opened_at_us)
     select c.root, c.episode, e.undamaged_version, e.withdrawn
     from chain c join alarm_episode e on e.structure_id = $1 and e.episode = c.episode"
);

const ACTIONS: &str = concat!(
    "select action_id, episode, kind, at_us, author, text, reason, assignee from alarm_action
     where structure_id = $1 and episode in (select cast(value as bigint) from ",
    elements!("$2"),
    ") order by action_id"
);

/// Actions of people on alarms.
#[derive(Clone, Copy)]
pub struct AlarmActions<'s> {
    pub(super) database: &'s Database,
}

impl AlarmActions<'_> {
    /// What people have done with alarms of a structure, by the number of the alarm.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn of(self, structure: &StructureId, alarms: &[i64]) -> Result<BTreeMap<i64, Handling>, Error> {
        let mut reader = self.database.reader.acquire().await?;
        let members: Vec<Member> =
            sql::query_as(MEMBERS).bind(structure.as_str()).bind(list(alarms)).fetch_all(&mut reader).await?;
        let all: Vec<i64> = members.iter().map(|member| member.episode).collect();
        let statement = sql::query_as(ACTIONS).bind(structure.as_str()).bind(list(&all));
        let actions = self.database.damaged.leave_out(statement, &mut reader, 1, action).await?;
        Ok(alarms.iter().map(|&alarm| (alarm, handling(alarm, &members, &actions))).collect())
    }

    /// Stores an action under a unique id. Closing an alarm that nobody has acknowledged acknowledges it.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn add(self, structure: &StructureId, alarm: i64, new: NewAction) -> Result<ActionOutcome, Error> {
        let structure = structure.to_string();
        self.database
            .write(move |transaction| {
                Box::pin(async move {
                    let refused = refusal(transaction, &structure, alarm, &new).await?;
                    if let Some(refused) = refused {
                        return Ok(refused);
                    }
                    let uid = uuid::Uuid::now_v7().to_string();
                    insert_action(transaction, (&structure, alarm), &uid, &new, false).await?;
                    if matches!(new.kind, ActionKind::Closing { .. }) {
                        sql::query(
                            "update alarm_episode set acknowledged_at_us = $1, acknowledged_by = $2
                             where structure_id = $3 and episode = $4 and acknowledged_at_us is null",
                        )
                        .bind(new.at.micros())
                        .bind(&new.author)
                        .bind(&structure)
                        .bind(alarm)
                        .execute(&mut *transaction)
                        .await?;
                    }
                    Ok(ActionOutcome::Stored)
                })
            })
            .await
    }
}

/// Inserts an action unless its unique id is stored already. Returns whether it was new.
pub(super) async fn insert_action(
    transaction: &mut Transaction<'_>,
    (structure, alarm): (&str, i64),
    uid: &str,
    new: &NewAction,
    imported: bool,
) -> Result<bool, Error> {
    let inserted = sql::query(
        "insert into alarm_action (structure_id, episode, uid, kind, at_us, author, text, reason, assignee, imported)
         values ($1, $2, $3, $4, $5, $6, $7, $8, $9, $10) on conflict (structure_id, uid) do nothing",
    )
    .bind(structure)
    .bind(alarm)
    .bind(uid)
    .bind(new.kind.name())
    .bind(new.at.micros())
    .bind(&new.author)
    .bind(new.kind.text())
    .bind(new.kind.reason().map(ClosingReason::as_str))
    .bind(new.kind.assignee())
    .bind(imported)
    .execute(&mut *transaction)
    .await?;
    Ok(inserted.rows_affected() > 0)
}

/// Why an action is not stored, if it is not.
async fn refusal(
    transaction: &mut Transaction<'_>,
    structure: &str,
    alarm: i64,
    new: &NewAction,
) -> Result<Option<ActionOutcome>, Error> {
    let members: Vec<Member> =
        sql::query_as(MEMBERS).bind(structure).bind(list(&[alarm])).fetch_all(&mut *transaction).await?;
    if members.is_empty() {
        return Ok(Some(ActionOutcome::UnknownAlarm));
    }
    let all: Vec<i64> = members.iter().map(|member| member.episode).collect();
    let rows: Vec<ActionRow> =
        sql::query_as(ACTIONS).bind(structure).bind(list(&all)).fetch_all(&mut *transaction).await?;
    // One that cannot be read is named when the actions are read.
    let actions: Vec<AlarmAction> = rows.into_iter().filter_map(|row| action(row).ok()).collect();
    let present = handling(alarm, &members, &actions);
    let own = actions.iter().filter(|action| action.alarm == alarm).count();
    let changes = |action: &&AlarmAction| !matches!(action.kind, ActionKind::Comment { .. });
    let newest = present.actions.iter().filter(changes).map(|action| action.number).max().unwrap_or(0);
    Ok(match new.kind {
        _ if own >= MOST_ACTIONS => Some(ActionOutcome::TooMany),
        ActionKind::Comment { .. } => None,
        _ if new.seen.is_some_and(|seen| newest > seen) => Some(ActionOutcome::Changed),
        ActionKind::Closing { .. } if present.closing.is_some() => Some(ActionOutcome::AlreadyClosed),
        ActionKind::Reopening { .. } if present.closing.is_none() => Some(ActionOutcome::NotClosed),
        _ => None,
    })
}

/// What people have done with an alarm, from the actions on it and on those that it continues.
fn handling(alarm: i64, members: &[Member], actions: &[AlarmAction]) -> Handling {
    let own: Vec<&Member> = members.iter().filter(|member| member.root == alarm).collect();
    // The alarm itself, then the latest alarm of an earlier reference, then the one that this continues, and so on.
    let mut line = vec![alarm];
    let version =
        |episode: i64| own.iter().find(|member| member.episode == episode).map_or(0, |m| m.undamaged_version.0);
    while let Some(next) = own
        .iter()
        .filter(|member| !member.withdrawn && member.undamaged_version.0 < version(line[line.len() - 1]))
        .map(|member| member.episode)
        .max()
    {
        line.push(next);
    }
    let last = |of: fn(&ActionKind) -> bool| {
        line.iter().find_map(|episode| actions.iter().rev().find(|a| a.alarm == *episode && of(&a.kind)))
    };
    let closing = last(|kind| matches!(kind, ActionKind::Closing { .. } | ActionKind::Reopening { .. }));
    let assigned = last(|kind| matches!(kind, ActionKind::Assignment { .. }));
    Handling {
        assignee: assigned.and_then(|action| action.kind.assignee()).map(str::to_owned),
        closing: closing.filter(|action| matches!(action.kind, ActionKind::Closing { .. })).cloned(),
        actions: actions.iter().filter(|a| own.iter().any(|member| member.episode == a.alarm)).cloned().collect(),
    }
}

/// The kind of a stored or archived action.
pub(super) fn kind_of_row(
    kind: &str,
    text: Option<String>,
    reason: Option<&str>,
    assignee: Option<String>,
) -> Result<ActionKind, Error> {
    let wrong = |detail: &dyn std::fmt::Display| bad_row("alarm action")(detail);
    match kind {
        "comment" => Ok(ActionKind::Comment { text: text.ok_or_else(|| wrong(&"a comment without text"))? }),
        "assignment" => Ok(ActionKind::Assignment { assignee }),
        "closing" => {
            let reason = reason.and_then(ClosingReason::of_name);
            Ok(ActionKind::Closing { reason: reason.ok_or_else(|| wrong(&"a closing without a known reason"))?, text })
        }
        "reopening" => Ok(ActionKind::Reopening { text }),
        other => Err(wrong(&other)),
    }
}

fn action(row: ActionRow) -> Result<AlarmAction, Error> {
    Ok(AlarmAction {
        number: row.action_id,
        alarm: row.episode,
        kind: kind_of_row(&row.kind, row.text, row.reason.as_deref(), row.assignee)?,
        at: timestamp("alarm action", row.at_us)?,
        author: row.author,
    })
}
