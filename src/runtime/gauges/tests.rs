//! Gauges of Submissions and Leaderboards.

use kube::runtime::reflector::ObjectRef;
use serde_json::{Value, json};
use tokio::time::Instant;

use super::super::backoff::BackoffMap;
use super::super::reconciles::Queues;
use super::*;
use crate::fixtures::{self, Cluster, surroundings};
use crate::metrics::{Metrics, Program};
use leaderboard_api::Attempt;
use leaderboard_base::shutdown::Stop;

const NOW: &str = "2026-01-01T01:00:00Z";

fn now() -> Timestamp {
    NOW.parse().unwrap()
}

fn board(name: &str, operator: &str, ready: &str) -> Leaderboard {
    let mut board = fixtures::leaderboard(name, "http://127.0.0.1:9");
    let condition =
        json!({"type": "Ready", "status": ready, "reason": "Ready", "message": "", "lastTransitionTime": NOW});
    let status = board.status.get_or_insert_default();
    status.conditions = vec![serde_json::from_value(condition).unwrap()];
    status.operator = Some(operator.into());
    board
}

fn named(name: &str, board: &str, status: &Value) -> Submission {
    let object = json!({
        "apiVersion": "leaderboard.carla.org/v1alpha1", "kind": "Submission",
        "metadata": {"name": name, "namespace": "one"},
        "spec": {"leaderboardName": board, "track": "map", "image": "agent:1"},
        "status": status,
    });
    serde_json::from_value(object).unwrap()
}

/// A submission with these conditions, each since a minute of this hour.
fn submission(board: &str, conditions: &[(&str, &str, &str, u32)]) -> Submission {
    let condition = |(name, status, reason, minute): &(&str, &str, &str, u32)| {
        let since = format!("2026-01-01T00:{minute:02}:00Z");
        json!({"type": name, "status": status, "reason": reason, "message": "", "lastTransitionTime": since})
    };
    let conditions: Vec<Value> = conditions.iter().map(condition).collect();
    named("one", board, &json!({"conditions": conditions}))
}

/// The samples of a gauge as `/metrics` has them: what stands after its name.
fn lines(samples: &Samples, gauge: &str) -> Vec<String> {
    let metrics = Metrics::new(Program::Controller);
    metrics.set_leading(Some(1));
    metrics.show(samples.clone());
    let start = format!("leaderboard_{gauge}{{");
    let text = metrics.text().unwrap();
    let found = text.lines().filter_map(|line| line.strip_prefix(&start));
    found.map(|line| line.replace(['"', '}'], "")).collect()
}

fn states(submissions: impl IntoIterator<Item = Submission>) -> Samples {
    let mut samples = Samples::default();
    let submissions: Vec<_> = submissions.into_iter().map(Arc::new).collect();
    show_states(&mut samples, &submissions);
    samples
}

fn boards(leaderboards: impl IntoIterator<Item = Leaderboard>, submissions: &[Submission]) -> Samples {
    let mut samples = Samples::default();
    let leaderboards: Vec<_> = leaderboards.into_iter().map(Arc::new).collect();
    let submissions: Vec<_> = submissions.iter().cloned().map(Arc::new).collect();
    show_boards(
        &mut samples,
        &leaderboards,
        &submissions,
        &LeaderboardState::default(),
        now(),
    );
    samples
}

#[test]
fn each_leaderboard_shows_its_readiness_and_how_long_its_oldest_have_waited() {
    let ended = |published: (&'static str, &'static str), minute| {
        let published = ("Published", published.0, published.1, 59);
        submission("a", &[("Finished", "True", "Finished", minute), published])
    };
    let mut submissions = vec![
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
        ended(("False", "Waiting"), 40),
        ended(("False", "Waiting"), 50),
        ended(("False", "Refused"), 3),
        ended(("False", "NotRequired"), 3),
        ended(("True", "Published"), 3),
        submission("unknown", &[("Finished", "False", "Preparing", 0)]),
    ];
    // Two have a slot; one that has ended has given it back.
    for had_job in &mut submissions[2..5] {
        had_job.status.as_mut().unwrap().job_name = Some("job".into());
    }
    let found = boards([board("a", "us", "True"), board("b", "us", "False")], &submissions);
    let shown = |gauge| lines(&found, gauge);
    assert_eq!(shown("ready"), ["leaderboard=one/a 1", "leaderboard=one/b 0"]);
    assert_eq!(
        shown("oldest_pending_seconds"),
        ["leaderboard=one/a 2400", "leaderboard=one/b 0"]
    );
    assert_eq!(shown("slots_in_use"), ["leaderboard=one/a 2", "leaderboard=one/b 0"]);
    assert_eq!(
        shown("oldest_unpublished_seconds"),
        ["leaderboard=one/a 1200", "leaderboard=one/b 0"]
    );
}

#[test]
fn a_new_submission_waits_since_it_was_made() {
    let mut new = named("one", "a", &Value::Null);
    new.metadata.creation_timestamp = Some(serde_json::from_value(json!("2026-01-01T00:59:00Z")).unwrap());
    let found = boards([board("a", "us", "True")], &[new]);
    assert_eq!(lines(&found, "oldest_pending_seconds"), ["leaderboard=one/a 60"]);
}

/// One in a state, as its conditions show it.
fn in_state(state: State, reason: Option<&str>, class: Option<&str>) -> Submission {
    let conditions: &[_] = match state {
        State::Pending => &[("Finished", "False", "Preparing", 1)],
        State::Running | State::Resumed => &[("Running", "True", "Running", 1)],
        State::Finished => &[("Finished", "True", "Finished", 1)],
        State::Failed | State::Cancelled => &[("Finished", "True", "AsItEnded", 1)],
    };
    let mut one = submission("a", conditions);
    let failure = class.map(|class| json!({"class": class, "reason": "R", "message": "M"}));
    let status = one.status.as_mut().unwrap();
    // The gauges must not read these fields, which are for people.
    status.state = Some(State::Resumed);
    status.attempt = Some(Attempt::FIRST);
    status.reason = reason.map(Into::into);
    status.failure = serde_json::from_value(json!(failure)).unwrap();
    one
}

#[test]
fn submissions_are_counted_by_the_reason_and_the_class_of_their_failure() {
    let all = [
        named("unseen", "a", &Value::Null),
        in_state(State::Failed, Some("AgentCrashed"), Some("Participant")),
        in_state(State::Failed, Some("AgentCrashed"), Some("Participant")),
        in_state(State::Failed, Some("AgentCrashed"), Some("Infrastructure")),
        // The failure of an earlier attempt is no failure of the attempt that runs now.
        in_state(State::Running, None, Some("Infrastructure")),
        in_state(State::Cancelled, Some("of a version to come"), None),
    ];
    let expected = [
        "state=Cancelled,reason=Other,class= 1",
        "state=Failed,reason=AgentCrashed,class=Infrastructure 1",
        "state=Failed,reason=AgentCrashed,class=Participant 2",
        "state=Pending,reason=None,class= 1",
        "state=Running,reason=Running,class= 1",
    ];
    assert_eq!(lines(&states(all), "submissions_by_reason"), expected);
}

#[test]
fn every_state_is_counted_also_with_nobody_in_it() {
    let failed = || in_state(State::Failed, None, Some("Participant"));
    let all = [submission("a", &[]), failed(), failed()];
    let found = states(all);
    let expected = [
        "state=Cancelled 0",
        "state=Failed 2",
        "state=Finished 0",
        "state=Pending 1",
        "state=Resumed 0",
        "state=Running 0",
    ];
    assert_eq!(lines(&found, "submissions"), expected);
}

/// The Pod has had four GPUs for so many minutes, and Jobs before it used 100 GPU seconds.
fn holding(minutes: u32, running: &str, stopped: &str) -> Value {
    let condition = |name: &str, status: &str, since: &str| json!({"type": name, "status": status, "reason": "R", "message": "", "lastTransitionTime": since});
    json!({
        "use": {"gpus": 4, "gpuSeconds": 100},
        "times": {"scheduled": format!("2026-01-01T00:{:02}:00Z", 60 - minutes)},
        "conditions": [condition("Finished", "False", "2026-01-01T00:00:00Z"), condition("Running", running, stopped)],
    })
}

fn gpu_use(all: &[Submission]) -> Vec<String> {
    let found = lines(&boards([board("a", "us", "True")], all), "submission_gpu_seconds");
    found
        .iter()
        .map(|line| line.replace("leaderboard=one/a,submission=", ""))
        .collect()
}

#[test]
fn one_that_holds_gpus_has_what_it_has_used_until_now() {
    let begun = "2026-01-01T00:00:00Z";
    let all = [
        named("drives", "a", &holding(10, "True", "2026-01-01T00:51:00Z")),
        named("pulls", "a", &holding(5, "False", begun)),
        named("lost", "a", &holding(30, "False", "2026-01-01T00:40:00Z")),
        named("elsewhere", "b", &holding(30, "True", begun)),
    ];
    assert_eq!(gpu_use(&all), ["drives 2500", "lost 2500", "pulls 1300"]);
}

#[test]
fn what_has_ended_waits_or_has_no_gpu_is_not_shown() {
    let live = holding(10, "True", NOW);
    let with = |key: &str, value: Value| {
        let mut status = live.clone();
        status[key] = value;
        named("one", "a", &status)
    };
    let ended =
        json!([{"type": "Finished", "status": "True", "reason": "Finished", "message": "", "lastTransitionTime": NOW}]);
    let none = [
        with("conditions", ended),
        with("times", json!({})),
        with("use", json!({"gpus": 0, "gpuSeconds": 100})),
        with("use", Value::Null),
        named("one", "a", &Value::Null),
    ];
    assert_eq!(gpu_use(&none), [""; 0]);
}

#[test]
fn five_hundred_of_a_leaderboard_have_a_sample_each_and_the_others_one() {
    let minutes = |number: u32| if number == 0 { 59 } else { 10 };
    let one = |number: u32| named(&format!("s-{number:03}"), "a", &holding(minutes(number), "True", NOW));
    let all: Vec<Submission> = (0..502).rev().map(one).collect();
    let found = gpu_use(&all);
    assert_eq!(found.len(), MAX_SHOWN + 1);
    assert_eq!(found[0], format!("other {}", 2 * (100 + 4 * 600)));
    assert_eq!(found[1], format!("s-000 {}", 100 + 4 * 3540));
}

#[tokio::test]
async fn a_walk_shows_the_leaderboards_that_this_installation_drives() {
    let ours = fixtures::leaderboard("a", "http://127.0.0.1:9");
    let cluster = Cluster {
        leaderboards: vec![ours, board("b", "them", "True")],
        submissions: vec![submission("a", &[("Finished", "False", "Preparing", 50)])],
        ..Cluster::default()
    };
    let around = Box::pin(surroundings(cluster, "http://127.0.0.1:9")).await;
    let (_stop, stopped) = Stop::new();
    let telemetry = Observability::new(stopped);
    let shared = Shared {
        context: Arc::new(around.context),
        queues: Queues::new(1, &telemetry.metrics),
        backoff: BackoffMap::default(),
        telemetry,
    };
    shared
        .queues
        .submissions
        .add(&ObjectRef::<Submission>::new("one").within("one"), Class::New);
    let ready = |found: &Shared| found.queues.leaderboards.depth().iter().sum::<usize>();
    assert_eq!(ready(&shared), 0);
    let found = walk(&shared, now());
    assert_eq!(ready(&shared), 1, "its status has no count yet of the one that waits");
    assert_eq!(lines(&found, "ready"), ["leaderboard=one/a 0"]);
    assert_eq!(lines(&found, "oldest_pending_seconds"), ["leaderboard=one/a 600"]);
    assert_eq!(lines(&found, "slots_in_use"), ["leaderboard=one/a 0"]);
    assert_eq!(lines(&found, "table_rows_waiting"), ["leaderboard=one/a 0"]);
    assert_eq!(lines(&found, "slots_limit"), [""; 0], "nothing limits it");
    let waiting = lines(&found, "reconciles_waiting");
    assert!(
        waiting.contains(&"kind=Submission,class=new 1".to_owned()),
        "{waiting:?}"
    );
}

#[tokio::test(start_paused = true)]
async fn who_begins_to_lead_walks_at_once_and_then_after_each_interval_until_the_stop() {
    let (stop, stopped) = Stop::new();
    let telemetry = Observability::new(stopped);
    telemetry.metrics.set_leading(Some(1));
    let began = Instant::now();
    let walk = move || {
        let mut samples = Samples::default();
        samples.set(&leader::SUBMISSIONS, ["Pending"], began.elapsed().as_secs());
        samples
    };
    let kept = tokio::spawn(keep(EVERY, walk, telemetry.clone()));
    for at in [0, 15, 30] {
        tokio::time::sleep_until(began + Duration::from_millis(at * 1000 + 1)).await;
        let text = telemetry.metrics.text().unwrap();
        let line = format!("leaderboard_submissions{{state=\"Pending\"}} {at}\n");
        assert!(text.contains(&line), "{line} is missing in\n{text}");
    }
    stop.send(true).unwrap();
    kept.await.unwrap();
}
