//! Tokens that are refused, and uploaded files that name no image.

use leaderboard_evalai::Usage;

use super::*;

#[tokio::test]
async fn a_token_whose_user_is_no_host_is_named_and_one_submission_condemns_none() {
    let mut world = World::new().await;
    let good = world.target.clone();
    world.target = target(&world.server.url(), "local-team-a-token");
    world.hub.serve(&leaderboard(), &world.target).unwrap();
    let why = world.token_refused().await;
    assert!(
        why.contains("no host of this challenge") && why.contains("evalai.token"),
        "{why}"
    );
    // A submission that the host of another challenge may not read.
    world.target = Target {
        leaderboard: Key {
            name: "of-another-challenge".into(),
            ..leaderboard()
        },
        ..target(&world.server.url(), "local-stranger-token")
    };
    let pk = world.submit();
    world.ask(pk, false);
    let view = world.until(pk, |view| view.last_error.is_some()).await;
    let error = view.last_error.unwrap();
    assert!(error.contains("no host of its challenge"), "{error}");
    world.hub.serve(&leaderboard(), &good).unwrap();
    while world.hub.labels(&leaderboard()).0.is_none() {
        world.changed.recv().await.unwrap();
    }
    assert_eq!(world.hub.token_refused(&leaderboard()), None);
}

#[tokio::test]
async fn a_refused_token_is_reported_and_a_new_one_used() {
    let mut world = World::new().await;
    let good = world.target.clone();
    world.target = target(&world.server.url(), "local-host-access-token");
    world.hub.serve(&leaderboard(), &world.target).unwrap();
    let why = world.token_refused().await;
    assert!(
        why.contains("Token has wrong type") && why.contains("refresh token of a host"),
        "{why}"
    );
    let pk = world.submit();
    world.ask(pk, false);
    world.target = good;
    world.hub.serve(&leaderboard(), &world.target).unwrap();
    world.ask(pk, false);
    world.until(pk, |view| view.answered == Some(Attempt(1))).await;
    assert_eq!(world.hub.token_refused(&leaderboard()), None);
    let Usage { used, limit, .. } = world.hub.usage(&leaderboard()).unwrap();
    assert!(used > 0 && limit == 6000);
}

#[tokio::test]
async fn an_image_that_cannot_be_had_is_named() {
    let mut world = World::new().await;
    let pk = world.submit_with(FileState::Missing, Timestamp::now());
    world.ask(pk, true);
    let view = world.until(pk, |view| view.image.is_some()).await;
    let Some(ImageAnswer::Unread(why)) = view.image else {
        panic!("{:?}", view.image)
    };
    assert!(why.contains("404"), "{why}");
}

#[tokio::test]
async fn a_file_that_names_no_image_is_read_once() {
    let mut world = World::new().await;
    let large = "x".repeat(70_000);
    let files = [
        json!({"submitted_image_uri": null}).to_string(),
        json!({"submitted_image_uri": "  "}).to_string(),
        json!({"submitted_image_uri": 5}).to_string(),
        "no JSON".to_owned(),
        json!({ "submitted_image_uri": large }).to_string(),
    ];
    for file in files {
        let pk = world.submit_file(file.into_bytes(), FileState::Stored, Timestamp::now());
        world.ask(pk, true);
        let view = world.until(pk, |view| view.image.is_some()).await;
        assert!(matches!(view.image, Some(ImageAnswer::NotAnImage(_))), "{view:?}");
        assert_eq!(view.last_error, None);
    }
}
