//! The outcome of each message: all of the bridge's policy, as pure functions.
//!
//! Called by the poller. Knows no queue, no cluster and no clock: times are handed in as milliseconds since 1970.

use std::sync::Arc;

use super::message::{Malformed, Message, STATIC_CODE_UPLOAD};
use leaderboard_api::{Attempt, EvaluationMode, Foreign, Leaderboard, ResourceExt, SqsQueue};

/// First wait of a message that can't be used yet, in seconds; it doubles with each receive.
const FIRST_WAIT: i32 = 30;
/// Longest wait of a message, in seconds.
pub const LONGEST_WAIT: i32 = 900;
/// Longest wait of a message that another reader may want, or whose old object is going away, in seconds.
const SHORT_WAIT: i32 = 60;

/// A message as the policy sees it.
#[derive(Clone, Debug)]
pub struct Envelope {
    /// The parsed message, or why it cannot be parsed.
    pub content: Result<Message, Malformed>,
    /// When it was sent.
    pub sent_ms: i64,
    /// How often it has been received, this time included.
    pub receives: i32,
    /// Why it makes no Submission, whatever it holds.
    pub hindrance: Option<Hindrance>,
}

/// Why a message makes no Submission.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Hindrance {
    /// Its submission is not there to be run, for this reason.
    Unusable(String),
    /// EvalAI does not show its submission now.
    Hidden,
}

/// The rules for the messages of a queue, from all Leaderboards that share it.
#[derive(Clone, Debug, PartialEq, Eq, Default)]
pub struct Rules {
    /// Where messages go that can't be used: the oldest Leaderboard's that names one.
    pub dead_letter: Option<String>,
    /// How long a message may wait for its Leaderboard, in milliseconds: the longest of all.
    pub unknown_after_ms: i64,
    /// True if any of them leaves foreign messages to another reader.
    pub leaves_foreign: bool,
    /// True if other challenges may have the same queue: an EvalAI in debug mode has one for all.
    pub is_common: bool,
}

/// Why a message goes to the dead-letter queue.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum DeadReason {
    /// It is no message of EvalAI that can be run.
    Malformed(String),
    /// No Leaderboard serves its challenge and phase.
    Unknown(String),
    /// The name of its Submission belongs to another one.
    IdTaken(String),
    /// The API server refuses its Submission.
    Refused(String),
}

impl DeadReason {
    /// The attribute `reason` of the dead letter.
    pub fn as_str(&self) -> &'static str {
        match self {
            Self::Malformed(_) => "Malformed",
            Self::Unknown(_) => "UnknownPhase",
            Self::IdTaken(_) => "IdTaken",
            Self::Refused(_) => "Refused",
        }
    }

    /// The attribute `detail` of the dead letter: a sentence.
    pub fn detail(&self) -> &str {
        match self {
            Self::Malformed(text) | Self::Unknown(text) | Self::IdTaken(text) | Self::Refused(text) => text,
        }
    }
}

/// All that becomes of messages, as the metric's label has it.
pub const OUTCOMES: [&str; 11] = [
    "dead_letter",
    "created",
    "bumped",
    "repeat",
    "retried",
    "unknown",
    "foreign",
    "deleting",
    "stopping",
    "refused",
    "blocked",
];

/// The outcome of a message.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum MessageOutcome {
    /// It is for this Leaderboard.
    Ingest { namespace: String, leaderboard: String },
    /// It can't be used.
    Dead(DeadReason),
    /// It comes back after so many seconds.
    Later { seconds: i32, why: Later },
    /// It is done with.
    Delete(Done),
    /// It comes back when its visibility lapses.
    Lapse,
}

/// Why a message comes back later.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Later {
    /// Its Leaderboard may yet be applied.
    Unknown,
    /// It is for another reader of the queue.
    Foreign,
    /// Its Submission's predecessor is being deleted.
    Deleting,
    /// The attempt before it is being stopped.
    Stopping,
    /// The API server refused its Submission.
    Refused,
    /// It belongs in a dead-letter queue, and the queue has none.
    Blocked,
}

/// Why a message is done with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Done {
    Created,
    Bumped,
    Repeat,
}

impl MessageOutcome {
    /// The value of the metric's label.
    pub fn as_str(&self) -> &'static str {
        match self {
            Self::Ingest { .. } => "ingest",
            Self::Dead(_) => "dead_letter",
            Self::Delete(Done::Created) => "created",
            Self::Delete(Done::Bumped) => "bumped",
            Self::Delete(Done::Repeat) => "repeat",
            Self::Lapse => "retried",
            Self::Later { why, .. } => match why {
                Later::Unknown => "unknown",
                Later::Foreign => "foreign",
                Later::Deleting => "deleting",
                Later::Stopping => "stopping",
                Later::Refused => "refused",
                Later::Blocked => "blocked",
            },
        }
    }
}

/// The Leaderboards that read a queue, the oldest first. One that is being deleted takes no further message.
pub fn readers(url: &str, leaderboards: &[Arc<Leaderboard>]) -> Vec<Arc<Leaderboard>> {
    let mut readers: Vec<_> = leaderboards
        .iter()
        .filter(|lb| lb.metadata.deletion_timestamp.is_none())
        .filter(|lb| lb.spec.evalai.is_some() && queue_of(lb).is_some_and(|queue| queue.url == url))
        .cloned()
        .collect();
    readers.sort_by_key(|lb| lb.seniority());
    readers
}

/// The queue of a Leaderboard that takes messages.
pub fn queue_of(leaderboard: &Leaderboard) -> Option<&SqsQueue> {
    leaderboard.spec.sqs()
}

/// The rules of a queue, from all its readers, the oldest first.
pub fn rules(readers: &[Arc<Leaderboard>]) -> Rules {
    let queues = || readers.iter().filter_map(|lb| queue_of(lb));
    Rules {
        dead_letter: queues().find_map(|queue| queue.dead_letter_url.clone()),
        unknown_after_ms: queues()
            .map(|queue| queue.unknown_after_seconds)
            .max()
            .unwrap_or_default()
            * 1000,
        leaves_foreign: queues().any(|queue| queue.foreign == Foreign::Leave),
        is_common: false,
    }
}

/// Finds the Leaderboard of a message. `readers` are the queue's, the oldest first; `is_complete`: none can be missing.
pub fn route(
    rules: &Rules,
    envelope: &Envelope,
    readers: &[Arc<Leaderboard>],
    now_ms: i64,
    is_complete: bool,
) -> MessageOutcome {
    // The last Leaderboard of the queue is being deleted: the next reader decides.
    if readers.is_empty() {
        return MessageOutcome::Lapse;
    }
    let message = match &envelope.content {
        Ok(message) => message,
        Err(malformed) => return MessageOutcome::Dead(DeadReason::Malformed(malformed.to_string())),
    };
    let is_of_reader =
        |lb: &Arc<Leaderboard>| (lb.spec.evalai.as_ref()).is_some_and(|e| e.challenge == message.challenge);
    if rules.is_common && !readers.iter().any(is_of_reader) {
        return later(envelope.receives, SHORT_WAIT, Later::Foreign);
    }
    match &envelope.hindrance {
        Some(Hindrance::Unusable(why)) => return MessageOutcome::Dead(DeadReason::Malformed(why.clone())),
        Some(Hindrance::Hidden) => return MessageOutcome::Lapse,
        None => {}
    }
    if let Some(leaderboard) = readers.iter().find(|lb| lb.serves(message.challenge, message.phase)) {
        return match misfit(message.is_static_code_upload, leaderboard) {
            None => MessageOutcome::Ingest {
                namespace: leaderboard.namespace().unwrap_or_default(),
                leaderboard: leaderboard.name_any(),
            },
            // The other reader of the queue may evaluate it.
            Some(_) if rules.leaves_foreign => later(envelope.receives, SHORT_WAIT, Later::Foreign),
            Some(why) => MessageOutcome::Dead(DeadReason::Malformed(why)),
        };
    }
    if rules.leaves_foreign {
        return later(envelope.receives, SHORT_WAIT, Later::Foreign);
    }
    if !is_complete || !is_overdue(envelope, rules, now_ms) {
        return later(envelope.receives, LONGEST_WAIT, Later::Unknown);
    }
    MessageOutcome::Dead(DeadReason::Unknown(format!(
        "no Leaderboard that reads this queue serves challenge {}, phase {}",
        message.challenge, message.phase
    )))
}

/// Why a Leaderboard cannot run a submission of this kind.
pub fn misfit(is_static_code_upload: bool, leaderboard: &Leaderboard) -> Option<String> {
    let mode = leaderboard.spec.evaluation.container().map(|container| container.mode);
    if !is_static_code_upload || mode == Some(EvaluationMode::Batch) {
        return None;
    }
    let name = leaderboard.name_any();
    let kind = mode.map_or_else(|| "evaluation.carla".to_owned(), |mode| format!("the mode {mode:?}"));
    Some(format!(
        "{STATIC_CODE_UPLOAD} is set, and the Leaderboard {name} has {kind}: such submissions need evaluation.container with the mode Batch"
    ))
}

/// The outcome of a message after its Submission was, or could not be, created or bumped.
pub fn settle(
    envelope: &Envelope,
    outcome: &Result<Outcome, NotIngested>,
    rules: &Rules,
    now_ms: i64,
) -> MessageOutcome {
    match outcome {
        Ok(Outcome::Created) => MessageOutcome::Delete(Done::Created),
        Ok(Outcome::Bumped(_)) => MessageOutcome::Delete(Done::Bumped),
        Ok(Outcome::Repeat | Outcome::Refused | Outcome::NotNew) => MessageOutcome::Delete(Done::Repeat),
        Ok(Outcome::Deleting) => later(envelope.receives, SHORT_WAIT, Later::Deleting),
        Ok(Outcome::Stopping) => later(envelope.receives, SHORT_WAIT, Later::Stopping),
        Ok(Outcome::IdTaken(owner)) => MessageOutcome::Dead(DeadReason::IdTaken(owner.clone())),
        // Definitions that are newer or older than this program may refuse what others accept.
        Err(NotIngested::Refused(_)) if !is_overdue(envelope, rules, now_ms) => {
            later(envelope.receives, LONGEST_WAIT, Later::Refused)
        }
        Err(NotIngested::Refused(text)) => MessageOutcome::Dead(DeadReason::Refused(text.clone())),
        Err(NotIngested::Unknown) => MessageOutcome::Lapse,
    }
}

/// A dead letter without a dead-letter queue comes back ever more slowly.
pub fn blocked(receives: i32) -> MessageOutcome {
    later(receives, LONGEST_WAIT, Later::Blocked)
}

fn is_overdue(envelope: &Envelope, rules: &Rules, now_ms: i64) -> bool {
    now_ms.saturating_sub(envelope.sent_ms) > rules.unknown_after_ms
}

fn later(receives: i32, longest: i32, why: Later) -> MessageOutcome {
    let doublings = u32::try_from(receives - 1).unwrap_or(0).min(10);
    MessageOutcome::Later {
        seconds: (FIRST_WAIT << doublings).min(longest),
        why,
    }
}

/// Why there is no outcome.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum NotIngested {
    /// The API server refuses the Submission, in its own words.
    Refused(String),
    /// It may pass.
    Unknown,
}

/// The change that a message made, or why it made none.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// A Submission was created.
    Created,
    /// Its attempt was raised to this number.
    Bumped(Attempt),
    /// The attempt that is asked for does not begin, which is noted.
    Refused,
    /// EvalAI's row was run before, and no message has announced that it is to be run again: none is made.
    NotNew,
    /// It was known already.
    Repeat,
    /// The old one is being deleted: come back when it is gone.
    Deleting,
    /// Its present attempt is being stopped: come back when that has ended.
    Stopping,
    /// The name belongs to another leaderboard, challenge or phase; the text names them.
    IdTaken(String),
}

impl std::fmt::Display for Outcome {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Created => f.write_str("created"),
            Self::Bumped(attempt) => write!(f, "resumed as attempt {attempt}"),
            Self::Refused => {
                f.write_str("it has ended, and no further attempt begins; its condition Stalled shows why")
            }
            Self::NotNew => f.write_str("it was run before and no message has announced another run, so none is made"),
            Self::Repeat => f.write_str("known already"),
            Self::Deleting => f.write_str("the old one is still being deleted"),
            Self::Stopping => f.write_str("its present attempt is still being stopped"),
            Self::IdTaken(owner) => write!(f, "the name is taken by {owner}; rename or delete that"),
        }
    }
}

#[cfg(test)]
mod tests;
