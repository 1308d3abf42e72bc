//! Reasons of a Leaderboard that keep its submissions from starting: it is missing, paused, not Ready or being deleted.
//!
//! Called by `why`, `overview` and `change`. Pure.

use super::text::Page;
use leaderboard_api::conditions;
use leaderboard_api::text::sentence;
use leaderboard_api::{Leaderboard, Reason};

/// The Leaderboard of a submission, as far as this person can read it.
#[derive(Clone, Copy, Debug)]
pub enum Observed<'a> {
    Found(&'a Leaderboard),
    Missing,
    /// This person has no right to read Leaderboards.
    Forbidden,
}

impl<'a> Observed<'a> {
    /// The Leaderboard, if it could be read.
    pub fn leaderboard(self) -> Option<&'a Leaderboard> {
        match self {
            Self::Found(leaderboard) => Some(leaderboard),
            Self::Missing | Self::Forbidden => None,
        }
    }
}

/// A sentence about what is wrong with a Leaderboard, and the reason whose next step fixes it.
pub(super) type Problem = (String, Option<Reason>);

/// All that is wrong with the Leaderboard of this name.
pub(super) fn problems(name: &str, observed: Observed<'_>) -> Vec<Problem> {
    let leaderboard = match observed {
        Observed::Found(leaderboard) => leaderboard,
        Observed::Missing => {
            let text = format!("There is no Leaderboard {name} in this namespace: nothing new starts.");
            return vec![(text, Some(Reason::LeaderboardNotFound))];
        }
        Observed::Forbidden => {
            let text = format!("You have no right to read Leaderboard {name}; it may be paused or not Ready.");
            return vec![(text, None)];
        }
    };
    let mut found = Vec::new();
    if leaderboard.metadata.deletion_timestamp.is_some() {
        let text = format!("Leaderboard {name} is being deleted and waits for its submissions.");
        found.push((text, Some(Reason::InUse)));
    }
    if leaderboard.spec.paused {
        let text = format!("Leaderboard {name} is paused: nothing new starts, and running submissions continue.");
        found.push((text, Some(Reason::Paused)));
    }
    found.extend(not_ready(name, leaderboard));
    found
}

/// Writes a paragraph for each thing that is wrong with the Leaderboard of this name.
pub(super) fn show_problems(page: &mut Page, name: &str, observed: Observed<'_>) {
    for (text, _) in problems(name, observed) {
        page.paragraph(&text);
    }
}

fn not_ready(name: &str, leaderboard: &Leaderboard) -> Option<Problem> {
    let status = leaderboard.status.as_ref();
    let ready = status.and_then(|status| conditions::get(&status.conditions, conditions::READY));
    let Some(ready) = ready else {
        let text = format!(
            "The operator has not processed Leaderboard {name} yet. If that lasts, check that the operator runs."
        );
        return Some((text, None));
    };
    let what = match ready.status.as_str() {
        "True" => return None,
        "False" => "is not Ready",
        _ => "may not be Ready",
    };
    let colon = if ready.message.is_empty() { "." } else { ": " };
    let text = format!(
        "Leaderboard {name} {what} ({}){colon}{}",
        ready.reason,
        sentence(&ready.message)
    );
    Some((text, ready.reason.known()))
}
