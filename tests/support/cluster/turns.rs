//! Which test begins when: a few at once in any case, as they wait most of their time, and more while the processors have time left.

use std::fs;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use tokio::select;
use tokio::sync::{Mutex, Notify};
use tokio::time::sleep;

/// So many run in any case.
const FEW: usize = 6;
/// Tenths of the processors' time that must be left for a further one.
const LEFT: u64 = 3;
/// How long the processors are looked at. What has begun before is at work by then.
const LOOK: Duration = Duration::from_secs(4);
/// Places in the first line of /proc/stat of what another test could have: `nice`, of programs that give way, `idle` and `iowait`.
const FREE: [usize; 3] = [1, 3, 4];
/// Behind them are the times of guests, which are part of the others.
const ALL: usize = 8;

/// Tests that wait for their turn, in their order.
static LINE: Mutex<()> = Mutex::const_new(());
static RUNNING: AtomicUsize = AtomicUsize::new(0);
static ENDED: Notify = Notify::const_new();

/// The turn of a test that runs.
pub struct Turn(());

impl Turn {
    pub async fn take() -> Self {
        let _first = LINE.lock().await;
        while RUNNING.load(Ordering::SeqCst) >= FEW {
            select! {
                is_left = is_time_left() => if is_left { break },
                () = ENDED.notified() => {}
            }
        }
        RUNNING.fetch_add(1, Ordering::SeqCst);
        Self(())
    }
}

impl Drop for Turn {
    fn drop(&mut self) {
        RUNNING.fetch_sub(1, Ordering::SeqCst);
        ENDED.notify_one();
    }
}

async fn is_time_left() -> bool {
    let before = times(&stat());
    sleep(LOOK).await;
    is_left(&before, &times(&stat()))
}

fn stat() -> String {
    fs::read_to_string("/proc/stat").unwrap()
}

/// The processors' times since the machine's start, by what they did.
fn times(stat: &str) -> Vec<u64> {
    let numbers = stat.lines().next().unwrap().split_whitespace().skip(1).take(ALL);
    numbers.map(|number| number.parse().unwrap()).collect()
}

fn is_left(before: &[u64], after: &[u64]) -> bool {
    let spent: Vec<u64> = before
        .iter()
        .zip(after)
        .map(|(before, after)| after.saturating_sub(*before))
        .collect();
    let free: u64 = FREE.iter().map(|place| spent[*place]).sum();
    free * 10 >= spent.iter().sum::<u64>() * LEFT
}

#[test]
fn time_of_programs_that_give_way_is_left_for_a_further_test() {
    let before = times("cpu  10 10 10 10 10 10 10 10 99 99\ncpu0 1 1 1 1 1 1 1 1 1 1\n");
    let after = |nice: u64, idle: u64| times(&format!("cpu  70 {nice} 20 {idle} 10 10 10 10 500 500\n"));
    assert!(is_left(&before, &after(30, 20)), "30 of 100");
    assert!(!is_left(&before, &after(10, 20)), "10 of 80");
}
