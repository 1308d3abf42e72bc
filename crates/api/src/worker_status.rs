//! One worker of a run: what it does, and what ended its last round.
//!
//! Part of a Submission's status. Pure.

use std::fmt;

use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// State of a worker.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum WorkerState {
    /// Its agent has not begun.
    #[default]
    Waiting,
    Running,
    Done,
    /// Its agent or its environment ended too early and is started again.
    Crashed,
    /// A state that this operator does not know, from a Pod of another version.
    #[serde(other)]
    Unknown,
}

/// One worker: an agent with the environment that it acts in.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq)]
#[serde(rename_all = "camelCase")]
pub struct WorkerStatus {
    /// Id is the worker's number, from 1.
    pub id: i32,
    /// Done counts the units that the worker has done.
    pub done: i32,
    /// Total counts the worker's units.
    pub total: i32,
    /// Number of crashes of the worker so far.
    pub crashes: i32,
    /// State shows what the worker does.
    pub state: WorkerState,
    /// Last shows how the worker's last container ended.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub last: Option<Box<LastEnd>>,
    /// Number of times that the worker's containers were ended from outside and started again, which is no crash.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub ended_from_outside: i32,
    /// EnvironmentFailed is true if the worker's environment has failed in this attempt, by its own container's word or by the kubelet's.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub environment_failed: bool,
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde hands out references")]
fn is_zero(number: &i32) -> bool {
    *number == 0
}

/// Cause that ended a round of a worker.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Copy, Debug, PartialEq, Eq)]
pub enum EndReason {
    /// The agent's command ended by itself.
    Exited,
    Killed,
    /// The agent's runner was killed, too.
    SilentDeath,
    /// The agent's command ended well, without complete results.
    Incomplete,
    /// The agent printed nothing for too long.
    Idle,
    OutOfMemory,
    /// The agent's command is missing in the image or not for this machine.
    CannotStart,
    /// The kubelet could not start the agent's container, because of its image.
    StartError,
    /// The kubelet could not start the agent's container, because of the node.
    NodeCannotStart,
    /// The agents left no process in the Pod to start the agent or the simulator again.
    NoProcess,
    /// Agent and simulator were ended from outside: their sandbox was made anew, or their node started again. It is no crash.
    EndedFromOutside,
    /// The agent's verdict blames a simulator or an evaluator that has not failed.
    BlamesHost,
    /// The simulator followed its agent, whose own end is not known.
    Unseen,
    /// Another container of the Pod listened on the simulator's port.
    PortTaken,
    SimulatorCrashed,
    SimulatorNotReady,
    SimulatorSilent,
    /// The kubelet could not start the simulator's container.
    SimulatorNotStarted,
    /// The evaluator ended without a final result.
    EvaluatorCrashed,
    /// The evaluator did not listen on its port in time, or had no final result in time.
    EvaluatorNotReady,
    /// The kubelet could not start the evaluator's container.
    EvaluatorNotStarted,
    /// The simulator was to have a GPU and saw none.
    NoGPU,
    /// The simulator's node has no driver for what it draws with.
    GraphicsDriverMissing,
    /// An end that this operator does not know, of another version.
    #[serde(other)]
    Unknown,
}

impl fmt::Display for EndReason {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "{self:?}")
    }
}

/// End of a container.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq)]
#[serde(rename_all = "camelCase")]
pub struct LastEnd {
    /// Reason names the cause of the end.
    pub reason: EndReason,
    /// ExitCode is the exit code of the container's process.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub exit_code: Option<i32>,
    /// Time is when the container ended.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub time: Option<Time>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_state_of_another_version_is_unknown() {
        assert_eq!(
            serde_json::from_str::<WorkerState>("\"Running\"").unwrap(),
            WorkerState::Running
        );
        assert_eq!(
            serde_json::from_str::<WorkerState>("\"Dreaming\"").unwrap(),
            WorkerState::Unknown
        );
    }
}
