//! One round of a full run: read four workers' files, merge, render. Measured against reading the same bytes into
//! `serde_json` values and writing them again, the least any merge of them has to do.
//!
//! `cargo bench -p leaderboard-results`. Read the ratio: it does not depend on the machine as the times do. 1.0 would be a
//! merge for free.
#![allow(clippy::unwrap_used, reason = "a bench that can't run has nothing to say")]

#[path = "../tests/common/mod.rs"]
mod common;

use std::hint::black_box;
use std::time::{Duration, Instant};

use common::{Drive, finished, pod};
use leaderboard_results::{Format, offline};

const ROUNDS: usize = 200;

fn main() {
    for (format, repetitions) in [(Format::V1, 5), (Format::V2, 1)] {
        let slices = [(0, 4), (5, 9), (10, 14), (15, 19)];
        let plan = pod(format, repetitions, &slices);
        let files: Vec<Vec<u8>> = slices.iter().map(|slice| worker(format, *slice, repetitions)).collect();
        let inputs: Vec<Option<Vec<u8>>> = files.iter().cloned().map(Some).collect();
        assert!(offline(&plan, &inputs).unwrap().0.is_final);

        let ours = best(|| {
            black_box(offline(&plan, black_box(&inputs)).unwrap());
        });
        let least = best(|| {
            let values: Vec<serde_json::Value> = files
                .iter()
                .map(|file| serde_json::from_slice(black_box(file)).unwrap())
                .collect();
            black_box(serde_json::to_string_pretty(&values).unwrap());
        });
        let size = files.iter().map(Vec::len).sum::<usize>() / 1024;
        let records = 20 * repetitions;
        let ratio = ours.as_secs_f64() / least.as_secs_f64();
        println!(
            "{format:?}: {records} records, {size} KiB: {ours:?} a round, parse and write {least:?}, ratio {ratio:.1}"
        );
    }
}

fn worker(format: Format, (first, last): (u32, u32), repetitions: u32) -> Vec<u8> {
    let message = "Agent collided against object with type=vehicle.tesla.model3 and id=17 at (x=1.5, y=2.5, z=0.5)";
    let drives = (first..=last).flat_map(|id| (0..repetitions).map(move |k| Drive::perfect(id).repeated(k)));
    let crash = |drive| Drive {
        penalty: 0.36,
        infractions: vec![("collisions_vehicle", vec![message.to_owned(); 2])],
        ..drive
    };
    finished(format, &drives.map(crash).collect::<Vec<_>>())
        .to_string()
        .into_bytes()
}

/// The fastest of many rounds: the others were disturbed.
fn best(mut round: impl FnMut()) -> Duration {
    let time = |()| {
        let start = Instant::now();
        round();
        start.elapsed()
    };
    std::iter::repeat_n((), ROUNDS).map(time).min().unwrap_or_default()
}
