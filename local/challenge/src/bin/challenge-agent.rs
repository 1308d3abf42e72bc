//! The agent image's program, installed as `/usr/bin/python3`.

use std::{
    env,
    io::{self, Write as _},
    process::ExitCode,
    time::Duration,
};

use challenge_stand_in::{
    evaluator::{self, Ending, Environment},
    faults,
    flags::{self, Format, Invocation},
    knobs::Knobs,
};

fn main() -> ExitCode {
    let arguments: Vec<String> = env::args().skip(1).collect();
    if env::var_os("CHALLENGE_PRINT_ARGUMENTS").is_some() {
        // A reader of the log that went away is no reason to end.
        let _ = writeln!(io::stdout(), "python3 {}", arguments.join(" "));
    }
    let format = match env::var("CHALLENGE_FORMAT").unwrap_or_default().as_str() {
        "" => None,
        text => match Format::parse(text) {
            None => return refuse(&format!("CHALLENGE_FORMAT={text} is neither V1 nor V2")),
            known => known,
        },
    };
    let invocation = match flags::parse(&arguments, format) {
        Ok(invocation) => invocation,
        Err(error) => return refuse(&format!("leaderboard_evaluator.py: error: {error}")),
    };
    if !invocation.script.is_file() {
        let script = invocation.script.display();
        return refuse(&format!(
            "python3: can't open file '{script}': [Errno 2] No such file or directory"
        ));
    }
    let environment = match environment(&invocation) {
        Ok(environment) => environment,
        Err(error) => return refuse(&error),
    };
    match evaluator::run(&invocation, environment) {
        Ok(Ending::Finished) => ExitCode::SUCCESS,
        Ok(Ending::Stopped) => ExitCode::from(255),
        Err(error) => {
            eprintln!("Traceback (most recent call last):\n{error}");
            // V1 prints what its run raises and ends as if nothing had happened.
            if invocation.format == Format::V1 && error.is_of_the_run() {
                ExitCode::SUCCESS
            } else {
                ExitCode::FAILURE
            }
        }
    }
}

fn environment(invocation: &Invocation) -> Result<Environment, String> {
    let time = env::var("ROUTE_MS").unwrap_or_else(|_| "500".to_owned());
    let route_time = time
        .parse()
        .map_err(|_| format!("ROUTE_MS={time} is not a number of milliseconds"))?;
    let knobs = env::var("AGENT_KNOBS").unwrap_or_default();
    let knobs =
        Knobs::parse(&knobs, faults::KNOBS, invocation.port).map_err(|error| format!("AGENT_KNOBS: {error}"))?;
    let python_path = env::split_paths(&env::var_os("PYTHONPATH").unwrap_or_default()).collect();
    Ok(Environment {
        route_time: Duration::from_millis(route_time),
        route_copy: env::var_os("ROUTE_COPY").map(Into::into),
        knobs,
        python_path,
    })
}

fn refuse(why: &str) -> ExitCode {
    eprintln!("{why}");
    ExitCode::from(2)
}
