//! Every reason that a status, a condition or an event can have: its name, its class, what it means, and the next step.
//!
//! One table. `docs/states.md` is generated from it (`make docs`),
//! `kubectl leaderboard why` prints it, and the messages of failures take their next step from it. The texts are Markdown with
//! code spans, and pages as `docs/gpu.md`; [`plain`] makes them plain. Pure.

use std::fmt;

use serde::{Serialize, Serializer};

use crate::DOCUMENTS;

/// The kind of thing that a reason explains. Each class is one table of docs/states.md.
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
    /// The condition `Logged`.
    CloudWatch,
    /// An event, and no state or condition.
    Event,
    /// The conditions `Ready` and `Terminating` of a Leaderboard.
    Leaderboard,
    /// The condition `Isolated` of a Leaderboard.
    Isolation,
}

/// The row of a reason.
struct Row {
    name: &'static str,
    class: Class,
    meaning: &'static str,
    next_step: &'static str,
    after_failure: Option<&'static str>,
    log: Option<&'static str>,
}

impl Reason {
    /// The reason of this name.
    pub fn of(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|reason| reason.as_str() == name)
    }

    /// As it stands in `reason`.
    pub fn as_str(self) -> &'static str {
        self.row().name
    }

    /// The kind of thing that the reason explains.
    pub fn class(self) -> Class {
        self.row().class
    }

    /// The meaning of the reason, in sentences.
    pub fn meaning(self) -> &'static str {
        self.row().meaning
    }

    /// The step to take next, in sentences.
    pub fn next_step(self) -> &'static str {
        self.row().next_step
    }

    /// The step for a host once a submission has failed for this reason, in sentences.
    pub fn after_failure(self) -> &'static str {
        self.own_after_failure().unwrap_or(self.next_step())
    }

    /// The step after a failure, if it differs from [`Reason::next_step`].
    fn own_after_failure(self) -> Option<&'static str> {
        self.row().after_failure
    }

    /// Whose log explains a failure for this reason, if one does; `<n>` is the number of the worker.
    pub fn log(self) -> Option<&'static str> {
        self.row().log
    }
}

impl fmt::Display for Reason {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(self.as_str())
    }
}

impl Serialize for Reason {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.as_str())
    }
}

/// A text of the table without its code spans, its pages as addresses.
pub fn plain(text: &str) -> String {
    text.replace('`', "").replace("docs/", DOCUMENTS)
}

/// Makes the enum and its table: a reason cannot be in one of them only.
macro_rules! reasons {
    ($($class:ident { $($reason:ident, $meaning:literal, $next:literal
        $(, after_failure: $after:literal)? $(, log: $log:literal)?;)* })*) => {
        /// Every reason, in the order of docs/states.md.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
        pub enum Reason {
            $($(#[doc = $meaning] $reason,)*)*
        }

        impl Reason {
            /// All reasons, in the order of docs/states.md.
            pub const ALL: [Self; [$($(Self::$reason,)*)*].len()] = [$($(Self::$reason,)*)*];

            pub(super) fn row(self) -> &'static Row {
                match self {
                    $($(Self::$reason => &Row {
                        name: stringify!($reason),
                        class: Class::$class,
                        meaning: $meaning,
                        next_step: $next,
                        after_failure: optional!($($after)?),
                        log: optional!($($log)?),
                    },)*)*
                }
            }
        }
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

mod name;
mod table;

pub use name::ReasonName;
pub use table::Reason;

#[cfg(test)]
mod tests;
