//! Requests and races on a mock API server.

use tracing::Instrument;

use super::*;
use crate::observability::logging::tests::Lines;
use leaderboard_base::trace_id::TraceId;

/// Answers each request in turn by `script`, and returns what was asked.
async fn against(
    script: Vec<(u16, Value)>,
    incoming: Incoming,
) -> (Result<Outcome, IngestError>, Vec<(String, Value)>) {
    let (service, mut handle) =
        tower_test::mock::pair::<http::Request<kube::client::Body>, http::Response<kube::client::Body>>();
    let client = kube::Client::new(service, "ns");
    let server = tokio::spawn(async move {
        let mut asked = Vec::new();
        for (code, body) in script {
            let (request, send) = handle.next_request().await.unwrap();
            let line = format!("{} {}", request.method(), request.uri().path());
            let bytes = request.into_body().collect_bytes().await.unwrap();
            asked.push((line, serde_json::from_slice(&bytes).unwrap_or(Value::Null)));
            let body = serde_json::to_vec(&body).unwrap();
            send.send_response(http::Response::builder().status(code).body(body.into()).unwrap());
        }
        asked
    });
    let api = Api::namespaced(client, "ns");
    let outcome = apply(&api, BOARD, &incoming).await;
    // Ends a script that was not asked for to its end.
    drop(api);
    (outcome, server.await.unwrap())
}

fn refusal(code: u16, reason: &str) -> (u16, Value) {
    let body = json!({"kind": "Status", "apiVersion": "v1", "status": "Failure", "code": code, "reason": reason, "message": format!("{reason} indeed")});
    (code, body)
}

fn object(submission: &Submission) -> (u16, Value) {
    (200, serde_json::to_value(submission).unwrap())
}

const ALL: &str = "/apis/leaderboard.carla.org/v1alpha1/namespaces/ns/submissions";
const ONE: &str = "/apis/leaderboard.carla.org/v1alpha1/namespaces/ns/submissions/submission-3";

#[tokio::test]
async fn a_new_one_costs_one_request() {
    let first = message("a", 100);
    let (outcome, asked) = against(vec![object(&made_by(&first))], first).await;
    assert_eq!(outcome.unwrap(), Outcome::Created);
    assert_eq!(asked[0].0, format!("POST {ALL}"));
    assert_eq!(
        asked[0].1["metadata"]["finalizers"],
        json!([names::FINALIZER_SUBMISSION])
    );
}

#[tokio::test]
async fn of_two_replicas_at_once_the_second_finds_a_repeat() {
    let first = message("a", 100);
    let script = vec![refusal(409, "AlreadyExists"), object(&made_by(&first))];
    let (outcome, asked) = against(script, first).await;
    assert_eq!(outcome.unwrap(), Outcome::Repeat);
    assert_eq!(asked[1].0, format!("GET {ONE}"));
}

#[tokio::test]
async fn a_bump_is_one_patch_bound_to_what_was_read() {
    let failed = with_state(made_by(&message("a", 100)), State::Failed);
    let script = vec![refusal(409, "AlreadyExists"), object(&failed), object(&failed)];
    let (outcome, asked) = against(script, message("b", 200)).await;
    assert_eq!(outcome.unwrap(), Outcome::Bumped(Attempt(2)));
    assert_eq!(asked[2].0, format!("PATCH {ONE}"));
    let record = json!({"message": "b", "sent": 200, "attempt": 2}).to_string();
    let want = json!({
        "metadata": {"resourceVersion": "10", "annotations": {names::ANNOTATION_INGESTED: record}},
        "spec": {"attempt": 2, "cancel": false},
    });
    assert_eq!(asked[2].1, want);
}

#[tokio::test]
async fn a_refusal_is_noted_and_changes_no_attempt() {
    let failed = with_state(made_by(&message("a", 100_000)), State::Failed);
    let script = vec![refusal(409, "AlreadyExists"), object(&failed), object(&failed)];
    let (outcome, asked) = against(script, sweep(300_000)).await;
    assert_eq!(outcome.unwrap(), Outcome::Refused);
    let record =
        json!({"message": "a", "sent": 100_000, "attempt": 1, "refused": {"attempt": 2, "at": 300_000}}).to_string();
    let want = json!({
        "metadata": {"resourceVersion": "10", "annotations": {names::ANNOTATION_INGESTED: record}},
        "spec": {},
    });
    assert_eq!(
        (asked[2].0.as_str(), &asked[2].1),
        (format!("PATCH {ONE}").as_str(), &want)
    );
}

#[tokio::test]
async fn the_sweep_leaves_a_hosts_cancel_as_it_is() {
    let mut cancelled = with_state(made_by(&message("a", 100_000)), State::Cancelled);
    cancelled.spec.cancel = true;
    let script = vec![object(&cancelled), object(&cancelled)];
    let (outcome, asked) = against(script, swept_resume(300_000)).await;
    assert_eq!(outcome.unwrap(), Outcome::Refused);
    assert_eq!(asked[1].1["spec"], json!({}));
}

#[tokio::test]
async fn whether_a_row_that_was_run_before_has_an_object_is_read_first() {
    let edited = || incoming(Source::Sweep(Swept::Edited), 300_000);
    let (outcome, asked) = against(vec![refusal(404, "NotFound")], edited()).await;
    assert_eq!(outcome.unwrap(), Outcome::NotNew);
    assert_eq!(asked[0].0, format!("GET {ONE}"));
    let failed = with_state(made_by(&message("a", 100_000)), State::Failed);
    let (outcome, asked) = against(vec![object(&failed), object(&failed)], edited()).await;
    assert_eq!(outcome.unwrap(), Outcome::Refused);
    assert_eq!(asked[1].0, format!("PATCH {ONE}"));
}

#[tokio::test]
async fn of_two_bumps_at_once_the_second_finds_a_repeat() {
    let failed = with_state(made_by(&message("a", 100)), State::Failed);
    let resume = message("b", 200);
    let script = vec![
        refusal(409, "AlreadyExists"),
        object(&failed),
        refusal(409, "Conflict"),
        object(&bumped(failed.clone(), &resume)),
    ];
    let (outcome, asked) = against(script, resume).await;
    assert_eq!(outcome.unwrap(), Outcome::Repeat);
    assert_eq!(asked.len(), 4);
}

#[tokio::test]
async fn one_that_vanishes_in_between_is_created() {
    let failed = with_state(made_by(&message("a", 100)), State::Failed);
    let script = vec![
        refusal(409, "AlreadyExists"),
        object(&failed),
        refusal(404, "NotFound"),
        refusal(404, "NotFound"),
        object(&failed),
    ];
    let (outcome, asked) = against(script, message("b", 200)).await;
    assert_eq!(outcome.unwrap(), Outcome::Created);
    assert_eq!(asked[4].0, format!("POST {ALL}"));
}

#[tokio::test]
async fn a_permanent_refusal_differs_from_a_passing_failure() {
    let (refused, _) = against(vec![refusal(422, "Invalid")], message("a", 100)).await;
    assert!(matches!(refused, Err(IngestError::Refused { .. })), "{refused:?}");
    let (failed, _) = against(vec![refusal(403, "Forbidden")], message("a", 100)).await;
    let text = failed.unwrap_err().to_string();
    assert_eq!(
        text,
        "the creation of Submission submission-3 failed: the API server answered 403: Forbidden indeed; it is retried"
    );
}

#[tokio::test(start_paused = true)]
async fn a_silent_api_server_is_not_waited_for() {
    let (service, _handle) =
        tower_test::mock::pair::<http::Request<kube::client::Body>, http::Response<kube::client::Body>>();
    let api = Api::namespaced(kube::Client::new(service, "ns"), "ns");
    let outcome = apply(&api, BOARD, &message("a", 100)).await;
    assert!(
        matches!(
            outcome,
            Err(IngestError::Call(CallError::Silent {
                what: "the creation",
                ..
            }))
        ),
        "{outcome:?}"
    );
}

#[tokio::test]
async fn lines_about_what_comes_in_have_its_attempt_and_its_trace_once_its_object_is_known() {
    let lines = Lines::default();
    let _guard = lines.collect();
    let mut failed = with_state(made_by(&message("a", 100_000)), State::Failed);
    failed.metadata.uid = Some("uid".into());
    let mut resumed = failed.clone();
    resumed.spec.attempt = Attempt(2);
    let exists = || refusal(409, "AlreadyExists");
    for (script, attempt) in [
        (vec![refusal(403, "Forbidden")], None),
        (vec![object(&failed)], Some(1)),
        (vec![exists(), object(&failed), object(&resumed)], Some(2)),
        (vec![exists(), object(&failed), refusal(403, "Forbidden")], Some(1)),
    ] {
        let taken = async {
            let (outcome, _) = against(script, message("b", 200_000)).await;
            tracing::info!(is_done = outcome.is_ok(), "taken in");
        };
        taken.instrument(span("ns", BOARD, 3)).await;
        for line in lines.take_json() {
            let name = ["submission", "leaderboard"].map(|field| &line[field]);
            assert_eq!(json!(name), json!(["ns/submission-3", BOARD]), "{line}");
            let trace = attempt.map(|_| TraceId::of("uid").to_string());
            let expected = [attempt.map(Value::from), trace.map(Value::from)];
            assert_eq!(["attempt", "trace_id"].map(|field| line.get(field).cloned()), expected);
        }
    }
}

#[tokio::test]
async fn a_resume_that_comes_while_the_run_is_being_stopped_waits_for_its_end() {
    let first = message("a", 100_000);
    let resume = message("b", 200_000);
    let mut running = with_state(made_by(&first), State::Running);
    let mut cancelled = running.clone();
    cancelled.spec.cancel = true;
    let status = running.status.as_mut().unwrap();
    status.times.stopping = Some(Time(jiff::Timestamp::UNIX_EPOCH));
    for stopping in [running, cancelled] {
        check("the message that made it", &stopping, &first, &REPEAT);
        let script = vec![refusal(409, "AlreadyExists"), object(&stopping)];
        let (outcome, _) = against(script, resume.clone()).await;
        assert_eq!(outcome.unwrap(), Outcome::Stopping);
        check(
            "after its end",
            &with_state(stopping, State::Cancelled),
            &resume,
            &bump_to(2),
        );
    }
}

#[test]
fn what_has_finished_is_not_run_again_and_says_so() {
    let finished = with_state(made_by(&message("a", 100_000)), State::Finished);
    check("a late copy", &finished, &message("a", 100_000), &REPEAT);
    for resume in [message("b", 200_000), swept_resume(200_000)] {
        check("a resume", &finished, &resume, &refuse(2));
        check("once more", &refused(finished.clone(), 200_000), &resume, &REPEAT);
    }
}
