//! Every reason that a status, a condition or an event may give, with what it means.
//!
//! Pure. Each reason appears in docs/states.md.

/// Nothing holds a submission up.
pub const NOT_STALLED: &str = "NotStalled";

// Why a submission is Pending.
pub const WAITING_FOR_SLOT: &str = "WaitingForSlot";
pub const PAUSED: &str = "Paused";
pub const UNSCHEDULABLE: &str = "Unschedulable";
pub const QUOTA_EXCEEDED: &str = "QuotaExceeded";
pub const POD_REFUSED: &str = "PodRefused";
pub const IMAGE_PULL: &str = "ImagePull";
pub const CONTAINER_CONFIG: &str = "ContainerConfig";
/// The Pod is being scheduled, pulls images or fills its volumes.
pub const PREPARING: &str = "Preparing";
/// EvalAI is asked whether this submission still wants to run.
pub const ASKING_EVALAI: &str = "AskingEvalAI";
/// A Job of the same name belongs to an older object and is going away.
pub const JOB_NAME_TAKEN: &str = "JobNameTaken";
/// The Leaderboard's NetworkPolicy is not in place, or a Pod could reach what it forbids.
pub const NOT_ISOLATED: &str = "NotIsolated";

// Why a submission is not accepted.
pub const LEADERBOARD_NOT_FOUND: &str = "LeaderboardNotFound";
pub const TRACK_NOT_FOUND: &str = "TrackNotFound";
pub const IMAGE_MISSING: &str = "ImageMissing";
pub const LEADERBOARD_NOT_READY: &str = "LeaderboardNotReady";
/// EvalAI's row belongs to another phase.
pub const PHASE_DIFFERS: &str = "PhaseDiffers";

// While a submission runs.
pub const ACCEPTED: &str = "Accepted";
pub const RUNNING: &str = "Running";
pub const RESUMED: &str = "Resumed";
pub const REPLACING: &str = "Replacing";
pub const STOPPING: &str = "Stopping";
/// Scores do not follow from the infractions.
/// The scores follow from the infractions again.
pub const SCORES_EXPLAINED: &str = "ScoresExplained";
pub const UNEXPLAINED_SCORES: &str = "UnexplainedScores";

// Ends.
pub const FINISHED: &str = "Finished";
pub const CANCELLED: &str = "Cancelled";
pub const ENDED_IN_EVALAI: &str = "EndedInEvalAI";
pub const DELETED: &str = "Deleted";

// Failures of the participant.
pub const NOT_ELIGIBLE: &str = "NotEligible";
pub const AGENT_CRASHED: &str = "AgentCrashed";
pub const OUT_OF_MEMORY: &str = "OutOfMemory";
pub const IDLE: &str = "Idle";
pub const TIME_LIMIT: &str = "TimeLimit";
pub const INVALID_RESULTS: &str = "InvalidResults";
pub const CANNOT_START: &str = "CannotStart";
pub const DISK_FULL: &str = "DiskFull";
/// What was submitted names no image that could ever be pulled.
pub const IMAGE_INVALID: &str = "ImageInvalid";

// Failures of the infrastructure.
pub const SIMULATION_CRASHED: &str = "SimulationCrashed";
pub const RESULTS_NOT_STORED: &str = "ResultsNotStored";
pub const JOB_DELETED: &str = "JobDeleted";
pub const PREFIX_IN_USE: &str = "PrefixInUse";
pub const START_DEADLINE: &str = "StartDeadline";
pub const SCHEDULE_DEADLINE: &str = "ScheduleDeadline";
pub const JOB_FAILED: &str = "JobFailed";
pub const NODE_LOST: &str = "NodeLost";

// Of the other conditions.
pub const NOT_REQUIRED: &str = "NotRequired";
pub const CONCURRENT_UPDATE: &str = "ConcurrentUpdate";
pub const STORED: &str = "Stored";
pub const NOT_STORED: &str = "NotStored";
pub const PUBLISHED: &str = "Published";
pub const RECORDED: &str = "Recorded";
pub const WAITING: &str = "Waiting";
/// The process before may still have requests under way.
pub const WAITING_FOR_PREVIOUS_CONTROLLER: &str = "WaitingForPreviousController";
pub const REFUSED: &str = "Refused";

// Of a Leaderboard.
pub const READY: &str = "Ready";
pub const TOKEN_MISSING: &str = "TokenMissing";
pub const TOKEN_REFUSED: &str = "TokenRefused";
pub const PHASE_CONFLICT: &str = "PhaseConflict";
pub const PREFIX_CONFLICT: &str = "PrefixConflict";
pub const INVALID_POD: &str = "InvalidPod";
pub const QUEUE_BLOCKED: &str = "QueueBlocked";
pub const IN_USE: &str = "InUse";

// Of a Leaderboard's condition `Isolated`.
pub const ENFORCED: &str = "Enforced";
pub const NOT_ENFORCED: &str = "NotEnforced";
pub const NOT_MEASURED: &str = "NotMeasured";
pub const EXTERNAL: &str = "External";
pub const FORBIDDEN: &str = "Forbidden";
pub const NOT_APPLIED: &str = "NotApplied";

// Events only.
pub const JOB_CREATED: &str = "JobCreated";
pub const JOB_RECREATED: &str = "JobRecreated";
pub const RELEASED_UNPUBLISHED: &str = "ReleasedUnpublished";
/// No message has announced an attempt that EvalAI's row asks for.
pub const ATTEMPT_WITHOUT_MESSAGE: &str = "AttemptWithoutMessage";
/// EvalAI's row belongs to another team than at its acceptance.
pub const TEAM_DIFFERS: &str = "TeamDiffers";
pub const RERUN_IN_EVALAI: &str = "RerunInEvalAI";
/// The challenge's phases, splits or metric labels are not those of the Leaderboard.
pub const LABELS_DIFFER: &str = "LabelsDiffer";
/// The bucket, or what stands in for it, does not answer or refuses.
pub const BUCKET_UNREACHABLE: &str = "BucketUnreachable";
/// The table does not answer, refuses, or has other keys.
pub const TABLE_UNREACHABLE: &str = "TableUnreachable";
/// The queue does not answer or refuses.
pub const QUEUE_UNREACHABLE: &str = "QueueUnreachable";
/// The dead-letter queue does not answer or refuses.
pub const DEAD_LETTER_QUEUE_UNREACHABLE: &str = "DeadLetterQueueUnreachable";
