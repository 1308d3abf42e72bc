//! A walk of both kinds of pairs through every interleaving of their deaths.

use super::Action::{Announce, End, Launch, Wait};
use super::Part::{Driver, Evaluator, Plain, Simulator};
use super::Phase::{Booting, Opening, Running};
use super::tests::NOTHING;
use super::*;

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

    fn look(&self, peer: &Self, world: World) -> Seen {
        Seen {
            own_started: self.started[self.round],
            own_done: self.done,
            peer_started: peer.started[self.round],
            peer_crashed: peer.crashed[self.round],
            peer_done: peer.done,
            has_result: world.has_result,
            child: world.child,
            ..NOTHING
        }
    }

    fn start(&mut self) {
        self.round = self.crashed.iter().take_while(|crashed| **crashed).count();
        self.life = Life::Phase(0);
    }

    /// One step in the given world.
    fn step(&mut self, part: Part, peer: &Self, world: World) {
        match self.life {
            Life::Phase(phase) => self.act(part, PHASES[usize::from(phase)], peer, world),
            Life::Holding(code) => {
                let conclusion = Conclusion {
                    mark: None,
                    hold: Hold::Peer,
                    code,
                };
                match leave(part, conclusion, &self.look(peer, world), false) {
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

    fn act(&mut self, part: Part, phase: Phase, peer: &Self, world: World) {
        let seen = self.look(peer, world);
        match next(part, phase, &seen) {
            Wait => {}
            Action::Skip(_) => {
                self.crashed[self.round] = true;
                self.round += 1;
            }
            Launch if part.is_host() => self.life = Life::Phase(1),
            Launch | Announce => {
                assert!(
                    !self.started[self.round],
                    "{part:?} starts twice in round {}",
                    self.round
                );
                (self.started[self.round], self.life) = (true, Life::Phase(2));
            }
            End(cause) => {
                let complete = world.complete || world.has_result;
                let Conclusion { mark, hold, code } = conclude(part, cause, complete, &seen);
                match mark {
                    Some(EndMark::Done) => {
                        assert!(
                            part != Evaluator || world.has_result,
                            "an evaluator is done by {cause:?}"
                        );
                        self.done = true;
                    }
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

/// What a container's processes do in one step.
#[derive(Debug, Clone, Copy)]
struct World {
    child: Child,
    /// An agent's end is complete.
    complete: bool,
    /// An evaluator's result is complete.
    has_result: bool,
}

const fn world(child: Child) -> World {
    World {
        child,
        complete: false,
        has_result: false,
    }
}

/// From every state that deaths in any order can lead to, a pair that is left alone (hosts that are ready, an agent that
/// finishes, and then an evaluator that does) ends with both sides done; and no side ever starts twice in one round.
#[test]
fn whatever_dies_when_the_pair_meets_again_and_finishes() {
    for pair in [(Simulator, Driver), (Evaluator, Plain)] {
        let known = walk(pair);
        assert!(known > 100, "{pair:?}: only {known} states");
    }
}

fn walk((host, agent): (Part, Part)) -> usize {
    let mut known = std::collections::HashSet::from([(Container::new(), Container::new())]);
    let mut open: Vec<_> = known.iter().cloned().collect();
    while let Some((own, its)) = open.pop() {
        assert_left_alone_it_finishes((host, agent), own.clone(), its.clone());
        let mut states = Vec::new();
        for child in [Child::Quiet, Child::Ready, Child::Ended] {
            let quiet = world(child);
            let complete = World {
                complete: true,
                ..quiet
            };
            let result = World {
                has_result: host == Evaluator,
                ..quiet
            };
            for world in [quiet, result] {
                let mut next = own.clone();
                next.step(host, &its, world);
                states.push((next, its.clone()));
            }
            for world in [quiet, complete] {
                let mut next = its.clone();
                next.step(agent, &own, world);
                states.push((own.clone(), next));
            }
        }
        states.extend([(killed(&own), its.clone()), (own, killed(&its))]);
        for state in states {
            let rounds = |container: &Container| container.crashed.iter().filter(|crashed| **crashed).count();
            if rounds(&state.0).max(rounds(&state.1)) < ROUNDS - 1 && known.insert(state.clone()) {
                open.push(state);
            }
        }
    }
    known.len()
}

/// A kill, in a hold too: the container comes back and finds its own end.
fn killed(container: &Container) -> Container {
    let life = if container.life == Life::Gone {
        Life::Gone
    } else {
        Life::Down
    };
    Container {
        life,
        ..container.clone()
    }
}

fn assert_left_alone_it_finishes((host, agent): (Part, Part), mut own: Container, mut its: Container) {
    let from = (own.clone(), its.clone());
    for _ in 0..40 {
        let ready = World {
            has_result: host == Evaluator && its.done,
            ..world(Child::Ready)
        };
        own.step(host, &its, ready);
        let child = if its.life == Life::Phase(2) {
            Child::Ended
        } else {
            Child::Quiet
        };
        let finishes = World {
            complete: true,
            ..world(child)
        };
        its.step(agent, &own, finishes);
    }
    let finished = own.done && its.done && own.life == Life::Gone && its.life == Life::Gone;
    assert!(
        finished,
        "{host:?} and {agent:?} from {from:#?} got stuck at {:#?}",
        (own, its)
    );
}
