//! Evaluators and agents: images, commands, flags, variables and mounts of a worker, mode by mode. Pure.

use leaderboard_api::{Agents, ContainerEvaluation, ContainerPlan, EvaluationMode, LeaderboardSpec, PORT_STEP, names};
use leaderboard_contract::keys::{EVALUATORS, INPUT, SUBMISSION_FOLDER, agent_folder, host_folder, host_log_name};
use leaderboard_protocol::files::Pair;

use super::HOST;
use crate::workload::{
    AGENT, Asked, ContentsVolume, Data, HOST_LOG_LIMIT, Mount, Reserved, Role, Workload, literal, of_host, seconds,
};

/// Where an evaluator writes its result, and what it goes on with.
const RESULTS: &str = "/results";
/// Where an evaluator reads the files of a submission.
const INPUTS: &str = "/input";
/// Where the one that merges reads what the others have left.
const PARTS: &str = "/parts";
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
const PARTS_PATH: &str = "PARTS";
/// The variable WORKER of the one that merges.
const MERGE: &str = "merge";
/// EvalAI's own name for it.
const SUBMISSION_PATH: &str = "SUBMISSION_PATH";
/// They follow from the plan, in every mode. A plan keeps its merge when that of the Leaderboard changes.
const ENV: [&str; 9] = [
    "WORKER", "WORKERS", "TRACK", "PHASE", ADDRESS, "RESULTS", "RESUME", "ATTEMPT", PARTS_PATH,
];

/// Names that a host may not give another meaning: of what the Pods of this Leaderboard can have, and no others.
pub(super) fn reserved(mode: EvaluationMode, spec: &LeaderboardSpec) -> Reserved {
    let data = data(spec);
    let input = mode.has_input().then_some((INPUT_PATH, INPUTS));
    let submission = (mode == EvaluationMode::Batch).then_some((SUBMISSION_PATH, SUBMISSION));
    let of_data = data.iter().map(|data| (data.variable, data.volume.read));
    let all = [input, submission].into_iter().flatten();
    let (env, folders): (Vec<_>, Vec<_>) = all.chain(of_data).unzip();
    Reserved {
        env: ENV.into_iter().chain(env).collect(),
        volumes: &[],
        folders: [AGENT, RESULTS, PARTS, SHM].into_iter().chain(folders).collect(),
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

/// The evaluator of a worker, and its agent if it has one.
pub(super) fn workload(asked: &Asked<'_>, worker: Pair) -> Option<Workload> {
    let known = Known {
        asked,
        spec: asked.spec.evaluation.container()?,
        plan: asked.plan.container()?,
        worker,
    };
    let has_agent = asked.plan.has_agent(worker.get().into());
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
        let (reads, data) = (self.reads(), data(self.asked.spec));
        let after = self.merges().then(|| format!("--after={PARTS}"));
        Role {
            image: self.plan.image.to_string(),
            flags: self.alone().into_iter().chain(after).chain(port).chain(flags).collect(),
            command: literals(&self.spec.words()),
            env: self
                .of_worker()
                .chain(own)
                .chain(reads.iter().map(|&(variable, _, path)| (variable, path.to_owned())))
                .chain(data.iter().map(folder))
                .collect(),
            mounts: [results]
                .into_iter()
                .chain(reads.iter().map(|&(_, folder, path)| Mount::Read { folder, path }))
                .chain(data.iter().map(|data| Mount::Contents(data.volume)))
                .collect(),
            shm: Some(self.spec.shm_size.bytes()),
            removes: &[],
            draws: None,
        }
    }

    /// Folders of `logs` that it reads, each with its variable, and its place in the container.
    fn reads(&self) -> Vec<(&'static str, &'static str, &'static str)> {
        let input = self.plan.mode.has_input().then_some((INPUT_PATH, INPUT, INPUTS));
        let parts = self.merges().then_some((PARTS_PATH, EVALUATORS, PARTS));
        let all = input.into_iter().chain(parts);
        all.map(|(variable, folder, path)| (variable, folder.trim_end_matches('/'), path))
            .collect()
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
        let agents = self.asked.plan.agents_of(self.worker.get().into());
        (agents != Agents::Beside).then(|| "--alone".to_owned())
    }

    /// True for the worker that merges the results of the others.
    fn merges(&self) -> bool {
        self.plan.merger() == Some(self.worker.get().into())
    }

    /// No agent talks to the one that merges.
    fn port(&self) -> Option<i32> {
        if self.merges() {
            return None;
        }
        let before = i32::try_from(self.worker.index()).unwrap_or(i32::MAX);
        let port = self.spec.port?;
        Some(port.saturating_add(before.saturating_mul(PORT_STEP)))
    }

    /// Variables of a container that shares the work with others.
    fn of_worker(&self) -> impl Iterator<Item = (&'static str, String)> {
        let address = self.port().map(|port| (ADDRESS, format!("127.0.0.1:{port}")));
        let worker = if self.merges() {
            MERGE.to_owned()
        } else {
            self.worker.to_string()
        };
        [("WORKER", worker), ("WORKERS", self.plan.workers.to_string())]
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
mod tests;
