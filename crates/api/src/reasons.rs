//! Every reason that a status, a condition or an event can have: its name, its class, what it means, and the next step.
//!
//! One table, with a module for submissions and one for Leaderboards. `docs/states.md` is generated from it (`make docs`),
//! `kubectl leaderboard why` prints it, and the messages of failures take their next step from it. The texts are Markdown with
//! code spans only; [`plain`] removes them. Pure.

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
    /// The condition `Logged`.
    CloudWatch,
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
    all().find(|reason| reason.name == name)
}

/// What a host does once a submission has failed for this reason.
pub fn after_failure(name: &str) -> Option<&'static str> {
    of(name).map(|reason| reason.after_failure.unwrap_or(reason.next_step))
}

/// A text of the table without its code spans.
pub fn plain(text: &str) -> String {
    text.replace('`', "")
}

/// Makes a constant of each name, and the table of a module: a reason cannot be in one of them only.
macro_rules! reasons {
    ($($class:ident { $($constant:ident = $name:literal, $meaning:literal, $next:literal
        $(, after_failure: $after:literal)? $(, log: $log:literal)?;)* })*) => {
        $($(
            #[doc = $meaning]
            pub const $constant: &str = $name;
        )*)*
        pub(super) const TABLE: &[Reason] = &[$($(
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

mod leaderboards;
mod submissions;

pub use leaderboards::*;
pub use submissions::*;

/// All reasons, in the order of docs/states.md.
pub fn all() -> impl Iterator<Item = &'static Reason> {
    submissions::TABLE.iter().chain(leaderboards::TABLE)
}

#[cfg(test)]
mod tests;
