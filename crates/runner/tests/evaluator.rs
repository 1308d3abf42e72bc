//! An evaluator and its agent, as real processes: what ends them, who has the last word, and what an agent cannot bring about.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on fails")]

mod support;

use std::fs;
use std::net::TcpListener;
use std::os::unix::fs::PermissionsExt;
use std::time::{Duration, Instant};

use leaderboard_protocol::files::{Mark, Member, Pair, StatusFile};
use leaderboard_protocol::verdict::What;
use nix::sys::signal::Signal;
use support::{AGENT, Container, EVALUATOR, Pod};

const MOMENT: Duration = Duration::from_millis(300);
const FINAL: &str = r#"{"schema":1,"done":2,"total":2,"final":true,"splits":[]}"#;
const PARTIAL: &str = r#"{"schema":1,"done":1,"total":2,"final":false,"splits":[],"refused":null}"#;
/// It listens, takes one connection, and has its result when the other end of it has gone.
const SESSION: &str = "
import os, socket, sys
server = socket.socket()
server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
server.bind(('127.0.0.1', int(sys.argv[1])))
server.listen()
session = server.accept()[0]
received = session.recv(100)
while session.recv(100): pass
result = os.environ['RESULT']
with open(result + '.tmp', 'w') as file:
    file.write(sys.argv[2] if received == b'hello' else '{}')
os.rename(result + '.tmp', result)
";

/// A shell's words that put a result into its place.
fn write(result: &str) -> String {
    format!("echo '{result}' > $RESULT.tmp && mv $RESULT.tmp $RESULT")
}

const FOREVER: &str = "while :; do sleep 0.02; done";

/// A shell's words by which it does something when it is asked to end.
fn at_sigterm(words: &str) -> String {
    format!("last() {{ {words}; exit 5; }}; trap last TERM")
}

/// An evaluator that says what RESUME is, waits for the file `go`, and then has its result.
fn patient(pod: &Pod) -> String {
    let (said, go) = (pod.path("said"), pod.path("go"));
    let (said, go) = (said.display(), go.display());
    let wait = format!("until [ -e {go} ]; do sleep 0.02; done");
    format!("echo RESUME=[$RESUME] >> {said}; {wait}; {}", write(FINAL))
}

fn go(pod: &Pod) {
    fs::write(pod.path("go"), "").unwrap();
}

/// An evaluator that takes one session, and an agent that has it.
fn session(pod: &Pod) -> (Container, Container) {
    fs::write(pod.path("session.py"), SESSION).unwrap();
    let port = pod.port;
    let script = format!("exec python3 {} {port} '{FINAL}'", pod.path("session.py").display());
    let hello =
        format!("python3 -c \"import socket; socket.create_connection(('127.0.0.1', {port})).sendall(b'hello')\"");
    (
        pod.evaluator(&script, &[&format!("--port={port}")]),
        pod.plain(&hello, &[]),
    )
}

fn is_stored(pod: &Pod, evaluator: &mut Container) {
    pod.until(EVALUATOR, Mark::Done);
    assert!(
        evaluator.stays(MOMENT),
        "it holds its exit until the results are stored"
    );
    pod.write(StatusFile::Stored);
    assert_eq!(evaluator.code(), 0, "{}", evaluator.stderr());
    assert_eq!(evaluator.verdict().what, What::Finished);
}

#[test]
fn a_pair_runs_to_its_end_over_the_one_connection_that_its_evaluator_takes() {
    for inotify in ["--inotify=true", "--inotify=false"] {
        let mut pod = Pod::new();
        pod.options.push(inotify.to_owned());
        let (mut evaluator, mut agent) = session(&pod);
        assert_eq!(agent.code(), 0, "{}", agent.stderr());
        is_stored(&pod, &mut evaluator);
        assert_eq!(pod.files(EVALUATOR), ["evaluator-1.done", "evaluator-1.start0"]);
        assert_eq!(pod.files(AGENT), ["agent-1.done", "agent-1.start0"]);
        let verdict = evaluator.verdict();
        let why = "the evaluation has come to its end; its result is complete";
        assert_eq!((verdict.exit_code, verdict.why.as_str()), (Some(0), why));
    }
}

#[test]
fn a_complete_result_ends_its_evaluator_and_its_agent() {
    let pod = Pod::new();
    let mut agent = pod.plain("exec sleep 1000", &[]);
    let mut evaluator = pod.evaluator(&format!("{}; exec sleep 1000", patient(&pod)), &[]);
    pod.until(AGENT, Mark::Start(0));
    assert!(evaluator.stays(MOMENT) && agent.stays(Duration::ZERO));
    go(&pod);
    pod.until(EVALUATOR, Mark::Done);
    assert_eq!(agent.code(), 0);
    assert_eq!(
        (agent.verdict().what, agent.verdict().signal),
        (What::Finished, Some(15))
    );
    assert_eq!(pod.files(AGENT), ["agent-1.done", "agent-1.start0"]);
    is_stored(&pod, &mut evaluator);
    assert_eq!(evaluator.verdict().signal, Some(15));
}

#[test]
fn a_complete_result_counts_whatever_its_evaluator_exits_with() {
    for result in [FINAL, r#"{"final":false,"refused":"The file has no header."}"#] {
        let pod = Pod::new();
        let mut evaluator = pod.evaluator(&format!("{}; exit 3", write(result)), &[]);
        is_stored(&pod, &mut evaluator);
        assert_eq!(evaluator.verdict().exit_code, Some(3));
    }
}

#[test]
fn an_evaluator_without_a_text_refuses_by_its_exit_code() {
    let pod = Pod::new();
    let mut agent = pod.plain("exec sleep 1000", &[]);
    let mut evaluator = pod.evaluator(&format!("{}; exit 65", write(PARTIAL)), &[]);
    assert_eq!(agent.code(), 0, "{}", agent.stderr());
    is_stored(&pod, &mut evaluator);
    let refusal = fs::read_to_string(pod.result()).unwrap();
    assert!(
        refusal.contains(r#""final":true"#) && refusal.contains(r#""refused":"The evaluator refused the submission.""#),
        "{refusal}"
    );
}

#[test]
fn a_refusal_that_cannot_be_written_is_a_crash() {
    let pod = Pod::new();
    fs::create_dir(pod.result()).unwrap();
    let mut evaluator = pod.evaluator("exit 65", &["--peer-seconds=0"]);
    assert_eq!(evaluator.code(), 1);
    let verdict = evaluator.verdict();
    assert_eq!((verdict.what, verdict.exit_code), (What::Exited, Some(65)));
    assert!(
        verdict.why.contains("; its refusal cannot be written: "),
        "{}",
        verdict.why
    );
    assert!(pod.has(EVALUATOR, Mark::Crash(0)) && !pod.has(EVALUATOR, Mark::Done));
}

#[test]
fn what_an_evaluator_prints_after_its_result_is_kept() {
    let pod = Pod::new();
    let console = pod.path("results/console.log");
    let log = format!("--log={}", console.display());
    let mut evaluator = pod.evaluator(&format!("{}; sleep 0.3; echo the end", write(FINAL)), &[&log]);
    is_stored(&pod, &mut evaluator);
    assert_eq!(fs::read_to_string(console).unwrap(), "the end\n");
}

#[test]
fn a_result_that_is_written_over_at_the_end_is_not_complete() {
    let pod = Pod::new();
    let script = format!("{}; {}; {FOREVER}", at_sigterm(&write(PARTIAL)), write(FINAL));
    let mut evaluator = pod.evaluator(&script, &["--peer-seconds=0"]);
    assert_eq!(evaluator.code(), 1);
    let verdict = evaluator.verdict();
    assert_eq!(verdict.what, What::Exited);
    assert_eq!(verdict.why, "the command exited with code 5; its result is not final");
    assert!(!pod.has(EVALUATOR, Mark::Done));
}

#[test]
fn an_evaluator_goes_on_after_the_regular_end_of_its_agent() {
    let pod = Pod::new();
    let (mut evaluator, mut agent) = (pod.evaluator(&patient(&pod), &[]), pod.plain("exit 0", &[]));
    assert_eq!(agent.code(), 0, "{}", agent.stderr());
    assert_eq!(
        (agent.verdict().what, agent.verdict().exit_code),
        (What::Exited, Some(0))
    );
    assert!(evaluator.stays(MOMENT));
    go(&pod);
    is_stored(&pod, &mut evaluator);
}

#[test]
fn an_evaluator_without_a_result_in_time_is_a_crash() {
    let pod = Pod::new();
    let mut evaluator = pod.evaluator(&patient(&pod), &["--answer-seconds=1"]);
    pod.until(EVALUATOR, Mark::Start(0));
    assert!(
        evaluator.stays(Duration::from_secs(2)),
        "the time does not run before its agent is done"
    );
    let began = Instant::now();
    let mut agent = pod.plain("exit 0", &[]);
    assert_eq!((agent.code(), evaluator.code()), (0, 1));
    assert!(began.elapsed() >= Duration::from_secs(1));
    let verdict = evaluator.verdict();
    let why = "the agent is done, and the evaluator had no complete result in time; there is no result file";
    assert_eq!((verdict.what, verdict.why.as_str()), (What::NoResult, why));
    assert_eq!(pod.files(EVALUATOR), ["evaluator-1.crash0", "evaluator-1.start0"]);
}

#[test]
fn an_evaluator_that_crashes_after_its_agents_end_is_started_again_alone() {
    let pod = Pod::new();
    let die = pod.path("die");
    let script = format!(
        "until [ -e {} ]; do sleep 0.02; done; {}; exit 4",
        die.display(),
        write(PARTIAL)
    );
    let (mut evaluator, mut agent) = (pod.evaluator(&script, &[]), pod.plain("exit 0", &[]));
    assert_eq!(agent.code(), 0);
    fs::write(die, "").unwrap();
    assert_eq!(evaluator.code(), 1);
    assert_eq!(
        evaluator.verdict().why,
        "the command exited with code 4; its result is not final"
    );

    let mut evaluator = pod.evaluator(&patient(&pod), &[]);
    pod.until(EVALUATOR, Mark::Start(1));
    let never = pod.path("never");
    let mut agent = pod.plain(&format!("touch {}", never.display()), &[]);
    assert_eq!(agent.code(), 0);
    go(&pod);
    is_stored(&pod, &mut evaluator);
    assert!(!never.exists(), "an agent that is done is not started again");
    assert_eq!(fs::read_to_string(pod.path("said")).unwrap(), "RESUME=[1]\n");
    assert_eq!(pod.files(AGENT), ["agent-1.done", "agent-1.start0"]);
}

#[test]
fn an_evaluator_resumes_only_if_it_has_files_of_an_earlier_pod() {
    for (from_outside, has_files, said) in [
        ("", true, "RESUME=[1]\n"),
        ("1", true, "RESUME=[1]\n"),
        ("1", false, "RESUME=[]\n"),
    ] {
        let mut pod = Pod::new();
        pod.environment.push(("RESUME".to_owned(), from_outside.to_owned()));
        if has_files {
            fs::write(pod.path("results/games.json"), "[]").unwrap();
        }
        let (mut evaluator, _agent) = (pod.evaluator(&patient(&pod), &[]), pod.plain("exec sleep 1000", &[]));
        go(&pod);
        is_stored(&pod, &mut evaluator);
        assert_eq!(fs::read_to_string(pod.path("said")).unwrap(), said, "{from_outside:?}");
    }
}

#[test]
fn an_agent_that_crashes_leaves_its_evaluator_the_time_for_a_partial_result() {
    let pod = Pod::new();
    let script = format!(
        "{}; echo RESUME=[$RESUME] >> {}; {FOREVER}",
        at_sigterm(&write(PARTIAL)),
        pod.path("said").display()
    );
    let begun = pod.path("said");
    let crash = format!("until [ -e {} ]; do sleep 0.02; done; exit 3", begun.display());
    let (mut evaluator, mut agent) = (pod.evaluator(&script, &[]), pod.plain(&crash, &[]));
    assert_eq!((evaluator.code(), agent.code()), (1, 1));
    assert_eq!(
        (agent.verdict().what, agent.verdict().exit_code),
        (What::Exited, Some(3))
    );
    let why = "the agent crashed, so the evaluator was stopped; its result is not final";
    let verdict = evaluator.verdict();
    assert_eq!((verdict.what, verdict.why.as_str()), (What::PeerCrashed, why));
    assert_eq!(fs::read_to_string(pod.result()).unwrap().trim(), PARTIAL);

    let (mut evaluator, mut agent) = (pod.evaluator(&patient(&pod), &[]), pod.plain("exit 0", &[]));
    pod.until(AGENT, Mark::Start(1));
    assert_eq!(agent.code(), 0);
    go(&pod);
    is_stored(&pod, &mut evaluator);
    assert_eq!(fs::read_to_string(pod.path("said")).unwrap(), "RESUME=[]\nRESUME=[1]\n");
}

#[test]
fn an_agent_that_crashes_while_its_evaluator_completes_is_done_with_it() {
    let pod = Pod::new();
    let begun = pod.path("begun");
    let script = format!("{}; touch {}; {FOREVER}", at_sigterm(&write(FINAL)), begun.display());
    let crash = format!("until [ -e {} ]; do sleep 0.02; done; exit 3", begun.display());
    let (mut evaluator, mut agent) = (pod.evaluator(&script, &[]), pod.plain(&crash, &[]));
    assert_eq!(agent.code(), 0, "{}", agent.stderr());
    is_stored(&pod, &mut evaluator);
    assert!(pod.has(AGENT, Mark::Done) && pod.has(AGENT, Mark::Crash(0)));
}

#[test]
fn a_silent_agent_is_stopped_and_so_is_its_evaluator() {
    let pod = Pod::new();
    let (mut evaluator, mut agent) = (
        pod.evaluator(&patient(&pod), &[]),
        // Its exit code is none of its own any more.
        pod.plain(&format!("trap 'exit 0' TERM; {FOREVER}"), &["--idle-seconds=1"]),
    );
    assert_eq!((evaluator.code(), agent.code()), (1, 1));
    assert_eq!(
        [evaluator.verdict().what, agent.verdict().what],
        [What::PeerCrashed, What::Idle]
    );
    assert!(!pod.has(AGENT, Mark::Done));
}

#[test]
fn an_evaluator_that_crashes_brings_its_agent_down() {
    let pod = Pod::new();
    let begun = pod.path("begun");
    let crash = format!("until [ -e {} ]; do sleep 0.02; done; exit 0", begun.display());
    let (mut evaluator, mut agent) = (
        pod.evaluator(&crash, &[]),
        pod.plain(&format!("touch {}; exec sleep 1000", begun.display()), &[]),
    );
    assert_eq!((evaluator.code(), agent.code()), (1, 1));
    let why = "the command exited with code 0; there is no result file";
    assert_eq!(evaluator.verdict().why, why);
    assert_eq!(agent.verdict().why, "the evaluator crashed, so the agent was stopped");
    assert_eq!(pod.files(AGENT), ["agent-1.crash0", "agent-1.start0"]);
}

#[test]
fn a_cancel_and_a_sigterm_stop_both() {
    let pod = Pod::new();
    let (mut evaluator, mut agent) = (pod.evaluator(&patient(&pod), &[]), pod.plain("exec sleep 1000", &[]));
    pod.until(AGENT, Mark::Start(0));
    for container in [&evaluator, &agent] {
        container.signal(Signal::SIGTERM);
    }
    assert_eq!((evaluator.code(), agent.code()), (143, 143));

    let (mut evaluator, mut agent) = (pod.evaluator(&patient(&pod), &[]), pod.plain("exec sleep 1000", &[]));
    pod.until(AGENT, Mark::Start(1));
    pod.write(StatusFile::Cancel);
    assert_eq!(agent.code(), 0);
    assert!(evaluator.stays(MOMENT), "it holds until what there is has been stored");
    pod.write(StatusFile::Stored);
    assert_eq!(evaluator.code(), 0);
    assert_eq!([evaluator.verdict().what, agent.verdict().what], [What::Cancelled; 2]);
    assert!(!pod.has(EVALUATOR, Mark::Done) && !pod.has(AGENT, Mark::Done));
}

#[test]
fn an_evaluator_that_finds_its_complete_result_starts_nothing() {
    let pod = Pod::new();
    // Its runner was killed between the result and its mark.
    pod.write(StatusFile::Of(EVALUATOR, Mark::Start(0)));
    fs::write(pod.result(), FINAL).unwrap();
    let never = pod.path("never");
    let touch = format!("touch {}", never.display());
    let mut evaluator = pod.evaluator(&touch, &[]);
    pod.until(EVALUATOR, Mark::Done);
    let mut agent = pod.plain(&touch, &[]);
    assert_eq!((agent.code(), agent.verdict().what), (0, What::Finished));
    evaluator.kill_without_a_word();
    let mut evaluator = pod.evaluator(&touch, &[]);
    is_stored(&pod, &mut evaluator);
    assert!(!never.exists());
    assert_eq!(pod.files(EVALUATOR), ["evaluator-1.done", "evaluator-1.start0"]);
    let mut late = pod.evaluator(&touch, &[]);
    assert_eq!(late.code(), 0);
}

#[test]
fn a_result_of_mode_0600_becomes_readable_while_its_evaluator_runs() {
    let pod = Pod::new();
    let script = format!("umask 077; {}; exec sleep 1000", write(PARTIAL));
    let mut evaluator = pod.evaluator(&script, &[]);
    support::until_exists(&pod.result());
    let began = Instant::now();
    while fs::metadata(pod.result()).unwrap().permissions().mode() & 0o777 != 0o644 {
        assert!(began.elapsed() < support::LIMIT, "{}", evaluator.stderr());
        std::thread::yield_now();
    }
    assert!(evaluator.stays(Duration::ZERO));
}

#[test]
fn a_listener_of_another_container_is_no_readiness() {
    let pod = Pod::new();
    let _other = TcpListener::bind(("127.0.0.1", pod.port)).unwrap();
    let port = format!("--port={}", pod.port);
    let options = [port.as_str(), "--ready-seconds=1", "--peer-seconds=0"];
    let mut evaluator = pod.evaluator("exec sleep 1000", &options);
    assert_eq!(evaluator.code(), 1);
    let verdict = evaluator.verdict();
    let why = "the evaluator did not answer on its port in time; there is no result file";
    assert_eq!(
        (verdict.what, verdict.why.as_str()),
        (What::NotReady, why),
        "no agent has begun"
    );
    assert_eq!(pod.files(EVALUATOR), ["evaluator-1.crash0"]);

    let other = Member {
        pair: Pair::new(2).unwrap(),
        ..EVALUATOR
    };
    pod.write(StatusFile::Of(other, Mark::Start(0)));
    let mut evaluator = pod.evaluator("exec sleep 1000", &options);
    assert_eq!(evaluator.code(), 1);
    let verdict = evaluator.verdict();
    let why = format!(
        "another process of the Pod has port {}, which the evaluator needs; there is no result file",
        pod.port
    );
    assert_eq!((verdict.what, verdict.why), (What::PortTaken, why));
}

#[test]
fn what_an_agent_forges_ends_nothing_and_completes_nothing() {
    let pod = Pod::new();
    let forge = "mkdir -p logcopy evaluator-1; touch agent-1.done evaluator-1.done evaluator-1.crash0 logcopy.done \
                 logcopy/logcopy.done evaluator-1/evaluator-1.done";
    let script = format!(
        "cd {}/agent-1 && {forge}; echo '{FINAL}' > result.json; exec sleep 1000",
        pod.status().display()
    );
    let options = ["--answer-seconds=2", "--peer-seconds=0"];
    let (mut evaluator, mut agent) = (pod.evaluator(&patient(&pod), &options), pod.plain(&script, &[]));
    support::until_exists(&pod.status().join("agent-1/result.json"));
    assert!(evaluator.stays(MOMENT), "only the time for the result has begun");
    assert!(agent.stays(Duration::ZERO));
    assert_eq!((evaluator.code(), evaluator.verdict().what), (1, What::NoResult));
    let end = (agent.code(), agent.verdict().what);
    assert_eq!(end, (1, What::PeerCrashed), "no agent that is done ends so");
    assert!(!pod.has(EVALUATOR, Mark::Done));

    let mut evaluator = pod.evaluator(&patient(&pod), &[]);
    pod.until(EVALUATOR, Mark::Start(1));
    assert!(evaluator.stays(MOMENT), "it is launched in spite of the forged mark");
    go(&pod);
    is_stored(&pod, &mut evaluator);
}

#[test]
fn the_words_of_both_commands_see_their_environment() {
    let mut pod = Pod::new();
    pod.environment.push(("WORKER".to_owned(), "1".to_owned()));
    let said = |name: &str| fs::read_to_string(pod.path(name)).unwrap();
    let words = "echo '$(WORKER) [$(RESUME)] $$(WORKER)'";
    let script = |name: &str| format!("{words} >> {}; exit 4", pod.path(name).display());
    for _ in 0..2 {
        let mut evaluator = pod.evaluator(&script("evaluator"), &["--peer-seconds=0"]);
        assert_eq!(evaluator.code(), 1);
        fs::write(pod.path("results/kept"), "").unwrap();
    }
    assert_eq!(said("evaluator"), "1 [] $(WORKER)\n1 [1] $(WORKER)\n");
    pod.write(StatusFile::Of(EVALUATOR, Mark::Start(2)));
    let mut agent = pod.plain(&script("agent"), &["--peer-seconds=0"]);
    assert_eq!(agent.code(), 1);
    assert_eq!(
        said("agent"),
        "1 [$(RESUME)] $(WORKER)\n",
        "a plain program has no rounds"
    );
}
