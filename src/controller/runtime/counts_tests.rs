//! What the gauges show of Submissions and Leaderboards.

use serde_json::json;

use super::*;

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

fn submission(board: &str, conditions: &[(&str, &str, &str, u32)]) -> Submission {
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
    object
}

fn census(all: &[Submission]) -> Census {
    let census = Census::default();
    for one in all {
        census.changed(None, Some(one));
    }
    census
}

#[test]
fn each_leaderboard_shows_its_readiness_and_how_long_its_oldest_have_waited() {
    let ended = |board, published: (&'static str, &'static str), minute| {
        let published = ("Published", published.0, published.1, 59);
        submission(board, &[("Finished", "True", "Finished", minute), published])
    };
    let submissions = vec![
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
    let found = boards(&leaderboards, &census(&submissions), "us", NOW.parse().unwrap());
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
    new.status = None;
    new.metadata.creation_timestamp = Some(k8s_openapi::apimachinery::pkg::apis::meta::v1::Time(made));
    let found = boards(&[board("a", "us", "True")], &census(&[new]), "us", NOW.parse().unwrap());
    assert_eq!(found["one/a"].oldest_pending, Duration::from_mins(1));
}

/// One in a state, as its conditions show it.
fn in_state(state: State, reason: Option<&str>, class: Option<&str>) -> Submission {
    let conditions: &[_] = match state {
        State::Pending => &[("Finished", "False", "Preparing", 1)],
        State::Running | State::Resumed => &[("Running", "True", "Running", 1)],
        State::Finished => &[("Finished", "True", reasons::FINISHED, 1)],
        State::Failed | State::Cancelled => &[("Finished", "True", "AsItEnded", 1)],
    };
    let mut one = submission("a", conditions);
    let failure = class.map(|class| json!({"class": class, "charged": false, "reason": "R", "message": "M"}));
    let status = one.status.as_mut().unwrap();
    // What is for people is read by nobody.
    status.state = Some(State::Resumed);
    status.reason = reason.map(Into::into);
    status.failure = serde_json::from_value(json!(failure)).unwrap();
    one
}

#[test]
fn submissions_are_counted_by_the_reason_and_the_class_of_their_failure() {
    let mut unseen = submission("a", &[]);
    unseen.status = None;
    let all = [
        unseen,
        in_state(State::Failed, Some("AgentCrashed"), Some("Participant")),
        in_state(State::Failed, Some("AgentCrashed"), Some("Participant")),
        in_state(State::Failed, Some("AgentCrashed"), Some("Infrastructure")),
        // What failed once is no failure of the attempt that runs now.
        in_state(State::Running, Some("Running"), Some("Infrastructure")),
        in_state(State::Cancelled, Some("of a version to come"), None),
    ];
    let expected = [
        ("Cancelled", "Other", "", 1),
        ("Failed", "AgentCrashed", "Infrastructure", 1),
        ("Failed", "AgentCrashed", "Participant", 2),
        ("Pending", "None", "", 1),
        ("Running", "Running", "", 1),
    ];
    let found = census(&all).standings().into_iter();
    let found: Vec<_> = found
        .map(|(by, count)| (by.state, by.reason, by.class, count))
        .collect();
    assert_eq!(found, expected);
}

#[test]
fn every_state_is_counted_also_with_nobody_in_it() {
    let failed = || in_state(State::Failed, None, Some("Participant"));
    let found = states(&census(&[submission("a", &[]), failed(), failed()]).standings());
    let expected = [
        ("Cancelled", 0),
        ("Failed", 2),
        ("Finished", 0),
        ("Pending", 1),
        ("Resumed", 0),
        ("Running", 0),
    ];
    assert_eq!(found, expected.into());
}

#[test]
fn whatever_changes_the_numbers_are_those_of_what_is_there() {
    let compared = |reason: &str| {
        submission(
            "a",
            &[("Finished", "True", "Finished", 1), ("Compared", "True", reason, 2)],
        )
    };
    let open = |minute| {
        let published = ("Published", "False", reasons::WAITING, 59);
        submission("a", &[("Finished", "True", "Finished", minute), published])
    };
    let before = [
        submission("a", &[("Finished", "False", "Preparing", 10)]),
        compared(reasons::AWAITING_OTHER_END),
        open(20),
        in_state(State::Failed, Some("AgentCrashed"), Some("Participant")),
    ];
    let after = [
        in_state(State::Running, Some("Running"), None),
        compared(reasons::SAME_END),
        open(30),
        submission("b", &[("Finished", "False", "Preparing", 40)]),
    ];
    let read = |census: &Census| {
        let boards = boards(
            &[board("a", "us", "True"), board("b", "us", "True")],
            census,
            "us",
            NOW.parse().unwrap(),
        );
        (census.standings(), census.compared(), boards)
    };
    let known = census(&before);
    for (before, after) in before.iter().zip(&after) {
        known.changed(Some(before), Some(after));
    }
    assert_eq!(read(&known), read(&census(&after)));
    assert_eq!(known.compared()[0], (reasons::SAME_END, 1));
    for one in &after {
        known.changed(Some(one), None);
    }
    let counted = lock(&known.0);
    assert!(counted.standings.is_empty() && counted.compared.is_empty() && counted.waits.is_empty());
}
