//! Decisions of a runner: pure functions of what it sees. Three questions in a container's life, each with its table of
//! tests: what next while it lives ([`next`]), what its end means ([`conclude`]), and when it may leave ([`leave`]).
//!
//! Called by `run`, which does the looking and the doing. Knows no clock, no file, no process.
//!
//! Rounds: both sides count their own crashes and name their files with the count. A side that has not started in a round
//! its peer has crashed in steps over it (its own crash file, no exit); one that has started is brought down. So
//! the two counts meet again however far apart the containers restart.

use leaderboard_protocol::files::Side;
use leaderboard_protocol::verdict::{CODE_NO_PROCESS, CODE_NODE_REFUSED};

/// How far this container has come.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Phase {
    /// Nothing is launched. An agent waits here for its simulator.
    Opening,
    /// A simulator's server runs; its port has not answered yet.
    Booting,
    /// This round's start file is written.
    Running,
}

/// The command, seen from outside.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Child {
    /// Not launched, or alive (and, in [`Phase::Booting`], not answering).
    Quiet,
    /// A simulator's server that answers.
    Ready,
    /// It ended by itself.
    Ended,
}

/// GPU of the agent, as the simulator has read it.
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
    pub(crate) cancel: bool,
    /// `logcopy.done`: the final results are stored.
    pub(crate) stored: bool,
    pub(crate) child: Child,
    pub(crate) agent_gpu: AgentGpu,
    /// SIGTERM came from outside.
    pub(crate) terminated: bool,
    /// The agent has printed nothing for too long.
    pub(crate) idle: bool,
    /// The simulator's server, or the agent's simulator, is late.
    pub(crate) overdue: bool,
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
pub(crate) fn next(side: Side, phase: Phase, seen: &Seen) -> Action {
    if seen.terminated {
        return Action::End(Cause::Terminated);
    }
    match (side, phase) {
        (_, Phase::Opening) => opening(side, seen),
        (_, Phase::Booting) => booting(seen),
        (Side::Host, Phase::Running) => simulator_running(seen),
        (Side::Agent, Phase::Running) => agent_running(seen),
    }
}

fn opening(side: Side, seen: &Seen) -> Action {
    if seen.own_done {
        return Action::End(Cause::AlreadyDone);
    }
    if side == Side::Host && seen.peer_done {
        return Action::End(Cause::PeerDone);
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
    match side {
        Side::Host => Action::Launch,
        Side::Agent if seen.peer_started => Action::Launch,
        Side::Agent if seen.overdue => Action::End(Cause::NotReady),
        Side::Agent => Action::Wait,
    }
}

fn booting(seen: &Seen) -> Action {
    if seen.peer_done {
        Action::End(Cause::PeerDone)
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

/// The agent's word comes first: complete results are complete, whatever became of the server.
fn simulator_running(seen: &Seen) -> Action {
    if seen.peer_done {
        Action::End(Cause::PeerDone)
    } else if seen.cancel {
        Action::End(Cause::Cancelled)
    } else if seen.peer_crashed {
        Action::End(Cause::PeerCrashed)
    } else if seen.child == Child::Ended {
        Action::End(Cause::ChildEnded)
    } else {
        Action::Wait
    }
}

/// The command's own end comes first: only then its results are judged in spite of a cancel.
fn agent_running(seen: &Seen) -> Action {
    if seen.child == Child::Ended {
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
/// The round ended without complete results.
pub(crate) const CODE_CRASHED: i32 = 1;
/// A SIGTERM from outside, as a shell reports it.
pub(crate) const CODE_TERMINATED: i32 = 143;
/// There is nothing to draw with (EX_UNAVAILABLE).
pub(crate) const CODE_NO_GRAPHICS: i32 = 69;
/// The last whole checkpoint cannot be put back, so the command could not go on where it was (EX_CANTCREAT).
pub(crate) const CODE_NOT_RESUMED: i32 = 73;
/// The status folder cannot be written (EX_IOERR).
pub(crate) const CODE_MUTE: i32 = 74;

const SIMULATOR_DONE: Conclusion = Conclusion {
    mark: Some(EndMark::Done),
    hold: Hold::Flush,
    code: CODE_OVER,
};

/// Judges the end, once every process has ended. `complete`: the agent's checkpoint has its global record, or all its routes.
pub(crate) fn conclude(side: Side, cause: Cause, complete: bool, seen: &Seen) -> Conclusion {
    match cause {
        Cause::Terminated => silent(Hold::Free, CODE_TERMINATED),
        Cause::Mute => silent(Hold::Free, CODE_MUTE),
        Cause::AlreadyDone => silent(of_host(side, Hold::Flush), CODE_OVER),
        Cause::Cancelled => silent(of_host(side, Hold::Cancel), CODE_OVER),
        Cause::PeerDone => SIMULATOR_DONE,
        // The agent's image may take an hour to come, and nothing that it does helps.
        Cause::NoGpu | Cause::AgentHasNoGpu | Cause::GraphicsDriverMissing => Conclusion {
            mark: Some(EndMark::Crash),
            hold: Hold::Free,
            code: CODE_NO_GRAPHICS,
        },
        Cause::PeerCrashed
        | Cause::ChildEnded
        | Cause::Idle
        | Cause::NotReady
        | Cause::ServerSilent
        | Cause::PortTaken
        | Cause::CannotStart(_)
        | Cause::NodeRefused
        | Cause::NoProcess => crashed(side, cause, complete, seen),
    }
}

/// Judges an end that is a crash, unless the run was over or asked to end by then.
fn crashed(side: Side, cause: Cause, complete: bool, seen: &Seen) -> Conclusion {
    let ran = !matches!(
        cause,
        Cause::NotReady | Cause::CannotStart(_) | Cause::NodeRefused | Cause::NoProcess
    );
    if side == Side::Host && seen.peer_done {
        return SIMULATOR_DONE;
    }
    if side == Side::Agent && ran && complete {
        return Conclusion {
            mark: Some(EndMark::Done),
            hold: Hold::Peer,
            code: CODE_OVER,
        };
    }
    if seen.cancel {
        return silent(of_host(side, Hold::Cancel), CODE_OVER);
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
fn of_host(side: Side, hold: Hold) -> Hold {
    if side == Side::Host { hold } else { Hold::Free }
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
pub(crate) fn leave(side: Side, conclusion: Conclusion, seen: &Seen, over: bool) -> Leave {
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
    match (hold, side) {
        (Hold::Peer, Side::Host) if seen.peer_done => Leave::Hold(SIMULATOR_DONE),
        // Exit 0, since after another code the container would be restarted for nothing.
        (Hold::Peer, _) if seen.stored => Leave::Exit(CODE_OVER),
        (Hold::Peer, Side::Host) if seen.cancel => Leave::Hold(cancelled),
        (Hold::Peer, Side::Agent) if seen.cancel => Leave::Exit(CODE_OVER),
        (Hold::Peer, _) => exit_or_wait(seen.peer_crashed || seen.peer_done || over, code),
        (Hold::Flush, _) if seen.cancel && !seen.stored && !over => Leave::Hold(cancelled),
        _ => exit_or_wait(seen.stored || over, code),
    }
}

#[cfg(test)]
mod tests;
