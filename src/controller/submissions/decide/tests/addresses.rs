//! Where `network.dns` is `Pinned`: no Job without young addresses of the services that its own containers need.

use std::sync::Arc;
use std::time::Duration;

use serde_json::json;

use super::builders::*;
use crate::controller::submissions::addresses::{Found, Looked, Question, of_pod};
use crate::controller::submissions::decide::{Action, Plan};
use crate::controller::submissions::view::ObservedAddresses;
use crate::services::endpoints::ServiceAddress;
use leaderboard_api::State::{Pending, Running};
use leaderboard_api::conditions::{ACCEPTED, STALLED};
use leaderboard_api::reasons;

fn pinned(world: World) -> World {
    let mut world = world;
    let network = json!({"dns": "Pinned", "egress": [{"cidr": "10.0.0.0/16", "ports": [443]}]});
    world.leaderboard().network = serde_json::from_value(network).unwrap();
    world
}

/// What a plan asks for.
fn asked(plan: &Plan) -> Option<Question> {
    plan.actions.iter().find_map(|action| match action {
        Action::LookUpNames(question) => Some((**question).clone()),
        _ => None,
    })
}

/// An answer of this moment.
fn answer(world: &mut World, question: Question, address: &str) {
    let found = Found {
        place: ServiceAddress {
            service: "S3",
            host: "results.s3.example".into(),
            port: 443,
        },
        addresses: Ok(vec![address.parse().unwrap()]),
    };
    let at = world.view.now;
    let looked = Looked {
        at,
        question,
        found: Ok(vec![found]),
    };
    world.view.addresses = ObservedAddresses::Answered(Arc::new(looked));
}

fn given(world: &World) -> Option<Vec<String>> {
    let network = &world.view.leaderboard.as_ref().unwrap().spec.network;
    let all = of_pod(&world.view.addresses, network)?;
    Some(all.values().flatten().map(ToString::to_string).collect())
}

#[test]
fn a_job_waits_for_the_addresses_and_an_answer_within_seconds_costs_no_write() {
    let mut world = pinned(World::local());
    let plan = world.pass();
    assert!(!creates(&plan) && plan.status.conditions.is_empty());
    let question = asked(&plan).unwrap();
    world.view.addresses = ObservedAddresses::Asked(Duration::from_secs(4));
    assert!(!creates(&world.pass()));
    answer(&mut world, question, "10.0.4.10");
    let plan = world.pass_to(Pending, reasons::PREPARING);
    assert!(creates(&plan));
    assert_eq!(given(&world), Some(vec!["10.0.4.10".to_owned()]));
}

#[test]
fn a_silence_and_a_name_that_leads_nowhere_are_shown_with_what_to_do() {
    let mut world = pinned(World::local());
    let question = asked(&world.pass()).unwrap();
    world.view.addresses = ObservedAddresses::Asked(Duration::from_secs(5));
    let plan = world.pass_to(Pending, reasons::NAME_NOT_RESOLVED);
    assert!(!creates(&plan));
    answer(&mut world, question, "10.9.0.1");
    let plan = world.pass_to(Pending, reasons::NAME_NOT_RESOLVED);
    assert!(!creates(&plan));
    let found = |kind| condition(&plan, kind);
    assert_eq!(found(ACCEPTED), ("False".into(), reasons::NAME_NOT_RESOLVED.into()));
    assert_eq!(found(STALLED), ("True".into(), reasons::NAME_NOT_RESOLVED.into()));
    let message = plan.status.message.as_deref().unwrap();
    assert!(message.contains("network.egress allows none of them"), "{message}");
    // The host's edit settles it, without another answer.
    world.leaderboard().network.egress[0].cidr = "10.9.0.1/32".into();
    let plan = world.pass_to(Pending, reasons::PREPARING);
    assert!(creates(&plan));
    assert_eq!(condition(&plan, STALLED).0, "False");
}

#[test]
fn where_pods_ask_a_resolver_or_nobody_nothing_is_looked_up() {
    for dns in ["Cluster", "None"] {
        let mut world = World::local();
        world.leaderboard().network = serde_json::from_value(json!({ "dns": dns })).unwrap();
        let plan = world.pass_to(Pending, reasons::PREPARING);
        assert!(creates(&plan) && asked(&plan).is_none(), "{dns}");
        assert_eq!(given(&world), None);
    }
}

#[test]
fn an_address_that_changes_while_a_pod_runs_is_that_of_the_next_pod() {
    let mut world = pinned(World::local());
    let question = asked(&world.pass()).unwrap();
    answer(&mut world, question.clone(), "10.0.4.10");
    assert!(creates(&world.pass()));
    world.see_job();
    world.view.pod = Some(pod(0));
    world.see_agents();
    world.go_to(10);
    world.pass_to(Running, reasons::RUNNING);
    // Hours later the answer is that of the Pod that is gone.
    world.go_to(3600);
    world.job_gone();
    let plan = world.pass();
    assert!(!creates(&plan), "its addresses may be those of an hour ago");
    assert_eq!(asked(&plan), Some(question.clone()));
    answer(&mut world, question, "10.0.5.10");
    let plan = world.pass_to(Running, reasons::REPLACING);
    assert!(creates(&plan));
    assert_eq!(given(&world), Some(vec!["10.0.5.10".to_owned()]));
}

#[test]
fn an_answer_for_another_bucket_or_log_group_is_none() {
    let mut world = pinned(World::local());
    let question = asked(&world.pass()).unwrap();
    let mut other = question.clone();
    other.storage.bucket = "other".into();
    answer(&mut world, other, "10.0.4.10");
    let plan = world.pass();
    assert!(!creates(&plan));
    assert_eq!(asked(&plan), Some(question.clone()));
    answer(&mut world, question, "10.0.4.10");
    let group = json!({"name": "carla"});
    world.leaderboard().log_group = Some(serde_json::from_value(group).unwrap());
    let plan = world.pass();
    assert!(!creates(&plan));
    assert!(asked(&plan).unwrap().log_group.is_some());
}
