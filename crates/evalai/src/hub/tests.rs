mod drain;
mod inputs;
mod tokens;

use super::*;
use crate::token::Token;
use crate::types::{Metrics, Run};
use futures::FutureExt;
use leaderboard_api::Attempt;
use leaderboard_base::shutdown::Stop;
use leaderboard_base::spans::LogSpan;
use leaderboard_base::tasks::Tasks;
use std::time::Duration;
use tokio::sync::mpsc;

/// A hub that nobody listens to.
fn hub(tasks: &Tasks, write_guard: impl Fn() -> bool + Send + Sync + 'static) -> Hub {
    Hub::new(Options::unheard(tasks, write_guard))
}

fn target(token: &str) -> Target {
    Target {
        leaderboard: key("board"),
        api_server: "http://127.0.0.1:9".into(),
        challenge: 1,
        split: "leaderboard".into(),
        token: Arc::new(Token::parse(token).unwrap()),
        requests_per_minute: 54,
        sweep: Duration::from_mins(1),
        period: Duration::from_secs(10),
        phases: [1].into(),
        metrics: Metrics::Fixed([].into()),
        inbox: None,
        is_observed: false,
        takes_files: false,
        since: Timestamp::UNIX_EPOCH,
    }
}

fn key(name: &str) -> Key {
    Key {
        namespace: "ns".into(),
        name: name.into(),
        uid: name.into(),
    }
}

#[tokio::test(start_paused = true)]
async fn the_task_of_each_token_is_one_of_the_process() {
    let (_stop, signal) = Stop::new();
    let tasks = Tasks::new(signal);
    // Nothing is sent anywhere: the guard's panic stands for any of the task's own.
    let hub = hub(&tasks, || -> bool { panic!("on purpose") });
    hub.serve(&key("board"), &target("x")).unwrap();
    let failed = tokio::time::timeout(Duration::from_mins(1), tasks.failed()).await;
    let failed = failed.unwrap().to_string();
    assert!(
        failed.starts_with("task EvalAI requests of token-") && failed.contains("has panicked: on purpose"),
        "{failed}"
    );
    assert!(!hub.drain().await, "a write of it may have no answer");
}

#[tokio::test(start_paused = true)]
async fn people_read_when_writes_begin_by_the_clock_of_the_process() {
    let (_stop, signal) = Stop::new();
    let wait = Duration::from_secs(75);
    let hub = Hub::new(Options {
        clock: Clock::system().with_wall(|| Timestamp::UNIX_EPOCH),
        not_before: Instant::now() + wait,
        ..Options::unheard(&Tasks::new(signal), || true)
    });
    assert_eq!(hub.writes_from(), Some(Timestamp::UNIX_EPOCH + wait));
    tokio::time::advance(wait).await;
    assert_eq!(hub.writes_from(), None);
}

#[test]
fn only_a_leaderboard_that_publishes_has_a_publisher() {
    for is_observed in [false, true] {
        let run = Run {
            attempt: Attempt(1),
            job: "submission-7-1".into(),
            by_hand: false,
            has_job: true,
            ended: None,
            log: LogSpan::default(),
        };
        let target = Target {
            is_observed,
            ..target("x")
        };
        let (target, key) = (Arc::new(target), key("7"));
        let subject = Subject {
            target,
            key,
            pk: 7,
            run,
        };
        assert_eq!(Publisher::of(subject).is_none(), is_observed);
    }
}

#[tokio::test(start_paused = true)]
async fn a_leaderboard_that_is_forgotten_is_served_no_more() {
    let (_stop, signal) = Stop::new();
    let hub = hub(&Tasks::new(signal), || true);
    let slow = Target {
        requests_per_minute: 10,
        ..target("x")
    };
    hub.serve(&key("one"), &slow).unwrap();
    hub.serve(&key("two"), &target("x")).unwrap();
    let limit = || hub.usage(&key("two")).unwrap().limit;
    assert_eq!(limit(), 10, "the lower one of a token's Leaderboards");
    hub.forget(&key("one"));
    assert_eq!(limit(), 54);
}

#[tokio::test(start_paused = true)]
async fn nothing_is_remembered_of_a_thousand_submissions_that_are_forgotten() {
    let (_stop, signal) = Stop::new();
    let hub = hub(&Tasks::new(signal), || true);
    let target = Arc::new(target("x"));
    let subject = |pk: i64| Subject {
        target: target.clone(),
        key: key(&pk.to_string()),
        pk,
        run: Run {
            attempt: Attempt(1),
            job: format!("submission-{pk}-1"),
            by_hand: false,
            has_job: true,
            ended: None,
            log: LogSpan::default(),
        },
    };
    for pk in 0..1000 {
        hub.live(&subject(pk), Timestamp::UNIX_EPOCH).unwrap();
    }
    assert_eq!(hub.state().places.len(), 1000);
    for pk in 0..1000 {
        hub.forget(&subject(pk).key);
    }
    tokio::time::sleep(Duration::from_mins(2)).await;
    let state = hub.state();
    assert_eq!((state.places.len(), state.tokens.len()), (0, 0));
    drop(state);
    assert!(hub.view(&key("1")).is_none());
}

#[tokio::test(start_paused = true)]
async fn the_task_of_a_token_ends_when_nothing_uses_it_and_comes_back_with_the_next_use() {
    let (_stop, signal) = Stop::new();
    let tasks = Tasks::new(signal);
    let hub = hub(&tasks, || true);
    let running = || tasks.names().len();
    let settled = async || tokio::time::sleep(Duration::from_mins(2)).await;
    hub.serve(&key("one"), &target("x")).unwrap();
    hub.serve(&key("two"), &target("x")).unwrap();
    hub.serve(&key("three"), &target("y")).unwrap();
    assert_eq!(running(), 2);
    hub.retire(&key("one"));
    hub.retire(&key("three"));
    settled().await;
    assert_eq!(running(), 1, "the one that a Leaderboard still uses");
    assert_eq!(hub.state().tokens.len(), 1);
    hub.serve(&key("two"), &target("y")).unwrap();
    settled().await;
    assert_eq!(running(), 1, "the renewed token's");
    hub.retire(&key("two"));
    settled().await;
    assert_eq!((running(), hub.state().places.len()), (0, 0));
    hub.serve(&key("two"), &target("x")).unwrap();
    assert_eq!(running(), 1);
    assert!(tasks.failed().now_or_never().is_none());
    assert!(hub.drain().await);
}
