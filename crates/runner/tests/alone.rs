//! An evaluator, or its agent, that has no peer beside it, as a real process: it waits for nobody and follows nobody.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on fails")]

mod support;

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::time::{Duration, Instant};

use leaderboard_protocol::files::{Mark, RESULT, StatusFile};
use leaderboard_protocol::verdict::{CODE_NO_GRAPHICS, What};
use support::{AGENT, Container, EVALUATOR, MERGER, Pod};

const MOMENT: Duration = Duration::from_millis(300);
const FINAL: &str = r#"echo '{"final":true,"splits":[]}' > $RESULT"#;
/// Ends of the other side in the first round, which it may have forged.
const ENDS: [Mark; 2] = [Mark::Crash(0), Mark::Done];

fn agent(pod: &Pod, script: &str, options: &[&str]) -> Container {
    pod.plain(script, &[&["--alone"], options].concat())
}

fn evaluator(pod: &Pod, script: &str, options: &[&str]) -> Container {
    pod.evaluator(script, &[&["--alone"], options].concat())
}

fn is_stored(pod: &Pod, evaluator: &mut Container) {
    pod.until(evaluator.member, Mark::Done);
    assert!(
        evaluator.stays(MOMENT),
        "it holds its exit until the results are stored"
    );
    pod.write(StatusFile::Stored);
    assert_eq!((evaluator.code(), evaluator.verdict().what), (0, What::Finished));
}

#[test]
fn an_agent_runs_once_to_its_end() {
    let pod = Pod::new();
    let script = format!("echo ran >> {}", pod.path("said").display());
    let mut first = agent(&pod, &script, &[]);
    assert_eq!((first.code(), first.verdict().what), (0, What::Exited));
    let mut again = agent(&pod, &script, &[]);
    assert_eq!((again.code(), again.verdict().what), (0, What::Finished));
    assert_eq!(fs::read_to_string(pod.path("said")).unwrap(), "ran\n");
    assert_eq!(pod.files(AGENT), ["agent-1.done", "agent-1.start0"]);
}

#[test]
fn all_users_can_read_what_an_agent_has_left_when_it_is_done() {
    let pod = Pod::new();
    let folder = pod.path("left");
    fs::create_dir(&folder).unwrap();
    let leaves = format!("--leaves={}", folder.display());
    for (code, expected) in [(3, [0o700, 0o600]), (0, [0o755, 0o644])] {
        let inner = folder.join(code.to_string());
        let file = inner.join("answers");
        let script = format!(
            "umask 077; mkdir {}; echo a > {}; exit {code}",
            inner.display(),
            file.display()
        );
        let mut agent = agent(&pod, &script, &[&leaves]);
        assert_eq!(agent.code() == 0, code == 0, "{}", agent.stderr());
        let found = [&inner, &file].map(|path| fs::metadata(path).unwrap().permissions().mode() & 0o777);
        assert_eq!(found, expected, "exit code {code}");
    }
}

#[test]
fn an_agent_that_crashes_leaves_at_once_and_is_run_again() {
    let pod = Pod::new();
    for mark in ENDS {
        pod.write(StatusFile::Of(EVALUATOR, mark));
    }
    let mut first = agent(&pod, "exit 3", &[]);
    assert_eq!(first.code(), 1);
    let verdict = first.verdict();
    assert_eq!((verdict.what, verdict.exit_code), (What::Exited, Some(3)));
    let mut silent = agent(&pod, "exec sleep 1000", &["--idle-seconds=1"]);
    assert_eq!((silent.code(), silent.verdict().what), (1, What::Idle));
    let mut killed = agent(&pod, "exec sleep 1000", &[]);
    pod.until(AGENT, Mark::Start(2));
    killed.kill_without_a_word();
    let mut last = agent(&pod, "exit 0", &[]);
    assert_eq!(last.code(), 0);
    for mark in [Mark::Crash(2), Mark::Start(3), Mark::Done] {
        assert!(pod.has(AGENT, mark), "{mark:?}");
    }
}

#[test]
fn a_cancel_ends_an_agent_at_once_and_an_evaluator_when_all_is_stored() {
    let pod = Pod::new();
    let mut agent = agent(&pod, "exec sleep 1000", &[]);
    let mut evaluator = evaluator(&pod, "exec sleep 1000", &[]);
    pod.until(AGENT, Mark::Start(0));
    pod.until(EVALUATOR, Mark::Start(0));
    pod.write(StatusFile::Cancel);
    assert_eq!((agent.code(), agent.verdict().what), (0, What::Cancelled));
    assert!(evaluator.stays(MOMENT));
    pod.write(StatusFile::Stored);
    assert_eq!((evaluator.code(), evaluator.verdict().what), (0, What::Cancelled));
    assert!(!pod.has(AGENT, Mark::Done) && !pod.has(EVALUATOR, Mark::Done));
}

#[test]
fn an_agent_that_is_to_have_a_gpu_and_sees_none_is_not_begun() {
    let pod = Pod::new();
    let never = pod.path("never");
    let root = format!("--root={}", pod.path("root").display());
    let options = ["--report-gpu=true", &root];
    let script = format!("touch {}", never.display());
    let mut first = agent(&pod, &script, &options);
    assert_eq!((first.code(), first.verdict().what), (CODE_NO_GRAPHICS, What::NoGpu));
    pod.write(StatusFile::Of(AGENT, Mark::Done));
    let mut done = agent(&pod, &script, &options);
    assert_eq!(done.code(), 0, "{}", done.stderr());
    assert!(!never.exists());
}

#[test]
fn an_evaluator_follows_no_mark_of_an_agent() {
    let pod = Pod::new();
    for file in ENDS.map(|mark| StatusFile::Of(AGENT, mark)) {
        pod.write(file);
    }
    pod.write(StatusFile::Gpu(AGENT, false));
    let go = pod.path("go");
    let script = format!("until [ -e {} ]; do sleep 0.02; done; {FINAL}", go.display());
    let mut evaluator = evaluator(&pod, &script, &["--agent-gpu=true"]);
    pod.until(EVALUATOR, Mark::Start(0));
    assert!(evaluator.stays(MOMENT));
    fs::write(go, "").unwrap();
    is_stored(&pod, &mut evaluator);
    assert_eq!(pod.files(EVALUATOR), ["evaluator-1.done", "evaluator-1.start0"]);
}

#[test]
fn an_evaluator_has_its_time_from_its_own_start() {
    let pod = Pod::new();
    let began = Instant::now();
    let mut evaluator = evaluator(&pod, "exec sleep 1000", &["--answer-seconds=1"]);
    assert_eq!(evaluator.code(), 1);
    assert!(began.elapsed() >= Duration::from_secs(1));
    let verdict = evaluator.verdict();
    let why = "the evaluator had no complete result in time; there is no result file";
    assert_eq!((verdict.what, verdict.why.as_str()), (What::NoResult, why));
    assert_eq!(pod.files(EVALUATOR), ["evaluator-1.crash0", "evaluator-1.start0"]);
}

#[test]
fn an_evaluator_that_crashes_leaves_at_once_and_may_refuse_in_the_next_round() {
    let pod = Pod::new();
    let mut first = evaluator(&pod, "exit 4", &[]);
    assert_eq!((first.code(), first.verdict().what), (1, What::Exited));
    let mut refusing = evaluator(&pod, "exit 65", &[]);
    is_stored(&pod, &mut refusing);
    assert!(fs::read_to_string(pod.result()).unwrap().contains("refused"));
}

#[test]
fn one_that_merges_begins_when_the_others_are_done_with_final_results_and_has_its_time_from_then() {
    let pod = Pod::new();
    let part = pod.path("parts/1");
    fs::create_dir_all(&part).unwrap();
    fs::write(part.join(RESULT), r#"{"final":true}"#).unwrap();
    let mut late = pod.merger("exec sleep 1000", &["--answer-seconds=1", "--ready-seconds=1"]);
    // Longer than each of its limits, and than the time between two looks.
    assert!(late.stays(Duration::from_millis(1500)), "another one is not done");
    assert!(pod.files(MERGER).is_empty());
    pod.write(StatusFile::Of(EVALUATOR, Mark::Done));
    assert_eq!((late.code(), late.verdict().what), (1, What::NoResult));
    assert_eq!(pod.files(MERGER), ["evaluator-2.crash0", "evaluator-2.start0"]);

    let read = format!("grep final {} && {FINAL}", part.join(RESULT).display());
    let mut merger = pod.merger(&read, &[]);
    is_stored(&pod, &mut merger);
    assert_eq!(
        pod.files(MERGER),
        [
            "evaluator-2.crash0",
            "evaluator-2.done",
            "evaluator-2.start0",
            "evaluator-2.start1"
        ]
    );
}

#[test]
fn one_that_merges_does_not_begin_where_a_result_refuses_and_a_cancel_ends_it() {
    let pod = Pod::new();
    let part = pod.path("parts/1");
    fs::create_dir_all(&part).unwrap();
    pod.write(StatusFile::Of(EVALUATOR, Mark::Done));
    let refusal = r#"{"final":true,"refused":"The file has no header."}"#;
    fs::write(part.join(RESULT), refusal).unwrap();
    let mut merger = pod.merger("exec sleep 1000", &[]);
    assert!(merger.stays(MOMENT));
    pod.write(StatusFile::Cancel);
    pod.write(StatusFile::Stored);
    assert_eq!((merger.code(), merger.verdict().what), (0, What::Cancelled));
    assert!(pod.files(MERGER).is_empty());
}
