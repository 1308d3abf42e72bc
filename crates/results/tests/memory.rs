//! The memory that reading and merging takes in a Pod, at the largest checkpoints that are taken: it does not grow with the
//! number of pairs.
#![allow(clippy::unwrap_used, reason = "the helpers of a test may fail it")]

mod common;

use std::alloc::System;
use std::fmt::Write as _;

use common::{Drive, assert_refusals, finished, pod};
use leaderboard_results::{Checkpoint, Format, Plan, merge, read_worker, render};
use serde_json::Value;
use stats_alloc::{INSTRUMENTED_SYSTEM, Region, StatsAlloc};

#[global_allocator]
static COUNTED: &StatsAlloc<System> = &INSTRUMENTED_SYSTEM;

/// Bytes that two rounds may allocate in all, freed or not: more than the memory they ever hold at once.
const MOST: usize = 512 << 20;
const TEXT: usize = 1 << 20;

/// A checkpoint with one finished route, filled up to the limits of its pair with small objects and long texts.
fn largest(plan: &Plan, pair: usize) -> Vec<u8> {
    let limits = plan.limits_of(pair);
    let drive = Drive::perfect(u32::try_from(pair).unwrap());
    let worker = finished(Format::V2, &[drive]);
    let small = "{\"\":0},".repeat((limits.values - values(&worker) - 200) / 2);
    let worker = worker.to_string();
    let mut left = limits.bytes - worker.len() - small.len() - "\"fill\":[0],".len();
    let mut texts = String::new();
    while left > 3 {
        let length = TEXT.min(left - 3);
        write!(texts, "\"{}\",", "x".repeat(length)).unwrap();
        left -= length + 3;
    }
    let filled = worker.replacen("\"route_id\":", &format!("\"fill\":[{small}{texts}0],\"route_id\":"), 1);
    assert!(filled.len() <= limits.bytes && filled.len() + 3 >= limits.bytes);
    filled.into_bytes()
}

fn values(value: &Value) -> usize {
    1 + match value {
        Value::Array(list) => list.iter().map(values).sum(),
        Value::Object(object) => object.values().map(values).sum(),
        _ => 0,
    }
}

#[test]
fn the_memory_of_the_largest_checkpoints_does_not_grow_with_the_pairs() {
    for pairs in [1, 4, 16] {
        let slices: Vec<(u32, u32)> = (0..pairs).map(|pair| (pair, pair)).collect();
        let plan = pod(Format::V2, 1, &slices);
        let files: Vec<Vec<u8>> = (0..slices.len()).map(|pair| largest(&plan, pair)).collect();
        let bytes: usize = files.iter().map(Vec::len).sum();
        assert!(bytes <= 48 << 20, "{pairs} pairs may keep {bytes} bytes");
        let read = |pair: usize| read_worker(&plan, pair, &files[pair]).unwrap().unwrap();

        let region = Region::new(COUNTED);
        let mut checkpoints: Vec<Checkpoint> = (0..slices.len()).map(read).collect();
        // Each is written anew, and the last good one stays until the new one is read.
        for (pair, checkpoint) in checkpoints.iter_mut().enumerate() {
            *checkpoint = read(pair);
        }
        let workers: Vec<Option<&Checkpoint>> = checkpoints.iter().map(Some).collect();
        let files = merge(&plan, &workers).and_then(|merged| render(&plan, Some(&merged)));
        let allocated = region.change().bytes_allocated;
        println!(
            "{pairs} pairs, {bytes} bytes: {allocated} bytes allocated, merged: {}",
            files.is_ok()
        );
        assert!(allocated < MOST, "{pairs} pairs: {allocated} bytes");
    }
}

#[test]
fn a_checkpoint_beyond_its_pairs_share_is_refused() {
    let plan = pod(Format::V2, 1, &[(0, 0), (1, 3)]);
    let limits = [0, 1].map(|pair| plan.limits_of(pair));
    assert_eq!(limits.map(|limits| limits.bytes >> 20), [9, 25]);
    assert_eq!(limits.map(|limits| limits.values), [135_000, 385_000]);
    let refusal = |bytes: Vec<u8>| read_worker(&plan, 0, &bytes).unwrap_err();
    let mut large = largest(&plan, 0);
    large.extend([b' '; 8]);
    let many = format!("[{}0]", "0,".repeat(135_000));
    let refusals = [("bytes", refusal(large)), ("values", refusal(many.into_bytes()))];
    assert_refusals("shares", &refusals.map(|(what, refusal)| (what.to_owned(), refusal)));
}
