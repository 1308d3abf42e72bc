//! Which images run: the patterns, what a registry reports, and what participants read of it.

use std::sync::Arc;
use std::time::Duration;

use serde_json::json;

use super::builders::*;
use crate::controller::submissions::decide::{Action, pinned};
use crate::controller::submissions::images::Question;
use crate::controller::submissions::view::ObservedImage;
use crate::services::registry::{Facts, Fault, Image};
use leaderboard_api::State::{Failed, Pending};
use leaderboard_api::conditions::ACCEPTED;
use leaderboard_api::{Attempt, FailureClass, ImagePattern, PinnedImage, SubmissionStatus, Team, reasons};

const ECR: &str = "123456789012.dkr.ecr.us-east-1.amazonaws.com";
const OURS: &str = "123456789012.dkr.ecr.us-east-1.amazonaws.com/carla-participant-team-42:one";

fn digest() -> String {
    format!("sha256:{}", "a".repeat(64))
}

fn facts() -> Facts {
    Facts {
        digest: digest(),
        bytes: 1 << 30,
        has_volumes: false,
    }
}

/// A submission of EvalAI's team 42 with the default patterns.
fn evalai(image: &str) -> World {
    let mut world = World::evalai();
    world.leaderboard().agent.images = None;
    world.submission().spec.image = Some(image.to_owned());
    world
}

fn answered(answer: Result<Facts, Fault>) -> World {
    let mut world = evalai(OURS);
    world.view.image = ObservedImage::Answered(Arc::new(answer));
    world
}

fn question(world: &mut World) -> Option<Question> {
    world.pass().actions.into_iter().find_map(|action| match action {
        Action::LookUpImage(question) => Some(question),
        _ => None,
    })
}

#[test]
fn an_image_of_another_team_or_of_the_host_fails_at_once_and_no_registry_is_asked() {
    for image in [
        format!("{ECR}/carla-participant-team-4:one"),
        format!("{ECR}/carla-participant-team-142:one"),
        format!("{ECR}:443/carla-participant-team-42:one"),
        "10.0.0.5:8080/x-participant-team-42:one".into(),
        "team/agent:1".into(),
    ] {
        let mut world = evalai(&image);
        let plan = world.pass_to(Failed, reasons::IMAGE_NOT_ALLOWED);
        assert!(
            !creates(&plan) && !has(&plan, |a| matches!(a, Action::LookUpImage(_))),
            "{image}"
        );
        assert_eq!(condition(&plan, ACCEPTED).0, "False");
        let failure = plan.status.failure.unwrap();
        assert_eq!(failure.class, FailureClass::Participant);
        let shown = failure.participant_message.unwrap_or(failure.message);
        assert!(!shown.contains("amazonaws") && !shown.contains("8080"), "{shown}");
    }
}

#[test]
fn the_images_of_contents_and_simulator_are_nobodys_agent_whatever_the_patterns_allow() {
    for (image, patterns) in [
        ("contents:2", vec![]),
        ("docker.io/library/simulator:1", vec![]),
        ("contents:1", vec![ImagePattern("docker.io/library/*".into())]),
    ] {
        let mut world = World::evalai();
        world.leaderboard().agent.images = Some(patterns);
        world.submission().spec.image = Some(image.into());
        world.pass_to(Failed, reasons::IMAGE_NOT_ALLOWED);
    }
}

#[test]
fn any_image_of_a_local_submission_runs_unless_patterns_are_set() {
    let mut world = World::local();
    world.leaderboard().agent.images = None;
    assert!(
        creates(&world.pass_to(Pending, reasons::PREPARING)),
        "no registry is asked"
    );
    let of_team = |id: Option<&str>| {
        let mut world = World::local();
        world.leaderboard().agent.images = Some(vec![ImagePattern("docker.io/team-{team}/*".into())]);
        world.submission().spec.image = Some("team-7/agent:1".into());
        let id = id.map(str::to_owned);
        world.submission().spec.team = Some(Team { id, name: None });
        world
    };
    assert!(question(&mut of_team(Some("7"))).is_some());
    for other in [Some("17"), Some("*"), None] {
        of_team(other).pass_to(Failed, reasons::IMAGE_NOT_ALLOWED);
    }
}

#[test]
fn the_registry_is_asked_once_and_an_answer_within_five_seconds_costs_no_write() {
    let mut world = evalai(OURS);
    world.leaderboard().pod_overrides = Some(json!({"spec": {"imagePullSecrets": [{"name": "registry"}]}}));
    let image = Image {
        registry: ECR.into(),
        path: "carla-participant-team-42".into(),
        reference: "one".into(),
        may_be_local: false,
    };
    let wanted = Question {
        attempt: Attempt(1),
        image,
        secrets: vec!["registry".into()],
    };
    assert_eq!(question(&mut world), Some(wanted));
    assert_eq!(world.status(), SubmissionStatus::default());
    world.view.image = ObservedImage::Asked(Duration::from_secs(2));
    let plan = world.pass();
    assert_eq!(plan.status, SubmissionStatus::default());
    assert!(!creates(&plan));
    world.view.image = ObservedImage::Asked(Duration::from_secs(5));
    assert!(!creates(&world.pass_to(Pending, reasons::CHECKING_IMAGE)));
    world.view.image = ObservedImage::Answered(Arc::new(Ok(facts())));
    let plan = world.pass_to(Pending, reasons::PREPARING);
    assert!(creates(&plan) && !has(&plan, |a| matches!(a, Action::LookUpImage(_))));
    assert_eq!(world.status().image, Some(PinnedImage { digest: digest() }));
    assert_eq!(condition(&plan, ACCEPTED), ("True".into(), reasons::ACCEPTED.into()));
}

#[test]
fn the_digest_stays_through_retries_and_attempts() {
    let mut world = answered(Ok(facts()));
    world.pass_to(Pending, reasons::PREPARING);
    world.view.image = ObservedImage::NotAsked;
    let mut retried = world.clone();
    let status = retried.submission().status.as_mut().unwrap();
    (status.retry, status.job_name) = (1, None);
    assert_eq!(question(&mut retried), None);
    assert_eq!(retried.status().image, Some(PinnedImage { digest: digest() }));
    world.submission().spec.cancel = true;
    world.job_gone();
    world.pass();
    let spec = &mut world.submission().spec;
    (spec.cancel, spec.attempt) = (false, Attempt(2));
    world.pass();
    assert_eq!(world.status().attempt, Some(Attempt(2)));
    assert_eq!(question(&mut world), None);
    assert_eq!(world.status().image, Some(PinnedImage { digest: digest() }));
}

#[test]
fn what_a_registry_reports_ends_a_submission_before_a_job_is_made() {
    use FailureClass::{Infrastructure, Participant};
    let huge = Facts {
        bytes: (60 << 30) + 1,
        ..facts()
    };
    let with_volumes = Facts {
        has_volumes: true,
        ..facts()
    };
    for (answer, reason, class) in [
        (Err(Fault::NotFound), reasons::IMAGE_NOT_FOUND, Participant),
        (Ok(huge), reasons::IMAGE_TOO_LARGE, Participant),
        (Ok(with_volumes), reasons::IMAGE_VOLUMES, Participant),
        (Err(Fault::OtherPlatform), reasons::IMAGE_PLATFORM, Participant),
        (Err(Fault::NotAnImage("it is odd")), reasons::IMAGE_INVALID, Participant),
        (Err(Fault::Denied), reasons::IMAGE_DENIED, Infrastructure),
    ] {
        let mut world = answered(answer);
        let plan = world.pass_to(Failed, reason);
        assert!(!creates(&plan) && plan.status.image.is_none(), "{reason}");
        let failure = plan.status.failure.unwrap();
        assert_eq!(failure.class, class, "{reason}");
        let shown = failure.participant_message.unwrap_or(failure.message);
        assert!(!shown.contains(ECR), "{shown}");
    }
    let mut largest = answered(Ok(Facts {
        bytes: 60 << 30,
        ..facts()
    }));
    assert!(creates(&largest.pass()));
}

#[test]
fn a_registry_that_cannot_be_asked_holds_nothing_up_and_hosts_alone_read_why() {
    let why = "no connection (connection refused)\u{1b}[2J";
    let mut world = answered(Err(Fault::Unreachable(why.into())));
    let plan = world.pass_to(Pending, reasons::PREPARING);
    assert!(creates(&plan) && plan.status.image.is_none());
    let note = |world: &World| {
        let status = world.status();
        let found = leaderboard_api::conditions::get(&status.conditions, ACCEPTED)
            .unwrap()
            .clone();
        assert_eq!(
            (found.status.as_str(), found.reason.as_str()),
            ("True", reasons::IMAGE_NOT_PINNED)
        );
        found.message
    };
    let message = note(&world);
    assert!(
        message.contains("connection refused") && !message.contains('\u{1b}'),
        "{message}"
    );
    // It is not asked again while it waits for its turn, and the note stays.
    world.view.image = ObservedImage::NotAsked;
    world.submission().status.as_mut().unwrap().job_name = None;
    assert_eq!(question(&mut world), None);
    assert_eq!(note(&world), message);
}

#[test]
fn a_new_attempt_asks_again_for_an_image_that_was_missing() {
    let mut world = answered(Err(Fault::NotFound));
    world.pass_to(Failed, reasons::IMAGE_NOT_FOUND);
    world.published();
    world.submission().spec.attempt = Attempt(2);
    world.view.image = ObservedImage::NotAsked;
    world.pass();
    assert_eq!(question(&mut world).map(|question| question.attempt), Some(Attempt(2)));
}

#[test]
fn pods_pull_by_digest_whatever_else_the_reference_names() {
    let found = PinnedImage { digest: digest() };
    let other = format!("sha256:{}", "b".repeat(64));
    for (image, name) in [
        ("agent".to_owned(), "agent"),
        ("r.example:5000/team/agent:1".to_owned(), "r.example:5000/team/agent"),
        ("r.example:5000/agent".to_owned(), "r.example:5000/agent"),
        (format!("agent:1@{other}"), "agent"),
        (format!("r.example/agent@{other}"), "r.example/agent"),
    ] {
        assert_eq!(pinned(&image, Some(&found)), format!("{name}@{}", digest()));
        assert_eq!(pinned(&image, None), image);
    }
}

#[test]
fn participants_read_nothing_of_what_a_registry_or_the_network_answers_to_a_pull() {
    for (words, wanted) in [
        (
            "failed to resolve reference \"10.0.0.5:8080/x:1\": 10.0.0.5:8080/x:1: not found",
            "is not in its registry",
        ),
        ("failed to authorize: 401 Unauthorized", "could not be pulled"),
        ("no match for platform in manifest: not found", "is not for linux/amd64"),
        (
            "http: server gave HTTP response to HTTPS client 10.0.0.5:8080",
            "could not be pulled",
        ),
        ("x509: certificate signed by unknown authority", "could not be pulled"),
        (
            "dial tcp 10.0.0.5:8080: connect: connection refused",
            "could not be pulled",
        ),
    ] {
        let mut world = World::local().with_pod();
        world.see(waiting("agent-1", "ImagePullBackOff", words));
        world.pass();
        world.go_to(2000);
        let failure = world.pass().status.failure.unwrap();
        let shown = failure.participant_message.unwrap();
        assert!(
            failure.message.contains(words),
            "hosts read all of it: {}",
            failure.message
        );
        assert!(shown.contains(wanted), "{shown}");
        for part in ["10.0.0.5", "401", "x509", "refused", "HTTP"] {
            assert!(!shown.contains(part), "{shown}");
        }
    }
}
