//! Cost of a challenge's old submissions.

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
    // The cost of a row is tested elsewhere; here their number counts.
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
    world.until(pk, |view| view.answered == Some(Attempt(1))).await;
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

/// Rows of a list, and the time that it takes the real server, in milliseconds: a fixed part, and one for each row.
const ROWS: u64 = 2000;
const LIST_MS: u64 = 3000;
const ROW_MS: u64 = 10;
/// Submissions that end while the list is on its way.
const ENDS: usize = 40;

#[tokio::test]
async fn a_list_of_2000_rows_that_takes_23_seconds_holds_no_end_up() {
    let mut world = World::with(timing(), Timeouts::default()).await;
    // Older than all that the list shows, so that it reaches back to them.
    let live = world.submit_with(FileState::Stored, Timestamp::now() - SignedDuration::from_hours(1));
    world.ask(live, false);
    world.until(live, |view| view.answered == Some(Attempt(1))).await;
    let rows = Bulk {
        count: ROWS - 1,
        phase: 1,
        team: 1,
        status: Stored::Cancelled,
        age_seconds: 0,
    };
    world
        .server
        .with_state(|state| bulk(state, &rows, Timestamp::now()).unwrap());
    world.server.set_knobs(Knobs {
        list_delay_ms: LIST_MS,
        list_row_ms: ROW_MS,
        ..Knobs::default()
    });
    world.set(live, Stored::Cancelled);
    world.live(live);
    let is_list = |entry: &Entry| entry.path.contains("status=cancelled");
    world.server.wait_until(|_, log| log.entries().any(is_list)).await;
    let pks: Vec<i64> = (0..ENDS).map(|_| world.submit()).collect();
    for pk in &pks {
        let end = DesiredUpdate::Final(Outcome::Finished, results(&world.target, 43.0));
        world.update(*pk, end);
    }
    for pk in &pks {
        assert!(matches!(world.ended(*pk).await, Ended::Published { .. }));
    }
    let lists: Vec<Entry> = world.sent("GET").into_iter().filter(is_list).collect();
    assert_eq!(lists.len(), 1);
    assert_eq!(
        lists[0].answered, None,
        "the list is on its way until after the last end"
    );
    // The answer counts all the same.
    let view = world.until(live, |view| view.ended.is_some()).await;
    assert_eq!(view.ended, Some(Status::Cancelled));
    let answered = world.sent("GET").into_iter().find(is_list).unwrap();
    let took = answered.answered.unwrap().duration_since(answered.time);
    assert!(took >= SignedDuration::from_secs(23), "{took:#}");
    assert_eq!(rows_of(&world, &answered.path).await, usize::try_from(ROWS).unwrap());
}
