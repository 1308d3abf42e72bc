//! For each rule of the API a mistake that a person can make, and its neighbor that is no mistake.

pub mod container;
mod gpu;
mod services;
mod submissions;

use serde_json::{Value, json};

use super::objects::Kind::{self, Leaderboard, Submission};

/// One mistake. `good` and `bad` are merge patches on the smallest object of the kind.
pub struct Case {
    pub kind: Kind,
    /// A part of the rule's message that no other rule of the kind has.
    pub message: &'static str,
    pub step: Step,
}

/// When the mistake is made.
pub enum Step {
    /// `good` is accepted, `bad` on top of it is not.
    Create { good: Value, bad: Value },
    /// The object `from` is there, perhaps with an end; the change `bad` is refused, then `good` is accepted.
    Update {
        from: Value,
        end: Option<&'static str>,
        bad: Value,
        good: Value,
    },
}

fn create(kind: Kind, message: &'static str, good: &Value, bad: &Value) -> Case {
    let step = Step::Create {
        good: json!({ "spec": good }),
        bad: json!({ "spec": bad }),
    };
    Case { kind, message, step }
}

fn update(kind: Kind, message: &'static str, from: &Value, bad: &Value, good: &Value) -> Case {
    let step = Step::Update {
        from: json!({ "spec": from }),
        end: None,
        bad: json!({ "spec": bad }),
        good: json!({ "spec": good }),
    };
    Case { kind, message, step }
}

fn named(kind: Kind, message: &'static str, good: &str, bad: &str) -> Case {
    let step = Step::Create {
        good: json!({"metadata": {"name": good}}),
        bad: json!({"metadata": {"name": bad}}),
    };
    Case { kind, message, step }
}

/// Every case.
pub fn all() -> Vec<Case> {
    [
        names(),
        kept(),
        tracks(),
        subsets(),
        containers(),
        times(),
        sizes_and_images(),
        container::all(),
        gpu::all(),
        services::all(),
        submissions::all(),
    ]
    .into_iter()
    .flatten()
    .collect()
}

fn evalai() -> Value {
    json!({"apiServer": "https://eval.ai", "challenge": 1, "token": {"secretKeyRef": {"name": "evalai", "key": "token"}}})
}

fn track(more: &Value) -> Value {
    let mut track = json!({"name": "sensors", "carla": {"codename": "SENSORS"}});
    super::objects::merge(&mut track, more);
    track
}

fn names() -> Vec<Case> {
    let [longest, longer] = ["a".repeat(52), "a".repeat(53)];
    [Leaderboard, Submission]
        .into_iter()
        .flat_map(|kind| {
            [
                named(kind, "at most 52 characters", &longest, &longer),
                named(kind, "may not contain a dot", "carla-2-0", "carla-2.0"),
            ]
        })
        .collect()
}

fn kept() -> Vec<Case> {
    let paused = json!({"paused": true});
    let served = json!({"evalai": evalai(), "tracks": [track(&json!({"phase": 7}))]});
    let prefix = |prefix: &Value| json!({"storage": {"s3": {"prefix": prefix}}});
    let keeps = |message, from: &Value, bad: &Value| update(Leaderboard, message, from, bad, &paused);
    vec![
        keeps(
            "evaluation.carla.version is immutable",
            &json!({}),
            &json!({"evaluation": {"carla": {"version": "V1"}}}),
        ),
        keeps(
            "storage.s3.bucket is immutable",
            &json!({}),
            &json!({"storage": {"s3": {"bucket": "other"}}}),
        ),
        keeps("storage.s3.prefix is immutable", &json!({}), &prefix(&json!("a/"))),
        keeps(
            "storage.s3.prefix is immutable",
            &prefix(&json!("a/")),
            &prefix(&json!("b/")),
        ),
        keeps(
            "storage.s3.prefix is immutable",
            &prefix(&json!("a/")),
            &prefix(&Value::Null),
        ),
        keeps(
            "evalai cannot be removed",
            &served,
            &json!({"evalai": null, "tracks": [track(&json!({}))]}),
        ),
        keeps(
            "evalai.challenge is immutable",
            &served,
            &json!({"evalai": {"challenge": 2}}),
        ),
        // It may be added, and its server may move.
        update(
            Leaderboard,
            "evalai.challenge is immutable",
            &served,
            &json!({"evalai": {"challenge": 3}}),
            &json!({"evalai": {"apiServer": "https://evalai.example.org"}}),
        ),
        update(
            Leaderboard,
            "evaluation.carla.version is immutable",
            &json!({}),
            &json!({"evaluation": {"carla": {"version": "V1"}}}),
            &served,
        ),
    ]
}

fn one_track(more: &Value) -> Value {
    json!({"tracks": [track(more)]})
}

fn served(more: &Value) -> Value {
    let mut spec = json!({"evalai": evalai(), "tracks": [track(&json!({"phase": 7}))]});
    super::objects::merge(&mut spec, more);
    spec
}

fn tracks() -> Vec<Case> {
    let two = |second: i64| {
        let more = json!({"name": "map", "carla": {"codename": "MAP"}, "phase": second});
        json!({"evalai": evalai(), "tracks": [track(&json!({"phase": 7})), more]})
    };
    let drives = |pairs: i64, routes: i64| json!({"evaluation": {"carla": {"pairs": pairs, "routes": routes}}});
    let of_track = |pairs: i64, routes: i64| one_track(&json!({"carla": {"pairs": pairs, "routes": routes}}));
    let phase = one_track(&json!({"phase": 7}));
    let no_phase = one_track(&json!({}));
    let case = |message, good: &Value, bad: &Value| create(Leaderboard, message, good, bad);
    vec![
        case("two tracks have the same phase", &two(8), &two(7)),
        case("no track has a phase", &served(&json!({})), &no_phase),
        case("but evalai is missing", &no_phase, &phase),
        case("more pairs than routes", &drives(4, 4), &drives(4, 3)),
        case("more pairs than routes", &of_track(2, 2), &of_track(2, 1)),
    ]
}

fn subsets() -> Vec<Case> {
    let subsets = |list: &Value| one_track(&json!({"carla": {"pairs": 2, "routeSubsets": list}}));
    let uneven = subsets(&json!(["0-14", "15-19"]));
    let v1 = json!({"evaluation": {"carla": {"version": "V1"}}, "tracks": [track(&json!({"carla": {"scenariosFile": "/workspace/scenarios.json"}}))]});
    let case = |message, bad: &Value| create(Leaderboard, message, &uneven, &subsets(bad));
    vec![
        case("one entry for each of its pairs", &json!(["0-19"])),
        case("do not add up to routes", &json!(["0-9", "10-18"])),
        case("do not add up to routes", &json!(["0-10", "10-19"])),
        case("ends before it begins", &json!(["0-19", "20-19"])),
        create(
            Leaderboard,
            "only V1 reads one",
            &v1,
            &json!({"evaluation": {"carla": {"version": "V2"}}}),
        ),
    ]
}

fn containers() -> Vec<Case> {
    let ran = |part: &str, run: &Value| match part {
        "agent" => json!({ "agent": run }),
        part => json!({"evaluation": {"carla": {part: run}}}),
    };
    ["agent", "contents", "simulator"]
        .into_iter()
        .zip(["agent.args", "carla.contents.args", "carla.simulator.args"])
        .map(|(part, message)| {
            let good = ran(part, &json!({"command": ["/bin/sh"], "args": ["-c", "true"]}));
            create(Leaderboard, message, &good, &ran(part, &json!({"command": null})))
        })
        .collect()
}

fn times() -> Vec<Case> {
    let deadlines = |deadlines: Value| json!({ "deadlines": deadlines });
    vec![
        create(
            Leaderboard,
            "idleSeconds must be longer than syncPeriodSeconds",
            &json!({"syncPeriodSeconds": 60, "deadlines": {"idleSeconds": 61}}),
            &deadlines(json!({"idleSeconds": 60})),
        ),
        create(
            Leaderboard,
            "idleSeconds (800 by default) must be shorter",
            &deadlines(json!({"idleSeconds": 7199, "runSeconds": 7200})),
            &deadlines(json!({"idleSeconds": 7200})),
        ),
        create(
            Leaderboard,
            "readySeconds (3600 by default) must be shorter",
            &deadlines(json!({"readySeconds": 3599, "runSeconds": 3600})),
            &deadlines(json!({"readySeconds": 3600})),
        ),
        create(
            Leaderboard,
            "a track's deadlines.runSeconds must be longer",
            &json!({"tracks": [track(&json!({"deadlines": {"runSeconds": 3601}}))]}),
            &json!({"tracks": [track(&json!({"deadlines": {"runSeconds": 3600}}))]}),
        ),
        create(
            Leaderboard,
            "a track's deadlines.runSeconds must be longer",
            &json!({"tracks": [track(&json!({"deadlines": {"runSeconds": null}}))]}),
            &json!({"tracks": [track(&json!({"deadlines": {"runSeconds": 800}}))], "deadlines": {"readySeconds": 1}}),
        ),
        create(
            Leaderboard,
            "cancelSeconds may not be longer than flushSeconds",
            &deadlines(json!({"cancelSeconds": 60, "flushSeconds": 60})),
            &deadlines(json!({"flushSeconds": 59})),
        ),
        create(
            Leaderboard,
            "retention.finishedSeconds must be at least",
            &json!({"ttlSecondsAfterFinished": 3600, "retention": {"finishedSeconds": 3600}}),
            &json!({"retention": {"finishedSeconds": 3599}}),
        ),
        create(
            Leaderboard,
            "concurrency.perTeam is larger than concurrency.total",
            &json!({"concurrency": {"total": 2, "perTeam": 2}}),
            &json!({"concurrency": {"total": 1}}),
        ),
    ]
}

fn sizes_and_images() -> Vec<Case> {
    let case = |message, good: &Value, bad: &Value| create(Leaderboard, message, good, bad);
    vec![
        case(
            "storage.s3.sizeLimit must be 1Ti",
            &json!({"storage": {"s3": {"sizeLimit": "0.5Ti"}}}),
            &json!({"storage": {"s3": {"sizeLimit": "1.5Ti"}}}),
        ),
        case(
            "storage.s3.sizeLimit must be 16Mi",
            &json!({"storage": {"s3": {"sizeLimit": 16_777_216}}}),
            &json!({"storage": {"s3": {"sizeLimit": 16_000_000}}}),
        ),
        case(
            "agent.shmSize must be 1Mi",
            &json!({"agent": {"shmSize": "1Mi"}}),
            &json!({"agent": {"shmSize": "1M"}}),
        ),
        case(
            "agent.shmSize must be 1Ti",
            &json!({"agent": {"shmSize": "1024Gi"}}),
            &json!({"agent": {"shmSize": "1025Gi"}}),
        ),
        case(
            "logs.cloudWatch.retentionDays must be",
            &json!({"logs": {"cloudWatch": {"name": "logs", "retentionDays": 30}}}),
            &json!({"logs": {"cloudWatch": {"name": "logs", "retentionDays": 31}}}),
        ),
        case(
            "logs.cloudWatch.tags are for",
            &json!({"logs": {"cloudWatch": {"name": "logs", "retentionDays": 30, "tags": {"team": "challenge"}}}}),
            &json!({"logs": {"cloudWatch": {"name": "logs", "retentionDays": null, "tags": {"team": "challenge"}}}}),
        ),
        case(
            "agent.logSizeLimit must be 1Mi",
            &json!({"agent": {"logSizeLimit": "1Mi"}}),
            &json!({"agent": {"logSizeLimit": "1M"}}),
        ),
        case(
            "agent.logSizeLimit must be 1Ti",
            &json!({"agent": {"logSizeLimit": "1Ti"}}),
            &json!({"agent": {"logSizeLimit": "2T"}}),
        ),
        case(
            "team 7 would get the images of team 17",
            &images("*.dkr.ecr.*.amazonaws.com/*-participant-team-{team}"),
            &images("r.example/*{team}"),
        ),
        case(
            "team 7 would get the images of team 17",
            &images("r.example:5000/{team}/x_{team}.agent/*"),
            &images("r.example/team-{team}0/*"),
        ),
    ]
}

fn images(pattern: &str) -> Value {
    json!({"agent": {"images": [pattern]}})
}
