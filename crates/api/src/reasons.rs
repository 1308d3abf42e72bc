//! Every reason that a status, a condition or an event can have: its name, its class, what it means, and the next step.
//!
//! One table. `docs/states.md` is generated from it (`make docs`), `kubectl leaderboard why` prints it, and the messages of
//! failures take their next step from it. The texts are Markdown with code spans only; [`plain`] removes them. Pure.

/// What kind of thing a reason explains. Each class is one table of docs/states.md.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Class {
    /// Why a submission is Pending.
    Pending,
    /// A submission that runs.
    Running,
    /// An end that is no failure.
    End,
    /// A failure that counts as an attempt.
    Participant,
    /// A failure that does not count as an attempt.
    Infrastructure,
    /// The conditions `Archived`, `Published` and `Recorded`.
    System,
    /// The condition `Plausible`.
    Scores,
    /// An event, and no state or condition.
    Event,
    /// The conditions `Ready` and `Terminating` of a Leaderboard.
    Leaderboard,
    /// The condition `Isolated` of a Leaderboard.
    Isolation,
}

/// One reason.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Reason {
    /// As it stands in `reason`.
    pub name: &'static str,
    /// What kind of thing it explains.
    pub class: Class,
    /// What it means, in sentences.
    pub meaning: &'static str,
    /// What to do next, in sentences.
    pub next_step: &'static str,
    /// What a host does once a submission has failed for this reason, where that is another step.
    pub after_failure: Option<&'static str>,
    /// Whose log explains a failure for this reason, if one does; `<n>` is the number of the pair.
    pub log: Option<&'static str>,
}

/// The reason of this name.
pub fn of(name: &str) -> Option<&'static Reason> {
    ALL.iter().find(|reason| reason.name == name)
}

/// What a host does once a submission has failed for this reason.
pub fn after_failure(name: &str) -> Option<&'static str> {
    of(name).map(|reason| reason.after_failure.unwrap_or(reason.next_step))
}

/// A text of the table without its code spans.
pub fn plain(text: &str) -> String {
    text.replace('`', "")
}

/// Makes a constant of each name, and the table of all: a reason cannot be in one of them only.
macro_rules! reasons {
    ($($class:ident { $($constant:ident = $name:literal, $meaning:literal, $next:literal
        $(, after_failure: $after:literal)? $(, log: $log:literal)?;)* })*) => {
        $($(
            #[doc = $meaning]
            pub const $constant: &str = $name;
        )*)*
        /// All reasons, in the order of docs/states.md.
        pub const ALL: &[Reason] = &[$($(
            Reason {
                name: $name,
                class: Class::$class,
                meaning: $meaning,
                next_step: $next,
                after_failure: optional!($($after)?),
                log: optional!($($log)?),
            },
        )*)*];
    };
}

macro_rules! optional {
    () => {
        None
    };
    ($value:literal) => {
        Some($value)
    };
}

reasons! {
    Pending {
        ASKING_EVALAI = "AskingEvalAI",
            "The operator is asking EvalAI whether the submission should still run.",
            "Nothing. If it lasts, the message has EvalAI's last error: check the token and EvalAI.";
        LEADERBOARD_NOT_FOUND = "LeaderboardNotFound",
            "The namespace has no Leaderboard of that name. Running submissions continue without it; new ones do not start.",
            "Apply the Leaderboard; the submission then continues.";
        LEADERBOARD_NOT_READY = "LeaderboardNotReady",
            "The Leaderboard has a fault, and no Job can or may be created for it.",
            "Fix what the Leaderboard's condition `Ready` reports.";
        TRACK_NOT_FOUND = "TrackNotFound",
            "The Leaderboard has no track of that name or phase.",
            "Add the track, or cancel the submission.";
        IMAGE_MISSING = "ImageMissing",
            "The Submission names no image, and the file in EvalAI that names it could not be read yet. The operator retries.",
            "Check that EvalAI serves the submission's input file, or set `spec.image`. If it lasts, ask the participant to push \
             again, and cancel this submission.";
        PHASE_DIFFERS = "PhaseDiffers",
            "EvalAI's row belongs to another phase than the Submission: one of the two was edited, or the Submission was applied \
             with the wrong phase. It does not run, and for an hour nothing is reported to EvalAI; then it fails (which does not \
             count as an attempt), so that the participant sees an end in EvalAI.",
            "Set the phase back in EvalAI: within the hour the submission continues without further action; after it has failed, \
             resume it. If the Submission has the wrong phase, delete it within the hour and apply it with the right one.",
            after_failure: "Set the phase back in EvalAI, then resume the submission. If the Submission has the wrong phase, \
             delete it and apply it with the right one.";
        WAITING_FOR_SLOT = "WaitingForSlot",
            "All slots that `concurrency.total` and `concurrency.perTeam` allow are in use. `status.waiting` has the position in the line \
             and an estimate.",
            "Wait, or raise the limits.";
        PAUSED = "Paused",
            "The Leaderboard is paused: nothing new starts.",
            "Set `paused: false`.";
        JOB_NAME_TAKEN = "JobNameTaken",
            "A Job of an older Submission of the same name is still being deleted.",
            "Nothing. If the Job stays, delete it.";
        PREPARING = "Preparing",
            "The Job is created; its Pod is being scheduled, pulls images, copies the contents or fills the workspace. After 45 s \
             the message names the step.",
            "Nothing. If it lasts, check the node that the message names.";
        UNSCHEDULABLE = "Unschedulable",
            "No node has accepted the Pod for 5 s or longer. The message is the scheduler's.",
            "Add a node, or lower the requests. Without `deadlines.scheduleSeconds` the submission waits without a limit.";
        QUOTA_EXCEEDED = "QuotaExceeded",
            "The namespace's quota does not allow the Pod.",
            "Raise the quota, or wait until other Pods end.";
        POD_REFUSED = "PodRefused",
            "The API server refuses the Pod: a LimitRange, Pod Security, or a webhook.",
            "Fix what the message names, in the Leaderboard or in the namespace.";
        IMAGE_PULL = "ImagePull",
            "An image cannot be pulled. The submission fails after `deadlines.startSeconds`: as a participant failure if it is the \
             agent's image and the registry answers, else as an infrastructure failure.",
            "The participant pushes the image again for linux/amd64. For the host's images and the registry: fix the name, the \
             rights or the network.",
            after_failure: "Fix this, then resume the submission.";
        CONTAINER_CONFIG = "ContainerConfig",
            "A container cannot be set up: a Secret or a key is missing, or the image's user is not allowed.",
            "Create what the message names.",
            after_failure: "Fix this, then resume the submission.";
        NOT_ISOLATED = "NotIsolated",
            "The NetworkPolicy of the Leaderboard is not in place, and no Job is created without it. As a failure: \
             `network.enforcement` is `Require`, and the Pod could reach what the policy forbids, or could not measure it.",
            "Nothing for a moment after the Leaderboard was applied or edited. If it lasts, do what the condition `Isolated` of the \
             Leaderboard reports.",
            after_failure: "Do what the message asks, then resume the submission.";
    }
    Running {
        ACCEPTED = "Accepted",
            "Leaderboard, track and image are known, and the plan is pinned (condition `Accepted`).",
            "Nothing.";
        RUNNING = "Running",
            "The agents of the first attempt are running.",
            "Nothing.";
        RESUMED = "Resumed",
            "The agents are running and continue from the stored results.",
            "Nothing.";
        REPLACING = "Replacing",
            "The Pod or the Job was lost, and a new one continues from the stored results; or the operator retries after an \
             infrastructure failure.",
            "Nothing. The message names what was lost.";
        STOPPING = "Stopping",
            "The submission is being stopped; completed routes are kept.",
            "Nothing. It ends within about three minutes after `deadlines.cancelSeconds`; later while the bucket cannot be read.";
        NOT_STALLED = "NotStalled",
            "The submission is not held up (condition `Stalled`).",
            "Nothing.";
    }
    End {
        FINISHED = "Finished",
            "All routes are done, and the results count.",
            "Nothing.";
        CANCELLED = "Cancelled",
            "A person cancelled it; completed routes are kept.",
            "To continue it, resume it: a patch to a higher `attempt` with `cancel: false`.";
        ENDED_IN_EVALAI = "EndedInEvalAI",
            "It ended in EvalAI: cancelled, archived, deleted, or set to an end by hand. (`finished` counts only before the run was \
             under way: participants can write it, and the operator's own result later replaces it.) The operator then writes \
             nothing to EvalAI, with one exception: for a Submission deleted before its end it writes `cancelled`, because EvalAI \
             would otherwise count it as in progress permanently.",
            "To run it after all: resume it in EvalAI if EvalAI shows `failed`, else re-run it there. A submission deleted in \
             EvalAI cannot continue; the participant submits again.";
        DELETED = "Deleted",
            "The Submission was deleted.",
            "Nothing. To continue from the stored results, apply it again with a higher attempt.";
    }
    Participant {
        AGENT_CRASHED = "AgentCrashed",
            "An agent crashed more often than `retries.perPair` allows.",
            "Look at `agent/agent<n>/leaderboard.log` of the results; the participant fixes the agent and submits again.",
            log: "the log of agent `<n>`, `agent/agent<n>/leaderboard.log`";
        OUT_OF_MEMORY = "OutOfMemory",
            "An agent crashed more often than `retries.perPair` allows, the last time because it ran out of memory.",
            "The participant reduces the agent's memory use; its limit is `agent.resources` of the Leaderboard.",
            log: "the log of agent `<n>`, `agent/agent<n>/leaderboard.log`";
        IDLE = "Idle",
            "An agent ended early more often than `retries.perPair` allows, the last time because it printed nothing for \
             `deadlines.idleSeconds`.",
            "Look at `agent/agent<n>/leaderboard.log` of the results; the participant fixes the agent and submits again.",
            log: "the log of agent `<n>`, `agent/agent<n>/leaderboard.log`";
        CANNOT_START = "CannotStart",
            "The agent's command is missing in the image or is not for this machine. For a simulator: an infrastructure failure.",
            "Rebuild the image for linux/amd64.",
            after_failure: "Fix this, then resume the submission.",
            log: "the log of agent `<n>`, `agent/agent<n>/leaderboard.log`";
        TIME_LIMIT = "TimeLimit",
            "The run took longer than `deadlines.runSeconds`. Completed routes are kept.",
            "Make the agent faster, or ask the host for more time.",
            log: "the log of the agent of the first pair that was not done, else of the first pair";
        INVALID_RESULTS = "InvalidResults",
            "A checkpoint was refused: malformed, implausible, or incomplete at the end.",
            "Check what the agent writes into its checkpoint, and submit again.",
            log: "the log of the agent whose checkpoint was refused";
        NOT_ELIGIBLE = "NotEligible",
            "The run is complete, but its results do not count (`Rejected`, `Invalid`).",
            "Compare the agent's sensors with those the track allows, and submit again.",
            log: "the log of the agent of the first pair that was not done, else of the first pair";
        IMAGE_INVALID = "ImageInvalid",
            "The submitted image is not a valid image reference: empty, no text, upper-case letters in the repository, or white \
             space. The submission fails at once, usually before a Job is created; where only the kubelet refuses the name, with \
             the first Pod.",
            "Submit again with an image such as registry.example/team/agent:1.";
        DISK_FULL = "DiskFull",
            "The Pod was evicted because the agent filled its disk.",
            "Write less to disk or to the log.",
            log: "the log of the agent of the first pair that was not done, else of the first pair";
    }
    Infrastructure {
        SIMULATION_CRASHED = "SimulationCrashed",
            "A simulator crashed, or was not ready, more often than `retries.perPair` allows; or a route ended as crashed.",
            "Look at the simulator's log, then resume the submission; it repeats the route it was at.",
            log: "the log of simulator `<n>`, read from its node before the Pod ends; else `simulator/console-<n>.log`";
        RESULTS_NOT_STORED = "ResultsNotStored",
            "The Pod ended before its final results were stored.",
            "Look at the log of logcopy and at the bucket, then resume the submission.",
            log: "the log of `logcopy`";
        NODE_LOST = "NodeLost",
            "The node went silent or was removed with the Pod, or did not end the Pod within its grace period.",
            "Look at the node, then resume the submission.";
        START_DEADLINE = "StartDeadline",
            "No agent started within `deadlines.startSeconds` after the Pod was scheduled.",
            "Fix this, then resume the submission.",
            log: "the log of `contents`, `workspace` or `logcopy`, whichever fails, read from its node before the Job is deleted";
        SCHEDULE_DEADLINE = "ScheduleDeadline",
            "No node accepted the Pod within `deadlines.scheduleSeconds`. There is no retry.",
            "Add a node or free one, then resume the submission.";
        JOB_DELETED = "JobDeleted",
            "Somebody deleted the Job four times between two retries. There is no further retry.",
            "Find out who deletes Jobs in this namespace, then resume the submission.";
        JOB_EXPIRED = "JobExpired",
            "The Job ended while the operator was away, or the bucket could not be read, for longer than the Job is kept (at least 7 \
             days): Kubernetes removed it before its end was read. There is no further Job.",
            "Look at the stored results and logs, then resume the submission.";
        JOB_FAILED = "JobFailed",
            "Kubernetes ended the Job for a reason that no container explains.",
            "Look at the Job's events, then resume the submission.",
            log: "the log of `logcopy`";
        PREFIX_IN_USE = "PrefixInUse",
            "The run's folder in the bucket holds another Submission's results. There is no retry.",
            "Apply the Submission with `attempt: 2` to continue from these results, or empty the prefix.";
    }
    System {
        STORED = "Stored",
            "The final results are in S3.",
            "Nothing.";
        NOT_STORED = "NotStored",
            "No final results are in S3. For a live submission: they cannot be read at the moment.",
            "Nothing while the submission is live: the operator waits for the bucket for up to a day (after a cancel: for \
             `deadlines.cancelSeconds`, at least 60 s).";
        PUBLISHED = "Published",
            "EvalAI has the result.",
            "Nothing.";
        RECORDED = "Recorded",
            "DynamoDB has the result.",
            "Nothing.";
        WAITING = "Waiting",
            "The other system does not have the result yet.",
            "Nothing. The message has the last error, or why the stored result cannot be read.";
        WAITING_FOR_PREVIOUS_CONTROLLER = "WaitingForPreviousController",
            "The previous controller process (perhaps the same container before a restart) did not confirm its last requests to \
             EvalAI. Nothing is written there for 75 s after the takeover: such a request may still be running.",
            "Nothing. The message names the time until which it waits.";
        REFUSED = "Refused",
            "The other system rejected the result. The operator keeps retrying (EvalAI: every ten minutes); if EvalAI has cancelled \
             or archived the submission meanwhile, it becomes Cancelled.",
            "EvalAI: check that the phase's leaderboard schema has all metric labels. DynamoDB: check the table and the operator's \
             rights.";
        NOT_REQUIRED = "NotRequired",
            "There is nothing to publish: no EvalAI, no table, no team, or EvalAI ended the submission itself.",
            "Nothing.";
        CONCURRENT_UPDATE = "ConcurrentUpdate",
            "An update of EvalAI and one of the operator happened at the same time, or the submission was deleted before its end: \
             EvalAI may show the wrong end. The operator reads EvalAI again and writes `cancelled` if needed.",
            "Nothing.";
    }
    Scores {
        UNEXPLAINED_SCORES = "UnexplainedScores",
            "The Leaderboard's `verify` is `Warn`, and scores in a checkpoint do not follow from its infractions. The message has \
             the first one; `logcopy/report.json` has up to 50.",
            "Look at the checkpoint before you trust the score (docs/results.md). `verify: Refuse` refuses such results.";
        SCORES_EXPLAINED = "ScoresExplained",
            "The scores follow from the infractions again.",
            "Nothing.";
    }
    Event {
        JOB_RECREATED = "JobRecreated",
            "Somebody deleted the Job; the operator creates it again, at most three times between two retries.",
            "Find out who deletes Jobs.";
        ATTEMPT_WITHOUT_MESSAGE = "AttemptWithoutMessage",
            "EvalAI's row asks for another attempt that no message has announced. EvalAI lets only hosts resume and re-run, but \
             participants can edit the row. One such attempt begins (a message can be lost) if the row shows `resuming` and the \
             attempt before has failed, or if it is the new row of a re-run; the next one begins only after a message. Until then \
             the condition `Stalled` reports it, too.",
            "Check in EvalAI who asked. If the attempt has begun and must not run, cancel it. If it has not begun and must run, \
             raise `spec.attempt`; otherwise set the status back in EvalAI.";
        TEAM_DIFFERS = "TeamDiffers",
            "EvalAI showed the submission under another team when its result was published; the run counts for the team it was \
             accepted for.",
            "Set the team back in EvalAI, or correct the table.";
        RERUN_IN_EVALAI = "RerunInEvalAI",
            "A host re-ran the submission in EvalAI, which cancelled its result there and created a new submission; the message and \
             `status.rerunAs` name it. State, score and the table's row keep the result; the row names the re-run in its column \
             `rerun_as`.",
            "Nothing.";
        RELEASED_UNPUBLISHED = "ReleasedUnpublished",
            "A deleted Submission was released after `deadlines.finalizeSeconds` before all systems had its result.",
            "Correct EvalAI or the table by hand.";
        DEAD_LETTER = "DeadLetter",
            "Event of a Leaderboard: a message of its queue cannot be used and was moved to the dead-letter queue. The message \
             names the cause.",
            "Look at the message in the dead-letter queue: its attributes `reason` and `detail` name the cause.";
    }
    Leaderboard {
        READY = "Ready",
            "Submissions can run. The message may have a note: metrics of a phase's leaderboard that stay empty, a token that \
             expires soon, until when nothing is written to EvalAI after a change of operators, Secrets that participants can read, \
             or rights by which their code can leave its Pod.",
            "Nothing, or what the note asks for.";
        OTHER_OPERATOR = "OtherOperator",
            "Only in the log and the metrics of an operator: another installation drives this Leaderboard, which `status.operator` \
             names by its Lease. This one leaves the Leaderboard and its submissions alone, and takes over when that Lease is gone \
             or has not been renewed for 30 s.",
            "Uninstall one of the two, or let them serve different namespaces (`leaderboards` of the chart's values).";
        TOKEN_MISSING = "TokenMissing",
            "EvalAI's token is not where `evalai.token` points.",
            "Create the Secret, or correct the reference.";
        TOKEN_REFUSED = "TokenRefused",
            "EvalAI refuses the token, or its user is no host of the challenge.",
            "Renew the token; or store a host's token, make the user a host, or correct `evalai.challenge`, as the message asks.";
        NOT_ALLOWED = "NotAllowed",
            "The Leaderboard names an entry of Secrets Manager or a queue that Leaderboards of its namespace may not name. Its token is \
             not read, its queue is left alone, and EvalAI is not asked.",
            "Name another one; or let the operator's administrator allow it under `leaderboards` of the chart's values.";
        INSECURE_SERVER = "InsecureServer",
            "`evalai.apiServer` begins with http and is on the internet: everyone on the way could read the host's token.",
            "Use https.";
        PHASE_CONFLICT = "PhaseConflict",
            "An older Leaderboard has the same phase and serves it.",
            "Remove the phase from one of them.";
        PREFIX_CONFLICT = "PrefixConflict",
            "A Leaderboard of another EvalAI server has the same bucket and prefix.",
            "Give one of them another `storage.prefix`.";
        LABELS_DIFFER = "LabelsDiffer",
            "The challenge's phases, splits or metric labels are not those of the Leaderboard.",
            "Compare `evalai.challenge`, `evalai.split` and the tracks' phases with the challenge; the message names the difference.";
        BUCKET_UNREACHABLE = "BucketUnreachable",
            "The bucket does not answer, or refuses the operator.",
            "Check `storage`, the operator's credentials and the network. The operator keeps checking.";
        TABLE_UNREACHABLE = "TableUnreachable",
            "The table does not answer, refuses the operator, or has other keys.",
            "As the message asks: create the table, or correct `table` or the operator's rights.";
        QUEUE_UNREACHABLE = "QueueUnreachable",
            "The queue does not answer or does not exist. With `Unknown` also: the controller lacks the right \
             `sqs:GetQueueAttributes`.",
            "As the message asks: create the queue, or correct `queue` or the controller's rights.";
        DEAD_LETTER_QUEUE_UNREACHABLE = "DeadLetterQueueUnreachable",
            "The dead-letter queue does not answer or does not exist. With `Unknown` also: the controller lacks the right \
             `sqs:GetQueueAttributes`.",
            "As the message asks: create the queue, or correct `queue.deadLetterURL` or the controller's rights.";
        INVALID_POD = "InvalidPod",
            "The API server refuses a Pod made with `spec.podOverrides`.",
            "Correct `spec.podOverrides` as the message asks.";
        QUEUE_BLOCKED = "QueueBlocked",
            "Messages that no Leaderboard serves stay in the queue, because there is no dead-letter queue.",
            "Set `queue.deadLetterURL`.";
        IN_USE = "InUse",
            "The Leaderboard is being deleted and waits for submissions that are live or unpublished (condition `Terminating`).",
            "Wait, or cancel these submissions.";
    }
    Isolation {
        ENFORCED = "Enforced",
            "True: the Pod of the last run could not reach what the policy forbids.",
            "Nothing.";
        NOT_ENFORCED = "NotEnforced",
            "The policy is in place, but the Pod of the last run could reach what it forbids.",
            "Use a network plugin that enforces policies. If `network.egress` contains the API server's own addresses, set \
             `network.probe`.";
        NOT_MEASURED = "NotMeasured",
            "The policy is in place, but no run of this spec has measured whether it is enforced, or none could (with `Require` \
             such a run fails with `NotIsolated`).",
            "Nothing before the first run; after that, as the message asks.";
        EXTERNAL = "External",
            "`network.policy` is `External`: the operator relies on the cluster's own policies.",
            "Nothing.";
        FORBIDDEN = "Forbidden",
            "The API server refuses the policy: the operator lacks the right, or an admission webhook rejects it. No Job is created.",
            "Give the operator's role the verbs that the message names, or correct what the webhook reports; or set \
             `network.policy` to `External`.";
        NOT_APPLIED = "NotApplied",
            "The policy could not be applied, or the API server stored another one, or the operator cannot see it, because its role \
             lacks list and watch. No Job is created.",
            "As the message asks. The operator retries every 10 s.";
    }
}

#[cfg(test)]
mod tests;
