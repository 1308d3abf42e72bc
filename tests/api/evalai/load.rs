//! What old submissions of a challenge cost.

use evalai_stand_in::submissions::{Bulk, bulk};

use super::*;

const OLD: usize = 5000;

/// Rows that a list of the log brings, asked again by somebody else.
async fn rows_of(world: &World, path: &str) -> usize {
    let http = reqwest::Client::builder().no_proxy().build().unwrap();
    let request = http.get(format!("{}{path}", world.server.url()));
    let answer = request.bearer_auth("local-organizer-token").send().await.unwrap();
    let rows: Vec<serde_json::Value> = serde_json::from_slice(&answer.bytes().await.unwrap()).unwrap();
    rows.len()
}

fn lists(world: &World) -> Vec<String> {
    let lists = world.sent("GET").into_iter().map(|entry| entry.path);
    lists.filter(|path| path.contains("status=cancelled")).collect()
}

#[tokio::test]
async fn old_cancelled_submissions_cost_nothing() {
    let mut world = World::new().await;
    // What a row costs is known; this is about how many there are.
    world.server.set_knobs(Knobs {
        list_row_ms: 0,
        ..Knobs::default()
    });
    let old = Bulk {
        count: OLD as u64,
        phase: 1,
        team: 1,
        status: Stored::Cancelled,
        age_seconds: 3600,
    };
    world
        .server
        .with_state(|state| bulk(state, &old, Timestamp::now()).unwrap());
    let pk = world.submit();
    world.ask(pk, false);
    world.until(pk, |view| view.answered == 1).await;
    world.live(pk);
    world
        .server
        .wait_until(|_, log| {
            let answered = log
                .entries()
                .filter(|e| e.path.contains("status=cancelled") && e.answered.is_some());
            answered.count() >= 3
        })
        .await;
    let lists = lists(&world);
    for path in &lists {
        assert!(path.contains("submitted_after="), "{path}");
        assert_eq!(rows_of(&world, path).await, 0, "{path}");
    }
    let whole = lists[0]
        .split("submitted_after=")
        .next()
        .unwrap()
        .trim_end_matches(['&', '?'])
        .to_owned();
    assert_eq!(
        rows_of(&world, &whole).await,
        OLD,
        "{whole}: what it costs without the limit"
    );
    // And a cancellation of today is found all the same.
    world.set(pk, Stored::Cancelled);
    let view = world.until(pk, |view| view.ended.is_some()).await;
    assert_eq!(view.ended, Some(Status::Cancelled));
}
