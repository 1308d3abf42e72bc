//! Re-runs: EvalAI cancels the row of a submission that a host re-runs, and makes a new row under a new id. The new row keeps the
//! Job names and the time of the old one, which lead from the new Submission to the old.
//!
//! `observe` finds the original of a new submission, the feed of the watches notes it from the status, and the reconcile of the
//! original takes it from here. Pure; knows no client.

use std::collections::HashMap;
use std::sync::{Arc, Mutex};

use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;
use kube::ResourceExt;
use kube::runtime::reflector::ObjectRef;

use crate::lock::lock;
use crate::services::evalai::row::Row;
use leaderboard_api::{Attempt, Rerun, Submission, names};

/// The Submission that a row is a re-run of, among `others` of the same namespace. A participant can edit the row, so only a
/// Submission of the same Leaderboard, phase and team is taken.
///
/// EvalAI knows the Jobs of those alone whose `queued` or `running` was written: a run that ends before that has none there. EvalAI
/// copies the time of the submission too, by which that one is found.
pub(super) fn original(
    row: &Row,
    submission: &Submission,
    others: impl FnOnce() -> Vec<Arc<Submission>>,
) -> Option<Rerun> {
    let time = row.resumed_at?;
    let own = submission.name_any();
    let of_phase = |s: &Submission| s.spec.evalai.map(|e| (e.challenge, e.phase));
    let team = Some(row.team_id?.to_string());
    let others: Vec<_> = others()
        .into_iter()
        .filter(|other| {
            other.metadata.name.as_deref() != Some(own.as_str())
                && other.spec.leaderboard_name == submission.spec.leaderboard_name
                && of_phase(other) == of_phase(submission)
                && other.status.as_ref().and_then(|s| s.team.as_ref()?.id.as_ref()) == team.as_ref()
        })
        .collect();
    let mut names = row.jobs.iter().rev().filter_map(|job| Some(split(job)?.0));
    let named = names.find(|name| others.iter().any(|other| other.metadata.name.as_deref() == Some(*name)));
    let name = named.map(str::to_owned).or_else(|| copied(row, submission, &others))?;
    Some(Rerun {
        submission_name: name,
        time: Some(Time(time)),
    })
}

/// The newest submission that is older than a row, and was submitted in the second that the row names. A resumed submission names its
/// own time too, and is no copy.
fn copied(row: &Row, submission: &Submission, others: &[Arc<Submission>]) -> Option<String> {
    if submission.spec.attempt != Attempt::FIRST || last_attempt(row).is_some() {
        return None;
    }
    let second = row.submitted_at?.as_second();
    let submitted = |s: &Submission| Some(s.status.as_ref()?.times.submitted.as_ref()?.0.as_second());
    let id = |s: &Submission| s.spec.evalai.map(|evalai| evalai.submission);
    let older = others
        .iter()
        .filter(|other| submitted(other) == Some(second) && id(other) < Some(row.id));
    older.max_by_key(|other| id(other)).map(|other| other.name_any())
}

/// The highest attempt whose first Job a row names as its own. A participant can edit the row, so a number that no
/// Submission can have counts for nothing.
pub(super) fn last_attempt(row: &Row) -> Option<Attempt> {
    let own = names::submission(row.id);
    let jobs = row.jobs.iter().filter_map(|job| split(job));
    let attempts = jobs.filter(|(name, attempt)| *name == own && (Attempt::FIRST..Attempt::HIGHEST).contains(attempt));
    attempts.map(|(_, attempt)| attempt).max()
}

/// Submission and attempt of a first Job, `<name>-<attempt>`.
fn split(job: &str) -> Option<(&str, Attempt)> {
    let (name, attempt) = job.rsplit_once('-')?;
    Some((name, Attempt(attempt.parse().ok()?)))
}

/// Which submissions were re-run, by namespace and name of the original: the re-run's name and when.
#[derive(Default)]
pub struct Reruns(Mutex<HashMap<(String, String), Rerun>>);

impl Reruns {
    /// Takes in a Submission that was changed or is gone. Returns the original that has to know of it.
    pub fn moved(&self, submission: &Submission, is_gone: bool) -> Option<ObjectRef<Submission>> {
        let of = submission.status.as_ref()?.rerun_of.as_ref()?;
        let namespace = submission.namespace().unwrap_or_default();
        let key = (namespace.clone(), of.submission_name.clone());
        let rerun = Rerun {
            submission_name: submission.name_any(),
            time: of.time.clone(),
        };
        let mut known = lock(&self.0);
        if is_gone {
            if known.get(&key) == Some(&rerun) {
                known.remove(&key);
            }
            return None;
        }
        let is_new = known.insert(key, rerun.clone()).as_ref() != Some(&rerun);
        is_new.then(|| ObjectRef::new(&of.submission_name).within(&namespace))
    }

    /// What a submission was re-run as.
    pub fn of(&self, submission: &Submission) -> Option<Rerun> {
        let key = (submission.namespace().unwrap_or_default(), submission.name_any());
        lock(&self.0).get(&key).cloned()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn submission(id: i64, leaderboard: &str, phase: i64, team: &str) -> Submission {
        let spec =
            json!({"leaderboardName": leaderboard, "evalai": {"challenge": 1, "phase": phase, "submission": id}});
        let mut submission = Submission::new(&format!("submission-{id}"), serde_json::from_value(spec).unwrap());
        submission.metadata.namespace = Some("ns".into());
        submission.status = Some(serde_json::from_value(json!({"team": {"id": team}})).unwrap());
        submission
    }

    fn row(jobs: &[&str], is_again: bool) -> Row {
        let again = is_again.then_some("2026-11-20T10:00:00Z");
        let row =
            json!({"id": 9, "status": "submitted", "participant_team": 3, "rerun_resumed_at": again, "job_name": jobs});
        serde_json::from_value(row).unwrap()
    }

    const SUBMITTED: &str = "2026-11-19T08:30:00Z";

    /// The one that a row of this submission is found to be a re-run of.
    fn found(row: &Row, new: &Submission, all: &[Submission]) -> Option<String> {
        let others = || all.iter().cloned().map(Arc::new).collect();
        original(row, new, others).map(|rerun| rerun.submission_name)
    }

    #[test]
    fn the_job_names_of_a_row_lead_to_its_original() {
        let all = [
            submission(7, "lb", 2, "3"),
            submission(8, "lb", 2, "3"),
            submission(4, "other", 2, "3"),
            submission(5, "lb", 1, "3"),
            submission(6, "lb", 2, "66"),
        ];
        let new = submission(9, "lb", 2, "3");
        for (jobs, expected) in [
            (&["submission-7-1"][..], Some("submission-7")),
            (&["submission-7-1", "submission-7-2"], Some("submission-7")),
            (&["submission-7-1", "submission-8-1"], Some("submission-8")),
            (&["submission-7-1", "submission-9-1"], Some("submission-7")),
            (&["submission-4-1", "submission-5-1", "submission-6-1"], None),
            (&["submission-1-1", "nothing", "-", "submission-7-x"], None),
            (&[], None),
        ] {
            assert_eq!(found(&row(jobs, true), &new, &all).as_deref(), expected, "{jobs:?}");
        }
        assert_eq!(
            found(&row(&["submission-7-1"], false), &new, &all),
            None,
            "it was not re-run"
        );
    }

    #[test]
    fn the_time_of_a_row_leads_to_an_original_that_ended_before_evalai_knew_its_job() {
        let at = |id, leaderboard, team, time: &str| {
            let mut submission = submission(id, leaderboard, 2, team);
            submission.status.as_mut().unwrap().times.submitted = Some(Time(time.parse().unwrap()));
            submission
        };
        let all = [
            at(5, "lb", "3", "2026-11-19T08:29:59Z"),
            at(6, "lb", "3", SUBMITTED),
            at(7, "lb", "3", SUBMITTED),
            at(8, "lb", "66", SUBMITTED),
            at(10, "lb", "3", SUBMITTED),
            at(4, "other", "3", SUBMITTED),
        ];
        let mut new = at(9, "lb", "3", SUBMITTED);
        let mut copy = row(&[], true);
        copy.submitted_at = Some("2026-11-19T08:30:00.734518Z".parse().unwrap());
        assert_eq!(found(&copy, &new, &all).as_deref(), Some("submission-7"), "the newest");
        let named = Row {
            jobs: vec!["submission-5-1".into()],
            ..copy.clone()
        };
        assert_eq!(
            found(&named, &new, &all).as_deref(),
            Some("submission-5"),
            "a Job says more"
        );
        let own = Row {
            jobs: vec!["submission-9-1".into()],
            ..copy.clone()
        };
        assert_eq!(found(&own, &new, &all), None, "resumed: it has run under its own id");
        new.spec.attempt = Attempt(2);
        assert_eq!(found(&copy, &new, &all), None, "resumed");
        new.spec.attempt = Attempt(1);
        copy.submitted_at = Some("2026-11-19T08:30:01Z".parse().unwrap());
        assert_eq!(found(&copy, &new, &all), None, "of another second");
    }

    #[test]
    fn an_original_is_woken_once_by_its_rerun() {
        let reruns = Reruns::default();
        let mut new = submission(9, "lb", 2, "3");
        assert_eq!(reruns.moved(&new, false), None);
        let of = json!({"submissionName": "submission-7", "time": "2026-11-20T10:00:00Z"});
        new.status.as_mut().unwrap().rerun_of = serde_json::from_value(of).unwrap();
        let woken = reruns.moved(&new, false).unwrap();
        assert_eq!(
            (woken.name.as_str(), woken.namespace.as_deref()),
            ("submission-7", Some("ns"))
        );
        assert_eq!(reruns.moved(&new, false), None, "it knows");
        let rerun = reruns.of(&submission(7, "lb", 2, "3")).unwrap();
        assert_eq!(rerun.submission_name, "submission-9");
        reruns.moved(&new, true);
        assert_eq!(reruns.of(&submission(7, "lb", 2, "3")), None);
    }
}
