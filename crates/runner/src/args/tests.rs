//! Command lines, and what each becomes.

use std::path::Path;

use super::*;

const PAIR: Pair = Pair::new(3).unwrap();

fn parse_line(line: &str) -> Result<Request, UsageError> {
    parse(line.split_whitespace().map(OsString::from))
}

fn job(line: &str) -> Job {
    match parse_line(line).unwrap() {
        Request::Run(job) => *job,
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_simulator_has_its_defaults() {
    let job = job("simulator --pair 2 --status /s --port=2100 -- ./server --pair 9 -- x");
    assert_eq!(job.member().to_string(), "simulator-2");
    let flush = Duration::from_mins(30);
    assert_eq!(
        (job.part, job.port, job.answer),
        (Part::Simulator, Some(2100), Duration::from_secs(10))
    );
    assert_eq!(
        (job.flush, job.cancel, &job.log),
        (flush, Duration::from_mins(2), &None)
    );
    assert_eq!((job.gpu, job.agent_gpu, job.unset), (None, false, Vec::new()));
    assert_eq!(job.termination_log, PathBuf::from("/dev/termination-log"));
    assert_eq!((job.log_limit, job.inotify), (2 << 30, true));
    assert_eq!(
        [job.ready, job.grace, job.peer].map(|time| time.as_secs()),
        [3600, 20, 600]
    );
    assert_eq!(job.command, ["./server", "--pair", "9", "--", "x"]);
}

#[test]
fn a_simulator_has_a_gpu_and_loses_variables() {
    let line = "simulator --pair 1 --status /s --port 1 --gpu=vulkan --agent-gpu=true --unset=DISPLAY,XAUTHORITY --root /r -- a";
    let job = job(line);
    assert_eq!(
        (job.gpu, job.agent_gpu, job.root),
        (Some(Needs::Vulkan), true, "/r".into())
    );
    assert_eq!(job.unset, ["DISPLAY", "XAUTHORITY"]);
}

#[test]
fn an_agent_has_its_defaults_and_options() {
    let line = "agent --pair 1 --status /s --checkpoint /w/c.json";
    let first = job(&format!("{line} -- a"));
    let log = |folder: &str| Some(Path::new(folder).join("leaderboard.log"));
    assert_eq!((first.part, first.checkpoint), (Part::Driver, Some("/w/c.json".into())));
    assert_eq!((first.log, first.log_limit), (log(WORK), 2 << 30));
    assert_eq!((first.idle, first.agent_gpu), (Some(Duration::from_secs(800)), false));
    assert_eq!((first.python_path, first.route_runs), (None, None));
    let more = job(&format!(
        "{line} --work /w --idle-seconds 3 --log-limit 9 --python-path=/a:/b --report-gpu=true --route-runs 5 -- a"
    ));
    assert_eq!((more.log, more.log_limit), (log("/w"), 9));
    assert_eq!((more.idle, more.agent_gpu), (Some(Duration::from_secs(3)), true));
    assert_eq!((more.python_path, more.route_runs), (Some("/a:/b".into()), Some(5)));
}

#[test]
fn an_evaluator_has_its_defaults_and_options() {
    let line = "evaluator --pair 3 --status /s --results /r";
    let first = job(&format!("{line} -- a"));
    assert_eq!(
        (first.member(), first.peer()),
        (PAIR.host(Host::Evaluator), PAIR.agent())
    );
    assert_eq!(
        (first.part, first.port, first.answer),
        (Part::Evaluator, None, Duration::from_mins(10))
    );
    assert_eq!((first.result(), &first.after), (Some("/r/result.json".into()), &None));
    assert_eq!([first.ready, first.grace].map(|time| time.as_secs()), [3600, 30]);
    let more = job(&format!(
        "{line} --port=9000 --answer-seconds 7 --after /others --log /r/c.log --gpu=any -- a"
    ));
    assert_eq!(
        (more.port, more.answer, more.gpu),
        (Some(9000), Duration::from_secs(7), Some(Needs::Any))
    );
    assert_eq!(
        (more.log, more.after),
        (Some("/r/c.log".into()), Some("/others".into()))
    );
}

#[test]
fn an_evaluators_agent_is_a_plain_program() {
    let job = job("agent --pair 3 --status /s --host=evaluator --idle-seconds 3 -- a");
    assert_eq!((job.member(), job.peer()), (PAIR.agent(), PAIR.host(Host::Evaluator)));
    assert_eq!(
        (job.part, job.idle, job.leaves),
        (Part::Plain, Some(Duration::from_secs(3)), None)
    );
    assert_eq!(
        (job.checkpoint, job.agent_gpu, job.grace),
        (None, false, Duration::from_secs(20))
    );
}

#[test]
fn each_mistake_is_named() {
    let cases = [
        ("", "no arguments"),
        (
            "monitor",
            "unknown subcommand \"monitor\": simulator, evaluator, agent, keep or copy",
        ),
        ("simulator --status /s --port 1 -- a", "--pair is missing"),
        (
            "simulator --pair 0 --status /s --port 1 -- a",
            "--pair: \"0\" is not a number from 1 to 999",
        ),
        (
            "simulator --pair 1 --status /s --port 0 -- a",
            "--port: \"0\" is not a port from 1 to 65535",
        ),
        (
            "simulator --pair 1 --pair 2 --status /s --port 1 -- a",
            "--pair is given twice",
        ),
        (
            "simulator --pair 1 --status /s --port 1 --idle-seconds 3 -- a",
            "unknown option --idle-seconds",
        ),
        (
            "simulator --pair 1 --status /s --port 1 --grace-seconds -1 -- a",
            "--grace-seconds: \"-1\" is not a number of seconds",
        ),
        (
            "simulator --pair 1 --status= --port 1 -- a",
            "--status: \"\" is not a path",
        ),
        ("simulator --pair 1 --status /s --port", "--port needs a value"),
        (
            "simulator --pair 1 --status /s --port 1 --inotify off -- a",
            "--inotify: \"off\" is not true or false",
        ),
        (
            "simulator --pair 1 --status /s --port 1 --gpu directx -- a",
            "--gpu: \"directx\" is not any, vulkan or opengl",
        ),
        (
            "simulator --pair 1 --status /s --port 1",
            "the command after -- is missing",
        ),
        (
            "simulator --pair 1 --status /s --port 1 --",
            "the command after -- is missing",
        ),
        ("simulator run --pair 1", "unknown option run"),
        ("simulator --pair 1 --status /s -- a", "--port is missing"),
        ("agent --pair 1 --status /s --work /w -- a", "--checkpoint is missing"),
        ("evaluator --pair 1 --status /s --port 1 -- a", "--results is missing"),
        (
            "evaluator --pair 1 --status /s --results /r --port 0 -- a",
            "--port: \"0\" is not a port from 1 to 65535",
        ),
        (
            "simulator --pair 1 --status /s --port 1 --alone -- a",
            "unknown option --alone",
        ),
        (
            "agent --pair 1 --status /s --checkpoint /c --alone -- a",
            "unknown option --alone",
        ),
        (
            "evaluator --pair 1 --status /s --results /r --alone=2 -- a",
            "--alone: \"2\" is not true or false",
        ),
        (
            "agent --pair 1 --status /s --host evaluator --leaves /l -- a",
            "unknown option --leaves",
        ),
        (
            "simulator --pair 1 --status /s --port 1 --after /r -- a",
            "unknown option --after",
        ),
        (
            "evaluator --pair 1 --status /s --results /r --alone --leaves /l -- a",
            "unknown option --leaves",
        ),
        (
            "agent --pair 1 --status /s --host evaluators -- a",
            "--host: \"evaluators\" is not simulator or evaluator",
        ),
        (
            "agent --pair 1 --status /s --host evaluator --checkpoint /c -- a",
            "unknown option --checkpoint",
        ),
        (
            "agent --pair 1 --status /s --host evaluator --route-runs 2 -- a",
            "unknown option --route-runs",
        ),
    ];
    for (line, message) in cases {
        assert_eq!(parse_line(line).unwrap_err().to_string(), message, "{line}");
    }
}

#[test]
fn a_command_may_be_kept_alone() {
    let parsed = |line: &str| parse(line.split_whitespace().map(OsString::from));
    let kept = |log_limit| Kept {
        log: "/l/c.log".into(),
        log_limit,
        command: ["/bin/bash", "-c", "x"].map(OsString::from).to_vec(),
    };
    assert_eq!(
        parsed("keep --log=/l/c.log -- /bin/bash -c x"),
        Ok(Request::Keep(kept(2 << 30)))
    );
    assert_eq!(
        parsed("keep --log /l/c.log --log-limit 9 -- /bin/bash -c x"),
        Ok(Request::Keep(kept(9)))
    );
    assert_eq!(parsed("keep -- a"), Err(UsageError::Missing("--log")));
    assert_eq!(parsed("keep --log=/l --"), Err(UsageError::NoCommand));
    assert_eq!(
        parsed("keep --log=/l --pair=1 -- a"),
        Err(UsageError::Unknown("--pair".into()))
    );
}

#[test]
fn an_evaluator_and_its_agent_may_be_alone() {
    for line in [
        "evaluator --pair 1 --status /s --results /r",
        "agent --pair 1 --status /s --host evaluator",
    ] {
        for (option, alone) in [
            ("", false),
            ("--alone", true),
            ("--alone=true", true),
            ("--alone=false", false),
        ] {
            assert_eq!(job(&format!("{line} {option} -- a")).alone, alone, "{line} {option}");
        }
    }
}

#[test]
fn an_agent_that_is_alone_may_leave_files() {
    let line = "agent --pair 1 --status /s --host evaluator --alone";
    for (option, expected) in [("", None), ("--leaves=/l", Some("/l")), ("--leaves /l", Some("/l"))] {
        let leaves = job(&format!("{line} {option} -- a")).leaves;
        assert_eq!(leaves, expected.map(PathBuf::from), "{option}");
    }
}

#[test]
fn a_folder_is_copied_without_a_command() {
    let copied = |termination_log: &str| {
        Ok(Request::Copy(Copied {
            from: "/d".into(),
            to: "/t".into(),
            termination_log: termination_log.into(),
        }))
    };
    assert_eq!(parse_line("copy --from=/d --to /t"), copied("/dev/termination-log"));
    assert_eq!(
        parse_line("copy --from=/d --to=/t --termination-log=/l --"),
        copied("/l")
    );
    for (line, message) in [
        ("copy --from=/d", "--to is missing"),
        ("copy --to=/d --from=", "--from: \"\" is not a path"),
        ("copy --from=/d --to=/t --pair=1", "unknown option --pair"),
        ("copy --from=/d --to=/t -- a", "unknown option a"),
    ] {
        assert_eq!(parse_line(line).unwrap_err().to_string(), message, "{line}");
    }
}

#[test]
fn version_and_help_are_asked_for() {
    assert_eq!(parse_line("--version").unwrap(), Request::Version);
    assert_eq!(parse_line("--help").unwrap(), Request::Help);
}
