//! What infrastructure failures that an agent can cause cost a team.

use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;

use super::builders::*;
use crate::controller::submissions::team_history::{Others, TeamHistory};
use leaderboard_api::FailureClass::{Infrastructure, Participant};
use leaderboard_api::State::{Failed, Finished, Pending, Running};
use leaderboard_api::{Attempt, InfrastructureFailures, OnRepeatedInfrastructure, reasons};

/// Two attempts of the team in a row, on two nodes, while others finish.
fn repeated() -> TeamHistory {
    TeamHistory {
        within_a_day: 2,
        in_a_row: 2,
        nodes: ["node-b".to_owned()].into(),
        others: Others {
            finished: 5,
            ..Others::default()
        },
        ..TeamHistory::default()
    }
}

/// Its simulator has failed as often as it may, and its Job has ended.
fn simulator_failed(history: TeamHistory, policy: OnRepeatedInfrastructure) -> World {
    let mut world = World::local().running();
    world.leaderboard().retries.on_repeated_infrastructure = policy;
    world.view.team = history;
    world.see_alone(ended("simulator-1", 3, "exited", 1, 100));
    world.pass_to(Running, reasons::STOPPING);
    world.complete();
    world
}

#[test]
fn a_repeated_failure_is_charged_only_where_the_host_wants_it_and_only_to_the_likely_cause() {
    use OnRepeatedInfrastructure::{Charge, Forgive};
    let alone = TeamHistory {
        others: Others::default(),
        ..repeated()
    };
    for (what, history, policy) in [
        ("by default", repeated(), Forgive),
        ("nobody else finishes", alone, Charge),
        ("the first one", TeamHistory::default(), Charge),
    ] {
        let mut world = simulator_failed(history, policy);
        let plan = world.pass_to(Pending, reasons::REPLACING);
        assert_eq!(plan.status.retry, 1, "{what}: it is tried again");
    }

    let mut world = simulator_failed(repeated(), Charge);
    let status = world.pass_to(Failed, reasons::REPEATED_FAILURES).status;
    assert_eq!(status.retry, 0, "it ends with one Job");
    let failure = status.failure.unwrap();
    assert_eq!(
        (failure.class, failure.charged, failure.pair),
        (Participant, true, Some(1))
    );
    assert_eq!(
        failure.message,
        "The simulator of pair 1 failed 4 times: it crashed. The 2 attempts of the same team before it ended because of the \
         infrastructure as well, while 5 runs of other teams with the same simulator finished. Team t1: Look at the log of the \
         simulator and of the agent. If the agent is not the cause, resume the submission; else the participant fixes the agent and \
         submits again."
    );
    let told = failure.participant_message.unwrap();
    assert!(
        told.starts_with("The run ended early. The 2 attempts") && !told.contains("t1"),
        "{told}"
    );
    assert_eq!(status.infrastructure_failures.unwrap().number, 1, "the row goes on");
}

#[test]
fn a_resume_keeps_the_count_and_a_finish_ends_it() {
    let mut world = simulator_failed(repeated(), OnRepeatedInfrastructure::Charge);
    let known = world
        .pass_to(Failed, reasons::REPEATED_FAILURES)
        .status
        .infrastructure_failures;
    assert_eq!(known.as_ref().unwrap().nodes, ["node-a"]);
    world.submission().spec.attempt = Attempt(2);
    let plan = world.pass();
    assert_eq!((plan.status.attempt, &plan.status.failure), (Some(Attempt(2)), &None));
    assert_eq!(plan.status.infrastructure_failures, known, "also after a resume");

    let mut world = World::local().running();
    let mut status = world.status();
    status.infrastructure_failures = known;
    world.submission().status = Some(status);
    world.report(final_report());
    world.complete();
    world.report(final_report());
    assert_eq!(
        world
            .pass_to(Finished, reasons::FINISHED)
            .status
            .infrastructure_failures,
        None
    );
}

#[test]
fn results_that_an_agent_keeps_from_being_stored_are_counted_as_well() {
    let mut world = World::local().running();
    world.leaderboard().retries.infrastructure = 0;
    world.complete();
    let status = world.pass_to(Failed, reasons::RESULTS_NOT_STORED).status;
    assert_eq!(status.failure.unwrap().class, Infrastructure);
    assert_eq!(status.infrastructure_failures.unwrap().number, 1);
}

#[test]
fn ends_that_an_agent_can_bring_about_are_counted_and_those_of_the_hosts_images_are_not() {
    type Sees = fn(&mut World);
    fn waits(world: &mut World, name: &str, reason: &str, words: &str) {
        world.see(waiting(name, reason, words));
        world.pass();
        world.go_to(1800);
    }
    let cases: [(&str, Sees, &str, i32); 4] = [
        (
            "its node falls silent",
            |world| {
                world.pod().delete_by = Some(at(700));
                world.go_to(730);
            },
            reasons::NODE_LOST,
            1,
        ),
        (
            "its node starts nothing more",
            |world| {
                waits(
                    world,
                    "agent-1",
                    "CreateContainerError",
                    "too many open files in system",
                );
            },
            reasons::NODE_CANNOT_START,
            1,
        ),
        (
            "its image cannot be pulled",
            |world| waits(world, "agent-1", "ErrImagePull", "401 Unauthorized"),
            reasons::IMAGE_PULL,
            1,
        ),
        (
            "the simulator's cannot",
            |world| waits(world, "simulator-1", "ErrImagePull", "401 Unauthorized"),
            reasons::IMAGE_PULL,
            0,
        ),
    ];
    for (what, sees, reason, number) in cases {
        let mut world = World::local().with_pod();
        world.leaderboard().retries.infrastructure = 0;
        sees(&mut world);
        world.pass();
        world.job_gone();
        let status = world.pass_to(Failed, reason).status;
        assert!(!status.failure.unwrap().charged, "{what}");
        let counted = status.infrastructure_failures.map_or(0, |failures| failures.number);
        assert_eq!(counted, number, "{what}");
    }
}

#[test]
fn the_times_of_the_last_three_are_remembered() {
    let known = |number: i32, recent: &[i64]| InfrastructureFailures {
        number,
        first_time: Time(at(-9000)),
        last_time: Time(at(-1000)),
        recent_times: recent.iter().map(|second| Time(at(*second))).collect(),
        nodes: Vec::new(),
    };
    for (what, before, expected) in [
        ("the first one", None, vec![10]),
        ("after two", Some(known(2, &[-9000, -1000])), vec![-9000, -1000, 10]),
        (
            "after four",
            Some(known(4, &[-4000, -3000, -1000])),
            vec![-3000, -1000, 10],
        ),
        ("after those of an older operator", Some(known(2, &[])), vec![-1000, 10]),
    ] {
        let mut world = World::local().running();
        world.leaderboard().retries.infrastructure = 0;
        let number = before.as_ref().map_or(1, |before| before.number + 1);
        world.submission().status.as_mut().unwrap().infrastructure_failures = before.map(Box::new);
        world.complete();
        let status = world.pass_to(Failed, reasons::RESULTS_NOT_STORED).status;
        let found = status.infrastructure_failures.unwrap();
        let expected: Vec<_> = expected.into_iter().map(|second| Time(at(second))).collect();
        assert_eq!((found.number, found.recent_times), (number, expected), "{what}");
    }
}

#[test]
fn a_number_that_may_be_larger_is_shown_as_the_least() {
    let history = TeamHistory {
        within_a_day: 3,
        may_be_more: true,
        ..TeamHistory::default()
    };
    let mut world = simulator_failed(history, OnRepeatedInfrastructure::Forgive);
    let status = world.pass_to(Failed, reasons::SIMULATION_CRASHED).status;
    let message = status.failure.unwrap().message;
    assert!(
        message.contains("Within a day at least 4 attempts of team t1 ended like this in this Leaderboard;"),
        "{message}"
    );
}
