//! Evaluators and agents: images, commands, flags, variables and mounts of a worker. Pure.

use leaderboard_api::{ContainerEvaluation, ContainerPlan, PORT_STEP};
use leaderboard_contract::keys::{agent_folder, host_folder, host_log_name};
use leaderboard_protocol::files::Pair;

use super::HOST;
use crate::workload::{AGENT, Asked, HOST_LOG_LIMIT, Mount, Reserved, Role, Workload, literal, of_host, seconds};

/// Where an evaluator writes its result, and what it goes on with.
const RESULTS: &str = "/results";
/// Shared memory, which each container has for itself.
const SHM: &str = "/dev/shm";
const ADDRESS: &str = "EVALUATOR_ADDRESS";

/// They follow from the plan.
pub(super) const RESERVED: Reserved = Reserved {
    env: &[
        "WORKER", "WORKERS", "TRACK", "PHASE", ADDRESS, "RESULTS", "RESUME", "ATTEMPT",
    ],
    volumes: &[],
    folders: &[AGENT, RESULTS, SHM],
};

/// Settings of one worker, of this kind.
struct Known<'a> {
    asked: &'a Asked<'a>,
    spec: &'a ContainerEvaluation,
    plan: &'a ContainerPlan,
    worker: Pair,
}

/// The evaluator and the agent of a worker.
pub(super) fn workload(asked: &Asked<'_>, worker: Pair) -> Option<Workload> {
    let known = Known {
        asked,
        spec: asked.spec.evaluation.container()?,
        plan: asked.plan.container()?,
        worker,
    };
    Some(Workload {
        host: known.evaluator(),
        agent: Some(known.agent()?),
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
        let resume = if self.asked.resume { "1" } else { "" };
        let own = [
            ("RESULTS", RESULTS.to_owned()),
            ("RESUME", resume.to_owned()),
            ("ATTEMPT", self.asked.attempt.to_string()),
        ];
        Role {
            image: self.plan.image.to_string(),
            flags: self
                .port()
                .map(|port| format!("--port={port}"))
                .into_iter()
                .chain(flags)
                .collect(),
            command: literals(&self.spec.words()),
            env: self.variables().chain(own).collect(),
            mounts: vec![Mount::Own {
                folder: host_folder(HOST, self.worker),
                path: RESULTS,
            }],
            shm: Some(self.spec.shm_size.bytes()),
            removes: &[],
            draws: None,
        }
    }

    /// `None` without a command, which the API server refuses.
    fn agent(&self) -> Option<Role> {
        let (spec, deadlines) = (&self.asked.spec.agent, &self.asked.deadlines);
        let flags = vec![
            format!("--host={}", HOST.name()),
            format!("--work={AGENT}"),
            seconds("ready", deadlines.ready_seconds),
            seconds("idle", deadlines.idle_seconds),
            format!("--log-limit={}", spec.log_size_limit.bytes()),
        ];
        Some(Role {
            image: self.asked.plan.image.clone(),
            flags,
            command: literals(&of_host(spec.command.as_deref(), spec.args.as_deref())?),
            env: self.variables().collect(),
            mounts: vec![Mount::Own {
                folder: agent_folder(self.worker),
                path: AGENT,
            }],
            shm: Some(spec.shm_size.as_ref().unwrap_or(&self.spec.shm_size).bytes()),
            removes: &[],
            draws: None,
        })
    }

    fn port(&self) -> Option<i32> {
        let before = i32::try_from(self.worker.index()).unwrap_or(i32::MAX);
        let port = self.spec.port?;
        Some(port.saturating_add(before.saturating_mul(PORT_STEP)))
    }

    /// Variables of both containers.
    fn variables(&self) -> impl Iterator<Item = (&'static str, String)> {
        let plan = self.asked.plan;
        let phase = plan.phase.map(|phase| ("PHASE", phase.to_string()));
        let address = self.port().map(|port| (ADDRESS, format!("127.0.0.1:{port}")));
        [
            ("WORKER", self.worker.to_string()),
            ("WORKERS", self.plan.workers.to_string()),
            ("TRACK", plan.track.to_string()),
        ]
        .into_iter()
        .chain(phase)
        .chain(address)
    }
}

/// Words as they reach the runner, which expands them: RESUME is then what it is in this round.
fn literals(words: &[String]) -> Vec<String> {
    words.iter().map(|word| literal(word)).collect()
}

#[cfg(test)]
mod tests {
    use leaderboard_api::{Attempt, LeaderboardSpec};
    use serde_json::json;

    use super::*;
    use crate::fixtures;

    fn spec(port: Option<i32>) -> LeaderboardSpec {
        let mut evaluation =
            json!({"mode": "Interactive", "image": "evaluator", "command": ["python3"], "args": ["$(RESUME)"]});
        if let Some(port) = port {
            evaluation["port"] = port.into();
        }
        let spec = json!({
            "evaluation": {"container": evaluation},
            "storage": {"s3": {"bucket": "results"}},
            "agent": {"command": ["./run"], "shmSize": "1Gi"},
            "tracks": [{"name": "test", "container": {"score": {"metric": "accuracy"}}}],
        });
        serde_json::from_value(spec).unwrap()
    }

    fn of_second_worker(spec: &LeaderboardSpec, resume: bool) -> Option<Workload> {
        let plan = fixtures::container_run().plan;
        let asked = Asked {
            spec,
            track: spec.tracks.first(),
            plan: &plan,
            attempt: Attempt(3),
            deadlines: spec.deadlines,
            resume,
            has_gpus: false,
        };
        workload(&asked, Pair::new(2).unwrap())
    }

    fn value<'a>(role: &'a Role, name: &str) -> Option<&'a str> {
        let found = role.env.iter().find(|(known, _)| *known == name);
        found.map(|(_, value)| value.as_str())
    }

    #[test]
    fn the_agent_finds_the_evaluator_of_its_own_worker_and_sees_nothing_else_of_it() {
        let Workload { host, agent } = of_second_worker(&spec(Some(5000)), true).unwrap();
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
        for (name, of_host) in [("RESULTS", "/results"), ("RESUME", "1"), ("ATTEMPT", "3")] {
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
        let mut names = host.env.iter().chain(&agent.env).map(|(name, _)| name);
        assert!(names.all(|name| RESERVED.env.contains(name)));
    }

    #[test]
    fn without_a_port_the_agent_gets_no_address() {
        let Workload { host, agent } = of_second_worker(&spec(None), false).unwrap();
        assert!(!host.flags.iter().any(|flag| flag.starts_with("--port")));
        assert_eq!((value(&host, ADDRESS), value(&agent.unwrap(), ADDRESS)), (None, None));
        assert_eq!(value(&host, "RESUME"), Some(""));
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
