//! Signing in, throttle, paths, lists, the queue over REST, faults and the control plane.

mod support;

use std::time::Duration;

use evalai_stand_in::errors;
use reqwest::Method;
use serde_json::json;
use support::{HOST, IMAGE, Stand, TEAM_A, UPDATE};

#[tokio::test]
async fn only_refresh_tokens_and_keys_sign_in() {
    let stand = Stand::start().await;
    stand.submit().await;
    let path = "/api/jobs/submission/1";
    for (auth, error) in [
        ("", errors::NO_CREDENTIALS),
        ("Bearer local-host-access-token", errors::ACCESS_TOKEN),
        ("Bearer nonsense", errors::BAD_BEARER),
        ("Bearer local-late-token", errors::BAD_BEARER),
        ("Token local-host-token", errors::INVALID_KEY),
        ("Token 0000000000000000000000000000000000000022", errors::INACTIVE_USER),
        ("Token 0000000000000000000000000000000000000023", errors::EXPIRED_KEY),
        ("Bearer local-unverified-token", errors::UNVERIFIED_EMAIL),
        ("Bearer local-stranger-token", errors::SUBMISSION_FORBIDDEN),
    ] {
        stand.get(path, auth).await.is(&error, &[]);
    }
    for auth in [HOST, TEAM_A, "Token 0000000000000000000000000000000000000001"] {
        stand.get(path, auth).await.ok();
    }
    let token = stand.get("/api/accounts/user/get_auth_token", HOST).await.ok().json();
    assert_eq!(token["token"], "local-host-token");
}

#[tokio::test]
async fn exactly_sixty_requests_pass_in_a_minute_over_all_endpoints() {
    let stand = Stand::start_with(|_| {}).await;
    stand.submit().await;
    for index in 0..60 {
        // Refused requests count as well; both schemes are the same user.
        let got = match index % 4 {
            0 => stand.get("/api/jobs/submission/1", HOST).await,
            1 => {
                stand
                    .get(
                        "/api/jobs/challenge/1/submission/",
                        "Token 0000000000000000000000000000000000000001",
                    )
                    .await
            }
            2 => stand.get("/api/jobs/submission/99", HOST).await,
            _ => stand.post(UPDATE, HOST, &json!({})).await,
        };
        assert_ne!(got.status, 429, "request {index}");
    }
    let refused = stand.get("/api/jobs/submission/1", HOST).await;
    let wait = refused.header("retry-after").to_owned();
    refused.is(&errors::THROTTLED, &[&wait, "seconds"]);
    assert!((1..=60).contains(&wait.parse::<u64>().unwrap()), "{wait}");
    stand.get("/api/jobs/submission/1", TEAM_A).await.ok();
    stand.knobs(&json!({"throttle": 1})).await;
    stand.get("/api/jobs/submission/1", HOST).await.ok();
    assert_eq!(stand.get("/api/jobs/submission/1", HOST).await.status, 429);
    stand.knobs(&json!({"throttle": 0})).await;
    stand.get("/api/jobs/submission/1", HOST).await.ok();
}

#[tokio::test]
async fn paths_methods_and_bodies_are_exact() {
    let stand = Stand::start().await;
    stand.submit().await;
    stand
        .get("/api/jobs/submission/1/", HOST)
        .await
        .is(&errors::PAGE_NOT_FOUND, &[]);
    let moved = stand.put(UPDATE.trim_end_matches('/'), &json!({})).await;
    assert_eq!((moved.status, moved.header("location")), (301, UPDATE));
    stand.get(UPDATE, HOST).await.is(&errors::METHOD_NOT_ALLOWED, &["GET"]);
    let put = |content_type: &'static str, body: &'static str| {
        Stand::send(
            stand
                .request(Method::PUT, UPDATE, HOST)
                .header("content-type", content_type)
                .body(body),
        )
    };
    put("text/plain", "x")
        .await
        .is(&errors::UNSUPPORTED_MEDIA_TYPE, &["text/plain"]);
    let broken = put("application/json", "{\"submission\": }").await;
    broken.is(&errors::JSON_PARSE, &["Expecting value: line 1 column 16 (char 15)"]);
    put(
        "application/x-www-form-urlencoded",
        "submission=1&submission_status=FAILED&stderr=a+b",
    )
    .await
    .ok();
    let multipart = "--b\r\nContent-Disposition: form-data; name=\"submission\"\r\n\r\n1\r\n\
        --b\r\nContent-Disposition: form-data; name=\"submission_status\"\r\n\r\ncancelled\r\n--b--\r\n";
    put("multipart/form-data; boundary=b", multipart).await.ok();
    assert_eq!(stand.submission(1).await["status"], "cancelled");
}

#[tokio::test]
async fn lists_filter_by_status_and_date() {
    let stand = Stand::start().await;
    stand.knobs(&json!({"list_row_ms": 0})).await;
    let bulk = json!({"count": 500, "phase": 2, "team": 1, "age_seconds": 3_600});
    let got = stand.post("/_stand-in/bulk", "", &bulk).await;
    assert_eq!(got.json(), json!({"first": 1, "last": 500}));
    let pk = stand.submit().await;
    let count = async |query: &str| stand.list(query).await.ok().json().as_array().unwrap().len();
    assert_eq!(count("").await, 501, "not paginated");
    assert_eq!(stand.list("status=submitted").await.json()[0]["id"], pk);
    assert_eq!(count("status=submitted").await, 1);
    assert_eq!(count("status=cancelled").await, 500);
    assert_eq!(
        count("submitted_after=2020-01-01T00:00:00Z&submitted_before=2099-01-01T00:00:00Z&status=").await,
        501
    );
    assert_eq!(count("status=cancelled&submitted_after=2099-01-01T00:00:00Z").await, 0);
}

#[tokio::test]
async fn dates_of_a_list_are_bounds_that_are_not_in_it() {
    let stand = Stand::start().await;
    let pk = stand.submit().await;
    let at = stand.submission(pk).await["submitted_at"].as_str().unwrap().to_owned();
    for (query, count) in [
        (format!("submitted_after={at}"), 0),
        (format!("submitted_before={at}"), 0),
        ("submitted_after=2020-01-01T00:00:00".to_owned(), 1),
        ("submitted_after=2099-01-01T00:00:00Z".to_owned(), 0),
    ] {
        assert_eq!(
            stand.list(&query).await.ok().json().as_array().unwrap().len(),
            count,
            "{query}"
        );
    }
    stand
        .list("status=archived")
        .await
        .is(&errors::LIST_STATUS, &["archived"]);
    stand
        .list("submitted_after=yesterday")
        .await
        .is(&errors::LIST_DATE, &["submitted_after"]);
    stand
        .list("submitted_before=2020-13-01T00:00:00Z")
        .await
        .is(&errors::SERVER_ERROR, &[]);
    stand
        .get("/api/jobs/challenge/9/submission/", HOST)
        .await
        .is(&errors::CHALLENGE_NOT_FOUND, &["9"]);
    stand
        .get("/api/jobs/challenge/1/submission/", TEAM_A)
        .await
        .is(&errors::NOT_HOST, &[]);
}

#[tokio::test]
async fn a_list_is_as_old_as_its_request() {
    let stand = Stand::start().await;
    let pk = stand.submit().await;
    stand.knobs(&json!({"list_delay_ms": 2_000})).await;
    let list = stand.get("/api/jobs/challenge/1/submission/?status=cancelled", HOST);
    let cancel = async {
        // One thread runs all of it: when this one goes on, the list has been read and waits.
        stand
            .wait_until(|_, requests| requests.entries().any(|request| request.path.contains("status=")))
            .await;
        stand.cancel(pk, HOST).await.ok();
    };
    let (list, ()) = tokio::join!(list, cancel);
    assert_eq!(list.ok().json(), json!([]), "answered after the cancel, read before it");
}

#[tokio::test]
async fn context_is_what_a_worker_reads_before_it_writes() {
    let stand = Stand::start().await;
    stand.submit().await;
    let splits = stand
        .get("/api/challenges/1/challenge_phase_split", HOST)
        .await
        .ok()
        .json();
    assert_eq!(splits[0]["leaderboard_schema"]["labels"].as_array().unwrap().len(), 15);
    assert!(!splits[0].to_string().contains("codename"));
    let path = format!(
        "/api/challenges/challenge/create/dataset_split/{}/",
        splits[0]["dataset_split"]
    );
    assert_eq!(stand.get(&path, HOST).await.ok().json()["codename"], "leaderboard");
    let path = format!(
        "/api/challenges/challenge/create/challenge_phase_split/{}/",
        splits[0]["id"]
    );
    let own = stand.get(&path, HOST).await.ok().json();
    assert_eq!(own["is_leaderboard_order_descending"], json!(true));
    assert_eq!(
        splits[0].get("is_leaderboard_order_descending"),
        None,
        "the list lacks it"
    );
    let phases = stand.get("/api/challenges/1/phases/", HOST).await.ok().json();
    assert_eq!(
        (&phases[0]["codename"], &phases[1]["codename"]),
        (&json!("SENSORS"), &json!("MAP"))
    );
    stand
        .get("/api/challenges/1/phases/", TEAM_A)
        .await
        .is(&errors::PHASES_FORBIDDEN, &[]);
    assert_eq!(
        stand
            .get("/api/challenges/challenge/1/challenge_phase/2", HOST)
            .await
            .ok()
            .json()["id"],
        2
    );
    let error = stand.get("/api/challenges/challenge/1/challenge_phase/3", HOST).await;
    error.is(&errors::NO_PHASE_OF_CHALLENGE, &["3", "1"]);
    let counts = stand
        .get("/api/jobs/phases/1/submission_count_by_status/", HOST)
        .await
        .ok()
        .json();
    assert_eq!(counts, json!({"status": [{"status": "submitted", "count": 1}]}));
    let challenge = stand
        .get("/api/challenges/challenge/queues/submissions/", HOST)
        .await
        .ok()
        .json();
    assert_eq!(
        (&challenge["id"], &challenge["is_docker_based"]),
        (&json!(1), &json!(true))
    );
}

#[tokio::test]
async fn the_queue_over_rest_hands_one_message_out() {
    let stand = Stand::start().await;
    stand.submit().await;
    let receive = || stand.get("/api/jobs/challenge/queues/submissions/", HOST);
    let got = receive().await.ok().json();
    assert_eq!(got["body"]["submitted_image_uri"], IMAGE);
    assert_eq!(
        receive().await.ok().json(),
        json!({"body": null, "receipt_handle": null})
    );
    let path = "/api/jobs/queues/submissions/";
    stand
        .post(path, HOST, &json!({"receipt_handle": ""}))
        .await
        .is(&errors::RECEIPT_HANDLE_EMPTY, &[]);
    stand.post(path, HOST, &json!({})).await.is(&errors::SERVER_ERROR, &[]);
    stand
        .post(path, HOST, &json!({"receipt_handle": "nonsense"}))
        .await
        .is(&errors::SERVER_ERROR, &[]);
    stand.post(path, TEAM_A, &got).await.is(&errors::QUEUE_FORBIDDEN, &[]);
    stand.post(path, HOST, &got).await.ok();
    assert!(stand.sent().is_empty());
    stand
        .get("/api/jobs/challenge/queues/nope/", HOST)
        .await
        .is(&errors::QUEUE_UNKNOWN, &["nope"]);
    stand.knobs(&json!({"queue_down": true})).await;
    receive().await.is(&errors::SERVER_ERROR, &[]);
}

#[tokio::test]
async fn requests_fail_on_purpose() {
    let stand = Stand::start().await;
    let pk = stand.submit().await;
    let path = "/api/jobs/submission/1";
    stand
        .knobs(&json!({"fail_next": [
            {"method": "GET", "path_prefix": path, "answer": 429},
            {"method": "GET", "path_prefix": path, "answer": "html500"},
            {"method": "GET", "path_prefix": path, "answer": 504},
            {"method": "GET", "path_prefix": path, "answer": "close"},
            {"method": "GET", "path_prefix": path, "answer": "hang"},
            {"method": "PATCH", "answer": 503, "when": "after"},
        ]}))
        .await;
    let throttled = stand.get(path, HOST).await;
    throttled.is(&errors::THROTTLED, &["56", "seconds"]);
    assert_eq!(throttled.header("retry-after"), "56");
    stand.get(path, HOST).await.is(&errors::SERVER_ERROR, &[]);
    let gateway = stand.get(path, HOST).await;
    assert!(gateway.status == 504 && gateway.text.contains("nginx"), "{gateway:?}");
    assert!(
        stand.request(Method::GET, path, HOST).send().await.is_err(),
        "the connection is closed"
    );
    let hanging = stand
        .request(Method::GET, path, HOST)
        .timeout(Duration::from_millis(300))
        .send()
        .await;
    assert!(hanging.unwrap_err().is_timeout());
    stand.get(path, HOST).await.ok();
    assert_eq!(stand.cancel(pk, HOST).await.status, 503);
    assert_eq!(
        stand.submission(pk).await["status"],
        "cancelled",
        "done, and the client did not learn of it"
    );
    let faults: Vec<_> = stand
        .handle
        .requests()
        .into_iter()
        .filter_map(|request| request.fault)
        .collect();
    assert_eq!(faults, ["429", "html500", "504", "close", "hang", "503"]);
    stand.handle.shutdown().await;
}

#[tokio::test]
async fn the_control_plane_logs_shows_and_resets() {
    let stand = Stand::start().await;
    stand.submit().await;
    stand
        .put(
            UPDATE,
            &json!({"submission": 1, "submission_status": "failed", "stderr": "why"}),
        )
        .await
        .ok();
    let log = stand
        .get("/_stand-in/requests?method=PUT&path=update_submission", "")
        .await
        .ok()
        .json();
    let entry = &log[0];
    assert_eq!(
        (&entry["status"], &entry["token"]),
        (&json!(200), &json!("local-host-token"))
    );
    assert_eq!(entry["body"]["stderr"], "why");
    let state = stand.get("/_stand-in/state", "").await.ok().json();
    assert_eq!(state["submissions"]["1"]["status"], "failed");
    assert_eq!(state["published"][0]["body"]["submission_pk"], 1);
    let page = stand.get("/", "").await.ok().text;
    assert!(page.contains("team-a") && page.contains("failed"), "{page}");
    Stand::send(stand.request(Method::DELETE, "/_stand-in/requests", ""))
        .await
        .ok();
    assert_eq!(stand.get("/_stand-in/requests", "").await.ok().json(), json!([]));
    stand
        .post("/_stand-in/reset", "", &json!({"first_submission": 1_000}))
        .await
        .ok();
    assert_eq!(stand.submit().await, 1_000);
    for (path, body, word) in [
        (
            "/_stand-in/submit",
            json!({"team": "team-z", "phase": 1, "image": "x"}),
            "team-a",
        ),
        ("/_stand-in/knobs", json!({"put_delay_ms": 99_999}), "20000"),
        ("/_stand-in/nonsense", json!({}), "README"),
    ] {
        let got = stand.post(path, "", &body).await;
        assert!(got.status >= 400 && got.text.contains(word), "{got:?}");
    }
}

#[tokio::test]
async fn a_phase_has_the_servers_fields_and_more_of_them_for_hosts() {
    let stand = Stand::start().await;
    let path = "/api/challenges/challenge/1/challenge_phase/1";
    let everybody = [
        "id",
        "name",
        "description",
        "leaderboard_public",
        "start_date",
        "end_date",
        "challenge",
        "max_submissions_per_day",
        "max_submissions_per_month",
        "max_submissions",
        "submission_artifact_retention_policy",
        "is_public",
        "is_active",
        "codename",
        "slug",
        "max_concurrent_submissions_allowed",
        "is_restricted_to_select_one_submission",
        "submission_meta_attributes",
        "is_partial_submission_evaluation_enabled",
        "allowed_submission_file_types",
        "default_submission_meta_attributes",
        "allowed_email_ids",
        "is_submission_public",
        "disable_logs",
        "is_submission_paused",
    ];
    let hosts = [
        "annotations_uploaded_using_cli",
        "test_annotation",
        "environment_image",
        "config_id",
    ];
    let names = |row: &serde_json::Value| -> Vec<String> { row.as_object().unwrap().keys().cloned().collect() };
    let sorted = |names: &[&str]| {
        let mut names: Vec<_> = names.iter().map(|name| (*name).to_owned()).collect();
        names.sort();
        names
    };
    for auth in ["", TEAM_A] {
        let row = stand.get(path, auth).await.ok().json();
        assert_eq!(names(&row), sorted(&everybody), "{auth}");
        assert_eq!(row["slug"], "carla-sensors-1");
    }
    let all = sorted(&[&everybody[..], &hosts[..]].concat());
    assert_eq!(names(&stand.get(path, HOST).await.ok().json()), all);
    let list = stand.get("/api/challenges/1/phases/", HOST).await.ok().json();
    assert_eq!(names(&list[1]), all);
}
