//! The kubectl plugin: see `kubectl leaderboard --help`.

use std::process::ExitCode;

fn main() -> ExitCode {
    leaderboard_operator::plugin::run()
}
