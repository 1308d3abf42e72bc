//! Up to four files merged and rendered, in both formats, at both strictnesses, with and without a plan.
#![no_main]

use libfuzzer_sys::{fuzz_mutator, fuzz_target};

#[path = "../checks.rs"]
#[allow(dead_code, reason = "each target has its part of it")]
mod checks;
#[path = "../mutate.rs"]
mod mutate;

fuzz_target!(|data: &[u8]| {
    checks::merge(data);
});

fuzz_mutator!(|data: &mut [u8], size: usize, max_size: usize, seed: u32| {
    mutate::mutate(data, size, max_size, seed)
});
