//! What a container says about its own end, in `/dev/termination-log`, from where the kubelet copies it into the container
//! status.
//!
//! Written by the runner, parsed by the controller as hostile text (the agent's processes can write the same file while
//! they live; the runner has the last word). Knows no file system.

use serde::{Deserialize, Serialize};
use thiserror::Error;

/// No verdict is longer, in bytes. Eleven containers share 12 KiB; at nine each may have 1365.
pub const MAX_BYTES: usize = 1000;

/// How the command of a container came to its end. Whether its results are complete is told by the container's exit code
/// (0) and by the status files.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub enum What {
    /// It exited by itself, with `exitCode`.
    Exited,
    /// It died of a signal nobody of us sent, `signal`.
    Killed,
    /// The agent printed nothing for too long and was stopped.
    Idle,
    /// The other side of the pair crashed, so this one was stopped.
    PeerCrashed,
    /// The submission was stopped (`simulation.cancel`), or its results were stored before this container began.
    Cancelled,
    /// The container was told to end from outside (SIGTERM).
    Stopped,
    /// The simulator's server did not answer in time, or the agent's simulator did not come.
    NotReady,
    /// The command could not be started, or the status folder could not be written.
    CannotStart,
    /// Written first and replaced at the end: who reads it sees a runner that was killed without a word.
    SilentDeath,
    /// The simulator's agent is done: the orderly end of a simulator.
    Finished,
}

/// The verdict.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Verdict {
    /// How it ended.
    pub what: What,
    /// The command's exit code, 0–255, if it exited.
    #[serde(default)]
    pub exit_code: Option<i32>,
    /// The signal the command died of, if it did.
    #[serde(default)]
    pub signal: Option<i32>,
    /// The kernel killed a process of this container for lack of memory while the command ran.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub out_of_memory: bool,
    /// One sentence for people.
    pub why: String,
}

/// A termination message that is no verdict.
#[derive(Debug, Error)]
pub enum NotAVerdict {
    /// Longer than [`MAX_BYTES`].
    #[error("the termination message is longer than a verdict can be ({0} bytes)")]
    TooLong(usize),
    /// Not the JSON of a verdict.
    #[error("the termination message is no verdict: {0}")]
    Malformed(#[from] serde_json::Error),
}

impl Verdict {
    /// The verdict that stands until another replaces it.
    pub fn silent_death() -> Self {
        Self {
            what: What::SilentDeath,
            exit_code: None,
            signal: None,
            out_of_memory: false,
            why: "the container was killed before its runner could say why".to_owned(),
        }
    }

    /// Its JSON, at most [`MAX_BYTES`]; a longer `why` is cut.
    pub fn to_json(&self) -> String {
        let mut verdict = self.clone();
        loop {
            let json = serde_json::to_string(&verdict).unwrap_or_default();
            if json.len() <= MAX_BYTES || verdict.why.is_empty() {
                return json;
            }
            let keep = verdict.why.chars().count() * 3 / 4;
            verdict.why = verdict.why.chars().take(keep).collect();
        }
    }

    /// Parses a container's termination message.
    pub fn parse(message: &str) -> Result<Self, NotAVerdict> {
        if message.len() > MAX_BYTES {
            return Err(NotAVerdict::TooLong(message.len()));
        }
        Ok(serde_json::from_str(message)?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_json_is_the_documented_one() {
        let verdict = Verdict {
            what: What::PeerCrashed,
            exit_code: None,
            signal: Some(15),
            out_of_memory: false,
            why: "w".to_owned(),
        };
        assert_eq!(
            verdict.to_json(),
            r#"{"what":"peerCrashed","exitCode":null,"signal":15,"why":"w"}"#
        );
        assert_eq!(Verdict::parse(&verdict.to_json()).unwrap(), verdict);
        let out_of_memory = Verdict {
            out_of_memory: true,
            ..verdict
        };
        assert!(out_of_memory.to_json().contains(r#""outOfMemory":true"#));
        assert_eq!(Verdict::parse(&out_of_memory.to_json()).unwrap(), out_of_memory);
    }

    #[test]
    fn a_long_reason_is_cut_below_the_limit_whatever_its_characters() {
        for filler in ["a", "\u{1}", "é", "\"", "🚗"] {
            let verdict = Verdict {
                why: filler.repeat(5000),
                ..Verdict::silent_death()
            };
            let json = verdict.to_json();
            assert!(json.len() <= MAX_BYTES, "{} bytes", json.len());
            assert!(Verdict::parse(&json).unwrap().why.starts_with(filler));
        }
    }

    #[test]
    fn what_is_no_verdict_is_refused() {
        for message in [
            "",
            "Error",
            "{}",
            r#"{"what":"won","why":""}"#,
            r#"{"what":"idle"}"#,
            &"x".repeat(5000),
        ] {
            assert!(Verdict::parse(message).is_err(), "{message}");
        }
    }
}
