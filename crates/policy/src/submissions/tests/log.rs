//! Which log is kept of which failure, from where, and when.

use super::builders::*;
use crate::submissions::{Action, EvalaiUpdate, Plan};
use crate::view::{JobEnd, LogAt, LogPlace, ObservedReport};
use leaderboard_api::Reason;
use leaderboard_api::State::{Cancelled, Failed, Pending, Running};
use leaderboard_contract::report::{Outcome, RefusedResults, Report};

/// The places of a request, in short: `node agent-1`, `last simulator-1` for the run before, `s3 agent/agent1/leaderboard.log`.
pub(super) fn places(plan: &Plan) -> Vec<String> {
    let requests = plan.actions.iter().filter_map(|a| match a {
        Action::KeepLog { places } => Some(places),
        _ => None,
    });
    let requests: Vec<_> = requests.collect();
    assert!(requests.len() <= 1, "{requests:?}");
    requests.into_iter().flatten().map(short).collect()
}

fn short(place: &LogPlace) -> String {
    match &place.at {
        LogAt::Node { previous: false, .. } => format!("node {}", place.container),
        LogAt::Node { previous: true, .. } => format!("last {}", place.container),
        LogAt::Bucket { key } => format!("s3 {key}"),
    }
}

/// The failed Job has gone with its Pod.
fn end_without_pod(world: &mut World) -> Plan {
    world.leaderboard().retries.infrastructure = 0;
    world.job_gone();
    if world.view.report.stored == ObservedReport::NotRead {
        world.view.report.stored = ObservedReport::Absent;
    }
    let plan = world.pass();
    assert_eq!(plan.status.state, Some(Failed), "{:?}", plan.status);
    plan
}

#[test]
fn an_agents_failure_is_explained_by_its_own_log_from_s3() {
    for (word, reason) in [
        ("exited", Reason::AgentCrashed),
        ("idle", Reason::Idle),
        ("cannotStart", Reason::CannotStart),
    ] {
        let mut world = World::local().running();
        world.see(ended("agent-2", 3, word, 1, 100));
        let plan = world.pass_to(Running, Reason::Stopping);
        assert_eq!(plan.status.failure.as_ref().unwrap().worker, Some(2));
        assert_eq!(places(&plan), Vec::<String>::new(), "logcopy stores it yet");
        let mut with_pod = world.clone();
        assert_eq!(
            places(&end_without_pod(&mut world)),
            ["s3 agent/agent2/leaderboard.log"],
            "{reason}"
        );
        with_pod.complete();
        let plan = with_pod.pass_to(Failed, reason);
        assert_eq!(places(&plan), ["s3 agent/agent2/leaderboard.log", "node agent-2"]);
    }
}

#[test]
fn a_failure_of_the_whole_run_is_explained_by_a_pair_that_was_not_done() {
    let mut world = World::local().running();
    world.report(report(2));
    world.pass();
    world.go_to(90_000);
    world.pass_to(Running, Reason::Stopping);
    world.view.report.stored = ObservedReport::Absent;
    assert_eq!(
        places(&end_without_pod(&mut world)),
        ["s3 agent/agent2/leaderboard.log"],
        "pair 1 was done"
    );

    let refused = Report {
        is_final: true,
        refused: Some(RefusedResults::new(
            Some(2),
            "pair 2, record 1: its score is no number.",
        )),
        ..report(1)
    };
    let mut world = World::local().running();
    world.complete();
    world.report(refused.clone());
    let plan = world.pass_to(Failed, Reason::InvalidResults);
    assert_eq!(plan.status.failure.as_ref().unwrap().worker, Some(2));
    assert_eq!(places(&plan)[0], "s3 agent/agent2/leaderboard.log", "the refused one");
    let of_several = Some(RefusedResults::new(None, "pairs 1 and 2 have different sensors"));
    let mut world = World::local().running();
    world.complete();
    world.report(Report {
        refused: of_several,
        ..refused.clone()
    });
    assert_eq!(world.pass().status.failure.unwrap().worker, None);

    let ineligible = Report {
        eligible: false,
        outcome: Outcome::Rejected,
        ..final_report()
    };
    let mut world = World::local().running();
    world.complete();
    world.report(ineligible);
    let plan = world.pass_to(Failed, Reason::NotEligible);
    assert_eq!(places(&plan)[0], "s3 agent/agent1/leaderboard.log", "all were done");
}

#[test]
fn a_simulators_log_is_kept_while_its_pod_lives() {
    let mut world = World::local().running();
    world.see(ended("simulator-1", 3, "exited", 1, 100));
    let plan = world.pass_to(Running, Reason::Stopping);
    assert_eq!(places(&plan), ["node simulator-1"]);
    let mut again = ended("simulator-1", 4, "exited", 1, 100);
    again.running = true;
    world.see(again);
    assert_eq!(
        places(&world.pass()),
        ["last simulator-1"],
        "what runs now has not crashed"
    );
    // The Pod's end took it along.
    assert_eq!(places(&end_without_pod(&mut world)), ["s3 simulator/console-1.log"]);
}

#[test]
fn a_preparation_that_fails_is_explained_by_its_container_before_the_job_is_deleted() {
    for name in ["contents", "workspace", "logcopy"] {
        let mut world = World::local().with_pod();
        world.see(ended(name, 5, "", 3, 1700));
        world.pass();
        world.go_to(1800);
        let plan = world.pass_to(Pending, Reason::Stopping);
        assert_eq!(places(&plan), [format!("node {name}")]);
        let kinds = plan.actions.iter().map(|a| matches!(a, Action::DeleteJob { .. }));
        assert_eq!(kinds.collect::<Vec<_>>(), [false, true], "the log first");
        assert_eq!(
            places(&end_without_pod(&mut world)),
            Vec::<String>::new(),
            "it was kept, or is gone"
        );
    }
}

#[test]
fn results_that_were_not_stored_are_reported_by_logcopy() {
    let mut world = World::local().running();
    world.leaderboard().retries.infrastructure = 0;
    world.complete();
    let mut failed = world.clone();
    let plan = world.pass_to(Failed, Reason::ResultsNotStored);
    assert_eq!(places(&plan), ["node logcopy", "s3 logcopy/logcopy.log"]);

    failed.job().end = Some(JobEnd::Failed {
        at: None,
        reason: "BackoffLimitExceeded".into(),
        message: "no more".into(),
    });
    failed.view.pod = None;
    assert_eq!(
        places(&failed.pass_to(Failed, Reason::JobFailed)),
        ["s3 logcopy/logcopy.log"]
    );
}

#[test]
fn what_never_ran_has_no_log() {
    for (word, reason) in [
        ("ImagePullBackOff", Reason::ImagePull),
        ("CreateContainerConfigError", Reason::ContainerConfig),
    ] {
        let mut world = World::local().with_pod();
        world.see(waiting("agent-1", word, "it is missing"));
        world.pass();
        world.go_to(1800);
        let plan = world.pass_to(Pending, Reason::Stopping);
        assert_eq!(plan.status.failure.as_ref().unwrap().reason, reason);
        assert_eq!(places(&plan), Vec::<String>::new());
        assert_eq!(places(&end_without_pod(&mut world)), Vec::<String>::new());
    }
}

#[test]
fn a_log_is_requested_until_evalai_has_the_end_and_not_after() {
    let mut world = World::evalai().running();
    world.see(ended("agent-1", 3, "exited", 1, 100));
    world.pass();
    world.complete();
    let plan = world.pass_to(Failed, Reason::AgentCrashed);
    assert_eq!(
        (places(&plan).len(), evalai_updates(&plan)),
        (2, vec![]),
        "it is read first"
    );
    let plan = world.pass();
    assert_eq!(
        (places(&plan).len(), evalai_updates(&plan)),
        (2, vec![EvalaiUpdate::Failed]),
        "EvalAI has not answered"
    );
    world.published();
    for _ in 0..2 {
        assert_eq!(places(&world.pass()), Vec::<String>::new());
    }

    let mut world = World::local().running();
    world.see(ended("agent-1", 3, "exited", 1, 100));
    world.pass();
    world.complete();
    assert_eq!(places(&world.pass_to(Failed, Reason::AgentCrashed)).len(), 2);
    assert_eq!(places(&world.pass()), Vec::<String>::new(), "nobody waits for it");
}

#[test]
fn a_cancelled_or_finished_run_has_no_failure_to_explain() {
    let mut world = World::local().running();
    world.see(ended("simulator-1", 3, "exited", 1, 100));
    world.submission().spec.cancel = true;
    assert_eq!(places(&world.pass()), Vec::<String>::new());
    world.complete();
    assert_eq!(
        places(&world.pass_to(Cancelled, Reason::Cancelled)),
        Vec::<String>::new()
    );

    let mut world = World::local().running();
    world.complete();
    world.report(final_report());
    assert_eq!(places(&world.pass()), Vec::<String>::new());
}
