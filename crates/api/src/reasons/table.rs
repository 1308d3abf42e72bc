//! The table: each reason below its class, with its meaning, the next step, and where it has them the step after a failure and the log.

use super::{Class, Row};

reasons! {
    Pending {
        AskingEvalAI,
            "The operator is asking EvalAI whether the submission should still run.",
            "Nothing. If it lasts, the message has EvalAI's last error: check the token and EvalAI.";
        LeaderboardNotFound,
            "The namespace has no Leaderboard of that name. Running submissions continue without it; new ones do not start.",
            "Apply the Leaderboard; the submission then continues.";
        LeaderboardNotReady,
            "The Leaderboard has a fault, and no Job can or may be created for it.",
            "Fix what the Leaderboard's condition `Ready` reports.";
        TrackNotFound,
            "The Leaderboard has no track of that name or phase.",
            "Add the track, or cancel the submission.";
        ImageMissing,
            "The Submission names no image, and the file in EvalAI that names it could not be read yet. The operator retries.",
            "Check that EvalAI serves the submission's input file, or set `spec.image`. If it lasts, ask the participant to push \
             again, and cancel this submission.";
        FetchingInput,
            "The operator is copying the submitted file from EvalAI into the bucket, or waits for EvalAI's address of it. Nothing is \
             charged meanwhile.",
            "Nothing. If it lasts, the message has the last error: check that EvalAI serves the file, and the bucket.";
        PhaseDiffers,
            "EvalAI's row belongs to another phase than the Submission: one of the two was edited. It does not run. After an hour it \
             fails, which does not count as an attempt, so that EvalAI shows an end.",
            "Set the phase back in EvalAI within the hour, and the submission continues. If the Submission's own phase is wrong, \
             delete it and apply it anew.",
            after_failure: "Set the phase back, then resume it.";
        Foreign,
            "Another program may run the submission, such as the old pipeline. The table's row shows such a run or cannot be read, or \
             the Pod found its files below the run's prefix. The operator writes nothing.",
            "Wait for the end of the other run. If none runs, set the row's `submission_status` to `FAILED`, or hand the Submission \
             over by the annotation `leaderboard.carla.org/adopt=true`.";
        WaitingForSlot,
            "All slots that `concurrency.total` and `concurrency.perTeam` allow are in use. `status.waiting` has the position in the line \
             and an estimate.",
            "Wait, or raise the limits.";
        Paused,
            "The Leaderboard is paused: nothing new starts.",
            "Set `paused: false`.";
        JobNameTaken,
            "A Job of an older Submission of the same name is still being deleted.",
            "Nothing. If the Job stays, delete it.";
        Preparing,
            "The Job is created; its Pod is being scheduled, pulls images, copies the contents or fills the workspace. After 45 s \
             the message names the step.",
            "Nothing. If it lasts, check the node that the message names.";
        Suspended,
            "The Job is suspended (`spec.suspend`), by Kueue or by a person, and has no Pod. No deadline runs. After its resume a new Pod \
             continues from the stored results, and no retry is used.",
            "With Kueue look at its Workload: `kubectl describe workloads`. Else `kubectl get job NAME -o yaml --show-managed-fields` names who \
             has suspended it.";
        Unschedulable,
            "No node has accepted the Pod for 5 s or longer. The message is the scheduler's, with what cluster-autoscaler or \
             Karpenter says of it.",
            "Add a node, or lower the requests. Without `deadlines.scheduleSeconds` the submission waits without a limit.";
        QuotaExceeded,
            "The namespace's quota does not allow the Job or its Pod.",
            "Raise the quota, or wait until others end.";
        PodRefused,
            "The API server refuses the Job or its Pod: a LimitRange, Pod Security, or a webhook.",
            "Fix what the message names, in the Leaderboard or in the namespace.";
        ImagePull,
            "An image cannot be pulled; the submission fails after `deadlines.startSeconds`. That counts as an attempt only if the \
             registry lacks the agent's image (`ImageNotFound`, `ImagePlatform`, `ImageInvalid`).",
            "Fix the image's name, the rights of the nodes, or the network, as the message asks.",
            after_failure: "Fix this, then resume the submission.";
        ContainerConfig,
            "A container cannot be set up: a Secret or a key is missing, or the Leaderboard's settings of its user contradict each other.",
            "Create what the message names, or correct the settings.",
            after_failure: "Fix this, then resume the submission.";

        NotIsolated,
            "The Leaderboard's NetworkPolicy is not in place, and no Job starts without it. As a failure: with `network.enforcement: \
             Require` the Pod could reach what it forbids, or could not measure it.",
            "Nothing for a moment after an edit of the Leaderboard. If it lasts, do what its condition `Isolated` reports.",
            after_failure: "Do what the message asks, then resume the submission.";
    }
    Running {
        Accepted,
            "Leaderboard, track and image are known, and the plan is pinned (condition `Accepted`).",
            "Nothing.";
        Running,
            "The run of the first attempt is under way.",
            "Nothing.";
        Resumed,
            "The run continues from the stored results.",
            "Nothing.";
        Replacing,
            "The Pod or the Job was lost, a failure of the infrastructure is retried, or a host has raised `spec.attempt` of a live \
             run. A new Job continues from the stored results.",
            "Nothing. The message names the cause.";
        Stopping,
            "The submission is being stopped; completed work is kept.",
            "Nothing. It ends within about three minutes after `deadlines.cancelSeconds`; later while the bucket cannot be read.";
        InProgress,
            "The submission has been accepted and has not come to its end (condition `Succeeded`).",
            "Nothing.";
        NotStalled,
            "The submission is not held up (condition `Stalled`).",
            "Nothing.";
    }
    End {
        Finished,
            "All work is done, and the results count.",
            "Nothing.";
        Cancelled,
            "A person cancelled it; completed work is kept.",
            "To continue it, resume it: a patch to a higher `attempt` with `cancel: false`.";
        EndedInEvalAI,
            "It ended in EvalAI: cancelled, archived, deleted, or set to an end by hand. `finished` counts only before the run was \
             under way. The operator writes nothing more to EvalAI.",
            "Resume it in EvalAI if EvalAI shows `failed`, else re-run it there. After a deletion in EvalAI the participant submits \
             again.";
        Deleted,
            "The Submission was deleted.",
            "Nothing. To continue from the stored results, apply it again with a higher attempt.";
    }
    Participant {
        AgentCrashed,
            "An agent crashed more often than `retries.perWorker` allows.",
            "Look at `agent/agent<n>/leaderboard.log` of the results; the participant fixes the agent and submits again.",
            log: "the log of agent `<n>`, `agent/agent<n>/leaderboard.log`";
        OutOfMemory,
            "An agent crashed more often than `retries.perWorker` allows, the last time because it ran out of memory.",
            "The participant reduces the agent's memory use; its limit is `agent.resources` of the Leaderboard.",
            log: "the log of agent `<n>`, `agent/agent<n>/leaderboard.log`";
        Idle,
            "An agent ended early more often than `retries.perWorker` allows, the last time because it printed nothing for \
             `deadlines.idleSeconds`.",
            "Look at `agent/agent<n>/leaderboard.log` of the results; the participant fixes the agent and submits again.",
            log: "the log of agent `<n>`, `agent/agent<n>/leaderboard.log`";
        CannotStart,
            "The agent's command is missing, may not be executed, or is for another machine, or the image lacks the user that it \
             names. For a simulator this is an infrastructure failure.",
            "Rebuild the image for linux/amd64.",
            after_failure: "Fix this, then resume the submission.",
            log: "the log of agent `<n>`, `agent/agent<n>/leaderboard.log`";
        TimeLimit,
            "The run took longer than `deadlines.runSeconds`. Completed work is kept.",
            "Submit what takes less time, or ask the host for more.",
            log: "the log of the agent of the first worker that was not done, else of the first worker";
        InvalidResults,
            "A checkpoint was refused: malformed, implausible, or incomplete at the end. Or it names a crash of the simulation that \
             its simulator did not have. Or the host's evaluator refused the submission.",
            "Check what was submitted against what the track asks for, and submit again.",
            log: "the log of the agent whose results were refused";
        InputInvalid,
            "What the submission brings cannot be taken: no file, too many, too large, or something that is no regular file. Or the \
             submission is an image where the Leaderboard takes files, or the other way round.",
            "Keep to regular files within `evaluation.container.input`, and submit again.",
            log: "the log of the agent, if there is one";
        NotEligible,
            "The run is complete, but its results do not count (`Rejected`, `Invalid`).",
            "Compare what was submitted with the rules of the track, and submit again.",
            log: "the log of the agent of the first worker that was not done, else of the first worker";
        ImageInvalid,
            "The name is no valid image reference, or its registry has no container image there, or the Pod sets `runAsNonRoot` and \
             the image runs as root or names its user. The submission fails at once.",
            "Submit again with an image such as registry.example/team/agent:1.";
        ImageNotAllowed,
            "`agent.images` of the Leaderboard does not allow the image: it is another team's, of another registry, or the host's \
             own. No Job is created.",
            "Push the image to the team's own repository, and submit again.";
        ImageNotFound,
            "The registry does not have the submitted image. The submission fails after `deadlines.startSeconds`.",
            "Push the image under the name that is submitted, and submit again.";
        ImagePlatform,
            "The registry has the submitted image for other machines only. The submission fails after `deadlines.startSeconds`.",
            "Build the image for linux/amd64, and submit again.";
        ImageChanged,
            "The agents of one Pod run different images, because the tag of the submitted image moved between two pulls. The run is \
             stopped at once.",
            "Push the image under a tag that stays, and submit again.";
        DiskFull,
            "The Pod was evicted for a full disk. A participant failure if the kubelet names what agents alone write, or `logcopy` \
             measured that they fill the logs; else an infrastructure failure.",
            "Write less to disk or to the log.",
            after_failure: "Look at what fills the disk, such as saved files and core dumps, or raise the limit; then resume the \
             submission.",
            log: "the log of the agent of the first worker that was not done, else of the first worker";
    }
    Infrastructure {
        SimulationCrashed,
            "A simulator crashed, or was not ready, more often than `retries.perWorker` allows. Or the results name such a crash, and \
             that simulator has failed in this attempt.",
            "Look at the simulator's log, then resume the submission; it repeats the route it was at.",
            log: "the log of simulator `<n>`, read from its node before the Pod ends; else `simulator/console-<n>.log`";
        EvaluatorFailed,
            "An evaluator crashed, was not ready, or had no final result more often than `retries.perWorker` allows. Or it wrote a \
             `result.json` that cannot be used. Or they outlasted `runSeconds`.",
            "Look at the evaluator's log and at `evaluators/<n>/result.json`; `kubectl leaderboard lint FILE` says what is wrong with \
             it. Correct the evaluator's image, then resume the submission.",
            log: "the log of evaluator `<n>`, `evaluators/<n>/console.log`";
        InputMissing,
            "The submitted file is not to be had: EvalAI does not serve it, or the bucket has none at `input/file` that is the one of \
             the Submission.",
            "Check EvalAI's MEDIA_URL, or put the file into the bucket again; then resume the submission.";
        NoGPU,
            "A simulator, or in `NodeIndex` an agent that had not begun, saw no GPU although `gpu` gives it one. Another Job follows; \
             after two such ends on one node the Jobs of the attempt avoid it.",
            "Look at the node: driver, device plugin, container runtime, and what docs/gpu.md asks for the Leaderboard's `gpu.mode`. Then \
             resume the submission.";
        NodeCannotStart,
            "The node could not start a container, or did not admit the Pod: container engine, GPU toolkit, device plugin, full disk, \
             open files. Another Job follows on other nodes where there are some.",
            "Look at the node that the message names. The participant's image is not the cause.",
            after_failure: "Look at that node, then resume the submission.";
        GraphicsDriverMissing,
            "A simulator saw its GPU, and the node's NVIDIA driver has no Vulkan (V2) or OpenGL (V1) part in the container. It was \
             not started. There is no retry.",
            "Use a node image whose driver includes Vulkan and OpenGL, as docs/gpu.md says, then resume the submission.";
        ResultsNotStored,
            "The Pod ended before its final results were stored.",
            "Look at the log of logcopy and at the bucket, then resume the submission.",
            log: "the log of `logcopy`";
        NodeLost,
            "The node went silent or was removed with the Pod, or did not end the Pod within its grace period.",
            "Look at the node, then resume the submission.";
        NodeInterrupted,
            "The node was about to be taken away, or the Pod was evicted or preempted. A new Job resumes from the stored results. \
             This uses up neither an attempt nor `retries.infrastructure`.",
            "Nothing. If it happens often, give the track nodes that stay.",
            after_failure: "Resume the submission.";
        StartDeadline,
            "No agent started within `deadlines.startSeconds` after its images were pulled, or they were not pulled within \
             `deadlines.pullSeconds`.",
            "Fix this, then resume the submission.",
            log: "the log of `contents`, `workspace` or `logcopy`, whichever fails, read from its node before the Job is deleted";
        ScheduleDeadline,
            "No node accepted the Pod within `deadlines.scheduleSeconds`. There is no retry.",
            "Add a node or free one, then resume the submission.";
        JobDeleted,
            "Somebody deleted the Job four times between two retries. There is no further retry.",
            "Find out who deletes Jobs in this namespace, then resume the submission.";
        JobExpired,
            "The Job ended while the operator was away or the bucket could not be read, and Kubernetes removed it after its time (at \
             least 7 days). There is no further Job.",
            "Look at the stored results and logs, then resume the submission.";
        JobFailed,
            "Kubernetes ended the Job for a reason that no container explains.",
            "Look at the Job's events, then resume the submission.",
            log: "the log of `logcopy`";
    }
    System {
        Stored,
            "The final results are in S3.",
            "Nothing.";
        NotStored,
            "No final results are in S3. For a live submission: they cannot be read at the moment.",
            "Nothing while the submission is live. The operator waits for the bucket for up to a day, after a cancel for \
             `deadlines.cancelSeconds` (at least 60 s).";
        Published,
            "EvalAI has the result.",
            "Nothing.";
        Recorded,
            "DynamoDB has the result.",
            "Nothing.";
        Waiting,
            "The other system does not have the result yet.",
            "Nothing. The message has the last error.";
        WaitingForPreviousController,
            "The controller before this one may still have a request to EvalAI under way. Nothing is written there for 75 s after the \
             takeover.",
            "Nothing. The message names the time until which it waits.";
        Refused,
            "The other system rejected the result. The operator keeps trying (EvalAI: every ten minutes). If EvalAI has cancelled or \
             archived the submission meanwhile, it becomes Cancelled.",
            "EvalAI: check that the phase's leaderboard schema has all metric labels. DynamoDB: check the table and the operator's \
             rights.";
        Unread,
            "The stored result cannot be read, so the other system does not have it yet. It is sent when it can be read.",
            "Look at the bucket: the message has its answer.";
        Superseded,
            "The table keeps a later attempt or another end of the run, and this end was not written there.",
            "The message says how the submission goes on. Correct the row by hand if this end is the one that counts.";
        NotRequired,
            "There is nothing to publish: no EvalAI, no table, no team, or EvalAI ended the submission itself.",
            "Nothing, unless the message asks for it.";
        CancelledInEvalAI,
            "EvalAI has cancelled a result that it had taken, as a host's re-run does. It counts there no more. State, score and the \
             table's row stay.",
            "Nothing. A re-run is a new submission.";
        ConcurrentUpdate,
            "EvalAI and the operator wrote at one time, or the submission was deleted before its end, so EvalAI may show the wrong \
             end. The operator reads it again, and writes `cancelled` if needed.",
            "Nothing.";
    }
    Scores {
        UnexplainedScores,
            "The Leaderboard's `verify` is `Warn`, and scores in a checkpoint do not follow from its infractions. The message has \
             the first one; `logcopy/report.json` has up to 50.",
            "Look at the checkpoint before you trust the score (docs/results.md). `verify: Refuse` refuses such results.";
        ScoresExplained,
            "The scores follow from the infractions again.",
            "Nothing.";
    }
    CloudWatch {
        LogsRefused,
            "CloudWatch refuses the lines of the run. Results do not depend on it, and the logs are in S3.",
            "Check that the group of `logs.cloudWatch` exists and that the Pods' role has logs:CreateLogStream, logs:PutLogEvents and \
             logs:GetLogEvents for it. `network.egress` must name CloudWatch's endpoint.";
        LogsSent,
            "CloudWatch takes the lines of the run.",
            "Nothing.";
    }
    Event {
        Started,
            "The agents run: the first of a Job's Pod has started. Each Job of a submission has one such event.",
            "Nothing.";
        JobRecreated,
            "Somebody deleted the Job; the operator creates it again, at most three times between two retries.",
            "Find out who deletes Jobs.";
        AttemptWithoutMessage,
            "EvalAI's row asks for another attempt that no message has announced. One such attempt begins after a failure or a \
             re-run; a further one waits for a message, and `Stalled` shows it.",
            "Ask in EvalAI who did it. Cancel an attempt that must not run. For one that must run raise `spec.attempt`, else set the \
             status back in EvalAI.";
        AttemptAfterFinish,
            "EvalAI asks for another attempt of a submission that has finished, for example after its row was set to `failed`. A \
             finished submission is final. `Stalled` shows it, too.",
            "Re-run the submission in EvalAI, which makes a new one. Otherwise set its status back to `finished` there.";
        TeamDiffers,
            "EvalAI showed the submission under another team when its result was published. The run counts for the team that it was \
             accepted for.",
            "Set the team back in EvalAI, or correct the table.";
        ReleasedUnpublished,
            "A deleted Submission was released after `deadlines.finalizeSeconds` before all systems had its result.",
            "Correct EvalAI or the table by hand.";
        DeadLetter,
            "Event of a Leaderboard: a message of its queue cannot be used and is in the dead-letter queue now. The event names the \
             cause.",
            "Look at the message in the dead-letter queue: its attributes `reason` and `detail` name the cause.";
        MessageDropped,
            "Event of a Leaderboard: a message of its queue in EvalAI cannot be used and was deleted. The event has cause and text. \
             The submission starts later if EvalAI shows `submitted` and a phase fits.",
            "As the cause asks. To start a submission after all, re-run it in EvalAI.";
    }
    Leaderboard {
        Ready,
            "Submissions can run. A note names what is no obstacle, such as metrics that stay empty, an expiring token, images that cannot be \
             pulled, or a challenge that EvalAI's own worker evaluates.",
            "Nothing, or what the note asks for.";
        Checking,
            "The operator asks bucket, table, queues and the place of EvalAI's token for the first time, and not all have answered yet.",
            "Wait: what does not answer is named after ten seconds, an entry of Secrets Manager after a minute.";
        OtherOperator,
            "In events, log and metrics of an operator only: another installation, which `status.operator` names by its Lease, drives \
             this Leaderboard.",
            "Let the installations serve different namespaces (the chart's values), or uninstall one and hand the Leaderboard over by \
             the command in the event.";
        TokenMissing,
            "EvalAI's token is not where `evalai.token` points.",
            "Create the Secret, or correct the reference.";
        TokenRefused,
            "EvalAI refuses the token, or its user is no host of the challenge.",
            "Renew the token; or store a host's token, make the user a host, or correct `evalai.challenge`, as the message asks.";
        NotAllowed,
            "The Leaderboard names a Secret's entry, a queue, a bucket, a table or a log group that its namespace may not use. The \
             operator reads neither token nor queue, and starts and records nothing.",
            "Name another one, or let the operator's administrator allow it under `allow`, or in the entry of its namespace under `namespaces`, of the chart's values.";
        InsecureServer,
            "`evalai.apiServer` begins with http and is on the internet: everyone on the way could read the host's token.",
            "Use https.";
        PhaseConflict,
            "An older Leaderboard has the same phase and serves it.",
            "Remove the phase from one of them.";
        PrefixConflict,
            "An older Leaderboard of another namespace or another EvalAI server has the same bucket and prefix.",
            "Make one of them anew with another `storage.s3.prefix`.";
        LabelsDiffer,
            "The challenge's phases, splits or CARLA's metric labels are not those of the Leaderboard.",
            "Compare `evalai.challenge`, `evalai.split` and the tracks' phases with the challenge; the message names the difference.";
        BucketUnreachable,
            "The bucket does not answer, or refuses the operator.",
            "Check `storage`, the operator's credentials and the network. The operator keeps checking.";
        TableUnreachable,
            "The table does not answer, refuses the operator, or has other keys.",
            "As the message asks: create the table, or correct `table` or the operator's rights.";
        QueueUnreachable,
            "The queue does not answer or does not exist, or EvalAI does not let the token read it. With `Unknown` also: the \
             controller lacks `sqs:GetQueueAttributes`.",
            "As the message asks: create the queue, or correct `queue` or the controller's rights; or correct `queue.evalai`.";
        DeadLetterQueueUnreachable,
            "The dead-letter queue does not answer or does not exist. With `Unknown` also: the controller lacks \
             `sqs:GetQueueAttributes`.",
            "As the message asks: create the queue, or correct `queue.sqs.deadLetterURL` or the controller's rights.";
        InvalidPod,
            "The Pods cannot be made. The API server or `spec.podOverrides` is against them, `resources` and `gpu` contradict each other, or a \
             PriorityClass or a claim is missing.",
            "Correct what the message names.";
        ClaimsNotServed,
            "`gpu.mode` is `Claim`, and the API server does not serve `resource.k8s.io/v1`, which Kubernetes has from 1.34 on. No Job is \
             created.",
            "Update the cluster, or choose another `gpu.mode` (docs/gpu.md).";
        ClaimTemplateMissing,
            "`gpu.mode` is `Claim`, and the ResourceClaimTemplate is not there: the operator could not apply it, or yours does not exist. \
             No Job is created.",
            "As the message asks. The operator retries every 15 s.";
        QueueBlocked,
            "Messages that no Leaderboard serves stay in the queue, because there is no dead-letter queue.",
            "Set `queue.sqs.deadLetterURL`.";
        InUse,
            "The Leaderboard is being deleted and waits for submissions that are live or unpublished (condition `Terminating`).",
            "Wait, or cancel these submissions.";
    }
    Isolation {
        Enforced,
            "True: the Pod of the last run could not reach what the policy forbids.",
            "Nothing.";
        NotEnforced,
            "The policy is in place, but the Pod of the last run could reach what it forbids.",
            "Use a network plugin that enforces policies. If `network.egress` contains the API server's own addresses, set \
             `network.probe`.";
        NotMeasured,
            "The policy is in place, and no run of this spec has measured whether it is enforced, or none could. With `Require` such \
             a run fails with `NotIsolated`.",
            "Nothing before the first run; after that, as the message asks.";
        External,
            "`network.policy` is `External`: the operator relies on the cluster's own policies.",
            "Nothing.";
        Forbidden,
            "The API server refuses the policy: the operator lacks the right, or an admission webhook rejects it. No Job is created.",
            "Give the operator's role the verbs that the message names, or correct what the webhook reports; or set \
             `network.policy` to `External`.";
        NotApplied,
            "The policy could not be applied, another one is stored, or the operator's role lacks list and watch of policies. No Job \
             is created.",
            "As the message asks. The operator retries every 10 s.";
    }
}
