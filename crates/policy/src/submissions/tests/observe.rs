//! Runs that are not published: EvalAI and the table are left as they are.

use super::builders::*;
use crate::ask::Lookup;
use crate::submissions::{Action, EvalaiUpdate, Question};
use leaderboard_api::State::{Failed, Finished, Pending};
use leaderboard_api::conditions::PUBLISHED;
use leaderboard_api::evalai_status::Status;
use leaderboard_api::{EvalaiMode, Reason};

/// A submission of a Leaderboard that only observes.
fn observed() -> World {
    let mut world = World::evalai();
    let spec = world.leaderboard();
    spec.evalai.as_mut().unwrap().mode = EvalaiMode::Observe;
    spec.storage.s3.prefix = Some("observe/".into());
    spec.table = None;
    world.view.record = None;
    world
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

#[test]
fn no_end_is_sent_to_evalai() {
    for (mut world, state) in [(finished(), Finished), (failed(), Failed)] {
        // The other program's run goes on.
        world.in_evalai().info.as_mut().unwrap().status = Status::PartiallyEvaluated;
        let first = world.pass();
        assert_eq!(first.status.state, Some(state));
        let plan = world.pass();
        let is_end = |update: &EvalaiUpdate| {
            use EvalaiUpdate::{Cancelled, Failed, Finished};
            matches!(update, Finished | Failed | Cancelled)
        };
        for plan in [&first, &plan] {
            assert!(!evalai_updates(plan).iter().any(is_end), "{state:?}");
        }
        assert_eq!(
            condition(&plan, PUBLISHED),
            ("False".into(), Reason::NotRequired.into())
        );
        assert!(has(&plan, |a| *a == Action::Forget), "nothing more is asked");
    }
}

#[test]
fn nobody_looks_whether_another_program_runs_what_is_only_observed() {
    let mut world = observed();
    world.view.row = Lookup::default();
    let plan = world.pass_to(Pending, Reason::Preparing);
    assert!(creates(&plan) && !has(&plan, |a| matches!(a, Action::Ask(Question::Row(_)))));
}
