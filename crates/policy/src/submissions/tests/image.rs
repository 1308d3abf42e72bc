//! Which images run: the patterns, the digest that the first agent pins, and what participants read of a pull.

use super::builders::*;
use crate::submissions::{Plan, StatusWrite, pinned};
use leaderboard_api::State::{Failed, Pending, Running};
use leaderboard_api::conditions::ACCEPTED;
use leaderboard_api::{Attempt, FailureClass, ImagePattern, PinnedImage, Reason, Team};

const ECR: &str = "123456789012.dkr.ecr.us-east-1.amazonaws.com";

fn digest(of: char) -> String {
    format!("sha256:{}", of.to_string().repeat(64))
}

/// A submission of EvalAI's team 42 with the default patterns.
fn evalai(image: &str) -> World {
    let mut world = World::evalai();
    world.leaderboard().agent.images = None;
    world.submission().spec.image = Some(image.to_owned());
    world
}

/// The node's name of an agent's image, from second 10 on.
fn runs(world: &mut World, agent: &str, image_id: &str) {
    let containers = &mut world.pod().containers;
    let found = containers.iter_mut().find(|container| container.name == agent);
    found.unwrap().image_id = Some(image_id.into());
}

/// Its agents run, with these images.
fn running_with(images: [&str; 2]) -> (World, Plan) {
    let mut world = World::local().with_pod();
    world.see_agents();
    for (agent, image) in ["agent-1", "agent-2"].into_iter().zip(images) {
        runs(&mut world, agent, image);
    }
    world.go_to(10);
    let plan = world.pass();
    (world, plan)
}

#[test]
fn an_image_of_another_team_or_of_the_host_fails_at_once() {
    for image in [
        format!("{ECR}/carla-participant-team-4:one"),
        format!("{ECR}/carla-participant-team-142:one"),
        format!("{ECR}:443/carla-participant-team-42:one"),
        "10.0.0.5:8080/x-participant-team-42:one".into(),
        "team/agent:1".into(),
    ] {
        let mut world = evalai(&image);
        let plan = world.pass_to(Failed, Reason::ImageNotAllowed);
        assert!(!creates(&plan), "{image}");
        assert_eq!(condition(&plan, ACCEPTED).0, "False");
        let failure = plan.status.failure.unwrap();
        assert_eq!(failure.class, FailureClass::Participant);
        let shown = failure.participant_message.unwrap_or(failure.message);
        assert!(!shown.contains("amazonaws") && !shown.contains("8080"), "{shown}");
    }
    let mut own = evalai(&format!("{ECR}/carla-participant-team-42:one"));
    assert!(creates(&own.pass_to(Pending, Reason::Preparing)));
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
        world.pass_to(Failed, Reason::ImageNotAllowed);
    }
}

#[test]
fn any_image_of_a_local_submission_runs_unless_patterns_are_set() {
    let mut world = World::local();
    world.leaderboard().agent.images = None;
    assert!(creates(&world.pass_to(Pending, Reason::Preparing)));
    let of_team = |id: Option<&str>| {
        let mut world = World::local();
        world.leaderboard().agent.images = Some(vec![ImagePattern("docker.io/team-{team}/*".into())]);
        world.submission().spec.image = Some("team-7/agent:1".into());
        let id = id.map(str::to_owned);
        world.submission().spec.team = Some(Team { id, name: None });
        world
    };
    assert!(creates(&of_team(Some("7")).pass_to(Pending, Reason::Preparing)));
    for other in [Some("17"), Some("*"), None] {
        of_team(other).pass_to(Failed, Reason::ImageNotAllowed);
    }
}

#[test]
fn the_digest_comes_with_the_write_that_shows_the_run_and_with_none_of_its_own() {
    let image = format!("docker.io/team/agent@{}", digest('a'));
    let mut world = World::local().with_pod();
    assert_eq!(world.pass_to(Pending, Reason::Preparing).status.image, None);
    world.see_agents();
    runs(&mut world, "agent-1", &image);
    world.go_to(10);
    let plan = world.pass_to(Running, Reason::Running);
    assert_eq!(
        (plan.write, plan.status.image),
        (StatusWrite::Now, Some(PinnedImage { digest: digest('a') }))
    );

    let (mut late, _) = running_with(["sha256:not-from-a-registry", ""]);
    runs(&mut late, "agent-1", &image);
    late.view.written_ago = Some(std::time::Duration::from_secs(1));
    let plan = late.pass();
    assert_eq!((plan.write, plan.status.image.is_some()), (StatusWrite::NotNow, true));
}

#[test]
fn only_a_digest_of_the_submitted_repository_is_pinned() {
    let of = |name: &str| format!("{name}@{}", digest('a'));
    for (one, other, wanted) in [
        (of("docker.io/team/agent"), String::new(), Some('a')),
        (of("team/agent"), of("team/agent"), Some('a')),
        // One content under two names, as a node may show it.
        (
            of("docker.io/other/agent"),
            format!("team/agent@{}", digest('b')),
            Some('b'),
        ),
        (of("docker.io/other/agent"), of("r.example/team/agent"), None),
        // An image that was loaded onto the node.
        (digest('a'), String::new(), None),
        ("team/agent:1".into(), "team/agent@sha256:1".into(), None),
        (format!("team/agent@sha512:{}", "a".repeat(128)), String::new(), None),
    ] {
        let (_, plan) = running_with([&one, &other]);
        assert!(plan.status.shows(Reason::Running), "{:?}", plan.status.reason);
        let found = plan.status.image.map(|image| image.digest);
        assert_eq!(found, wanted.map(digest), "{one} {other}");
    }
}

#[test]
fn the_digest_stays_through_retries_and_attempts() {
    let image = format!("team/agent@{}", digest('a'));
    let (mut world, _) = running_with([&image, &image]);
    let found = Some(PinnedImage { digest: digest('a') });
    world.gets_another_job();
    assert_eq!((world.status().retry, world.status().image), (1, found.clone()));
    world.submission().spec.cancel = true;
    world.job_gone();
    world.pass();
    let spec = &mut world.submission().spec;
    (spec.cancel, spec.attempt) = (false, Attempt(2));
    world.pass();
    assert_eq!(
        (world.status().attempt, world.status().image),
        (Some(Attempt(2)), found)
    );
}

#[test]
fn agents_of_one_pod_with_different_images_are_stopped_at_once_and_it_is_the_participants() {
    let of = |letter: char| format!("team/agent@{}", digest(letter));
    let (mut world, plan) = running_with([&of('a'), &of('b')]);
    assert!(plan.status.shows(Reason::Stopping), "{:?}", plan.status.reason);
    world.job_gone();
    let failure = world.pass_to(Failed, Reason::ImageChanged).status.failure.unwrap();
    assert_eq!(failure.class, FailureClass::Participant);
    let (_, plan) = running_with([&of('a'), &format!("docker.io/other/agent@{}", digest('b'))]);
    assert_eq!(plan.status.failure, None, "another name of the content proves nothing");
}

#[test]
fn a_new_attempt_pulls_the_tag_again_where_no_agent_has_run() {
    let mut world = World::local().with_pod();
    world.see(waiting("agent-1", "ErrImagePull", "manifest unknown"));
    world.pass();
    world.go_to(1800);
    world.pass_to(Pending, Reason::Stopping);
    world.job_gone();
    world.pass_to(Failed, Reason::ImageNotFound);
    world.submission().spec.attempt = Attempt(2);
    world.pass();
    assert!(creates(&world.pass_to(Pending, Reason::Preparing)));
    assert_eq!(world.status().image, None);
}

#[test]
fn pods_pull_by_digest_whatever_else_the_reference_names() {
    let found = PinnedImage { digest: digest('a') };
    let other = digest('b');
    for (image, name) in [
        ("agent".to_owned(), "agent"),
        ("r.example:5000/team/agent:1".to_owned(), "r.example:5000/team/agent"),
        ("r.example:5000/agent".to_owned(), "r.example:5000/agent"),
        (format!("agent:1@{other}"), "agent"),
        (format!("r.example/agent@{other}"), "r.example/agent"),
    ] {
        assert_eq!(pinned(&image, Some(&found)), format!("{name}@{}", digest('a')));
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
