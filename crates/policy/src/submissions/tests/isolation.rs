//! No Job without the NetworkPolicy, and what follows when a Pod was not isolated.

use std::sync::Arc;

use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;

use super::builders::*;
use leaderboard_api::State::{Failed, Pending, Running};
use leaderboard_api::conditions::{self, ACCEPTED, ISOLATED, STALLED, Truth};
use leaderboard_api::{FailureClass, PolicySource, Reason};

/// The Leaderboard says so of its present spec.
fn say_of_the_leaderboard(world: &mut World, reason: Reason, message: &str) {
    let leaderboard = Arc::make_mut(world.view.leaderboard.as_mut().unwrap());
    let generation = leaderboard.metadata.generation;
    let conditions = &mut leaderboard.status.get_or_insert_default().conditions;
    conditions::set(
        conditions,
        ISOLATED,
        Truth::False,
        reason,
        message,
        generation,
        &Time(at(0)),
    );
}

#[test]
fn a_job_waits_for_the_policy_and_follows_it_by_itself() {
    let mut world = World::local();
    world.view.is_policy_in_place = false;
    // A Leaderboard and its first submission may come together.
    let plan = world.pass_to(Pending, Reason::Preparing);
    assert!(!creates(&plan));
    world.go_to(5);
    let plan = world.pass_to(Pending, Reason::NotIsolated);
    assert!(!creates(&plan));
    assert_eq!(condition(&plan, ACCEPTED), ("False".into(), Reason::NotIsolated.into()));
    let message = world.status().message.unwrap();
    assert!(
        message.contains("is not in place yet; the submission goes on once it is."),
        "{message}"
    );

    say_of_the_leaderboard(
        &mut world,
        Reason::Forbidden,
        "The API server refuses it. Give the role the verb create",
    );
    world.pass_to(Pending, Reason::NotIsolated);
    assert_eq!(
        world.status().message.unwrap(),
        "The NetworkPolicy of Leaderboard carla is not in place (Forbidden): The API server refuses it. Give the role the \
         verb create. The submission goes on once it is."
    );

    world.view.is_policy_in_place = true;
    assert!(creates(&world.pass_to(Pending, Reason::Preparing)));
}

#[test]
fn policies_of_the_clusters_own_are_not_waited_for() {
    let mut world = World::local();
    world.view.is_policy_in_place = false;
    world.leaderboard().network.policy = PolicySource::External;
    assert!(creates(&world.pass_to(Pending, Reason::Preparing)));
}

#[test]
fn a_job_that_was_deleted_is_made_again_only_under_the_policy() {
    let mut world = World::local().running();
    world.job_gone();
    world.view.is_policy_in_place = false;
    let plan = world.pass_to(Running, Reason::NotIsolated);
    assert!(!creates(&plan));
    assert_eq!(condition(&plan, STALLED), ("True".into(), Reason::NotIsolated.into()));
    say_of_the_leaderboard(&mut world, Reason::Forbidden, "The API server refuses it");
    let status = world.pass_to(Running, Reason::NotIsolated).status;
    let stalled = conditions::get(&status.conditions, STALLED).unwrap();
    for message in [&stalled.message, status.message.as_ref().unwrap()] {
        assert!(message.contains("(Forbidden): The API server refuses it."), "{message}");
    }
    world.view.is_policy_in_place = true;
    assert!(creates(&world.pass_to(Running, Reason::Replacing)));
    assert_eq!(world.status().recreated, 1);
}

#[test]
fn the_wait_for_the_policy_is_not_taken_for_a_job_that_was_seen() {
    let mut world = World::local();
    world.pass();
    world.view.is_policy_in_place = false;
    world.pass_to(Pending, Reason::NotIsolated);
    world.view.is_policy_in_place = true;
    assert!(creates(&world.pass_to(Pending, Reason::Preparing)));
    assert_eq!(world.status().recreated, 0);
}

#[test]
fn a_run_goes_on_whatever_becomes_of_the_policy() {
    let mut world = World::local().running();
    world.view.is_policy_in_place = false;
    world.pass_to(Running, Reason::Running);
}

#[test]
fn a_pod_that_was_not_isolated_ends_at_once_and_is_tried_again_uncharged() {
    // The run shows the same for a Pod that was not known to be isolated.
    for found in ["NotIsolated", "NotKnownIsolated"] {
        let mut world = World::local().with_pod();
        let mut workspace = ended("workspace", 0, found, 1, 5);
        let why = "The Pod could connect to 10.96.0.1:443. Use a network plugin that enforces policies.";
        workspace.last.as_mut().unwrap().why = Some(why.into());
        world.see(workspace);
        world.pass_to(Pending, Reason::Stopping);
        let failure = world.status().failure.unwrap();
        assert_eq!(
            (failure.reason.known().unwrap(), failure.message.as_str()),
            (Reason::NotIsolated, why)
        );
        assert_eq!(failure.class, FailureClass::Infrastructure);
        let mut last = world.clone();
        last.leaderboard().retries.infrastructure = 0;
        last.job_gone();
        let failure = last.pass_to(Failed, Reason::NotIsolated).status.failure.unwrap();
        assert_eq!(failure.message, format!("{why} Then resume the submission."));
        world.job_gone();
        let plan = world.pass_to(Pending, Reason::Replacing);
        assert_eq!(plan.status.retry, 1);
        // The next Job waits for the policy like the first.
        world.view.is_policy_in_place = false;
        world.wait(60);
        assert!(!creates(&world.pass_to(Pending, Reason::NotIsolated)));
    }
}
