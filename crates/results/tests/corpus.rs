//! The fuzzer's corpus, run through the fuzzer's own checks.
#![allow(clippy::unwrap_used, reason = "the helpers of a test may fail it")]

#[path = "../fuzz/checks.rs"]
mod checks;
mod common;

use std::fs;
use std::path::Path;

use checks::Seen;

/// The corpus stays small, so that replaying it stays quick.
const MOST_FILES: usize = 600;
const MOST_BYTES: usize = 1_500_000;

fn inputs(target: &str) -> Vec<(String, Vec<u8>)> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/corpus").join(target);
    let mut inputs: Vec<(String, Vec<u8>)> = fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .map(|path| (path.display().to_string(), fs::read(path).unwrap()))
        .collect();
    inputs.sort();
    inputs
}

/// Runs all inputs of a target; a failure is preceded by the name of its input.
fn replay(target: &str, check: fn(&[u8]) -> Seen) -> usize {
    let (mut taken, mut refused, mut is_final) = (0, 0, 0);
    let inputs = inputs(target);
    for (name, bytes) in &inputs {
        let seen = std::panic::catch_unwind(|| check(bytes));
        assert!(seen.is_ok(), "{name} fails");
        let seen = seen.unwrap();
        taken += usize::from(seen.taken);
        refused += usize::from(seen.refused);
        is_final += usize::from(seen.is_final);
    }
    common::say(&format!(
        "corpus: {} inputs of {target} replayed; {taken} taken, {is_final} of them final, {refused} refused, some both",
        inputs.len()
    ));
    assert!(
        is_final > 10 && taken > 20 && refused > 20,
        "the corpus has lost what it is for"
    );
    inputs.len()
}

#[test]
fn the_corpus_holds() {
    let files = replay("checkpoint", checks::checkpoint) + replay("merge", checks::merge);
    let size: usize = ["checkpoint", "merge"]
        .into_iter()
        .flat_map(inputs)
        .map(|(_, bytes)| bytes.len())
        .sum();
    assert!(files <= MOST_FILES && size <= MOST_BYTES, "{files} files, {size} bytes");
}
