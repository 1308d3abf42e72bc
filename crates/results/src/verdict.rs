//! How a run ended, and whether its results count. Called by the merge once it knows whether anything is missing; knows
//! statuses and sensors, no numbers.

use crate::checkpoint::Record;
use crate::json::Text;
use crate::names::{CRASHED, FINISHED, INVALID, REJECTED, SENSORS_INVALID, STARTED};
use crate::{Checkpoint, Format, Plan};

/// How a run ended, whatever the format calls it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Outcome {
    /// Routes are missing.
    Running,
    /// All routes were driven and count.
    Finished,
    /// A simulator crashed; the results do not count.
    Crashed,
    /// The agent asked for sensors it may not have; the results do not count.
    Rejected,
    /// The results contradict themselves; they do not count.
    Invalid,
}

impl Outcome {
    /// Why the results do not count, as one sentence; `None` when they do or may still.
    pub fn why_not(self) -> Option<&'static str> {
        match self {
            Self::Running | Self::Finished => None,
            Self::Crashed => Some("The simulation crashed in at least one route."),
            Self::Rejected => Some("The agent's sensors were invalid."),
            Self::Invalid => Some("The results name no sensors, or hold a route that was never finished."),
        }
    }
}

/// The outcome of the whole run, and what the merged file has of it.
pub(crate) struct Ending {
    pub(crate) entry_status: &'static str,
    pub(crate) eligible: bool,
    /// The original calls every file without sensors invalid, whatever its workers had.
    pub(crate) outcome: Outcome,
}

impl Ending {
    pub(crate) fn of(
        plan: &Plan,
        workers: &[Option<&Checkpoint>],
        (sorted, sensors): (&[&Record], &[Text]),
        is_final: bool,
    ) -> Self {
        let (entry_status, outcome) = match plan.format {
            _ if !is_final => (STARTED, Outcome::Running),
            Format::V1 => v1(sorted, plan.as_original),
            Format::V2 => v2(sorted),
        };
        if is_final && plan.format == Format::V2 && sensors.is_empty() {
            let has_named = |worker: &&Checkpoint| worker.counts_without_sensors();
            let counts = !plan.as_original && workers.iter().flatten().all(has_named);
            return Self {
                entry_status: INVALID,
                eligible: false,
                outcome: if counts { outcome } else { Outcome::Invalid },
            };
        }
        Self {
            entry_status,
            eligible: outcome == Outcome::Finished,
            outcome,
        }
    }
}

/// The original lets results count although a simulator crashed or the sensors were invalid; its evaluator does not, but
/// its merge forgets it.
fn v1(sorted: &[&Record], as_original: bool) -> (&'static str, Outcome) {
    let has_agent_errors = sorted.iter().any(|record| record.status.contains("Agent"));
    let entry_status = if has_agent_errors {
        "Finished with agent errors"
    } else {
        FINISHED
    };
    let told = telling(sorted).filter(|_| !as_original);
    (entry_status, told.map_or(Outcome::Finished, |(_, outcome)| outcome))
}

fn v2(sorted: &[&Record]) -> (&'static str, Outcome) {
    if sorted.iter().any(|record| record.status == STARTED) {
        return (INVALID, Outcome::Invalid);
    }
    telling(sorted).unwrap_or((FINISHED, Outcome::Finished))
}

/// The last route whose status names a crash or wrong sensors decides, as in the original.
fn telling(sorted: &[&Record]) -> Option<(&'static str, Outcome)> {
    sorted.iter().rev().find_map(|record| {
        if record.names_crash() {
            return Some((CRASHED, Outcome::Crashed));
        }
        let is_rejected = record.status.contains(SENSORS_INVALID);
        is_rejected.then_some((REJECTED, Outcome::Rejected))
    })
}
