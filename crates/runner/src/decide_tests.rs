//! The tables of the state machine, and a walk of both sides through every interleaving of their deaths.

use leaderboard_runner::protocol::Side::{self, Agent, Simulator};

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

#[test]
fn next_follows_the_table() {
    let silent_death = Action::Skip(Skip::SilentDeath);
    let catch_up = Action::Skip(Skip::CatchUp);
    let cases = [
        (Simulator, Opening, "", Launch),
        (Simulator, Opening, "peer-started", Launch),
        (Simulator, Opening, "own-started", silent_death),
        (Simulator, Opening, "own-started cancel", silent_death),
        (Simulator, Opening, "own-started peer-crashed", silent_death),
        (Simulator, Opening, "own-started peer-done", End(Cause::PeerDone)),
        (
            Simulator,
            Opening,
            "own-started own-done peer-done",
            End(Cause::AlreadyDone),
        ),
        (Simulator, Opening, "peer-crashed", catch_up),
        (Simulator, Opening, "cancel peer-crashed", End(Cause::Cancelled)),
        (Simulator, Opening, "stored", End(Cause::Cancelled)),
        (Simulator, Opening, "terminated own-started", End(Cause::Terminated)),
        (Simulator, Booting, "", Wait),
        (Simulator, Booting, "ready", Announce),
        (Simulator, Booting, "ready overdue", Announce),
        (Simulator, Booting, "ready peer-crashed", catch_up),
        (Simulator, Booting, "overdue", End(Cause::NotReady)),
        (Simulator, Booting, "ended", End(Cause::ChildEnded)),
        (Simulator, Booting, "cancel ended", End(Cause::Cancelled)),
        (Simulator, Booting, "stored", End(Cause::Cancelled)),
        (Simulator, Booting, "peer-done ready cancel", End(Cause::PeerDone)),
        (Simulator, Running, "own-started", Wait),
        (Simulator, Running, "own-started peer-started overdue stored", Wait),
        (
            Simulator,
            Running,
            "peer-done peer-crashed ended cancel",
            End(Cause::PeerDone),
        ),
        (Simulator, Running, "cancel peer-crashed ended", End(Cause::Cancelled)),
        (Simulator, Running, "peer-crashed ended", End(Cause::PeerCrashed)),
        (Simulator, Running, "ended", End(Cause::ChildEnded)),
        (Simulator, Running, "terminated peer-done", End(Cause::Terminated)),
        (Agent, Opening, "", Wait),
        (Agent, Opening, "peer-started", Launch),
        (Agent, Opening, "peer-started overdue", Launch),
        (Agent, Opening, "overdue", End(Cause::NotReady)),
        (Agent, Opening, "own-started peer-started", silent_death),
        (
            Agent,
            Opening,
            "own-started peer-started peer-crashed cancel",
            silent_death,
        ),
        (Agent, Opening, "peer-started peer-crashed", catch_up),
        (Agent, Opening, "peer-crashed overdue", catch_up),
        (Agent, Opening, "cancel peer-started", End(Cause::Cancelled)),
        (Agent, Opening, "stored peer-started", End(Cause::Cancelled)),
        (Agent, Opening, "own-started own-done", End(Cause::AlreadyDone)),
        (Agent, Running, "peer-started", Wait),
        (Agent, Running, "stored", Wait),
        (Agent, Running, "ended cancel peer-crashed idle", End(Cause::ChildEnded)),
        (Agent, Running, "cancel peer-crashed idle", End(Cause::Cancelled)),
        (Agent, Running, "peer-crashed idle", End(Cause::PeerCrashed)),
        (Agent, Running, "idle", End(Cause::Idle)),
        (Agent, Running, "terminated ended", End(Cause::Terminated)),
    ];
    for (side, phase, words, expected) in cases {
        assert_eq!(next(side, phase, &seen(words)), expected, "{side} {phase:?}: {words}");
    }
}

#[test]
fn an_end_is_concluded_by_the_table() {
    let crash = Some(EndMark::Crash);
    let done = Some(EndMark::Done);
    let cases = [
        (Simulator, Cause::PeerDone, false, "peer-done", done, Hold::Flush, 0),
        (
            Simulator,
            Cause::PeerDone,
            false,
            "peer-done cancel",
            done,
            Hold::Flush,
            0,
        ),
        (
            Simulator,
            Cause::PeerCrashed,
            false,
            "peer-crashed",
            crash,
            Hold::Peer,
            1,
        ),
        (
            Simulator,
            Cause::PeerCrashed,
            false,
            "peer-crashed cancel",
            None,
            Hold::Cancel,
            0,
        ),
        (Simulator, Cause::ChildEnded, false, "", crash, Hold::Peer, 1),
        (Simulator, Cause::ChildEnded, false, "peer-done", done, Hold::Flush, 0),
        (Simulator, Cause::NotReady, false, "", crash, Hold::Peer, 1),
        (Simulator, Cause::CannotStart(127), false, "", crash, Hold::Peer, 127),
        (Simulator, Cause::NoGpu, false, "", crash, Hold::Free, 69),
        (
            Simulator,
            Cause::GraphicsDriverMissing,
            false,
            "",
            crash,
            Hold::Free,
            69,
        ),
        (Simulator, Cause::Cancelled, false, "cancel", None, Hold::Cancel, 0),
        (Simulator, Cause::AlreadyDone, false, "own-done", None, Hold::Flush, 0),
        (Simulator, Cause::Terminated, false, "terminated", None, Hold::Free, 143),
        (Simulator, Cause::Mute, false, "", None, Hold::Free, 74),
        (Agent, Cause::ChildEnded, true, "", done, Hold::Peer, 0),
        (Agent, Cause::ChildEnded, true, "cancel", done, Hold::Peer, 0),
        (Agent, Cause::ChildEnded, false, "", crash, Hold::Peer, 1),
        (Agent, Cause::ChildEnded, false, "cancel", None, Hold::Free, 0),
        (Agent, Cause::PeerCrashed, true, "peer-crashed", done, Hold::Peer, 0),
        (Agent, Cause::PeerCrashed, false, "peer-crashed", crash, Hold::Peer, 1),
        (Agent, Cause::Idle, true, "", done, Hold::Peer, 0),
        (Agent, Cause::Idle, false, "", crash, Hold::Peer, 1),
        (Agent, Cause::NotReady, true, "", crash, Hold::Peer, 1),
        (Agent, Cause::CannotStart(126), true, "", crash, Hold::Peer, 126),
        (Agent, Cause::Cancelled, true, "cancel", None, Hold::Free, 0),
        (Agent, Cause::AlreadyDone, true, "own-done", None, Hold::Free, 0),
        (Agent, Cause::Terminated, true, "terminated", None, Hold::Free, 143),
        (Agent, Cause::Mute, true, "", None, Hold::Free, 74),
    ];
    for (side, cause, complete, words, mark, hold, code) in cases {
        let expected = Conclusion { mark, hold, code };
        assert_eq!(
            conclude(side, cause, complete, &seen(words)),
            expected,
            "{side} {cause:?} {complete}: {words}"
        );
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
