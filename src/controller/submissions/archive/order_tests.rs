//! In which order ends are read.

use super::*;
use leaderboard_api::Attempt;

fn ended(before: Duration, now: Instant) -> Arc<Target> {
    Arc::new(Target {
        namespace: "one".into(),
        name: "sub".into(),
        leaderboard: "carla".into(),
        prefix: "7/".into(),
        submission_uid: "u".into(),
        attempt: Attempt(1),
        ended: now.checked_sub(before),
    })
}

/// Whose work comes next, until nothing is due.
fn order(mut state: State, mut now: Instant) -> Vec<String> {
    let mut found = Vec::new();
    while let Some(work) = state.next(now) {
        found.push(work.uid.to_string());
        now += SPACING;
    }
    found
}

#[test]
fn of_ends_that_wait_the_oldest_is_read_first() {
    let now = Instant::now();
    let demand = ReportDemand {
        job: JobNumber::first(Attempt(1)),
        pod: None,
        stage: Stage::JobEnded,
        period: Duration::from_secs(10),
    };
    let mut reports = State::default();
    for (name, seconds) in [("new", 1), ("oldest", 30), ("old", 20)] {
        let (uid, target) = (Uid::from(name), ended(Duration::from_secs(seconds), now));
        reports.demand(&uid, &target, Some(demand.clone()), now);
    }
    assert_eq!(order(reports, now), ["oldest", "old", "new"]);
}
