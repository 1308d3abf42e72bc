//! Standings: the best result of each team of a track, ranked as EvalAI ranks them.
//!
//! One function for the Leaderboard's status, the page and the plugin, so that all three show one order. Pure.

use std::collections::{HashMap, HashSet};
use std::fmt;

use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;
use kube::ResourceExt;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::attempt::Attempt;
use super::conditions;
pub use super::order::Order;
use super::progress::{MAX_NAME, Metric, Score};
use super::reasons::Reason;
use super::submission::Submission;
use super::submission_status::{State, SubmissionStatus};
use super::text::one_line;

/// Most rows of a track in the status.
pub const MAX_STANDINGS: usize = 20;
/// Most bytes that the rows of all tracks take in the status, as JSON. An object of Kubernetes has room for 1.5 MiB.
pub const MAX_STANDINGS_BYTES: usize = 512 << 10;
/// Longest name and id of a team in a row, in characters.
pub const MAX_STANDING_TEAM: usize = 64;
/// Most metrics of a row, beside its score.
pub const MAX_STANDING_METRICS: usize = 8;
/// Characters of a number, and of a number as a text.
const MAX_NUMBER: usize = 33;
/// Characters of the name of a Submission, and of its UID.
const MAX_SUBMISSION: usize = 52;
const MAX_UID: usize = 128;

/// Metric that ranks the results of a track, and in which direction.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq, Eq, Hash)]
pub struct Ranking {
    /// Name of the metric, such as `Driving score`.
    #[schemars(length(max = MAX_NAME))]
    pub metric: String,
    /// `Descending` if the highest value leads.
    pub order: Order,
}

impl fmt::Display for Ranking {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let leads = match self.order {
            Order::Ascending => "the lowest",
            Order::Descending => "the highest",
        };
        write!(out, "{}, {leads} first", self.metric)
    }
}

/// Value of the metric that ranks.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, Default, PartialEq, Eq)]
pub struct RankedScore {
    /// Name of the metric, such as `Driving score`.
    #[schemars(length(max = MAX_NAME))]
    pub name: String,
    /// Value is a decimal number, such as `43.13`, in the unit of the metric.
    #[schemars(length(max = MAX_NUMBER))]
    pub value: String,
    /// Text shows the value to people.
    #[schemars(length(max = MAX_NUMBER))]
    pub text: String,
}

/// Best result of one team.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, Default, PartialEq, Eq)]
#[serde(rename_all = "camelCase")]
pub struct Standing {
    /// Number of the place, from 1. Of two equal results the one that was submitted first has the lower rank.
    pub rank: i32,
    /// Name of the team, else its id, in at most 64 characters. Its members chose it. Absent for a submission without a team, which ranks
    /// for itself.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    #[schemars(length(max = MAX_STANDING_TEAM))]
    pub team: String,
    /// Id of the team, by which its results are one team's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = MAX_STANDING_TEAM))]
    pub team_id: Option<String>,
    /// Name of the Submission, which retention may have deleted.
    #[schemars(length(max = MAX_SUBMISSION))]
    pub submission: String,
    /// UID of the Submission.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = MAX_UID))]
    pub uid: Option<String>,
    /// Value of the metric that ranks.
    pub score: RankedScore,
    /// Further numbers of the result.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[schemars(length(max = MAX_STANDING_METRICS))]
    pub metrics: Vec<Metric>,
    /// Attempt that had this result.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub attempt: Option<Attempt>,
    /// Time at which the team submitted it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub submitted_at: Option<Time>,
    /// When its run had ended.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub finished_at: Option<Time>,
}

impl Standing {
    /// The result of a Submission, without a rank. None if it does not rank: it has not finished, it is a check, EvalAI has cancelled it, or it
    /// lacks the metric.
    pub fn of(submission: &Submission, ranking: &Ranking) -> Option<Self> {
        let status = submission.status.as_ref().filter(|_| is_candidate(submission))?;
        let team = status.team.as_ref();
        let id = team.and_then(|team| team.id.as_deref()).or_else(|| {
            let given = submission.spec.team.as_ref()?;
            given.id.as_deref()
        });
        let score = status.score.as_ref().map(metric_of);
        let metrics = status.metrics.iter().take(MAX_STANDING_METRICS).cloned();
        let made = submission.metadata.creation_timestamp.as_ref();
        let row = Self {
            rank: 0,
            team: submission
                .team_name()
                .map(|name| one_line(&name, MAX_STANDING_TEAM))
                .unwrap_or_default(),
            team_id: id.map(|id| one_line(id, MAX_STANDING_TEAM)),
            submission: submission.name_any(),
            uid: submission.uid(),
            score: RankedScore::default(),
            metrics: score.into_iter().chain(metrics).collect(),
            attempt: status.attempt,
            submitted_at: status.times.submitted.as_ref().or(made).cloned(),
            finished_at: status
                .times
                .finished
                .clone()
                .or_else(|| status.end().map(|end| end.last_transition_time.clone())),
        };
        row.ranked_by(ranking)
    }

    /// This result, ranked by another metric. None if it lacks that metric, or if the value is no finite number.
    #[must_use]
    pub fn ranked_by(mut self, ranking: &Ranking) -> Option<Self> {
        if self.score.name != ranking.metric {
            let all = &mut self.metrics;
            if !self.score.name.is_empty() {
                let (name, value) = (
                    std::mem::take(&mut self.score.name),
                    std::mem::take(&mut self.score.value),
                );
                all.insert(0, Metric { name, value });
            }
            let found = all.iter().position(|metric| metric.name == ranking.metric)?;
            let Metric { name, value } = all.remove(found);
            let text = value.clone();
            self.score = RankedScore { name, value, text };
        }
        self.number().map(|_| self)
    }

    /// Value by which it ranks. None if it is no finite number.
    pub fn number(&self) -> Option<f64> {
        self.score.value.parse().ok().filter(|number: &f64| number.is_finite())
    }

    /// A value of a metric, the one that ranks included.
    pub fn metric(&self, name: &str) -> Option<&str> {
        if self.score.name == name {
            return Some(&self.score.value);
        }
        let found = self.metrics.iter().find(|metric| metric.name == name);
        found.map(|metric| metric.value.as_str())
    }

    /// The team whose result it is. A submission without a team is one of its own.
    fn team_key(&self) -> (u8, &str) {
        match self.team_id.as_deref() {
            Some(id) => (0, id),
            None if self.team.is_empty() => (2, &self.submission),
            None => (1, &self.team),
        }
    }

    /// True if the row is a result of this object. An object that was made anew has another UID.
    fn is_same_object(&self, submission: &Submission) -> bool {
        self.submission == submission.name_any() && (self.uid.is_none() || self.uid == submission.uid())
    }
}

fn metric_of(score: &Score) -> Metric {
    Metric {
        name: score.name.clone(),
        value: score.value.clone(),
    }
}

/// True if a Submission has a result that can rank: it finished with a final score, is no check, and is not cancelled in EvalAI.
pub fn is_candidate(submission: &Submission) -> bool {
    let Some(status) = submission.status.as_ref().filter(|_| !submission.spec.check) else {
        return false;
    };
    let is_final = status.score.as_ref().is_none_or(|score| score.is_final);
    status.state_of_conditions() == State::Finished && is_final && !is_cancelled_in_evalai(status)
}

fn is_cancelled_in_evalai(status: &SubmissionStatus) -> bool {
    let published = status.condition(conditions::PUBLISHED);
    published.is_some_and(|published| published.reason == Reason::CancelledInEvalAI)
}

/// Name of the track that a Submission was run on.
pub fn track_of(submission: &Submission) -> Option<&str> {
    let shown = submission.status.as_ref().and_then(|status| status.track.as_deref());
    shown.or(submission.spec.track.as_deref())
}

/// The best row of each team, best first, with its rank.
///
/// Equal values go to the earlier submission, then to the name, so that the order never depends on the order of `rows`.
pub fn rank(ranking: &Ranking, rows: impl IntoIterator<Item = Standing>) -> Vec<Standing> {
    let mut rows: Vec<(f64, Standing)> = rows
        .into_iter()
        .filter_map(|row| Some((row.number()? + 0.0, row)))
        .collect();
    rows.sort_by(|(x, a), (y, b)| {
        let by_value = match ranking.order {
            Order::Ascending => x.total_cmp(y),
            Order::Descending => y.total_cmp(x),
        };
        // A time that is not known comes last.
        let time = |row: &Standing| (row.submitted_at.is_none(), row.submitted_at.as_ref().map(|time| time.0));
        by_value
            .then_with(|| time(a).cmp(&time(b)))
            .then_with(|| a.submission.cmp(&b.submission))
    });
    let mut teams = HashSet::new();
    let is_best: Vec<bool> = rows.iter().map(|(_, row)| teams.insert(row.team_key())).collect();
    let best = rows.into_iter().zip(is_best).filter(|(_, is_best)| *is_best);
    let ranked = best.zip(1..).map(|(((_, row), _), rank)| Standing { rank, ..row });
    ranked.collect()
}

/// The standings of one track: of all its Submissions, and of the rows that the status has stored of Submissions that are gone.
///
/// A stored row counts until its own Submission is there, which then decides. `submissions` may be those of all tracks.
pub fn standings<'a>(
    track: &str,
    ranking: &Ranking,
    submissions: impl IntoIterator<Item = &'a Submission>,
    stored: &[Standing],
) -> Vec<Standing> {
    let mut left: HashMap<&str, &Standing> = stored.iter().map(|row| (row.submission.as_str(), row)).collect();
    let mut rows = Vec::new();
    for submission in submissions {
        let name = submission.metadata.name.as_deref().unwrap_or_default();
        let row = (track_of(submission) == Some(track))
            .then(|| Standing::of(submission, ranking))
            .flatten();
        // One that was made anew under a stored name, and has no result of its own, takes nothing away.
        let replaces = |stored: &&Standing| row.is_some() || stored.is_same_object(submission);
        if left.get(name).is_some_and(replaces) {
            left.remove(name);
        }
        rows.extend(row);
    }
    let gone = left.into_values().filter_map(|row| row.clone().ranked_by(ranking));
    rank(ranking, rows.into_iter().chain(gone))
}

/// The rows of a track that the status has room for: at most [`MAX_STANDINGS`], and within its part of [`MAX_STANDINGS_BYTES`].
pub fn shown(mut rows: Vec<Standing>, tracks: usize) -> Vec<Standing> {
    rows.truncate(MAX_STANDINGS);
    let mut room = MAX_STANDINGS_BYTES.checked_div(tracks.max(1)).unwrap_or_default();
    let fitting = rows.iter().take_while(|row| {
        let bytes = serde_json::to_vec(row).map_or(usize::MAX, |text| text.len().saturating_add(1));
        let fits = bytes <= room;
        room = room.saturating_sub(bytes);
        fits
    });
    let fitting = fitting.count();
    rows.truncate(fitting);
    rows
}

#[cfg(test)]
mod tests;
