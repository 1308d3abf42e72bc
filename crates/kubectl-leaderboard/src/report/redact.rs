//! Takes out of objects what a report must not hold. Pure.

use serde_json::{Value, json};

/// What stands where something was taken out.
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
/// Reasons whose messages quote a checkpoint, and with it routes.
const OF_RESULTS: [&str; 3] = ["InvalidResults", "NotEligible", "UnexplainedScores"];

/// The objects of one file.
pub(super) fn objects(file: &str, objects: Vec<Value>) -> Value {
    let is_of_pods = file.starts_with("pods");
    let all = objects
        .into_iter()
        .map(|object| if is_of_pods { pod(&object) } else { object });
    Value::Array(all.map(redacted).collect())
}

/// Of a Pod, how its containers fare: its spec has the plan and the environment.
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

fn redacted(value: Value) -> Value {
    match value {
        Value::Array(items) => Value::Array(items.into_iter().map(redacted).collect()),
        Value::Object(fields) => {
            let quotes = fields
                .get("reason")
                .and_then(Value::as_str)
                .is_some_and(|reason| OF_RESULTS.contains(&reason));
            let kept = fields.into_iter().filter(|(key, _)| !DROPPED.contains(&key.as_str()));
            let fields = kept.map(|(key, value)| {
                let value = match key.as_str() {
                    // Events call it a note.
                    "message" | "note" if quotes => json!(REMOVED),
                    "env" => without_values(value),
                    "team" => team(&value),
                    _ => redacted(value),
                };
                (key, value)
            });
            Value::Object(fields.collect())
        }
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

/// The id of a team. In a Leaderboard's counts the team is its id.
fn team(team: &Value) -> Value {
    match team {
        Value::Object(_) => json!({"id": team["id"]}),
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
        let text = objects("submissions.json", vec![submission, board]).to_string();
        assert!(!text.contains(secret), "{text}");
        for kept in ["stays", "TOKEN", "\"id\":\"7\"", "InvalidResults"] {
            assert!(text.contains(kept), "{kept}: {text}");
        }
    }

    #[test]
    fn an_event_that_quotes_results_keeps_its_reason_alone() {
        let event = |reason: &str, note: &str| json!({"reason": reason, "note": note, "regarding": {"name": "a"}});
        let mut events: Vec<Value> = OF_RESULTS.iter().map(|reason| event(reason, "s3cr3t")).collect();
        events.push(event("Replacing", "stays"));
        let text = objects("events.json", events).to_string();
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
        let text = objects("pods.json", vec![pod]).to_string();
        assert!(!text.contains("s3cr3t") && !text.contains("LEADERBOARD_RUN"), "{text}");
        assert!(text.contains("\"exitCode\":1") && text.contains("gpu-3"), "{text}");
    }
}
