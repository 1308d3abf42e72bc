//! Higher attempts: what is kept, what is renewed, and what is not theirs.

use serde_json::json;

use super::builders::*;
use crate::submissions::{Action, EvalaiUpdate};
use crate::view::{EvalaiView, ObservedReport, Standing};
use leaderboard_api::State::{Cancelled, Failed, Finished, Pending, Resumed};
use leaderboard_api::conditions::{FINISHED, PUBLISHED, STALLED};
use leaderboard_api::{Attempt, JobNumber, Reason, names};

fn failed() -> World {
    let mut world = World::evalai().running();
    world.report(report(2));
    world.see(ended("agent-1", 3, "exited", 1, 100));
    world.pass();
    world.complete();
    world.report(report(2));
    world.pass_to(Failed, Reason::AgentCrashed);
    world.view.report.stored = ObservedReport::NotRead;
    world
}

fn cancelled() -> World {
    let mut world = World::evalai().running();
    world.report(report(2));
    world.pass();
    world.submission().spec.cancel = true;
    world.pass();
    world.complete();
    world.report(report(2));
    world.pass_to(Cancelled, Reason::Cancelled);
    world.view.report.stored = ObservedReport::NotRead;
    world
}

#[test]
fn the_plan_is_kept_and_the_images_renewed() {
    for mut world in [failed(), cancelled()] {
        let before = world.status().plan.unwrap();
        let spec = world.leaderboard();
        let carla = spec.evaluation.carla_mut().unwrap();
        (carla.pairs, carla.routes) = (4, 8);
        carla.simulator.image = "simulator:2".into();
        world.submission().spec.attempt = Attempt(2);
        world.submission().spec.cancel = false;
        let plan = world.pass_to(Pending, Reason::Preparing);
        assert_eq!(plan.actions, [], "all that was observed is the first attempt's");
        assert_eq!(plan.requeue, Some(std::time::Duration::ZERO));
        assert_eq!(condition(&plan, FINISHED).0, "False");
        assert_eq!(condition(&plan, PUBLISHED).0, "");
        assert_eq!(plan.status.progress.as_ref().unwrap().text, "2/4");
        assert_eq!((plan.status.retry, plan.status.failure.as_ref()), (0, None));

        world.job_gone();
        world.view.evalai = Some(EvalaiView {
            info: Some(info()),
            ..EvalaiView::default()
        });
        let plan = world.pass();
        assert!(has(&plan, |a| *a == Action::CreateJob(JobNumber::first(Attempt(2)))));
        assert_eq!(evalai_updates(&plan), [EvalaiUpdate::Queued]);
        let pinned = plan.status.plan.unwrap();
        assert!(pinned.resume);
        let (carla, before) = (pinned.carla().unwrap(), before.carla().unwrap());
        assert_eq!(carla.simulator_image, "simulator:2");
        assert_eq!((&carla.slices, carla.routes), (&before.slices, before.routes));

        world.see_job();
        world.view.pod = Some(pod(500));
        world.see_agents();
        world.pass_to(Resumed, Reason::Resumed);
    }
}

#[test]
fn an_attempt_that_begins_on_its_own_old_job_does_not_end_by_it() {
    let mut world = failed();
    world.submission().spec.attempt = Attempt(2);
    world.pass();
    // The watch is slow: the first attempt's Job is still what is seen.
    let plan = world.pass_to(Pending, Reason::Preparing);
    assert_eq!(plan.status.attempt, Some(Attempt(2)));
    assert!(!creates(&plan));
}

#[test]
fn finished_is_final() {
    let mut world = World::local().running();
    world.complete();
    world.report(final_report());
    world.pass_to(Finished, Reason::Finished);
    world.submission().spec.attempt = Attempt(2);
    assert_eq!(
        world.pass_to(Finished, Reason::Finished).status.attempt,
        Some(Attempt(1))
    );
}

#[test]
fn a_jump_or_a_first_attempt_above_one_is_an_attempt_like_any() {
    let mut world = failed();
    world.submission().spec.attempt = Attempt(9);
    assert_eq!(world.pass().status.attempt, Some(Attempt(9)));

    let mut world = World::local();
    world.submission().spec.attempt = Attempt(2);
    assert_eq!(world.pass_to(Pending, Reason::Preparing).actions, []);
    let plan = world.pass();
    assert!(has(&plan, |a| *a == Action::CreateJob(JobNumber::first(Attempt(2)))));
    assert!(plan.status.plan.unwrap().resume);
}

#[test]
fn what_the_old_pipeline_left_is_taken_up_without_status_or_report() {
    // Resumed in EvalAI: a message for a submission that this cluster has never seen.
    let mut world = World::evalai();
    world.in_evalai().info.as_mut().unwrap().standing = Standing::Resumed;
    world.view.report.stored = ObservedReport::Absent;
    let plan = world.pass();
    assert!(has(&plan, |a| *a == Action::CreateJob(JobNumber::first(Attempt(1)))));
    assert!(
        plan.status.plan.as_ref().unwrap().resume,
        "workspace restores what is there"
    );
    world.see_job();
    world.view.pod = Some(pod(5));
    world.see_agents();
    let plan = world.pass_to(Resumed, Reason::Resumed);
    assert_eq!(evalai_updates(&plan), [EvalaiUpdate::Running]);
    world.complete();
    world.report(final_report());
    world.pass_to(Finished, Reason::Finished);

    // By hand, for data without EvalAI.
    let mut world = World::local();
    world.submission().spec.attempt = Attempt(2);
    world.pass();
    assert!(world.pass().status.plan.unwrap().resume);
}

#[test]
fn the_image_is_the_first_attempts() {
    let mut world = failed();
    world.submission().spec.image = None;
    world.submission().spec.attempt = Attempt(2);
    world.pass();
    world.job_gone();
    world.view.evalai = Some(EvalaiView {
        info: Some(info()),
        ..EvalaiView::default()
    });
    assert_eq!(world.pass().status.plan.unwrap().image.as_deref(), Some("team/agent:1"));
}

fn note(world: &mut World, record: &serde_json::Value) {
    let annotations = world.submission().metadata.annotations.get_or_insert_default();
    annotations.insert(names::ANNOTATION_INGESTED.into(), record.to_string());
}

#[test]
fn an_attempt_that_no_message_has_announced_is_shown() {
    for (numbers, shown) in [(json!([2]), true), (json!([]), false), (json!([1]), false)] {
        let mut world = failed();
        note(
            &mut world,
            &json!({"message": "sweep", "sent": 1_767_225_600_000_i64, "withoutMessage": numbers}),
        );
        world.submission().spec.attempt = Attempt(2);
        let plan = world.pass_to(Pending, Reason::Preparing);
        let found = plan.events.iter().find(|e| e.reason == Reason::AttemptWithoutMessage);
        assert_eq!(found.is_some(), shown);
        if let Some(found) = found {
            assert!(
                found.warning && found.message.contains("since 2026-01-01T00:00:00Z"),
                "{}",
                found.message
            );
        }
    }
}

#[test]
fn an_attempt_that_does_not_begin_is_shown_until_a_person_begins_it() {
    let mut world = failed();
    let refused = json!({"attempt": 2, "at": 1_767_225_600_000_i64});
    note(&mut world, &json!({"message": "a", "sent": 1, "refused": refused}));
    let plan = world.pass_to(Failed, Reason::AgentCrashed);
    let said = Reason::AttemptWithoutMessage;
    assert_eq!(condition(&plan, STALLED), ("True".into(), said.into()));
    assert_eq!(events(&plan), [said]);
    assert!(events(&world.pass()).is_empty(), "once");
    world.submission().spec.attempt = Attempt(2);
    world.pass_to(Pending, Reason::Preparing);
    let plan = world.pass();
    assert_ne!(condition(&plan, STALLED).1, said);
}
