//! A pair with nothing left to drive: its command is not started, and what it has left stays as it is.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on fails")]

mod support;

use std::fs;

use leaderboard_protocol::files::{Mark, StatusFile};
use leaderboard_protocol::verdict::What;
use support::{AGENT, Container, Pod, SIMULATOR, until_exists};

/// Two route runs, as many as the pair has.
const RUNS: &str = "--route-runs=2";
/// The file of an evaluator at its end, and of one that dies before its global record.
const ENDED: &str = r#"{"_checkpoint": {"global_record": {"index": -1}, "progress": [2, 2], "records": [{}, {}]}, "entry_status": "Finished"}"#;
const DIED: &str =
    r#"{"_checkpoint": {"global_record": {}, "progress": [2, 2], "records": [{}, {}]}, "entry_status": "Started"}"#;

/// An agent whose command, if it is started, leaves a trace and spoils its file.
fn agent(pod: &Pod, options: &[&str]) -> Container {
    let script = "touch ran; echo {} > $CHECKPOINT; exit 3";
    let script = format!("cd {}; {script}", pod.path("work").display());
    pod.agent_running(&["sh", "-c", &script], options)
}

fn has_run(pod: &Pod) -> bool {
    pod.path("work/ran").exists()
}

#[test]
fn a_pair_whose_routes_are_all_driven_ends_without_its_command() {
    for file in [ENDED, DIED] {
        let mut pod = Pod::new();
        pod.environment.push(("RESUME".to_owned(), "1".to_owned()));
        fs::write(pod.checkpoint(), file).unwrap();
        let mut agent = agent(&pod, &[RUNS]);
        assert_eq!(
            (agent.code(), agent.verdict().what),
            (0, What::Finished),
            "{}",
            agent.stderr()
        );
        assert_eq!(
            (pod.files(AGENT), has_run(&pod)),
            (vec!["agent-1.done".to_owned()], false)
        );
        assert_eq!(fs::read_to_string(pod.checkpoint()).unwrap(), file);
        // The agent's simulator only waits for the store, whenever it begins.
        let mut simulator = pod.simulator();
        pod.until(SIMULATOR, Mark::Done);
        pod.write(StatusFile::Stored);
        assert_eq!(
            (simulator.code(), pod.files(SIMULATOR)),
            (0, vec!["simulator-1.done".to_owned()])
        );
    }
}

#[test]
fn a_simulator_that_boots_for_a_pair_with_nothing_left_to_drive_is_stopped() {
    let pod = Pod::new();
    let up = pod.path("up");
    let script = format!("touch {}; exec sleep 1000", up.display());
    let mut simulator = pod.simulator_running(&["sh", "-c", &script], &[]);
    until_exists(&up);
    fs::write(pod.checkpoint(), ENDED).unwrap();
    assert_eq!(agent(&pod, &[RUNS]).code(), 0);
    pod.until(SIMULATOR, Mark::Done);
    pod.write(StatusFile::Stored);
    assert_eq!((simulator.code(), simulator.verdict().what), (0, What::Finished));
}

#[test]
fn a_checkpoint_that_lacks_a_route_of_the_pair_is_gone_on_with() {
    let crashed = DIED.replace("Started", "Crashed");
    let left = DIED.replace("[2, 2]", "[1, 2]");
    let of_another_plan = "--route-runs=3";
    let cases = [
        (ENDED, vec![of_another_plan]),
        (ENDED, vec![]),
        (crashed.as_str(), vec![RUNS]),
        (left.as_str(), vec![RUNS]),
        ("{}", vec![RUNS]),
    ];
    for (file, options) in cases {
        let pod = Pod::new();
        for mark in [Mark::Start(0), Mark::Done] {
            pod.write(StatusFile::Of(SIMULATOR, mark));
        }
        fs::write(pod.checkpoint(), file).unwrap();
        assert_eq!(
            (agent(&pod, &options).code(), has_run(&pod)),
            (1, true),
            "{file} {options:?}"
        );
    }
}

#[test]
fn an_evaluator_that_dies_between_its_last_route_and_its_global_record_is_done() {
    let pod = Pod::new();
    for mark in [Mark::Start(0), Mark::Done] {
        pod.write(StatusFile::Of(SIMULATOR, mark));
    }
    let script = format!("echo '{DIED}' > $CHECKPOINT; kill -9 $$");
    let mut agent = pod.agent_running(&["sh", "-c", &script], &[RUNS]);
    assert_eq!(
        (agent.code(), agent.verdict().signal),
        (0, Some(9)),
        "{}",
        agent.stderr()
    );
    assert!(pod.has(AGENT, Mark::Done) && !pod.has(AGENT, Mark::Crash(0)));
}

#[test]
fn an_agent_that_is_killed_after_its_end_is_done_when_it_is_started_again() {
    let pod = Pod::new();
    pod.write(StatusFile::Of(SIMULATOR, Mark::Start(0)));
    let kept = pod.status().join("agent-1/checkpoint.json");
    let (kept, torn) = (kept.display(), pod.path("work/torn"));
    let script = format!(
        "echo '{ENDED}' > $CHECKPOINT; until [ -s {kept} ]; do sleep 0.02; done; printf '{{' > $CHECKPOINT; touch {}; exec sleep 1000",
        torn.display()
    );
    let mut first = pod.agent_running(&["sh", "-c", &script], &[RUNS]);
    until_exists(&torn);
    first.kill_without_a_word();
    let mut second = agent(&pod, &[RUNS]);
    assert_eq!((second.code(), has_run(&pod)), (0, false), "{}", second.stderr());
    // The kill may fall into the copy of the torn file, and leaves its temporary file.
    let mut files = pod.files(AGENT);
    files.retain(|name| !name.starts_with('.'));
    assert_eq!(files, ["agent-1.done", "agent-1.start0"]);
    assert_eq!(fs::read_to_string(pod.checkpoint()).unwrap(), format!("{ENDED}\n"));
}
