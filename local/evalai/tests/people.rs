//! Acts of participants and hosts, and the messages that follow.

mod support;

use evalai_stand_in::errors;
use reqwest::Method;
use serde_json::{Value, json};
use support::{HOST, IMAGE, PARTIAL, Stand, TEAM_A, TEAM_B, UPDATE, put_body};

const SUBMIT: &str = "/api/jobs/challenge/1/challenge_phase/1/submission/";

fn file() -> String {
    json!({ "submitted_image_uri": IMAGE }).to_string()
}

#[tokio::test]
async fn a_push_sends_string_keys() {
    let stand = Stand::start().await;
    let got = stand.upload(SUBMIT, TEAM_A, &file()).await;
    assert_eq!(got.status, 201, "{}", got.text);
    let row = got.json();
    assert_eq!(
        (&row["id"], &row["status"], &row["method_name"]),
        (&json!(1), &json!("submitted"), &json!("mine"))
    );
    let message = json!({
        "challenge_pk": "1", "phase_pk": "1", "is_static_dataset_code_upload_submission": false,
        "submitted_image_uri": IMAGE, "submission_pk": 1,
    });
    assert_eq!(stand.sent(), [message]);
    stand
        .upload(SUBMIT, TEAM_A, "{}")
        .await
        .is(&errors::SUBMIT_BAD_FILE, &["'submitted_image_uri'"]);
    stand
        .post(SUBMIT, TEAM_A, &json!({}))
        .await
        .is(&errors::SUBMIT_NO_FILE, &[]);
    stand
        .post(SUBMIT, TEAM_A, &json!({"file_url": "http://x/y"}))
        .await
        .is(&errors::SUBMIT_BAD_URL, &[]);
    let json = json!({"input_file": {"submitted_image_uri": IMAGE}});
    let got = stand.post(SUBMIT, TEAM_A, &json).await;
    got.is(&errors::SUBMIT_NO_FILE, &[]);
    let got = stand.upload(SUBMIT, HOST, &file()).await;
    got.is(&errors::SUBMIT_NO_TEAM, &[]);
    stand
        .upload(&SUBMIT.replace("phase/1", "phase/9"), TEAM_A, &file())
        .await
        .is(&errors::SUBMIT_NO_PHASE, &[]);
    for _ in 0..2 {
        assert_eq!(stand.upload(SUBMIT, TEAM_A, &file()).await.status, 201);
    }
    stand
        .upload(SUBMIT, TEAM_A, &file())
        .await
        .is(&errors::SUBMIT_CONCURRENT, &["3"]);
    assert_eq!(
        stand.upload(SUBMIT, TEAM_B, &file()).await.status,
        201,
        "another team has its own three"
    );
    let own = stand.get(SUBMIT, TEAM_A).await.ok().json();
    assert_eq!((&own["count"], &own["results"][0]["id"]), (&json!(3), &json!(3)));
}

#[tokio::test]
async fn an_image_may_be_missing_in_each_of_the_ways_seen() {
    let stand = Stand::start().await;
    for file in ["missing-image", "file-url", "no-file"] {
        let body = json!({"team": 2, "phase": 1, "image": IMAGE, "file": file});
        assert_eq!(stand.post("/_stand-in/submit", "", &body).await.status, 201, "{file}");
    }
    let strings = |pk: u64| json!({"challenge_pk": "1", "phase_pk": "1", "is_static_dataset_code_upload_submission": false, "submission_pk": pk});
    let integers = json!({"challenge_pk": 1, "phase_pk": 1, "submission_pk": 2});
    assert_eq!(stand.sent(), [strings(1), integers, strings(3)]);
    for (pk, status) in [(1, 200), (2, 200), (3, 404)] {
        let url = stand.submission(pk).await["input_file"].as_str().unwrap().to_owned();
        let got = stand.get(url.strip_prefix(&stand.handle.url()).unwrap(), "").await;
        assert_eq!((got.status, got.text.contains(IMAGE)), (status, status == 200), "{pk}");
    }
    let body = json!({"team": "team-a", "phase": 5, "image": "unused"});
    assert_eq!(stand.post("/_stand-in/submit", "", &body).await.status, 201);
    assert!(
        stand.sent()[3].get("submitted_image_uri").is_none(),
        "a challenge of predictions has no images"
    );

    let url = stand.submission(1).await["input_file"].clone();
    let got = stand.post(SUBMIT, TEAM_A, &json!({ "file_url": url })).await.ok();
    assert_eq!(
        got.json()["message"],
        "Please wait while your submission being evaluated!"
    );
    assert_eq!(
        stand.sent()[4],
        json!({"challenge_pk": 1, "phase_pk": 1, "submission_pk": 5})
    );
}

#[tokio::test]
async fn a_rerun_cancels_and_copies_into_a_new_key() {
    let stand = Stand::start().await;
    let pk = stand.submit().await;
    stand
        .patch(
            UPDATE,
            &json!({"submission": pk, "submission_status": "running", "job_name": "j"}),
        )
        .await
        .ok();
    stand.put(UPDATE, &put_body(pk, "finished", 1.0)).await.ok();
    stand
        .post("/api/jobs/submissions/1/re-run/", TEAM_A, &json!({}))
        .await
        .is(&errors::RERUN_FORBIDDEN, &[]);
    let got = stand
        .post("/api/jobs/submissions/1/re-run/", HOST, &json!({}))
        .await
        .ok();
    assert_eq!(
        got.json()["success"],
        "Submission is successfully submitted for re-running"
    );
    let (old, new) = (stand.submission(1).await, stand.submission(2).await);
    assert_eq!(
        (&old["status"], &new["status"]),
        (&json!("cancelled"), &json!("submitted"))
    );
    for same in [
        "job_name",
        "started_at",
        "completed_at",
        "submitted_at",
        "created_by",
        "input_file",
    ] {
        assert_eq!(old[same], new[same], "{same}");
    }
    assert_eq!(
        (&new["stdout_file"], &old["rerun_resumed_at"]),
        (&Value::Null, &Value::Null)
    );
    assert!(new["rerun_resumed_at"].is_string());
    let message = json!({
        "challenge_pk": 1, "phase_pk": 1, "submission_pk": 2,
        "is_static_dataset_code_upload_submission": false, "submitted_image_uri": IMAGE,
    });
    assert_eq!(stand.sent()[1], message);
}

#[tokio::test]
async fn only_a_failed_submission_is_resumed_and_keeps_its_key() {
    let stand = Stand::start().await;
    let pk = stand.submit().await;
    let resume = || stand.post("/api/jobs/submissions/1/resume/", HOST, &Value::Null);
    resume().await.is(&errors::RESUME_NOT_FAILED, &[]);
    stand.put(UPDATE, &put_body(pk, "failed", 0.0)).await.ok();
    stand
        .handle
        .with_state(|state| state.seed.challenges[0].allow_resuming_submissions = false);
    resume()
        .await
        .is(&errors::RESUME_NOT_ALLOWED, &["CARLA Leaderboard 2.0 (local)"]);
    stand
        .handle
        .with_state(|state| state.seed.challenges[0].allow_resuming_submissions = true);
    resume().await.ok();
    let row = stand.submission(pk).await;
    assert_eq!(row["status"], "resuming");
    assert!(row["rerun_resumed_at"].is_string());
    assert_eq!(stand.sent()[1]["submission_pk"], pk);
    assert_eq!(stand.sent()[1]["challenge_pk"], 1);
    resume().await.is(&errors::RESUME_NOT_FAILED, &[]);
    let error = stand.post("/api/jobs/submissions/9/resume/", HOST, &json!({})).await;
    error.is(&errors::NO_SUCH_SUBMISSION, &["9"]);
}

#[tokio::test]
async fn an_input_file_that_can_not_be_fetched_loses_the_message() {
    let stand = Stand::start().await;
    let pk = stand.submit().await;
    stand
        .post("/_stand-in/file", "", &json!({"submission": pk, "state": "missing"}))
        .await
        .ok();
    stand
        .post("/api/jobs/submissions/1/re-run/", HOST, &json!({}))
        .await
        .ok();
    assert!(stand.sent()[1].get("submitted_image_uri").is_none());

    stand
        .post("/_stand-in/file", "", &json!({"submission": 2, "state": "unreachable"}))
        .await
        .ok();
    stand
        .post("/api/jobs/submissions/2/re-run/", HOST, &json!({}))
        .await
        .is(&errors::SERVER_ERROR, &[]);
    assert_eq!(stand.sent().len(), 2, "no message");
    assert_eq!(
        stand.submission(2).await["status"],
        "cancelled",
        "and the rows have changed all the same"
    );
    assert_eq!(stand.submission(3).await["status"], "submitted");

    stand.put(UPDATE, &put_body(3, "failed", 0.0)).await.ok();
    stand
        .post("/api/jobs/submissions/3/resume/", HOST, &json!({}))
        .await
        .is(&errors::SERVER_ERROR, &[]);
    assert_eq!(stand.submission(3).await["status"], "resuming");
    assert_eq!(stand.sent().len(), 2);
}

#[tokio::test]
async fn a_dead_queue_leaves_the_submission_without_a_message() {
    let stand = Stand::start().await;
    stand.knobs(&json!({"queue_down": true})).await;
    let got = stand.upload(SUBMIT, TEAM_A, &file()).await;
    got.is(&errors::SERVER_ERROR, &[]);
    assert_eq!(stand.submission(1).await["status"], "submitted");
    assert!(stand.sent().is_empty());
}

#[tokio::test]
async fn a_fifo_queue_gets_group_and_deduplication() {
    let stand = Stand::start_with(|config| {
        config.throttle = 0;
        config.seed.set_queue("submissions.fifo");
    })
    .await;
    stand.submit().await;
    stand
        .post("/api/jobs/submissions/1/re-run/", HOST, &json!({}))
        .await
        .ok();
    let messages = stand.queues.messages("submissions.fifo");
    assert!(messages.iter().all(|message| message.group.as_deref() == Some("1-1")));
    let ids: Vec<_> = messages.iter().map(|message| message.dedup.clone().unwrap()).collect();
    assert!(ids[0].starts_with("1-") && ids[1].starts_with("2-"), "{ids:?}");
    assert_eq!(ids[0].len(), "1-".len() + 36);
}

#[tokio::test]
async fn a_cancel_sends_nothing_and_checks_nothing() {
    let stand = Stand::start().await;
    let pk = stand.submit().await;
    stand.cancel(pk, TEAM_B).await.is(&errors::NO_SUCH_SUBMISSION, &["1"]);
    stand
        .cancel(pk, "Bearer local-stranger-token")
        .await
        .is(&errors::TEAM_NOT_FOUND, &["None"]);
    stand.cancel(9, HOST).await.is(&errors::SUBMISSION_NOT_FOUND, &["9"]);
    assert_eq!(stand.cancel(pk, TEAM_A).await.ok().json()["status"], "cancelled");
    assert_eq!(stand.sent().len(), 1);
    let path = "/api/jobs/challenges/1/submissions/1/update_submission_meta/";
    let got = stand
        .call(Method::PATCH, path, TEAM_A, &json!({"status": "finished"}))
        .await
        .ok();
    assert_eq!(got.json()["status"], "finished", "participants may set any status");
    stand
        .call(Method::PATCH, path, TEAM_A, &json!({"status": "bogus"}))
        .await
        .is(&errors::INVALID_CHOICE, &["bogus"]);
    let got = stand
        .call(
            Method::PATCH,
            path,
            HOST,
            &json!({"status": "archived", "is_flagged": "true"}),
        )
        .await
        .ok();
    assert_eq!(
        (&got.json()["status"], &got.json()["is_flagged"]),
        (&json!("archived"), &json!(true))
    );
}

#[tokio::test]
async fn a_deleted_submission_keeps_its_status() {
    let stand = Stand::start().await;
    stand.submit().await;
    let path = "/api/jobs/submission/1";
    let delete = |auth| Stand::send(stand.request(Method::DELETE, path, auth));
    delete(TEAM_B).await.is(&errors::SUBMISSION_FORBIDDEN, &[]);
    let row = delete(TEAM_A).await.ok().json();
    assert_eq!(
        (&row["status"], &row["ignore_submission"]),
        (&json!("submitted"), &json!(true))
    );
    stand
        .post("/api/jobs/submissions/1/re-run/", HOST, &json!({}))
        .await
        .is(&errors::RERUN_DELETED, &[]);
    stand
        .post("/api/jobs/submissions/1/resume/", HOST, &json!({}))
        .await
        .is(&errors::RESUME_DELETED, &[]);
    stand
        .get("/api/jobs/submission/2", HOST)
        .await
        .is(&errors::NO_SUCH_SUBMISSION, &["2"]);
}

#[tokio::test]
async fn deleted_submissions_count_as_in_progress_and_stay_on_the_leaderboard() {
    let stand = Stand::start().await;
    for pk in 1..=3 {
        assert_eq!(stand.upload(SUBMIT, TEAM_A, &file()).await.status, 201);
        let path = format!("/api/jobs/submission/{pk}");
        Stand::send(stand.request(Method::DELETE, &path, TEAM_A)).await.ok();
    }
    let refused = stand.upload(SUBMIT, TEAM_A, &file()).await;
    refused.is(&errors::SUBMIT_CONCURRENT, &["3"]);

    let partial = put_body(1, "partially_evaluated", 3.0);
    stand.put(PARTIAL, &partial).await.ok();
    let got = stand.upload(SUBMIT, TEAM_A, &file()).await;
    assert_eq!(got.status, 201, "a partly evaluated one does not count: {}", got.text);
    let refused = stand.upload(SUBMIT, TEAM_A, &file()).await;
    refused.is(&errors::SUBMIT_CONCURRENT, &["3"]);

    stand.put(UPDATE, &put_body(1, "finished", 3.0)).await.ok();
    let board = stand.get("/api/jobs/challenge_phase_split/1/leaderboard/", "").await;
    let board = board.ok().json();
    assert_eq!(board["results"][0]["submission__id"], 1);
    assert_eq!(stand.submission(1).await["ignore_submission"], true);
}
