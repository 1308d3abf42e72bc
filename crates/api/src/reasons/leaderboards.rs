//! The reasons of a Leaderboard's conditions.

use super::{Class, Reason};

reasons! {
    Leaderboard {
        READY = "Ready",
            "Submissions can run. The message may have a note: metrics of a phase's leaderboard that stay empty, a token that \
             expires soon, until when nothing is written to EvalAI after a change of operators, images of several teams that cannot be pulled \
             (`ImagePull`), or Secrets that participants can read.",
            "Nothing, or what the note asks for.";
        CHECKING = "Checking",
            "The operator asks bucket, table, queues and the place of EvalAI's token for the first time, and not all have answered yet.",
            "Wait: what does not answer is named after ten seconds, an entry of Secrets Manager after a minute.";
        OTHER_OPERATOR = "OtherOperator",
            "Only in an event, the log and the metrics of an operator: another installation drives this Leaderboard, which `status.operator` \
             names by its Lease. This one leaves the Leaderboard and its submissions alone.",
            "Let the two installations serve different namespaces (`leaderboards` of the chart's values), or uninstall one and hand the \
             Leaderboard over by the command in the event.";
        TOKEN_MISSING = "TokenMissing",
            "EvalAI's token is not where `evalai.token` points.",
            "Create the Secret, or correct the reference.";
        TOKEN_REFUSED = "TokenRefused",
            "EvalAI refuses the token, or its user is no host of the challenge.",
            "Renew the token; or store a host's token, make the user a host, or correct `evalai.challenge`, as the message asks.";
        NOT_ALLOWED = "NotAllowed",
            "The Leaderboard names an entry of Secrets Manager, a queue, a bucket, a table or a log group that Leaderboards of its namespace \
             may not name. Its token is not read, its queue is left alone, EvalAI is not asked, and no submission starts or is recorded.",
            "Name another one, or let the operator's administrator allow it under `leaderboards` of the chart's values.";
        INSECURE_SERVER = "InsecureServer",
            "`evalai.apiServer` begins with http and is on the internet: everyone on the way could read the host's token.",
            "Use https.";
        PHASE_CONFLICT = "PhaseConflict",
            "An older Leaderboard has the same phase and serves it.",
            "Remove the phase from one of them.";
        PREFIX_CONFLICT = "PrefixConflict",
            "An older Leaderboard of another namespace or another EvalAI server has the same bucket and prefix.",
            "Make one of them anew with another `storage.s3.prefix`.";
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
             `sqs:GetQueueAttributes`. Of a queue in EvalAI: it refuses to let this token read it, or has not for five minutes.",
            "As the message asks: create the queue, or correct `queue` or the controller's rights; or correct `queue.evalai`.";
        DEAD_LETTER_QUEUE_UNREACHABLE = "DeadLetterQueueUnreachable",
            "The dead-letter queue does not answer or does not exist. With `Unknown` also: the controller lacks the right \
             `sqs:GetQueueAttributes`.",
            "As the message asks: create the queue, or correct `queue.sqs.deadLetterURL` or the controller's rights.";
        INVALID_POD = "InvalidPod",
            "The Pods cannot be made: the API server refuses them, `spec.podOverrides` says what it may not, `resources` and `gpu` \
             contradict each other, or a PriorityClass does not exist or preempts.",
            "Correct what the message names.";
        CLAIMS_NOT_SERVED = "ClaimsNotServed",
            "`gpu.mode` is `Claim`, and the API server does not serve `resource.k8s.io/v1`, which Kubernetes has from 1.34 on. No Job is \
             created.",
            "Update the cluster, or choose another `gpu.mode` (docs/gpu.md).";
        CLAIM_TEMPLATE_MISSING = "ClaimTemplateMissing",
            "`gpu.mode` is `Claim`, and the ResourceClaimTemplate is not there: the operator could not apply it, or yours does not exist. \
             No Job is created.",
            "As the message asks. The operator retries every 15 s.";
        QUEUE_BLOCKED = "QueueBlocked",
            "Messages that no Leaderboard serves stay in the queue, because there is no dead-letter queue.",
            "Set `queue.sqs.deadLetterURL`.";
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
