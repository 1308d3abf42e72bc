//! Words, folders and memory of a host's evaluators and of their agents.

use std::time::Duration;

use leaderboard_runner::args;
use serde_json::json;

use super::command_tests::{behind_runner, started};
use super::tests::{Case, container, containers};

#[test]
fn an_evaluator_and_its_agent_stand_behind_the_runner_with_their_own_words() {
    let evaluator = json!({"workers": 2, "port": 9000, "answerSeconds": 60, "args": ["--worker=$(WORKER)"]});
    let agent = json!({"command": ["/agent", "$(EVALUATOR_ADDRESS)"], "logSizeLimit": "2Mi"});
    let deadlines = json!({"readySeconds": 60, "idleSeconds": 30, "flushSeconds": 50, "cancelSeconds": 40});
    let job = Case::container(evaluator, &json!({"agent": agent, "deadlines": deadlines})).json();
    let seconds = Duration::from_secs;
    let (words, mut env) = started(container(&job, "evaluator-2"), &[]);
    let (evaluator, command) = behind_runner(&words, &mut env);
    assert_eq!(evaluator.member().to_string(), "evaluator-2");
    assert_eq!((evaluator.part, evaluator.port), (args::Part::Evaluator, Some(9100)));
    assert_eq!(
        [evaluator.answer, evaluator.flush, evaluator.cancel],
        [60, 50, 40].map(seconds)
    );
    assert_eq!(
        (&evaluator.results, &evaluator.after),
        (&Some("/results".into()), &None)
    );
    assert_eq!(evaluator.log, Some("/results/console.log".into()));
    assert_eq!((evaluator.gpu, evaluator.agent_gpu), (None, false));
    assert!(evaluator.unset.is_empty());
    assert_eq!(
        (evaluator.ready, evaluator.peer().to_string().as_str()),
        (seconds(60), "agent-2")
    );
    // The runner replaces it in each round.
    assert_eq!(command, ["python3", "/evaluate.py", "--worker=$(WORKER)"]);
    assert_eq!(env["RESULTS"], "/results");

    let (words, mut env) = started(container(&job, "agent-2"), &[]);
    let (agent, command) = behind_runner(&words, &mut env);
    assert_eq!(
        (agent.peer().to_string().as_str(), agent.part),
        ("evaluator-2", args::Part::Plain)
    );
    assert_eq!((&agent.leaves, agent.idle), (&None, Some(seconds(30))));
    assert_eq!(agent.log, Some("/tmp/agent/leaderboard.log".into()));
    assert!(!agent.agent_gpu);
    assert_eq!(agent.log_limit, 2_097_152);
    assert_eq!(command, ["/agent", "$(EVALUATOR_ADDRESS)"]);
}

/// Containers of one Pod share its sandbox's memory, and agents could read there what an evaluator keeps from them.
#[test]
fn an_evaluators_results_and_each_ones_shared_memory_are_its_own() {
    for (agent, own, agents) in [
        (json!({"command": ["/agent"]}), 256 << 20, 256 << 20),
        (json!({"command": ["/agent"], "shmSize": "1Gi"}), 256 << 20, 1_u64 << 30),
    ] {
        let job = Case::container(json!({"workers": 2, "shmSize": "256Mi"}), &json!({"agent": agent})).json();
        let mut memory = Vec::new();
        for container in containers(&job) {
            let name = container["name"].as_str().unwrap();
            let mounts = container["volumeMounts"].as_array().unwrap();
            let folders = mounts.iter().filter_map(|mount| mount["subPath"].as_str());
            let folders: Vec<&str> = folders.filter(|folder| folder.starts_with("evaluators")).collect();
            let number = name.strip_prefix("evaluator-");
            let folder = number.map(|number| format!("evaluators/{number}"));
            assert_eq!(folders, folder.iter().collect::<Vec<_>>(), "{name}");
            let of_memory = mounts.iter().filter(|mount| mount["mountPath"] == "/dev/shm");
            memory.extend(of_memory.map(|mount| (name.to_owned(), mount["name"].clone())));
            let has_all = mounts
                .iter()
                .any(|mount| mount["name"] == "logs" && mount["subPath"].is_null());
            assert_eq!(has_all, ["workspace", "logcopy"].contains(&name), "{name}");
        }
        let members = ["evaluator-1", "evaluator-2", "agent-1", "agent-2"];
        assert_eq!(
            memory,
            members.map(|name| (name.to_owned(), json!(format!("shm-{name}"))))
        );
        let volumes = job["spec"]["template"]["spec"]["volumes"].as_array().unwrap();
        for (name, size) in [("shm-evaluator-2", own), ("shm-agent-1", agents)] {
            let empty_dir = json!({"medium": "Memory", "sizeLimit": size.to_string()});
            assert!(
                volumes.contains(&json!({"name": name, "emptyDir": empty_dir})),
                "{name}: {volumes:?}"
            );
        }
    }
}
