//! Evaluators and agents: images, commands, flags, variables and mounts of a worker, mode by mode. Pure.

use leaderboard_api::{Agents, ContainerEvaluation, ContainerPlan, EvaluationMode, LeaderboardSpec, PORT_STEP, names};
use leaderboard_contract::keys::{INPUT, SUBMISSION_FOLDER, agent_folder, host_folder, host_log_name};
use leaderboard_protocol::files::Pair;

use super::HOST;
use crate::workload::{
    AGENT, Asked, ContentsVolume, Data, HOST_LOG_LIMIT, Mount, Reserved, Role, Workload, literal, of_host, seconds,
};

/// Where an evaluator writes its result, and what it goes on with.
const RESULTS: &str = "/results";
/// Where an evaluator reads the files of a submission.
const INPUTS: &str = "/input";
/// Where an agent that runs first leaves them.
const SUBMISSION: &str = "/submission";
/// Shared memory, which each container has for itself.
const SHM: &str = "/dev/shm";
const DATASET: ContentsVolume = ContentsVolume {
    name: names::CONTAINER_DATASET,
    written: "/leaderboard-data",
    read: "/dataset",
};
const LABELS: ContentsVolume = ContentsVolume {
    name: names::CONTAINER_LABELS,
    written: "/leaderboard-data",
    read: "/labels",
};
const ADDRESS: &str = "EVALUATOR_ADDRESS";
const INPUT_PATH: &str = "INPUT";
/// EvalAI's own name for it.
const SUBMISSION_PATH: &str = "SUBMISSION_PATH";
/// They follow from the plan, in every mode.
const ENV: [&str; 8] = [
    "WORKER", "WORKERS", "TRACK", "PHASE", ADDRESS, "RESULTS", "RESUME", "ATTEMPT",
];

/// What a host may not give another meaning: names of what the Pods of this Leaderboard have, and no others.
pub(super) fn reserved(mode: EvaluationMode, spec: &LeaderboardSpec) -> Reserved {
    let data = data(spec);
    let input = mode.has_input().then_some((INPUT_PATH, INPUTS));
    let submission = (mode == EvaluationMode::Batch).then_some((SUBMISSION_PATH, SUBMISSION));
    let of_data = data.iter().map(|data| (data.variable, data.volume.read));
    let (env, folders): (Vec<_>, Vec<_>) = input.into_iter().chain(submission).chain(of_data).unzip();
    Reserved {
        env: ENV.into_iter().chain(env).collect(),
        volumes: &[],
        folders: [AGENT, RESULTS, SHM].into_iter().chain(folders).collect(),
    }
}

/// The dataset and the labels, as far as the Leaderboard has them.
pub(super) fn data(spec: &LeaderboardSpec) -> Vec<Data<'_>> {
    let Some(own) = spec.evaluation.container() else {
        return Vec::new();
    };
    [(DATASET, "DATASET", &own.dataset), (LABELS, "LABELS", &own.labels)]
        .into_iter()
        .filter_map(|(volume, variable, source)| {
            let source = source.as_ref()?;
            Some(Data {
                volume,
                variable,
                source,
            })
        })
        .collect()
}

/// Settings of one worker, of this kind.
struct Known<'a> {
    asked: &'a Asked<'a>,
    spec: &'a ContainerEvaluation,
    plan: &'a ContainerPlan,
    worker: Pair,
}

/// The evaluator of a worker, and its agent if it has one. The only agent of the mode Batch is the first worker's.
pub(super) fn workload(asked: &Asked<'_>, worker: Pair) -> Option<Workload> {
    let known = Known {
        asked,
        spec: asked.spec.evaluation.container()?,
        plan: asked.plan.container()?,
        worker,
    };
    let has_agent = match known.plan.mode.agents() {
        Agents::Beside => true,
        Agents::First => worker.index() == 0,
        Agents::Absent => false,
    };
    Some(Workload {
        host: known.evaluator(),
        agent: if has_agent { Some(known.agent()?) } else { None },
    })
}

impl Known<'_> {
    fn evaluator(&self) -> Role {
        let deadlines = &self.asked.deadlines;
        let flags = [
            format!("--results={RESULTS}"),
            seconds("answer", self.spec.answer_seconds),
            seconds("ready", deadlines.ready_seconds),
            seconds("flush", deadlines.flush_seconds),
            seconds("cancel", deadlines.cancel_seconds),
            format!("--log={RESULTS}/{}", host_log_name(HOST, self.worker)),
            format!("--log-limit={HOST_LOG_LIMIT}"),
        ];
        let port = self.port().map(|port| format!("--port={port}"));
        let own = [
            ("RESULTS", RESULTS.to_owned()),
            ("ATTEMPT", self.asked.attempt.to_string()),
        ];
        let results = Mount::Own {
            folder: host_folder(HOST, self.worker),
            path: RESULTS,
        };
        let input = self.plan.mode.has_input().then_some((INPUT_PATH, INPUTS.to_owned()));
        let inputs = input.is_some().then(|| Mount::Read {
            folder: INPUT.trim_end_matches('/'),
            path: INPUTS,
        });
        let data = data(self.asked.spec);
        Role {
            image: self.plan.image.to_string(),
            flags: self.alone().into_iter().chain(port).chain(flags).collect(),
            command: literals(&self.spec.words()),
            env: self
                .of_worker()
                .chain(own)
                .chain(input)
                .chain(data.iter().map(folder))
                .collect(),
            mounts: [results]
                .into_iter()
                .chain(inputs)
                .chain(data.iter().map(|data| Mount::Contents(data.volume)))
                .collect(),
            shm: Some(self.spec.shm_size.bytes()),
            removes: &[],
            draws: None,
        }
    }

    /// `None` without a command, which the API server refuses, and for a submission without an image.
    fn agent(&self) -> Option<Role> {
        let (spec, deadlines) = (&self.asked.spec.agent, &self.asked.deadlines);
        let flags = [
            format!("--work={AGENT}"),
            seconds("ready", deadlines.ready_seconds),
            seconds("idle", deadlines.idle_seconds),
            format!("--log-limit={}", spec.log_size_limit.bytes()),
        ];
        let host = format!("--host={}", HOST.name());
        let work = Mount::Own {
            folder: agent_folder(self.worker),
            path: AGENT,
        };
        let is_first = self.plan.mode == EvaluationMode::Batch;
        let submission = is_first.then(|| Mount::Own {
            folder: SUBMISSION_FOLDER.to_owned(),
            path: SUBMISSION,
        });
        let leaves = is_first.then(|| format!("--leaves={SUBMISSION}"));
        let mut env: Vec<_> = if is_first {
            self.of_run()
                .chain([(SUBMISSION_PATH, SUBMISSION.to_owned())])
                .collect()
        } else {
            self.of_worker().collect()
        };
        let is_shared = |data: &Data<'_>| data.volume == DATASET && self.spec.agent_has_dataset();
        let shared: Vec<Data<'_>> = data(self.asked.spec).into_iter().filter(is_shared).collect();
        env.extend(shared.iter().map(folder));
        let shared = shared.into_iter().map(|data| Mount::Contents(data.volume));
        Some(Role {
            image: self.asked.plan.image.clone()?,
            flags: [host]
                .into_iter()
                .chain(self.alone())
                .chain(leaves)
                .chain(flags)
                .collect(),
            command: literals(&of_host(spec.command.as_deref(), spec.args.as_deref())?),
            env,
            mounts: [work].into_iter().chain(submission).chain(shared).collect(),
            shm: Some(spec.shm_size.as_ref().unwrap_or(&self.spec.shm_size).bytes()),
            removes: &[],
            draws: None,
        })
    }

    /// The flag of a container that runs beside none of the other side.
    fn alone(&self) -> Option<String> {
        self.plan.mode.has_input().then(|| "--alone".to_owned())
    }

    fn port(&self) -> Option<i32> {
        let before = i32::try_from(self.worker.index()).unwrap_or(i32::MAX);
        let port = self.spec.port?;
        Some(port.saturating_add(before.saturating_mul(PORT_STEP)))
    }

    /// Variables of a container that shares the work with others.
    fn of_worker(&self) -> impl Iterator<Item = (&'static str, String)> {
        let address = self.port().map(|port| (ADDRESS, format!("127.0.0.1:{port}")));
        [
            ("WORKER", self.worker.to_string()),
            ("WORKERS", self.plan.workers.to_string()),
        ]
        .into_iter()
        .chain(self.of_run())
        .chain(address)
    }

    /// Variables of every container.
    fn of_run(&self) -> impl Iterator<Item = (&'static str, String)> {
        let plan = self.asked.plan;
        let phase = plan.phase.map(|phase| ("PHASE", phase.to_string()));
        [("TRACK", plan.track.to_string())].into_iter().chain(phase)
    }
}

/// The variable with the folder of data.
fn folder(data: &Data<'_>) -> (&'static str, String) {
    (data.variable, data.volume.read.to_owned())
}

/// Words as they reach the runner, which expands them: it alone knows RESUME, which is of this round.
fn literals(words: &[String]) -> Vec<String> {
    words.iter().map(|word| literal(word)).collect()
}

#[cfg(test)]
mod tests {
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
        assert_eq!(reserved.folders, [AGENT, RESULTS, SHM]);
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
}
