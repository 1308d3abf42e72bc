//! `leaderboard-runner`: PID 1 of every simulator, evaluator and agent container, and of the host's contents and data. Parses its arguments and lives one life (`run`).
//!
//! It runs inside any image: no shell, any uid, a read-only root. It has one thread and no heap growth with the output.

mod checkpoint;
mod copy;
mod decide;
mod group;
mod keep;
mod keep_output;
mod kernel;
mod launch;
mod left_files;
mod memory;
mod own_folder;
mod report;
mod result;
mod run;
mod server;
mod tee;
mod wake;

use std::fmt;
use std::io::{self, Write};
use std::process::ExitCode;

use nix::sys::prctl;
use nix::sys::resource::{Resource, getrlimit, setrlimit};
use nix::sys::stat::{Mode, umask};

use crate::run::Runner;
use crate::wake::Signals;
use leaderboard_protocol::verdict::CODE_NODE_REFUSED;
use leaderboard_runner::args::{self, Request};

/// Wrong arguments (EX_USAGE).
const CODE_USAGE: u8 = 64;
/// Bytes of a core dump, which is none. Not 0: the kernel then still starts a program that the node's core_pattern names.
const CORE_BYTES: u64 = 1;

fn main() -> ExitCode {
    match args::parse(std::env::args_os().skip(1)) {
        Ok(Request::Run(job)) => run(|signals| Runner::new(*job, signals).run()),
        Ok(Request::Keep(kept)) => run(|signals| keep_output::run(kept, signals)),
        Ok(Request::Copy(copied)) => run(|signals| copy::run(&copied, signals)),
        Ok(Request::Version) => print(concat!("leaderboard-runner ", env!("CARGO_PKG_VERSION"), "\n")),
        Ok(Request::Help) => print(args::USAGE),
        Err(error) => {
            say(format_args!("{error}\n{}", args::USAGE.trim_end()));
            ExitCode::from(CODE_USAGE)
        }
    }
}

fn run(live: impl FnOnce(Signals) -> i32) -> ExitCode {
    let signals = match Signals::open() {
        Ok(signals) => signals,
        Err(error) => {
            say(format_args!("signals cannot be handled: {error}"));
            return code(CODE_NODE_REFUSED);
        }
    };
    umask(Mode::from_bits_truncate(0o022));
    // The command has the same uid: without this it could read and change the runner's memory.
    for (what, result) in [
        ("dumpable", prctl::set_dumpable(false)),
        ("subreaper", prctl::set_child_subreaper(true)),
        // A crash of CARLA's would put gigabytes onto the node, where no limit of the Pod counts them.
        ("core limit", limit_core()),
    ] {
        if let Err(error) = result {
            say(format_args!("{what}: {error}"));
        }
    }
    code(live(signals))
}

fn code(number: i32) -> ExitCode {
    ExitCode::from(u8::try_from(number).unwrap_or(1))
}

fn limit_core() -> nix::Result<()> {
    let (_, hard) = getrlimit(Resource::RLIMIT_CORE)?;
    let most = hard.min(CORE_BYTES);
    setrlimit(Resource::RLIMIT_CORE, most, most)
}

fn print(text: &str) -> ExitCode {
    match io::stdout().write_all(text.as_bytes()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(_) => ExitCode::FAILURE,
    }
}

/// One line on stderr. Standard output is the command's.
pub(crate) fn say(text: fmt::Arguments<'_>) {
    // Without stderr there is no place to report to.
    let _ = writeln!(io::stderr(), "leaderboard-runner: {text}");
}
