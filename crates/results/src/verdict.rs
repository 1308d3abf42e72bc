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
        if !is_final {
            return Self {
                entry_status: STARTED,
                eligible: false,
                outcome: Outcome::Running,
            };
        }
        match plan.format {
            Format::V1 => Self::v1(sorted, plan.as_original),
            Format::V2 if sensors.is_empty() => {
                let has_named = |worker: &&Checkpoint| worker.counts_without_sensors();
                let counts = !plan.as_original && workers.iter().flatten().all(has_named);
                Self {
                    entry_status: INVALID,
                    eligible: false,
                    outcome: if counts {
                        Self::v2(sorted).outcome
                    } else {
                        Outcome::Invalid
                    },
                }
            }
            Format::V2 => Self::v2(sorted),
        }
    }

    /// The original lets results count although a simulator crashed or the sensors were invalid; its evaluator does not, but
    /// its merge forgets it.
    fn v1(sorted: &[&Record], as_original: bool) -> Self {
        let has_agent_errors = sorted.iter().any(|record| record.status.contains("Agent"));
        let told = telling(sorted).filter(|_| !as_original);
        let outcome = told.unwrap_or(Outcome::Finished);
        Self {
            entry_status: if has_agent_errors {
                "Finished with agent errors"
            } else {
                FINISHED
            },
            eligible: outcome == Outcome::Finished,
            outcome,
        }
    }

    fn v2(sorted: &[&Record]) -> Self {
        let is_invalid = sorted.iter().any(|record| record.status == STARTED);
        let outcome = if is_invalid {
            Outcome::Invalid
        } else {
            telling(sorted).unwrap_or(Outcome::Finished)
        };
        let entry_status = match outcome {
            Outcome::Invalid => INVALID,
            Outcome::Crashed => CRASHED,
            Outcome::Rejected => REJECTED,
            Outcome::Running | Outcome::Finished => FINISHED,
        };
        Self {
            entry_status,
            eligible: outcome == Outcome::Finished,
            outcome,
        }
    }
}

/// The last route whose status names a crash or wrong sensors decides, as in the original.
fn telling(sorted: &[&Record]) -> Option<Outcome> {
    sorted.iter().rev().find_map(|record| {
        if record.names_crash() {
            Some(Outcome::Crashed)
        } else {
            record.status.contains(SENSORS_INVALID).then_some(Outcome::Rejected)
        }
    })
}
