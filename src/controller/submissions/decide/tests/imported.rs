//! Submissions that were imported from a table: the controller shows them, and writes nothing anywhere.

use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;

use super::builders::*;
use crate::controller::submissions::decide::{Action, decide};
use leaderboard_api::State::{Cancelled, Failed, Finished};
use leaderboard_api::{Attempt, ImportedEnd, ImportedState, Rerun, Score, State, SubmissionStatus, Times, names};

const STATES: [(ImportedState, State); 3] = [
    (ImportedState::Finished, Finished),
    (ImportedState::Failed, Failed),
    (ImportedState::Cancelled, Cancelled),
];

fn imported(mut world: World, state: ImportedState) -> World {
    let table = (names::ANNOTATION_IMPORTED.to_owned(), "leaderboard-20".to_owned());
    let end = ImportedEnd {
        state,
        track: "sensors".into(),
        results_url: Some("s3://results/77".into()),
        progress: None,
        score: Some(Score::new(43.1, Some(80.0), Some(0.5), true)),
        times: Times::default(),
        table: table.1.clone(),
    };
    // As the command makes it: no finalizer, and nothing is known of it yet.
    let submission = world.submission();
    submission.metadata.annotations = Some([table].into());
    submission.metadata.finalizers = None;
    submission.status = Some(SubmissionStatus::of_imported(&submission.spec, end, 1, &Time(at(0))));
    world.view.evalai = None;
    world
}

#[test]
fn an_imported_end_is_shown_and_published_and_recorded_nowhere() {
    for (state, shown) in STATES {
        for begin in [World::local, World::evalai] {
            let mut world = imported(begin(), state);
            for _ in 0..3 {
                let before = world.status();
                assert_eq!(before.state, Some(shown));
                let plan = world.pass();
                assert_eq!(plan.status, before, "not even the status is written");
                assert_eq!(plan.actions, [Action::Forget]);
                assert_eq!((plan.events.len(), plan.report), (0, None));
                world.wait(3600);
            }
            // Applied in the wrong order, or removed later.
            world.view.leaderboard = None;
            let before = world.status();
            let plan = world.pass();
            assert_eq!((plan.status, plan.actions), (before, vec![Action::Forget]));
        }
    }
}

#[test]
fn one_without_its_status_is_left_alone_however_long_that_takes() {
    for begin in [World::local, World::evalai] {
        let mut world = imported(begin(), ImportedState::Finished);
        world.submission().status = None;
        for _ in 0..3 {
            let plan = decide(&world.view);
            assert_eq!((plan.actions, plan.requeue), (vec![], None));
            assert_eq!((plan.status, plan.events), (SubmissionStatus::default(), vec![]));
            world.wait(3600);
        }
    }
}

#[test]
fn a_failed_one_is_resumed_as_any_other() {
    let mut world = imported(World::local(), ImportedState::Failed);
    world.submission().spec.attempt = Attempt(2);
    world.submission().metadata.generation = Some(2);
    world.pass();
    let plan = world.pass();
    assert_eq!(plan.status.attempt, Some(Attempt(2)));
    assert!(plan.actions.iter().any(|action| matches!(action, Action::CreateJob(_))));
    assert!(
        plan.status.plan.is_some_and(|plan| plan.resume),
        "it goes on from what is stored"
    );
}

#[test]
fn a_later_rerun_in_evalai_changes_no_row() {
    let mut world = imported(World::evalai(), ImportedState::Finished);
    world.view.rerun_as = Some(Rerun {
        submission_name: "submission-78".into(),
        time: None,
    });
    world.in_evalai().info = Some(crate::controller::submissions::view::EvalaiInfo {
        status: "cancelled".into(),
        ..info()
    });
    for _ in 0..3 {
        let plan = world.pass();
        assert!(
            !plan
                .actions
                .iter()
                .any(|action| matches!(action, Action::UpdateEvalai(_)))
        );
    }
    assert_eq!(world.status().state, Some(Finished));
}
