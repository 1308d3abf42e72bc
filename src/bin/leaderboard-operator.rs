//! The operator's program: see `leaderboard-operator --help`.

use std::process::ExitCode;

fn main() -> ExitCode {
    leaderboard_operator::cli::run()
}
