//! What there is to do about a failure: one text for the challenge's hosts, who can read everything, and one for the
//! participant, who reads EvalAI alone.
//!
//! Called by `failure`, `start` and `end`. Pure. No text for a participant names a file, an object or a machine of the hosts.

use leaderboard_api::reasons;

/// The next step after a participant failure, for each of its two readers.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Steps {
    pub(super) hosts: String,
    pub(super) participant: &'static str,
}

/// Both can do the same.
pub(super) fn for_both(step: &'static str) -> Steps {
    Steps {
        hosts: step.to_owned(),
        participant: step,
    }
}

/// The log of an agent explains what happened. Only hosts can read it.
pub(super) fn in_the_log_of(agent: i32) -> Steps {
    Steps {
        hosts: format!(
            "Look at agent/agent{agent}/leaderboard.log of the results; the participant fixes the agent and submits again."
        ),
        participant: "Reproduce it on routes of your own, fix the agent and submit again; the challenge's hosts have its log.",
    }
}

/// An agent needs more memory than there is.
pub(super) fn smaller() -> Steps {
    Steps {
        hosts: "The participant reduces the agent's memory use; its limit is agent.resources of the Leaderboard."
            .to_owned(),
        participant: "Reduce the memory it uses and submit again; ask the challenge's hosts for the limit.",
    }
}

/// What a host does about a failure of the infrastructure that no retry has ended.
pub(super) fn of_infrastructure(reason: &str) -> &'static str {
    match reason {
        // The words of `workspace` hold it already.
        reasons::PREFIX_IN_USE => "",
        reasons::NOT_ISOLATED => "Then resume it.",
        reasons::JOB_DELETED => "Find out who deletes Jobs in this namespace, then resume it.",
        reasons::NODE_LOST => "Look at the node, then resume it.",
        reasons::RESULTS_NOT_STORED => "Look at the log of logcopy and at the bucket, then resume it.",
        reasons::SIMULATION_CRASHED => {
            "Look at the simulator's log, then resume it, which repeats the route it was at."
        }
        reasons::JOB_FAILED => "Look at the Job's events, then resume it.",
        reasons::PHASE_DIFFERS => {
            "Set the phase back in EvalAI, then resume it; if the Submission has the wrong phase, apply it anew."
        }
        reasons::SCHEDULE_DEADLINE => "Add a node or make room, then resume it.",
        _ => "Fix that, then resume it.",
    }
}

/// All that a participant reads of a failure of the infrastructure.
pub(super) fn infrastructure_for_participants(reason: &str) -> String {
    let what = match reason {
        reasons::IMAGE_PULL => "An image could not be pulled.",
        reasons::NODE_LOST => "The machine that ran the submission was lost.",
        reasons::RESULTS_NOT_STORED => "The results could not be stored.",
        reasons::SIMULATION_CRASHED => "The simulator crashed.",
        reasons::START_DEADLINE => "The run could not be started in time.",
        reasons::SCHEDULE_DEADLINE => "No machine was free for the submission in time.",
        reasons::JOB_DELETED | reasons::JOB_FAILED => "The cluster ended the run.",
        reasons::PHASE_DIFFERS => "The submission's phase in EvalAI is not the one it was submitted to.",
        reasons::NOT_ISOLATED => "The run could not be isolated from the network.",
        reasons::PREFIX_IN_USE => "The place for the results is in use.",
        _ => "The run could not be set up.",
    };
    format!("{what} Your agent is not the cause. Ask the challenge's hosts to resume the submission, or submit again.")
}
