//! The agent's container alone: its environment, its output, its processes, the judgement of its checkpoint. The simulator is
//! played by status files.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on fails")]

mod support;

use std::fs::{self, File};
use std::io::{Read, Write};
use std::os::unix::fs::{PermissionsExt, symlink};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use leaderboard_protocol::files::{Mark, StatusFile};
use leaderboard_protocol::verdict::{CODE_NODE_REFUSED, What};
use nix::sys::signal::Signal;
use support::{AGENT, COMPLETE, PARTIAL, Pod, SIMULATOR, lives};

/// A Pod whose simulator answers already, and is done when anybody asks.
fn pod() -> Pod {
    let pod = Pod::new();
    pod.write(StatusFile::Of(SIMULATOR, Mark::Start(0)));
    pod.write(StatusFile::Of(SIMULATOR, Mark::Done));
    pod
}

fn pid_in(path: &std::path::Path) -> i32 {
    fs::read_to_string(path).unwrap().trim().parse().unwrap()
}

/// Waits for what no event reports.
fn until(what: &str, holds: impl Fn() -> bool) {
    let begin = Instant::now();
    while !holds() {
        assert!(begin.elapsed() < support::LIMIT, "{what}: never");
        std::thread::yield_now();
    }
}

#[test]
fn fifty_megabytes_of_random_bytes_come_through_unchanged() {
    let pod = pod();
    let source = pod.path("random");
    let mut random = Vec::new();
    File::open("/dev/urandom")
        .unwrap()
        .take(50_000_000)
        .read_to_end(&mut random)
        .unwrap();
    fs::write(&source, &random).unwrap();
    let begin = Instant::now();
    let (mut output, stdout) = std::io::pipe().unwrap();
    let reader = std::thread::spawn(move || {
        let mut bytes = Vec::new();
        output.read_to_end(&mut bytes).unwrap();
        bytes
    });
    let mut agent = pod.agent_printing(&["cat", source.to_str().unwrap()], &[], stdout.into());
    assert_eq!(agent.code(), 1);
    println!("50 MB through the tee: {:?}", begin.elapsed());
    assert!(reader.join().unwrap() == random, "stdout differs");
    assert!(fs::read(pod.log()).unwrap() == random, "leaderboard.log differs");
}

#[test]
fn stdout_and_stderr_keep_their_order_and_the_log_is_appended_to() {
    let pod = pod();
    fs::write(pod.log(), "before\n").unwrap();
    let mut agent = pod.agent("for i in 1 2 3; do echo out$i; echo err$i >&2; done");
    assert_eq!(agent.code(), 1);
    let printed = "out1\nerr1\nout2\nerr2\nout3\nerr3\n";
    assert_eq!(fs::read_to_string(&agent.stdout).unwrap(), printed);
    assert_eq!(fs::read_to_string(pod.log()).unwrap(), format!("before\n{printed}"));
}

#[test]
fn the_log_stops_at_its_limit_and_stdout_goes_on() {
    let pod = pod();
    let script = "head -c 300000 /dev/zero | tr '\\0' x";
    let mut agent = pod.agent_running(&["sh", "-c", script], &["--log-limit=1000"]);
    assert_eq!(agent.code(), 1);
    assert_eq!(fs::metadata(&agent.stdout).unwrap().len(), 300_000);
    let log = fs::read_to_string(pod.log()).unwrap();
    let (kept, note) = log.split_once('\n').unwrap();
    assert_eq!(
        (kept.len(), note.matches("limit").count(), note.lines().count()),
        (1000, 1, 1)
    );
}

#[test]
fn a_log_that_cannot_be_written_is_reported_once() {
    let pod = pod();
    let outside = pod.path("outside");
    fs::write(&outside, "precious").unwrap();
    symlink(&outside, pod.log()).unwrap();
    let mut agent = pod.agent("echo 1; echo 2");
    assert_eq!(agent.code(), 1);
    assert_eq!(fs::read_to_string(&agent.stdout).unwrap(), "1\n2\n");
    assert_eq!(fs::read_to_string(outside).unwrap(), "precious");
    assert_eq!(agent.stderr().matches("going on with standard output alone").count(), 1);
}

#[test]
fn an_agent_is_stopped_even_while_nobody_reads_its_output_and_none_of_it_is_lost() {
    let pod = pod();
    let (mut output, stdout) = std::io::pipe().unwrap();
    let mut agent = pod.agent_printing(&["yes"], &[], stdout.into());
    // More than a pipe holds has been read, so stdout is full.
    until("stdout is full", || {
        fs::metadata(pod.log()).is_ok_and(|log| log.len() > 65536)
    });
    let yes = agent.children()[0];
    pod.write(StatusFile::Cancel);
    until("the command is gone", || !lives(yes.as_raw()));
    let mut bytes = Vec::new();
    output.read_to_end(&mut bytes).unwrap();
    assert_eq!(agent.code(), 0);
    assert!(bytes == fs::read(pod.log()).unwrap(), "stdout and log differ");
    assert!(bytes.len() > 65536, "{}", bytes.len());
}

#[test]
fn an_agent_that_prints_is_not_idle_while_nobody_reads_its_output() {
    let pod = pod();
    let (mut output, stdout) = std::io::pipe().unwrap();
    // More than its pipe, the runner's buffer and standard output hold together, and printed last of all.
    let script = format!("echo '{COMPLETE}' > $CHECKPOINT; exec head -c 400000 /dev/zero");
    let mut agent = pod.agent_printing(&["sh", "-c", &script], &["--idle-seconds=1"], stdout.into());
    until("stdout is full", || {
        fs::metadata(pod.log()).is_ok_and(|log| log.len() > 65536)
    });
    // No event shows that nothing happens. One second is the shortest limit there is; the other is for a busy machine.
    assert!(agent.stays(Duration::from_secs(2)), "{}", agent.stderr());
    let mut bytes = Vec::new();
    output.read_to_end(&mut bytes).unwrap();
    let end = (agent.code(), agent.verdict().what);
    assert_eq!(end, (0, What::Exited), "{}", agent.stderr());
    assert_eq!(bytes.len(), 400_000);
}

#[test]
fn no_variable_of_an_image_steers_its_runner() {
    let mut pod = pod();
    let elsewhere = pod.path("elsewhere");
    fs::write(&elsewhere, "").unwrap();
    // A variable for each option that there is: its only way in is the command line.
    let options = leaderboard_runner::args::USAGE
        .split(|c: char| c.is_whitespace() || c == '|')
        .filter_map(|word| word.strip_prefix("--"))
        .filter(|option| !option.is_empty());
    for option in options.chain(["no-option"]) {
        let variable = format!("LEADERBOARD_{}", option.to_uppercase().replace('-', "_"));
        let value = match option {
            "inotify" => "off".to_owned(),
            "port" | "pair" | "log-limit" => "7".to_owned(),
            _ if option.ends_with("-seconds") => "0".to_owned(),
            _ => elsewhere.display().to_string(),
        };
        pod.environment.push((variable, value));
    }
    for needed in [
        "LEADERBOARD_TERMINATION_LOG",
        "LEADERBOARD_INOTIFY",
        "LEADERBOARD_IDLE_SECONDS",
    ] {
        assert!(pod.environment.iter().any(|(name, _)| name == needed), "{needed}");
    }
    let forged = r#"{"what":"notReady","round":0,"why":""}"#;
    let log = pod.path("agent-1.termination");
    let mut agent = pod.agent(&format!("echo '{forged}' > {}; echo printed; exit 3", log.display()));
    assert_eq!(agent.code(), 1);
    assert_eq!((agent.verdict().what, agent.verdict().round), (What::Exited, Some(0)));
    assert_eq!(fs::read_to_string(elsewhere).unwrap(), "");
    assert_eq!(fs::read_to_string(pod.log()).unwrap(), "printed\n");
    assert!(!agent.stderr().contains("no inotify"), "{}", agent.stderr());
}

#[test]
fn a_silent_agent_is_stopped_and_judged() {
    let pod = pod();
    let mut agent = pod.agent_running(&["sh", "-c", "echo hello; exec sleep 1000"], &["--idle-seconds=1"]);
    assert_eq!(agent.code(), 1);
    let verdict = agent.verdict();
    assert_eq!((verdict.what, verdict.signal), (What::Idle, Some(15)));
    assert_eq!(pod.files(AGENT), ["agent-1.crash0", "agent-1.start0"]);

    let pod = self::pod();
    let script = format!("echo '{COMPLETE}' > $CHECKPOINT; exec sleep 1000");
    let mut agent = pod.agent_running(&["sh", "-c", &script], &["--idle-seconds=1"]);
    assert_eq!(
        (agent.code(), agent.verdict().what),
        (0, What::Idle),
        "it hung after its results were complete"
    );
}

#[test]
fn output_keeps_an_agent_from_being_idle() {
    let pod = pod();
    let script = format!("for i in 1 2 3 4 5 6; do sleep 0.5; echo $i; done; echo '{COMPLETE}' > $CHECKPOINT");
    let mut agent = pod.agent_running(&["sh", "-c", &script], &["--idle-seconds=2"]);
    assert_eq!(agent.code(), 0, "{}", agent.stderr());
}

#[test]
fn the_command_sees_the_environment_that_was_made() {
    let mut pod = pod();
    for (name, value) in [("PYTHONPATH", "/image"), ("ROUTES", "/r.xml"), ("RESUME", "no")] {
        pod.environment.push((name.to_owned(), value.to_owned()));
    }
    let script = "echo \"$@\"; echo [$RESUME] $PYTHONPATH; umask";
    let words = [
        "--routes=$(ROUTES)",
        "--resume=$(RESUME)",
        "$(PYTHONPATH)",
        "$(NOT_THERE)",
        "$$(ROUTES)",
    ];
    let command = [&["sh", "-c", script, "sh"][..], &words].concat();
    let mut agent = pod.agent_running(&command, &["--python-path", "/a:/b"]);
    assert_eq!(agent.code(), 1);
    let expected = "--routes=/r.xml --resume= /a:/b:/image $(NOT_THERE) $(ROUTES)\n[] /a:/b:/image\n0022\n";
    assert_eq!(fs::read_to_string(&agent.stdout).unwrap(), expected);
}

#[test]
fn no_program_of_an_image_leaves_a_core_dump_on_the_node() {
    let pod = pod();
    let mut agent = pod.agent("grep 'core file size' /proc/self/limits");
    assert_eq!(agent.code(), 1);
    let limits = fs::read_to_string(&agent.stdout).unwrap();
    let bytes: Vec<u64> = limits.split_whitespace().filter_map(|word| word.parse().ok()).collect();
    assert!(bytes.len() == 2 && bytes.iter().all(|bytes| *bytes <= 1), "{limits}");
}

#[test]
fn partial_results_are_resumed_and_a_resume_from_outside_stays() {
    let resumed = |pod: &Pod| {
        let mut agent = pod.agent("echo [$RESUME]");
        assert_eq!(agent.code(), 1);
        fs::read_to_string(&agent.stdout).unwrap()
    };
    let with_partial = pod();
    fs::write(with_partial.checkpoint(), PARTIAL).unwrap();
    assert_eq!(resumed(&with_partial), "[1]\n");
    let mut from_outside = pod();
    from_outside.environment.push(("RESUME".to_owned(), "1".to_owned()));
    assert_eq!(resumed(&from_outside), "[1]\n");
    assert_eq!(resumed(&pod()), "[]\n");
}

#[test]
fn a_checkpoint_torn_by_a_kill_is_whole_again_before_the_next_start() {
    let pod = pod();
    let kept = pod.status().join("agent-1/checkpoint.json");
    let script = format!(
        "echo '{PARTIAL}' > $CHECKPOINT; until [ -s {} ]; do sleep 0.02; done; ",
        kept.display()
    );
    let mut agent = pod.agent(&(script + "printf '{' > $CHECKPOINT; exec sleep 1000"));
    until("the checkpoint is torn", || {
        fs::read_to_string(pod.checkpoint()).is_ok_and(|text| text == "{")
    });
    agent.kill_without_a_word();
    pod.write(StatusFile::Of(SIMULATOR, Mark::Start(1)));
    let mut agent = pod.agent("echo RESUME=[$RESUME]; cat $CHECKPOINT");
    assert_eq!(agent.code(), 1);
    assert_eq!(
        fs::read_to_string(&agent.stdout).unwrap(),
        format!("RESUME=[1]\n{PARTIAL}\n")
    );
}

#[test]
fn a_command_that_cannot_be_started_is_reported_with_the_reason() {
    let pod = pod();
    let not_executable = pod.path("text");
    fs::write(&not_executable, "#!/bin/sh\n").unwrap();
    let wrong_format = pod.path("wrong");
    fs::write(&wrong_format, [0x7f, b'E', b'L', b'F', 0, 0, 0, 0]).unwrap();
    fs::set_permissions(&wrong_format, fs::Permissions::from_mode(0o755)).unwrap();
    let cases = [
        ("/no/such/command".to_owned(), 127, "No such file"),
        (not_executable.display().to_string(), 126, "Permission denied"),
        (wrong_format.display().to_string(), 126, "Exec format error"),
    ];
    for (round, (command, code, reason)) in (0..).zip(cases) {
        pod.write(StatusFile::Of(SIMULATOR, Mark::Start(round)));
        let mut agent = pod.agent_running(&[&command], &[]);
        assert_eq!(agent.code(), code, "{command}");
        let verdict = agent.verdict();
        assert_eq!(verdict.what, What::CannotStart);
        assert!(
            verdict.why.contains(&command) && verdict.why.contains(reason),
            "{}",
            verdict.why
        );
        assert!(pod.has(AGENT, Mark::Crash(round)));
    }
}

/// As on a node on which all files that may be open are: nothing of the image runs, and nothing of it can be the cause.
#[test]
fn a_command_for_which_there_are_no_files_is_never_its_images_fault() {
    let (mut refused, mut ran) = (0, 0);
    for files in 4..40 {
        let mut pod = pod();
        let limit = format!("ulimit -n {files}; exec \"$@\"");
        pod.starter = ["sh", "-c", &limit, "sh"].map(str::to_owned).to_vec();
        let begun = pod.path("work/begun");
        let script = format!("touch {}; echo '{COMPLETE}' > $CHECKPOINT", begun.display());
        let mut agent = pod.agent(&script);
        let code = agent.code();
        if begun.exists() {
            ran += 1;
        } else {
            refused += 1;
            assert_eq!(code, CODE_NODE_REFUSED, "{files} files: {}", agent.stderr());
        }
    }
    assert!(refused > 3 && ran > 3, "{refused} times refused, {ran} times not");
}

#[test]
fn a_command_that_dies_of_a_signal_is_reported_with_it() {
    for (signal, expected) in [("KILL", 9), ("SEGV", 11), ("TERM", 15), ("40", 40)] {
        let pod = pod();
        let mut agent = pod.agent(&format!("kill -{signal} $$"));
        assert_eq!(agent.code(), 1);
        let verdict = agent.verdict();
        assert_eq!(
            (verdict.what, verdict.exit_code, verdict.signal),
            (What::Killed, None, Some(expected))
        );
    }
}

#[test]
fn a_checkpoint_that_is_no_checkpoint_is_a_crash_and_blocks_nothing() {
    let cases = [
        ("rm -f $CHECKPOINT", "there is no checkpoint file"),
        ("mkfifo $CHECKPOINT", "the checkpoint is not a regular file"),
        ("ln -s /etc/passwd $CHECKPOINT", "the checkpoint is not a regular file"),
        ("ln -s /dev/zero $CHECKPOINT", "the checkpoint is not a regular file"),
        ("mkdir $CHECKPOINT", "the checkpoint is not a regular file"),
        ("truncate -s 10G $CHECKPOINT", "the checkpoint is larger than 64 MiB"),
        (
            "truncate -s 60M $CHECKPOINT",
            "the checkpoint is not a checkpoint's JSON (line 1, column 1)",
        ),
        (
            "echo '{}' > $CHECKPOINT",
            "the checkpoint is not a checkpoint's JSON (line 1, column 2)",
        ),
    ];
    for (script, why) in cases {
        let pod = pod();
        let mut agent = pod.agent(script);
        assert_eq!(agent.code(), 1, "{script}");
        assert_eq!(
            agent.verdict().why,
            format!("the command exited with code 0; {why}"),
            "{script}"
        );
        assert_eq!(pod.files(AGENT), ["agent-1.crash0", "agent-1.start0"], "{script}");
    }
}

#[test]
fn complete_results_count_whatever_the_exit_code_and_become_readable() {
    let pod = pod();
    let mut agent = pod.agent(&format!("umask 077; echo '{COMPLETE}' > $CHECKPOINT; exit 255"));
    assert_eq!(agent.code(), 0);
    assert_eq!(agent.verdict().exit_code, Some(255));
    assert_eq!(
        fs::metadata(pod.checkpoint()).unwrap().permissions().mode() & 0o777,
        0o644
    );
    assert!(pod.has(AGENT, Mark::Done));
}

#[test]
fn grandchildren_that_ignore_sigterm_or_leave_the_group_are_killed() {
    let pod = pod();
    let (stubborn, escaped) = (pod.path("work/stubborn"), pod.path("work/escaped"));
    let sleeper = |path: &std::path::Path| {
        format!(
            "echo $$ > {}.new; mv {0}.new {0}; sleep 1000; sleep 1000",
            path.display()
        )
    };
    let script = format!(
        "(sh -c 'trap \"\" TERM; {}' &) ; (setsid sh -c 'trap \"\" TERM; {}' > /dev/null 2>&1 &); \
         until [ -e {} ] && [ -e {} ]; do sleep 0.02; done; echo '{COMPLETE}' > $CHECKPOINT",
        sleeper(&stubborn),
        sleeper(&escaped),
        stubborn.display(),
        escaped.display()
    );
    let mut agent = pod.agent_running(&["sh", "-c", &script], &[]);
    assert_eq!(agent.code(), 0, "{}", agent.stderr());
    for path in [stubborn, escaped] {
        assert!(!lives(pid_in(&path)), "{} lives", path.display());
    }
}

#[test]
fn every_usual_stop_signal_stops_it() {
    for signal in [Signal::SIGTERM, Signal::SIGINT, Signal::SIGQUIT, Signal::SIGHUP] {
        let pod = Pod::new();
        let mut agent = pod.agent("exit 0");
        // Its signals are handled before it writes its first verdict.
        until("the first verdict", || {
            !fs::read_to_string(pod.path("agent-1.termination")).unwrap().is_empty()
        });
        agent.signal(signal);
        assert_eq!(agent.code(), 143, "{signal}");
    }
}

#[test]
fn the_command_line_answers_without_a_job() {
    let run = |arguments: &[&str]| {
        let output = Command::new(env!("CARGO_BIN_EXE_leaderboard-runner"))
            .args(arguments)
            .output()
            .unwrap();
        let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
        (output.status.code().unwrap(), text(output.stdout), text(output.stderr))
    };
    let (code, stdout, stderr) = run(&[]);
    assert_eq!((code, stdout.as_str()), (64, ""));
    assert!(stderr.contains("no arguments") && stderr.contains("usage:"), "{stderr}");
    let version = format!("leaderboard-runner {}\n", env!("CARGO_PKG_VERSION"));
    assert_eq!(run(&["--version"]), (0, version, String::new()));
    assert_eq!(run(&["agent", "--pair", "1", "--", "x"]).0, 64);
    assert!(run(&["--help"]).1.starts_with("usage:"));
}

#[test]
fn a_closed_stdout_does_not_stop_the_agent() {
    let pod = pod();
    let (output, stdout) = std::io::pipe().unwrap();
    drop(output);
    let script = format!("echo one; echo two; echo '{COMPLETE}' > $CHECKPOINT");
    let mut agent = pod.agent_printing(&["sh", "-c", &script], &[], Stdio::from(stdout));
    assert_eq!(agent.code(), 0, "{}", agent.stderr());
    let mut expected = Vec::new();
    writeln!(expected, "one\ntwo").unwrap();
    assert_eq!(fs::read(pod.log()).unwrap(), expected);
}
