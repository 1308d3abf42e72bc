//! What of a Leaderboard keeps its submissions from starting: missing, paused, not Ready, being deleted.
//!
//! Called by `why`, `overview` and `change`. Pure.

use leaderboard_api::conditions;
use leaderboard_api::text::sentence;
use leaderboard_api::{Leaderboard, reasons};

/// What was seen of a submission's Leaderboard.
#[derive(Clone, Copy, Debug)]
pub enum Sight<'a> {
    There(&'a Leaderboard),
    Missing,
    /// This person may not read Leaderboards.
    Unread,
}

impl<'a> Sight<'a> {
    /// The Leaderboard, if it was seen.
    pub fn leaderboard(self) -> Option<&'a Leaderboard> {
        match self {
            Self::There(leaderboard) => Some(leaderboard),
            Self::Missing | Self::Unread => None,
        }
    }

    /// Whether nothing new starts by the host's will.
    pub(super) fn is_paused(self) -> bool {
        self.leaderboard().is_some_and(|l| l.spec.paused)
    }
}

/// Something that is wrong with a Leaderboard.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Trouble {
    /// A sentence.
    pub words: String,
    /// The reason whose next step mends it.
    pub reason: Option<String>,
}

/// All that is wrong with the Leaderboard of this name.
pub(super) fn troubles(name: &str, sight: Sight<'_>) -> Vec<Trouble> {
    let leaderboard = match sight {
        Sight::There(leaderboard) => leaderboard,
        Sight::Missing => {
            let words = format!("There is no Leaderboard {name} in this namespace: nothing new starts.");
            return vec![trouble(words, Some(reasons::LEADERBOARD_NOT_FOUND))];
        }
        Sight::Unread => {
            let words =
                format!("You may not read Leaderboard {name}, so whether it is paused or not Ready is left out.");
            return vec![trouble(words, None)];
        }
    };
    let mut found = Vec::new();
    if leaderboard.metadata.deletion_timestamp.is_some() {
        let words = format!("Leaderboard {name} is being deleted and waits for its submissions.");
        found.push(trouble(words, Some(reasons::IN_USE)));
    }
    if leaderboard.spec.paused {
        let words = format!("Leaderboard {name} is paused: nothing new starts, and what runs goes on.");
        found.push(trouble(words, Some(reasons::PAUSED)));
    }
    found.extend(not_ready(name, leaderboard));
    found
}

fn not_ready(name: &str, leaderboard: &Leaderboard) -> Option<Trouble> {
    let status = leaderboard.status.as_ref();
    let ready = status.and_then(|status| conditions::get(&status.conditions, conditions::READY));
    let Some(ready) = ready else {
        let words = format!("The operator has not looked at Leaderboard {name} yet. If that lasts, it does not run.");
        return Some(trouble(words, None));
    };
    let what = match ready.status.as_str() {
        "True" => return None,
        "False" => "is not Ready",
        _ => "may not be Ready",
    };
    let colon = if ready.message.is_empty() { "." } else { ": " };
    let words = format!(
        "Leaderboard {name} {what} ({}){colon}{}",
        ready.reason,
        sentence(&ready.message)
    );
    Some(trouble(words, Some(&ready.reason)))
}

fn trouble(words: String, reason: Option<&str>) -> Trouble {
    Trouble {
        words,
        reason: reason.map(str::to_owned),
    }
}
