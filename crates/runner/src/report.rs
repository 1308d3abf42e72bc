//! The verdict: its sentence, and writing it where the kubelet finds it. Called by `run`.

use std::fs::OpenOptions;
use std::io::{ErrorKind, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

use leaderboard_protocol::verdict::{Verdict, What};
use nix::fcntl::OFlag;

use crate::checkpoint::{Checkpoint, Unreadable};
use crate::decide::{Cause, Part};
use crate::group::Status;

/// An end, as far as it is known.
#[derive(Debug)]
pub(crate) struct End<'a> {
    pub(crate) part: Part,
    pub(crate) round: u32,
    /// True if the container has no peer.
    pub(crate) alone: bool,
    pub(crate) cause: Cause,
    /// How the command ended, if it was started.
    pub(crate) status: Option<Status>,
    pub(crate) out_of_memory: bool,
    /// The state of its results, if they were looked at.
    pub(crate) left: Option<String>,
    /// Error, for the causes that are errors.
    pub(crate) detail: Option<&'a str>,
}

impl<'a> End<'a> {
    /// Without what only the command and its results show.
    pub(crate) fn of(part: Part, round: u32, cause: Cause, detail: Option<&'a str>) -> Self {
        Self {
            part,
            round,
            alone: false,
            cause,
            status: None,
            out_of_memory: false,
            left: None,
            detail,
        }
    }
}

/// The verdict on it.
pub(crate) fn verdict(end: &End<'_>) -> Verdict {
    let (exit_code, signal) = match end.status {
        Some(Status::Exited(code)) => (Some(code), None),
        Some(Status::Killed(signal)) => (None, signal),
        None => (None, None),
    };
    let (what, mut why) = described(end);
    if end.out_of_memory {
        why.push_str("; the kernel killed a process of this container for lack of memory");
    }
    if let Some(left) = &end.left {
        why.push_str("; ");
        why.push_str(left);
    }
    Verdict {
        exit_code,
        signal,
        out_of_memory: end.out_of_memory,
        ..Verdict::new(what, end.round, why)
    }
}

/// Name of an end, and its sentence.
fn described(end: &End<'_>) -> (What, String) {
    let (own, peer) = (noun(end.part), peer(end.part));
    let detail = || end.detail.unwrap_or("the command could not be started").to_owned();
    match end.cause {
        Cause::Terminated => (What::Stopped, "the container was ended from outside".to_owned()),
        Cause::AlreadyDone => (
            What::Finished,
            "the worker was done before this container began".to_owned(),
        ),
        Cause::HasResult => (What::Finished, "the evaluation has come to its end".to_owned()),
        Cause::PeerDone => (What::Finished, format!("the {peer} is done, so the {own} was stopped")),
        Cause::NoResult => {
            let done = if end.alone { "" } else { "the agent is done, and " };
            (What::NoResult, format!("{done}the evaluator had no complete result in time"))
        }
        Cause::PeerCrashed => (What::PeerCrashed, format!("the {peer} crashed, so the {own} was stopped")),
        Cause::Cancelled => (What::Cancelled, "the submission was stopped".to_owned()),
        Cause::Idle => (What::Idle, "the agent printed nothing for too long and was stopped".to_owned()),
        Cause::NotReady if end.part.is_host() => {
            (What::NotReady, format!("the {own} did not answer on its port in time"))
        }
        Cause::NotReady => (What::NotReady, format!("the {peer} was not ready in time")),
        Cause::ServerSilent => (
            What::ServerSilent,
            "the agent crashed, and the server does not answer any more".to_owned(),
        ),
        Cause::AgentHasNoGpu => (
            What::NoGpu,
            "the agent's container sees no GPU (no /dev/nvidia0 or any other number), and its Leaderboard gives it one; it was not begun"
                .to_owned(),
        ),
        Cause::PortTaken => (What::PortTaken, detail()),
        Cause::CannotStart(_) | Cause::Mute => (What::CannotStart, detail()),
        Cause::NodeRefused => (What::NodeRefused, detail()),
        Cause::NoProcess => (What::NoProcess, detail()),
        Cause::NoGpu => (What::NoGpu, detail()),
        Cause::GraphicsDriverMissing => (What::GraphicsDriverMissing, detail()),
        Cause::ChildEnded => {
            let (what, how) = how_it_ended(end.status);
            let more = end.detail.map(|detail| format!("; {detail}"));
            (what, how + &more.unwrap_or_default())
        }
    }
}

/// The command of a part, in sentences.
pub(crate) const fn noun(part: Part) -> &'static str {
    match part {
        Part::Simulator => "server",
        Part::Evaluator => "evaluator",
        Part::Driver | Part::Plain => "agent",
    }
}

/// The other side of a part, in sentences.
const fn peer(part: Part) -> &'static str {
    match part {
        Part::Driver => "simulator",
        Part::Plain => "evaluator",
        Part::Simulator | Part::Evaluator => "agent",
    }
}

fn how_it_ended(status: Option<Status>) -> (What, String) {
    match status {
        Some(Status::Exited(code)) => (What::Exited, format!("the command exited with code {code}")),
        Some(Status::Killed(Some(signal))) => (What::Killed, format!("the command died of signal {signal}")),
        Some(Status::Killed(None)) | None => (What::Killed, "the command ended in an unknown way".to_owned()),
    }
}

/// The state of a driver's checkpoint.
pub(crate) fn of_checkpoint(results: &Result<Checkpoint, Unreadable>) -> String {
    match results {
        Ok(Checkpoint { complete: true, .. }) => "its results are complete".to_owned(),
        Ok(Checkpoint { driven: Some(_), .. }) => "its routes are all driven (no global record)".to_owned(),
        Ok(Checkpoint { partial: true, .. }) => "its results are partial (no global record)".to_owned(),
        Ok(_) => "its checkpoint holds no results".to_owned(),
        Err(error) => error.to_string(),
    }
}

/// Replaces the termination message. A container without that file goes without.
pub(crate) fn write(path: &Path, message: &str) {
    let flags = OFlag::O_NOFOLLOW | OFlag::O_NONBLOCK | OFlag::O_NOCTTY;
    // Written in place: the file is a mount of its own, so nothing can be renamed over it.
    let opened = OpenOptions::new()
        .write(true)
        .truncate(true)
        .custom_flags(flags.bits())
        .open(path);
    let written = opened.and_then(|mut file| file.write_all(message.as_bytes()));
    if let Err(error) = written
        && error.kind() != ErrorKind::NotFound
    {
        crate::say(format_args!("the termination message cannot be written: {error}"));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const END: End<'_> = End {
        part: Part::Driver,
        round: 2,
        alone: false,
        cause: Cause::ChildEnded,
        status: Some(Status::Exited(3)),
        out_of_memory: false,
        left: None,
        detail: None,
    };

    fn assert_verdicts<const N: usize>(cases: [(End<'_>, What, &str); N]) {
        for (end, what, why) in cases {
            let verdict = verdict(&end);
            assert_eq!((verdict.what, verdict.why.as_str()), (what, why));
        }
    }

    #[test]
    fn the_sentence_names_the_commands_end_and_its_results() {
        let partial = Ok(Checkpoint {
            complete: false,
            partial: true,
            driven: None,
        });
        let missing = Err(Unreadable::Missing);
        assert_verdicts([
            (
                End {
                    left: Some(of_checkpoint(&partial)),
                    ..END
                },
                What::Exited,
                "the command exited with code 3; its results are partial (no global record)",
            ),
            (
                End {
                    status: Some(Status::Killed(Some(9))),
                    out_of_memory: true,
                    left: Some(of_checkpoint(&missing)),
                    ..END
                },
                What::Killed,
                "the command died of signal 9; the kernel killed a process of this container for lack of memory; there is no checkpoint file",
            ),
        ]);
    }

    #[test]
    fn the_sentence_names_another_cause_than_the_commands_end() {
        assert_verdicts([
            (
                End {
                    cause: Cause::PeerCrashed,
                    status: Some(Status::Killed(Some(9))),
                    ..END
                },
                What::PeerCrashed,
                "the simulator crashed, so the agent was stopped",
            ),
            (
                End {
                    cause: Cause::CannotStart(127),
                    status: None,
                    detail: Some("x"),
                    ..END
                },
                What::CannotStart,
                "x",
            ),
            (
                End {
                    part: Part::Simulator,
                    cause: Cause::NotReady,
                    ..END
                },
                What::NotReady,
                "the server did not answer on its port in time",
            ),
            (
                End {
                    part: Part::Plain,
                    cause: Cause::PeerCrashed,
                    ..END
                },
                What::PeerCrashed,
                "the evaluator crashed, so the agent was stopped",
            ),
            (
                End {
                    part: Part::Evaluator,
                    cause: Cause::NoResult,
                    left: Some("its result is not final".to_owned()),
                    ..END
                },
                What::NoResult,
                "the agent is done, and the evaluator had no complete result in time; its result is not final",
            ),
            (
                End {
                    part: Part::Evaluator,
                    alone: true,
                    cause: Cause::NoResult,
                    ..END
                },
                What::NoResult,
                "the evaluator had no complete result in time",
            ),
        ]);
    }

    #[test]
    fn the_numbers_are_the_commands_own() {
        let exited = verdict(&END);
        assert_eq!(
            (exited.round, exited.exit_code, exited.signal, exited.out_of_memory),
            (Some(2), Some(3), None, false)
        );
        let killed = verdict(&End {
            status: Some(Status::Killed(Some(11))),
            out_of_memory: true,
            ..END
        });
        assert_eq!(
            (killed.exit_code, killed.signal, killed.out_of_memory),
            (None, Some(11), true)
        );
    }
}
