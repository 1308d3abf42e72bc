//! The table of blame, where the host's container is an evaluator: it has the last word, and its agent writes no results.

use super::blame::Expected::{self, Awaited, NoCrash, Settled};
use super::blame::{Row, check_of, row};
use super::builders::*;
use crate::view::ContainerView;
use leaderboard_api::EndReason;
use leaderboard_protocol::files::Host;

fn check(rows: Vec<Row>) {
    check_of(Host::Evaluator, rows);
}

/// Both sides ended in round 2, at the same second.
fn both(what: &'static str, evaluator: &str, agent: &str, cause: EndReason) -> Row {
    let evaluator = ended("evaluator-1", 2, evaluator, 1, 100);
    row(what, evaluator, ended("agent-1", 2, agent, 1, 100), Settled(cause))
}

/// The agent has come to its regular end long before.
fn after_agent(what: &'static str, evaluator: ContainerView, expected: Expected) -> Row {
    row(what, evaluator, ended("agent-1", 0, "incomplete", 0, 20), expected)
}

#[test]
fn an_evaluator_that_failed_in_the_round_is_the_cause_whatever_the_agent_reports() {
    use EndReason::{EvaluatorCrashed, EvaluatorNotReady, EvaluatorNotStarted, NoGPU};
    check(vec![
        both("exited", "exited", "peerCrashed", EvaluatorCrashed),
        both("the agent noticed first", "exited", "exited", EvaluatorCrashed),
        both("killed with its runner", "silentDeath", "peerCrashed", EvaluatorCrashed),
        both(
            "could not start its command",
            "cannotStart",
            "peerCrashed",
            EvaluatorCrashed,
        ),
        both("did not listen", "notReady", "notReady", EvaluatorNotReady),
        both("no GPU", "noGpu", "peerCrashed", NoGPU),
        row(
            "it never ran",
            waiting("evaluator-1", "ErrImagePull", "no such image"),
            ended("agent-1", 0, "notReady", 1, 100),
            Settled(EvaluatorNotStarted),
        ),
        after_agent(
            "no final result in time",
            ended("evaluator-1", 2, "noResult", 1, 100),
            Settled(EvaluatorNotReady),
        ),
        after_agent(
            "crashed over its result",
            restarted("evaluator-1", 1, "exited", 1, 100),
            Settled(EvaluatorCrashed),
        ),
    ]);
}

#[test]
fn an_agent_whose_evaluator_followed_it_is_the_cause_by_its_own_report() {
    use EndReason::{BlamesHost, Exited, Idle, PortTaken, SilentDeath, Unseen};
    check(vec![
        both("exited", "peerCrashed", "exited", Exited),
        both("idle", "peerCrashed", "idle", Idle),
        both("killed with its runner", "peerCrashed", "silentDeath", SilentDeath),
        both("claims a regular end", "peerCrashed", "incomplete", Exited),
        both("blames its evaluator", "peerCrashed", "notReady", BlamesHost),
        both("forged its end", "noResult", "peerCrashed", BlamesHost),
        both("forged its end and crashed", "noResult", "exited", Exited),
        both("took its port", "portTaken", "peerCrashed", PortTaken),
        row(
            "its own end is not seen yet",
            ended("evaluator-1", 2, "peerCrashed", 1, 100),
            restarted("agent-1", 2, "exited", 1, 40),
            Awaited(Unseen),
        ),
    ]);
}

#[test]
fn after_a_complete_result_no_end_of_the_agent_is_a_crash() {
    let done = || ended("evaluator-1", 0, "finished", 0, 100);
    check(vec![
        row("it was ended", done(), ended("agent-1", 0, "finished", 0, 101), NoCrash),
        row("it had crashed", done(), ended("agent-1", 0, "exited", 1, 99), NoCrash),
        row(
            "its runner was killed",
            done(),
            ended("agent-1", 0, "silentDeath", 137, 101),
            NoCrash,
        ),
        row("it runs on", done(), running("agent-1"), NoCrash),
        after_agent("its agent ended first", done(), NoCrash),
    ]);
}
