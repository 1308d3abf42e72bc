//! What Leaderboards may name where the operator acts with an AWS identity of its own: entries of Secrets Manager, and queues. Pure.
//!
//! Who may edit Leaderboards in one namespace could otherwise have any entry sent to a server of their own, and any queue emptied. The
//! chart hands in what `leaderboards[]` of its values has; without it, as on a person's machine, everything is allowed. Asked by the
//! controller, which then reads no token and shows `NotAllowed`, and by the bridge, which then reads no queue.

use std::collections::BTreeMap;
use std::fmt;
use std::str::FromStr;

use serde::Deserialize;

use leaderboard_api::Leaderboard;

/// Stands for every namespace that has no entry of its own.
const ANY: &str = "*";

/// What Leaderboards may name, by their namespace.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Allowed(Option<BTreeMap<String, Patterns>>);

/// Patterns, in which `*` stands for any text.
#[derive(Deserialize, Clone, Debug, Default, PartialEq, Eq)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
struct Patterns {
    #[serde(default)]
    secrets_manager: Vec<String>,
    #[serde(default)]
    queues: Vec<String>,
}

/// What a Leaderboard names and may not.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NotAllowed {
    kind: Kind,
    name: String,
    namespace: String,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    Entry,
    Queue,
    DeadLetterQueue,
}

impl fmt::Display for NotAllowed {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (what, list) = match self.kind {
            Kind::Entry => ("entry of Secrets Manager", "secretsManager"),
            Kind::Queue => ("queue", "queues"),
            Kind::DeadLetterQueue => ("dead-letter queue", "queues"),
        };
        let Self { name, namespace, .. } = self;
        write!(
            f,
            "Leaderboards of the namespace {namespace} may not name the {what} {name}: the operator's administrator allows it in the \
             chart's values, under leaderboards[] of this namespace in {list}."
        )
    }
}

/// Why the operator's settings cannot be used.
#[derive(thiserror::Error, Debug, PartialEq, Eq)]
#[error(
    "what Leaderboards may name is not JSON such as {{\"namespace\": {{\"secretsManager\": [], \"queues\": []}}}}: {0}"
)]
pub struct Malformed(String);

impl FromStr for Allowed {
    type Err = Malformed;

    /// Reads JSON; an empty text sets no bounds.
    fn from_str(text: &str) -> Result<Self, Malformed> {
        if text.is_empty() {
            return Ok(Self(None));
        }
        serde_json::from_str(text)
            .map(|by_namespace| Self(Some(by_namespace)))
            .map_err(|error| Malformed(error.to_string()))
    }
}

impl Allowed {
    /// The first thing that a Leaderboard names and may not.
    pub fn refusal(&self, leaderboard: &Leaderboard) -> Option<NotAllowed> {
        let by_namespace = self.0.as_ref()?;
        let namespace = leaderboard.metadata.namespace.as_deref().unwrap_or_default();
        let none = Patterns::default();
        let patterns = by_namespace
            .get(namespace)
            .or_else(|| by_namespace.get(ANY))
            .unwrap_or(&none);
        let refused = named(leaderboard).find(|(kind, name)| !patterns.allow(*kind, name));
        refused.map(|(kind, name)| NotAllowed {
            kind,
            name: name.to_owned(),
            namespace: namespace.to_owned(),
        })
    }
}

impl Patterns {
    fn allow(&self, kind: Kind, name: &str) -> bool {
        match kind {
            Kind::Entry => self.secrets_manager.iter().any(|pattern| matches(pattern, name)),
            Kind::Queue | Kind::DeadLetterQueue => self.queues.iter().any(|pattern| is_queue(pattern, name)),
        }
    }
}

/// Everything that a Leaderboard names of what is allowed by name.
fn named(leaderboard: &Leaderboard) -> impl Iterator<Item = (Kind, &str)> {
    let spec = &leaderboard.spec;
    let entry = spec
        .evalai
        .iter()
        .filter_map(|evalai| evalai.token.secrets_manager.as_ref());
    let entries = entry.map(|entry| (Kind::Entry, entry.id.as_str()));
    let queues = spec.queue.iter().flat_map(|queue| {
        let dead = queue.dead_letter_url.as_deref().map(|url| (Kind::DeadLetterQueue, url));
        [(Kind::Queue, queue.url.as_str())].into_iter().chain(dead)
    });
    entries.chain(queues)
}

/// A pattern with a slash is about the whole URL, any other one about the queue's name, which is its end.
fn is_queue(pattern: &str, url: &str) -> bool {
    if pattern.contains('/') {
        return matches(pattern, url);
    }
    let name = url.rsplit('/').next().unwrap_or_default();
    // Nothing of a URL but its path is the queue's.
    !url.contains(['?', '#']) && matches(pattern, name)
}

/// Whether a text matches the pattern: `*` stands for any text, also none; all else for itself.
fn matches(pattern: &str, text: &str) -> bool {
    let mut parts = pattern.split('*');
    let first = parts.next().unwrap_or_default();
    let Some(mut rest) = text.strip_prefix(first) else {
        return false;
    };
    let Some(last) = parts.next_back() else {
        return rest.is_empty();
    };
    for part in parts {
        let Some((_, after)) = rest.split_once(part) else {
            return false;
        };
        rest = after;
    }
    rest.ends_with(last)
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    fn leaderboard(namespace: &str, entry: Option<&str>, queue: Option<&str>, dead: Option<&str>) -> Leaderboard {
        let token = match entry {
            Some(id) => json!({"secretsManager": {"id": id}}),
            None => json!({"secretKeyRef": {"name": "evalai", "key": "token"}}),
        };
        let mut spec = json!({
            "leaderboardVersion": "V2", "tracks": [{"name": "sensors", "codename": "SENSORS", "phase": 1}],
            "contents": {"image": "contents"}, "simulator": {"image": "simulator"}, "storage": {"bucket": "bucket"},
            "evalai": {"apiServer": "https://eval.ai", "challenge": 1, "token": token},
        });
        if let Some(url) = queue {
            spec["queue"] = json!({"url": url});
            spec["queue"]["deadLetterURL"] = dead.map_or(Value::Null, Value::from);
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
        let ours = r#"{"ours": {"secretsManager": ["evalai/*"], "queues": ["submissions", "*-dead"]}, "theirs": {"queues": ["*"]}}"#;
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
            (("nobodys", None, None, None), None),
            (("nobodys", None, Some(QUEUE), None), Some(Kind::Queue)),
            (("nobodys", entry, None, None), Some(Kind::Entry)),
        ];
        for ((namespace, entry, queue, dead), expected) in cases {
            let found = kind(ours, &leaderboard(namespace, entry, queue, dead));
            assert_eq!(found, expected, "{namespace} {entry:?} {queue:?} {dead:?}");
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
        let allowed = r#"{"*": {"queues": ["shared-*"]}, "ours": {"queues": ["submissions"]}}"#;
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
             in the chart's values, under leaderboards[] of this namespace in secretsManager."
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
}
