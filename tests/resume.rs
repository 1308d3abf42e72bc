//! A submission of 20 routes on 4 pairs as plain processes, killed in every part at every moment. The final score is always that of an
//! undisturbed run. The programs are the real ones (runner, workspace, logcopy), with stand-ins for simulator and agent. The test plays
//! the kubelet, and S3 is a stand-in.
//!
//! `LEADERBOARD_KILL_RUNS` sets how many runs, `LEADERBOARD_TEST_SEED` repeats one that failed.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "clippy knows a test by its attribute; what tests call is a test too"
)]

#[path = "support/files.rs"]
mod files;
#[allow(dead_code, reason = "each test program uses its own part of it")]
#[path = "support/ministack.rs"]
mod ministack;

mod resume {
    mod driven;
    mod kills;
    mod kubelet;
    mod largest;
    mod late;
    mod measure;
    mod process;
    mod restarted;
    mod results;
    mod singles;
    mod submission;
    mod volumes;
}
