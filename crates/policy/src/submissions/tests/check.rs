//! A check of a Leaderboard: what it runs, and what it leaves alone.

use super::builders::*;
use crate::slots::turns::InLine;
use crate::submissions::Action;
use crate::view::Turn;
use leaderboard_api::State::{Failed, Pending};
use leaderboard_api::{CheckImage, ImagePattern, Reason, RouteSlice};

fn check() -> World {
    let mut world = World::local();
    let submission = world.submission();
    submission.spec.check = true;
    submission.spec.team = None;
    submission.metadata.finalizers = None;
    world
}

#[test]
fn it_runs_one_route_with_one_pair_and_has_no_row() {
    let plan = check().pass_to(Pending, Reason::Preparing);
    let run = plan.status.plan.as_ref().unwrap();
    let carla = run.carla().unwrap();
    assert_eq!(carla.slices, [RouteSlice { first: 0, last: 0 }]);
    assert_eq!((carla.routes, carla.repetitions, run.run_id.as_str()), (1, 1, "sub"));
    assert!(creates(&plan));
    assert!(!has(&plan, |a| matches!(
        a,
        Action::SetFinalizer(true) | Action::Record(_)
    )));
    assert_eq!(World::local().pass().status.plan.unwrap().carla().unwrap().routes, 4);
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
fn the_first_fault_of_the_infrastructure_ends_it() {
    let mut world = check().with_pod();
    world.see(waiting(
        "simulator-1",
        "ErrImagePull",
        "failed to pull and unpack image \"r/x:1\": not found",
    ));
    world.pass_to(Pending, Reason::ImagePull);
    world.go_to(1900);
    world.pass_to(Pending, Reason::Stopping);
    world.job_gone();
    world.pass_to(Failed, Reason::ImagePull);
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
        world
    };
    world("hosts/contents-of-another:1").pass_to(Failed, Reason::ImageNotAllowed);
    let mut baseline = world("hosts/baseline:2");
    assert!(creates(&baseline.pass()));
    let mut private = world("contents:1");
    private.leaderboard().check = Some(CheckImage {
        image: "contents:1".into(),
    });
    private.pass_to(Failed, Reason::ImageNotAllowed);
}
