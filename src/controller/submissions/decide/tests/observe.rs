//! Runs that are not published: EvalAI is read, and ends and numbers of routes are compared.

use std::sync::Arc;

use super::builders::*;
use crate::controller::submissions::decide::observe::end_of;
use crate::controller::submissions::decide::{Action, EvalaiUpdate, Plan};
use crate::controller::submissions::other_results::{Answer, Routes};
use crate::controller::submissions::view::{ObservedReport, ObservedRoutes, ObservedTraces};
use leaderboard_api::State::{self, Cancelled, Failed, Finished, Pending};
use leaderboard_api::conditions::{COMPARED, PUBLISHED, STALLED};
use leaderboard_api::{EvalaiMode, reasons};

/// A submission of a Leaderboard that only observes.
fn observed() -> World {
    let mut world = World::evalai();
    let spec = world.leaderboard();
    spec.evalai.as_mut().unwrap().mode = EvalaiMode::Observe;
    spec.storage.prefix = Some("observe/".into());
    spec.table = None;
    world.view.record = None;
    other_has(&mut world, Ok(Routes { done: 4, total: 4 }));
    world
}

/// The routes in the other program's results.
fn other_has(world: &mut World, routes: Answer) {
    world.view.other_routes = ObservedRoutes::Answered(Arc::new(routes));
}

/// The other program's run, as EvalAI shows it at this second.
fn shows(world: &mut World, status: &str, second: i64) {
    let evalai = world.in_evalai();
    evalai.info.as_mut().unwrap().status = status.into();
    evalai.read_at = Some(at(second));
}

fn finished() -> World {
    let mut world = observed().running();
    world.complete();
    world.report(final_report());
    world
}

fn failed() -> World {
    let mut world = observed().running();
    world.report(report(2));
    world.see(ended("agent-1", 3, "exited", 1, 100));
    world.pass();
    world.complete();
    world.report(report(2));
    world
}

/// How a run ends, as what, what EvalAI shows of the other one, and what is concluded.
type Case = (fn() -> World, State, &'static str, &'static str, &'static str);

#[test]
fn an_end_is_compared_and_no_end_is_sent() {
    let cases: [Case; 5] = [
        (finished, Finished, "finished", "True", reasons::SAME_END),
        (finished, Finished, "failed", "False", reasons::DIFFERENT_END),
        (failed, Failed, "failed", "True", reasons::SAME_END),
        (failed, Failed, "finished", "False", reasons::DIFFERENT_END),
        (finished, Finished, "cancelled", "False", reasons::DIFFERENT_END),
    ];
    for (end, ours, theirs, truth, reason) in cases {
        let mut world = end();
        shows(&mut world, theirs, 10);
        let first = world.pass();
        assert_eq!(first.status.state, Some(ours));
        let plan = world.pass();
        assert_eq!(condition(&plan, COMPARED), (truth.into(), reason.into()), "{theirs}");
        assert_eq!(
            condition(&plan, PUBLISHED),
            ("False".into(), reasons::NOT_REQUIRED.into())
        );
        for plan in [&first, &plan] {
            let is_end = |update: &EvalaiUpdate| {
                use EvalaiUpdate::{Cancelled, Failed, Finished};
                matches!(update, Finished | Failed | Cancelled)
            };
            assert!(!evalai_updates(plan).iter().any(is_end), "{theirs}");
        }
        assert!(has(&plan, |a| *a == Action::Forget), "nothing more is asked");
        let is_shown = [&first, &plan]
            .iter()
            .any(|plan| events(plan).contains(&reasons::DIFFERENT_END));
        assert_eq!(is_shown, truth == "False", "{theirs}");
    }
}

#[test]
fn the_other_end_is_waited_for_and_read_again() {
    let mut world = finished();
    world.go_to(100);
    shows(&mut world, "partially_evaluated", 90);
    world.pass();
    let plan = world.pass_to(Finished, reasons::FINISHED);
    let waiting = ("Unknown".to_owned(), reasons::AWAITING_OTHER_END.to_owned());
    assert_eq!(condition(&plan, COMPARED), waiting);
    assert!(!has(&plan, |a| matches!(a, Action::Forget | Action::ForgetEvalai)));
    world.go_to(390);
    assert!(
        has(&world.pass(), |a| *a == Action::ForgetEvalai),
        "it is five minutes old"
    );
    world.in_evalai().info = None;
    assert!(has(&world.pass(), |a| *a == Action::AskEvalai));
    world.in_evalai().info = Some(info());
    shows(&mut world, "finished", 391);
    assert_eq!(condition(&world.pass(), COMPARED).0, "True");
}

#[test]
fn routes_are_read_once_and_compared_where_the_ends_are_the_same() {
    let has = |done, total| Ok(Routes { done, total });
    let missing: Answer = Err("there is no s3://results/1/agent/agent_results.json".into());
    let cases = [
        (
            finished as fn() -> World,
            "finished",
            has(4, 4),
            reasons::SAME_END,
            "has 4 of 4",
        ),
        (
            finished,
            "finished",
            has(3, 4),
            reasons::DIFFERENT_ROUTES,
            "have 3 of 4",
        ),
        (
            finished,
            "finished",
            has(20, 20),
            reasons::DIFFERENT_ROUTES,
            "have 20 of 20",
        ),
        (failed, "failed", has(0, 4), reasons::SAME_END, "have 0 of 4"),
        (failed, "failed", has(4, 5), reasons::DIFFERENT_ROUTES, "have 4 of 5"),
        (failed, "finished", has(4, 4), reasons::DIFFERENT_END, "have 4 of 4"),
        (
            finished,
            "finished",
            missing,
            reasons::SAME_END,
            "were not compared: there is no s3://",
        ),
    ];
    for (end, theirs, routes, reason, words) in cases {
        let mut world = end();
        world.view.other_routes = ObservedRoutes::NotAsked;
        shows(&mut world, theirs, 10);
        world.pass();
        let plan = world.pass();
        assert!(has_action(&plan), "{theirs} {routes:?}");
        assert_eq!(condition(&plan, COMPARED).1, reasons::AWAITING_OTHER_END);
        other_has(&mut world, routes.clone());
        let plan = world.pass();
        assert!(!has_action(&plan));
        assert_eq!(condition(&plan, COMPARED).1, reason, "{theirs} {routes:?}");
        let shown = plan.status.conditions.iter().find(|c| c.type_ == COMPARED).unwrap();
        assert!(shown.message.contains(words), "{}", shown.message);
        assert_eq!(events(&plan).contains(&reason), reason != reasons::SAME_END);
    }
}

fn has_action(plan: &Plan) -> bool {
    has(plan, |action| matches!(action, Action::ReadOtherResults(_)))
}

#[test]
fn nobody_looks_whether_another_program_runs_what_is_only_observed() {
    let mut world = observed();
    world.view.traces = ObservedTraces::NotAsked;
    assert!(creates(&world.pass_to(Pending, reasons::PREPARING)));
}

#[test]
fn what_never_ran_is_not_compared() {
    let mut world = observed();
    world.submission().spec.cancel = true;
    world.view.report = ObservedReport::Absent;
    let plan = world.pass_to(Cancelled, reasons::CANCELLED);
    assert_eq!(condition(&plan, COMPARED).0, "");
    assert_ne!(condition(&world.pass(), STALLED).0, "True");
    assert_eq!(condition(&world.pass(), COMPARED).0, "");
}

#[test]
fn each_status_of_evalai_is_an_end_or_none() {
    for (status, end) in [
        ("finished", Some(Finished)),
        ("failed", Some(Failed)),
        ("cancelled", Some(Cancelled)),
        ("archived", Some(Cancelled)),
        ("submitted", None),
        ("running", None),
        ("partially_evaluated", None),
        ("resuming", None),
    ] {
        assert_eq!(end_of(status), end, "{status}");
    }
}
