//! One simulator-agent pair: what it does, and what ended its last round.
//!
//! Part of a Submission's status. Pure.

use std::fmt;

use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// What a pair does.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum PairState {
    /// Its agent has not begun.
    #[default]
    Waiting,
    Running,
    Done,
    /// Its agent or its simulator ended too early and is started again.
    Crashed,
    /// A state that this operator does not know, from a Pod of another version.
    #[serde(other)]
    Unknown,
}

/// One simulator-agent pair.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq)]
pub struct PairStatus {
    /// From 1.
    pub id: i32,
    /// Routes done.
    pub done: i32,
    /// Routes of its slice, times repetitions.
    pub total: i32,
    /// Crashes so far.
    pub crashes: i32,
    /// What it does.
    pub state: PairState,
    /// How its last container ended.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub last: Option<Box<LastEnd>>,
    /// How often its containers were ended from outside and started again, which is no crash.
    #[serde(default, rename = "endedFromOutside", skip_serializing_if = "is_zero")]
    pub ended_from_outside: i32,
    /// Its simulator has failed in this attempt: by its own container's word, or by the kubelet's.
    #[serde(default, rename = "simulatorFailed", skip_serializing_if = "std::ops::Not::not")]
    pub simulator_failed: bool,
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde hands out references")]
fn is_zero(number: &i32) -> bool {
    *number == 0
}

/// What ended a round of a pair.
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
    /// The agent's verdict blames a simulator that has not failed.
    BlamesSimulator,
    /// The simulator followed its agent, whose own end is not known.
    Unseen,
    /// Another container of the Pod listened on the simulator's port.
    PortTaken,
    SimulatorCrashed,
    SimulatorNotReady,
    SimulatorSilent,
    /// The kubelet could not start the simulator's container.
    SimulatorNotStarted,
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

/// How a container ended.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq)]
#[serde(rename_all = "camelCase")]
pub struct LastEnd {
    /// What ended it.
    pub reason: EndReason,
    /// Exit code of the process.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub exit_code: Option<i32>,
    /// When.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub time: Option<Time>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_state_of_another_version_is_unknown() {
        assert_eq!(
            serde_json::from_str::<PairState>("\"Running\"").unwrap(),
            PairState::Running
        );
        assert_eq!(
            serde_json::from_str::<PairState>("\"Dreaming\"").unwrap(),
            PairState::Unknown
        );
    }
}
