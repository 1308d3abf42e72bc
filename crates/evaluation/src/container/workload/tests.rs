//! The containers of each mode: variables, mounts and flags.

use leaderboard_api::{Attempt, RunPlan};
use serde_json::{Value, json};

use super::*;
use crate::fixtures;

fn spec(port: Option<i32>) -> LeaderboardSpec {
    spec_with(&port.map_or_else(|| json!({}), |port| json!({"port": port})))
}

/// A Leaderboard with these fields of its evaluation.
fn spec_with(more: &Value) -> LeaderboardSpec {
    let mut evaluation =
        json!({"mode": "Interactive", "image": "evaluator", "command": ["python3"], "args": ["$(RESUME)"]});
    for (key, value) in more.as_object().unwrap() {
        evaluation[key] = value.clone();
    }
    let spec = json!({
        "evaluation": {"container": evaluation},
        "storage": {"s3": {"bucket": "results"}},
        "agent": {"command": ["./run"], "shmSize": "1Gi"},
        "tracks": [{"name": "test", "container": {"score": {"metric": "accuracy"}}}],
    });
    serde_json::from_value(spec).unwrap()
}

fn of_second_worker(spec: &LeaderboardSpec) -> Option<Workload> {
    of(spec, &fixtures::container_run().plan, 2)
}

fn of(spec: &LeaderboardSpec, plan: &RunPlan, worker: u16) -> Option<Workload> {
    let asked = Asked {
        spec,
        track: spec.tracks.first(),
        plan,
        attempt: Attempt(3),
        deadlines: spec.deadlines,
        resume: true,
        has_gpus: false,
    };
    workload(&asked, Pair::new(worker).unwrap())
}

fn value<'a>(role: &'a Role, name: &str) -> Option<&'a str> {
    let found = role.env.iter().find(|(known, _)| *known == name);
    found.map(|(_, value)| value.as_str())
}

#[test]
fn the_agent_finds_the_evaluator_of_its_own_worker_and_sees_nothing_else_of_it() {
    let Workload { host, agent } = of_second_worker(&spec(Some(5000))).unwrap();
    let agent = agent.unwrap();
    assert_eq!(host.flags[0], "--port=5100");
    assert_eq!(host.command, ["python3", "$$(RESUME)"]);
    for (name, of_both) in [
        ("WORKER", "2"),
        ("WORKERS", "2"),
        ("TRACK", "test"),
        ("PHASE", "7"),
        (ADDRESS, "127.0.0.1:5100"),
    ] {
        assert_eq!(
            (value(&host, name), value(&agent, name)),
            (Some(of_both), Some(of_both)),
            "{name}"
        );
    }
    for (name, of_host) in [("RESULTS", "/results"), ("ATTEMPT", "3")] {
        assert_eq!(
            (value(&host, name), value(&agent, name)),
            (Some(of_host), None),
            "{name}"
        );
    }
    let own = |folder: &str, path| Mount::Own {
        folder: folder.to_owned(),
        path,
    };
    assert_eq!(host.mounts, [own("evaluators/2", "/results")]);
    assert_eq!(agent.mounts, [own("agent/agent2", "/tmp/agent")]);
    assert_eq!((host.shm, agent.shm), (Some(64 << 20), Some(1 << 30)));
    let reserved = reserved(EvaluationMode::Interactive, &spec(Some(5000)));
    assert_eq!(reserved.env, ENV, "other names are the host's own");
    assert_eq!(reserved.folders, [AGENT, RESULTS, PARTS, SHM]);
}

/// Names of variables, and what is mounted where: a folder of `logs`, or a volume; `+` for one that can be written.
fn given(role: &Role) -> (Vec<&str>, Vec<String>) {
    let mounts = role.mounts.iter().map(|mount| match mount {
        Mount::Own { folder, path } => format!("{folder}+ {path}"),
        Mount::Read { folder, path } => format!("{folder} {path}"),
        Mount::Contents(volume) => format!("[{}] {}", volume.name, volume.read),
        Mount::OfNode { path, .. } => panic!("a folder of the node: {path}"),
    });
    (role.env.iter().map(|(name, _)| *name).collect(), mounts.collect())
}

const IMAGE: &str = r#"{"image": {"reference": "data:1"}}"#;
const OF_RUN: [&str; 2] = ["TRACK", "PHASE"];
const OF_WORKER: [&str; 4] = ["WORKER", "WORKERS", "TRACK", "PHASE"];

#[test]
fn each_mode_has_its_own_agents_and_no_agent_gets_labels_input_or_results() {
    let claim = json!({"persistentVolumeClaim": {"claimName": "data"}});
    let image: Value = serde_json::from_str(IMAGE).unwrap();
    let both = json!({"dataset": image, "labels": claim});
    let labels = json!({"labels": image});
    let shared = json!({"dataset": claim, "datasetForAgent": true});
    let kept = json!({"dataset": claim, "datasetForAgent": false});
    let own = ["agent/agent1+ /tmp/agent"];
    let left = ["agent/agent1+ /tmp/agent", "submission+ /submission"];
    let data = "[dataset] /dataset";
    let first = [&OF_RUN[..], &["SUBMISSION_PATH"]].concat();
    let cases = [
        ("Interactive", &both, Some((OF_WORKER.to_vec(), own.to_vec()))),
        (
            "Interactive",
            &shared,
            Some(([&OF_WORKER[..], &["DATASET"]].concat(), [&own[..], &[data]].concat())),
        ),
        (
            "Batch",
            &both,
            Some(([&first[..], &["DATASET"]].concat(), [&left[..], &[data]].concat())),
        ),
        ("Batch", &kept, Some((first.clone(), left.to_vec()))),
        ("Batch", &labels, Some((first, left.to_vec()))),
        ("Predictions", &both, None),
    ];
    for (mode, more, expected) in cases {
        let mut more = more.clone();
        more["mode"] = mode.into();
        let spec = spec_with(&more);
        let plan = fixtures::run_of_mode(spec.evaluation.container().unwrap().mode).plan;
        let of_worker = |worker| of(&spec, &plan, worker).unwrap().agent;
        let agent = of_worker(1);
        let found = agent.as_ref().map(given);
        let found = found.as_ref().map(|(env, mounts)| {
            let mounts: Vec<&str> = mounts.iter().map(String::as_str).collect();
            (env.clone(), mounts)
        });
        assert_eq!(found, expected, "{mode} {more}");
        assert_eq!(of_worker(2).is_some(), mode == "Interactive", "{mode}");
        let has = |flag: &str| agent.iter().flat_map(|agent| &agent.flags).any(|own| own == flag);
        let found = [has("--alone"), has("--leaves=/submission")];
        assert_eq!(found, [mode == "Batch"; 2], "{mode}");
    }
}

#[test]
fn an_evaluator_reads_what_is_submitted_and_the_data_and_writes_its_results_alone() {
    let image: Value = serde_json::from_str(IMAGE).unwrap();
    for (mode, input, data) in [
        ("Interactive", false, json!({})),
        ("Interactive", false, json!({"dataset": image, "labels": image})),
        ("Batch", true, json!({"dataset": image, "labels": image})),
        ("Batch", true, json!({"labels": image})),
        ("Predictions", true, json!({"dataset": image})),
    ] {
        let mut more = data.clone();
        more["mode"] = mode.into();
        let spec = spec_with(&more);
        let mode = spec.evaluation.container().unwrap().mode;
        let host = of(&spec, &fixtures::run_of_mode(mode).plan, 2).unwrap().host;
        let (mut env, mut mounts) = (
            [&OF_WORKER[..], &["RESULTS", "ATTEMPT"]].concat(),
            vec!["evaluators/2+ /results"],
        );
        if input {
            env.push("INPUT");
            mounts.push("input /input");
        }
        for (name, variable, mount) in [
            ("dataset", "DATASET", "[dataset] /dataset"),
            ("labels", "LABELS", "[labels] /labels"),
        ] {
            if data.get(name).is_some() {
                env.push(variable);
                mounts.push(mount);
            }
        }
        let found = given(&host);
        assert_eq!(
            (&found.0, found.1.join(", ")),
            (&env, mounts.join(", ")),
            "{mode:?} {data}"
        );
        assert_eq!(host.flags.contains(&"--alone".to_owned()), input, "{mode:?}");
        for (name, folder) in [("INPUT", "/input"), ("DATASET", "/dataset"), ("LABELS", "/labels")] {
            let expected = env.contains(&name).then_some(folder);
            assert_eq!(value(&host, name), expected, "{mode:?} {data}");
            let reserved = reserved(mode, &spec);
            let is_reserved = [reserved.env.contains(&name), reserved.folders.contains(&folder)];
            assert_eq!(is_reserved, [expected.is_some(); 2], "{mode:?} {data}: {name}");
        }
    }
}

#[test]
fn the_one_that_merges_reads_what_the_others_have_left_and_has_no_agent_in_any_mode() {
    for (mode, folder) in [
        (EvaluationMode::Interactive, None),
        (EvaluationMode::Batch, Some("input /input")),
        (EvaluationMode::Predictions, Some("input /input")),
    ] {
        let spec = spec_with(&json!({"merge": "Command", "mode": format!("{mode:?}")}));
        let plan = fixtures::merging_run(mode).plan;
        let Workload { host, agent } = of(&spec, &plan, 3).unwrap();
        assert_eq!(agent, None, "{mode:?}");
        let (env, mounts) = given(&host);
        let input = folder.map(|_| "INPUT");
        let expected: Vec<&str> = OF_WORKER
            .into_iter()
            .chain(["RESULTS", "ATTEMPT"])
            .chain(input)
            .collect();
        assert_eq!(env, [&expected[..], &["PARTS"]].concat(), "{mode:?}");
        let expected: Vec<&str> = ["evaluators/3+ /results"].into_iter().chain(folder).collect();
        assert_eq!(mounts, [&expected[..], &["evaluators /parts"]].concat(), "{mode:?}");
        for (name, expected) in [("WORKER", "merge"), ("WORKERS", "2"), ("PARTS", "/parts")] {
            assert_eq!(value(&host, name), Some(expected), "{mode:?}");
        }
        assert_eq!(host.flags[..2], ["--alone", "--after=/parts"], "{mode:?}");
        let others = of(&spec, &plan, 2).unwrap();
        assert_eq!(others.agent.is_some(), mode == EvaluationMode::Interactive);
        for role in [Some(others.host), others.agent].into_iter().flatten() {
            let (env, mounts) = given(&role);
            assert!(!env.contains(&"PARTS") && !mounts.contains(&"evaluators /parts".to_owned()));
            assert!(!role.flags.contains(&"--after=/parts".to_owned()));
        }
        // A submission keeps the merge of its plan.
        let merges_no_more = spec_with(&json!({"merge": "Mean", "mode": format!("{mode:?}")}));
        let reserved = reserved(mode, &merges_no_more);
        assert!(reserved.env.contains(&"PARTS") && reserved.folders.contains(&"/parts"));
    }
    let with_port = spec_with(&json!({"merge": "Command", "port": 5000}));
    let plan = fixtures::merging_run(EvaluationMode::Interactive).plan;
    let host = of(&with_port, &plan, 3).unwrap().host;
    assert_eq!(value(&host, ADDRESS), None);
    assert!(!host.flags.iter().any(|flag| flag.starts_with("--port")));
}

#[test]
fn a_submission_without_an_image_has_no_agent_to_run() {
    for (mode, has_workers) in [
        (EvaluationMode::Interactive, false),
        (EvaluationMode::Batch, false),
        (EvaluationMode::Predictions, true),
    ] {
        let mut plan = fixtures::run_of_mode(mode).plan;
        plan.image = None;
        assert_eq!(of(&spec(None), &plan, 1).is_some(), has_workers, "{mode:?}");
    }
}

#[test]
fn without_a_port_the_agent_gets_no_address() {
    let Workload { host, agent } = of_second_worker(&spec(None)).unwrap();
    assert!(!host.flags.iter().any(|flag| flag.starts_with("--port")));
    assert_eq!((value(&host, ADDRESS), value(&agent.unwrap(), ADDRESS)), (None, None));
}

#[test]
fn a_plan_of_another_kind_has_no_containers() {
    let carla = fixtures::run().plan;
    let spec = spec(None);
    let asked = Asked {
        spec: &spec,
        track: None,
        plan: &carla,
        attempt: Attempt(1),
        deadlines: spec.deadlines,
        resume: false,
        has_gpus: false,
    };
    assert_eq!(workload(&asked, Pair::new(1).unwrap()), None);
}
