//! A container's report about its own end, in its termination message. The kubelet copies that message into the container
//! status.
//!
//! Written by the runner, parsed by the controller as hostile text: an agent's processes can write the same file while they
//! live, so an agent's verdict can only count against the agent. Knows no file system.

use serde::de::IntoDeserializer;
use serde::de::value::{Error as ValueError, StrDeserializer};
use serde::{Deserialize, Serialize};
use thiserror::Error;

/// No verdict is longer, in bytes. The containers of a Pod share 12 KiB of termination messages: 16 pairs leave 351 bytes each.
pub const MAX_BYTES: usize = 340;
/// Exit code of a runner whose container was to have a GPU, or a driver to draw with, and has none (EX_UNAVAILABLE). It is the runner's own:
/// no process of the image can bring it about.
pub const CODE_NO_GRAPHICS: i32 = 69;
/// Exit code of a runner whose node refused what it needs before its command ran (EX_OSERR). It counts without a verdict, since no process
/// of the image has run and can have caused it.
pub const CODE_NODE_REFUSED: i32 = 71;
/// The same for want of a process (EX_TEMPFAIL), which the other containers of the Pod can use up.
pub const CODE_NO_PROCESS: i32 = 75;
/// Version of the document.
pub const SCHEMA: u32 = 1;

/// How the command of a container came to its end. The container's exit code (0) and the status files show if its results are
/// complete.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub enum What {
    /// It exited by itself, with `exitCode`.
    Exited,
    /// It died of a signal that the runner did not send, `signal`.
    Killed,
    /// The agent printed nothing for too long and was stopped.
    Idle,
    /// The other side of the pair crashed, so this one was stopped.
    PeerCrashed,
    /// The submission was stopped (`simulation.cancel`), or its results were stored before this container began.
    Cancelled,
    /// The container was ended from outside (SIGTERM).
    Stopped,
    /// The simulator's server did not answer in time, the evaluator did not listen in time, or the agent's host did not come.
    NotReady,
    /// The evaluator's agent is done, or has forged that it is, or it has none, and no complete result came in time.
    NoResult,
    /// The agent crashed, and at that moment the simulator's server did not answer any more.
    ServerSilent,
    /// Another process of the Pod has taken a port of the simulator's server or of the evaluator.
    PortTaken,
    /// The host's container, or its agent, was to have a GPU and sees none. A host's word for both; of an agent it counts for nothing
    /// without [`CODE_NO_GRAPHICS`].
    NoGpu,
    /// The simulator sees a GPU, and no driver for what its server draws with.
    GraphicsDriverMissing,
    /// The command could not be started, or the status folder could not be written.
    CannotStart,
    /// The node refused what the command needs to start: files, memory, a disk that works.
    NodeRefused,
    /// No process was left for the command.
    NoProcess,
    /// Written first and replaced at the end: it stays when the runner is killed.
    SilentDeath,
    /// The results are complete: the orderly end of a simulator, of an evaluator, and of an agent that its evaluator has ended.
    Finished,
}

/// The verdict. Its fields are in the order of their importance, since a message that is too long loses its end.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Verdict {
    /// How it ended.
    pub what: What,
    /// The round that ended: crashes of this side before it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub round: Option<u32>,
    /// [`SCHEMA`].
    pub schema: u32,
    /// The command's exit code, 0–255, if it exited.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub exit_code: Option<i32>,
    /// The signal the command died of, if it did.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub signal: Option<i32>,
    /// The kernel killed a process of this container for lack of memory while the command ran.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub out_of_memory: bool,
    /// One sentence for people.
    #[serde(default)]
    pub why: String,
}

/// A termination message that is no verdict.
#[derive(Debug, Error)]
pub enum NotAVerdict {
    /// Longer than any version writes.
    #[error("the termination message is longer than a verdict can be ({0} bytes)")]
    TooLong(usize),
    /// A schema number that this version does not read.
    #[error("the verdict has schema {0}; this version reads {SCHEMA}")]
    Schema(u32),
    /// Not the JSON of a verdict.
    #[error("the termination message is no verdict: {0}")]
    Malformed(#[from] serde_json::Error),
}

impl Verdict {
    /// A verdict of this version without numbers.
    pub fn new(what: What, round: u32, why: impl Into<String>) -> Self {
        Self {
            what,
            round: Some(round),
            schema: SCHEMA,
            exit_code: None,
            signal: None,
            out_of_memory: false,
            why: why.into(),
        }
    }

    /// The verdict that stands until another replaces it.
    pub fn silent_death(round: u32) -> Self {
        let why = "the container was killed before its runner could report why";
        Self::new(What::SilentDeath, round, why)
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

    /// Parses a container's termination message. One whose end is missing is read as far as it goes.
    pub fn parse(message: &str) -> Result<Self, NotAVerdict> {
        if message.len() > MAX_BYTES {
            return Err(NotAVerdict::TooLong(message.len()));
        }
        let verdict: Self = match serde_json::from_str(message) {
            Ok(verdict) => verdict,
            Err(error) => Self::of_beginning(message).ok_or(error)?,
        };
        if verdict.schema != SCHEMA {
            return Err(NotAVerdict::Schema(verdict.schema));
        }
        Ok(verdict)
    }

    /// The fields in the beginning of a verdict whose end is missing. A number without its end may lack digits, so it does not count.
    fn of_beginning(message: &str) -> Option<Self> {
        let (what, rest) = message.strip_prefix(r#"{"what":""#)?.split_once('"')?;
        let what: StrDeserializer<'_, ValueError> = what.into_deserializer();
        let round = rest.strip_prefix(r#","round":"#).and_then(|rest| rest.split_once(','));
        Some(Self {
            round: round.and_then(|(round, _)| round.parse().ok()),
            ..Self::new(What::deserialize(what).ok()?, 0, "")
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const GOLDEN: &str = r#"{"what":"peerCrashed","round":12,"schema":1,"signal":15,"why":"w"}"#;

    fn followed() -> Verdict {
        Verdict {
            signal: Some(15),
            ..Verdict::new(What::PeerCrashed, 12, "w")
        }
    }

    #[test]
    fn the_json_is_the_documented_one() {
        assert_eq!(followed().to_json(), GOLDEN);
        assert_eq!(Verdict::parse(GOLDEN).unwrap(), followed());
        let out_of_memory = Verdict {
            out_of_memory: true,
            ..followed()
        };
        assert!(out_of_memory.to_json().contains(r#""outOfMemory":true"#));
        assert_eq!(Verdict::parse(&out_of_memory.to_json()).unwrap(), out_of_memory);
        for other in [0, 2] {
            let json = GOLDEN.replace("\"schema\":1", &format!("\"schema\":{other}"));
            assert!(matches!(Verdict::parse(&json), Err(NotAVerdict::Schema(found)) if found == other));
        }
    }

    #[test]
    fn a_long_reason_is_cut_below_the_limit_whatever_its_characters() {
        for filler in ["a", "\u{1}", "é", "\"", "🚗"] {
            let verdict = Verdict {
                exit_code: Some(255),
                signal: Some(64),
                out_of_memory: true,
                ..Verdict::new(What::PeerCrashed, 1000, filler.repeat(5000))
            };
            let json = verdict.to_json();
            assert!(json.len() <= MAX_BYTES, "{} bytes", json.len());
            assert!(Verdict::parse(&json).unwrap().why.starts_with(filler));
        }
    }

    #[test]
    fn a_cut_verdict_is_read_as_far_as_it_goes() {
        let json = followed().to_json();
        for (cut, round) in [
            (r#"{"what":"peerCrashed","#, None),
            (r#"{"what":"peerCrashed","round":1"#, None),
            (r#"{"what":"peerCrashed","round":12"#, None),
            (r#"{"what":"peerCrashed","round":12,"#, Some(12)),
            (&json[..json.len() - 3], Some(12)),
        ] {
            assert!(json.starts_with(cut));
            let verdict = Verdict::parse(cut).unwrap();
            assert_eq!((verdict.what, verdict.round), (What::PeerCrashed, round), "{cut}");
        }
        assert!(Verdict::parse(r#"{"what":"peerCra"#).is_err());
    }

    #[test]
    fn what_is_no_verdict_is_refused() {
        for message in [
            "",
            "Error",
            "{}",
            r#"{"what":"won","why":""}"#,
            r#"{"why":"idle"}"#,
            &"x".repeat(5000),
        ] {
            assert!(Verdict::parse(message).is_err(), "{message}");
        }
    }
}
