//! What a row of the table becomes: a Submission that has ended, one that goes on, or a matter for a person. Pure.

use std::collections::BTreeMap;

use jiff::Timestamp;
use jiff::civil::DateTime;
use jiff::tz::TimeZone;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::{ObjectMeta, Time};
use kube::ResourceExt;
use leaderboard_api::text::{LONGEST_NAME, one_line};
use leaderboard_api::{
    Attempt, EvalaiRef, ImageReference, ImportedEnd, ImportedState, Leaderboard, Progress, Score, Submission,
    SubmissionSpec, Team, Times, Track, names,
};

use crate::services::table::StoredRow;

/// Longest id of a team.
const LONGEST_ID: usize = 128;
/// Longest address of results.
const LONGEST_URL: usize = 2048;
/// Longest name of a Submission.
const LONGEST_SUBMISSION: usize = 52;
/// Statuses of a row that has not ended, of both pipelines.
const LIVE: [&str; 5] = ["SUBMITTED", "PENDING", "QUEUED", "RUNNING", "RESUMING"];

/// What a row becomes.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Outcome {
    /// A Submission, and the end that its status shows.
    Ended(Box<(Submission, ImportedEnd)>),
    /// A Submission that the controller takes up from what is stored.
    Adopted(Box<Submission>),
    /// Nothing, before a person has decided.
    Undecided(Undecided),
}

/// Why nothing is made of a row.
#[derive(thiserror::Error, Clone, Debug, PartialEq, Eq)]
pub(super) enum Undecided {
    #[error(
        "it has no track_id, and its track_name is no track of a local Leaderboard with this table; nothing says where it belongs"
    )]
    NoPhase,
    #[error(
        "its track_id {0} is the phase of no Leaderboard with this table; apply that Leaderboard first, or leave the row"
    )]
    Phase(String),
    #[error("its id is none that a submission of EvalAI has; leave the row")]
    Id,
    #[error("its id cannot be the name of a Submission; leave the row")]
    Name,
    #[error("it has no image that could be run; leave the row")]
    Image,
    #[error(
        "it is {0}, and the row has no attempt of this operator: another pipeline may still run it; wait for its end, or resume it \
         in EvalAI once that pipeline is off"
    )]
    OfAnother(String),
    #[error("its status {0} is not known; leave the row")]
    Status(String),
}

/// Decides for one row of a table, which these Leaderboards name.
pub(super) fn outcome(row: &StoredRow, boards: &[Leaderboard], table: &str) -> Outcome {
    match decide(row, boards, table) {
        Ok(outcome) => outcome,
        Err(why) => Outcome::Undecided(why),
    }
}

fn decide(row: &StoredRow, boards: &[Leaderboard], table: &str) -> Result<Outcome, Undecided> {
    let place = place(row, boards)?;
    let status = row.text("submission_status").unwrap_or_default().to_ascii_uppercase();
    let attempt = row.attempt.map(Attempt).unwrap_or_default();
    let attempt = attempt.clamp(Attempt::FIRST, Attempt::HIGHEST);
    let ended = |state| {
        let submission = submission(row, &place, attempt)?;
        let end = end(row, state, place.track, table);
        Ok(Outcome::Ended(Box::new((imported(submission, table), end))))
    };
    match status.as_str() {
        "FINISHED" => ended(ImportedState::Finished),
        "FAILED" => ended(ImportedState::Failed),
        "CANCELLED" => ended(ImportedState::Cancelled),
        live if LIVE.contains(&live) && row.attempt.is_some() => {
            // The next attempt: it takes up what is stored, and the row takes no attempt that it has already.
            let next = attempt.next().min(Attempt::HIGHEST);
            Ok(Outcome::Adopted(Box::new(submission(row, &place, next)?)))
        }
        live if LIVE.contains(&live) => Err(Undecided::OfAnother(status)),
        _ => Err(Undecided::Status(one_line(&status, 32))),
    }
}

/// Where a row belongs.
struct Destination<'a> {
    board: &'a Leaderboard,
    track: &'a Track,
    /// Challenge and phase of EvalAI; none for a local Leaderboard.
    evalai: Option<(i64, i64)>,
}

fn place<'a>(row: &StoredRow, boards: &'a [Leaderboard]) -> Result<Destination<'a>, Undecided> {
    let Some(text) = row.text("track_id") else {
        return local(row, boards).ok_or(Undecided::NoPhase);
    };
    let phase: Option<i64> = text.parse().ok();
    let found = boards.iter().find_map(|board| {
        let evalai = board.spec.evalai.as_ref()?;
        let track = board
            .spec
            .tracks
            .iter()
            .find(|track| track.phase.is_some() && track.phase == phase)?;
        Some(Destination {
            board,
            track,
            evalai: Some((evalai.challenge, phase?)),
        })
    });
    found.ok_or_else(|| Undecided::Phase(one_line(text, 32)))
}

/// A local submission's row has no phase; its track is known by its codename.
fn local<'a>(row: &StoredRow, boards: &'a [Leaderboard]) -> Option<Destination<'a>> {
    let codename = row.text("track_name")?;
    let locals = boards.iter().filter(|board| board.spec.evalai.is_none());
    let mut found = locals.flat_map(|board| board.spec.tracks.iter().map(move |track| (board, track)));
    let (board, track) = found.find(|(_, track)| track.codename == codename)?;
    Some(Destination {
        board,
        track,
        evalai: None,
    })
}

fn submission(row: &StoredRow, place: &Destination<'_>, attempt: Attempt) -> Result<Submission, Undecided> {
    let board = place.board.name_any();
    let mut labels = BTreeMap::from([(names::LABEL_LEADERBOARD.to_owned(), board.clone())]);
    let image = row
        .text("submitted_image_uri")
        .filter(|image| is_image(image))
        .map(str::to_owned);
    let (name, evalai) = if let Some((challenge, phase)) = place.evalai {
        let id: Option<i64> = row.run_id.parse().ok().filter(|id| *id > 0);
        let submission = id.ok_or(Undecided::Id)?;
        labels.insert(names::LABEL_PHASE.to_owned(), phase.to_string());
        let evalai = EvalaiRef {
            challenge,
            phase,
            submission,
        };
        (names::submission(submission), Some(evalai))
    } else {
        if !is_name(&row.run_id) {
            return Err(Undecided::Name);
        }
        if image.is_none() {
            return Err(Undecided::Image);
        }
        (row.run_id.clone(), None)
    };
    Ok(Submission {
        metadata: ObjectMeta {
            name: Some(name),
            namespace: place.board.namespace(),
            labels: Some(labels),
            ..ObjectMeta::default()
        },
        spec: SubmissionSpec {
            check: false,
            leaderboard_name: board,
            image,
            evalai,
            track: place.evalai.is_none().then(|| place.track.name.clone()),
            team: team(row),
            priority: 0,
            attempt,
            cancel: false,
        },
        status: None,
    })
}

/// Keeps the controller away until the status is there.
fn imported(mut submission: Submission, table: &str) -> Submission {
    let mark = (names::ANNOTATION_IMPORTED.to_owned(), table.to_owned());
    submission.metadata.annotations = Some(BTreeMap::from([mark]));
    submission
}

fn team(row: &StoredRow) -> Option<Team> {
    let line = |text: &str, longest| Some(one_line(text, longest)).filter(|line| !line.is_empty());
    let id = line(&row.team_id, LONGEST_ID);
    let name = row.text("team_name").and_then(|name| line(name, LONGEST_NAME));
    (id.is_some() || name.is_some()).then_some(Team { id, name })
}

fn end(row: &StoredRow, state: ImportedState, track: &Track, table: &str) -> ImportedEnd {
    let results = row
        .text("results")
        .filter(|url| url.starts_with("s3://") && url.len() <= LONGEST_URL);
    ImportedEnd {
        state,
        track: track.name.clone(),
        results_url: results.map(|url| one_line(url, LONGEST_URL)),
        progress: row.text("progress").and_then(progress),
        score: score(row).filter(|_| state == ImportedState::Finished),
        times: Times {
            submitted: time(row.text("submitted_time")),
            started: time(row.text("start_time")),
            finished: time(row.text("end_time")),
            ..Times::default()
        },
        table: table.to_owned(),
    }
}

fn progress(text: &str) -> Option<Progress> {
    let (done, total) = text.split_once('/')?;
    let (done, total) = (done.parse().ok()?, total.parse().ok()?);
    (0..=total).contains(&done).then(|| Progress::new(done, total))
}

/// An agent may have forged its own: what is out of its range is no score, and may be longer than a status takes.
fn score(row: &StoredRow) -> Option<Score> {
    let number = |column: &str, most: f64| {
        let number: Option<f64> = row.text(column)?.parse().ok();
        number.filter(|number| (0.0..=most).contains(number))
    };
    Some(Score::new(
        number("driving_score", 100.0)?,
        number("route_completion", 100.0),
        number("infraction_penalty", 1.0),
        true,
    ))
}

/// A time as both pipelines write it, `2026-11-20 10:00:00 UTC`, or as AWS does. A forged one may be of a year that Kubernetes takes no
/// time of.
fn time(text: Option<&str>) -> Option<Time> {
    let text = text?;
    let theirs = DateTime::strptime("%Y-%m-%d %H:%M:%S UTC", text).ok();
    let theirs = theirs.and_then(|time| time.to_zoned(TimeZone::UTC).ok());
    let at = theirs.map(|time| time.timestamp());
    let at = at.or_else(|| text.parse::<Timestamp>().ok());
    at.filter(|at| *at >= Timestamp::UNIX_EPOCH).map(Time)
}

fn is_image(text: &str) -> bool {
    let is_first = |byte: &u8| byte.is_ascii_lowercase() || byte.is_ascii_digit();
    text.bytes().next().is_some_and(|byte| is_first(&byte)) && ImageReference::parse(text).is_ok()
}

fn is_name(text: &str) -> bool {
    let is_word = |byte: u8| byte.is_ascii_lowercase() || byte.is_ascii_digit() || byte == b'-';
    let fits = (1..=LONGEST_SUBMISSION).contains(&text.len()) && text.bytes().all(is_word);
    fits && !text.starts_with('-') && !text.ends_with('-')
}

#[cfg(test)]
#[path = "rows_tests.rs"]
mod tests;
