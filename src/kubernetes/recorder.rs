//! Writers of events.

use kube::Client;
use kube::runtime::events::{Recorder, Reporter};
use leaderboard_api::GROUP;

/// A writer of a program's events. It keeps what it has written for six minutes, to count repetitions, and walks all of it at each
/// further event.
pub fn recorder(client: &Client, program: &str) -> Recorder {
    let reporter = Reporter {
        controller: format!("{GROUP}/{program}"),
        instance: std::env::var("POD_NAME").ok(),
    };
    Recorder::new(client.clone(), reporter)
}
