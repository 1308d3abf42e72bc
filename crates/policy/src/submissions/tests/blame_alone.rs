//! The table of blame, where agent and evaluator never live at one time: each end speaks for its own container.

use super::blame::since;
use super::builders::*;
use crate::submissions::blame::alone::last_crash;
use crate::view::ContainerView;
use leaderboard_api::EndReason;

/// A container in its third life, which has ended like this at second 100.
fn third(name: &str, what: &str, exit_code: i32) -> ContainerView {
    ended(name, 2, what, exit_code, 100)
}

#[track_caller]
fn is_judged(host: Option<&ContainerView>, agent: Option<&ContainerView>, expected: Option<EndReason>) {
    let found = last_crash(host, agent, Some(&running("logcopy")));
    assert_eq!(found.map(|crash| crash.cause), expected, "{host:?} {agent:?}");
    assert!(found.is_none_or(|crash| crash.is_settled), "nothing is waited for");
}

#[test]
fn an_agents_end_is_its_own_whatever_it_reports_and_its_nodes_where_that_refused_it() {
    use EndReason::{BlamesHost, CannotStart, Exited, Idle, Killed, NoGPU, NodeCannotStart, SilentDeath};
    for (what, exit_code, expected) in [
        ("exited", 1, Some(Exited)),
        ("idle", 1, Some(Idle)),
        ("silentDeath", 137, Some(SilentDeath)),
        ("cannotStart", 127, Some(CannotStart)),
        ("killed", 1, Some(Killed)),
        ("peerCrashed", 1, Some(BlamesHost)),
        ("noGpu", 1, Some(BlamesHost)),
        ("noGpu", 69, Some(NoGPU)),
        ("nodeRefused", 71, Some(NodeCannotStart)),
        // Nothing of its earlier lives is left to use processes up.
        ("noProcess", 75, Some(NodeCannotStart)),
        ("stopped", 143, None),
        ("cancelled", 0, None),
        ("incomplete", 0, None),
    ] {
        is_judged(None, Some(&third("agent-1", what, exit_code)), expected);
    }
    // It was not asked to end: the kubelet starts it again.
    is_judged(None, Some(&restarted("agent-1", 1, "stopped", 143, 100)), Some(Killed));
    // Nobody has waited for it, and nobody is waited for.
    let never_ran = waiting("evaluator-1", "PodInitializing", "");
    is_judged(Some(&never_ran), Some(&third("agent-1", "exited", 1)), Some(Exited));
    is_judged(Some(&never_ran), Some(&running("agent-1")), None);
}

#[test]
fn an_evaluators_end_is_its_own_whatever_became_of_the_agent() {
    use EndReason::{EvaluatorCrashed, EvaluatorNotReady, EvaluatorNotStarted, NoGPU};
    let mut unstarted = third("evaluator-1", "", 128);
    "StartError".clone_into(&mut unstarted.last.as_mut().unwrap().reason);
    let agent = since(1, ended("agent-1", 3, "incomplete", 0, 90));
    for (evaluator, expected) in [
        (third("evaluator-1", "exited", 1), Some(EvaluatorCrashed)),
        (third("evaluator-1", "silentDeath", 137), Some(EvaluatorCrashed)),
        (third("evaluator-1", "noResult", 1), Some(EvaluatorNotReady)),
        (third("evaluator-1", "noGpu", 69), Some(NoGPU)),
        (third("evaluator-1", "noProcess", 75), Some(EvaluatorCrashed)),
        (third("evaluator-1", "portTaken", 1), Some(EvaluatorCrashed)),
        (unstarted, Some(EvaluatorNotStarted)),
        (third("evaluator-1", "finished", 0), None),
        (third("evaluator-1", "stopped", 143), None),
        (running("evaluator-1"), None),
    ] {
        for agent in [None, Some(&agent)] {
            is_judged(Some(&evaluator), agent, expected);
        }
    }
}

#[test]
fn what_ends_together_with_logcopy_was_ended_from_outside() {
    use EndReason::{EndedFromOutside, EvaluatorCrashed, Exited, Killed, SilentDeath};
    let logcopy = |exit_code, reason: &str| {
        let mut container = restarted("logcopy", 1, "", exit_code, 100);
        reason.clone_into(&mut container.last.as_mut().unwrap().reason);
        container
    };
    let (lost, asked) = (logcopy(255, "Unknown"), logcopy(0, "Completed"));
    let (no_memory, broken) = (logcopy(137, "OOMKilled"), logcopy(1, "Error"));
    let agent = |what| restarted("agent-1", 3, what, 137, 100);
    let later = since(101, ended("agent-1", 3, "silentDeath", 137, 160));
    for (logcopy, container, expected) in [
        (&lost, agent("silentDeath"), EndedFromOutside),
        (&asked, agent("stopped"), EndedFromOutside),
        (&lost, agent(""), EndedFromOutside),
        (&lost, agent("exited"), Exited),
        (&lost, later, SilentDeath),
        (&no_memory, agent("silentDeath"), SilentDeath),
        (&broken, agent("stopped"), Killed),
    ] {
        let found = last_crash(None, Some(&container), Some(logcopy)).unwrap();
        assert_eq!(
            (found.cause, found.is_settled),
            (expected, true),
            "{container:?} {logcopy:?}"
        );
    }
    for (logcopy, expected) in [(&lost, EndedFromOutside), (&no_memory, EvaluatorCrashed)] {
        let evaluator = restarted("evaluator-1", 3, "silentDeath", 137, 100);
        let done = ended("agent-1", 1, "incomplete", 0, 40);
        for agent in [None, Some(&done)] {
            let found = last_crash(Some(&evaluator), agent, Some(logcopy)).unwrap();
            assert_eq!(found.cause, expected, "{logcopy:?}");
        }
    }
}
