//! Submissions that are files, and images that leave some: what is uploaded, what its address gives out, which messages go out.

mod support;

use std::time::Duration;

use evalai_stand_in::errors;
use reqwest::Method;
use serde_json::{Value, json};
use support::{HOST, IMAGE, Stand, TEAM_A};

const PREDICTIONS: &str = "/api/jobs/challenge/3/challenge_phase/5/submission/";
const FLAG: &str = "is_static_dataset_code_upload_submission";
const CONTENT: &str = "id,label\n1,cat\n2,dog\n";

#[expect(clippy::unwrap_used, reason = "a helper that fails fails its test")]
impl Stand {
    /// Team a uploads a file for challenge 3. Hands the path below the stand-in's URL back.
    async fn upload_predictions(&self) -> String {
        let got = self.upload(PREDICTIONS, TEAM_A, CONTENT).await;
        assert_eq!(got.status, 201, "{}", got.text);
        self.path_of(&got.json())
    }

    fn path_of(&self, row: &Value) -> String {
        let url = row["input_file"].as_str().unwrap();
        url.strip_prefix(&self.handle.url()).unwrap().to_owned()
    }

    async fn file_is(&self, pk: u64, state: Value) {
        let body = json!({"submission": pk, "state": state});
        self.post("/_stand-in/file", "", &body).await.ok();
    }
}

#[tokio::test]
async fn a_file_of_predictions_is_served_as_it_was_uploaded_and_its_message_has_no_image() {
    let stand = Stand::start().await;
    let path = stand.upload_predictions().await;
    assert_eq!(stand.get(&path, "").await.ok().text, CONTENT);
    let message = json!({"challenge_pk": "3", "phase_pk": "5", FLAG: false, "submission_pk": 1});
    assert_eq!(stand.sent(), [message]);
    let rerun = "/api/jobs/submissions/1/re-run/";
    stand.post(rerun, HOST, &json!({})).await.ok();
    let message = json!({"challenge_pk": 3, "phase_pk": 5, FLAG: false, "submission_pk": 2});
    assert_eq!(stand.sent()[1], message);

    let body = json!({"team": "team-b", "phase": 5, "content": CONTENT});
    let got = stand.post("/_stand-in/submit", "", &body).await;
    assert_eq!(got.status, 201, "{}", got.text);
    let path = stand.path_of(&stand.submission(3).await);
    assert_eq!(stand.get(&path, "").await.ok().text, CONTENT);
    let nothing = json!({"team": "team-b", "phase": 5});
    assert_eq!(stand.post("/_stand-in/submit", "", &nothing).await.status, 400);
}

#[tokio::test]
async fn a_file_may_be_gone() {
    let stand = Stand::start().await;
    let path = stand.upload_predictions().await;
    stand.file_is(1, json!("missing")).await;
    stand.get(&path, "").await.is(&errors::PAGE_NOT_FOUND, &[]);
    stand.file_is(1, json!("gone")).await;
    assert_eq!(stand.get(&path, "").await.status, 410);
    stand.file_is(1, json!("stored")).await;
    assert_eq!(stand.get(&path, "").await.ok().text, CONTENT);
}

#[tokio::test]
async fn a_file_may_never_come_or_break_off() {
    let stand = Stand::start().await;
    let path = stand.upload_predictions().await;
    let get = || stand.request(Method::GET, &path, "");
    for state in ["unreachable", "silent"] {
        stand.file_is(1, json!(state)).await;
        let error = get().timeout(Duration::from_millis(200)).send().await.unwrap_err();
        assert_eq!(error.is_timeout(), state == "silent", "{state}: {error}");
    }
    stand.file_is(1, json!("cut")).await;
    let mut answer = get().send().await.unwrap();
    assert_eq!(answer.content_length(), Some(CONTENT.len() as u64));
    let mut read = Vec::new();
    let end = loop {
        match answer.chunk().await {
            Ok(Some(chunk)) => read.extend_from_slice(&chunk),
            end => break end,
        }
    };
    assert_eq!(read, &CONTENT.as_bytes()[..CONTENT.len() / 2]);
    assert!(end.is_err(), "{end:?}");
}

#[tokio::test]
async fn a_file_may_be_larger_than_any_disk() {
    let stand = Stand::start().await;
    let path = stand.upload_predictions().await;
    let zeros = |size: u64| json!({ "zeros": size });
    stand.file_is(1, zeros(10 << 30)).await;
    let mut answer = stand.request(Method::GET, &path, "").send().await.unwrap();
    assert_eq!(answer.content_length(), Some(10 << 30));
    let mut read = 0;
    while read < 5 << 20 {
        let chunk = answer.chunk().await.unwrap().unwrap();
        assert!(chunk.iter().all(|byte| *byte == 0));
        read += chunk.len();
    }
    for size in [0, 1, 100_000] {
        stand.file_is(1, zeros(size)).await;
        let got = stand.get(&path, "").await.ok();
        assert_eq!(got.text.len() as u64, size);
    }
}

#[tokio::test]
async fn an_address_that_has_expired_is_refused_and_a_new_one_is_in_the_row() {
    let stand = Stand::start().await;
    let mut old = stand.upload_predictions().await;
    for _ in 0..2 {
        stand.post("/_stand-in/expire", "", &json!({})).await.ok();
        let got = stand.get(&old, "").await;
        assert_eq!((got.status, got.text.contains("Request has expired")), (403, true));
        let new = stand.path_of(&stand.submission(1).await);
        assert_ne!(new, old);
        assert_eq!(stand.get(&new, "").await.ok().text, CONTENT);
        old = new;
    }
}

#[tokio::test]
async fn messages_of_images_that_leave_files_say_so() {
    let stand = Stand::start().await;
    stand
        .handle
        .with_state(|state| state.seed.challenges[0].is_static_dataset_code_upload = true);
    stand.submit().await;
    let first = json!({
        "challenge_pk": "1", "phase_pk": "1", FLAG: true, "submitted_image_uri": IMAGE, "submission_pk": 1,
    });
    assert_eq!(stand.sent(), [first]);
    let rerun = |pk: u64| format!("/api/jobs/submissions/{pk}/re-run/");
    stand.post(&rerun(1), HOST, &json!({})).await.ok();
    let again = json!({"challenge_pk": 1, "phase_pk": 1, FLAG: true, "submitted_image_uri": IMAGE, "submission_pk": 2});
    assert_eq!(stand.sent()[1], again);
    // Without the file EvalAI knows neither.
    stand.file_is(2, json!("gone")).await;
    stand.post(&rerun(2), HOST, &json!({})).await.ok();
    let without = json!({"challenge_pk": 1, "phase_pk": 1, FLAG: false, "submission_pk": 3});
    assert_eq!(stand.sent()[2], without);
    let by_url = json!({"team": "team-a", "phase": 1, "image": IMAGE, "file": "file-url"});
    stand.post("/_stand-in/submit", "", &by_url).await;
    assert_eq!(stand.sent()[3].get(FLAG), None);
}

#[tokio::test]
async fn anybody_reads_who_evaluates_a_challenge() {
    let stand = Stand::start_with(|config| config.throttle = 1).await;
    let path = "/api/challenges/challenge/3/";
    let flags = async |auth: &str| {
        let challenge = stand.get(path, auth).await.ok().json();
        ["remote_evaluation", "is_docker_based", "is_static_dataset_code_upload"].map(|name| challenge[name].clone())
    };
    assert_eq!(flags("").await, [json!(true), json!(false), json!(false)]);
    stand
        .handle
        .with_state(|state| state.seed.challenges[2].remote_evaluation = false);
    for _ in 0..3 {
        let shown = flags(HOST).await;
        assert_eq!(shown[0], json!(false), "it is not throttled for users");
    }
    let unknown = stand.get("/api/challenges/challenge/9/", HOST).await;
    unknown.is(&errors::UNKNOWN_CHALLENGE, &[]);
}
