//! How many cancellations a partial result undoes: the server saves the whole row that it read when the request came in.
//!
//! The small version of it is `cancels_during_partial_traffic_are_lost_only_inside_a_request`; this one measures:
//! `make measure-scale`.

use super::*;

/// The write that undid a cancel knowingly. It is the first write that was not answered when the cancel came, if it and the read before
/// it came after the cancel. Writes after a cancel that was undone cannot know of it.
fn written_knowingly(log: &[Entry], pk: i64, cancelled: Timestamp) -> Option<&Entry> {
    let path = format!("/jobs/submission/{pk}");
    let is_write = |entry: &&Entry| entry.method != "GET" && entry.body["submission"] == json!(pk);
    let write = log
        .iter()
        .filter(is_write)
        .find(|write| write.answered.is_none_or(|at| at > cancelled))?;
    let mut reads = log
        .iter()
        .filter(|entry| entry.method == "GET" && entry.path.ends_with(&path));
    let read = reads.rfind(|read| read.time <= write.time);
    (write.time > cancelled && read.is_none_or(|read| read.time > cancelled)).then_some(write)
}

/// Submissions that no list will show any more, the way they are after a list that was just answered.
async fn just_listed(world: &mut World, count: usize) -> Vec<i64> {
    world.target.period = Duration::from_mins(10);
    let pks: Vec<i64> = (0..count).map(|_| world.submit()).collect();
    for pk in &pks {
        world.ask(*pk, false);
    }
    for pk in &pks {
        world.until(*pk, |view| view.answered == Some(Attempt(1))).await;
        world.live(*pk);
    }
    world
        .server
        .wait_until(|_, log| {
            let mut lists = log.entries().filter(|entry| entry.path.contains("status=cancelled"));
            lists.any(|list| list.answered.is_some())
        })
        .await;
    pks
}

#[tokio::test]
async fn cancels_between_a_list_and_a_write_are_found_by_the_read_of_that_write() {
    let mut world = World::new().await;
    for (index, pk) in just_listed(&mut world, 40).await.into_iter().enumerate() {
        world.set(pk, Stored::Cancelled);
        let cancelled = Timestamp::now();
        let update = match index % 3 {
            0 => DesiredUpdate::Queued,
            1 => DesiredUpdate::Running,
            _ => DesiredUpdate::Partial(results(&world.target, 41.0)),
        };
        world.update(pk, update);
        let view = world.until(pk, |view| {
            view.ended.is_some() || view.progress.is_some() || view.partial_done.is_some()
        });
        let view = view.await;
        assert_eq!(
            (view.ended, world.stored(pk)),
            (Some(Status::Cancelled), Stored::Cancelled)
        );
        assert_eq!(written_knowingly(&world.server.requests(), pk, cancelled), None);
    }
}

#[tokio::test]
async fn cancels_during_partial_traffic_are_lost_only_inside_a_request() {
    let world = World::new().await;
    world.server.set_knobs(Knobs {
        put_delay_ms: 20,
        ..Knobs::default()
    });
    let pks: Vec<_> = (0..40).map(|_| world.submit()).collect();
    for pk in &pks {
        world.set(*pk, Stored::Running);
        world.live(*pk);
    }
    let mut cancelled: BTreeMap<i64, Timestamp> = BTreeMap::new();
    for (round, pk) in pks.iter().enumerate() {
        for other in &pks {
            let score = f64::from(u32::try_from(round).unwrap());
            world.update(*other, DesiredUpdate::Partial(results(&world.target, score)));
        }
        // Cancelled submissions get no PUT.
        let wanted = world.sent("PUT").len() + 5.min(pks.len() - round);
        world
            .server
            .wait_until(|_, log| log.entries().filter(|entry| entry.method == "PUT").count() >= wanted)
            .await;
        cancelled.insert(*pk, Timestamp::now());
        world.set(*pk, Stored::Cancelled);
    }
    // Everything that was on its way is answered, and no more is begun.
    assert!(world.hub.drain().await);
    let log = world.server.requests();
    let puts: Vec<_> = log.iter().filter(|entry| entry.method == "PUT").collect();
    assert!(puts.len() > 100, "{} partials", puts.len());
    let lost = cancelled
        .keys()
        .filter(|pk| world.stored(**pk) != Stored::Cancelled)
        .count();
    for (pk, at) in &cancelled {
        assert_eq!(written_knowingly(&log, *pk, *at), None, "the cancel of submission {pk}");
    }
    println!(
        "{} partials, {} cancels, {lost} overwritten",
        puts.len(),
        cancelled.len()
    );
}

const CANCELS: usize = 1000;
const OVER: Duration = Duration::from_mins(4);
/// How long the server works on partial results.
const PUT: Duration = Duration::from_millis(500);

/// Where the cancels fell that were undone.
#[derive(Debug, Default)]
struct Undone {
    /// While the server worked on the partial results.
    inside: usize,
    /// Before that, since the last read or list that did not show them; with the longest such time.
    before: usize,
    longest: f64,
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "it measures for ten minutes: make measure-scale"]
async fn a_thousand_cancels_at_random_moments_during_partial_traffic() {
    for (what, list, requests) in [
        ("the usual budget, a slow list", 3000, 54),
        ("all that four requests at once can do, a slow list", 3000, 6000),
        ("the same, a fast list", 100, 6000),
    ] {
        measure(what, list, requests).await;
    }
}

async fn measure(what: &str, list_delay_ms: u64, requests_per_minute: u32) {
    let mut world = World::with(Timing::default(), Timeouts::default()).await;
    world.target.period = Duration::from_secs(10);
    world.target.requests_per_minute = requests_per_minute;
    world.server.set_knobs(Knobs {
        put_delay_ms: u64::try_from(PUT.as_millis()).unwrap(),
        list_delay_ms,
        list_row_ms: 0,
        ..Knobs::default()
    });
    let pks: Vec<i64> = (0..CANCELS).map(|_| world.submit()).collect();
    for pk in &pks {
        world.ask(*pk, false);
    }
    for pk in &pks {
        world.until(*pk, |view| view.answered == Some(Attempt(1))).await;
        world.live(*pk);
    }
    let cancelled = cancel_all(&world, &pks).await;
    assert!(world.hub.drain().await);
    let (undone, partials) = count(&world, &cancelled);
    println!(
        "{what}: {partials} partials in {} s, {CANCELS} cancels; undone while the server worked on one: {}, between a read \
         and one: {} (at most {:.2} s after the cancel)",
        OVER.as_secs(),
        undone.inside,
        undone.before,
        undone.longest,
    );
}

/// Cancels each at a random moment; all that are left request newer partial results in each period.
async fn cancel_all(world: &World, pks: &[i64]) -> BTreeMap<i64, Timestamp> {
    let mut moments: Vec<_> = pks.iter().map(|pk| (OVER.mul_f64(fastrand::f64()), *pk)).collect();
    moments.sort();
    let began = Instant::now();
    let (mut cancelled, mut round) = (BTreeMap::new(), 0_u32);
    for (moment, pk) in moments {
        while began + Duration::from_secs(10) * round <= began + moment {
            tokio::time::sleep_until(began + Duration::from_secs(10) * round).await;
            round += 1;
            let results = results(&world.target, f64::from(round));
            for pk in pks.iter().filter(|pk| !cancelled.contains_key(*pk)) {
                world.update(*pk, DesiredUpdate::Partial(results.clone()));
            }
        }
        tokio::time::sleep_until(began + moment).await;
        world.set(pk, Stored::Cancelled);
        cancelled.insert(pk, Timestamp::now());
    }
    cancelled
}

fn count(world: &World, cancelled: &BTreeMap<i64, Timestamp>) -> (Undone, usize) {
    let puts = world.sent("PUT");
    let mut undone = Undone::default();
    for (pk, at) in cancelled
        .iter()
        .filter(|(pk, _)| world.stored(**pk) != Stored::Cancelled)
    {
        let mut of = puts.iter().filter(|put| put.body["submission"] == json!(pk));
        let by = of
            .find(|put| put.answered.is_none_or(|answered| answered > *at))
            .unwrap();
        if by.time <= *at {
            undone.inside += 1;
        } else {
            undone.before += 1;
            undone.longest = undone.longest.max(by.time.duration_since(*at).as_secs_f64());
        }
    }
    (undone, puts.len())
}
