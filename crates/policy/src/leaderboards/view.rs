//! How the things stand that a Leaderboard names, as `decide` sees them.

use jiff::Timestamp;

use leaderboard_api::Reason;
use leaderboard_api::conditions::Truth;

/// How the template of a Leaderboard stands.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum Claims {
    /// Its workers claim nothing.
    #[default]
    NotRequired,
    InPlace,
    /// The API server does not serve claims.
    NotServed,
    /// It is not there, and why.
    Missing(String),
}

impl Claims {
    /// The Pods have what they claim.
    pub fn is_good(&self) -> bool {
        matches!(self, Self::NotRequired | Self::InPlace)
    }
}

/// The condition of a Leaderboard whose places cannot all be reached.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Unreachable {
    /// Never True.
    pub truth: Truth,
    /// Reason of the gravest problem.
    pub reason: Reason,
    /// Messages of all problems.
    pub message: String,
}

/// How a Leaderboard stands with EvalAI.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum EvalaiStanding {
    NotRequired,
    NoToken(String),
    TokenRefused(String),
    /// Its queue in EvalAI is not read. Refused: waiting alone does not help.
    QueueUnread {
        is_refused: bool,
        why: String,
    },
    /// Its phases or labels do not fit the challenge.
    Misfit(String),
    /// Not checked yet, or EvalAI does not answer.
    Unchecked(Option<String>),
    Fits {
        /// Something to be shown although it works, such as a token that ends soon.
        note: Option<String>,
    },
}

/// Why nothing is written to EvalAI for a moment. A request of a controller that ended without an answer may still be worked on.
pub(crate) fn previous_controller(until: Timestamp) -> String {
    format!(
        "Nothing is written to EvalAI before {} UTC: the previous controller did not confirm its last requests, and they may \
         still be running. Nothing to do.",
        until.strftime("%H:%M:%S")
    )
}

/// How the policy of a Leaderboard stands.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Policy {
    InPlace,
    /// The cluster has its own.
    External,
    /// The API server refuses it, and why.
    Refused(String),
    /// It could not be applied, or came out otherwise, and why.
    NotApplied(String),
}
