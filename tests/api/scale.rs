//! Many submissions at once, on a real API server with a played cluster. The budget of requests to EvalAI holds, every result is
//! published, and a cancellation in EvalAI reaches the Pod.
//!
//! The small size belongs to the tests. The full one measures, and takes a quarter of an hour: `make measure-scale`.

mod board;
mod cancels;

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use evalai_stand_in::log::Entry;
use evalai_stand_in::model::{FileState, Status as Stored};
use evalai_stand_in::submissions::{NewSubmission, create as push};
use evalai_stand_in::{Config, Handle, Knobs};
use futures::StreamExt;
use jiff::{SignedDuration, Timestamp};
use kube::api::Api;
use kube::runtime::{WatchStreamExt, watcher};
use kube::{Client, ResourceExt};
use leaderboard_api::{Leaderboard, Reason, State, Submission, conditions};
use serde_json::{Map, Value, json};
use tokio::net::TcpListener;
use tokio::time::{Instant, timeout_at};

use super::bridge::StandIn;
use super::objects::{Kind, create};
use super::operator::Operator;
use crate::support::apiserver::server;
use crate::support::player::{Cluster, Player, ROUTES, reports};
use board::make_board;

const BOARD: &str = "carla";
/// How often it is looked whether the controller goes on.
const LOOK: Duration = Duration::from_secs(5);
/// By how many seconds an end may be published after a younger one: its result may still have been read meanwhile.
const LATE: f64 = 15.0;

/// How much of everything.
struct Size {
    /// Submissions that come to their own end, all of them at the same moment.
    finals: usize,
    /// Submissions that are cancelled in EvalAI while all others run.
    cancels: usize,
    /// Time over which they are cancelled.
    cancel_over: Duration,
    requests_per_minute: usize,
    period_seconds: u32,
    /// How long EvalAI takes for a list, and for a result.
    list: Duration,
    put: Duration,
    /// Longest time for each of the three parts.
    limit: Duration,
}

const SMALL: Size = Size {
    finals: 20,
    cancels: 6,
    cancel_over: Duration::from_secs(8),
    requests_per_minute: 300,
    period_seconds: 2,
    list: Duration::from_millis(300),
    put: Duration::from_millis(50),
    limit: Duration::from_mins(3),
};

/// The numbers of a large challenge, and of EvalAI on a slow day.
const FULL: Size = Size {
    finals: 200,
    cancels: 100,
    cancel_over: Duration::from_mins(3),
    requests_per_minute: 54,
    period_seconds: 10,
    list: Duration::from_secs(3),
    put: Duration::from_millis(500),
    limit: Duration::from_mins(20),
};

/// A deadline's evening, with a budget that lets the test end.
const THOUSAND: Size = Size {
    finals: 1000,
    cancels: 0,
    requests_per_minute: 3000,
    put: Duration::from_millis(50),
    ..FULL
};

#[tokio::test(flavor = "multi_thread")]
async fn many_submissions_stay_inside_the_budget_and_all_are_published() {
    measure(&SMALL).await;
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "it measures for a quarter of an hour: make measure-scale"]
async fn two_hundred_submissions_at_the_size_of_a_large_challenge() {
    measure(&FULL).await;
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "it measures for a quarter of an hour: make measure-scale"]
async fn a_thousand_that_end_at_once_are_published_the_oldest_first() {
    measure(&THOUSAND).await;
}

async fn measure(size: &Size) {
    let mut world = World::start(size).await;
    let pks = world.run(size).await;
    let all: BTreeSet<String> = pks.iter().map(|pk| name(*pk)).collect();
    let (cancelled, others) = pks.split_at(size.cancels);
    let (mut undone, _) = world.cancel_all(size, cancelled).await;

    world.player.fall_the_curtain();
    world
        .until(size, "all have ended", |seen| {
            all.iter().all(|name| seen.terminal.contains_key(name))
        })
        .await;
    // A list may have shown a cancel that was being written over.
    let stopped = world.player.seen().asked_to_stop;
    undone.retain(|pk| !stopped.contains_key(&name(*pk)));
    let rest: BTreeSet<String> = others.iter().chain(&undone).map(|pk| name(*pk)).collect();
    world
        .until(size, "all are published", |seen| {
            all.iter().all(|name| seen.terminal.contains_key(name))
                && rest.iter().all(|name| seen.published.contains(name))
                && all.iter().all(|name| seen.settled.contains(name))
        })
        .await;
    world.report_ends(&rest);
    world.check(size, &rest, cancelled, &undone);
    world.operator.end().await;
}

fn name(pk: u64) -> String {
    format!("submission-{pk}")
}

fn between(from: Timestamp, to: Timestamp) -> f64 {
    to.duration_since(from).as_secs_f64()
}

/// Prints the middle, the 99th percentile and the last of some times.
fn say(what: &str, mut seconds: Vec<f64>) {
    seconds.sort_by(f64::total_cmp);
    let at = |part: usize| {
        seconds
            .get((seconds.len() * part).div_ceil(100).saturating_sub(1))
            .copied()
    };
    if let (Some(middle), Some(late), Some(last)) = (at(50), at(99), seconds.last()) {
        println!(
            "{what}: {} times, p50 {middle:.2} s, p99 {late:.2} s, max {last:.2} s",
            seconds.len()
        );
    }
}

/// Everything around the controller.
struct World {
    operator: Operator,
    evalai: Handle,
    player: Player,
    client: Client,
    namespace: String,
    submissions: Seen,
    changes: std::pin::Pin<Box<dyn futures::Stream<Item = Submission> + Send>>,
}

/// The Submissions as their statuses have shown them.
#[derive(Default)]
struct Seen {
    states: BTreeMap<String, State>,
    terminal: BTreeMap<String, Timestamp>,
    published: BTreeSet<String>,
    /// When each ended, as its status shows.
    finished: BTreeMap<String, Timestamp>,
    /// Nothing more of them is to be sent to EvalAI.
    settled: BTreeSet<String>,
}

impl Seen {
    fn is(&self, name: &str, state: State) -> bool {
        self.states.get(name) == Some(&state)
    }

    fn take(&mut self, submission: &Submission) {
        let Some(status) = &submission.status else { return };
        let name = submission.name_any();
        let finished = status.times.finished.as_ref();
        self.finished.extend(finished.map(|time| (name.clone(), time.0)));
        self.states.extend(status.state.map(|state| (name.clone(), state)));
        if conditions::is_true(&status.conditions, conditions::FINISHED) {
            self.terminal.entry(name.clone()).or_insert_with(Timestamp::now);
        }
        let Some(published) = conditions::get(&status.conditions, conditions::PUBLISHED) else {
            return;
        };
        if published.status == "True" {
            self.published.insert(name.clone());
        }
        if published.status == "True" || published.reason == Reason::NotRequired {
            self.settled.insert(name);
        }
    }
}

impl World {
    async fn start(size: &Size) -> Self {
        let aws = StandIn::start().await;
        let client = server().await.client();
        let namespace = server().await.namespace("scale").await;
        let (config, _) = Config::in_memory().unwrap();
        // Its own limit is a little above ours, as in EvalAI.
        let config = Config {
            throttle: size.requests_per_minute * 60 / 54,
            ..config
        };
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let evalai = evalai_stand_in::serve(config, vec![listener]);
        let millis = |time: Duration| u64::try_from(time.as_millis()).unwrap();
        evalai.set_knobs(Knobs {
            list_delay_ms: millis(size.list),
            list_row_ms: 0,
            put_delay_ms: millis(size.put),
            ..Knobs::default()
        });
        let bucket = aws.name("scale");
        let s3 = aws.aws.s3(None, Some(&aws.endpoint));
        s3.create_bucket().bucket(&bucket).send().await.unwrap();
        make_board(&client, &namespace, size, &evalai, &bucket, &aws.endpoint).await;
        let period = Duration::from_secs(size.period_seconds.into());
        let player = Player::start(Cluster::new(&client, &namespace), reports(period, s3, &bucket));
        let api: Api<Submission> = Api::namespaced(client.clone(), &namespace);
        let changes = watcher(api, watcher::Config::default())
            .default_backoff()
            .applied_objects();
        Self {
            operator: Operator::start(&namespace, aws.aws).await,
            evalai,
            player,
            client,
            namespace,
            submissions: Seen::default(),
            changes: changes.filter_map(async |event| event.ok()).boxed(),
        }
    }

    /// A participant pushes an image; its message goes nowhere.
    fn submit(&self) -> u64 {
        let new = NewSubmission {
            team: 1,
            phase: 1,
            user: 11,
            input: br#"{"submitted_image_uri": "registry.example/team-a:1"}"#.to_vec(),
            fields: Map::new(),
        };
        self.evalai
            .with_state(|state| push(state, new, FileState::Stored, Timestamp::now()))
    }

    async fn apply(&self, pk: u64) {
        let spec = json!({"spec": {
            "leaderboardName": BOARD, "track": null, "evalai": {"challenge": 1, "phase": 1, "submission": pk},
        }});
        let api = Kind::Submission.api(&self.client, &self.namespace);
        create(&api, Kind::Submission.object(&name(pk), &[&spec]), false)
            .await
            .unwrap();
    }

    /// Follows the Submissions until something holds.
    async fn until(&mut self, size: &Size, what: &str, holds: impl Fn(&Seen) -> bool) {
        let end = Instant::now() + size.limit;
        while !holds(&self.submissions) {
            assert!(self.operator.is_running(), "the controller has ended by itself: {what}");
            let change = timeout_at(end.min(Instant::now() + LOOK), self.changes.next()).await;
            if change.is_err() && Instant::now() < end {
                continue;
            }
            let Ok(Some(submission)) = change else {
                panic!("not after {:?}: {what}; {:?}", size.limit, self.submissions.states);
            };
            self.submissions.take(&submission);
        }
    }

    /// Submits all, and waits until they run.
    async fn run(&mut self, size: &Size) -> Vec<u64> {
        let began = Instant::now();
        let pks: Vec<u64> = (0..size.finals + size.cancels).map(|_| self.submit()).collect();
        for pk in &pks {
            self.apply(*pk).await;
        }
        let all: BTreeSet<String> = pks.iter().map(|pk| name(*pk)).collect();
        self.until(size, "all run", |seen| {
            all.iter().all(|name| seen.is(name, State::Running))
        })
        .await;
        let took = began.elapsed().as_secs_f64();
        println!("{} submissions run after {took:.1} s", pks.len());
        pks
    }

    /// Cancels at random moments, and returns when each was.
    async fn cancel(&self, pks: &[u64], over: Duration) -> BTreeMap<u64, Timestamp> {
        let seed = fastrand::u64(..);
        println!("the moments of the cancels are of seed {seed}");
        let mut random = fastrand::Rng::with_seed(seed);
        let mut moments: Vec<_> = pks.iter().map(|pk| (over.mul_f64(random.f64()), *pk)).collect();
        moments.sort();
        let began = Instant::now();
        let mut times = BTreeMap::new();
        for (moment, pk) in moments {
            tokio::time::sleep_until(began + moment).await;
            self.evalai
                .with_state(|state| state.submissions.get_mut(&pk).unwrap().status = Stored::Cancelled);
            times.insert(pk, Timestamp::now());
        }
        times
    }

    /// Waits until each cancelled submission is stopped, or EvalAI has forgotten that it was cancelled; gives the latter.
    async fn settle(&mut self, size: &Size, pks: &[u64]) -> Vec<u64> {
        let (mut undone, mut open) = (Vec::new(), Vec::new());
        // A Pod that was asked to stop is noticed by the next request, and EvalAI gets some in every sweep.
        let settled = self.evalai.wait_until(|state, _| {
            let stopped = self.player.seen().asked_to_stop;
            let left = pks.iter().filter(|pk| !stopped.contains_key(&name(**pk)));
            (undone, open) = left.partition(|pk| state.submissions[*pk].status != Stored::Cancelled);
            open.is_empty()
        });
        let in_time = tokio::time::timeout(size.limit, settled).await;
        assert!(in_time.is_ok(), "not asked to stop after {:?}: {open:?}", size.limit);
        undone
    }

    /// Prints which write it was that undid each cancel.
    fn explain(&self, undone: &[u64], times: &BTreeMap<u64, Timestamp>) {
        let log = self.evalai.requests();
        for pk in undone {
            let mut writes = log.iter().filter(|entry| entry.body["submission"] == json!(pk));
            if let Some(by) = writes.find(|entry| entry.answered.is_none_or(|at| at > times[pk])) {
                let (after, said) = (between(times[pk], by.time), &by.body["submission_status"]);
                println!(
                    "submission {pk}: {} {said} came {after:.2} s after the cancel",
                    by.method
                );
            }
        }
    }

    fn puts(&self, status: &str) -> BTreeMap<u64, Entry> {
        let log = self.evalai.requests().into_iter();
        let puts = log.filter(|entry| entry.method == "PUT" && entry.body["submission_status"] == json!(status));
        puts.map(|entry| (entry.body["submission"].as_u64().unwrap(), entry))
            .collect()
    }

    fn report_ends(&self, rest: &BTreeSet<String>) {
        let ended = self.player.seen().ended;
        let puts = self.puts("finished");
        let of = |name: &str| name.trim_start_matches("submission-").parse::<u64>().unwrap();
        let status = rest
            .iter()
            .map(|name| between(ended[name], self.submissions.terminal[name]));
        say("the Job's end to the terminal status", status.collect());
        let put = rest
            .iter()
            .filter_map(|name| Some(between(ended[name], puts.get(&of(name))?.time)));
        say("the Job's end to the PUT of the result", put.collect());
        let mut order: Vec<_> = puts.iter().map(|(pk, entry)| (entry.time, *pk)).collect();
        order.sort();
        let mut newest = Timestamp::UNIX_EPOCH;
        for (_, pk) in order {
            let at = self.submissions.finished[&name(pk)];
            assert!(
                between(at, newest) <= LATE,
                "{pk} ended at {at}, after one of {newest} was published"
            );
            newest = newest.max(at);
        }
    }

    fn check(&self, size: &Size, rest: &BTreeSet<String>, cancelled: &[u64], undone: &[u64]) {
        let log = self.evalai.requests();
        let times: Vec<Timestamp> = log.iter().map(|entry| entry.time).collect();
        let (minute, sixth) = (most_within(&times, 60_000), most_within(&times, 10_000));
        println!(
            "{} requests, at most {minute} in any minute, {sixth} in any 10 s",
            log.len()
        );
        let throttled = log.iter().filter(|entry| entry.status == Some(429)).count();
        assert_eq!(throttled, 0, "EvalAI throttled us");
        // Requests that leave in time may arrive a little closer together.
        let limit = size.requests_per_minute;
        assert!(most_within(&times, 59_000) <= limit, "{minute} requests in a minute");
        assert!(
            sixth <= limit / 3 + 2,
            "{sixth} requests in 10 s: a burst and a sixth of a minute"
        );
        let state = self.evalai.state();
        for name in rest {
            let pk: u64 = name.trim_start_matches("submission-").parse().unwrap();
            assert_eq!(state.submissions[&pk].status, Stored::Finished, "{name}");
            let rows: Vec<_> = state.rows.values().filter(|row| row.submission == pk).collect();
            assert_eq!(rows.len(), 1, "{name} has one row on the leaderboard");
            assert_eq!(
                rows[0].result["Driving score"].as_f64(),
                Some(100.0),
                "{name}: the result of all {ROUTES} routes"
            );
            assert!(self.submissions.is(name, State::Finished), "{name}");
        }
        self.check_cancelled(cancelled.iter().filter(|pk| !undone.contains(pk)), &log);
        let partials = log
            .iter()
            .filter(|entry| entry.path.contains("partially_evaluated"))
            .count();
        println!("{partials} partial results");
    }

    /// Fails unless each stopped submission is Cancelled in EvalAI too, also if a write that was on its way had undone that.
    fn check_cancelled<'a>(&self, pks: impl Iterator<Item = &'a u64>, log: &[Entry]) {
        let state = self.evalai.state();
        let mut sent_again = 0;
        for pk in pks {
            assert!(self.submissions.is(&name(*pk), State::Cancelled), "submission {pk}");
            assert_eq!(
                state.submissions[pk].status,
                Stored::Cancelled,
                "submission {pk} in EvalAI"
            );
            let is_again = |entry: &&Entry| entry.method == "PUT" && entry.body["submission"] == json!(pk);
            sent_again += usize::from(
                log.iter()
                    .filter(is_again)
                    .any(|entry| entry.body["submission_status"] == json!("cancelled")),
            );
        }
        println!("{sent_again} cancels were sent again after a write of ours that was on its way");
    }
}

/// The most moments within any so many milliseconds.
fn most_within(times: &[Timestamp], milliseconds: i64) -> usize {
    let window = SignedDuration::from_millis(milliseconds);
    let from = |first: usize| {
        times[first..]
            .iter()
            .take_while(|time| time.duration_since(times[first]) < window)
            .count()
    };
    (0..times.len()).map(from).max().unwrap_or(0)
}
