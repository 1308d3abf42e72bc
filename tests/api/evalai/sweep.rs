//! Submissions whose message was lost.

use super::*;

#[tokio::test]
async fn a_lost_message_is_found_by_the_sweep() {
    let mut world = World::new().await;
    let known = world.submit();
    world.ask(known, false);
    world.until(known, |view| view.answered == Some(Attempt(1))).await;
    let lost = world.submit_with(FileState::Stored, Timestamp::now() - SignedDuration::from_secs(300));
    world.hub.serve(&leaderboard(), &world.target).unwrap();
    let found = world.sweep.recv().await.unwrap();
    assert_eq!((found.challenge, found.phase, found.submission), (1, 1, lost));
}

#[tokio::test]
async fn a_lost_message_is_found_for_the_server_that_has_it() {
    let mut world = World::new().await;
    let (config, _) = Config::in_memory().unwrap();
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let other = evalai_stand_in::serve(Config { throttle: 0, ..config }, vec![listener]);
    // The ids of challenge, phase and submission are the same in both.
    let at = Timestamp::now() - SignedDuration::from_secs(300);
    let lost = world.submit_with(FileState::Stored, at);
    let own = std::mem::replace(&mut world.server, other);
    assert_eq!(world.submit_with(FileState::Stored, at), lost);
    let second = Key {
        name: "staging".into(),
        ..leaderboard()
    };
    world.hub.serve(&leaderboard(), &world.target).unwrap();
    let of_second = Target {
        leaderboard: second.clone(),
        ..target(&world.server.url(), "local-host-token")
    };
    world.hub.serve(&second, &of_second).unwrap();
    let mut servers = Vec::new();
    for _ in 0..2 {
        let found = world.sweep.recv().await.unwrap();
        assert_eq!((found.challenge, found.phase, found.submission), (1, 1, lost));
        servers.push(found.server);
    }
    servers.sort();
    let mut wanted = [own.url(), world.server.url()];
    wanted.sort();
    assert_eq!(servers, wanted);
}
