//! What there is to do about a failure: one text for the challenge's hosts, who can read everything, and one for the
//! participant, who reads EvalAI alone.
//!
//! Called by `failure`, `start` and `end`. Pure. No text for a participant names a file, an object or a machine of the hosts.

use leaderboard_api::reasons;

/// The next step after a participant failure, for each of its two readers.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Steps {
    pub(super) hosts: String,
    pub(super) participant: String,
}

/// Both can do the same.
pub(super) fn for_both(step: &str) -> Steps {
    Steps {
        hosts: step.to_owned(),
        participant: step.to_owned(),
    }
}

/// The log of an agent explains what happened. Only hosts can read it.
pub(super) fn in_the_log_of(agent: i32) -> Steps {
    Steps {
        hosts: of_participant(reasons::AGENT_CRASHED).replace("<n>", &agent.to_string()),
        participant:
            "Reproduce it on routes of your own, fix the agent and submit again; the challenge's hosts have its log."
                .to_owned(),
    }
}

/// An agent needs more memory than there is.
pub(super) fn smaller() -> Steps {
    Steps {
        hosts: of_participant(reasons::OUT_OF_MEMORY),
        participant: "Reduce the memory it uses and submit again; ask the challenge's hosts for the limit.".to_owned(),
    }
}

/// The next step of the table of reasons.
pub(super) fn of_participant(reason: &str) -> String {
    reasons::of(reason).map_or_else(String::new, |reason| reasons::plain(reason.next_step))
}

/// What a host does about a failure of the infrastructure that no retry has ended.
pub(super) fn of_infrastructure(reason: &str) -> &'static str {
    match reason {
        // The text of `workspace` has the step before this one.
        reasons::NOT_ISOLATED => "Then resume the submission.",
        _ => reasons::after_failure(reason).unwrap_or("Fix this, then resume the submission."),
    }
}

/// All that a participant reads of a failure of the infrastructure.
pub(super) fn infrastructure_for_participants(reason: &str) -> String {
    let what = match reason {
        reasons::IMAGE_PULL => "An image could not be pulled.",
        reasons::NODE_LOST => "The machine that ran the submission was lost.",
        reasons::NODE_INTERRUPTED => "The machine that ran the submission was taken away.",
        reasons::RESULTS_NOT_STORED => "The results could not be stored.",
        reasons::SIMULATION_CRASHED => "The simulator crashed.",
        reasons::NO_GPU => "The machine that ran the submission had no GPU for it.",
        reasons::NODE_CANNOT_START => "The machine that was to run the submission could not start it.",
        reasons::DISK_FULL => "The run's disk was full.",
        reasons::GRAPHICS_DRIVER_MISSING => "The machine that ran the submission could not run the simulator.",
        reasons::START_DEADLINE => "The run could not be started in time.",
        reasons::SCHEDULE_DEADLINE => "No machine was free for the submission in time.",
        reasons::JOB_DELETED | reasons::JOB_EXPIRED | reasons::JOB_FAILED => "The cluster ended the run.",
        reasons::PHASE_DIFFERS => "The submission's phase in EvalAI is not the one it was submitted to.",
        reasons::NOT_ISOLATED => "The run could not be isolated from the network.",
        _ => "The run could not be set up.",
    };
    format!("{what} Your agent is not the cause. Ask the challenge's hosts to resume the submission, or submit again.")
}
