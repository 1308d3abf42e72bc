//! Both containers of a pair, as real processes: how they run to the end, crash, meet again and are stopped.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on fails")]

mod support;

use std::fs;
use std::net::TcpStream;
use std::time::{Duration, Instant};

use leaderboard_protocol::files::{MAX_ROUNDS, Mark, StatusFile};
use leaderboard_protocol::verdict::What;
use nix::sys::signal::Signal;
use support::{AGENT, COMPLETE, PARTIAL, Pod, SIMULATOR};

const MOMENT: Duration = Duration::from_millis(300);

/// An agent that waits for the file `go` in its work folder and then has complete results. It prints what RESUME is.
fn patient_agent(pod: &Pod) -> String {
    let (said, go) = (pod.path("work/said"), pod.path("work/go"));
    let (said, go) = (said.display(), go.display());
    format!(
        "echo RESUME=[$RESUME]; touch {said}; until [ -e {go} ]; do sleep 0.02; done; echo '{COMPLETE}' > $CHECKPOINT"
    )
}

fn go(pod: &Pod) {
    fs::write(pod.path("work/go"), "").unwrap();
}

fn runs_to_its_end(pod: &Pod) {
    let mut agent = pod.agent(&format!("echo '{COMPLETE}' > $CHECKPOINT"));
    let mut simulator = pod.simulator();
    pod.until(SIMULATOR, Mark::Done);
    assert_eq!(agent.code(), 0, "{}", agent.stderr());
    assert!(
        simulator.stays(MOMENT),
        "it holds its exit until the results are stored"
    );
    let stored = Instant::now();
    pod.write(StatusFile::Stored);
    assert_eq!(simulator.code(), 0);
    println!("logcopy.done -> simulator's exit: {:?}", stored.elapsed());

    assert!(
        TcpStream::connect(("127.0.0.1", pod.port)).is_err(),
        "the server is gone"
    );
    assert_eq!(pod.files(SIMULATOR), ["simulator-1.done", "simulator-1.start0"]);
    assert_eq!(pod.files(AGENT), ["agent-1.done", "agent-1.start0"]);
    assert_eq!(simulator.verdict().what, What::Finished);
    assert_eq!(
        (agent.verdict().what, agent.verdict().exit_code),
        (What::Exited, Some(0))
    );
    let started = StatusFile::Of(SIMULATOR, Mark::Start(0));
    pod.print_reaction(
        "simulator's start -> agent's",
        started,
        StatusFile::Of(AGENT, Mark::Start(0)),
    );
    let done = StatusFile::Of(AGENT, Mark::Done);
    pod.print_reaction(
        "agent's done -> simulator's",
        done,
        StatusFile::Of(SIMULATOR, Mark::Done),
    );
}

#[test]
fn a_pair_runs_to_its_end_and_the_simulator_holds_until_the_results_are_stored() {
    runs_to_its_end(&Pod::new());
}

#[test]
fn a_pair_runs_to_its_end_without_inotify() {
    let mut pod = Pod::new();
    pod.options.push("--inotify=false".to_owned());
    runs_to_its_end(&pod);
}

#[test]
fn a_hold_ends_by_itself_after_its_limit() {
    let pod = Pod::new();
    pod.write(StatusFile::Of(SIMULATOR, Mark::Done));
    let mut simulator = pod.simulator_running(&["false"], &["--flush-seconds=1"]);
    assert_eq!(simulator.code(), 0);
    assert_eq!(pod.files(SIMULATOR), ["simulator-1.done"]);
}

#[test]
fn what_a_server_prints_is_kept_over_its_rounds() {
    let pod = Pod::new();
    let console = pod.path("console.log");
    let log = format!("--log={}", console.display());
    let server = ["sh", "-c", "echo up; echo broken >&2; exit 3"];
    for _ in 0..2 {
        let mut simulator = pod.simulator_running(&server, &[&log, "--peer-seconds=0"]);
        assert_eq!(simulator.code(), 1);
    }
    assert_eq!(std::fs::read_to_string(console).unwrap(), "up\nbroken\nup\nbroken\n");
}

#[test]
fn a_server_that_dies_brings_its_agent_down_and_the_next_round_resumes() {
    let pod = Pod::new();
    let (mut simulator, mut agent) = (pod.simulator(), pod.agent(&patient_agent(&pod)));
    support::until_exists(&pod.path("work/said"));
    for server in simulator.children() {
        nix::sys::signal::kill(server, Signal::SIGKILL).unwrap();
    }
    assert_eq!((simulator.code(), agent.code()), (1, 1));
    assert_eq!(
        (simulator.verdict().what, simulator.verdict().signal),
        (What::Killed, Some(9))
    );
    assert_eq!(agent.verdict().what, What::PeerCrashed);
    assert_eq!([simulator.verdict().round, agent.verdict().round], [Some(0); 2]);
    let crash = StatusFile::Of(SIMULATOR, Mark::Crash(0));
    pod.print_reaction(
        "simulator's crash -> agent's",
        crash,
        StatusFile::Of(AGENT, Mark::Crash(0)),
    );

    let (mut simulator, mut agent) = (pod.simulator(), pod.agent(&patient_agent(&pod)));
    pod.until(AGENT, Mark::Start(1));
    go(&pod);
    assert_eq!(agent.code(), 0);
    pod.write(StatusFile::Stored);
    assert_eq!(simulator.code(), 0);
    assert_eq!([simulator.verdict().round, agent.verdict().round], [Some(1); 2]);
    let expected = ["agent-1.crash0", "agent-1.done", "agent-1.start0", "agent-1.start1"];
    assert_eq!(pod.files(AGENT), expected);
    let log = fs::read_to_string(pod.log()).unwrap();
    assert_eq!(log, "RESUME=[]\nRESUME=[1]\n");
}

#[test]
fn an_agent_that_fails_brings_its_server_down() {
    let pod = Pod::new();
    let (mut simulator, mut agent) = (
        pod.simulator(),
        pod.agent(&format!("echo '{PARTIAL}' > $CHECKPOINT; exit 3")),
    );
    assert_eq!((simulator.code(), agent.code()), (1, 1));
    assert_eq!(simulator.verdict().what, What::PeerCrashed);
    let verdict = agent.verdict();
    assert_eq!((verdict.what, verdict.exit_code), (What::Exited, Some(3)));
    assert_eq!(
        verdict.why,
        "the command exited with code 3; its results are partial (no global record)"
    );
    assert_eq!(pod.files(SIMULATOR), ["simulator-1.crash0", "simulator-1.start0"]);
    assert_eq!(pod.files(AGENT), ["agent-1.crash0", "agent-1.start0"]);
}

#[test]
fn an_agents_runner_killed_without_a_word_counts_as_a_crash_and_resumes() {
    let pod = Pod::new();
    let (mut simulator, mut agent) = (pod.simulator(), pod.agent(&patient_agent(&pod)));
    pod.until(AGENT, Mark::Start(0));
    agent.kill_without_a_word();
    assert_eq!(agent.verdict().what, What::SilentDeath);
    assert!(simulator.stays(MOMENT), "nobody has said anything yet");

    let mut agent = pod.agent(&patient_agent(&pod));
    assert_eq!(simulator.code(), 1);
    assert_eq!(simulator.verdict().what, What::PeerCrashed);
    let mut simulator = pod.simulator();
    pod.until(AGENT, Mark::Start(1));
    go(&pod);
    assert_eq!(agent.code(), 0);
    pod.write(StatusFile::Stored);
    assert_eq!(simulator.code(), 0);
    assert!(fs::read_to_string(pod.log()).unwrap().ends_with("RESUME=[1]\n"));
}

#[test]
fn a_simulators_runner_killed_without_a_word_counts_as_a_crash() {
    let pod = Pod::new();
    let (mut simulator, mut agent) = (pod.simulator(), pod.agent(&patient_agent(&pod)));
    pod.until(AGENT, Mark::Start(0));
    simulator.kill_without_a_word();
    let mut simulator = pod.simulator();
    assert_eq!(agent.code(), 1);
    assert_eq!(agent.verdict().what, What::PeerCrashed);
    go(&pod);
    let mut agent = pod.agent(&patient_agent(&pod));
    assert_eq!(agent.code(), 0);
    pod.write(StatusFile::Stored);
    assert_eq!(simulator.code(), 0);
    assert_eq!(pod.files(SIMULATOR).len(), 4, "{:?}", pod.files(SIMULATOR));
}

#[test]
fn a_server_that_dies_before_it_answers_does_not_cost_the_agent_its_container() {
    let pod = Pod::new();
    let mut agent = pod.agent(&format!("echo '{COMPLETE}' > $CHECKPOINT"));
    let mut simulator = pod.simulator_running(&["sh", "-c", "exit 5"], &[]);
    assert_eq!(simulator.code(), 1);
    assert_eq!(simulator.verdict().exit_code, Some(5));
    let mut simulator = pod.simulator();
    assert_eq!(agent.code(), 0);
    pod.write(StatusFile::Stored);
    assert_eq!(simulator.code(), 0);
    assert_eq!(pod.files(AGENT), ["agent-1.crash0", "agent-1.done", "agent-1.start1"]);
    assert_eq!(
        pod.files(SIMULATOR),
        ["simulator-1.crash0", "simulator-1.done", "simulator-1.start1"]
    );
}

#[test]
fn a_server_that_does_not_answer_in_time_is_a_crash() {
    let pod = Pod::new();
    let options = ["--ready-seconds=1", "--peer-seconds=0"];
    let mut simulator = pod.simulator_running(&["sleep", "1000"], &options);
    assert_eq!(simulator.code(), 1);
    assert_eq!(simulator.verdict().what, What::NotReady);
    assert_eq!(pod.files(SIMULATOR), ["simulator-1.crash0"]);
}

#[test]
fn an_agent_whose_simulator_does_not_come_is_a_crash() {
    let pod = Pod::new();
    let mut agent = pod.agent_running(&["true"], &["--ready-seconds=1", "--peer-seconds=0"]);
    assert_eq!(agent.code(), 1);
    assert_eq!(agent.verdict().what, What::NotReady);
    assert_eq!(pod.files(AGENT), ["agent-1.crash0"]);
}

#[test]
fn a_side_waits_for_the_end_of_the_other_before_it_exits() {
    let pod = Pod::new();
    let mut simulator = pod.simulator_running(&["false"], &[]);
    pod.until(SIMULATOR, Mark::Crash(0));
    assert!(simulator.stays(MOMENT));
    pod.write(StatusFile::Of(AGENT, Mark::Crash(0)));
    assert_eq!(simulator.code(), 1);
}

#[test]
fn a_simulator_whose_agent_turns_out_to_be_done_is_done_too() {
    let pod = Pod::new();
    let mut simulator = pod.simulator_running(&["false"], &[]);
    pod.until(SIMULATOR, Mark::Crash(0));
    pod.write(StatusFile::Of(AGENT, Mark::Done));
    pod.until(SIMULATOR, Mark::Done);
    assert!(simulator.stays(MOMENT));
    pod.write(StatusFile::Stored);
    assert_eq!(simulator.code(), 0);
}

#[test]
fn a_cancel_stops_both_without_a_file_and_the_simulator_holds() {
    let pod = Pod::new();
    let (mut simulator, mut agent) = (pod.simulator(), pod.agent(&patient_agent(&pod)));
    pod.until(AGENT, Mark::Start(0));
    let cancelled = Instant::now();
    pod.write(StatusFile::Cancel);
    assert_eq!(agent.code(), 0);
    println!("simulation.cancel -> agent's exit: {:?}", cancelled.elapsed());
    assert!(simulator.stays(MOMENT));
    pod.write(StatusFile::Stored);
    assert_eq!(simulator.code(), 0);
    for container in [&simulator, &agent] {
        assert_eq!(container.verdict().what, What::Cancelled);
    }
    assert_eq!(pod.files(SIMULATOR), ["simulator-1.start0"]);
    assert_eq!(pod.files(AGENT), ["agent-1.start0"]);
}

#[test]
fn a_cancel_is_obeyed_while_waiting_and_while_booting() {
    let pod = Pod::new();
    let mut agent = pod.agent("exit 0");
    let mut simulator = pod.simulator_running(&["sleep", "1000"], &["--cancel-seconds=1"]);
    assert!(simulator.stays(MOMENT) && agent.stays(Duration::ZERO));
    pod.write(StatusFile::Cancel);
    assert_eq!((simulator.code(), agent.code()), (0, 0));
    assert!(pod.files(SIMULATOR).is_empty() && pod.files(AGENT).is_empty());
}

#[test]
fn a_container_that_comes_back_after_the_end_starts_nothing() {
    let pod = Pod::new();
    pod.write(StatusFile::Of(AGENT, Mark::Done));
    let never = pod.path("never");
    let touch = ["touch", never.to_str().unwrap()];
    let mut agent = pod.agent_running(&touch, &[]);
    assert_eq!(agent.code(), 0);
    let mut simulator = pod.simulator_running(&touch, &[]);
    pod.until(SIMULATOR, Mark::Done);
    simulator.kill_without_a_word();
    let mut simulator = pod.simulator_running(&touch, &[]);
    assert!(simulator.stays(MOMENT));
    pod.write(StatusFile::Stored);
    assert_eq!(simulator.code(), 0);
    assert!(!never.exists());
    assert_eq!(pod.files(SIMULATOR), ["simulator-1.done"]);
}

#[test]
fn sigterm_stops_everything_at_once_and_nobody_holds() {
    let pod = Pod::new();
    let (mut simulator, mut agent) = (pod.simulator(), pod.agent(&patient_agent(&pod)));
    pod.until(AGENT, Mark::Start(0));
    for container in [&simulator, &agent] {
        container.signal(Signal::SIGTERM);
    }
    assert_eq!((simulator.code(), agent.code()), (143, 143));
    assert_eq!(agent.verdict().what, What::Stopped);
    assert_eq!(pod.files(SIMULATOR), ["simulator-1.start0"]);
    assert!(TcpStream::connect(("127.0.0.1", pod.port)).is_err());

    pod.write(StatusFile::Of(SIMULATOR, Mark::Done));
    let mut holding = pod.simulator();
    assert!(holding.stays(MOMENT));
    holding.signal(Signal::SIGTERM);
    assert_eq!(holding.code(), 0, "a hold that is broken off is no failure");
}

#[test]
fn files_that_an_agent_forges_in_its_own_folder_mean_nothing() {
    let pod = Pod::new();
    let forge = "mkdir -p logcopy simulator-1; touch simulator-1.done simulator-1.crash0 simulation.cancel logcopy.done \
                 agent-2.done agent-1.crash1 agent-1.crash00 agent-1.done.x logcopy/simulation.cancel simulator-1/simulator-1.crash0";
    let script = format!(
        "cd {}/agent-1 && {forge}; {}",
        pod.status().display(),
        patient_agent(&pod)
    );
    let (mut simulator, mut agent) = (pod.simulator(), pod.agent(&script));
    support::until_exists(&pod.status().join("agent-1/simulator-1/simulator-1.crash0"));
    assert!(simulator.stays(MOMENT) && agent.stays(MOMENT));
    go(&pod);
    assert_eq!(agent.code(), 0);
    assert!(simulator.stays(MOMENT), "the forged logcopy.done does not end the hold");
    pod.write(StatusFile::Stored);
    assert_eq!(simulator.code(), 0);
    assert_eq!(pod.files(SIMULATOR), ["simulator-1.done", "simulator-1.start0"]);
}

#[test]
fn crashes_that_an_agent_forges_are_never_its_simulators() {
    let pod = Pod::new();
    let crash = format!("touch {}/agent-1/agent-1.crash0", pod.status().display());
    let script = format!("{crash}; {}", patient_agent(&pod));
    let (mut simulator, mut agent) = (pod.simulator(), pod.agent(&script));
    assert_eq!((simulator.code(), agent.code()), (1, 1));
    assert_eq!(
        [simulator.verdict().what, agent.verdict().what],
        [What::PeerCrashed, What::PeerCrashed],
        "each blames the other, which happens to no honest pair"
    );
    for round in 1..MAX_ROUNDS {
        pod.write(StatusFile::Of(AGENT, Mark::Crash(round)));
    }
    let mut simulator = pod.simulator();
    assert_eq!((simulator.code(), simulator.verdict().what), (1, What::PeerCrashed));
    let mut agent = pod.agent(&script);
    assert_eq!((agent.code(), agent.verdict().what), (74, What::CannotStart));
}

#[test]
fn marks_that_an_agent_deletes_take_no_pair_out_of_step() {
    let pod = Pod::new();
    let script = format!("rm -rf {}/agent-1/* && exit 1", pod.status().display());
    for round in 0..3 {
        let (mut simulator, mut agent) = (pod.simulator(), pod.agent(&script));
        assert_eq!((simulator.code(), agent.code()), (1, 1), "{}", agent.stderr());
        assert_eq!(simulator.verdict().what, What::PeerCrashed);
        assert_eq!([simulator.verdict().round, agent.verdict().round], [Some(round); 2]);
    }
}

#[test]
fn a_status_folder_that_cannot_be_written_is_reported_and_ends_the_container() {
    let pod = Pod::new();
    fs::write(pod.status().join("simulator-1"), "").unwrap();
    let mut simulator = pod.simulator();
    assert_eq!(simulator.code(), 74);
    let verdict = simulator.verdict();
    assert_eq!(verdict.what, What::CannotStart);
    assert!(
        verdict.why.contains("simulator-1.start0 cannot be created"),
        "{}",
        verdict.why
    );
    assert!(
        TcpStream::connect(("127.0.0.1", pod.port)).is_err(),
        "the server is stopped"
    );
}
