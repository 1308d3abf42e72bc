//! One round of a run: read four workers' files, merge, render. Measured against the floor: the same bytes read into
//! `serde_json` values and written again, the least any merge of them has to do.
//!
//! `make bench-results`. Read the ratio: it does not depend on the machine as the times do. 1.0 would be a merge for free; the aim is
//! at most 3.
#![allow(clippy::unwrap_used, reason = "a bench that can't run has nothing to say")]

#[path = "../tests/common/mod.rs"]
mod common;

use std::alloc::System;
use std::hint::black_box;
use std::time::{Duration, Instant};

use common::{Drive, finished, pod};
use leaderboard_results::{Format, Plan, offline};
use serde::Serialize as _;
use serde_json::Value;
use serde_json::ser::{PrettyFormatter, Serializer};
use stats_alloc::{INSTRUMENTED_SYSTEM, Region, StatsAlloc};

#[global_allocator]
static COUNTED: &StatsAlloc<System> = &INSTRUMENTED_SYSTEM;

const WORKERS: u32 = 4;
/// Both sides take turns for so long.
const TIME: Duration = Duration::from_secs(2);
const LEAST_ROUNDS: usize = 20;

fn main() {
    println!("format records    KiB |  round µs  records/s  allocations  per record | floor µs  allocations | ratio");
    for format in [Format::V1, Format::V2] {
        for records in [20, 100, 2_000] {
            measure(format, records);
        }
    }
}

fn measure(format: Format, records: u32) {
    let repetitions = if format == Format::V1 { 5 } else { 1 };
    let share = records / repetitions / WORKERS;
    let slices: Vec<(u32, u32)> = (0..WORKERS).map(|k| (k * share, (k + 1) * share - 1)).collect();
    let plan = pod(format, repetitions, &slices);
    let files: Vec<Vec<u8>> = slices.iter().map(|slice| worker(format, *slice, repetitions)).collect();
    let inputs: Vec<Option<Vec<u8>>> = files.iter().cloned().map(Some).collect();
    let (merged, _) = offline(&plan, &inputs).unwrap();
    assert!(merged.is_final && merged.done == records && merged.warnings.is_empty());

    let ours = || round(&plan, &inputs);
    let floor = || read_and_write(&files);
    let (our_time, floor_time) = fastest(ours, floor);
    let (our_allocations, floor_allocations) = (allocations(ours), allocations(floor));
    let size = files.iter().map(Vec::len).sum::<usize>() / 1024;
    let (us, floor_us) = (our_time.as_secs_f64() * 1e6, floor_time.as_secs_f64() * 1e6);
    println!(
        "{:<6} {records:>7} {size:>6} | {us:>9.0} {:>10.0} {our_allocations:>12} {:>11.1} | {floor_us:>8.0} {floor_allocations:>12} | \
         {:>5.2}",
        format!("{format:?}"),
        f64::from(records) / our_time.as_secs_f64(),
        f64::from(our_allocations) / f64::from(records),
        us / floor_us,
    );
}

fn round(plan: &Plan, inputs: &[Option<Vec<u8>>]) {
    black_box(offline(plan, black_box(inputs)).unwrap());
}

fn read_and_write(files: &[Vec<u8>]) {
    let values: Vec<Value> = files
        .iter()
        .map(|file| serde_json::from_slice(black_box(file)).unwrap())
        .collect();
    black_box(written(&Value::from(values)));
}

/// In the evaluator's layout.
fn written(value: &Value) -> Vec<u8> {
    let mut text = Vec::new();
    let layout = PrettyFormatter::with_indent(b"    ");
    value
        .serialize(&mut Serializer::with_formatter(&mut text, layout))
        .unwrap();
    text
}

fn worker(format: Format, (first, last): (u32, u32), repetitions: u32) -> Vec<u8> {
    let message = "Agent collided against object with type=vehicle.tesla.model3 and id=17 at (x=1.5, y=2.5, z=0.5)";
    let drives = (first..=last).flat_map(|id| (0..repetitions).map(move |k| Drive::perfect(id).repeated(k)));
    let crash = |drive| Drive {
        penalty: 0.36,
        infractions: vec![("collisions_vehicle", vec![message.to_owned(); 2])],
        ..drive
    };
    written(&finished(format, &drives.map(crash).collect::<Vec<_>>()))
}

/// The fastest round of each side: the others were disturbed. In turns, so that both meet the same machine.
fn fastest(ours: impl Fn(), floor: impl Fn()) -> (Duration, Duration) {
    let time = |work: &dyn Fn()| {
        let start = Instant::now();
        work();
        start.elapsed()
    };
    let begin = Instant::now();
    let mut best = (Duration::MAX, Duration::MAX);
    let mut rounds = 0;
    while rounds < LEAST_ROUNDS || begin.elapsed() < TIME {
        best = (best.0.min(time(&ours)), best.1.min(time(&floor)));
        rounds += 1;
    }
    best
}

fn allocations(work: impl Fn()) -> u32 {
    let region = Region::new(COUNTED);
    work();
    let change = region.change();
    u32::try_from(change.allocations + change.reallocations).unwrap()
}
