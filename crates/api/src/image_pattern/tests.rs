//! Tables of what a pattern lets in, and of the spellings that must not get round one.

use super::*;

const ECR: &str = "123456789012.dkr.ecr.us-east-1.amazonaws.com";

fn allows(pattern: &str, image: &str, team: Option<&str>) -> bool {
    let image = ImageReference::parse(image).unwrap();
    ImagePattern(pattern.into()).allows(&Repository::of(&image), team)
}

#[test]
fn a_team_gets_its_own_repository_of_evalai_and_no_other() {
    for (image, is_allowed) in [
        (format!("{ECR}/carla-participant-team-7:one"), true),
        (format!("{ECR}/carla-2024-participant-team-7"), true),
        (
            format!("{ECR}/carla-participant-team-7@sha256:{}", "0".repeat(64)),
            true,
        ),
        (format!("{ECR}/carla-participant-team-17:one"), false),
        (format!("{ECR}/carla-participant-team-71:one"), false),
        (format!("{ECR}/carla-participant-team-7-0:one"), false),
        (format!("{ECR}/carla-participant-team-8:participant-team-7"), false),
        (format!("{ECR}/x-participant-team-7"), true),
        (format!("{ECR}/participant-team-7"), false),
        (format!("{ECR}/x/carla-participant-team-7"), false),
        (format!("{ECR}/carla-participant-team-7/x"), false),
        (format!("{ECR}/contents"), false),
    ] {
        assert_eq!(allows(OF_EVALAI, &image, Some("7")), is_allowed, "{image}");
    }
}

#[test]
fn no_other_spelling_of_a_registry_gets_round_a_pattern() {
    let of = |registry: &str| format!("{registry}/carla-participant-team-7:1");
    for registry in [
        "123456789012.dkr.ecr.us-east-1.amazonaws.com:443",
        "123456789012.dkr.ecr.us-east-1.amazonaws.com:80",
        "123456789012.DKR.ecr.us-east-1.amazonaws.com",
        "123456789012.dkr.ecr.us-east-1.amazonaws.com.evil.example",
        "123456789012.dkr.ecr.us-east-1.amazonaws.com.cn",
        "123456789012.dkr.ecr.us-east-1-amazonaws.com",
        "123456789012.dkr.ecr.us-east-1.amazonawsXcom",
        "evil.example.dkr.ecr.us-east-1.amazonaws.com",
        "dkr.ecr.us-east-1.amazonaws.com",
        "10.0.0.5:8080",
        "169.254.169.254",
        "localhost",
        "localhost:5000",
        "[::1]:5000",
    ] {
        assert!(!allows(OF_EVALAI, &of(registry), Some("7")), "{registry}");
    }
    assert!(!allows(OF_EVALAI, "carla-participant-team-7", Some("7")));
}

#[test]
fn a_star_stays_between_two_slashes_or_dots_and_stands_for_something() {
    for (pattern, image, is_allowed) in [
        ("r.example/*", "r.example/a:1", true),
        ("r.example/*", "r.example/a/b", false),
        ("r.example/*/*", "r.example/a/b", true),
        ("r.example/a*", "r.example/a", false),
        ("r.example/a*", "r.example/ab-c", true),
        ("r.example/a*c*e", "r.example/abcde", true),
        ("r.example/a*c*e", "r.example/ace", false),
        ("r.example/a*c*e", "r.example/abcdef", false),
        ("r.example:5000/*", "r.example:5000/a", true),
        ("r.example:5000/*", "r.example/a", false),
        ("r.example/*", "r.example:443/a", false),
        ("*.r.example/a", "x.r.example/a", true),
        ("*.r.example/a", "x.y.r.example/a", false),
        ("*.r.example/a", "r.example/a", false),
        ("127.0.0.1:5000/a", "127.0.0.1:5000/a", true),
        ("docker.io/team/*", "team/agent:1", true),
        ("docker.io/team/*", "index.docker.io/team/agent:1", true),
        ("docker.io/library/*", "agent:1", true),
        ("docker.io/*", "agent:1", false),
        ("team/*", "team/agent:1", false),
        ("r.example", "r.example/a", false),
        ("", "r.example/a", false),
    ] {
        assert_eq!(allows(pattern, image, None), is_allowed, "{pattern} {image}");
    }
    let hostile = format!("r.example/{}", "a".repeat(250));
    assert!(!allows(&format!("r.example/{}b", "a*".repeat(120)), &hostile, None));
}

#[test]
fn a_pattern_with_a_team_lets_nobody_in_whose_id_is_none() {
    let pattern = "r.example/team-{team}/*";
    for (team, is_allowed) in [
        (Some("7"), true),
        (Some("17"), false),
        (None, false),
        (Some(""), false),
        (Some("*"), false),
        (Some("7/agent"), false),
        (Some("{team}"), false),
    ] {
        assert_eq!(
            allows(pattern, "r.example/team-7/agent:1", team),
            is_allowed,
            "{team:?}"
        );
    }
    assert!(allows("r.example/*", "r.example/a", Some("*")), "it needs no team");
}

#[test]
fn one_repository_is_known_in_every_spelling() {
    let same = |one: &str, other: &str| {
        let (one, other) = (
            ImageReference::parse(one).unwrap(),
            ImageReference::parse(other).unwrap(),
        );
        Repository::of(&one).is_same(&Repository::of(&other))
    };
    for (one, other, is_same) in [
        ("r.example/contents:1", "r.example/contents:2", true),
        ("r.example/contents:1", "R.example:443/contents", true),
        ("contents:1", "docker.io/library/contents", true),
        ("team/contents", "index.docker.io/team/contents:3", true),
        ("r.example/contents:1", "r.example:5000/contents:1", false),
        ("r.example/contents:1", "r.example/contents2", false),
    ] {
        assert_eq!(same(one, other), is_same, "{one} {other}");
    }
}
