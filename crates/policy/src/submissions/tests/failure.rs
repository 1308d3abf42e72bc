//! Sentences: each failure has its own, with a next step that a retry leaves out.

use super::builders::*;
use crate::submissions::failure::{at_the_end, infrastructure, invalid_results, participant};
use leaderboard_api::text::sentence;
use leaderboard_api::{Failure, FailureClass, Reason};
use leaderboard_contract::report::RefusedResults;
use leaderboard_evaluation::words;

#[test]
fn a_next_step_is_added_at_the_end() {
    for reason in [
        Reason::NodeLost,
        Reason::SimulationCrashed,
        Reason::JobFailed,
        Reason::ImagePull,
    ] {
        let failure = infrastructure(reason, "It broke.");
        assert_eq!(failure.message, "It broke.");
        let ended = at_the_end(failure).message;
        assert!(
            ended.starts_with("It broke. ") && ended.contains("resume the submission"),
            "{reason}: {ended}"
        );
    }
    let slow = participant(Reason::Idle, "Slow.", "Hurry.");
    assert_eq!(at_the_end(slow).message, "Slow. Hurry.");
}

#[test]
fn words_become_one_sentence() {
    for (words, wanted) in [("no", "no."), (" no. ", "no."), ("cut …", "cut …"), ("", "")] {
        assert_eq!(sentence(words), wanted);
    }
    assert!(
        !invalid_results(&RefusedResults::new(None, "a score of NaN."), words(None))
            .message
            .contains("..")
    );
}

/// The failure of a run whose agent 2 has ended like this as often as it may.
fn failure_of(what: &str, reason: &str) -> Failure {
    let mut world = World::evalai().running();
    let mut end = ended("agent-2", 4, what, 1, 100);
    if let Some(last) = end.last.as_mut() {
        reason.clone_into(&mut last.reason);
    }
    world.see(end);
    *world.pass().status.failure.unwrap()
}

#[test]
fn a_participant_is_sent_to_nothing_that_only_hosts_can_read() {
    let infrastructure = [
        Reason::ImagePull,
        Reason::ContainerConfig,
        Reason::NodeLost,
        Reason::ResultsNotStored,
        Reason::SimulationCrashed,
        Reason::StartDeadline,
        Reason::ScheduleDeadline,
        Reason::JobDeleted,
        Reason::JobFailed,
        Reason::CannotStart,
    ]
    .map(|reason| {
        infrastructure(
            reason,
            "The Job on node gpu-3 broke: see logcopy/report.json in s3://results.",
        )
    });
    let agents = [
        ("exited", "Error"),
        ("exited", "OOMKilled"),
        ("idle", "Error"),
        ("incomplete", "Completed"),
        ("cannotStart", "Error"),
    ]
    .map(|(what, reason)| failure_of(what, reason));
    for failure in infrastructure.iter().chain(&agents) {
        let text = failure.participant_message.as_ref().unwrap_or(&failure.message);
        let of_the_hosts = [
            "leaderboard.log of",
            "agent/agent",
            "logcopy",
            "s3://",
            "gpu-3",
            "Look at",
            "Job",
            "agent.resources",
        ];
        for word in of_the_hosts {
            assert!(!text.contains(word), "{}: {text}", failure.reason);
        }
        let next = ["submit again", "Rebuild"];
        assert!(
            next.iter().any(|step| text.contains(step)),
            "{}: {text}",
            failure.reason
        );
        assert_eq!(
            failure.class == FailureClass::Infrastructure,
            text.contains("Your submission is not the cause."),
            "{text}"
        );
    }
}

#[test]
fn hosts_are_sent_to_the_log_and_the_participant_to_the_agent() {
    let crashed = failure_of("exited", "Error");
    assert_eq!(
        crashed.message,
        "Agent 2 crashed 5 times. Look at agent/agent2/leaderboard.log of the results; the participant fixes the agent and \
         submits again."
    );
    assert_eq!(
        crashed.participant_message.as_deref(),
        Some(
            "Agent 2 crashed 5 times. Reproduce it on routes of your own, fix the agent and submit again; the challenge's hosts have \
             its log."
        )
    );
}
