//! Statuses of Pods and Jobs in the words of the kubelet and the Job controller. Builds JSON alone; `player` writes it.

use jiff::Timestamp;
use serde_json::{Value, json};

/// The present second, as Kubernetes writes it.
pub fn now() -> String {
    Timestamp::now().strftime("%Y-%m-%dT%H:%M:%SZ").to_string()
}

/// State of a container that runs since now.
pub fn running() -> Value {
    json!({"running": {"startedAt": now()}})
}

/// State of a container that has ended now, with this content of its termination log.
pub fn ended(exit_code: i32, message: &str) -> Value {
    let (now, reason) = (now(), if exit_code == 0 { "Completed" } else { "Error" });
    let message = (!message.is_empty()).then_some(message);
    json!({"terminated": {
        "exitCode": exit_code, "reason": reason, "message": message, "startedAt": now, "finishedAt": now,
    }})
}

/// Status of a container in its first life. `image_id` is empty where no registry has named the image.
pub fn container(name: &str, image: &str, image_id: &str, state: &Value) -> Value {
    let runs = state.get("running").is_some();
    json!({
        "name": name, "image": image, "imageID": image_id, "restartCount": 0, "ready": runs, "started": runs,
        "state": state,
    })
}

/// Status of a Pod on a node, with the statuses of its containers.
pub fn pod(phase: &str, init: &[Value], containers: &[Value]) -> Value {
    let now = now();
    json!({
        "phase": phase,
        "startTime": now,
        "conditions": [{"type": "PodScheduled", "status": "True", "lastTransitionTime": now}],
        "initContainerStatuses": init,
        "containerStatuses": containers,
    })
}

/// The status of a container in the status of its Pod.
pub fn container_of<'a>(pod: &'a mut Value, name: &str) -> &'a mut Value {
    let all = pod["containerStatuses"].as_array_mut().unwrap();
    all.iter_mut().find(|container| container["name"] == name).unwrap()
}

/// Status of a Job whose Pod runs.
pub fn job_started() -> Value {
    json!({"active": 1, "ready": 1, "startTime": now()})
}

/// Status of a Job whose Pod has ended well.
pub fn job_complete() -> Value {
    let now = now();
    let condition = |kind: &str| json!({"type": kind, "status": "True", "reason": "CompletionsReached", "lastTransitionTime": now, "lastProbeTime": now});
    json!({
        "active": null, "ready": 0, "succeeded": 1, "completionTime": now, "uncountedTerminatedPods": {},
        "conditions": [condition("SuccessCriteriaMet"), condition("Complete")],
    })
}

/// Status of a Job whose Pods are deleted, because it is suspended.
pub fn job_suspended() -> Value {
    let suspended =
        json!({"type": "Suspended", "status": "True", "reason": "JobSuspended", "lastTransitionTime": now()});
    json!({"active": null, "ready": 0, "startTime": null, "conditions": [suspended]})
}

/// Status of a Job that is resumed.
pub fn job_resumed() -> Value {
    let now = now();
    let resumed = json!({"type": "Suspended", "status": "False", "reason": "JobResumed", "lastTransitionTime": now});
    json!({"active": 1, "ready": 0, "startTime": now, "conditions": [resumed]})
}
