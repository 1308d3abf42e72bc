//! The reasons of submissions, and of events.

use super::{Class, Reason};

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
        FOREIGN = "Foreign",
            "The submission is held back, because another program such as the old pipeline may run it. Either the table's row is \
             `SUBMITTED` or `RUNNING` and has no `attempt`, or the row cannot be read; then nothing has been written anywhere. Or the \
             Pod has found results of something else below the run's prefix; then its Job was deleted, and nothing more is written to \
             EvalAI, table and bucket.",
            "With a row: wait for the end of the other run; the row is read every 30 s. If nothing runs it any more, set the row's \
             `submission_status` to `FAILED`. In each case the annotation `leaderboard.carla.org/adopt=true` hands the Submission over: \
             it then continues from what is stored. If the message has an error, do what it asks.";
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
            "No node has accepted the Pod for 5 s or longer. The message is the scheduler's, with what cluster-autoscaler or \
             Karpenter says of it.",
            "Add a node, or lower the requests. Without `deadlines.scheduleSeconds` the submission waits without a limit.";
        QUOTA_EXCEEDED = "QuotaExceeded",
            "The namespace's quota does not allow the Job or its Pod.",
            "Raise the quota, or wait until others end.";
        POD_REFUSED = "PodRefused",
            "The API server refuses the Job or its Pod: a LimitRange, Pod Security, or a webhook.",
            "Fix what the message names, in the Leaderboard or in the namespace.";
        IMAGE_PULL = "ImagePull",
            "An image cannot be pulled. The submission fails after `deadlines.startSeconds`. The agent's image is the cause only where its \
             registry has no such image, has it for other machines, or has what is no container image: `ImageNotFound`, \
             `ImagePlatform`, `ImageInvalid`. Every other cause, such as refused rights, a time-out or a full disk, is an \
             infrastructure failure.",
            "Fix the name, the rights of the nodes, or the network, as the message asks. If the registry does not have the agent's image, \
             the participant pushes it again for linux/amd64.",
            after_failure: "Fix this, then resume the submission.";
        CONTAINER_CONFIG = "ContainerConfig",
            "A container cannot be set up: a Secret or a key is missing, or the Leaderboard's settings of its user contradict each other.",
            "Create what the message names, or correct the settings.",
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
            "The Pod or the Job was lost, or a host has raised `spec.attempt` of a live run, and a new Job continues from the stored \
             results; or the operator retries after an infrastructure failure.",
            "Nothing. The message names the cause.";
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
            "An agent crashed more often than `retries.perWorker` allows.",
            "Look at `agent/agent<n>/leaderboard.log` of the results; the participant fixes the agent and submits again.",
            log: "the log of agent `<n>`, `agent/agent<n>/leaderboard.log`";
        OUT_OF_MEMORY = "OutOfMemory",
            "An agent crashed more often than `retries.perWorker` allows, the last time because it ran out of memory.",
            "The participant reduces the agent's memory use; its limit is `agent.resources` of the Leaderboard.",
            log: "the log of agent `<n>`, `agent/agent<n>/leaderboard.log`";
        IDLE = "Idle",
            "An agent ended early more often than `retries.perWorker` allows, the last time because it printed nothing for \
             `deadlines.idleSeconds`.",
            "Look at `agent/agent<n>/leaderboard.log` of the results; the participant fixes the agent and submits again.",
            log: "the log of agent `<n>`, `agent/agent<n>/leaderboard.log`";
        CANNOT_START = "CannotStart",
            "The agent's command is missing in the image, may not be executed, or is not for this machine; or the image has no user \
             of the name that it asks for. For a simulator: an infrastructure failure. `NodeCannotStart` is for a node that fails.",
            "Rebuild the image for linux/amd64.",
            after_failure: "Fix this, then resume the submission.",
            log: "the log of agent `<n>`, `agent/agent<n>/leaderboard.log`";
        TIME_LIMIT = "TimeLimit",
            "The run took longer than `deadlines.runSeconds`. Completed routes are kept.",
            "Make the agent faster, or ask the host for more time.",
            log: "the log of the agent of the first pair that was not done, else of the first pair";
        INVALID_RESULTS = "InvalidResults",
            "A checkpoint was refused: malformed, implausible, or incomplete at the end; or it names a crash of the simulation that its \
             simulator did not have.",
            "Check what the agent writes into its checkpoint, and submit again.",
            log: "the log of the agent whose checkpoint was refused";
        NOT_ELIGIBLE = "NotEligible",
            "The run is complete, but its results do not count (`Rejected`, `Invalid`).",
            "Compare the agent's sensors with those the track allows, and submit again.",
            log: "the log of the agent of the first pair that was not done, else of the first pair";
        IMAGE_INVALID = "ImageInvalid",
            "The submitted image is not a valid image reference: empty, no text, upper-case letters in the repository, or white \
             space; or what its registry has under that name is not a container image; or the Pod sets `runAsNonRoot`, and the image runs as \
             root or names its user instead of giving its number. The submission fails at once, usually before a Job is created; where \
             only the kubelet refuses the image, with the first Pod.",
            "Submit again with an image such as registry.example/team/agent:1.";
        IMAGE_NOT_ALLOWED = "ImageNotAllowed",
            "`agent.images` of the Leaderboard does not allow the submitted image: it is another team's, of another registry, or the \
             host's own. No Job is created.",
            "Push the image to the team's own repository, and submit again.";
        IMAGE_NOT_FOUND = "ImageNotFound",
            "The registry does not have the submitted image. The submission fails after `deadlines.startSeconds`.",
            "Push the image under the name that is submitted, and submit again.";
        IMAGE_PLATFORM = "ImagePlatform",
            "The registry has the submitted image for other machines only. The submission fails after `deadlines.startSeconds`.",
            "Build the image for linux/amd64, and submit again.";
        IMAGE_CHANGED = "ImageChanged",
            "The agents of one Pod run different images, because the tag of the submitted image moved between two pulls. The run is \
             stopped at once.",
            "Push the image under a tag that stays, and submit again.";
        DISK_FULL = "DiskFull",
            "The Pod was evicted because its disk was full. A participant failure if the kubelet names an agent's container or a volume that \
             agents alone write to, or if `logcopy` has measured that agents fill the logs. Else it is an infrastructure failure: \
             CARLA's saves and core dumps are on the same account.",
            "Write less to disk or to the log.",
            after_failure: "Look at what fills the disk, such as the simulator's Saved and core dumps, or raise the limit; then resume the \
             submission.",
            log: "the log of the agent of the first pair that was not done, else of the first pair";
    }
    Infrastructure {
        SIMULATION_CRASHED = "SimulationCrashed",
            "A simulator crashed, or was not ready, more often than `retries.perWorker` allows; or the results name a crash of the simulation, \
             and that pair's simulator has failed in this attempt.",
            "Look at the simulator's log, then resume the submission; it repeats the route it was at.",
            log: "the log of simulator `<n>`, read from its node before the Pod ends; else `simulator/console-<n>.log`";
        NO_GPU = "NoGPU",
            "A simulator, or with `gpu.mode: NodeIndex` an agent that had not begun, saw no GPU on its node although `gpu` of the \
             Leaderboard gives it one; the simulator's log says which. The Job ends at once, and another one follows; after two on one \
             node the Jobs of this attempt avoid it.",
            "Look at the node: driver, device plugin, container runtime, and what docs/gpu.md asks for the Leaderboard's `gpu.mode`. Then \
             resume the submission.";
        NODE_CANNOT_START = "NodeCannotStart",
            "The node could not start a container, or its kubelet did not admit the Pod (`UnexpectedAdmissionError`): the container engine, \
             the GPU toolkit or device plugin, a full disk, too many open files. All that is not proven to be the image's counts here. \
             Another Job follows, which prefers other nodes (`status.failedNodes`); after a second such end only if its Job has finished a \
             route.",
            "Look at the node that the message names. The participant's image is not the cause.",
            after_failure: "Look at the node that the message names: its container engine, GPU toolkit, device plugin and disk. Then resume the \
             submission.";
        GRAPHICS_DRIVER_MISSING = "GraphicsDriverMissing",
            "A simulator saw its GPU, but the node's NVIDIA driver has no Vulkan/OpenGL part: nvidia_icd.json (V2) or libGLX_nvidia.so.0 (V1) \
             is missing in the container. It was not started. There is no retry.",
            "Use a node image whose driver includes Vulkan and OpenGL, as docs/gpu.md says, then resume the submission.";
        RESULTS_NOT_STORED = "ResultsNotStored",
            "The Pod ended before its final results were stored.",
            "Look at the log of logcopy and at the bucket, then resume the submission.",
            log: "the log of `logcopy`";
        NODE_LOST = "NodeLost",
            "The node went silent or was removed with the Pod, or did not end the Pod within its grace period.",
            "Look at the node, then resume the submission.";
        NODE_INTERRUPTED = "NodeInterrupted",
            "The node was about to be taken away (Spot, Karpenter, cluster-autoscaler, the AWS Node Termination Handler), or the Pod was \
             evicted from it or preempted. The results were stored, and a new Job resumes from them; this uses up neither an attempt nor \
             `retries.infrastructure`.",
            "Nothing. If it happens often, give the track nodes that stay.",
            after_failure: "Resume the submission.";
        START_DEADLINE = "StartDeadline",
            "No agent started within `deadlines.startSeconds` after the Pod was scheduled and its images were pulled, or the images were \
             not pulled within `deadlines.pullSeconds`.",
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
            "There is nothing to publish: no EvalAI, no table, no team, or EvalAI ended the submission itself; or the table keeps a later \
             attempt or another end of the run, as the message then says.",
            "Nothing, unless the message asks for it.";
        CANCELLED_IN_EVALAI = "CancelledInEvalAI",
            "EvalAI has cancelled the result since it took it, as a host's re-run does: it counts there no more (condition `Published`). State, \
             score and the table's row stay.",
            "Nothing. A re-run is a new submission.";
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
    CloudWatch {
        LOGS_REFUSED = "LogsRefused",
            "CloudWatch refuses the lines of the run. Results do not depend on it, and the logs are in S3.",
            "Check that `logs.cloudWatch` of the Leaderboard exists (`logs.cloudWatch.retentionDays` has the controller make it) and that the Pods' role has \
             logs:CreateLogStream, logs:PutLogEvents and logs:GetLogEvents for it; on a cluster that enforces policies also that \
             `network.egress` names CloudWatch's endpoint.";
        LOGS_SENT = "LogsSent",
            "CloudWatch takes the lines of the run.",
            "Nothing.";
    }
    Event {
        JOB_RECREATED = "JobRecreated",
            "Somebody deleted the Job; the operator creates it again, at most three times between two retries.",
            "Find out who deletes Jobs.";
        ATTEMPT_WITHOUT_MESSAGE = "AttemptWithoutMessage",
            "EvalAI's row asks for another attempt that no message has announced. EvalAI lets hosts resume and re-run, and \
             participants only where the challenge has `allow_participants_resubmissions`; but any participant can edit the row. One such attempt begins (a message can be lost) if the row shows `resuming` and the \
             attempt before has failed, or if it is the new row of a re-run; the next one begins only after a message. Until then \
             the condition `Stalled` reports it, too.",
            "Check in EvalAI who asked. If the attempt has begun and must not run, cancel it. If it has not begun and must run, \
             raise `spec.attempt`; otherwise set the status back in EvalAI.";
        ATTEMPT_AFTER_FINISH = "AttemptAfterFinish",
            "EvalAI asks for another attempt of a submission that has finished, as after its row was set to `failed` by hand and resumed. \
             It is not run again: a finished submission is final. The condition `Stalled` reports it, too.",
            "Re-run the submission in EvalAI, which makes a new one. Otherwise set its status back to `finished` there.";
        TEAM_DIFFERS = "TeamDiffers",
            "EvalAI showed the submission under another team when its result was published; the run counts for the team it was \
             accepted for.",
            "Set the team back in EvalAI, or correct the table.";
        RELEASED_UNPUBLISHED = "ReleasedUnpublished",
            "A deleted Submission was released after `deadlines.finalizeSeconds` before all systems had its result.",
            "Correct EvalAI or the table by hand.";
        DEAD_LETTER = "DeadLetter",
            "Event of a Leaderboard: a message of its queue cannot be used and was moved to the dead-letter queue. The message \
             names the cause.",
            "Look at the message in the dead-letter queue: its attributes `reason` and `detail` name the cause.";
        MESSAGE_DROPPED = "MessageDropped",
            "Event of a Leaderboard: a message of its queue in EvalAI (`queue.evalai`) cannot be used and was deleted there. The event \
             and the controller's log have the cause and the message. Its submission stays in EvalAI, and starts later if EvalAI \
             shows it as `submitted` and a Leaderboard serves its phase by then.",
            "As the cause asks. To start a submission after all, re-run it in EvalAI.";
    }
}
