//! The place in line, and how long it may take.
//!
//! Part of a Submission's status. Pure.

use std::fmt;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Place of the submission in the line for a slot.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq, Eq)]
#[serde(rename_all = "camelCase")]
pub struct Waiting {
    /// Place in the line, from 1.
    pub position: i32,
    /// Seconds until it starts, at the least; absent until runs of this track have ended, and while the Leaderboard is paused.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub eta_min_seconds: Option<i64>,
    /// Seconds until it starts, at the most.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub eta_max_seconds: Option<i64>,
    /// For people: `3rd, 20-35 min`.
    #[schemars(length(max = 64))]
    pub text: String,
}

impl Waiting {
    /// A place and how long it may take.
    pub fn new(position: i32, eta: Option<Eta>) -> Self {
        let ending = match (position % 10, position % 100) {
            (1, 1 | 21..) => "st",
            (2, 2 | 22..) => "nd",
            (3, 3 | 23..) => "rd",
            _ => "th",
        };
        let eta_text = eta.map(|eta| format!(", {eta}")).unwrap_or_default();
        Self {
            position,
            eta_min_seconds: eta.map(|eta| eta.min_seconds),
            eta_max_seconds: eta.map(|eta| eta.max_seconds),
            text: format!("{position}{ending}{eta_text}"),
        }
    }

    /// How long it may take.
    pub fn eta(&self) -> Option<Eta> {
        Some(Eta {
            min_seconds: self.eta_min_seconds?,
            max_seconds: self.eta_max_seconds?,
        })
    }
}

/// How long a wait may take, no finer than an estimate can be: whole steps of the unit that people read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Eta {
    /// At the least.
    pub min_seconds: i64,
    /// At the most.
    pub max_seconds: i64,
}

const MINUTE: i64 = 60;
const HOUR: i64 = 60 * MINUTE;
const DAY: i64 = 24 * HOUR;

impl Eta {
    /// Rounds both to what is shown.
    pub fn between(min_seconds: i64, max_seconds: i64) -> Self {
        let step = match max_seconds {
            ..=600 => MINUTE,
            601..=5_400 => 5 * MINUTE,
            5_401..=172_800 => HOUR,
            _ => DAY,
        };
        Self {
            min_seconds: min_seconds.max(0) / step * step,
            max_seconds: (max_seconds.max(1) + step - 1) / step * step,
        }
    }
}

/// `20-35 min`.
impl fmt::Display for Eta {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (unit, word) = match self.max_seconds {
            ..=5_400 => (MINUTE, "min"),
            5_401..=172_800 => (HOUR, "h"),
            _ => (DAY, "d"),
        };
        write!(out, "{}-{} {word}", self.min_seconds / unit, self.max_seconds / unit)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_place_in_line_reads_as_people_say_it() {
        let texts = [1, 2, 3, 4, 11, 12, 13, 21, 22, 101, 111, 123].map(|position| Waiting::new(position, None).text);
        let expected = [
            "1st", "2nd", "3rd", "4th", "11th", "12th", "13th", "21st", "22nd", "101st", "111th", "123rd",
        ];
        assert_eq!(texts, expected);
        let waiting = Waiting::new(3, Some(Eta::between(1201, 2000)));
        assert_eq!(waiting.text, "3rd, 20-35 min");
        assert_eq!(
            (waiting.eta_min_seconds, waiting.eta_max_seconds),
            (Some(1200), Some(2100))
        );
        assert_eq!(waiting.eta(), Some(Eta::between(1200, 2100)));
    }
}
