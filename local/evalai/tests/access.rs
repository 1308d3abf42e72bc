//! Access: the users and the headers that the server accepts, and the cost of a request.

mod support;

use evalai_stand_in::errors;
use support::{HOST, Stand, TEAM_A};

const SPLITS: &str = "/api/challenges/1/challenge_phase_split";
const LEADERBOARD: &str = "/api/jobs/challenge_phase_split/1/leaderboard/";

#[tokio::test]
async fn a_malformed_header_is_refused_even_where_nobody_has_to_sign_in() {
    let stand = Stand::start().await;
    let pk = stand.submit().await;
    let submission = format!("/api/jobs/submission/{pk}");
    for (header, error) in [
        ("Bearer ", errors::BAD_AUTHORIZATION_HEADER),
        ("Bearer", errors::BAD_AUTHORIZATION_HEADER),
        ("Bearer local-host-token twice", errors::BAD_AUTHORIZATION_HEADER),
        ("Token", errors::KEY_MISSING),
        ("Token a b", errors::KEY_WITH_SPACES),
    ] {
        for path in [&submission, SPLITS, LEADERBOARD] {
            stand.get(path, header).await.is(&error, &[]);
        }
    }
    let got = stand.get(&submission, "Bearer ").await.json();
    assert_eq!(got["code"], "bad_authorization_header");
    assert_eq!(
        got["detail"],
        "Authorization header must contain two space-delimited values"
    );
}

#[tokio::test]
async fn splits_and_leaderboards_are_for_users_without_a_confirmed_address_too() {
    let stand = Stand::start().await;
    let unverified = "Bearer local-unverified-token";
    stand.get(SPLITS, unverified).await.ok();
    stand.get(LEADERBOARD, unverified).await.ok();
    let phase = stand
        .get("/api/challenges/challenge/1/challenge_phase/1", unverified)
        .await;
    phase.is(&errors::UNVERIFIED_EMAIL, &[]);
}

#[tokio::test]
async fn splits_do_not_count_against_the_requests_of_a_user() {
    let stand = Stand::start_with(|config| config.throttle = 2).await;
    stand.submit().await;
    for _ in 0..5 {
        stand.get(SPLITS, HOST).await.ok();
    }
    for _ in 0..2 {
        stand.get("/api/jobs/submission/1", HOST).await.ok();
    }
    assert_eq!(stand.get("/api/jobs/submission/1", HOST).await.status, 429);
    stand.get(SPLITS, HOST).await.ok();
}

#[tokio::test]
async fn a_renewed_token_ends_the_one_before_at_once() {
    let stand = Stand::start().await;
    stand.submit().await;
    let renewal = "/api/accounts/user/refresh_auth_token";
    let renew = async |token: &str| {
        let got = stand.get(renewal, token).await.ok().json();
        format!("Bearer {}", got["token"].as_str().unwrap())
    };
    let second = renew(HOST).await;
    assert_ne!(second, HOST);
    let path = "/api/jobs/submission/1";
    stand.get(path, HOST).await.is(&errors::BLACKLISTED, &[]);
    assert!(stand.get(path, HOST).await.text.contains("Token is blacklisted"));
    stand.get(path, &second).await.ok();
    stand.get(path, TEAM_A).await.ok();
    let shown = stand.get("/api/accounts/user/get_auth_token", &second).await;
    assert_eq!(
        format!("Bearer {}", shown.ok().json()["token"].as_str().unwrap()),
        second
    );

    // The key of the log-in is no refresh token: it goes on, and renews as well.
    let third = renew("Token 0000000000000000000000000000000000000001").await;
    stand.get(path, &second).await.is(&errors::BLACKLISTED, &[]);
    stand.get(path, &third).await.ok();
    stand.post("/_stand-in/reset", "", &serde_json::json!({})).await.ok();
    stand.submit().await;
    stand.get(path, HOST).await.ok();
}
