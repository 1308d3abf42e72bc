//! Joins the controller's parts to the process's metrics: loads and states every few seconds.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use kube::ResourceExt;

use crate::controller::leaderboards::operator;
use crate::controller::submissions::act::awaits_publication;
use crate::kubernetes::Store;
use crate::observability::Observability;
use crate::observability::metrics::{BoardState, Standing};
use crate::services::evalai::Hub;
use leaderboard_api::{FailureClass, Leaderboard, State, Submission, SubmissionStatus, conditions, reasons};

/// How often what is not an event is counted: more often than anybody scrapes.
const EVERY: Duration = Duration::from_secs(5);
/// So many failures in a row are worth a host's look.
const REPEATED: i32 = 3;
/// All states, so that one without submissions says 0.
const STATES: [State; 6] = [
    State::Pending,
    State::Running,
    State::Resumed,
    State::Finished,
    State::Failed,
    State::Cancelled,
];

/// Keeps gauges true until the stop.
pub(super) async fn keep(
    hub: Hub,
    leaderboards: Store<Leaderboard>,
    submissions: Store<Submission>,
    us: String,
    telemetry: Observability,
) {
    let mut tick = tokio::time::interval(EVERY);
    let mut shown: BTreeSet<String> = BTreeSet::new();
    let mut standings: BTreeMap<Standing, usize> = BTreeMap::new();
    loop {
        tokio::select! { _ = tick.tick() => {}, () = telemetry.stop.wait() => return }
        let load = hub.load();
        telemetry.metrics.set_evalai_load(load.used, load.limit, load.waiting);
        let all = submissions.state();
        for count in standings.values_mut() {
            *count = 0;
        }
        standings.extend(count_standings(&all));
        for (state, count) in states(&standings) {
            telemetry.metrics.set_submissions(state, count);
        }
        for (standing, count) in &standings {
            telemetry.metrics.set_standing(*standing, *count);
        }
        standings.retain(|_, count| *count > 0);
        for (reason, count) in observed(&all) {
            telemetry.metrics.set_observed(reason, count);
        }
        telemetry
            .metrics
            .set_repeating_teams(repeating_teams(&leaderboards.state()));
        let boards = boards(&leaderboards.state(), &all, &us, Timestamp::now());
        for (leaderboard, state) in &boards {
            telemetry.metrics.set_leaderboard(leaderboard, *state);
        }
        for gone in shown.iter().filter(|leaderboard| !boards.contains_key(*leaderboard)) {
            telemetry.metrics.forget_leaderboard(gone);
        }
        shown = boards.into_keys().collect();
    }
}

/// The Leaderboards that this installation, `us`, drives, each as `namespace/name`.
fn boards(
    leaderboards: &[Arc<Leaderboard>],
    submissions: &[Arc<Submission>],
    us: &str,
    now: Timestamp,
) -> BTreeMap<String, BoardState> {
    let ours = leaderboards
        .iter()
        .filter(|leaderboard| operator::is_ours(leaderboard, us));
    let state = |leaderboard: &Leaderboard| BoardState {
        is_ready: leaderboard
            .condition(conditions::READY)
            .is_some_and(|ready| ready.status == "True"),
        ..BoardState::default()
    };
    let name = |namespace: Option<String>, name: &str| format!("{}/{name}", namespace.unwrap_or_default());
    let mut boards: BTreeMap<_, _> = ours
        .map(|leaderboard| {
            (
                name(leaderboard.namespace(), &leaderboard.name_any()),
                state(leaderboard),
            )
        })
        .collect();
    for submission in submissions {
        let status = submission.status.as_ref();
        let is_pending = status.is_none_or(|status| status.state_of_conditions() == State::Pending);
        if !is_pending && !status.is_some_and(awaits_publication) {
            continue;
        }
        let of = name(submission.namespace(), &submission.spec.leaderboard_name);
        let Some(board) = boards.get_mut(&of) else { continue };
        let age = now.duration_since(stands_since(submission, now));
        let oldest = if is_pending {
            &mut board.oldest_pending
        } else {
            &mut board.oldest_unpublished
        };
        *oldest = Duration::try_from(age).unwrap_or_default().max(*oldest);
    }
    boards
}

/// Since when it waits to run, or is over. A resume makes `Finished` False again, and a Job that is to be replaced `Running`. A new
/// object has no condition yet.
fn stands_since(submission: &Submission, now: Timestamp) -> Timestamp {
    let status = submission.status.as_ref();
    let since = |name| {
        let condition = status.and_then(|status| status.condition(name));
        condition.map(|condition| &condition.last_transition_time)
    };
    let changes = [since(conditions::FINISHED), since(conditions::RUNNING)];
    (changes.into_iter().flatten().max())
        .or(submission.metadata.creation_timestamp.as_ref())
        .map_or(now, |time| time.0)
}

/// Teams that have had this often in a row what an agent can cause, by the statuses of the Leaderboards.
fn repeating_teams(leaderboards: &[Arc<Leaderboard>]) -> usize {
    let statuses = leaderboards
        .iter()
        .filter_map(|leaderboard| leaderboard.status.as_ref());
    let teams = statuses.flat_map(|status| &status.infrastructure_failures);
    teams.filter(|team| team.number >= REPEATED).count()
}

/// Submissions by the reason of their comparison, those without one left out.
fn observed(submissions: &[Arc<Submission>]) -> [(&'static str, usize); 4] {
    let of = |submission: &&Arc<Submission>, reason: &str| {
        let status = submission.status.as_ref();
        let compared = status.and_then(|status| status.condition(conditions::COMPARED));
        compared.is_some_and(|compared| compared.reason == reason)
    };
    [
        reasons::SAME_END,
        reasons::DIFFERENT_END,
        reasons::DIFFERENT_ROUTES,
        reasons::AWAITING_OTHER_END,
    ]
    .map(|reason| (reason, submissions.iter().filter(|one| of(one, reason)).count()))
}

/// Submissions by state, reason and class of failure.
fn count_standings(submissions: &[Arc<Submission>]) -> BTreeMap<Standing, usize> {
    let mut written: BTreeMap<(&'static str, &str, &'static str), usize> = BTreeMap::new();
    for submission in submissions {
        let status = submission.status.as_ref();
        let state = state(submission);
        let failure = status.and_then(|status| status.failure.as_ref());
        let class = failure.filter(|_| state == State::Failed).map(|failure| failure.class);
        let reason = status.and_then(|status| status.reason.as_deref());
        let class = class.map_or("", FailureClass::as_str);
        let standing = (state.as_str(), reason.unwrap_or_default(), class);
        *written.entry(standing).or_default() += 1;
    }
    let mut counts = BTreeMap::new();
    for ((state, reason, class), count) in written {
        let reason = match reason {
            "" => "None",
            name => reasons::of(name).map_or("Other", |reason| reason.name),
        };
        *counts.entry(Standing { state, reason, class }).or_default() += count;
    }
    counts
}

fn states(standings: &BTreeMap<Standing, usize>) -> [(&'static str, usize); 6] {
    STATES.map(State::as_str).map(|state| {
        let of_state = standings.iter().filter(|(standing, _)| standing.state == state);
        (state, of_state.map(|(_, count)| count).sum())
    })
}

fn state(submission: &Submission) -> State {
    let status = submission.status.as_ref();
    status.map_or(State::Pending, SubmissionStatus::state_of_conditions)
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    const NOW: &str = "2026-01-01T01:00:00Z";

    fn board(name: &str, operator: &str, ready: &str) -> Arc<Leaderboard> {
        let mut board = crate::controller::fixtures::leaderboard(name, "http://127.0.0.1:9");
        let condition =
            json!({"type": "Ready", "status": ready, "reason": "Ready", "message": "", "lastTransitionTime": NOW});
        let mut status = board.status.take().unwrap_or_default();
        status.conditions = vec![serde_json::from_value(condition).unwrap()];
        status.operator = Some(operator.into());
        board.status = Some(status);
        Arc::new(board)
    }

    fn submission(board: &str, conditions: &[(&str, &str, &str, u32)]) -> Arc<Submission> {
        let spec = json!({"leaderboardName": board, "track": "map", "image": "agent:1"});
        let mut object = Submission::new("one", serde_json::from_value(spec).unwrap());
        object.metadata.namespace = Some("one".into());
        let condition = |(name, status, reason, minute): &(&str, &str, &str, u32)| {
            let since = format!("2026-01-01T00:{minute:02}:00Z");
            let condition =
                json!({"type": name, "status": status, "reason": reason, "message": "", "lastTransitionTime": since});
            serde_json::from_value(condition).unwrap()
        };
        object.status = Some(SubmissionStatus {
            conditions: conditions.iter().map(condition).collect(),
            ..SubmissionStatus::default()
        });
        Arc::new(object)
    }

    #[test]
    fn each_leaderboard_shows_its_readiness_and_how_long_its_oldest_have_waited() {
        let ended = |board, published: (&'static str, &'static str), minute| {
            let published = ("Published", published.0, published.1, 59);
            submission(board, &[("Finished", "True", "Finished", minute), published])
        };
        let submissions = [
            submission("a", &[("Finished", "False", "Preparing", 50)]),
            submission("a", &[("Finished", "False", "Preparing", 20)]),
            // It has run and waits for its next Job.
            submission(
                "a",
                &[
                    ("Finished", "False", "Preparing", 1),
                    ("Running", "False", "Preparing", 45),
                ],
            ),
            submission(
                "a",
                &[("Finished", "False", "Preparing", 1), ("Running", "True", "Running", 2)],
            ),
            ended("a", ("False", reasons::WAITING), 40),
            ended("a", ("False", reasons::REFUSED), 3),
            ended("a", ("False", reasons::NOT_REQUIRED), 3),
            ended("a", ("True", reasons::PUBLISHED), 3),
            submission("other", &[("Finished", "False", "Preparing", 0)]),
        ];
        let leaderboards = [
            board("a", "us", "True"),
            board("b", "us", "False"),
            board("other", "them", "True"),
        ];
        let found = boards(&leaderboards, &submissions, "us", NOW.parse().unwrap());
        let minutes = Duration::from_mins;
        let busy = BoardState {
            is_ready: true,
            oldest_pending: minutes(40),
            oldest_unpublished: minutes(20),
        };
        let expected = [("one/a".to_owned(), busy), ("one/b".to_owned(), BoardState::default())];
        assert_eq!(found, expected.into());
    }

    #[test]
    fn a_new_submission_waits_since_it_was_made() {
        let made = "2026-01-01T00:59:00Z".parse().unwrap();
        let mut new = submission("a", &[]);
        let object = Arc::make_mut(&mut new);
        object.status = None;
        object.metadata.creation_timestamp = Some(k8s_openapi::apimachinery::pkg::apis::meta::v1::Time(made));
        let found = boards(&[board("a", "us", "True")], &[new], "us", NOW.parse().unwrap());
        assert_eq!(found["one/a"].oldest_pending, Duration::from_mins(1));
    }

    #[test]
    fn submissions_are_counted_by_the_reason_and_the_class_of_their_failure() {
        let with = |condition, reason: &str, class: Option<&str>| {
            let mut one = submission("a", &[(condition, "True", reason, 1)]);
            let failure = class.map(|class| json!({"class": class, "charged": false, "reason": "R", "message": "M"}));
            let status = Arc::make_mut(&mut one).status.as_mut().unwrap();
            status.reason = Some(reason.to_owned());
            status.failure = serde_json::from_value(json!(failure)).unwrap();
            one
        };
        let mut unseen = submission("a", &[]);
        Arc::make_mut(&mut unseen).status = None;
        let all = [
            unseen,
            with("Finished", "AgentCrashed", Some("Participant")),
            with("Finished", "AgentCrashed", Some("Participant")),
            with("Finished", "AgentCrashed", Some("Infrastructure")),
            // What failed once is no failure of the attempt that runs now.
            with("Running", "Running", Some("Infrastructure")),
            with("Finished", "of a version to come", None),
        ];
        let expected = [
            ("Cancelled", "Other", "", 1),
            ("Failed", "AgentCrashed", "Infrastructure", 1),
            ("Failed", "AgentCrashed", "Participant", 2),
            ("Pending", "None", "", 1),
            ("Running", "Running", "", 1),
        ];
        let found = count_standings(&all).into_iter();
        let found: Vec<_> = found
            .map(|(by, count)| (by.state, by.reason, by.class, count))
            .collect();
        assert_eq!(found, expected);
    }

    #[test]
    fn every_state_is_counted_also_with_nobody_in_it() {
        let mut edited = submission("a", &[]);
        // No program reads the state that is shown.
        Arc::make_mut(&mut edited).status.as_mut().unwrap().state = Some(State::Failed);
        let finished = || submission("a", &[("Finished", "True", "Finished", 1)]);
        let all = [edited, finished(), finished()];
        let expected = [
            ("Pending", 1),
            ("Running", 0),
            ("Resumed", 0),
            ("Finished", 2),
            ("Failed", 0),
            ("Cancelled", 0),
        ];
        assert_eq!(states(&count_standings(&all)), expected);
    }
}
