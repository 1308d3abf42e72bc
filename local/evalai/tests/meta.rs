//! `update_submission_meta`: any field, for participants too.

mod support;

use reqwest::Method;
use serde_json::{Value, json};
use support::{Got, HOST, Stand, TEAM_A, TEAM_B};

const META: &str = "/api/jobs/challenges/1/submissions/1/update_submission_meta/";

async fn edit(stand: &Stand, auth: &str, fields: &Value) -> Got {
    stand.call(Method::PATCH, META, auth, fields).await
}

#[tokio::test]
async fn a_participant_writes_every_field_of_the_own_row() {
    let stand = Stand::start().await;
    stand.submit().await;
    let fields = json!({
        "status": "submitted", "job_name": ["mine", "yours"], "challenge_phase": 2, "created_by": 12,
        "rerun_resumed_at": "2026-11-22T04:00:00Z", "started_at": "2026-11-22T03:00:00.5Z",
        "completed_at": "2026-11-22 05:00:00+01:00", "when_made_public": null, "is_baseline": true,
        "submission_metadata": {"a": [1]}, "stdout_file": null,
    });
    let row = edit(&stand, TEAM_A, &fields).await.ok().json();
    for (name, wanted) in fields.as_object().unwrap() {
        match name.as_str() {
            "started_at" => assert_eq!(row[name], "2026-11-22T03:00:00.500000Z"),
            "completed_at" => assert_eq!(row[name], "2026-11-22T04:00:00Z"),
            _ => assert_eq!(&row[name], wanted, "{name}"),
        }
    }
    assert_eq!(row["execution_time"], 3599.5);
    let team = edit(&stand, TEAM_A, &json!({"participant_team": "2"}))
        .await
        .ok()
        .json();
    assert_eq!(
        (&team["participant_team"], &team["participant_team_name"]),
        (&json!(2), &json!("team-b"))
    );
    assert_eq!(edit(&stand, TEAM_A, &json!({})).await.status, 404, "it is team b's now");
    edit(&stand, TEAM_B, &json!({})).await.ok();
    let read_only = json!({"id": 7, "submitted_at": "2020-01-01T00:00:00Z", "execution_time": 1, "nonsense": 1});
    let after = edit(&stand, HOST, &read_only).await.ok().json();
    let before = stand.submission(1).await;
    assert_eq!(after, before);
    assert_ne!(after["submitted_at"], "2020-01-01T00:00:00Z");
}

#[tokio::test]
async fn only_the_type_of_a_field_is_checked() {
    let stand = Stand::start().await;
    stand.submit().await;
    let before = stand.submission(1).await;
    let null = "This field may not be null.";
    let no_file = "The submitted data was not a file. Check the encoding type on the form.";
    for (name, value, error) in [
        ("input_file", json!("text"), no_file),
        ("input_file", Value::Null, null),
        ("stdout_file", json!({}), no_file),
        ("status", Value::Null, null),
        ("is_public", Value::Null, null),
        (
            "job_name",
            json!("one"),
            "Expected a list of items but got type \"str\".",
        ),
        (
            "challenge_phase",
            json!(99),
            "Invalid pk \"99\" - object does not exist.",
        ),
        (
            "participant_team",
            json!("x"),
            "Incorrect type. Expected pk value, received str.",
        ),
        ("created_by", Value::Null, null),
        (
            "rerun_resumed_at",
            json!("yesterday"),
            "Datetime has wrong format. Use one of these formats instead: \
             YYYY-MM-DDThh:mm[:ss[.uuuuuu]][+HH:MM|-HH:MM|Z].",
        ),
    ] {
        let got = edit(&stand, TEAM_A, &json!({ name: value, "method_name": "kept out" })).await;
        assert_eq!(got.status, 400, "{name}: {}", got.text);
        assert_eq!(got.json(), json!({ name: [error] }));
    }
    assert_eq!(stand.submission(1).await, before, "nothing was written");
}

#[tokio::test]
async fn a_file_is_a_form_with_a_file() {
    let stand = Stand::start().await;
    stand.submit().await;
    let before = stand.submission(1).await;
    let body = "--b\r\nContent-Disposition: form-data; name=\"input_file\"; filename=\"a.json\"\r\n\r\n{}\r\n--b--\r\n";
    let request = stand.request(Method::PATCH, META, TEAM_A).body(body);
    let got = Stand::send(request.header("content-type", "multipart/form-data; boundary=b")).await;
    let url = got.ok().json()["input_file"].as_str().unwrap().to_owned();
    assert_ne!(before["input_file"], url.as_str());
    let path = url.strip_prefix(&stand.handle.url()).unwrap();
    assert_eq!(stand.get(path, "").await.ok().text, "{}");
}
