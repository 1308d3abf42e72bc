//! The tables of the state machine.

use super::Action::{Announce, End, Launch, Wait};
use super::Part::{Driver, Evaluator, Plain, Simulator};
use super::Phase::{Booting, Opening, Running};
use super::*;

pub(super) const NOTHING: Seen = Seen {
    own_started: false,
    own_done: false,
    peer_started: false,
    peer_crashed: false,
    peer_done: false,
    has_result: false,
    held: false,
    cancel: false,
    stored: false,
    child: Child::Quiet,
    agent_gpu: AgentGpu::NotAsked,
    terminated: false,
    idle: false,
    overdue: false,
};

/// A `Seen` from words, so that a table stays a table.
fn seen(words: &str) -> Seen {
    let mut seen = NOTHING;
    for word in words.split_whitespace() {
        match word {
            "own-started" => seen.own_started = true,
            "own-done" => seen.own_done = true,
            "peer-started" => seen.peer_started = true,
            "peer-crashed" => seen.peer_crashed = true,
            "peer-done" => seen.peer_done = true,
            "has-result" => seen.has_result = true,
            "held" => seen.held = true,
            "cancel" => seen.cancel = true,
            "stored" => seen.stored = true,
            "gpu-awaited" => seen.agent_gpu = AgentGpu::Awaited,
            "gpu-seen" => seen.agent_gpu = AgentGpu::Seen,
            "gpu-missing" => seen.agent_gpu = AgentGpu::Missing,
            "ready" => seen.child = Child::Ready,
            "ended" => seen.child = Child::Ended,
            "terminated" => seen.terminated = true,
            "idle" => seen.idle = true,
            "overdue" => seen.overdue = true,
            other => panic!("no such word: {other}"),
        }
    }
    seen
}

/// A phase, what is seen, and what follows.
type Step = (Phase, &'static str, Action);

const SILENT_DEATH: Action = Action::Skip(Skip::SilentDeath);
const CATCH_UP: Action = Action::Skip(Skip::CatchUp);

const SIMULATORS: &[Step] = &[
    (Opening, "", Launch),
    (Opening, "peer-started", Launch),
    (Opening, "own-started", SILENT_DEATH),
    (Opening, "own-started cancel", SILENT_DEATH),
    (Opening, "own-started peer-crashed", SILENT_DEATH),
    (Opening, "own-started peer-done", End(Cause::PeerDone)),
    (Opening, "own-started own-done peer-done", End(Cause::AlreadyDone)),
    (Opening, "peer-crashed", CATCH_UP),
    (Opening, "cancel peer-crashed", End(Cause::Cancelled)),
    (Opening, "stored", End(Cause::Cancelled)),
    (Opening, "terminated own-started", End(Cause::Terminated)),
    (Booting, "", Wait),
    (Booting, "ready", Announce),
    (Booting, "ready overdue", Announce),
    // Until the agent's runner has looked for its GPU nothing is announced, however long its image takes.
    (Booting, "gpu-awaited", Wait),
    (Booting, "gpu-awaited ready", Wait),
    (Booting, "gpu-awaited ready overdue", Wait),
    (Booting, "gpu-awaited overdue", End(Cause::NotReady)),
    (Booting, "gpu-awaited ended", End(Cause::ChildEnded)),
    (Booting, "gpu-awaited ready cancel", End(Cause::Cancelled)),
    (Booting, "gpu-awaited ready peer-crashed", CATCH_UP),
    (Booting, "gpu-seen", Wait),
    (Booting, "gpu-seen ready", Announce),
    (Booting, "gpu-missing", End(Cause::AgentHasNoGpu)),
    (
        Booting,
        "gpu-missing ready peer-crashed ended",
        End(Cause::AgentHasNoGpu),
    ),
    (Booting, "gpu-missing cancel", End(Cause::Cancelled)),
    (Booting, "gpu-missing terminated", End(Cause::Terminated)),
    (Booting, "ready peer-crashed", CATCH_UP),
    (Booting, "overdue", End(Cause::NotReady)),
    (Booting, "ended", End(Cause::ChildEnded)),
    (Booting, "cancel ended", End(Cause::Cancelled)),
    (Booting, "stored", End(Cause::Cancelled)),
    (Booting, "peer-done ready cancel", End(Cause::PeerDone)),
    (Running, "own-started", Wait),
    (Running, "own-started peer-started overdue stored", Wait),
    (Running, "peer-done peer-crashed ended cancel", End(Cause::PeerDone)),
    (Running, "cancel peer-crashed ended", End(Cause::Cancelled)),
    (Running, "peer-crashed ended", End(Cause::PeerCrashed)),
    (Running, "ended", End(Cause::ChildEnded)),
    (Running, "terminated peer-done", End(Cause::Terminated)),
];

const DRIVERS: &[Step] = &[
    (Opening, "", Wait),
    (Opening, "peer-started", Launch),
    (Opening, "peer-started overdue", Launch),
    (Opening, "overdue", End(Cause::NotReady)),
    (Opening, "own-started peer-started", SILENT_DEATH),
    (Opening, "own-started peer-started peer-crashed cancel", SILENT_DEATH),
    (Opening, "peer-started peer-crashed", CATCH_UP),
    (Opening, "peer-crashed overdue", CATCH_UP),
    (Opening, "cancel peer-started", End(Cause::Cancelled)),
    (Opening, "stored peer-started", End(Cause::Cancelled)),
    (Opening, "own-started own-done", End(Cause::AlreadyDone)),
    (Running, "peer-started", Wait),
    (Running, "stored", Wait),
    (Running, "ended cancel peer-crashed idle", End(Cause::ChildEnded)),
    (Running, "cancel peer-crashed idle", End(Cause::Cancelled)),
    (Running, "peer-crashed idle", End(Cause::PeerCrashed)),
    (Running, "idle", End(Cause::Idle)),
    (Running, "terminated ended", End(Cause::Terminated)),
];

const EVALUATORS: &[Step] = &[
    (Opening, "", Launch),
    // Its agent is done, or claims to be: the evaluator has the last word all the same.
    (Opening, "peer-done", Launch),
    (Opening, "peer-done own-started", SILENT_DEATH),
    (Opening, "own-started", SILENT_DEATH),
    (Opening, "peer-crashed", CATCH_UP),
    (Opening, "peer-done peer-crashed", CATCH_UP),
    (Opening, "cancel", End(Cause::Cancelled)),
    (Opening, "stored peer-done", End(Cause::Cancelled)),
    (Opening, "own-done has-result", End(Cause::AlreadyDone)),
    // It was killed between its result and its mark, or the result was restored.
    (Opening, "has-result own-started cancel", End(Cause::HasResult)),
    (Opening, "terminated has-result", End(Cause::Terminated)),
    // It merges the results of others, and theirs are not final yet.
    (Opening, "held peer-done peer-started", Wait),
    (Opening, "held overdue", Wait),
    (Opening, "held own-started", SILENT_DEATH),
    (Opening, "held has-result", End(Cause::HasResult)),
    (Opening, "held cancel", End(Cause::Cancelled)),
    (Opening, "held stored", End(Cause::Cancelled)),
    (Opening, "held terminated", End(Cause::Terminated)),
    (Booting, "", Wait),
    (Booting, "ready", Announce),
    (Booting, "ready peer-done", Announce),
    (Booting, "overdue", End(Cause::NotReady)),
    (Booting, "ended", End(Cause::ChildEnded)),
    (Booting, "ended peer-done", End(Cause::ChildEnded)),
    (Booting, "has-result ended cancel", End(Cause::HasResult)),
    (Booting, "ready peer-crashed", CATCH_UP),
    (Booting, "ready cancel", End(Cause::Cancelled)),
    (Booting, "stored", End(Cause::Cancelled)),
    (Booting, "gpu-awaited ready overdue", Wait),
    (Booting, "gpu-missing ready", End(Cause::AgentHasNoGpu)),
    (Running, "own-started", Wait),
    (Running, "own-started stored", Wait),
    // The result is complete, whether the evaluator lives or not, and whatever its agent does or claims.
    (Running, "has-result", End(Cause::HasResult)),
    (
        Running,
        "has-result ended peer-crashed peer-done cancel overdue",
        End(Cause::HasResult),
    ),
    // The agent is done: the time for the result runs, and ends by nothing but the clock.
    (Running, "peer-done", Wait),
    (Running, "peer-done overdue", End(Cause::NoResult)),
    (Running, "peer-done ended", End(Cause::ChildEnded)),
    (Running, "peer-done overdue ended", End(Cause::ChildEnded)),
    (Running, "peer-done overdue cancel", End(Cause::Cancelled)),
    (Running, "overdue", Wait),
    (Running, "ended", End(Cause::ChildEnded)),
    // An evaluator that loses its agent may well end.
    (Running, "peer-crashed ended", End(Cause::PeerCrashed)),
    // A forged mark does not undo a crash.
    (Running, "peer-crashed peer-done", End(Cause::PeerCrashed)),
    (Running, "cancel peer-crashed ended", End(Cause::Cancelled)),
    (Running, "terminated has-result", End(Cause::Terminated)),
];

const PLAINS: &[Step] = &[
    (Opening, "", Wait),
    (Opening, "peer-started", Launch),
    (Opening, "overdue", End(Cause::NotReady)),
    (Opening, "own-started peer-started", SILENT_DEATH),
    (Opening, "peer-started peer-crashed", CATCH_UP),
    (Opening, "cancel peer-started", End(Cause::Cancelled)),
    (Opening, "stored peer-started", End(Cause::Cancelled)),
    // It is not started a second time, even when its evaluator is.
    (Opening, "own-started own-done peer-started", End(Cause::AlreadyDone)),
    (Opening, "peer-done own-started peer-started", End(Cause::PeerDone)),
    (Opening, "peer-done", End(Cause::PeerDone)),
    (Running, "peer-started", Wait),
    (Running, "stored", Wait),
    (Running, "peer-done ended cancel idle", End(Cause::PeerDone)),
    (Running, "ended cancel peer-crashed idle", End(Cause::ChildEnded)),
    (Running, "cancel peer-crashed idle", End(Cause::Cancelled)),
    (Running, "peer-crashed idle", End(Cause::PeerCrashed)),
    (Running, "idle", End(Cause::Idle)),
    (Running, "terminated peer-done", End(Cause::Terminated)),
];

#[test]
fn next_follows_the_table() {
    let tables = [
        (Simulator, SIMULATORS),
        (Driver, DRIVERS),
        (Evaluator, EVALUATORS),
        (Plain, PLAINS),
    ];
    for (part, steps) in tables {
        for (phase, words, expected) in steps {
            assert_eq!(
                next(part, *phase, &seen(words)),
                *expected,
                "{part:?} {phase:?}: {words}"
            );
        }
    }
}

/// Nobody's marks count but its own, `logcopy`'s and the cancel.
const ALONE: &[(Part, Phase, &str, Action)] = &[
    (Plain, Opening, "", Launch),
    (Plain, Opening, "peer-crashed peer-done overdue", Launch),
    (Plain, Opening, "own-started", SILENT_DEATH),
    (Plain, Opening, "own-started own-done", End(Cause::AlreadyDone)),
    (Plain, Opening, "cancel", End(Cause::Cancelled)),
    (Plain, Opening, "stored", End(Cause::Cancelled)),
    (Plain, Running, "peer-crashed peer-done", Wait),
    (Plain, Running, "ended cancel", End(Cause::ChildEnded)),
    (Plain, Running, "cancel idle", End(Cause::Cancelled)),
    (Plain, Running, "idle peer-crashed", End(Cause::Idle)),
    (Evaluator, Opening, "peer-crashed", Launch),
    (Evaluator, Opening, "own-started peer-crashed", SILENT_DEATH),
    (Evaluator, Opening, "has-result", End(Cause::HasResult)),
    (Evaluator, Opening, "cancel", End(Cause::Cancelled)),
    (Evaluator, Booting, "ready peer-crashed", Announce),
    (Evaluator, Booting, "ended peer-crashed", End(Cause::ChildEnded)),
    (Evaluator, Running, "peer-crashed", Wait),
    (Evaluator, Running, "overdue", End(Cause::NoResult)),
    (Evaluator, Running, "ended peer-crashed", End(Cause::ChildEnded)),
    (Evaluator, Running, "has-result overdue", End(Cause::HasResult)),
    (Evaluator, Running, "cancel overdue", End(Cause::Cancelled)),
];

#[test]
fn a_container_that_is_alone_follows_nobody() {
    for (part, phase, words, expected) in ALONE {
        let seen = seen(words).alone(*part);
        assert_eq!(next(*part, *phase, &seen), *expected, "{part:?} {phase:?}: {words}");
    }
    for (part, cause) in [(Plain, Cause::ChildEnded), (Evaluator, Cause::NoResult)] {
        let seen = seen("peer-crashed peer-done").alone(part);
        let crashed = conclude(part, cause, false, &seen);
        assert_eq!((crashed.mark, crashed.code), (CRASH, 1), "{part:?}");
        assert_eq!(leave(part, crashed, &seen, true), Leave::Exit(1), "{part:?}");
    }
}

/// A cause, whether all is complete, what is seen, and what is concluded.
type Concluded = (Cause, bool, &'static str, Option<EndMark>, Hold, i32);

const CRASH: Option<EndMark> = Some(EndMark::Crash);
const DONE: Option<EndMark> = Some(EndMark::Done);

const ENDS_OF_SIMULATORS: &[Concluded] = &[
    (Cause::PeerDone, false, "peer-done", DONE, Hold::Flush, 0),
    (Cause::PeerDone, false, "peer-done cancel", DONE, Hold::Flush, 0),
    (Cause::PeerCrashed, false, "peer-crashed", CRASH, Hold::Peer, 1),
    (Cause::PeerCrashed, false, "peer-crashed cancel", None, Hold::Cancel, 0),
    (Cause::ChildEnded, false, "", CRASH, Hold::Peer, 1),
    (Cause::ChildEnded, false, "peer-done", DONE, Hold::Flush, 0),
    (Cause::NotReady, false, "", CRASH, Hold::Peer, 1),
    (Cause::CannotStart(127), false, "", CRASH, Hold::Peer, 127),
    (Cause::NodeRefused, false, "", CRASH, Hold::Peer, 71),
    (Cause::NoProcess, false, "", CRASH, Hold::Peer, 75),
    (Cause::NoGpu, false, "", CRASH, Hold::Free, 69),
    (Cause::AgentHasNoGpu, false, "", CRASH, Hold::Free, 69),
    (Cause::GraphicsDriverMissing, false, "", CRASH, Hold::Free, 69),
    (Cause::Cancelled, false, "cancel", None, Hold::Cancel, 0),
    (Cause::AlreadyDone, false, "own-done", None, Hold::Flush, 0),
    (Cause::Terminated, false, "terminated", None, Hold::Free, 143),
    (Cause::Mute, false, "", None, Hold::Free, 74),
];

const ENDS_OF_DRIVERS: &[Concluded] = &[
    (Cause::ChildEnded, true, "", DONE, Hold::Peer, 0),
    (Cause::ChildEnded, true, "cancel", DONE, Hold::Peer, 0),
    (Cause::ChildEnded, false, "", CRASH, Hold::Peer, 1),
    (Cause::ChildEnded, false, "cancel", None, Hold::Free, 0),
    (Cause::PeerCrashed, true, "peer-crashed", DONE, Hold::Peer, 0),
    (Cause::PeerCrashed, false, "peer-crashed", CRASH, Hold::Peer, 1),
    (Cause::Idle, true, "", DONE, Hold::Peer, 0),
    (Cause::Idle, false, "", CRASH, Hold::Peer, 1),
    (Cause::NotReady, true, "", CRASH, Hold::Peer, 1),
    (Cause::CannotStart(126), true, "", CRASH, Hold::Peer, 126),
    (Cause::NodeRefused, true, "", CRASH, Hold::Peer, 71),
    (Cause::NoProcess, true, "", CRASH, Hold::Peer, 75),
    (Cause::Cancelled, true, "cancel", None, Hold::Free, 0),
    (Cause::AlreadyDone, true, "own-done", None, Hold::Free, 0),
    (Cause::Terminated, true, "terminated", None, Hold::Free, 143),
    (Cause::Mute, true, "", None, Hold::Free, 74),
];

const ENDS_OF_EVALUATORS: &[Concluded] = &[
    (Cause::HasResult, true, "", DONE, Hold::Flush, 0),
    (
        Cause::HasResult,
        true,
        "peer-done peer-crashed cancel",
        DONE,
        Hold::Flush,
        0,
    ),
    // It was complete, and its evaluator wrote over it at the end.
    (Cause::HasResult, false, "", CRASH, Hold::Peer, 1),
    (Cause::ChildEnded, true, "", DONE, Hold::Flush, 0),
    (Cause::ChildEnded, false, "", CRASH, Hold::Peer, 1),
    // Nothing that its agent writes makes its end complete.
    (Cause::ChildEnded, false, "peer-done", CRASH, Hold::Peer, 1),
    (Cause::NoResult, false, "peer-done", CRASH, Hold::Peer, 1),
    (
        Cause::PeerCrashed,
        false,
        "peer-crashed peer-done",
        CRASH,
        Hold::Peer,
        1,
    ),
    // The last result that it wrote while it was stopped was complete.
    (Cause::NoResult, true, "peer-done", DONE, Hold::Flush, 0),
    (Cause::PeerCrashed, true, "peer-crashed", DONE, Hold::Flush, 0),
    (Cause::PeerCrashed, false, "peer-crashed cancel", None, Hold::Cancel, 0),
    (Cause::NotReady, false, "", CRASH, Hold::Peer, 1),
    (Cause::PortTaken, false, "", CRASH, Hold::Peer, 1),
    (Cause::CannotStart(127), false, "", CRASH, Hold::Peer, 127),
    (Cause::NodeRefused, false, "", CRASH, Hold::Peer, 71),
    (Cause::NoProcess, false, "", CRASH, Hold::Peer, 75),
    (Cause::NoGpu, false, "", CRASH, Hold::Free, 69),
    (Cause::AgentHasNoGpu, false, "", CRASH, Hold::Free, 69),
    (Cause::Cancelled, true, "cancel", None, Hold::Cancel, 0),
    (Cause::AlreadyDone, false, "own-done", None, Hold::Flush, 0),
    (Cause::Terminated, true, "terminated", None, Hold::Free, 143),
    (Cause::Mute, true, "", None, Hold::Free, 74),
];

const ENDS_OF_PLAINS: &[Concluded] = &[
    (Cause::ChildEnded, true, "", DONE, Hold::Free, 0),
    (Cause::ChildEnded, true, "peer-crashed cancel", DONE, Hold::Free, 0),
    (Cause::ChildEnded, false, "", CRASH, Hold::Peer, 1),
    (Cause::ChildEnded, false, "cancel", None, Hold::Free, 0),
    // Its evaluator has the last word.
    (Cause::ChildEnded, false, "peer-done", DONE, Hold::Free, 0),
    (Cause::PeerDone, false, "peer-done", DONE, Hold::Free, 0),
    (Cause::Idle, false, "peer-done", DONE, Hold::Free, 0),
    (Cause::CannotStart(126), false, "peer-done", DONE, Hold::Free, 0),
    // Exit code 0 is no end of its own once it was asked to end.
    (Cause::Idle, true, "", CRASH, Hold::Peer, 1),
    (Cause::PeerCrashed, true, "peer-crashed", CRASH, Hold::Peer, 1),
    (Cause::NotReady, false, "", CRASH, Hold::Peer, 1),
    (Cause::CannotStart(126), false, "", CRASH, Hold::Peer, 126),
    (Cause::NodeRefused, false, "", CRASH, Hold::Peer, 71),
    (Cause::NoProcess, false, "", CRASH, Hold::Peer, 75),
    (Cause::Cancelled, true, "cancel", None, Hold::Free, 0),
    (Cause::AlreadyDone, true, "own-done", None, Hold::Free, 0),
    (Cause::Terminated, true, "terminated", None, Hold::Free, 143),
    (Cause::Mute, true, "", None, Hold::Free, 74),
];

#[test]
fn an_end_is_concluded_by_the_table() {
    let tables = [
        (Simulator, ENDS_OF_SIMULATORS),
        (Driver, ENDS_OF_DRIVERS),
        (Evaluator, ENDS_OF_EVALUATORS),
        (Plain, ENDS_OF_PLAINS),
    ];
    for (part, ends) in tables {
        for &(cause, complete, words, mark, hold, code) in ends {
            assert_eq!(
                conclude(part, cause, complete, &seen(words)),
                Conclusion { mark, hold, code },
                "{part:?} {cause:?} {complete}: {words}"
            );
        }
    }
}

#[test]
fn an_exit_is_held_by_the_table() {
    let done = Leave::Hold(super::done(Simulator));
    let followed = Leave::Hold(super::done(Plain));
    let cancelled = Leave::Hold(Conclusion {
        mark: None,
        hold: Hold::Cancel,
        code: 0,
    });
    let cases = [
        (Simulator, Hold::Peer, 1, "", false, Leave::Wait),
        (Simulator, Hold::Peer, 1, "", true, Leave::Exit(1)),
        (Simulator, Hold::Peer, 1, "peer-crashed", false, Leave::Exit(1)),
        (Simulator, Hold::Peer, 1, "peer-done peer-crashed cancel", false, done),
        (Simulator, Hold::Peer, 1, "cancel", false, cancelled),
        (Simulator, Hold::Peer, 1, "stored", false, Leave::Exit(0)),
        (Simulator, Hold::Peer, 1, "terminated", false, Leave::Exit(1)),
        (Simulator, Hold::Flush, 0, "peer-done own-done", false, Leave::Wait),
        (Simulator, Hold::Flush, 0, "stored", false, Leave::Exit(0)),
        (Simulator, Hold::Flush, 0, "", true, Leave::Exit(0)),
        (Simulator, Hold::Flush, 0, "cancel", false, cancelled),
        (Simulator, Hold::Flush, 0, "cancel stored", false, Leave::Exit(0)),
        (Simulator, Hold::Flush, 0, "terminated", false, Leave::Exit(0)),
        (Simulator, Hold::Cancel, 0, "cancel", false, Leave::Wait),
        (Simulator, Hold::Cancel, 0, "cancel stored", false, Leave::Exit(0)),
        (Simulator, Hold::Cancel, 0, "cancel", true, Leave::Exit(0)),
        (Simulator, Hold::Free, 143, "", false, Leave::Exit(143)),
        (Driver, Hold::Peer, 0, "", false, Leave::Wait),
        (Driver, Hold::Peer, 0, "peer-done", false, Leave::Exit(0)),
        (Driver, Hold::Peer, 0, "peer-crashed", false, Leave::Exit(0)),
        (Driver, Hold::Peer, 1, "peer-crashed", false, Leave::Exit(1)),
        (Driver, Hold::Peer, 127, "", true, Leave::Exit(127)),
        (Driver, Hold::Peer, 1, "cancel", false, Leave::Exit(0)),
        (Driver, Hold::Peer, 1, "stored", false, Leave::Exit(0)),
        (Driver, Hold::Free, 0, "", false, Leave::Exit(0)),
        (Evaluator, Hold::Peer, 1, "", false, Leave::Wait),
        (Evaluator, Hold::Peer, 1, "", true, Leave::Exit(1)),
        (Evaluator, Hold::Peer, 1, "peer-crashed", false, Leave::Exit(1)),
        // Its agent is not started again, so there is nothing to wait for; it is itself.
        (Evaluator, Hold::Peer, 1, "peer-done", false, Leave::Exit(1)),
        (Evaluator, Hold::Peer, 1, "peer-done cancel", false, cancelled),
        (Evaluator, Hold::Peer, 1, "peer-done stored", false, Leave::Exit(0)),
        (Evaluator, Hold::Flush, 0, "peer-done own-done", false, Leave::Wait),
        (Evaluator, Hold::Flush, 0, "stored", false, Leave::Exit(0)),
        (Evaluator, Hold::Flush, 0, "cancel", false, cancelled),
        (Evaluator, Hold::Flush, 0, "terminated", false, Leave::Exit(0)),
        (Evaluator, Hold::Cancel, 0, "stored", false, Leave::Exit(0)),
        (Plain, Hold::Peer, 1, "", false, Leave::Wait),
        (Plain, Hold::Peer, 1, "peer-crashed", false, Leave::Exit(1)),
        (Plain, Hold::Peer, 1, "peer-done cancel", false, followed),
        (Plain, Hold::Peer, 1, "cancel", false, Leave::Exit(0)),
        (Plain, Hold::Peer, 1, "stored", false, Leave::Exit(0)),
        (Plain, Hold::Free, 0, "", false, Leave::Exit(0)),
    ];
    for (part, hold, code, words, over, expected) in cases {
        let conclusion = Conclusion { mark: None, hold, code };
        assert_eq!(
            leave(part, conclusion, &seen(words), over),
            expected,
            "{part:?} {hold:?}: {words} over={over}"
        );
    }
}
