//! Writes of a host's worker: progress, results, partial results, and their faults.

#![allow(clippy::unwrap_used, reason = "a helper that fails fails its test")]

mod support;

use evalai_stand_in::errors;
use serde_json::{Value, json};
use support::{HOST, PARTIAL, Stand, TEAM_A, UPDATE, put_body, result};

#[tokio::test]
async fn a_run_goes_from_submitted_to_the_leaderboard() {
    let stand = Stand::start().await;
    let pk = stand.submit().await;
    assert_eq!(stand.submission(pk).await["execution_time"], "None");

    let queued = json!({"submission": pk.to_string(), "submission_status": "QUEUED", "job_name": "Submission-1-1"});
    let first = stand.patch(UPDATE, &queued).await.ok().json();
    assert_eq!(
        (&first["status"], &first["job_name"]),
        (&json!("queued"), &json!(["submission-1-1"]))
    );
    let again = stand.patch(UPDATE, &queued).await.ok().json();
    assert_eq!(
        again["job_name"],
        json!(["submission-1-1", "submission-1-1"]),
        "appended without a look"
    );
    assert!(
        again["started_at"].as_str() > first["started_at"].as_str(),
        "each PATCH starts the clock again"
    );

    stand.put(UPDATE, &put_body(pk, "Finished", 43.5)).await.ok();
    let after = stand.submission(pk).await;
    assert_eq!(after["status"], "finished");
    assert!(after["execution_time"].is_f64(), "{after}");

    let board = stand
        .get("/api/jobs/challenge_phase_split/1/leaderboard/", "")
        .await
        .ok()
        .json();
    let entry = &board["results"][0];
    assert_eq!((&board["count"], &entry["submission__id"]), (&json!(1), &json!(pk)));
    assert_eq!(entry["result"][0], 43.5);
    assert_eq!(entry["result"][1], "#", "a metric that is missing is not refused");

    stand.put(UPDATE, &put_body(pk, "finished", 50.0)).await.ok();
    let rows = stand.handle.state().rows;
    assert_eq!(rows.len(), 1, "one after the other, the row is overwritten");
    assert_eq!(rows[&1].result["Driving score"], 50.0);

    stand.put(UPDATE, &put_body(pk, "failed", 0.0)).await.ok();
    let board = stand
        .get("/api/jobs/challenge_phase_split/1/leaderboard/", "")
        .await
        .ok()
        .json();
    assert_eq!(board["count"], 0);
    assert_eq!(stand.handle.state().rows.len(), 1, "the row stays and is not shown");
}

#[tokio::test]
async fn texts_are_stored_and_the_environment_log_is_for_hosts() {
    let stand = Stand::start().await;
    let pk = stand.submit().await;
    let mut body = put_body(pk, "finished", 1.0);
    body["metadata"] = json!({"k": [1, null, true]});
    stand.put(UPDATE, &body).await.ok();
    let host = stand.submission(pk).await;
    for (field, text) in [
        ("stdout_file", "out"),
        ("stderr_file", "err"),
        ("environment_log_file", "secret"),
        ("submission_result_file", "[{'Driving score': 1.0}]"),
        (
            "input_file",
            r#"{"submitted_image_uri":"registry.example/carla/team-a:7f3"}"#,
        ),
    ] {
        let url = host[field].as_str().unwrap();
        assert!(url.starts_with(&stand.handle.url()), "{url}");
        let got = stand.get(url.strip_prefix(&stand.handle.url()).unwrap(), "").await.ok();
        assert_eq!(got.text, text, "{field}");
    }
    let metadata = stand.handle.with_state(|state| {
        let path = state.submissions[&pk].submission_metadata_file.clone().unwrap();
        String::from_utf8(state.files[&path].clone()).unwrap()
    });
    assert_eq!(metadata, "{'k': [1, None, True]}");

    let own = stand
        .get(&format!("/api/jobs/submission/{pk}"), TEAM_A)
        .await
        .ok()
        .json();
    assert!(own.get("environment_log_file").is_none());
    assert!(own["stdout_file"].is_string());

    let files = stand.handle.state().files.len();
    stand
        .put(UPDATE, &json!({"submission": pk, "submission_status": "failed"}))
        .await
        .ok();
    assert_eq!(
        stand.handle.state().files.len(),
        files + 5,
        "each PUT leaves five new files"
    );
    let stderr = stand.submission(pk).await["stderr_file"].as_str().unwrap().to_owned();
    let path = stderr.strip_prefix(&stand.handle.url()).unwrap();
    assert_eq!(
        stand.get(path, "").await.ok().text,
        "",
        "omitted texts overwrite earlier ones"
    );
}

/// The change of a PUT of a result, and the answer with its values.
type Refusal = (Value, errors::ErrorText, &'static [&'static str]);

fn refusals_of_fields() -> Vec<Refusal> {
    vec![
        (json!({"submission": 99}), errors::SUBMISSION_NOT_FOUND, &["99"]),
        (json!({"submission": null}), errors::SUBMISSION_NOT_FOUND, &["None"]),
        (
            json!({"submission": 99, "submission_status": "x"}),
            errors::SUBMISSION_NOT_FOUND,
            &["99"],
        ),
        (json!({"submission": "x"}), errors::SERVER_ERROR, &[]),
        (json!({"stdout": null}), errors::SERVER_ERROR, &[]),
        (json!({"environment_log": 3}), errors::SERVER_ERROR, &[]),
        (json!({"submission_status": null}), errors::SERVER_ERROR, &[]),
        (
            json!({"submission_status": "partially_evaluated"}),
            errors::INVALID_STATUS,
            &[],
        ),
        (json!({"submission_status": "running"}), errors::INVALID_STATUS, &[]),
        (
            json!({"challenge_phase": null}),
            errors::SPLIT_NOT_FOUND,
            &["None", "leaderboard"],
        ),
        (json!({"challenge_phase": "x"}), errors::SERVER_ERROR, &[]),
    ]
}

fn refusals_of_results() -> Vec<Refusal> {
    const EMPTY: &[&str] = &["Expecting value: line 1 column 1 (char 0)"];
    const NO_TEXT: &[&str] = &["the JSON object must be str, bytes or bytearray, not list"];
    let item = |split: &str, accuracies: &Value| json!({"result": json!([{"split": split, "accuracies": accuracies}]).to_string()});
    let not_a_number = result(&json!({"Driving score": 0.5})).replace("0.5", "NaN");
    vec![
        (json!({"result": []}), errors::RESULT_INVALID, NO_TEXT),
        (json!({"result": ""}), errors::RESULT_INVALID, EMPTY),
        (json!({"result": "{\"a\": 1}"}), errors::SERVER_ERROR, &[]),
        (
            json!({"result": "[{\"split\": \"leaderboard\"}]"}),
            errors::SERVER_ERROR,
            &[],
        ),
        (item("nope", &json!({})), errors::SPLIT_NOT_FOUND, &["1", "nope"]),
        (
            item("leaderboard", &json!({"Bogus": 1, "Driving score": "x"})),
            errors::METRICS_UNKNOWN,
            &["['Bogus']"],
        ),
        (
            item("leaderboard", &json!({"Driving score": "x"})),
            errors::METRICS_MALFORMED,
            &["[('Driving score', <class 'str'>)]"],
        ),
        (json!({ "result": not_a_number }), errors::RESULT_NOT_FINITE, &[]),
    ]
}

fn changed(pk: u64, change: &Value) -> Value {
    let mut body = put_body(pk, "finished", 1.0);
    body.as_object_mut()
        .unwrap()
        .extend(change.as_object().unwrap().clone());
    body
}

#[tokio::test]
async fn results_are_checked_in_the_servers_order_before_anything_is_written() {
    let stand = Stand::start().await;
    let pk = stand.submit().await;
    let before = serde_json::to_value(stand.handle.state()).unwrap();
    for (change, error, values) in refusals_of_fields().into_iter().chain(refusals_of_results()) {
        stand.put(UPDATE, &changed(pk, &change)).await.is(&error, values);
    }
    assert_eq!(
        serde_json::to_value(stand.handle.state()).unwrap(),
        before,
        "nothing was written"
    );
}

#[tokio::test]
async fn much_is_not_checked_at_all() {
    let stand = Stand::start().await;
    let pk = stand.submit().await;
    stand.put(UPDATE, &changed(pk, &json!({"result": "[]"}))).await.ok();
    assert!(
        stand.handle.state().rows.is_empty(),
        "an empty list finishes without a row"
    );

    let foreign = json!({"challenge_phase": "2", "result": result(&json!({"Driving score": true}))});
    stand.put(UPDATE, &changed(pk, &foreign)).await.ok();
    assert_eq!(
        stand.handle.state().rows[&1].split,
        2,
        "a phase that is not the submission's gets the row"
    );

    let one = json!({"split": "leaderboard", "accuracies": {"Driving score": 1}});
    let twice = json!({"result": json!([one, one]).to_string()});
    stand.put(UPDATE, &changed(pk, &twice)).await.ok();
    assert_eq!(
        stand.handle.state().rows.len(),
        3,
        "the same split twice, with no row yet, makes two rows"
    );
}

#[tokio::test]
async fn no_transition_is_refused() {
    let stand = Stand::start().await;
    let pk = stand.submit().await;
    stand.cancel(pk, HOST).await.ok();
    stand.put(UPDATE, &put_body(pk, "finished", 1.0)).await.ok();
    assert_eq!(
        stand.submission(pk).await["status"],
        "finished",
        "a late result revives a cancelled submission"
    );
    stand
        .patch(UPDATE, &json!({"submission": pk, "submission_status": "running"}))
        .await
        .ok();
    assert_eq!(
        stand.submission(pk).await["status"],
        "running",
        "a late PATCH opens a finished one"
    );
    let error = stand
        .patch(UPDATE, &json!({"submission": pk, "submission_status": "finished"}))
        .await;
    error.is(&errors::INVALID_STATUS, &[]);
    let error = stand
        .patch(
            UPDATE,
            &json!({"submission": pk, "submission_status": "running", "job_name": null}),
        )
        .await;
    error.is(&errors::SERVER_ERROR, &[]);
}

#[tokio::test]
async fn concurrent_results_double_the_row_and_then_fail_permanently() {
    let stand = Stand::start().await;
    let pk = stand.submit().await;
    stand.knobs(&json!({"put_delay_ms": 2_000})).await;
    let body = put_body(pk, "finished", 7.0);
    let (one, two) = tokio::join!(stand.put(UPDATE, &body), stand.put(UPDATE, &body));
    assert_eq!((one.status, two.status), (200, 200), "both read before either saved");
    assert_eq!(stand.handle.state().rows.len(), 2);

    stand.knobs(&json!({"put_delay_ms": 0})).await;
    for status in ["finished", "FINISHED"] {
        stand
            .put(UPDATE, &put_body(pk, status, 8.0))
            .await
            .is(&errors::SERVER_ERROR, &[]);
    }
    stand.put(UPDATE, &put_body(pk, "failed", 0.0)).await.ok();
    stand.handle.with_state(|state| state.rows.remove(&2));
    stand.put(UPDATE, &put_body(pk, "finished", 8.0)).await.ok();
}

#[tokio::test]
async fn a_late_partial_result_undoes_a_cancel() {
    let stand = Stand::start().await;
    let pk = stand.submit().await;
    stand.knobs(&json!({"put_delay_ms": 2_000})).await;
    let body = put_body(pk, "partially_evaluated", 12.0);
    let partial = stand.put(PARTIAL, &body);
    let cancel = async {
        stand
            .wait_until(|_, requests| requests.entries().any(|request| request.method == "PUT"))
            .await;
        // One thread runs all of it: when this one goes on, the PUT has read its rows and waits.
        stand.cancel(pk, TEAM_A).await.ok();
        stand.submission(pk).await["status"].clone()
    };
    let (partial, seen) = tokio::join!(partial, cancel);
    partial.ok();
    assert_eq!(seen, "cancelled", "the participant saw the cancel");
    assert_eq!(
        stand.submission(pk).await["status"],
        "partially_evaluated",
        "and the whole row was saved over it"
    );
}

#[tokio::test]
async fn a_request_is_worked_on_to_its_end_when_its_client_is_gone() {
    let stand = Stand::start().await;
    let pk = stand.submit().await;
    stand.knobs(&json!({"put_delay_ms": 2_000})).await;
    let body = put_body(pk, "finished", 1.0);
    let mut put = Box::pin(stand.put(UPDATE, &body));
    let logged = stand.wait_until(|_, requests| requests.entries().any(|request| request.method == "PUT"));
    tokio::select! {
        _ = &mut put => panic!("answered before its delay"),
        () = logged => {}
    }
    drop(put);
    stand
        .wait_until(|state, _| state.submissions[&pk].status.as_str() == "finished")
        .await;
    assert_eq!(stand.handle.state().rows.len(), 1);
}

#[tokio::test]
async fn partial_results_are_put_once_and_then_merged() {
    let stand = Stand::start().await;
    let pk = stand.submit().await;
    let text = pk.to_string();
    stand
        .patch(PARTIAL, &put_body(pk, "finished", 1.0))
        .await
        .is(&errors::NO_LEADERBOARD_DATA, &["1", &text]);
    stand
        .patch(PARTIAL, &put_body(pk, "queued", 1.0))
        .await
        .is(&errors::INVALID_STATUS, &[]);
    let mut bogus = put_body(pk, "partially_evaluated", 1.0);
    bogus["result"] = result(&json!({"X": 1})).into();
    stand
        .put(PARTIAL, &bogus)
        .await
        .is(&errors::METRICS_UNKNOWN_PARTIAL, &["['X']", "1"]);

    stand
        .put(PARTIAL, &put_body(pk, "partially_evaluated", 10.0))
        .await
        .ok();
    assert_eq!(
        stand.submission(pk).await["environment_log_file"],
        Value::Null,
        "this endpoint has no such text"
    );
    let board = || async {
        stand
            .get("/api/jobs/challenge_phase_split/1/leaderboard/", "")
            .await
            .ok()
            .json()
    };
    assert_eq!(board().await["count"], 0, "shown only if the phase says so");
    let phase = |state: &mut evalai_stand_in::State| {
        state.seed.challenges[0].phases[0].is_partial_submission_evaluation_enabled = true;
    };
    stand.handle.with_state(phase);
    assert_eq!(board().await["count"], 1);

    let mut more = put_body(pk, "finished", 1.0);
    more["result"] = result(&json!({"Route completion": 55})).into();
    stand.patch(PARTIAL, &more).await.ok();
    let row = stand.handle.state().rows[&1].result.clone();
    assert_eq!(
        Value::Object(row),
        json!({"Driving score": 10.0, "Route completion": 55})
    );
    let running = stand
        .patch(PARTIAL, &json!({"submission": pk, "submission_status": "running"}))
        .await
        .ok()
        .json();
    assert_eq!(running["status"], "running");
}

#[tokio::test]
async fn only_hosts_write_results() {
    let stand = Stand::start().await;
    let pk = stand.submit().await;
    let body = put_body(pk, "finished", 1.0);
    let put = async |path: &str, auth: &str| stand.call(reqwest::Method::PUT, path, auth, &body).await;
    stand.handle.with_state(|state| state.seed.challenges[2].hosts.clear());
    put(UPDATE, TEAM_A).await.is(&errors::NOT_HOST, &[]);
    put(&UPDATE.replace('1', "99"), HOST).await.is(&errors::NOT_HOST, &[]);
    put(&UPDATE.replace('1', "3"), HOST).await.is(&errors::NOT_HOST, &[]);
    put(PARTIAL, "Bearer local-staff-token")
        .await
        .is(&errors::NOT_HOST, &[]);
    put(UPDATE, "Bearer local-staff-token").await.ok();
    put(&UPDATE.replace('1', "2"), HOST).await.ok();

    let path = "/api/jobs/submission/1/update_started_at/";
    let started = stand.call(reqwest::Method::PATCH, path, TEAM_A, &Value::Null).await;
    assert!(
        started.ok().json()["started_at"].is_string(),
        "anybody may start anybody's clock"
    );
    let unknown = stand
        .patch("/api/jobs/submission/9/update_started_at/", &json!({}))
        .await;
    unknown.is(&errors::STARTED_AT_UNKNOWN, &[]);
}

#[tokio::test]
async fn a_host_corrects_a_row_with_exactly_its_labels() {
    let stand = Stand::start().await;
    let pk = stand.submit().await;
    stand.put(UPDATE, &put_body(pk, "finished", 1.0)).await.ok();
    let path = "/api/jobs/leaderboard_data/1/";
    let send = |data: &Value| json!({ "leaderboard_data": data.to_string() });
    stand.patch(path, &json!({})).await.is(&errors::ROW_BLANK, &[]);
    stand
        .patch("/api/jobs/leaderboard_data/2/", &json!({}))
        .await
        .is(&errors::ROW_NOT_FOUND, &[]);
    let labels = stand.handle.state().seed.challenges[0].phases[0].splits[0]
        .schema
        .labels
        .clone();
    let mut all: Value = labels.iter().map(|label| (label.clone(), json!(2))).collect();
    let corrected = stand.patch(path, &send(&all)).await.ok().json();
    assert_eq!(corrected["result"]["Agent blocked"], 2);
    all["Bogus"] = json!(1);
    stand
        .patch(path, &send(&all))
        .await
        .is(&errors::ROW_EXTRA, &["['Bogus']"]);
    all.as_object_mut().unwrap().remove("Agent blocked");
    let both = ["['Agent blocked']", "['Bogus']"];
    stand
        .patch(path, &send(&all))
        .await
        .is(&errors::ROW_MISSING_AND_EXTRA, &both);
    all.as_object_mut().unwrap().remove("Bogus");
    stand
        .patch(path, &send(&all))
        .await
        .is(&errors::ROW_MISSING, &["['Agent blocked']"]);
}
