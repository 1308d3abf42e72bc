//! The program of the probe images, installed as `/usr/bin/python3`. It tries every attack of the table, or the one ending that
//! `PROBE_ENDING` names, and becomes an honest agent.

use std::env;
use std::io::{self, Write as _};
use std::process::{Command, ExitCode};

use challenge_probe::endings::VARIABLE;
use challenge_probe::seen::{self, Seen};
use challenge_probe::{modes, table};

/// `EX_SOFTWARE`: the attack could not be carried out.
const CODE_BROKEN: u8 = 70;

fn main() -> ExitCode {
    let arguments: Vec<String> = env::args().skip(1).collect();
    let done = match arguments.first().map(String::as_str) {
        Some("--probe") => one(arguments.get(1).map_or("", String::as_str)),
        Some("--background") => modes::background_work(arguments.get(1).map_or("", String::as_str)),
        _ => agent(&arguments),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("challenge-probe: {error}");
            ExitCode::from(CODE_BROKEN)
        }
    }
}

fn agent(arguments: &[String]) -> io::Result<()> {
    match env::var(VARIABLE).ok().filter(|id| !id.is_empty()) {
        Some(id) => modes::run(&id, arguments)?,
        None => all()?,
    }
    modes::honest(arguments, "").map(|never| match never {})
}

/// Each in a process of its own: one that gets through may change what the next one finds.
fn all() -> io::Result<()> {
    for probe in table::probes() {
        let run = Command::new("/proc/self/exe").args(["--probe", probe.id]).status()?;
        if !run.success() {
            print(probe.id, &Seen::Unclear(format!("the probe ended with {run}")))?;
        }
    }
    Ok(())
}

fn one(id: &str) -> io::Result<()> {
    let Some(probe) = table::probes().find(|probe| probe.id == id) else {
        return Err(io::Error::other(format!("there is no probe {id}")));
    };
    print(id, &(probe.run)())
}

fn print(id: &str, seen: &Seen) -> io::Result<()> {
    writeln!(io::stdout(), "{}", seen::line(id, seen))
}
