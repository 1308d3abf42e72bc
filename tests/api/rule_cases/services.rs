//! Rules of EvalAI, queues, labels, tables and addresses.

use serde_json::{Value, json};

use super::super::objects::Kind::Leaderboard;
use super::{Case, create, served, update};

pub(super) fn all() -> Vec<Case> {
    [
        server(),
        queue(),
        networks(),
        labels(),
        identities_and_tables(),
        endpoints(),
    ]
    .into_iter()
    .flatten()
    .collect()
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
