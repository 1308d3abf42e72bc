//! `leaderboard-operator results` on four files of 500 records, as a process.

use std::process::Command;
use std::time::Instant;

use leaderboard_results::Format;

use crate::bench::{Bench, Outcome};
use crate::record::Figures;

#[path = "../../../crates/results/tests/common/mod.rs"]
#[allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "shared with tests"
)]
mod common;

use common::{Drive, finished};

const FILES: u32 = 4;
const RECORDS: usize = 500;
const RUNS: usize = 20;
/// Runs that fill the caches of the disk.
const WARM: usize = 2;

pub fn measure(bench: &Bench) -> Outcome<Figures> {
    #[allow(clippy::cast_possible_truncation, reason = "at most 500")]
    let records = bench.count(RECORDS) as u32;
    let folder = tempfile::tempdir()?;
    let mut inputs = Vec::new();
    for file in 0..FILES {
        let drives: Vec<Drive> = (file * records..(file + 1) * records).map(Drive::perfect).collect();
        let path = folder.path().join(format!("agent{file}.json"));
        std::fs::write(&path, serde_json::to_vec_pretty(&finished(Format::V2, &drives))?)?;
        inputs.push(path);
    }
    let mut figures = Figures::default();
    for run in 0..WARM + bench.pairs(RUNS).max(5) {
        let began = Instant::now();
        let done = Command::new(&bench.operator)
            .args(["results", "--format", "v2", "--out"])
            .arg(folder.path().join("out"))
            .args(&inputs)
            .output()?;
        let millis = began.elapsed().as_secs_f64() * 1e3;
        if !done.status.success() {
            return Err(String::from_utf8_lossy(&done.stderr).into_owned().into());
        }
        if run >= WARM {
            figures.add("results, ms", millis);
        }
    }
    figures.note(format!("{FILES} files of {records} records"));
    Ok(figures)
}
