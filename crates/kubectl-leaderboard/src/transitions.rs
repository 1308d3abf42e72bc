//! What is printed while a person waits for the end of a submission.
//!
//! Called by `main` for each change that the watch reports. Pure: the time is handed in.

use jiff::Timestamp;
use kube::ResourceExt;

use super::text::{WIDTH, wrap};
use leaderboard_api::conditions;
use leaderboard_api::{Attempt, State, Submission};

/// Columns before the text of a transition.
const INDENT: usize = 11;

/// A wait for the end of an attempt.
pub struct Waiting {
    attempt: Attempt,
    width: usize,
    last: Option<(State, String)>,
}

/// What a change of the object means for a wait.
#[derive(Debug, PartialEq, Eq)]
pub struct Update {
    /// What is new, in lines.
    pub lines: Vec<String>,
    /// The state, if it is the end.
    pub end: Option<State>,
}

impl Waiting {
    /// Waits for the end of this attempt, or of a later one.
    pub fn new(attempt: Attempt) -> Self {
        Self {
            attempt,
            width: WIDTH,
            last: None,
        }
    }

    /// The same in lines of this width.
    #[must_use]
    pub fn within(self, width: usize) -> Self {
        Self { width, ..self }
    }

    /// Takes the object as it is now.
    pub fn observe(&mut self, submission: &Submission, now: Timestamp) -> Update {
        let nothing = Update {
            lines: Vec::new(),
            end: None,
        };
        let status = submission.status.as_ref().filter(|s| s.attempt >= Some(self.attempt));
        let Some(status) = status else {
            return nothing;
        };
        let state = status.state_of_conditions();
        let is_over = conditions::is_true(&status.conditions, conditions::FINISHED);
        let end = is_over.then_some(state);
        let reason = status.reason.as_deref().unwrap_or_default().to_owned();
        if self.last.as_ref() == Some(&(state, reason.clone())) {
            return Update { end, ..nothing };
        }
        let message = status.message.as_deref().unwrap_or_default();
        let colon = if message.is_empty() { "" } else { ":" };
        let name = submission.name_any();
        let text = format!("{name} is {} ({reason}){colon} {message}", state.as_str());
        self.last = Some((state, reason));
        Update {
            lines: hang(&now.strftime("%H:%M:%SZ").to_string(), &text, self.width),
            end,
        }
    }
}

fn hang(label: &str, text: &str, width: usize) -> Vec<String> {
    let lines = wrap(text, width.saturating_sub(INDENT));
    let labels = std::iter::once(label).chain(std::iter::repeat(""));
    labels
        .zip(lines)
        .map(|(label, line)| format!("{label:<INDENT$}{line}"))
        .collect()
}
