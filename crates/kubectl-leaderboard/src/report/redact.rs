//! Takes out of objects what a report must not hold. Pure.

use std::collections::BTreeSet;

use leaderboard_api::Reason;
use serde_json::{Value, json};

/// Stands in place of a removed text.
const REMOVED: &str = "<removed>";
/// Fields that are dropped wherever they are: what Kubernetes repeats, whose a submission is, and what programs wrote before they ended.
const DROPPED: [&str; 6] = [
    "managedFields",
    "annotations",
    "displayName",
    "participantMessage",
    "nextStep",
    "podOverrides",
];
/// Reasons whose messages quote results, with CARLA's routes, or names of files.
const OF_RESULTS: [Reason; 5] = [
    Reason::InvalidResults,
    Reason::InputInvalid,
    Reason::NotEligible,
    Reason::UnexplainedScores,
    Reason::EvaluatorFailed,
];

/// Names of the teams of submissions that have no id: counts and messages call these by their name.
pub(super) fn names(submissions: &[Value]) -> BTreeSet<String> {
    let teams = submissions
        .iter()
        .flat_map(|one| [&one["spec"]["team"], &one["status"]["team"]]);
    let without_id = teams.filter(|team| team["id"].is_null());
    without_id
        .filter_map(|team| team["name"].as_str())
        .map(str::to_owned)
        .collect()
}

/// The objects of one part, without these names of teams.
pub(super) fn objects(part: &str, objects: Vec<Value>, names: &BTreeSet<String>) -> Value {
    let is_of_pods = part == "pods";
    let all = objects
        .into_iter()
        .map(|object| if is_of_pods { pod(&object) } else { object });
    Value::Array(all.map(|object| redacted(object, names)).collect())
}

/// The state of a Pod's containers. Its spec stays out, because it has the plan and the environment.
fn pod(pod: &Value) -> Value {
    let containers = |key: &str| {
        let all = pod["status"][key].as_array().map(Vec::as_slice).unwrap_or_default();
        all.iter().map(container).collect::<Vec<_>>()
    };
    json!({
        "metadata": {"name": pod["metadata"]["name"], "labels": pod["metadata"]["labels"],
                     "creationTimestamp": pod["metadata"]["creationTimestamp"]},
        "node": pod["spec"]["nodeName"],
        "phase": pod["status"]["phase"], "conditions": pod["status"]["conditions"],
        "initContainers": containers("initContainerStatuses"), "containers": containers("containerStatuses"),
    })
}

fn container(status: &Value) -> Value {
    let mut state = json!({"state": status["state"], "lastState": status["lastState"]});
    for key in ["state", "lastState"] {
        // A message at the end of a container is its program's own.
        if let Some(end) = state[key].get_mut("terminated").and_then(Value::as_object_mut) {
            end.remove("message");
        }
    }
    json!({"name": status["name"], "image": status["image"], "restarts": status["restartCount"],
           "state": state["state"], "lastState": state["lastState"]})
}

fn redacted(value: Value, names: &BTreeSet<String>) -> Value {
    match value {
        Value::Array(items) => Value::Array(items.into_iter().map(|item| redacted(item, names)).collect()),
        Value::Object(fields) => {
            let quotes = fields
                .get("reason")
                .and_then(Value::as_str)
                .and_then(Reason::of)
                .is_some_and(|reason| OF_RESULTS.contains(&reason));
            let kept = fields.into_iter().filter(|(key, _)| !DROPPED.contains(&key.as_str()));
            let fields = kept.map(|(key, value)| {
                let value = match key.as_str() {
                    // Events call it a note.
                    "message" | "note" if quotes => json!(REMOVED),
                    "env" => without_values(value),
                    "team" => team(&value),
                    _ => redacted(value, names),
                };
                (key, value)
            });
            Value::Object(fields.collect())
        }
        Value::String(text) => Value::String(names.iter().fold(text, |text, name| {
            text.replace(&format!("team {name}"), &format!("team {REMOVED}"))
        })),
        scalar => scalar,
    }
}

/// The names of variables without their values.
fn without_values(env: Value) -> Value {
    let Value::Array(variables) = env else {
        return json!(REMOVED);
    };
    let names = variables
        .into_iter()
        .map(|variable| json!({"name": variable["name"], "value": REMOVED}));
    Value::Array(names.collect())
}

/// The id of a team. In a Leaderboard's counts the team is its id, or its name if it has none; EvalAI's ids are numbers.
fn team(team: &Value) -> Value {
    match team {
        Value::Object(_) => json!({"id": team["id"]}),
        Value::String(text) if !text.bytes().all(|byte| byte.is_ascii_digit()) => json!(REMOVED),
        other => other.clone(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn neither_secrets_nor_routes_nor_names_are_left() {
        let secret = "s3cr3t";
        let submission = json!({
            "metadata": {"name": "a", "managedFields": [secret], "annotations": {"x": secret}},
            "spec": {"team": {"id": "7", "name": secret}},
            "status": {"team": {"id": "7", "name": secret, "displayName": secret}, "reason": "InvalidResults", "message": secret,
                       "failure": {"reason": "InvalidResults", "message": secret, "nextStep": secret},
                       "conditions": [{"type": "Plausible", "reason": "UnexplainedScores", "message": secret},
                                      {"type": "Ready", "reason": "Ready", "message": "stays"}]},
        });
        let board =
            json!({"spec": {"agent": {"env": [{"name": "TOKEN", "value": secret}]}, "podOverrides": {"x": secret}}});
        let text = objects("submissions", vec![submission, board], &BTreeSet::new()).to_string();
        assert!(!text.contains(secret), "{text}");
        for kept in ["stays", "TOKEN", "\"id\":\"7\"", "InvalidResults"] {
            assert!(text.contains(kept), "{kept}: {text}");
        }
    }

    #[test]
    fn a_team_without_an_id_is_named_neither_in_counts_nor_in_messages() {
        let ended =
            "Node gpu-3 was lost. Within a day 2 attempts of team Team Seven ended like this in this Leaderboard.";
        let submission = json!({
            "spec": {"team": {"name": "Team Seven"}},
            "status": {"team": {"name": "Team Seven", "displayName": "Team Seven"}, "failure": {"reason": "NodeLost", "message": ended}},
        });
        let numbered = json!({"spec": {"team": {"id": "8", "name": "gpu"}}});
        let board =
            json!({"status": {"gpuUse": [{"team": "Team Seven", "gpuSeconds": 4}, {"team": "8", "gpuSeconds": 2}]}});
        let all = vec![
            submission,
            numbered,
            board,
            json!({"reason": "NodeLost", "note": ended}),
        ];
        let names = names(&all);
        let text = objects("submissions", all, &names).to_string();
        assert!(!text.contains("Seven"), "{text}");
        for kept in ["\"team\":\"8\"", "attempts of team <removed> ended", "gpu-3"] {
            assert!(text.contains(kept), "{kept}: {text}");
        }
    }

    #[test]
    fn an_event_that_quotes_results_keeps_its_reason_alone() {
        let event = |reason: &str, note: &str| json!({"reason": reason, "note": note, "regarding": {"name": "a"}});
        let mut events: Vec<Value> = OF_RESULTS
            .iter()
            .map(|reason| event(reason.as_str(), "s3cr3t"))
            .collect();
        events.push(event("Replacing", "stays"));
        let text = objects("events", events, &BTreeSet::new()).to_string();
        assert!(!text.contains("s3cr3t"), "{text}");
        assert!(text.contains("InvalidResults") && text.contains("stays"), "{text}");
    }

    #[test]
    fn of_a_pod_only_what_became_of_it_is_kept() {
        let ended = json!({"terminated": {"exitCode": 1, "reason": "Error", "message": "s3cr3t"}});
        let pod = json!({
            "metadata": {"name": "p", "labels": {"a": "b"}},
            "spec": {"nodeName": "gpu-3", "containers": [{"env": [{"name": "LEADERBOARD_RUN", "value": "s3cr3t"}]}]},
            "status": {"phase": "Failed", "containerStatuses": [{"name": "agent-1", "image": "a:1", "state": ended}]},
        });
        let text = objects("pods", vec![pod], &BTreeSet::new()).to_string();
        assert!(!text.contains("s3cr3t") && !text.contains("LEADERBOARD_RUN"), "{text}");
        assert!(text.contains("\"exitCode\":1") && text.contains("gpu-3"), "{text}");
    }
}
