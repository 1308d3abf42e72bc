//! For each rule of the API a mistake that a person can make, and its neighbor that is no mistake.

mod gpu;
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
        server(),
        queue(),
        networks(),
        labels(),
        identities_and_tables(),
        sizes_and_images(),
        endpoints(),
        gpu::all(),
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
            "idleSeconds must be shorter than runSeconds",
            &deadlines(json!({"idleSeconds": 7199, "runSeconds": 7200})),
            &deadlines(json!({"idleSeconds": 7200})),
        ),
        create(
            Leaderboard,
            "readySeconds must be shorter than runSeconds",
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

fn served(more: &Value) -> Value {
    let mut spec = json!({"evalai": evalai(), "tracks": [track(&json!({"phase": 7}))]});
    super::objects::merge(&mut spec, more);
    spec
}

fn server() -> Vec<Case> {
    let at = |server: &str| json!({"evalai": {"apiServer": server}});
    let root = served(&at("https://api.eval.ai/"));
    let under_path = served(&at("http://example.org:8000/evalai"));
    let in_manager = json!({"evalai": {"token": {"secretsManager": {"id": "evalai"}}}});
    let nowhere = json!({"evalai": {"token": {"secretKeyRef": null}}});
    let case = |message, good: &Value, bad: &Value| create(Leaderboard, message, good, bad);
    let one_place = "exactly one of secretKeyRef and secretsManager";
    let mode = |mode: &str| served(&json!({"evalai": {"mode": mode}, "storage": {"s3": {"prefix": "observe/"}}}));
    let observe = mode("Observe");
    let only_observed = "evalai.mode Observe needs a storage.s3.prefix";
    let queue = json!({"queue": {"sqs": {"url": "https://sqs.example.org/1/a"}}});
    vec![
        case(only_observed, &observe, &queue),
        case(
            only_observed,
            &observe,
            &json!({"queue": {"evalai": {"name": "carla-1"}}}),
        ),
        case(
            only_observed,
            &observe,
            &json!({"table": {"dynamoDB": {"name": "rows"}}}),
        ),
        case(only_observed, &observe, &json!({"storage": {"s3": {"prefix": null}}})),
        update(
            Leaderboard,
            "evalai.mode is immutable",
            &mode("Publish"),
            &json!({"evalai": {"mode": "Observe"}}),
            &json!({"paused": true}),
        ),
        case("without /api", &root, &at("https://eval.ai/api")),
        case("without /api", &under_path, &at("https://eval.ai/api/")),
        case("without /api", &root, &at("https://eval.ai/evalai/api/jobs")),
        case(
            "evalai.apiServer may hold neither",
            &root,
            &at("https://host:secret@eval.ai"),
        ),
        case(
            "evalai.apiServer may hold neither",
            &root,
            &at("https://eval.ai/?token=x"),
        ),
        case("evalai.apiServer may hold neither", &root, &at("https://eval.ai/#x")),
        case(one_place, &served(&json!({})), &in_manager),
        case(one_place, &served(&json!({})), &nowhere),
    ]
}

fn queue() -> Vec<Case> {
    let queue = |url: &str, dead: &str| {
        let at = |name: &str| format!("https://sqs.example.org/1/{name}");
        json!({"queue": {"sqs": {"url": at(url), "deadLetterURL": at(dead)}}})
    };
    let case = |message, good: &Value, bad: &Value| create(Leaderboard, message, good, bad);
    let alone = json!({"queue": {"sqs": {"url": "https://sqs.example.org/1/a"}}});
    let inbox = json!({"queue": {"evalai": {"name": "carla-1"}}});
    vec![
        case("queue needs evalai", &json!({}), &alone),
        case("queue needs evalai", &json!({}), &inbox),
        case("queue needs exactly one of sqs and evalai", &served(&inbox), &alone),
        case(
            "queue needs exactly one of sqs and evalai",
            &served(&inbox),
            &json!({"queue": {"evalai": null}}),
        ),
        case("is the queue itself", &served(&queue("a", "b")), &queue("a", "a")),
        case(
            "needs a FIFO dead-letter queue",
            &served(&queue("a.fifo", "b.fifo")),
            &queue("a.fifo", "b"),
        ),
        case(
            "needs a FIFO dead-letter queue",
            &served(&queue("a", "b")),
            &queue("a", "b.fifo"),
        ),
    ]
}

fn networks() -> Vec<Case> {
    let to = |cidr: &str| json!({"network": {"egress": [{"cidr": cidr, "ports": [443]}]}});
    let policy = |policy: &str, enforcement: &str| json!({"network": {"policy": policy, "enforcement": enforcement}});
    let case = |message, good: &Value, bad: &Value| create(Leaderboard, message, good, bad);
    let probe = |probe: &str| json!({"network": {"probe": probe}});
    let not_a_probe = "network.probe is not an address and port";
    let servers = |servers: &[&str]| json!({"network": {"dnsServers": servers}});
    let not_a_server = "network.dnsServers is neither an address nor a range";
    vec![
        case("is not a range of addresses", &to("2001:db8::/32"), &to("10.0.0.1")),
        case(
            not_a_server,
            &servers(&["10.0.0.10", "fd00::/64"]),
            &servers(&["10.0.0.10", "dns.example"]),
        ),
        case(not_a_probe, &probe("192.0.2.1:443"), &probe("999.1.1.1:443")),
        case(not_a_probe, &probe("[2001:db8::1]:443"), &probe("192.0.2.1:65536")),
        case(
            "Require needs network.policy Managed",
            &policy("Managed", "Require"),
            &policy("External", "Require"),
        ),
    ]
}

/// A queue's label is the host's, and what the operator and the Job controller find their Jobs by is not.
fn labels() -> Vec<Case> {
    let labels = |key: &str| json!({"jobLabels": {key: "x"}});
    let good = labels("kueue.x-k8s.io/queue-name");
    let case = |message, key: &str| create(Leaderboard, message, &good, &labels(key));
    vec![
        case("by those labels the operator finds", "leaderboard.carla.org/run"),
        case("by those labels the operator finds", "app.kubernetes.io/managed-by"),
        case("those labels are the Job controller's", "job-name"),
        case("those labels are the Job controller's", "batch.kubernetes.io/job-name"),
    ]
}

fn identities_and_tables() -> Vec<Case> {
    let identity = |identity: Value| json!({ "podIdentity": identity });
    let role = "arn:aws:iam::123456789012:role/pods";
    let secret = identity(json!({"secretName": "aws", "serviceAccountName": "pods"}));
    let assumed = identity(json!({"roleARN": role, "serviceAccountName": "pods"}));
    let table = |sort_key: &Value| json!({"table": {"dynamoDB": {"name": "rows", "partitionKey": "team_id", "sortKey": sort_key}}});
    let both = table(&json!("submission_id"));
    let case = |message, good: &Value, bad: &Value| create(Leaderboard, message, good, bad);
    let one_way = "exactly one of roleARN and secretName";
    vec![
        case(one_way, &secret, &identity(json!({"roleARN": role}))),
        case(one_way, &secret, &identity(json!({"secretName": null}))),
        case(
            "roleARN needs serviceAccountName",
            &assumed,
            &identity(json!({"serviceAccountName": null})),
        ),
        case("are set together", &both, &table(&Value::Null)),
        case("are the same key", &both, &table(&json!("team_id"))),
    ]
}

/// A password in any of these would be shown by conditions and logs.
fn endpoints() -> Vec<Case> {
    let storage = |endpoint: &str| json!({"storage": {"s3": {"endpoint": endpoint}}});
    let table = |endpoint: &str| json!({"table": {"dynamoDB": {"name": "rows", "endpoint": endpoint}}});
    let group = |endpoint: &str| json!({"logs": {"cloudWatch": {"name": "logs", "endpoint": endpoint}}});
    let entry = |endpoint: &str| {
        let manager = json!({"id": "evalai", "endpoint": endpoint});
        served(&json!({"evalai": {"token": {"secretsManager": manager, "secretKeyRef": null}}}))
    };
    let queue = |field: &str, url: &str| {
        let mut queue = json!({"url": "https://sqs.example.org/1/a", "deadLetterURL": "https://sqs.example.org/1/b"});
        queue[field] = url.into();
        served(&json!({ "queue": {"sqs": queue} }))
    };
    let mut cases = Vec::new();
    for bad in [
        "http://user:secret@aws:4566",
        "http://aws:4566/?key=secret",
        "http://aws:4566/#secret",
    ] {
        let good = "http://aws:4566/path";
        let mut case = |message, good: Value, bad: Value| cases.push(create(Leaderboard, message, &good, &bad));
        case("storage.s3.endpoint may hold neither", storage(good), storage(bad));
        case("table.dynamoDB.endpoint may hold neither", table(good), table(bad));
        case("logs.cloudWatch.endpoint may hold neither", group(good), group(bad));
        case("secretsManager.endpoint may hold neither", entry(good), entry(bad));
        for (field, message) in [
            ("url", "queue.sqs.url may hold neither"),
            ("deadLetterURL", "queue.sqs.deadLetterURL may hold neither"),
            ("endpoint", "queue.sqs.endpoint may hold neither"),
        ] {
            case(message, queue(field, good), queue(field, bad));
        }
    }
    cases
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
