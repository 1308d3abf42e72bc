//! Whole elections on tokio's paused clock against one Lease on a mock of the API server, with faults.

pub(crate) mod fake_server;
mod simulation;

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use tokio::sync::watch;
use tokio::time::{Instant, sleep, timeout};

use super::*;
use fake_server::{FakeServer, Fault};
use leaderboard_base::clock::Clock;
use leaderboard_base::shutdown::Stop;

/// Longer than anything an election may take.
const LIMIT: Duration = Duration::from_mins(5);

struct Candidate {
    leader: Leader,
    telemetry: Observability,
    /// Seconds by which its boot clock is ahead of tokio's: a pause of the machine.
    paused: Arc<AtomicU64>,
    _stop: watch::Sender<bool>,
}

impl Candidate {
    fn start(server: &FakeServer, identity: Identity) -> Self {
        Self::with_clock(server, identity, Clock::system())
    }

    fn with_clock(server: &FakeServer, identity: Identity, wall: Clock) -> Self {
        let (sender, stop) = Stop::new();
        let (begin, paused) = (Instant::now(), Arc::new(AtomicU64::new(1000)));
        let ahead = paused.clone();
        let boot = move || begin.elapsed() + Duration::from_secs(ahead.load(Ordering::SeqCst));
        let telemetry = Observability {
            clock: wall.with_boot(boot),
            ..Observability::new(stop)
        };
        let settings = Settings::new("ns", "operator", identity);
        let leader = start(server.client(), settings, &telemetry);
        Self {
            leader,
            telemetry,
            paused,
            _stop: sender,
        }
    }

    async fn until(&self, what: &str, is: impl Fn(&Leadership) -> bool) -> Leadership {
        let mut leadership = self.leader.leadership();
        let found = timeout(LIMIT, leadership.wait_for(|now| is(now))).await;
        found.unwrap_or_else(|_| panic!("never {what}")).unwrap().clone()
    }

    async fn leads(&self) -> Leadership {
        self.until("leads", |l| l.term().is_some()).await
    }

    /// Its term, and whether it may write to EvalAI at once.
    async fn leads_in(&self) -> (i32, bool) {
        let term = self.leads().await.term().unwrap();
        let not_before = self.leader.fence().evalai_not_before().unwrap();
        (term, not_before <= Instant::now())
    }

    async fn loses(&self) -> String {
        match self.until("loses", |l| matches!(l, Leadership::Lost { .. })).await {
            Leadership::Lost { why } => why,
            other => panic!("{other:?}"),
        }
    }

    fn may_write(&self) -> bool {
        self.leader.fence().may_write()
    }
}

fn someone() -> Identity {
    Identity::random("host")
}

#[tokio::test(start_paused = true)]
async fn the_first_ever_leads_at_once_and_may_write_to_evalai_at_once() {
    let (server, begin) = (FakeServer::default(), Instant::now());
    let candidate = Candidate::start(&server, someone());
    assert!(!candidate.may_write());
    assert_eq!(candidate.leads_in().await, (1, true));
    assert!(candidate.may_write() && begin.elapsed() < Duration::from_secs(1));
    assert!(
        candidate
            .telemetry
            .metrics
            .text()
            .unwrap()
            .contains("leaderboard_is_leader 1\n")
    );
}

#[tokio::test(start_paused = true)]
async fn a_leader_renews_every_two_seconds_without_reading() {
    let server = FakeServer::default();
    let candidate = Candidate::start(&server, someone());
    candidate.leads().await;
    server.with(|state| state.log.clear());
    for _ in 0..60 {
        sleep(Duration::from_secs(1)).await;
        assert!(candidate.may_write());
    }
    let log = server.with(|state| state.log.clone());
    assert!(
        log.iter().all(|method| method == "PUT") && (27..=34).contains(&log.len()),
        "{log:?}"
    );
}

#[tokio::test(start_paused = true)]
async fn a_standby_takes_over_fifteen_seconds_after_the_last_sign_and_waits_for_evalai() {
    let server = FakeServer::default();
    server.with(|state| state.put(Some("gone"), 3));
    let begin = Instant::now();
    let candidate = Candidate::start(&server, someone());
    assert_eq!(candidate.leads_in().await, (4, false));
    let waited = begin.elapsed();
    assert!((15..=18).contains(&waited.as_secs()), "{waited:?}");
    let quiet = candidate.leader.fence().evalai_not_before().unwrap() - Instant::now();
    assert!((74..=75).contains(&quiet.as_secs()), "{quiet:?}");
    assert!(candidate.may_write(), "DynamoDB needs no quiet time");
}

#[tokio::test(start_paused = true)]
async fn a_live_leader_is_left_alone_whatever_its_clock_shows() {
    let server = FakeServer::default();
    server.with(|state| state.put(Some("alive"), 3));
    let candidate = Candidate::start(&server, someone());
    for _ in 0..20 {
        sleep(Duration::from_secs(10)).await;
        // The times it writes lie months away; only that they change counts.
        server.with(|state| state.put(Some("alive"), 3));
    }
    assert_eq!(*candidate.leader.leadership().borrow(), Leadership::Standby);
    assert!(!candidate.may_write());
}

#[tokio::test(start_paused = true)]
async fn each_replica_writes_the_time_of_its_own_clock_and_a_difference_takes_no_lease() {
    let server = FakeServer::default();
    let renewed = || -> Timestamp { serde_json::from_value(server.with(|state| state.spec("renewTime"))).unwrap() };
    let noon = Timestamp::from_second(1_800_000_000).unwrap();
    let day = SignedDuration::from_hours(24);
    let begin = Instant::now();
    let clock = Clock::system().with_wall(move || noon + SignedDuration::try_from(begin.elapsed()).unwrap());
    let old = Candidate::with_clock(&server, someone(), clock.clone());
    old.leads().await;
    let new = Candidate::with_clock(&server, someone(), clock.ahead(day));
    sleep(Duration::from_mins(1)).await;
    assert!(old.may_write() && !new.may_write());
    let later = |time: Timestamp| time.duration_since(noon);
    assert!(later(renewed()) < SignedDuration::from_hours(1));
    old.leader.release().await;
    assert_eq!(new.leads_in().await, (2, true));
    assert!(later(renewed()) > day);
}

#[tokio::test(start_paused = true)]
async fn an_orderly_end_hands_over_within_a_look_and_without_quiet_time() {
    let server = FakeServer::default();
    let old = Candidate::start(&server, someone());
    old.leads().await;
    let new = Candidate::start(&server, someone());
    sleep(Duration::from_secs(5)).await;
    let fence = old.leader.fence();
    old.leader.release().await;
    assert!(!fence.may_write());
    let begin = Instant::now();
    assert_eq!(new.leads_in().await, (2, true));
    assert!(begin.elapsed() < Duration::from_secs(3));
    assert!(
        futures::FutureExt::now_or_never(old.telemetry.tasks.failed()).is_none(),
        "an orderly end is no failed task"
    );
}

#[tokio::test(start_paused = true)]
async fn an_end_without_all_answers_leaves_the_lease_to_expire() {
    let server = FakeServer::default();
    let old = Candidate::start(&server, someone());
    old.leads().await;
    drop(old);
    let (new, begin) = (Candidate::start(&server, someone()), Instant::now());
    assert_eq!(new.leads_in().await, (2, false));
    assert!((15..=18).contains(&begin.elapsed().as_secs()));
}

#[tokio::test(start_paused = true)]
async fn a_restarted_container_takes_over_from_its_own_past_at_once_but_keeps_quiet_as_does_its_successor() {
    let server = FakeServer::default();
    let before = Identity::of_pod("pod", "uid");
    server.with(|state| state.put(Some(before.as_str()), 3));
    let begin = Instant::now();
    let candidate = Candidate::start(&server, Identity::of_pod("pod", "uid"));
    assert_eq!(candidate.leads_in().await, (4, false));
    assert!(begin.elapsed() < Duration::from_secs(1));
    candidate.leader.release().await;
    assert!(server.with(|state| state.spec("holderIdentity")).is_string());
    let next = Candidate::start(&server, someone());
    assert_eq!(next.leads_in().await, (5, false));
}

#[tokio::test(start_paused = true)]
async fn a_conflict_means_look_again_not_lose() {
    let server = FakeServer::default();
    let candidate = Candidate::start(&server, someone());
    candidate.leads().await;
    server.with(|state| state.writes = [Fault::Meddled, Fault::Meddled].into());
    for _ in 0..20 {
        sleep(Duration::from_secs(1)).await;
        assert!(candidate.may_write());
    }
    assert!(server.with(|state| state.writes.is_empty()));
    assert_eq!(server.with(|state| state.spec("leaseTransitions")), 1);
}

#[tokio::test(start_paused = true)]
async fn an_acquisition_whose_answer_was_lost_is_found_and_kept_in_its_term() {
    for fault in [Fault::DoneBut504, Fault::Silence] {
        let server = FakeServer::default();
        server.with(|state| {
            state.put_free(3);
            state.writes = [fault].into();
        });
        let candidate = Candidate::start(&server, someone());
        assert_eq!(candidate.leads_in().await, (4, true), "{fault:?}");
        assert!(candidate.may_write());
        assert_eq!(server.with(|state| state.spec("leaseTransitions")), 4, "{fault:?}");
    }
}

#[tokio::test(start_paused = true)]
async fn a_renewal_whose_answer_was_lost_costs_one_look() {
    let server = FakeServer::default();
    let candidate = Candidate::start(&server, someone());
    candidate.leads().await;
    server.with(|state| {
        state.writes = [Fault::DoneBut504].into();
        state.log.clear();
    });
    sleep(Duration::from_secs(8)).await;
    assert!(candidate.may_write());
    let log = server.with(|state| state.log.clone());
    assert_eq!(log.iter().filter(|method| *method == "GET").count(), 1, "{log:?}");
    assert!(
        candidate
            .telemetry
            .metrics
            .text()
            .unwrap()
            .contains("leaderboard_lease_errors_total{reason=\"server\"} 1\n")
    );
}

#[tokio::test(start_paused = true)]
async fn silence_closes_the_fence_in_ten_seconds_and_ends_the_term() {
    for fault in [Fault::Silence, Fault::Forbidden] {
        let server = FakeServer::default();
        let candidate = Candidate::start(&server, someone());
        candidate.leads().await;
        sleep(Duration::from_secs(7)).await;
        server.with(|state| state.always = Some(fault));
        let begin = Instant::now();
        let why = candidate.loses().await;
        let taken = begin.elapsed();
        assert!(why.contains("could not be renewed for 10 s"), "{why}");
        assert!((7..=10).contains(&taken.as_secs()), "{fault:?} {taken:?}");
        assert!(!candidate.may_write());
        assert!(
            candidate
                .telemetry
                .metrics
                .text()
                .unwrap()
                .contains("leaderboard_is_leader 0\n")
        );
        server.with(|state| state.always = None);
        sleep(Duration::from_mins(1)).await;
        assert!(!candidate.may_write(), "a process leads only once");
        candidate.leader.release().await;
    }
}

#[tokio::test(start_paused = true)]
async fn a_renewal_counts_from_when_it_was_sent() {
    let server = FakeServer::default();
    let candidate = Candidate::start(&server, someone());
    candidate.leads().await;
    let begin = Instant::now();
    server.with(|state| {
        state.writes = [Fault::Late].into_iter().chain([Fault::Silence; 20]).collect();
        state.reads = [Fault::Silence; 20].into();
    });
    candidate.loses().await;
    // Sent after 2 s, answered after 6 s.
    let taken = begin.elapsed().as_secs_f32();
    assert!((11.7..=12.3).contains(&taken), "{taken}");
}

#[tokio::test(start_paused = true)]
async fn a_pause_of_the_machine_closes_the_fence_before_anything_else_runs() {
    let server = FakeServer::default();
    let candidate = Candidate::start(&server, someone());
    candidate.leads().await;
    candidate.paused.fetch_add(30, Ordering::SeqCst);
    assert!(!candidate.may_write());
    server.with(|state| state.log.clear());
    let why = candidate.loses().await;
    assert!(why.contains("could not be renewed"), "{why}");
    assert!(
        server.with(|state| state.log.is_empty()),
        "a leader that overslept does not renew"
    );
}

#[tokio::test(start_paused = true)]
async fn a_taken_lease_ends_the_term() {
    let server = FakeServer::default();
    let candidate = Candidate::start(&server, someone());
    candidate.leads().await;
    server.with(|state| state.put(Some("other"), 2));
    assert_eq!(candidate.loses().await, "other holds the Lease");
    assert!(!candidate.may_write());
}

#[tokio::test(start_paused = true)]
async fn a_holder_cleared_by_hand_ends_its_term_before_the_next_begins() {
    let server = FakeServer::default();
    let old = Candidate::start(&server, someone());
    old.leads().await;
    let new = Candidate::start(&server, someone());
    sleep(Duration::from_secs(5)).await;
    server.with(|state| state.put(None, 1));
    assert_eq!(old.loses().await, "somebody has cleared the holder of the Lease");
    assert!(!new.may_write());
    assert_eq!(new.leads_in().await, (2, false));
}

#[tokio::test(start_paused = true)]
async fn a_deleted_lease_is_written_again_in_the_same_term() {
    let server = FakeServer::default();
    server.with(|state| state.put_free(3));
    let (one, two) = (Candidate::start(&server, someone()), someone());
    one.leads().await;
    let standby = Candidate::start(&server, two);
    sleep(Duration::from_secs(5)).await;
    server.with(|state| state.lease = None);
    sleep(Duration::from_mins(1)).await;
    assert!(one.may_write() && !standby.may_write());
    assert_eq!(server.with(|state| state.spec("leaseTransitions")), 4);
    assert_eq!(*standby.leader.leadership().borrow(), Leadership::Standby);
}

#[tokio::test(start_paused = true)]
async fn of_many_candidates_exactly_one_leads_at_any_time() {
    let server = FakeServer::default();
    let mut candidates: Vec<_> = (0..5).map(|_| Candidate::start(&server, someone())).collect();
    let mut leaders = 0;
    while !candidates.is_empty() {
        let mut found = None;
        for _ in 0..60 {
            sleep(Duration::from_millis(500)).await;
            let writers: Vec<_> = (0..candidates.len()).filter(|&i| candidates[i].may_write()).collect();
            assert!(writers.len() <= 1, "{writers:?}");
            found = writers.first().copied().or(found);
        }
        let leader = candidates.swap_remove(found.expect("somebody leads"));
        leaders += 1;
        // Every other one vanishes without a word.
        if leaders % 2 == 0 {
            leader.leader.release().await;
        }
    }
    assert_eq!(server.with(|state| state.spec("leaseTransitions")), 5);
}

#[tokio::test(start_paused = true)]
async fn a_release_that_fails_leaves_the_fence_closed_and_the_lease_to_expire() {
    let server = FakeServer::default();
    let candidate = Candidate::start(&server, someone());
    candidate.leads().await;
    let fence = candidate.leader.fence();
    server.with(|state| state.always = Some(Fault::Forbidden));
    candidate.leader.release().await;
    assert!(!fence.may_write());
    assert!(
        server.with(|state| state.spec("holderIdentity")).is_string(),
        "it expires"
    );
}
