//! The simulator image's program; `/home/carla/CarlaUE4.sh` execs it.

use std::process::ExitCode;

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    match challenge_stand_in::simulator::run(&arguments) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("CarlaUE4: {error}");
            ExitCode::from(2)
        }
    }
}
