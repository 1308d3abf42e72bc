//! The queue with its tasks, under a paused clock.

use std::collections::HashMap;
use std::time::Duration;

use tokio::sync::{mpsc, watch};
use tokio::task::JoinHandle;

use super::*;
use crate::metrics::{Metrics, Program};

const LIMITS: Limits = Limits {
    reconciles: 16,
    creates: 8,
    creates_per_namespace: 4,
};
const TAKES: Duration = Duration::from_millis(100);
const LATER: After = After::In(Duration::from_mins(10), Class::Refresh);

fn key(namespace: &str, name: impl Into<Arc<str>>) -> Key {
    Key {
        namespace: namespace.into(),
        name: name.into(),
    }
}

struct Running {
    queue: Arc<Queue>,
    /// Reconciles that have begun, and when.
    begun: mpsc::UnboundedReceiver<(Key, Instant)>,
    stop: watch::Sender<bool>,
    task: JoinHandle<()>,
}

/// A queue whose reconciles take as long as `takes` returns for their key. The reconciles of new objects create a Job.
fn start(takes: impl Fn(&Key) -> Duration + Send + Sync + 'static) -> Running {
    let waits = Class::ALL.map(|class| {
        Metrics::new(Program::Controller)
            .work
            .reconcile_wait
            .of(["Submission", class.as_str()])
    });
    let queue = Queue::new(LIMITS, waits);
    let (tell, begun) = mpsc::unbounded_channel();
    let (stop, stopped) = Stop::new();
    let reconciles = Arc::clone(&queue);
    let task = tokio::spawn(async move {
        let reconcile = |turn: Turn| {
            let (tell, takes) = (tell.clone(), takes(&turn.key));
            async move {
                let _ = tell.send((turn.key.clone(), Instant::now()));
                if !turn.may_continue(turn.key.name.starts_with("new")) {
                    return After::WithPermit;
                }
                tokio::time::sleep(takes).await;
                LATER
            }
        };
        reconciles.run(&stopped, reconcile).await;
    });
    Running {
        queue,
        begun,
        stop,
        task,
    }
}

impl Running {
    async fn next(&mut self) -> (String, Instant) {
        let (key, at) = self.begun.recv().await.unwrap();
        (key.to_string(), at)
    }

    /// Nothing more begins within a minute.
    async fn is_quiet(&mut self) -> bool {
        tokio::time::sleep(Duration::from_mins(1)).await;
        self.begun.is_empty()
    }
}

#[tokio::test(start_paused = true)]
async fn ends_go_before_a_thousand_new_ones() {
    let mut running = start(|_| TAKES);
    for number in 0..1000 {
        running.queue.add(key("one", format!("new-{number}")), Class::New);
    }
    tokio::time::sleep(Duration::from_secs(1)).await;
    let began = Instant::now();
    for number in 0..50 {
        running.queue.add(key("one", format!("end-{number}")), Class::Urgent);
    }
    let mut ends = Vec::new();
    while ends.len() < 50 {
        let (name, at) = running.next().await;
        if name.starts_with("one/end") {
            ends.push(at - began);
        }
    }
    // Four creates of the namespace run; twelve others may.
    assert!(ends.iter().all(|waited| *waited <= 5 * TAKES), "{ends:?}");
    running.task.abort();
}

#[tokio::test(start_paused = true)]
async fn a_live_one_is_served_under_a_load_of_ends_and_new_ones() {
    let mut running = start(|_| TAKES);
    let queue = Arc::clone(&running.queue);
    // More ends than can be served.
    let load = tokio::spawn(async move {
        for number in 0_u32.. {
            queue.add(key("one", format!("end-{number}")), Class::Urgent);
            queue.add(key("one", format!("new-{number}")), Class::New);
            tokio::time::sleep(Duration::from_millis(4)).await;
        }
    });
    tokio::time::sleep(Duration::from_secs(10)).await;
    let began = Instant::now();
    running.queue.add(key("one", "live"), Class::Refresh);
    let waited = loop {
        let (name, at) = running.next().await;
        if name == "one/live" || at - began > Duration::from_mins(1) {
            break at - began;
        }
    };
    assert!(waited <= Duration::from_secs(10), "{waited:?}");
    load.abort();
    running.task.abort();
}

#[tokio::test(start_paused = true)]
async fn slow_creates_in_one_namespace_do_not_delay_those_of_another() {
    let slow = Duration::from_secs(10);
    let mut running = start(move |key| if &*key.namespace == "slow" { slow } else { TAKES });
    for number in 0..100 {
        running.queue.add(key("slow", format!("new-{number}")), Class::New);
    }
    for number in 0..40 {
        running.queue.add(key("other", format!("new-{number}")), Class::New);
    }
    let (began, mut begun) = (Instant::now(), HashMap::<bool, Vec<Duration>>::new());
    while begun.values().map(Vec::len).sum::<usize>() < 44 {
        let (name, at) = running.next().await;
        begun.entry(name.starts_with("other")).or_default().push(at - began);
    }
    assert_eq!(begun[&false].len(), 4, "those of the slow namespace");
    assert!(begun[&true].iter().all(|waited| *waited < 10 * TAKES), "{begun:?}");
    running.task.abort();
}

#[tokio::test(start_paused = true)]
async fn an_event_during_its_reconcile_is_one_more_reconcile_right_after_it() {
    let mut running = start(|_| TAKES);
    running.queue.add(key("one", "a"), Class::Refresh);
    let (_, first) = running.next().await;
    for _ in 0..3 {
        running.queue.add(key("one", "a"), Class::Refresh);
    }
    let (_, second) = running.next().await;
    assert!(
        second - first >= TAKES && second - first <= TAKES * 2,
        "{:?}",
        second - first
    );
    assert!(running.is_quiet().await);
    running.task.abort();
}

#[tokio::test(start_paused = true)]
async fn the_first_event_is_served_at_once_and_the_requeue_at_its_time() {
    let mut running = start(|_| TAKES);
    let began = Instant::now();
    running.queue.add(key("one", "a"), Class::Refresh);
    let waited = running.next().await.1 - began;
    assert!(waited <= Duration::from_millis(1), "{waited:?}");
    let again = running.next().await.1 - began;
    let expected = Duration::from_mins(10) + TAKES;
    assert!(
        expected <= again && again <= expected + Duration::from_secs(1),
        "{again:?}"
    );
    running.task.abort();
}

#[tokio::test(start_paused = true)]
async fn who_has_no_permit_gives_its_place_to_others_and_creates_later() {
    let mut running = start(|_| TAKES);
    for number in 0..4 {
        running.queue.add(key("one", format!("new-{number}")), Class::New);
    }
    for _ in 0..4 {
        running.next().await;
    }
    // It turns out to create a Job, although its event was no new submission's.
    running.queue.add(key("one", "new-retry"), Class::Refresh);
    let mut attempts = Vec::new();
    while attempts.len() < 2 {
        let (name, at) = running.next().await;
        assert_eq!(name, "one/new-retry");
        attempts.push(at);
    }
    assert!(
        attempts[1] - attempts[0] >= TAKES / 2,
        "it waited for a permit: {attempts:?}"
    );
    assert!(running.is_quiet().await);
    running.task.abort();
}

#[tokio::test(start_paused = true)]
async fn a_stop_finishes_what_has_begun_and_begins_nothing() {
    let mut running = start(|_| Duration::from_secs(5));
    for number in 0..40 {
        running.queue.add(key("one", format!("live-{number}")), Class::Refresh);
    }
    for _ in 0..12 {
        running.next().await;
    }
    let began = Instant::now();
    running.stop.send_replace(true);
    running.task.await.unwrap();
    let took = began.elapsed();
    assert!(
        took >= Duration::from_secs(4),
        "it did not wait for those that run: {took:?}"
    );
    assert!(running.begun.is_empty());
}

#[tokio::test(start_paused = true)]
async fn what_is_given_up_is_ended() {
    let mut running = start(|_| Duration::from_secs(5));
    running.queue.add(key("one", "a"), Class::Refresh);
    running.next().await;
    running.task.abort();
    let _ = running.task.await;
    tokio::time::sleep(Duration::from_secs(10)).await;
    // The task and its reconcile, which held the queue too, have ended.
    assert_eq!(Arc::strong_count(&running.queue), 1);
}
