//! The standings of each track and their metric, as the status shows them. Pure.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use leaderboard_api::standings::{is_candidate, shown, standings, track_of};
use leaderboard_api::{Leaderboard, Ranking, ResourceExt, ScoreMetric, Standing, Submission, Track, TrackStatus};
use leaderboard_evaluation as evaluation;

/// Results that a Leaderboard's standings are made of.
#[derive(Clone, Debug, Default)]
pub struct Results {
    /// All of its Submissions.
    pub submissions: Vec<Arc<Submission>>,
    /// Submissions of stored rows that EvalAI shows as cancelled.
    pub cancelled: BTreeSet<String>,
}

/// How EvalAI ranks the phases of a Leaderboard that names a metric; none while that is not known.
pub type Named = Option<BTreeMap<i64, Ranking>>;

/// How a track ranks.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Ranked {
    pub ranking: Ranking,
    /// The metric of EvalAI that results here do not show.
    pub lacking: Option<Ranking>,
}

/// How a track ranks: as EvalAI does, else as it did before, else as its evaluation asks.
pub fn ranked(leaderboard: &Leaderboard, track: &Track, named: &Named) -> Ranked {
    let evaluation = evaluation::of(&leaderboard.spec);
    let is_shown = |ranking: &Ranking| evaluation.shows(&ranking.metric);
    let phase = track.phase.filter(|_| leaderboard.spec.evalai.is_some());
    let wanted = match (phase, named) {
        (Some(phase), Some(named)) => named.get(&phase).map(|ranking| as_shown(track, ranking)),
        (Some(_), None) => stored(leaderboard, track).and_then(|stored| stored.ranking.clone()),
        (None, _) => None,
    };
    match wanted {
        Some(ranking) if is_shown(&ranking) => Ranked { ranking, lacking: None },
        lacking => Ranked {
            ranking: evaluation.ranking(track),
            lacking,
        },
    }
}

/// A ranking of EvalAI's with the name that results here have for its metric: that of the split whose metric is the track's score.
fn as_shown(track: &Track, ranking: &Ranking) -> Ranking {
    let score = track.container.as_ref().map(|own| &own.score);
    let name = |score: &ScoreMetric| score.name_of(score.split.as_deref().unwrap_or_default(), &ranking.metric);
    Ranking {
        metric: score.map_or_else(|| ranking.metric.clone(), name),
        order: ranking.order,
    }
}

/// The standings of a track. Without results nothing has changed since they were stored.
pub fn of_track(
    leaderboard: &Leaderboard,
    track: &Track,
    ranking: &Ranking,
    results: Option<&Results>,
) -> Vec<Standing> {
    let stored = stored(leaderboard, track).map_or(&[][..], |track| &track.standings);
    let Some(results) = results else {
        return stored.to_vec();
    };
    let kept = stored.iter().filter(|row| !results.cancelled.contains(&row.submission));
    let kept: Vec<Standing> = kept.cloned().collect();
    let submissions = results.submissions.iter().map(AsRef::as_ref);
    shown(
        standings(&track.name, ranking, submissions, &kept),
        leaderboard.spec.tracks.len(),
    )
}

fn stored<'a>(leaderboard: &'a Leaderboard, track: &Track) -> Option<&'a TrackStatus> {
    let mut tracks = leaderboard.status.iter().flat_map(|status| &status.tracks);
    tracks.find(|stored| stored.name == track.name)
}

/// Warnings about tracks that EvalAI ranks by a metric that no status shows.
pub fn notes(leaderboard: &Leaderboard, named: &Named) -> Vec<String> {
    let note = |track: &Track| {
        let Ranked { ranking, lacking } = ranked(leaderboard, track, named);
        let lacking = lacking?;
        Some(format!(
            "EvalAI ranks the phase of track {} by {}, which the status of a submission does not show: the standings here go by {ranking}.",
            track.name, lacking.metric
        ))
    };
    leaderboard.spec.tracks.iter().filter_map(note).collect()
}

/// True if the standings no longer need an object: they hold its result exactly if that is one of the best.
pub fn can_spare(leaderboard: &Leaderboard, submission: &Submission) -> bool {
    let name = track_of(submission).unwrap_or_default();
    let Some(track) = leaderboard.spec.tracks.iter().find(|track| track.name == name) else {
        return true;
    };
    let stored = stored(leaderboard, track);
    let Some((stored, ranking)) = stored.and_then(|stored| Some((stored, stored.ranking.as_ref()?))) else {
        return !is_candidate(submission);
    };
    let has_it = |rows: &[Standing]| {
        let is_its = |row: &Standing| row.submission == submission.name_any() && row.uid == submission.uid();
        rows.iter().any(is_its)
    };
    let wanted = standings(name, ranking, [submission], &stored.standings);
    has_it(&stored.standings) == has_it(&shown(wanted, leaderboard.spec.tracks.len()))
}

#[cfg(test)]
mod tests;
