//! The tables of the state machine, and a walk of both sides through every interleaving of their deaths.

use leaderboard_protocol::files::Side::{self, Agent, Host as Simulator};

use super::Action::{Announce, End, Launch, Wait};
use super::Phase::{Booting, Opening, Running};
use super::*;

const NOTHING: Seen = Seen {
    own_started: false,
    own_done: false,
    peer_started: false,
    peer_crashed: false,
    peer_done: false,
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

const AGENTS: &[Step] = &[
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

#[test]
fn next_follows_the_table() {
    for (side, steps) in [(Simulator, SIMULATORS), (Agent, AGENTS)] {
        for (phase, words, expected) in steps {
            assert_eq!(next(side, *phase, &seen(words)), *expected, "{side} {phase:?}: {words}");
        }
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

const ENDS_OF_AGENTS: &[Concluded] = &[
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

#[test]
fn an_end_is_concluded_by_the_table() {
    for (side, ends) in [(Simulator, ENDS_OF_SIMULATORS), (Agent, ENDS_OF_AGENTS)] {
        for &(cause, complete, words, mark, hold, code) in ends {
            assert_eq!(
                conclude(side, cause, complete, &seen(words)),
                Conclusion { mark, hold, code },
                "{side} {cause:?} {complete}: {words}"
            );
        }
    }
}

#[test]
fn an_exit_is_held_by_the_table() {
    let done = Leave::Hold(SIMULATOR_DONE);
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
        (Agent, Hold::Peer, 0, "", false, Leave::Wait),
        (Agent, Hold::Peer, 0, "peer-done", false, Leave::Exit(0)),
        (Agent, Hold::Peer, 0, "peer-crashed", false, Leave::Exit(0)),
        (Agent, Hold::Peer, 1, "peer-crashed", false, Leave::Exit(1)),
        (Agent, Hold::Peer, 127, "", true, Leave::Exit(127)),
        (Agent, Hold::Peer, 1, "cancel", false, Leave::Exit(0)),
        (Agent, Hold::Peer, 1, "stored", false, Leave::Exit(0)),
        (Agent, Hold::Free, 0, "", false, Leave::Exit(0)),
    ];
    for (side, hold, code, words, over, expected) in cases {
        let conclusion = Conclusion { mark: None, hold, code };
        assert_eq!(
            leave(side, conclusion, &seen(words), over),
            expected,
            "{side} {hold:?}: {words} over={over}"
        );
    }
}

/// The status files and one container of a side, without processes or time.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct Container {
    started: Vec<bool>,
    crashed: Vec<bool>,
    done: bool,
    round: usize,
    life: Life,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash)]
enum Life {
    Phase(u8),
    Holding(i32),
    /// Between two lives: it starts again unless it exited 0.
    Down,
    Gone,
}

const ROUNDS: usize = 4;
const PHASES: [Phase; 3] = [Opening, Booting, Running];

impl Container {
    fn new() -> Self {
        let files = vec![false; ROUNDS + 1];
        Self {
            started: files.clone(),
            crashed: files,
            done: false,
            round: 0,
            life: Life::Down,
        }
    }

    fn look(&self, peer: &Self, child: Child) -> Seen {
        Seen {
            own_started: self.started[self.round],
            own_done: self.done,
            peer_started: peer.started[self.round],
            peer_crashed: peer.crashed[self.round],
            peer_done: peer.done,
            child,
            ..NOTHING
        }
    }

    fn start(&mut self) {
        self.round = self.crashed.iter().take_while(|crashed| **crashed).count();
        self.life = Life::Phase(0);
    }

    /// One step with the given state of its child; an agent whose command ends has complete results iff `complete`.
    fn step(&mut self, side: Side, peer: &Self, child: Child, complete: bool) {
        match self.life {
            Life::Phase(phase) => self.act(side, PHASES[usize::from(phase)], peer, child, complete),
            Life::Holding(code) => {
                let conclusion = Conclusion {
                    mark: None,
                    hold: Hold::Peer,
                    code,
                };
                match leave(side, conclusion, &self.look(peer, child), false) {
                    Leave::Wait => {}
                    Leave::Hold(_) => (self.done, self.life) = (true, Life::Gone),
                    Leave::Exit(0) => self.life = Life::Gone,
                    Leave::Exit(_) => self.life = Life::Down,
                }
            }
            Life::Down => self.start(),
            Life::Gone => {}
        }
    }

    fn act(&mut self, side: Side, phase: Phase, peer: &Self, child: Child, complete: bool) {
        let seen = self.look(peer, child);
        match next(side, phase, &seen) {
            Wait => {}
            Action::Skip(_) => {
                self.crashed[self.round] = true;
                self.round += 1;
            }
            Launch if side == Simulator => self.life = Life::Phase(1),
            Launch | Announce => {
                assert!(!self.started[self.round], "{side} starts twice in round {}", self.round);
                (self.started[self.round], self.life) = (true, Life::Phase(2));
            }
            End(cause) => {
                let Conclusion { mark, hold, code } = conclude(side, cause, complete, &seen);
                match mark {
                    Some(EndMark::Done) => self.done = true,
                    Some(EndMark::Crash) => self.crashed[self.round] = true,
                    None => {}
                }
                self.life = if hold == Hold::Peer {
                    Life::Holding(code)
                } else {
                    Life::Gone
                };
            }
        }
    }
}

/// From every state that deaths in any order can lead to, a pair that is left alone (servers that answer, an agent that
/// finishes) ends with both sides done; and no side ever starts twice in one round.
#[test]
fn whatever_dies_when_the_pair_meets_again_and_finishes() {
    let mut known = std::collections::HashSet::from([(Container::new(), Container::new())]);
    let mut open: Vec<_> = known.iter().cloned().collect();
    while let Some((simulator, agent)) = open.pop() {
        assert_left_alone_it_finishes(simulator.clone(), agent.clone());
        for child in [Child::Quiet, Child::Ready, Child::Ended] {
            let (mut next_simulator, mut next_agent) = (simulator.clone(), agent.clone());
            next_simulator.step(Simulator, &agent, child, false);
            next_agent.step(Agent, &simulator, child, false);
            let mut complete = agent.clone();
            complete.step(Agent, &simulator, child, true);
            let mut killed = (simulator.clone(), agent.clone());
            for container in [&mut killed.0, &mut killed.1] {
                // A kill in a hold: the container comes back and finds its own end.
                container.life = if container.life == Life::Gone {
                    Life::Gone
                } else {
                    Life::Down
                };
            }
            let states = [
                (next_simulator, agent.clone()),
                (simulator.clone(), next_agent),
                (simulator.clone(), complete),
                (killed.0, agent.clone()),
                (simulator.clone(), killed.1),
            ];
            for state in states {
                let rounds = |container: &Container| container.crashed.iter().filter(|crashed| **crashed).count();
                if rounds(&state.0).max(rounds(&state.1)) < ROUNDS - 1 && known.insert(state.clone()) {
                    open.push(state);
                }
            }
        }
    }
    assert!(known.len() > 100, "only {} states", known.len());
}

fn assert_left_alone_it_finishes(mut simulator: Container, mut agent: Container) {
    let from = (simulator.clone(), agent.clone());
    for _ in 0..40 {
        simulator.step(Simulator, &agent, Child::Ready, true);
        let child = if agent.life == Life::Phase(2) {
            Child::Ended
        } else {
            Child::Quiet
        };
        agent.step(Agent, &simulator, child, true);
    }
    let finished = simulator.done && agent.done && simulator.life == Life::Gone && agent.life == Life::Gone;
    assert!(finished, "{from:#?} got stuck at {:#?}", (simulator, agent));
}
