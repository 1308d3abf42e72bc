//! Results as the real server takes, stores and shows them, with what it gets wrong.

#![allow(clippy::unwrap_used, reason = "a helper that fails fails its test")]

mod support;

use evalai_stand_in::errors;
use futures::future::join_all;
use serde_json::{Value, json};
use support::{HOST, PARTIAL, Stand, TEAM_A, UPDATE, put_body, result};

const LEADERBOARD: &str = "/api/jobs/challenge_phase_split/1/leaderboard/";

#[tokio::test]
async fn six_results_at_once_double_the_row_without_any_help() {
    let stand = Stand::start().await;
    let mut seen = Vec::new();
    // On an idle machine the first six are answered as in the real server: 200 200 200 500 500 500, with two rows.
    let pk = loop {
        let pk = stand.submit().await;
        let body = put_body(pk, "finished", 7.0);
        let answers = join_all((0..6).map(|_| stand.put(UPDATE, &body))).await;
        let mut statuses: Vec<_> = answers.iter().map(|got| got.status).collect();
        statuses.sort_unstable();
        let rows = stand.handle.state().rows.into_values();
        let rows = rows.filter(|row| row.submission == pk).count();
        if rows >= 2 && statuses[1] == 200 && statuses[5] == 500 {
            break pk;
        }
        seen.push((rows, statuses));
        assert!(seen.len() < 5, "{seen:?}");
    };
    let late = stand.put(UPDATE, &put_body(pk, "finished", 8.0)).await;
    late.is(&errors::SERVER_ERROR, &[]);
}

#[tokio::test]
async fn a_bool_is_taken_for_a_number_and_breaks_the_leaderboard_for_everybody() {
    let stand = Stand::start().await;
    let (pk, other) = (stand.submit().await, stand.submit().await);
    stand.put(UPDATE, &put_body(other, "finished", 1.0)).await.ok();
    let mut body = put_body(pk, "finished", 0.0);
    body["result"] = result(&json!({"Driving score": true})).into();
    stand.put(UPDATE, &body).await.ok();
    for auth in ["", HOST, TEAM_A] {
        stand.get(LEADERBOARD, auth).await.is(&errors::SERVER_ERROR, &[]);
    }
    let by_another = format!("{LEADERBOARD}?order_by=Route%20completion");
    assert_eq!(stand.get(&by_another, "").await.ok().json()["count"], 1);
    assert!(stand.get("/", "").await.ok().text.contains("500"));
    stand.cancel(pk, HOST).await.ok();
    assert_eq!(stand.get(LEADERBOARD, "").await.ok().json()["count"], 1);
}

#[tokio::test]
async fn shown_metrics_keep_the_order_they_were_sent_in() {
    let stand = Stand::start().await;
    let pk = stand.submit().await;
    let mut body = put_body(pk, "finished", 0.0);
    body["result"] = Value::from(
        r#"[{"split": "leaderboard", "accuracies": {"Stop sign infractions": 1, "Agent blocked": 2.5, "Driving score": 3},
            "show_to_participant": true}]"#,
    );
    let wanted = "[{'Stop sign infractions': 1, 'Agent blocked': 2.5, 'Driving score': 3}]";
    for path in [UPDATE, PARTIAL] {
        stand.put(path, &body).await.ok();
        let url = stand.submission(pk).await["submission_result_file"].clone();
        let path = url
            .as_str()
            .unwrap()
            .strip_prefix(&stand.handle.url())
            .unwrap()
            .to_owned();
        assert_eq!(stand.get(&path, "").await.ok().text, wanted);
    }
}

#[tokio::test]
async fn files_lie_below_challenge_phase_and_submission_and_have_their_type() {
    let stand = Stand::start().await;
    let pk = stand.submit().await;
    stand.put(UPDATE, &put_body(pk, "finished", 1.0)).await.ok();
    let row = stand.submission(pk).await;
    for (field, extension, content_type) in [
        ("input_file", "json", "application/json"),
        ("stdout_file", "txt", "text/plain"),
        ("stderr_file", "txt", "text/plain"),
        ("environment_log_file", "txt", "text/plain"),
        ("submission_result_file", "json", "application/json"),
    ] {
        let url = row[field].as_str().unwrap();
        let folder = format!(
            "{}/media/submission_files/challenge_1/phase_1/submission_{pk}/",
            stand.handle.url()
        );
        let name = url.strip_prefix(&folder).unwrap_or_else(|| panic!("{field}: {url}"));
        assert!(name.ends_with(&format!(".{extension}")), "{url}");
        let got = stand.get(url.strip_prefix(&stand.handle.url()).unwrap(), "").await.ok();
        assert_eq!(got.header("content-type"), content_type, "{field}");
    }
}

#[tokio::test]
async fn keys_are_read_as_the_database_reads_them() {
    let stand = Stand::start().await;
    stand.submit().await;
    let put = async |key: &Value| {
        let body = json!({"submission": key, "submission_status": "failed"});
        stand.put(UPDATE, &body).await
    };
    for key in [json!(1.0), json!(1.9), json!("1"), json!(" 1 ")] {
        put(&key).await.ok();
    }
    put(&json!("1.0")).await.is(&errors::SERVER_ERROR, &[]);
    let long = "99999999999999999999";
    put(&json!(long)).await.is(&errors::SUBMISSION_NOT_FOUND, &[long]);
    let got = stand.get(&format!("/api/jobs/submission/{long}"), HOST).await;
    got.is(&errors::NO_SUCH_SUBMISSION, &[long]);
}
