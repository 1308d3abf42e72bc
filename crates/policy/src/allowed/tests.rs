//! The names that a Leaderboard may use, by the patterns of its namespace.

use serde_json::{Value, json};

use super::*;

fn leaderboard(namespace: &str, entry: Option<&str>, queue: Option<&str>, dead: Option<&str>) -> Leaderboard {
    let token = match entry {
        Some(id) => json!({"secretsManager": {"id": id}}),
        None => json!({"secretKeyRef": {"name": "evalai", "key": "token"}}),
    };
    let mut spec = json!({
        "evaluation": {"carla": {
            "version": "V2", "contents": {"image": "contents"}, "simulator": {"image": "simulator"},
        }}, "tracks": [{"name": "sensors", "phase": 1}], "storage": {"s3": {"bucket": "bucket"}},
        "evalai": {"apiServer": "https://eval.ai", "challenge": 1, "token": token},
    });
    if let Some(url) = queue {
        spec["queue"] = json!({"sqs": {"url": url, "deadLetterURL": dead}});
    }
    let object = json!({
        "apiVersion": "leaderboard.carla.org/v1alpha1", "kind": "Leaderboard",
        "metadata": {"name": "lb", "namespace": namespace}, "spec": spec,
    });
    serde_json::from_value(object).unwrap()
}

fn kind(allowed: &str, leaderboard: &Leaderboard) -> Option<Kind> {
    let allowed: Allowed = allowed.parse().unwrap();
    allowed.refusal(leaderboard).map(|refused| refused.kind)
}

const QUEUE: &str = "https://sqs.us-east-1.amazonaws.com/123456789012/submissions";
const DEAD: &str = "https://sqs.us-east-1.amazonaws.com/123456789012/submissions-dead";

#[test]
fn what_a_leaderboard_names_must_be_allowed_in_its_own_namespace() {
    let ours = r#"{
        "ours": {"secretsManager": ["evalai/*"], "queues": ["submissions", "*-dead"], "buckets": ["bucket"]},
        "theirs": {"queues": ["*"], "buckets": ["bucket"]}
    }"#;
    let (queue_2, dead_2) = (format!("{QUEUE}-2"), format!("{DEAD}-2"));
    let entry = Some("evalai/token");
    let cases = [
        (("ours", None, None, None), None),
        (("ours", entry, Some(QUEUE), Some(DEAD)), None),
        (("ours", Some("payroll"), Some(QUEUE), None), Some(Kind::Entry)),
        (("ours", None, Some(queue_2.as_str()), None), Some(Kind::Queue)),
        (
            ("ours", None, Some(QUEUE), Some(dead_2.as_str())),
            Some(Kind::DeadLetterQueue),
        ),
        (("theirs", entry, None, None), Some(Kind::Entry)),
        (("theirs", None, Some(QUEUE), Some(DEAD)), None),
        (("nobodys", None, None, None), Some(Kind::Bucket)),
        (("nobodys", None, Some(QUEUE), None), Some(Kind::Queue)),
        (("nobodys", entry, None, None), Some(Kind::Entry)),
    ];
    for ((namespace, entry, queue, dead), expected) in cases {
        let found = kind(ours, &leaderboard(namespace, entry, queue, dead));
        assert_eq!(found, expected, "{namespace} {entry:?} {queue:?} {dead:?}");
    }
}

/// The first refused name of a Leaderboard with these places.
fn refused(allowed: &str, more: &Value) -> Option<String> {
    let mut spec = serde_json::to_value(leaderboard("ours", None, None, None).spec).unwrap();
    for (key, value) in more.as_object().unwrap() {
        spec[key] = value.clone();
    }
    let mut leaderboard = Leaderboard::new("lb", serde_json::from_value(spec).unwrap());
    leaderboard.metadata.namespace = Some("ours".to_owned());
    let allowed: Allowed = allowed.parse().unwrap();
    allowed
        .refusal(&leaderboard)
        .map(|refused| format!("{:?} {}", refused.kind, refused.name))
}

#[test]
fn a_namespace_may_not_name_the_results_rows_and_logs_of_another_one() {
    let ours = r#"{
        "ours": {"buckets": ["ours-*", "shared/ours/*"], "tables": ["ours-*"], "logGroups": ["/leaderboards/ours"]},
        "theirs": {"buckets": ["theirs", "shared/theirs/*"], "tables": ["theirs"], "logGroups": ["*"]}
    }"#;
    let stored = |bucket: &str, prefix: Option<&str>| json!({"storage": {"s3": {"bucket": bucket, "prefix": prefix}}});
    let with = |key: &str, member: &str, name: &str| {
        let mut spec = stored("ours-1", None);
        spec[key] = json!({member: {"name": name}});
        spec
    };
    let cases = [
        (stored("ours-1", None), None),
        (stored("ours-1", Some("a/b/")), None),
        (stored("theirs", None), Some("Bucket theirs/")),
        (stored("shared", Some("ours/")), None),
        (stored("shared", Some("ours/20/")), None),
        (stored("shared", Some("theirs/")), Some("Bucket shared/theirs/")),
        (stored("shared", Some("ours2/")), Some("Bucket shared/ours2/")),
        // All of a bucket that is shared holds the others' too.
        (stored("shared", None), Some("Bucket shared/")),
        (with("table", "dynamoDB", "ours-rows"), None),
        (with("table", "dynamoDB", "theirs"), Some("Table theirs")),
        (with("logs", "cloudWatch", "/leaderboards/ours"), None),
        (
            with("logs", "cloudWatch", "/leaderboards/ours/2"),
            Some("LogGroup /leaderboards/ours/2"),
        ),
    ];
    for (spec, expected) in cases {
        assert_eq!(refused(ours, &spec).as_deref(), expected, "{spec}");
        assert_eq!(refused("", &spec), None, "{spec}");
    }
}

#[test]
fn without_a_setting_everything_is_allowed_and_with_an_empty_one_nothing() {
    let leaderboard = leaderboard("ours", Some("payroll"), Some(QUEUE), Some(DEAD));
    assert_eq!(kind("", &leaderboard), None);
    assert_eq!(Allowed::default().refusal(&leaderboard), None);
    assert_eq!(kind("{}", &leaderboard), Some(Kind::Entry));
}

#[test]
fn the_star_is_for_namespaces_without_an_entry() {
    let allowed = r#"{"*": {"queues": ["shared-*"], "buckets": ["*"]}, "ours": {"queues": ["submissions"]}}"#;
    let shared = "https://sqs.us-east-1.amazonaws.com/123456789012/shared-1";
    assert_eq!(kind(allowed, &leaderboard("any", None, Some(shared), None)), None);
    assert_eq!(
        kind(allowed, &leaderboard("ours", None, Some(shared), None)),
        Some(Kind::Queue)
    );
    assert_eq!(
        kind(allowed, &leaderboard("any", None, Some(QUEUE), None)),
        Some(Kind::Queue)
    );
}

#[test]
fn patterns_match_whole_texts() {
    let cases = [
        ("evalai", "evalai", true),
        ("evalai", "evalai2", false),
        ("evalai", "my-evalai", false),
        ("*", "", true),
        ("*", "anything/at:all", true),
        ("evalai/*", "evalai/token", true),
        ("evalai/*", "evalai/", true),
        ("evalai/*", "other/evalai/token", false),
        ("*-dead", "submissions-dead", true),
        ("*-dead", "submissions-dead-2", false),
        ("a*b*c", "abc", true),
        ("a*b*c", "a-b-b-c", true),
        ("a*b*c", "acb", false),
        ("ab*ba", "aba", false),
        ("a**c", "abc", true),
        ("", "", true),
        ("", "a", false),
    ];
    for (pattern, text, expected) in cases {
        assert_eq!(matches(pattern, text), expected, "{pattern} {text}");
    }
}

#[test]
fn a_queue_is_known_by_its_name_or_by_its_url() {
    let account = "https://sqs.us-east-1.amazonaws.com/123456789012/*";
    let cases = [
        ("submissions", QUEUE, true),
        (account, QUEUE, true),
        (
            account,
            "https://sqs.us-east-1.amazonaws.com/999999999999/submissions",
            false,
        ),
        (
            "submissions",
            "https://sqs.us-east-1.amazonaws.com/123456789012/payroll?/submissions",
            false,
        ),
        (
            "submissions",
            "https://sqs.us-east-1.amazonaws.com/123456789012/payroll#/submissions",
            false,
        ),
        ("123456789012", QUEUE, false),
    ];
    for (pattern, url, expected) in cases {
        assert_eq!(is_queue(pattern, url), expected, "{pattern} {url}");
    }
}

#[test]
fn a_refusal_names_what_is_refused_and_the_next_step() {
    let allowed: Allowed = r#"{"ours": {}}"#.parse().unwrap();
    let refused = allowed
        .refusal(&leaderboard("ours", Some("payroll"), None, None))
        .unwrap();
    assert_eq!(
        refused.to_string(),
        "Leaderboards of the namespace ours may not name the entry of Secrets Manager payroll: the operator's administrator allows it \
         in the chart's values, in allow.secretsManager or in secretsManager of this namespace's entry in namespaces."
    );
}

#[test]
fn a_setting_that_cannot_be_read_is_an_error_and_allows_nothing() {
    for text in [
        "nonsense",
        "[]",
        r#"{"ours": {"queue": []}}"#,
        r#"{"ours": {"queues": "submissions"}}"#,
    ] {
        let error = text.parse::<Allowed>().unwrap_err();
        assert!(error.to_string().contains("\"queues\": []"), "{error}");
    }
}
