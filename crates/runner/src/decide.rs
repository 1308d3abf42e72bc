//! Decisions of a runner: pure functions of what it sees. Three questions in a container's life, each with its table of
//! tests: what next while it lives ([`next`]), what its end means ([`conclude`]), and when it may leave ([`leave`]).
//!
//! Called by `run`, which does the looking and the doing. Knows no clock, no file, no process.
//!
//! In each pair one side has the last word: its results are the pair's, and its peer follows it. With a simulator that is the agent, and
//! with an evaluator the evaluator.
//!
//! Rounds: both sides count their own crashes and name their files with the count. A side that has not started in a round
//! its peer has crashed in steps over it (its own crash file, no exit); one that has started is brought down. So
//! the two counts meet again however far apart the containers restart.

use leaderboard_protocol::verdict::{CODE_NO_GRAPHICS, CODE_NO_PROCESS, CODE_NODE_REFUSED};
pub(crate) use leaderboard_runner::args::Part;

/// How far this container has come.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Phase {
    /// Nothing is launched. An agent waits here for its host.
    Opening,
    /// A host's command runs; its agent may not begin yet.
    Booting,
    /// This round's start file is written.
    Running,
}

/// The command, seen from outside.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Child {
    /// Not launched, or alive (and, in [`Phase::Booting`], not ready).
    Quiet,
    /// A host's command that its agent can reach.
    Ready,
    /// It ended by itself.
    Ended,
}

/// GPU of the agent, as its host has read it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum AgentGpu {
    /// It does not matter, or the agent's command may have begun: from then on what lies in its folder is its own word.
    NotAsked,
    /// Its runner has not looked yet.
    Awaited,
    Seen,
    Missing,
}

/// The world at one moment. All of the peer is about this side's present round.
#[expect(clippy::struct_excessive_bools, reason = "each is one independent observation")]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Seen {
    pub(crate) own_started: bool,
    pub(crate) own_done: bool,
    pub(crate) peer_started: bool,
    pub(crate) peer_crashed: bool,
    pub(crate) peer_done: bool,
    /// An evaluator's result is complete, or it has refused the submission by its exit code.
    pub(crate) has_result: bool,
    /// Results are not final yet after which an evaluator's command begins.
    pub(crate) held: bool,
    pub(crate) cancel: bool,
    /// `logcopy.done`: the final results are stored.
    pub(crate) stored: bool,
    pub(crate) child: Child,
    pub(crate) agent_gpu: AgentGpu,
    /// SIGTERM came from outside.
    pub(crate) terminated: bool,
    /// The agent has printed nothing for too long.
    pub(crate) idle: bool,
    /// Late is the readiness of a host's command, an agent's host, or the result of an evaluator whose agent is done.
    pub(crate) overdue: bool,
}

impl Seen {
    /// What a container sees that has no peer: as if an agent's host had started, an evaluator's agent were done, and neither had crashed.
    pub(crate) const fn alone(self, part: Part) -> Self {
        Self {
            peer_started: true,
            peer_crashed: false,
            peer_done: part.has_last_word(),
            ..self
        }
    }
}

/// Why a round is stepped over without an exit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Skip {
    /// This side was killed in it without a word.
    SilentDeath,
    /// The peer crashed in it before this side started.
    CatchUp,
}

/// Why this container comes to its end.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Cause {
    Terminated,
    AlreadyDone,
    PeerDone,
    /// The evaluator's result is complete.
    HasResult,
    /// The agent is done, or there is none, and the evaluator's result was not complete in time.
    NoResult,
    PeerCrashed,
    Cancelled,
    ChildEnded,
    Idle,
    NotReady,
    /// The agent crashed, and the server does not answer any more.
    ServerSilent,
    /// The server failed while another process of the Pod listened on its port.
    PortTaken,
    /// The server was to have a GPU and there is none.
    NoGpu,
    /// The agent was to have a GPU and there is none. It has not begun.
    AgentHasNoGpu,
    /// There is a GPU, and no driver for what the server draws with.
    GraphicsDriverMissing,
    /// With the exit code of a shell that cannot start a command.
    CannotStart(i32),
    /// The node refuses what the command needs to start: files, memory, a disk that works.
    NodeRefused,
    /// No process is left for the command.
    NoProcess,
    /// The status folder cannot be written, so nothing can be agreed.
    Mute,
}

/// Next step.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Action {
    Wait,
    Skip(Skip),
    Launch,
    /// Write the simulator's start file.
    Announce,
    /// End all processes and conclude.
    End(Cause),
}

/// Next step while nothing has ended yet.
pub(crate) fn next(part: Part, phase: Phase, seen: &Seen) -> Action {
    if seen.terminated {
        return Action::End(Cause::Terminated);
    }
    match phase {
        Phase::Opening => opening(part, seen),
        Phase::Booting => booting(part, seen),
        Phase::Running if part.is_host() => host_running(part, seen),
        Phase::Running => agent_running(part, seen),
    }
}

/// The end that the side with the last word brings about. It comes first: complete results are complete, whatever became of the other side.
fn last_word(part: Part, seen: &Seen) -> Option<Cause> {
    match part {
        Part::Evaluator => seen.has_result.then_some(Cause::HasResult),
        Part::Simulator | Part::Plain => seen.peer_done.then_some(Cause::PeerDone),
        // Its results are judged at its end, which is soon.
        Part::Driver => None,
    }
}

fn opening(part: Part, seen: &Seen) -> Action {
    if seen.own_done {
        return Action::End(Cause::AlreadyDone);
    }
    if let Some(cause) = last_word(part, seen) {
        return Action::End(cause);
    }
    if seen.own_started {
        return Action::Skip(Skip::SilentDeath);
    }
    if seen.cancel || seen.stored {
        return Action::End(Cause::Cancelled);
    }
    if seen.peer_crashed {
        return Action::Skip(Skip::CatchUp);
    }
    if seen.held {
        Action::Wait
    } else if part.is_host() || seen.peer_started {
        Action::Launch
    } else if seen.overdue {
        Action::End(Cause::NotReady)
    } else {
        Action::Wait
    }
}

fn booting(part: Part, seen: &Seen) -> Action {
    if let Some(cause) = last_word(part, seen) {
        Action::End(cause)
    } else if seen.cancel || seen.stored {
        Action::End(Cause::Cancelled)
    } else if seen.agent_gpu == AgentGpu::Missing {
        Action::End(Cause::AgentHasNoGpu)
    } else if seen.child == Child::Ended {
        Action::End(Cause::ChildEnded)
    } else if seen.peer_crashed {
        Action::Skip(Skip::CatchUp)
    } else if seen.child == Child::Ready && seen.agent_gpu == AgentGpu::Awaited {
        // The agent's image may take an hour to come, and until then the server is not late.
        Action::Wait
    } else if seen.child == Child::Ready {
        Action::Announce
    } else if seen.overdue {
        Action::End(Cause::NotReady)
    } else {
        Action::Wait
    }
}

/// An agent's crash comes before that of its host, which can follow from it.
fn host_running(part: Part, seen: &Seen) -> Action {
    if let Some(cause) = last_word(part, seen) {
        Action::End(cause)
    } else if seen.cancel {
        Action::End(Cause::Cancelled)
    } else if seen.peer_crashed {
        Action::End(Cause::PeerCrashed)
    } else if seen.child == Child::Ended {
        Action::End(Cause::ChildEnded)
    } else if part == Part::Evaluator && seen.peer_done && seen.overdue {
        Action::End(Cause::NoResult)
    } else {
        Action::Wait
    }
}

/// The command's own end comes early: only then its results are judged in spite of a cancel.
fn agent_running(part: Part, seen: &Seen) -> Action {
    if let Some(cause) = last_word(part, seen) {
        Action::End(cause)
    } else if seen.child == Child::Ended {
        Action::End(Cause::ChildEnded)
    } else if seen.cancel {
        Action::End(Cause::Cancelled)
    } else if seen.peer_crashed {
        Action::End(Cause::PeerCrashed)
    } else if seen.idle {
        Action::End(Cause::Idle)
    } else {
        Action::Wait
    }
}

/// The file an end is announced with.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum EndMark {
    Done,
    Crash,
}

/// Condition that the exit waits for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Hold {
    /// Nothing.
    Free,
    /// The peer's end of the same round.
    Peer,
    /// `logcopy.done`, as long as storing the results may take.
    Flush,
    /// `logcopy.done`, as long as a cancel may take.
    Cancel,
}

/// Meaning of an end.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Conclusion {
    pub(crate) mark: Option<EndMark>,
    pub(crate) hold: Hold,
    pub(crate) code: i32,
}

/// Complete, cancelled, or the results are stored already: the container is not started again.
pub(crate) const CODE_OVER: i32 = 0;
/// The round ended without complete results, or a folder could not be copied.
pub(crate) const CODE_CRASHED: i32 = 1;
/// A SIGTERM from outside, as a shell reports it.
pub(crate) const CODE_TERMINATED: i32 = 143;
/// The last whole checkpoint cannot be put back, so the command could not go on where it was (EX_CANTCREAT).
pub(crate) const CODE_NOT_RESUMED: i32 = 73;
/// The status folder cannot be written (EX_IOERR).
pub(crate) const CODE_MUTE: i32 = 74;

/// A regular end.
const fn done(part: Part) -> Conclusion {
    Conclusion {
        mark: Some(EndMark::Done),
        hold: match part {
            Part::Simulator | Part::Evaluator => Hold::Flush,
            Part::Driver => Hold::Peer,
            // The kubelet's word that its container has ended cannot be forged, as its mark can.
            Part::Plain => Hold::Free,
        },
        code: CODE_OVER,
    }
}

/// Judges the end, once every process has ended. `complete`: the driver's checkpoint has its global record, or all its routes; the
/// evaluator's result is complete; the plain program has exited with code 0.
pub(crate) fn conclude(part: Part, cause: Cause, complete: bool, seen: &Seen) -> Conclusion {
    match cause {
        Cause::Terminated => silent(Hold::Free, CODE_TERMINATED),
        Cause::Mute => silent(Hold::Free, CODE_MUTE),
        Cause::AlreadyDone => silent(of_host(part, Hold::Flush), CODE_OVER),
        Cause::Cancelled => silent(of_host(part, Hold::Cancel), CODE_OVER),
        Cause::PeerDone => done(part),
        // The agent's image may take an hour to come, and nothing that it does helps.
        Cause::NoGpu | Cause::AgentHasNoGpu | Cause::GraphicsDriverMissing => Conclusion {
            mark: Some(EndMark::Crash),
            hold: Hold::Free,
            code: CODE_NO_GRAPHICS,
        },
        Cause::HasResult
        | Cause::NoResult
        | Cause::PeerCrashed
        | Cause::ChildEnded
        | Cause::Idle
        | Cause::NotReady
        | Cause::ServerSilent
        | Cause::PortTaken
        | Cause::CannotStart(_)
        | Cause::NodeRefused
        | Cause::NoProcess => crashed(part, cause, complete, seen),
    }
}

/// Judges an end that is a crash, unless the results are complete, or the run was over or asked to end by then.
fn crashed(part: Part, cause: Cause, complete: bool, seen: &Seen) -> Conclusion {
    let ran = !matches!(
        cause,
        Cause::NotReady | Cause::CannotStart(_) | Cause::NodeRefused | Cause::NoProcess
    );
    let is_done = match part {
        Part::Simulator => seen.peer_done,
        Part::Driver | Part::Evaluator => ran && complete,
        // A command that was asked to end may well exit with code 0.
        Part::Plain => seen.peer_done || (cause == Cause::ChildEnded && complete),
    };
    if is_done {
        return done(part);
    }
    if seen.cancel {
        return silent(of_host(part, Hold::Cancel), CODE_OVER);
    }
    let code = match cause {
        Cause::CannotStart(code) => code,
        Cause::NodeRefused => CODE_NODE_REFUSED,
        Cause::NoProcess => CODE_NO_PROCESS,
        _ => CODE_CRASHED,
    };
    Conclusion {
        mark: Some(EndMark::Crash),
        hold: Hold::Peer,
        code,
    }
}

fn silent(hold: Hold, code: i32) -> Conclusion {
    Conclusion { mark: None, hold, code }
}

/// Hold of the host's side; the agent's is free.
fn of_host(part: Part, hold: Hold) -> Hold {
    if part.is_host() { hold } else { Hold::Free }
}

/// Next step while the exit is held.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Leave {
    Wait,
    /// Hold for something else from now on.
    Hold(Conclusion),
    Exit(i32),
}

/// True if the container may exit. `over`: the present hold has lasted as long as it may.
pub(crate) fn leave(part: Part, conclusion: Conclusion, seen: &Seen, over: bool) -> Leave {
    let Conclusion { hold, code, .. } = conclusion;
    let exit_or_wait = |exit, code| if exit { Leave::Exit(code) } else { Leave::Wait };
    if seen.terminated || hold == Hold::Free {
        return Leave::Exit(code);
    }
    let cancelled = Conclusion {
        mark: None,
        hold: Hold::Cancel,
        code: CODE_OVER,
    };
    match hold {
        Hold::Peer if seen.peer_done && !part.has_last_word() => Leave::Hold(done(part)),
        // Exit 0, since after another code the container would be restarted for nothing.
        Hold::Peer if seen.stored => Leave::Exit(CODE_OVER),
        Hold::Peer if seen.cancel && part.is_host() => Leave::Hold(cancelled),
        Hold::Peer if seen.cancel => Leave::Exit(CODE_OVER),
        Hold::Peer => exit_or_wait(seen.peer_crashed || seen.peer_done || over, code),
        Hold::Flush if seen.cancel && !seen.stored && !over => Leave::Hold(cancelled),
        Hold::Free | Hold::Flush | Hold::Cancel => exit_or_wait(seen.stored || over, code),
    }
}

#[cfg(test)]
mod tests;
#[cfg(test)]
mod walk_tests;
