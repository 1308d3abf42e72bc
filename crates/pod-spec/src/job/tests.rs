//! The built Job as JSON: the committed golden files, and what must hold for every input.

use std::fs;
use std::path::PathBuf;

use serde_json::{Value, json};

use super::*;
use leaderboard_api::{Agents, FailedNode, JobNumber, effective};

pub(super) const OPERATOR_IMAGE: &str = "registry.example/leaderboard-operator:1";

/// The input of a test's Job.
pub(super) struct Case {
    pub(super) submission: Submission,
    pub(super) leaderboard: Leaderboard,
    pub(super) plan: RunPlan,
    pub(super) number: JobNumber,
    pub(super) file: Option<SubmittedFile>,
    pub(super) own: OwnImage,
    pub(super) failed_nodes: Vec<FailedNode>,
}

/// Lays fields over a spec, those of `evaluation.carla` one by one.
pub(super) fn lay(spec: &mut Value, more: &Value) {
    for (key, value) in more.as_object().unwrap() {
        match key.as_str() {
            "evaluation" => lay(&mut spec["evaluation"]["carla"], &value["carla"]),
            key => spec[key] = value.clone(),
        }
    }
}

impl Case {
    /// A Leaderboard with one track, `more` laid over its spec.
    #[allow(clippy::needless_pass_by_value, reason = "the cases read better")]
    pub(super) fn new(format: &str, more: Value) -> Self {
        let mut spec = json!({
            "evaluation": {"carla": {
                "version": format, "contents": {"image": "registry.example/contents:1"},
                "simulator": {"image": "registry.example/carla:1"},
            }},
            "tracks": [{"name": "sensors", "carla": {"codename": "SENSORS"}}],
            "gpu": {"resourceName": "nvidia.com/gpu"},
            "agent": {},
            "storage": {"s3": {"bucket": "results", "prefix": "runs/", "region": "eu-west-1"}},
        });
        lay(&mut spec, &more);
        Self::of(&spec)
    }

    /// A Leaderboard with an evaluator of the host's and one track, `container` and `more` laid over evaluation and spec.
    #[allow(clippy::needless_pass_by_value, reason = "the cases read better")]
    pub(super) fn container(container: Value, more: &Value) -> Self {
        let mut evaluation = json!({"mode": "Interactive", "image": "registry.example/evaluator:1", "command": ["python3", "/evaluate.py"]});
        for (key, value) in container.as_object().unwrap() {
            evaluation[key] = value.clone();
        }
        let mut spec = json!({
            "evaluation": {"container": evaluation},
            "tracks": [{"name": "test", "container": {"score": {"metric": "accuracy"}}}],
            "agent": {"command": ["/agent"]},
            "storage": {"s3": {"bucket": "results", "prefix": "runs/", "region": "eu-west-1"}},
        });
        for (key, value) in more.as_object().unwrap() {
            spec[key] = value.clone();
        }
        Self::of(&spec)
    }

    /// The first track of a Leaderboard with this spec.
    fn of(spec: &Value) -> Self {
        let leaderboard: Leaderboard = serde_json::from_value(json!({
            "apiVersion": "leaderboard.carla.org/v1alpha1", "kind": "Leaderboard",
            "metadata": {"name": "carla", "namespace": "challenge", "uid": "leaderboard-uid"}, "spec": spec,
        }))
        .unwrap();
        let submission: Submission = serde_json::from_value(json!({
            "apiVersion": "leaderboard.carla.org/v1alpha1", "kind": "Submission",
            "metadata": {"name": "submission-4711", "namespace": "challenge", "uid": "submission-uid"},
            "spec": {"leaderboardName": "carla", "evalai": {"challenge": 1, "phase": 2, "submission": 4711}},
        }))
        .unwrap();
        let takes_files = leaderboard_evaluation::of(&leaderboard.spec).agents() == Agents::Absent;
        let image = (!takes_files).then(|| "registry.example/team@sha256:0a1b".to_owned());
        let file = takes_files.then(|| SubmittedFile {
            sha256: "0a1b".repeat(16),
            size: 12_345,
        });
        let plan = effective::plan(
            &leaderboard.spec,
            &leaderboard.spec.tracks[0],
            "4711".parse().unwrap(),
            image,
            false,
        )
        .unwrap();
        Self {
            submission,
            leaderboard,
            plan,
            number: JobNumber::first(Attempt(1)),
            file,
            own: OwnImage {
                image: OPERATOR_IMAGE.into(),
                ..OwnImage::default()
            },
            failed_nodes: Vec::new(),
        }
    }

    pub(super) fn input(&self) -> JobInput<'_> {
        JobInput {
            submission: &self.submission,
            leaderboard: &self.leaderboard,
            plan: &self.plan,
            number: self.number,
            input: self.file.as_ref(),
            own: &self.own,
            failed_nodes: &self.failed_nodes,
            now: "2026-11-01T12:00:00Z".parse().unwrap(),
        }
    }

    pub(super) fn json(&self) -> Value {
        serde_json::to_value(build_object(&self.input())).unwrap()
    }
}

pub(super) fn containers(job: &Value) -> Vec<&Value> {
    let pod = &job["spec"]["template"]["spec"];
    [&pod["initContainers"], &pod["containers"]]
        .into_iter()
        .flat_map(|list| list.as_array().unwrap())
        .collect()
}

pub(super) fn container<'a>(job: &'a Value, name: &str) -> &'a Value {
    containers(job)
        .into_iter()
        .find(|container| container["name"] == name)
        .unwrap()
}

pub(super) fn role() -> Value {
    json!({"serviceAccountName": "submission-worker", "roleARN": "arn:aws:iam::123456789012:role/results"})
}

fn golden(name: &str, case: &Case) {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR"))
        .join("src/job/golden")
        .join(name);
    let built = format!("{:#}\n", case.json());
    if std::env::var_os("UPDATE_GOLDEN").is_some() {
        fs::write(&path, &built).unwrap();
    }
    let known = fs::read_to_string(&path).unwrap();
    assert!(
        built == known,
        "{name} differs from what is built; set UPDATE_GOLDEN=1 and read the difference"
    );
}

#[test]
fn the_job_of_leaderboard_1_is_as_committed() {
    golden(
        "v1.json",
        &Case::new("V1", json!({"podIdentity": {"secretName": "results-writer"}})),
    );
}

#[test]
fn the_job_of_leaderboard_2_is_as_committed() {
    let mut case = Case::new(
        "V2",
        json!({
            "podIdentity": role(),
            "runtimeClassName": "gvisor",
            "logs": {"cloudWatch": {"name": "leaderboard"}},
            "tracks": [{
                "name": "sensors", "carla": {"codename": "SENSORS"}, "phase": 2,
                "nodeSelector": {"node.kubernetes.io/instance-type": "g5.12xlarge"},
                "tolerations": [{"key": "nvidia.com/gpu", "operator": "Exists", "effect": "NoSchedule"}],
            }],
        }),
    );
    case.number.attempt = Attempt(3);
    case.number.retry = 1;
    golden("v2.json", &case);
}

#[test]
fn the_job_of_an_evaluator_without_a_port_is_as_committed() {
    golden("interactive-1.json", &Case::container(json!({}), &json!({})));
}

#[test]
fn the_job_of_two_evaluators_with_ports_and_gpus_is_as_committed() {
    let container = json!({
        "workers": 2, "port": 9000, "shmSize": "256Mi", "answerSeconds": 60,
        "args": ["--split", "$(PHASE)"], "env": [{"name": "LABELS", "value": "/data/labels.csv"}],
        "resources": {"limits": {"memory": "4Gi"}}, "securityContext": {"runAsUser": 1000},
    });
    let more = json!({
        "podIdentity": role(),
        "gpu": {"resourceName": "nvidia.com/gpu"},
        "tracks": [{"name": "test", "phase": 2, "container": {"score": {"split": "test", "metric": "accuracy"}}}],
        "agent": {"command": ["/agent", "--server", "$(EVALUATOR_ADDRESS)"], "shmSize": "1Gi"},
    });
    let mut case = Case::container(container, &more);
    case.number.attempt = Attempt(2);
    golden("interactive-2.json", &case);
}

#[test]
fn the_job_of_an_agent_that_leaves_files_for_two_evaluators_is_as_committed() {
    let container = json!({
        "mode": "Batch", "workers": 2, "shmSize": "256Mi", "answerSeconds": 60,
        "dataset": {"image": {"reference": "registry.example/dataset:1"}},
        "labels": {"persistentVolumeClaim": {"claimName": "labels"}},
        "input": {"maxBytes": "10Mi"},
    });
    let more = json!({
        "podIdentity": role(),
        "gpu": {"resourceName": "nvidia.com/gpu"},
        "tracks": [{"name": "test", "phase": 2, "container": {"score": {"metric": "accuracy"}}}],
        "agent": {"command": ["/agent", "--to", "$(SUBMISSION_PATH)"], "shmSize": "1Gi"},
    });
    golden("batch-2.json", &Case::container(container, &more));
}

#[test]
fn the_job_of_a_submitted_file_is_as_committed() {
    let container = json!({"mode": "Predictions", "labels": {"image": {"reference": "registry.example/labels:1"}}});
    golden("predictions-1.json", &Case::container(container, &json!({"agent": {}})));
}

#[test]
fn the_job_of_two_evaluators_whose_results_a_command_merges_is_as_committed() {
    let container = json!({"workers": 2, "port": 9000, "merge": "Command"});
    let gpu = json!({"mode": "NodeIndex", "resourceName": "nvidia.com/gpu"});
    golden("merge-2.json", &Case::container(container, &json!({"gpu": gpu})));
}

#[test]
#[expect(clippy::useless_vec, reason = "an array of Leaderboards is too large for the stack")]
fn the_job_has_no_field_that_kubernetes_does_not_know() {
    let data = json!({"image": {"reference": "d"}});
    for case in vec![
        Case::new("V2", json!({"podIdentity": role()})),
        Case::container(json!({"port": 9000}), &json!({})),
        Case::container(json!({"mode": "Batch", "dataset": data}), &json!({})),
        Case::container(
            json!({"mode": "Predictions", "labels": {"persistentVolumeClaim": {"claimName": "c"}}}),
            &json!({}),
        ),
    ] {
        let json = case.json();
        let typed: Job = serde_json::from_value(json.clone()).unwrap();
        assert_eq!(serde_json::to_value(typed).unwrap(), json);
    }
}

#[test]
fn a_plan_of_another_kind_than_its_leaderboards_has_no_container_of_a_worker() {
    let mut case = Case::new("V2", json!({}));
    case.leaderboard.spec.evaluation = Case::container(json!({}), &json!({})).leaderboard.spec.evaluation;
    let pod = &case.json()["spec"]["template"]["spec"];
    assert_eq!(pod["containers"], json!([]), "the API server refuses such a Job");
}

#[test]
fn a_field_that_this_client_does_not_know_survives() {
    let case = Case::new(
        "V2",
        json!({"podOverrides": {"spec": {"fieldOfTheFuture": {"on": true}}}}),
    );
    assert_eq!(
        case.json()["spec"]["template"]["spec"]["fieldOfTheFuture"],
        json!({"on": true})
    );
}

#[test]
fn an_overlay_that_is_refused_is_not_applied() {
    let case = Case::new(
        "V2",
        json!({"podOverrides": {"spec": {"hostNetwork": true, "priorityClassName": "high"}}}),
    );
    assert_eq!(case.json(), Case::new("V2", json!({})).json());
    assert_eq!(containers(&case.json()).len(), 3 + 8);
}

#[test]
fn names_fit_wherever_kubernetes_puts_them() {
    let mut case = Case::new("V2", json!({"evaluation": {"carla": {"pairs": 16, "routes": 100}}}));
    case.submission.metadata.name = Some("s".repeat(52));
    case.number.attempt = Attempt(99_999);
    case.number.retry = 100;
    let job = case.json();
    // Kubernetes makes a label of it.
    assert!(job["metadata"]["name"].as_str().unwrap().len() <= 63);
    for value in job["spec"]["template"]["metadata"]["labels"]
        .as_object()
        .unwrap()
        .values()
    {
        assert!(value.as_str().unwrap().len() <= 63, "{value}");
    }
    let pod = &job["spec"]["template"]["spec"];
    for name in containers(&job).into_iter().chain(pod["volumes"].as_array().unwrap()) {
        assert!(name["name"].as_str().unwrap().len() <= 63);
    }
}

#[test]
fn jobs_and_pods_show_whose_they_are() {
    let mut case = Case::new("V2", json!({}));
    case.number = JobNumber {
        attempt: Attempt(2),
        retry: 3,
    };
    let job = case.json();
    assert_eq!(job["metadata"]["name"], "submission-4711-2-r3");
    assert_eq!(job["metadata"]["annotations"]["leaderboard.carla.org/retry"], "3");
    let labels = json!({
        "app.kubernetes.io/managed-by": "leaderboard-operator",
        "leaderboard.carla.org/submission": "submission-4711",
        "leaderboard.carla.org/attempt": "2",
        "leaderboard.carla.org/leaderboard": "carla",
        "leaderboard.carla.org/run": "4711",
    });
    assert_eq!(job["metadata"]["labels"], labels);
    assert_eq!(job["spec"]["template"]["metadata"]["labels"], labels);
}

#[test]
fn the_nets_are_wider_than_the_rules_above_them() {
    let cases = [
        (json!({}), 52, None),
        (
            json!({"evaluation": {"carla": {"pairs": 1}}, "retries": {"perWorker": 0}, "deadlines": {"runSeconds": 7200}}),
            22,
            Some(5400 + 1800 + 7200 + 120 + 1800 + 1800),
        ),
        (
            json!({"evaluation": {"carla": {"pairs": 16}}, "retries": {"perWorker": 100}, "deadlines": {"runSeconds": i64::MAX}}),
            3252,
            Some(i32::MAX.into()),
        ),
    ];
    for (more, backoff, deadline) in cases {
        let job = Case::new("V2", more).json();
        assert_eq!(job["spec"]["backoffLimit"], backoff);
        assert_eq!(
            job["spec"]["template"]["spec"]["activeDeadlineSeconds"].as_i64(),
            deadline
        );
        assert_eq!(job["spec"].get("activeDeadlineSeconds"), None);
    }
}

#[test]
fn kubernetes_keeps_a_finished_job_long_enough_for_its_end_to_be_read() {
    for (hosts, kept) in [
        (json!({}), 604_800),
        (json!(0), 604_800),
        (json!(86_400), 604_800),
        (json!(1_000_000), 1_000_000),
    ] {
        let more = if hosts.is_number() {
            json!({"ttlSecondsAfterFinished": hosts})
        } else {
            hosts
        };
        let job = Case::new("V2", more).json();
        assert_eq!(job["spec"]["ttlSecondsAfterFinished"], kept);
    }
}

#[test]
fn labels_of_the_host_are_on_the_job_alone_and_ours_stay() {
    let labels = json!({"kueue.x-k8s.io/queue-name": "gpus", "leaderboard.carla.org/run": "forged"});
    let job = Case::new("V2", json!({ "jobLabels": labels })).json();
    let of = |object: &Value| object["metadata"]["labels"].clone();
    assert_eq!(of(&job)["kueue.x-k8s.io/queue-name"], "gpus");
    assert_eq!(of(&job)["leaderboard.carla.org/run"], "4711");
    assert_eq!(of(&job["spec"]["template"])["kueue.x-k8s.io/queue-name"], Value::Null);
    // Its one writer is the program that suspends and resumes the Job.
    assert_eq!(job["spec"]["suspend"], Value::Null);
}
