//! A check of a Leaderboard: what it runs, what it leaves alone, and how soon a fault ends it.

use super::builders::*;
use crate::controller::slots::turns::InLine;
use crate::controller::submissions::decide::{Action, TableUpdate};
use crate::controller::submissions::images::Question;
use crate::controller::submissions::view::{ContainerView, JobEnd, ObservedImage, ObservedReport, Turn};
use leaderboard_api::State::{Failed, Finished, Pending, Running};
use leaderboard_api::conditions::{PUBLISHED, RECORDED};
use leaderboard_api::{CheckImage, ImagePattern, RouteSlice, reasons};

fn check() -> World {
    let mut world = World::local();
    let submission = world.submission();
    submission.spec.check = true;
    submission.spec.team = None;
    submission.metadata.finalizers = None;
    let leaderboard = std::sync::Arc::make_mut(world.view.leaderboard.as_mut().unwrap());
    leaderboard.metadata.generation = Some(5);
    world
}

#[test]
fn it_runs_one_route_with_one_pair_and_notes_which_spec() {
    let plan = check().pass_to(Pending, reasons::PREPARING);
    let run = plan.status.plan.as_ref().unwrap();
    assert_eq!(run.slices, [RouteSlice { first: 0, last: 0 }]);
    assert_eq!((run.routes, run.repetitions, run.run_id.as_str()), (1, 1, "sub"));
    assert_eq!(plan.status.checked_generation, Some(5));
    assert!(creates(&plan));
    assert!(!has(&plan, |a| matches!(a, Action::AddFinalizer | Action::Record(_))));
    let of_a_team = World::local().pass();
    assert_eq!(of_a_team.status.checked_generation, None);
    assert_eq!(of_a_team.status.plan.unwrap().routes, 4);
}

#[test]
fn it_stands_in_line_as_a_team_of_its_own() {
    let mut world = check();
    world.view.turn = Turn::NotInLine;
    let plan = world.pass();
    let place = |action: &Action| match action {
        Action::JoinLine(InLine { team, is_check, .. }) => Some((team.clone(), *is_check)),
        _ => None,
    };
    let found: Vec<_> = plan.actions.iter().filter_map(place).collect();
    assert_eq!(found, [("check/sub".to_owned(), true)]);
}

#[test]
fn the_table_is_only_asked_whether_it_would_take_a_row() {
    let mut world = check().running();
    assert!(!has(&world.pass(), |a| matches!(a, Action::Record(_))));
    world.report(crate::pod::report::Report {
        done: 1,
        total: 1,
        pairs: report(4).pairs[..1].to_vec(),
        ..final_report()
    });
    let report = world.view.report.clone();
    world.complete();
    world.view.report = report;
    let plan = world.pass_to(Finished, reasons::FINISHED);
    assert_eq!(plan.status.times.published, None);
    let asked = world.pass();
    assert!(
        has(&asked, |a| *a == Action::Record(TableUpdate::Trial)),
        "{:?}",
        asked.actions
    );
    assert_eq!(condition(&asked, PUBLISHED).1, reasons::NOT_REQUIRED);
    assert_eq!(world.view.submission.check_end(), None, "the table has not answered");

    let mut refused = world.clone();
    refused.view.record.as_mut().unwrap().error = Some("AccessDenied".into());
    assert_eq!(condition(&refused.pass(), RECORDED).1, reasons::REFUSED);
    let end = refused.view.submission.check_end().unwrap();
    assert_eq!(
        (end.has_finished, end.reason.as_str()),
        (false, reasons::TABLE_UNREACHABLE)
    );

    world.recorded();
    assert_eq!(
        condition(&world.pass(), RECORDED),
        ("True".into(), reasons::RECORDED.into())
    );
    let end = world.view.submission.check_end().unwrap();
    assert_eq!((end.has_finished, end.generation), (true, Some(5)));
}

/// A host waits for it: what keeps it from starting ends it after a minute, not after `startSeconds`.
#[test]
fn what_keeps_it_from_starting_ends_it_after_a_minute() {
    let contents = ContainerView {
        waiting: None,
        ..ended("contents", 3, "", 1, 0)
    };
    let pull = "failed to pull and unpack image \"r/x:1\": not found";
    for (container, shown, fails_as) in [
        (
            waiting("simulator-1", "ErrImagePull", pull),
            reasons::IMAGE_PULL,
            reasons::IMAGE_PULL,
        ),
        (contents, reasons::PREPARING, reasons::START_DEADLINE),
    ] {
        let mut world = check().with_pod();
        world.see(container);
        world.go_to(100);
        let plan = world.pass_to(Pending, shown);
        assert!(
            plan.requeue.is_some_and(|after| after.as_secs() <= 60),
            "{:?}",
            plan.requeue
        );
        world.go_to(159);
        world.pass_to(Pending, shown);
        world.go_to(160);
        world.pass_to(Pending, reasons::STOPPING);
        world.job_gone();
        let failure = world.pass_to(Failed, fails_as).status.failure.unwrap();
        assert!(
            failure.message.contains("It was tried for 60 s on node node-a."),
            "{}",
            failure.message
        );
    }
}

#[test]
fn a_bucket_that_cannot_be_read_ends_it_after_a_minute() {
    let mut world = check().running();
    world.go_to(100);
    world.job().end = Some(JobEnd::Failed {
        at: Some(at(100)),
        reason: "BackoffLimitExceeded".into(),
        message: "it has reached its limit".into(),
    });
    world.view.report = ObservedReport::Unreadable("bucket results does not exist.".into());
    world.pass_to(Running, reasons::NOT_STORED);
    world.go_to(159);
    world.pass_to(Running, reasons::NOT_STORED);
    world.go_to(160);
    let plan = world.pass();
    assert_eq!(plan.status.state, Some(Failed), "{:?}", plan.status.reason);
}

#[test]
fn its_image_is_the_one_that_the_leaderboard_names_for_it() {
    let world = |image: &str| {
        let mut world = check();
        world.submission().spec.image = Some(image.into());
        world.leaderboard().agent.images = Some(vec![ImagePattern("registry.example/team-{team}/*".into())]);
        world.leaderboard().check = Some(CheckImage {
            image: "hosts/baseline:1".into(),
        });
        world.view.image = ObservedImage::NotAsked;
        world
    };
    let mut other = world("hosts/contents-of-another:1");
    let failure = other
        .pass_to(Failed, reasons::IMAGE_NOT_ALLOWED)
        .status
        .failure
        .unwrap();
    assert!(
        failure.message.contains("Name it in check.image"),
        "{}",
        failure.message
    );
    let mut baseline = world("hosts/baseline:2");
    let asked = baseline.pass().actions.into_iter().find_map(|action| match action {
        Action::LookUpImage(Question { image, .. }) => Some(image.path),
        _ => None,
    });
    assert_eq!(asked.as_deref(), Some("hosts/baseline"));
    let mut private = world("contents:1");
    private.leaderboard().check = Some(CheckImage {
        image: "contents:1".into(),
    });
    private.pass_to(Failed, reasons::IMAGE_NOT_ALLOWED);
}
