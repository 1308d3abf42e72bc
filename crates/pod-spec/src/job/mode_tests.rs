//! The Pods of an evaluator's modes: which containers they have, in which order, and what each of them can reach.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::path::Path;

use leaderboard_api::Attempt;
use leaderboard_runner::args;
use serde_json::{Value, json};

use super::command_tests::{behind_runner, started};
use super::run_document;
use super::tests::{Case, container, containers, role};

const MODES: [&str; 3] = ["Interactive", "Batch", "Predictions"];
const GPU: &str = "nvidia.com/gpu";

/// Two workers of a mode with a dataset in an image and labels in a claim.
fn case(mode: &str, more: &Value) -> Case {
    case_with(json!({"mode": mode}), more)
}

#[allow(clippy::needless_pass_by_value, reason = "the cases read better")]
fn case_with(evaluation: Value, more: &Value) -> Case {
    let mut container = json!({
        "workers": 2,
        "dataset": {"image": {"reference": "registry.example/dataset:1", "path": "/files"}},
        "labels": {"persistentVolumeClaim": {"claimName": "answers"}},
    });
    for (key, value) in evaluation.as_object().unwrap() {
        container[key] = value.clone();
    }
    Case::container(container, more)
}

fn pod(job: &Value) -> &Value {
    &job["spec"]["template"]["spec"]
}

fn names<'a>(job: &'a Value, list: &str) -> Vec<&'a str> {
    let list = pod(job)[list].as_array().unwrap();
    list.iter()
        .map(|container| container["name"].as_str().unwrap())
        .collect()
}

/// What a container mounts, but for the runner, the files by which it resolves names and its own memory: `volume/folder`, with `+` if it can
/// write, and where.
fn mounts(container: &Value) -> Vec<String> {
    let all = container["volumeMounts"].as_array().unwrap().iter();
    let of_interest = all.filter(|mount| {
        let name = mount["name"].as_str().unwrap();
        (name != "tools" || mount["readOnly"] != true) && !name.starts_with("shm-")
    });
    let texts = of_interest.map(|mount| {
        let folder = mount["subPath"]
            .as_str()
            .map(|folder| format!("/{folder}"))
            .unwrap_or_default();
        let writes = if mount["readOnly"] == true { "" } else { "+" };
        let [name, path] = ["name", "mountPath"].map(|field| mount[field].as_str().unwrap());
        format!("{name}{folder}{writes} {path}")
    });
    texts.collect()
}

#[test]
fn the_kubelet_starts_each_container_when_it_may_begin() {
    for (mode, first, beside) in [
        (
            "Interactive",
            [].as_slice(),
            ["evaluator-1", "evaluator-2", "agent-1", "agent-2"].as_slice(),
        ),
        ("Batch", &["agent-1", "collect"], &["evaluator-1", "evaluator-2"]),
        ("Predictions", &[], &["evaluator-1", "evaluator-2"]),
    ] {
        let job = case(mode, &json!({})).json();
        let before = ["workspace", "dataset", "logcopy"];
        assert_eq!(names(&job, "initContainers"), [&before[..], first].concat(), "{mode}");
        assert_eq!(names(&job, "containers"), beside, "{mode}");
        for name in first {
            // As the Pod says: again after a failure, and not beside what follows.
            assert_eq!(container(&job, name).get("restartPolicy"), None, "{name}");
        }
    }
}

/// Labels, input and results are the evaluators' alone, and what an agent leaves is the agent's.
#[test]
fn each_container_mounts_its_own_and_no_more() {
    let status = "logs/containers-status /tmp/status";
    let own = |name: &str| format!("logs/containers-status/{name}+ /tmp/status/{name}");
    let results = |worker: u8| format!("logs/evaluators/{worker}+ /results");
    let (dataset, labels) = ("dataset /dataset", "labels /labels");
    for (mode, shared) in [
        ("Interactive", false),
        ("Interactive", true),
        ("Batch", true),
        ("Batch", false),
        ("Predictions", false),
    ] {
        let mut evaluation = json!({"mode": mode});
        if mode != "Predictions" {
            evaluation["datasetForAgent"] = shared.into();
        }
        let job = case_with(evaluation, &json!({"podIdentity": role()})).json();
        for container in containers(&job) {
            let name = container["name"].as_str().unwrap();
            let mut expected: Vec<String> = match name {
                "workspace" => vec!["logs+ /logs".into(), "tools+ /leaderboard-tools".into()],
                "logcopy" => vec!["logs+ /logs".into(), "podinfo /podinfo".into()],
                "collect" => vec!["logs+ /logs".into()],
                "dataset" => vec!["dataset+ /leaderboard-data".into()],
                _ => vec![status.into(), own(name)],
            };
            if ["workspace", "logcopy"].contains(&name) {
                expected.push("identity /var/run/secrets/leaderboard".into());
            }
            if let Some(worker) = name.strip_prefix("evaluator-") {
                expected.push(results(worker.parse().unwrap()));
                expected.extend((mode != "Interactive").then(|| "logs/input /input".to_owned()));
                expected.extend([dataset.to_owned(), labels.to_owned()]);
            }
            if let Some(worker) = name.strip_prefix("agent-") {
                expected.push(format!("logs/agent/agent{worker}+ /tmp/agent"));
                expected.extend((mode == "Batch").then(|| "logs/submission+ /submission".to_owned()));
                expected.extend(shared.then(|| dataset.to_owned()));
            }
            assert_eq!(mounts(container), expected, "{mode} {name}");
            let has_memory = name.starts_with("evaluator-") || name.starts_with("agent-");
            let memory = json!({"name": format!("shm-{name}"), "mountPath": "/dev/shm"});
            let all = container["volumeMounts"].as_array().unwrap();
            assert_eq!(all.contains(&memory), has_memory, "{mode} {name}");
        }
    }
}

#[test]
fn data_is_in_a_volume_that_an_image_fills_or_a_claim_that_nobody_writes() {
    for mode in MODES {
        let job = case(mode, &json!({})).json();
        let volumes = pod(&job)["volumes"].as_array().unwrap();
        for expected in [
            json!({"name": "dataset", "emptyDir": {}}),
            json!({"name": "labels", "persistentVolumeClaim": {"claimName": "answers", "readOnly": true}}),
        ] {
            assert!(volumes.contains(&expected), "{mode}: {volumes:?}");
        }
        let copies = container(&job, "dataset");
        assert_eq!(copies["image"], "registry.example/dataset:1");
        assert_eq!(copied(copies), ("/files".into(), "/leaderboard-data".into()), "{mode}");
    }
    let without = Case::container(json!({}), &json!({})).json();
    let volumes = pod(&without)["volumes"].as_array().unwrap();
    assert!(
        !volumes
            .iter()
            .any(|volume| volume["name"] == "dataset" || volume["name"] == "labels")
    );
    // The host's path is a path, and no variable.
    let image = json!({"image": {"reference": "d", "path": "/$(AWS_REGION)/$$"}});
    let job = case_with(json!({"mode": "Batch", "labels": image}), &json!({})).json();
    assert_eq!(copied(container(&job, "labels")).0, "/$(AWS_REGION)/$$");
}

/// Where the runner copies from and to, once Kubernetes has expanded its words.
fn copied(container: &Value) -> (String, String) {
    let (words, _) = started(container, &[]);
    assert_eq!(words[0], "/leaderboard-tools/leaderboard-runner");
    let args::Request::Copy(copied) = args::parse(words[1..].iter().map(OsString::from)).unwrap() else {
        panic!("{words:?} copies nothing");
    };
    let text = |path: &Path| path.to_str().unwrap().to_owned();
    (text(&copied.from), text(&copied.to))
}

#[test]
fn who_runs_beside_nobody_stands_behind_a_runner_that_waits_for_nobody() {
    for mode in MODES {
        let job = case(mode, &json!({"agent": {"command": ["/agent", "$(SUBMISSION_PATH)"]}})).json();
        for container in containers(&job) {
            let name = container["name"].as_str().unwrap();
            let (words, mut env) = started(container, &[]);
            if !(name.starts_with("evaluator-") || name.starts_with("agent-")) {
                continue;
            }
            let (runs, command) = behind_runner(&words, &mut env);
            assert_eq!(runs.member().to_string(), name);
            assert_eq!(runs.alone, mode != "Interactive", "{mode} {name}");
            if name == "agent-1" {
                // The runner expands it.
                assert_eq!(command, ["/agent", "$(SUBMISSION_PATH)"]);
            }
        }
    }
}

/// The variables of ours that a container has, with their values.
fn variables(container: &Value) -> BTreeMap<String, String> {
    let (_, env) = started(container, &[]);
    env.into_iter()
        .filter(|(name, _)| !name.starts_with("NVIDIA"))
        .collect()
}

fn pairs(all: &[(&str, &str)]) -> BTreeMap<String, String> {
    all.iter()
        .map(|(name, value)| ((*name).to_owned(), (*value).to_owned()))
        .collect()
}

#[test]
fn evaluators_and_the_agent_find_their_folders_by_variables() {
    let track = json!({"name": "test", "phase": 7, "container": {"score": {"metric": "accuracy"}}});
    let job = |mode: &str| {
        let mut case = case(mode, &json!({"tracks": [track]}));
        case.number.attempt = Attempt(2);
        case.json()
    };
    let evaluator = [
        ("WORKER", "2"),
        ("WORKERS", "2"),
        ("TRACK", "test"),
        ("PHASE", "7"),
        ("RESULTS", "/results"),
        ("ATTEMPT", "2"),
        ("DATASET", "/dataset"),
        ("LABELS", "/labels"),
    ];
    let (none, input): (&[_], &[_]) = (&[], &[("INPUT", "/input")]);
    for (mode, input) in [("Interactive", none), ("Batch", input), ("Predictions", input)] {
        let job = job(mode);
        let expected = pairs(&[&evaluator[..], input].concat());
        assert_eq!(variables(container(&job, "evaluator-2")), expected, "{mode}");
    }
    let agent = [
        ("TRACK", "test"),
        ("PHASE", "7"),
        ("SUBMISSION_PATH", "/submission"),
        ("DATASET", "/dataset"),
    ];
    assert_eq!(variables(container(&job("Batch"), "agent-1")), pairs(&agent));
}

/// It reads a stranger's files.
#[test]
fn what_collects_an_agents_files_knows_its_run_and_has_no_identity() {
    for identity in [role(), json!({"secretName": "writer"})] {
        let mut case = case("Batch", &json!({"podIdentity": identity}));
        case.own.region = Some("us-west-2".into());
        case.own.checksums = Some("when_required".into());
        let job = case.json();
        let collect = container(&job, "collect");
        assert_eq!(collect["command"], json!(["leaderboard-operator", "collect"]));
        let env = collect["env"]
            .as_array()
            .unwrap()
            .iter()
            .map(|variable| variable["name"].as_str().unwrap());
        assert_eq!(env.collect::<Vec<_>>(), ["NVIDIA_VISIBLE_DEVICES", "LEADERBOARD_RUN"]);
        assert!(!collect["env"].to_string().contains("valueFrom"));
        // It writes where `workspace` has made folders, and its files are as those of our others.
        for field in ["image", "securityContext"] {
            assert_eq!(collect[field], container(&job, "workspace")[field], "{field}");
        }
        let skipped = &job["spec"]["template"]["metadata"]["annotations"]["eks.amazonaws.com/skip-containers"];
        assert_eq!(skipped, "dataset,agent-1,collect,evaluator-1,evaluator-2");
    }
}

#[test]
fn the_pod_knows_the_submitted_file_and_the_bounds() {
    for mode in MODES {
        let case = case(mode, &json!({}));
        let run = run_document(&case.input());
        assert_eq!(run.input.is_some(), mode == "Predictions", "{mode}");
        assert_eq!(run.input, case.file);
        assert_eq!(run.plan.image.is_none(), mode == "Predictions", "{mode}");
        let bounds = run.plan.container().unwrap().input.clone();
        assert_eq!(bounds.is_some(), mode != "Interactive", "{mode}");
    }
}

/// `ephemeral-storage` of a container, as request and limit.
fn disk(container: &Value) -> [Option<&str>; 2] {
    ["requests", "limits"].map(|list| container["resources"][list]["ephemeral-storage"].as_str())
}

#[test]
fn volumes_have_room_for_what_is_submitted_and_an_agent_that_runs_first_for_its_own() {
    let gib = 1_u64 << 30;
    // 20 of results and 1 to spare; 2 of an agent's log; what is submitted, and its copy.
    for (mode, logs) in [
        ("Interactive", 20 + 1 + 2 * 2),
        ("Batch", 20 + 1 + 2 + 2 * 3),
        ("Predictions", 20 + 1 + 3),
    ] {
        let mut evaluation = json!({"mode": mode});
        if mode != "Interactive" {
            evaluation["input"] = json!({"maxBytes": "3Gi"});
        }
        let job = case_with(evaluation, &json!({})).json();
        let volumes = pod(&job)["volumes"].as_array().unwrap();
        let volume = volumes.iter().find(|volume| volume["name"] == "logs").unwrap();
        assert_eq!(volume["emptyDir"]["sizeLimit"], (logs * gib).to_string(), "{mode}");
        // And 10 for the dataset, which an image brings.
        let limit = ((logs + 10) * gib).to_string();
        assert_eq!(disk(container(&job, "logcopy")), [Some("1Gi"), Some(&*limit)], "{mode}");
        assert_eq!(
            disk(container(&job, "evaluator-2")),
            [Some("2Gi"), Some("10Gi")],
            "{mode}"
        );
        if mode != "Predictions" {
            assert_eq!(disk(container(&job, "agent-1")), [Some("2Gi"), Some("20Gi")], "{mode}");
        }
    }
    // A request alone is no limit, for the containers after it too.
    let agent = json!({"command": ["/agent"], "resources": {"requests": {"ephemeral-storage": "5Gi"}}});
    let job = case("Batch", &json!({"agent": agent})).json();
    let found = ["agent-1", "evaluator-1", "logcopy"].map(|name| disk(container(&job, name)));
    assert_eq!(found, [[Some("5Gi"), None], [Some("2Gi"), None], [Some("1Gi"), None]]);
}

#[test]
fn an_agent_that_runs_first_has_a_gpu_as_the_evaluators_after_it() {
    let claim = json!({"resourceClaimTemplateName": "t"});
    for (gpu, devices, requested, claims) in [
        (json!(null), Some("void"), None, Value::Null),
        (json!({"resourceName": GPU}), None, Some("1"), Value::Null),
        (
            json!({"mode": "NodeIndex", "resourceName": GPU}),
            Some("0"),
            Some("1"),
            Value::Null,
        ),
        (
            json!({"mode": "Claim", "claim": claim}),
            Some("void"),
            None,
            json!([{"name": "gpu-1"}]),
        ),
    ] {
        let job = case("Batch", &json!({"gpu": gpu})).json();
        for name in ["agent-1", "evaluator-1"] {
            let container = container(&job, name);
            let (words, env) = started(container, &[]);
            assert_eq!(
                env.get("NVIDIA_VISIBLE_DEVICES").map(String::as_str),
                devices,
                "{name} {gpu}"
            );
            assert_eq!(
                container["resources"]["limits"][GPU].as_str(),
                requested,
                "{name} {gpu}"
            );
            assert_eq!(container["resources"]["claims"], claims, "{name} {gpu}");
            let waits = words.iter().any(|word| word.contains("-gpu="));
            assert!(!waits, "nobody is beside it: {words:?}");
        }
        for name in ["dataset", "collect"] {
            let (_, env) = started(container(&job, name), &[]);
            assert_eq!(env["NVIDIA_VISIBLE_DEVICES"], "void", "{name} {gpu}");
        }
    }
    let limits = json!({"limits": {GPU: "1"}});
    let agent = json!({"command": ["/agent"], "resources": limits});
    for (case, expected) in [
        (
            case("Batch", &json!({"agent": agent})),
            Some("agent-1 requests nvidia.com/gpu"),
        ),
        (
            case_with(json!({"mode": "Batch", "resources": limits}), &json!({})),
            Some("evaluator-1 requests nvidia.com/gpu"),
        ),
        // No other container could be meant.
        (
            case_with(json!({"mode": "Predictions", "resources": limits}), &json!({})),
            None,
        ),
    ] {
        let found = super::unclear(&case.leaderboard.spec, &case.json()["spec"]["template"]);
        match expected {
            Some(begin) => assert!(found.as_ref().is_some_and(|why| why.starts_with(begin)), "{found:?}"),
            None => assert_eq!(found, None),
        }
    }
}

#[test]
fn the_one_that_merges_stands_beside_the_evaluators_without_an_agent_or_a_gpu() {
    let claim = json!({"resourceClaimTemplateName": "t"});
    let resources = json!({"limits": {GPU: "1", "cpu": "2"}, "requests": {GPU: 1}});
    for gpu in [
        json!(null),
        json!({"mode": "None"}),
        json!({"resourceName": GPU}),
        json!({"mode": "NodeIndex", "resourceName": GPU}),
        json!({"mode": "Claim", "claim": claim}),
    ] {
        for mode in MODES {
            let of = |merge: &str| {
                let evaluation = json!({"mode": mode, "merge": merge, "resources": resources});
                case_with(evaluation, &json!({"gpu": gpu}))
            };
            let (case, without) = (of("Command"), of("Mean"));
            let job = case.json();
            let mut expected = names(&without.json(), "containers").join(",");
            expected = expected.replace("evaluator-2", "evaluator-2,evaluator-3");
            assert_eq!(names(&job, "containers").join(","), expected, "{mode} {gpu}");
            let merger = container(&job, "evaluator-3");
            let (words, mut env) = started(merger, &[]);
            assert_eq!(env["NVIDIA_VISIBLE_DEVICES"], "void", "{mode} {gpu}");
            for list in ["limits", "requests"] {
                assert_eq!(merger["resources"][list].get(GPU), None, "{mode} {gpu}");
            }
            assert_eq!(merger["resources"]["limits"]["cpu"], "2", "{mode} {gpu}");
            assert_eq!(merger["resources"].get("claims"), None, "{mode} {gpu}");
            let (runs, _) = behind_runner(&words, &mut env);
            assert!(
                runs.alone && !words.iter().any(|word| word.contains("-gpu=")),
                "{words:?}"
            );
            let claims = |case: &Case| pod(&case.json())["resourceClaims"].clone();
            assert_eq!(claims(&case), claims(&without), "{mode} {gpu}");
            let counted =
                |case: &Case| super::gpus(&case.leaderboard.spec, case.leaderboard.spec.tracks.first(), &case.plan);
            assert_eq!(counted(&case), counted(&without), "{mode} {gpu}");
            let mounts = mounts(merger);
            for mount in ["logs/evaluators/3+ /results", "logs/evaluators /parts"] {
                assert!(mounts.contains(&mount.to_owned()), "{mode}: {mounts:?}");
            }
        }
    }
}

#[test]
fn an_overlay_and_the_hosts_settings_reach_an_agent_that_runs_first() {
    let check = json!({"name": "check", "image": "c"});
    let overlay = json!({"spec": {"initContainers": [
        {"name": "agent", "imagePullPolicy": "Always", "securityContext": {"privileged": true}}, check,
    ]}});
    let agent =
        json!({"command": ["/agent"], "env": [{"name": "MODEL", "value": "m"}], "securityContext": {"runAsUser": 7}});
    let job = case("Batch", &json!({"agent": agent, "podOverrides": overlay})).json();
    let before = ["workspace", "dataset", "logcopy", "check", "agent-1", "collect"];
    assert_eq!(names(&job, "initContainers"), before);
    let agent = container(&job, "agent-1");
    assert_eq!(agent["imagePullPolicy"], "Always");
    assert_eq!(started(agent, &[]).1["MODEL"], "m");
    let context = json!({
        "privileged": true, "runAsUser": 7, "capabilities": {"drop": ["ALL"]}, "seccompProfile": {"type": "RuntimeDefault"},
    });
    assert_eq!(agent["securityContext"], context);
}

#[test]
fn every_container_of_every_mode_is_confined() {
    for mode in MODES {
        let job = case(mode, &json!({})).json();
        for container in containers(&job) {
            let (name, context) = (&container["name"], &container["securityContext"]);
            assert_eq!(context["allowPrivilegeEscalation"], false, "{mode} {name}");
            assert_eq!(context["capabilities"], json!({"drop": ["ALL"]}), "{mode} {name}");
            assert_eq!(
                context["seccompProfile"],
                json!({"type": "RuntimeDefault"}),
                "{mode} {name}"
            );
            let is_own = ["workspace", "logcopy", "collect"].iter().any(|own| name == own);
            assert_eq!(context["readOnlyRootFilesystem"] == true, is_own, "{mode} {name}");
        }
    }
}

#[test]
fn the_net_of_restarts_is_wider_than_the_crashes_of_those_that_are_there() {
    // Three crashes and the first start of each container, and 20 to spare.
    for (mode, members) in [("Interactive", 4), ("Batch", 3), ("Predictions", 2)] {
        let job = case(mode, &json!({"retries": {"perWorker": 3}})).json();
        assert_eq!(job["spec"]["backoffLimit"], members * 4 + 20, "{mode}");
    }
}
