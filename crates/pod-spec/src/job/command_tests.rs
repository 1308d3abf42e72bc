//! The default commands, run as they are: Kubernetes' expansion, then the runner's own code, then a real bash with a fake
//! `python3` or `cp` in front of its PATH.

use std::collections::BTreeMap;
use std::ffi::{OsStr, OsString};
use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::time::Duration;

use serde_json::{Value, json};

use super::tests::{Case, container};
use leaderboard_api::Attempt;
use leaderboard_evaluation::workload::literal;
use leaderboard_runner::{args, expand, graphics};

/// A word as the kubelet hands it on (k8s.io/kubernetes/third_party/forked/golang/expansion).
pub(super) fn kubernetes_expand(word: &str, lookup: &dyn Fn(&str) -> Option<String>) -> String {
    let mut out = String::new();
    let mut rest = word;
    while let Some(at) = rest.find('$') {
        out.push_str(&rest[..at]);
        rest = &rest[at + 1..];
        if let Some(after) = rest.strip_prefix('$') {
            out.push('$');
            rest = after;
        } else if let Some((name, after)) = rest.strip_prefix('(').and_then(|inner| inner.split_once(')')) {
            out.push_str(&lookup(name).unwrap_or_else(|| format!("$({name})")));
            rest = after;
        } else {
            out.push('$');
            let first = rest.chars().next().map_or(0, char::len_utf8);
            out.push_str(&rest[..first]);
            rest = &rest[first..];
        }
    }
    out + rest
}

/// A container as the kubelet starts it: its words and its variables, `image` being those of its image.
pub(super) fn started(container: &Value, image: &[(&str, &str)]) -> (Vec<String>, BTreeMap<String, String>) {
    let mut env: BTreeMap<String, String> = image
        .iter()
        .map(|(name, value)| ((*name).into(), (*value).into()))
        .collect();
    let mut pods = BTreeMap::new();
    for variable in container["env"].as_array().map(Vec::as_slice).unwrap_or_default() {
        let value = variable["value"].as_str().unwrap_or_default();
        let value = kubernetes_expand(value, &|name| pods.get(name).cloned());
        pods.insert(variable["name"].as_str().unwrap().to_owned(), value);
    }
    let words = container["command"].as_array().unwrap().iter();
    let words = words
        .map(|word| kubernetes_expand(word.as_str().unwrap(), &|name| pods.get(name).cloned()))
        .collect();
    env.extend(pods);
    (words, env)
}

/// The job that the runner parses from its words, and the command that it starts. `env` becomes that command's variables.
pub(super) fn behind_runner(words: &[String], env: &mut BTreeMap<String, String>) -> (args::Job, Vec<String>) {
    assert_eq!(words[0], "/leaderboard-tools/leaderboard-runner");
    let args::Request::Run(job) = args::parse(words[1..].iter().map(OsString::from)).unwrap() else {
        panic!("{words:?} asks for nothing to run");
    };
    if let Some(front) = &job.python_path {
        let image = env
            .get("PYTHONPATH")
            .map(|image| format!(":{image}"))
            .unwrap_or_default();
        env.insert("PYTHONPATH".into(), format!("{}{image}", front.to_str().unwrap()));
        let lookup = |name: &OsStr| env.get(name.to_str()?).map(OsString::from);
        let command = job
            .command
            .iter()
            .map(|word| expand::expand(word, lookup).into_string().unwrap())
            .collect();
        return (*job, command);
    }
    // As on a node where the pair sees all GPUs.
    let index = env
        .get(leaderboard_protocol::graphics::INDEX)
        .map_or(0, |index| index.parse().unwrap());
    let command = job
        .command
        .iter()
        .map(|word| graphics::with_adapter(word, index).into_string().unwrap())
        .collect();
    (*job, command)
}

/// The command that the runner keeps the output of, as it starts it.
fn behind_keeper(words: &[String]) -> Vec<String> {
    assert_eq!(words[0], "/leaderboard-tools/leaderboard-runner");
    let args::Request::Keep(kept) = args::parse(words[1..].iter().map(OsString::from)).unwrap() else {
        panic!("{words:?} keeps nothing");
    };
    assert_eq!(kept.log.to_str(), Some("/tmp/leaderboard-log/contents.log"));
    assert_eq!(kept.log_limit, 16 << 20);
    kept.command
        .into_iter()
        .map(|word| word.into_string().unwrap())
        .collect()
}

/// A home folder and a `bin` with one fake program that writes its arguments, and for python3 its variables, as lines.
struct Image {
    folder: PathBuf,
}

impl Image {
    fn new(test: &str) -> Self {
        let folder = std::env::temp_dir().join(format!("job-spec-{}-{test}", std::process::id()));
        fs::create_dir_all(folder.join("bin")).unwrap();
        Self { folder }
    }

    fn file(&self, name: &str, text: &str) -> &Self {
        let path = self.folder.join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, text).unwrap();
        self
    }

    fn program(&self, name: &str, text: &str) -> &Self {
        let path = format!("bin/{name}");
        self.file(&path, text);
        fs::set_permissions(self.folder.join(path), fs::Permissions::from_mode(0o755)).unwrap();
        self
    }

    fn run(&self, command: &[String], env: &BTreeMap<String, String>) -> Output {
        let path = format!("{}:/usr/bin:/bin", self.folder.join("bin").display());
        let mut bash = Command::new(&command[0]);
        bash.args(&command[1..])
            .env_clear()
            .envs(env)
            .env("HOME", &self.folder)
            .env("PATH", path);
        bash.current_dir(&self.folder).output().unwrap()
    }

    fn path(&self, name: &str) -> String {
        Path::new(&self.folder).join(name).to_str().unwrap().to_owned()
    }
}

impl Drop for Image {
    fn drop(&mut self) {
        // A folder that stays behind is in the temporary folder and does no harm.
        let _ = fs::remove_dir_all(&self.folder);
    }
}

const FAKE_PYTHON: &str = "#!/bin/sh\nprintf '%s\\n' \"$@\"\necho ---\nenv\n";

/// Arguments and variables that the fake python3 saw.
fn seen(output: &Output) -> (Vec<String>, BTreeMap<String, String>) {
    let text = String::from_utf8(output.stdout.clone()).unwrap();
    let (words, env) = text.split_once("---\n").unwrap_or_else(|| panic!("{output:?}"));
    let env = env.lines().filter_map(|line| line.split_once('='));
    (
        words.lines().map(Into::into).collect(),
        env.map(|(name, value)| (name.into(), value.into())).collect(),
    )
}

fn agent(
    case: &Case,
    pair: usize,
    image: &Image,
    variables: &[(&str, &str)],
) -> (Vec<String>, BTreeMap<String, String>) {
    let job = case.json();
    let (words, mut env) = started(container(&job, &format!("agent-{pair}")), variables);
    let (_, command) = behind_runner(&words, &mut env);
    seen(&image.run(&command, &env))
}

const TEAM: [(&str, &str); 2] = [("TEAM_AGENT", "/team/my agent.py"), ("TEAM_CONFIG", "/team/*.json")];

const V1: [&str; 15] = [
    "-u",
    "/workspace/leaderboard/leaderboard/leaderboard_evaluator.py",
    "--port=2100",
    "--trafficManagerPort=2110",
    "--agent=/team/my agent.py",
    "--agent-config=/team/*.json",
    "--track=SENSORS",
    "--routes=/workspace/leaderboard/data/routes_testing.xml",
    "--routes-subset=5-9",
    "--scenarios=/workspace/leaderboard/data/all_towns_traffic_scenarios_private.json",
    "--repetitions=5",
    "--resume=",
    "--checkpoint=/tmp/agent/agent_results.json",
    "--record=/home/carla/CarlaUE4/Saved",
    "--debug=0",
];
const V2: [&str; 15] = [
    "-u",
    "/workspace/leaderboard/leaderboard/leaderboard_evaluator.py",
    "--port=2100",
    "--traffic-manager-port=2110",
    "--agent=/team/my agent.py",
    "--agent-config=/team/*.json",
    "--track=SENSORS",
    "--routes=/workspace/leaderboard/data/routes_testing.xml",
    "--routes-subset=5-9",
    "--repetitions=1",
    "--resume=",
    "--checkpoint=/tmp/agent/agent_results.json",
    "--record=/home/carla/CarlaUE4/Saved",
    "--debug-checkpoint=/tmp/agent/live_results.txt",
    "--debug=0",
];
const FRONT: &str = "/workspace/CARLA/PythonAPI/carla:/workspace/scenario_runner:/workspace/leaderboard";

#[test]
fn the_evaluator_gets_the_originals_arguments() {
    for (format, expected) in [("V1", V1), ("V2", V2)] {
        let image = Image::new(&format!("plain-{format}"));
        image.program("python3", FAKE_PYTHON);
        let (words, env) = agent(&Case::new(format, json!({})), 2, &image, &TEAM);
        assert_eq!(words, expected, "{format}");
        assert_eq!(env["PYTHONPATH"], FRONT);
        let own = [
            ("CARLA_ROOT", "/workspace/CARLA"),
            ("SCENARIO_RUNNER_ROOT", "/workspace/scenario_runner"),
            ("NVIDIA_DRIVER_CAPABILITIES", "all"),
        ];
        for (name, value) in own {
            assert_eq!(env[name], value);
        }
        assert_eq!(env.contains_key("SCENARIOS"), format == "V1");
        assert_eq!(env.contains_key("DEBUG_CHECKPOINT_ENDPOINT"), format == "V2");
    }
}

#[test]
fn the_participants_files_set_the_agent_and_nothing_of_ours() {
    let forged = "export ROUTES=/mine.xml REPETITIONS=9 ROUTES_SUBSET=0-0 RESUME=1 CARLA_PORT=1 CHECKPOINT_ENDPOINT=/x LEADERBOARD_ROOT=/mine\n\
                  export TEAM_AGENT='/team/my agent.py' TEAM_CONFIG='/team/*.json' PYTHONPATH=/mine:$PYTHONPATH\n\
                  set -- --routes=/mine.xml; IFS=/; set -u\n";
    for (format, expected) in [("V1", V1), ("V2", V2)] {
        let image = Image::new(&format!("forged-{format}"));
        image
            .program("python3", FAKE_PYTHON)
            .file(".bashrc", "export FROM_BASHRC=1\n")
            .file("agent_sources.sh", forged);
        let (words, env) = agent(&Case::new(format, json!({})), 2, &image, &[("TEAM_AGENT", "/image.py")]);
        assert_eq!(words, expected, "{format}");
        assert_eq!(env["FROM_BASHRC"], "1");
        assert_eq!(env["PYTHONPATH"], format!("{FRONT}:/mine:{FRONT}"));
    }
}

#[test]
fn the_images_python_path_comes_behind_ours() {
    let image = Image::new("path");
    image.program("python3", FAKE_PYTHON);
    let variables = [("TEAM_AGENT", "/a.py"), ("PYTHONPATH", "/carla.egg:/lib")];
    let (words, env) = agent(&Case::new("V1", json!({})), 1, &image, &variables);
    assert_eq!(env["PYTHONPATH"], format!("{FRONT}:/carla.egg:/lib"));
    assert!(words.contains(&"--agent-config=".to_owned()));
}

#[test]
fn a_resumed_attempt_sets_resume() {
    let image = Image::new("resume");
    image.program("python3", FAKE_PYTHON);
    let mut case = Case::new("V2", json!({}));
    case.number.attempt = Attempt(2);
    let (words, env) = agent(&case, 1, &image, &TEAM);
    assert!(words.contains(&"--resume=1".to_owned()));
    assert_eq!(env["RESUME"], "1");
}

#[test]
fn an_image_without_an_agent_shows_what_is_missing() {
    let image = Image::new("nobody");
    image.program("python3", FAKE_PYTHON);
    let job = Case::new("V2", json!({})).json();
    let (words, mut env) = started(container(&job, "agent-1"), &[]);
    let (_, command) = behind_runner(&words, &mut env);
    let output = image.run(&command, &env);
    assert!(!output.status.success());
    assert!(output.stdout.is_empty());
    assert!(
        String::from_utf8_lossy(&output.stderr).contains("the image must set TEAM_AGENT"),
        "{output:?}"
    );
}

#[test]
fn the_evaluators_exit_code_is_the_commands() {
    let image = Image::new("code");
    image.program("python3", "#!/bin/sh\nexit 7\n");
    let job = Case::new("V1", json!({})).json();
    let (words, mut env) = started(container(&job, "agent-1"), &TEAM);
    let (_, command) = behind_runner(&words, &mut env);
    assert_eq!(image.run(&command, &env).status.code(), Some(7));
}

#[test]
fn the_runner_gets_the_deadlines() {
    let deadlines = json!({"readySeconds": 60, "idleSeconds": 30, "flushSeconds": 50, "cancelSeconds": 40});
    let job = Case::new("V2", json!({"deadlines": deadlines, "agent": {"logSizeLimit": "2Mi"}})).json();
    let (words, mut env) = started(container(&job, "simulator-3"), &[]);
    let (simulator, command) = behind_runner(&words, &mut env);
    let seconds = Duration::from_secs;
    assert_eq!(
        (simulator.member().to_string().as_str(), simulator.ready),
        ("simulator-3", seconds(60))
    );
    assert_eq!(simulator.status, Path::new("/tmp/status"));
    assert_eq!((simulator.part, simulator.port), (args::Part::Simulator, Some(2200)));
    assert_eq!(
        [simulator.answer, simulator.flush, simulator.cancel],
        [10, 50, 40].map(seconds)
    );
    assert_eq!(simulator.log, Some("/home/carla/CarlaUE4/Saved/console-3.log".into()));
    let gpu = Some(leaderboard_protocol::graphics::Needs::Vulkan);
    assert_eq!((simulator.gpu, simulator.agent_gpu), (gpu, false));
    assert_eq!(simulator.unset, ["DISPLAY", "XAUTHORITY"]);
    assert_eq!(simulator.log_limit, 64 << 20);
    assert_eq!(
        command,
        [
            "/bin/bash",
            "/home/carla/CarlaUE4.sh",
            "-vulkan",
            "-carla-rpc-port=2200",
            "-RenderOffScreen",
            "-nosound",
            "-ini:[/Script/Engine.RendererSettings]:r.GraphicsAdapter=2",
        ]
    );
    let (words, mut env) = started(container(&job, "agent-3"), &[]);
    let (agent, _) = behind_runner(&words, &mut env);
    assert_eq!(agent.member().to_string(), "agent-3");
    assert_eq!((agent.part, agent.route_runs), (args::Part::Driver, Some(5)));
    assert_eq!(agent.checkpoint, Some("/tmp/agent/agent_results.json".into()));
    assert_eq!(agent.python_path, Some(FRONT.into()));
    assert_eq!((agent.idle, agent.agent_gpu), (Some(seconds(30)), false));
    let log = Some("/tmp/agent/leaderboard.log".into());
    assert_eq!((agent.log, agent.log_limit), (log, 2_097_152));
}

#[test]
fn leaderboard_1_draws_with_opengl() {
    let job = Case::new("V1", json!({})).json();
    let (words, mut env) = started(container(&job, "simulator-1"), &[]);
    let (_, command) = behind_runner(&words, &mut env);
    assert_eq!(
        command,
        [
            "/bin/bash",
            "/home/carla/CarlaUE4.sh",
            "-carla-rpc-port=2000",
            "-opengl",
            "-nosound"
        ]
    );
}

#[test]
fn a_hosts_command_stands_behind_the_same_runner() {
    let own = |words: Value| json!({"command": words, "args": ["$(RESUME)", "$$(date) $$ $HOME"], "image": "x"});
    let job = Case::new(
        "V2",
        json!({"agent": own(json!(["/run", "--port=$(CARLA_PORT)"])), "evaluation": {"carla": {"simulator": own(json!(["/sim", "$(CARLA_PORT)"])), "contents": own(json!(["/fill"]))}}}),
    )
    .json();
    let (words, mut env) = started(container(&job, "agent-1"), &[]);
    env.insert("RESUME".into(), "1".into());
    let (_, command) = behind_runner(&words, &mut env);
    // The runner knows the round: Kubernetes' own RESUME would still be empty.
    assert_eq!(command, ["/run", "--port=2000", "1", "$(date) $$ $HOME"]);
    let (words, mut env) = started(container(&job, "simulator-2"), &[]);
    let (_, command) = behind_runner(&words, &mut env);
    assert_eq!(command, ["/sim", "2100", "$(RESUME)", "$(date) $ $HOME"]);
    let (words, _) = started(container(&job, "contents"), &[]);
    assert_eq!(behind_keeper(&words), ["/fill", "", "$(date) $ $HOME"]);
}

#[test]
fn the_contents_are_copied_as_the_original_does() {
    let image = Image::new("contents");
    image.program("cp", "#!/bin/sh\nprintf '%s\\n' \"$*\"\n");
    for name in [
        "lb/leaderboard/a.py",
        "lb/data/r.xml",
        "sr/srunner/b.py",
        "carla/PythonAPI/c.py",
    ] {
        image.file(name, "");
    }
    let roots = ["lb", "sr", "carla"].map(|name| image.path(name));
    let names = ["LEADERBOARD_ROOT", "SCENARIO_RUNNER_ROOT", "CARLA_PYTHON_API_ROOT"];
    let variables: Vec<(&str, &str)> = names.into_iter().zip(roots.iter().map(String::as_str)).collect();
    let job = Case::new("V2", json!({})).json();
    let (command, env) = started(container(&job, "contents"), &variables);
    let output = image.run(&behind_keeper(&command), &env);
    let [lb, sr, carla] = &roots;
    let expected = format!(
        "-r {lb}/data {lb}/leaderboard /tmp/leaderboard/\n-r {sr}/srunner /tmp/scenario_runner/\n-r {carla}/PythonAPI /tmp/CARLA/\n"
    );
    assert_eq!(String::from_utf8_lossy(&output.stdout), expected, "{output:?}");
    assert!(output.status.success());
}

#[test]
fn contents_that_are_missing_or_not_copied_end_the_container() {
    let image = Image::new("no-contents");
    let job = Case::new("V1", json!({})).json();
    image.program("cp", "#!/bin/sh\necho copied\n");
    let (command, mut env) = started(
        container(&job, "contents"),
        &[("LEADERBOARD_ROOT", "/a"), ("SCENARIO_RUNNER_ROOT", "")],
    );
    let command = behind_keeper(&command);
    let output = image.run(&command, &env);
    assert!(!output.status.success());
    assert!(output.stdout.is_empty(), "the whole file system would have been copied");
    assert!(
        String::from_utf8_lossy(&output.stderr).contains("SCENARIO_RUNNER_ROOT"),
        "{output:?}"
    );
    image.program("cp", "#!/bin/sh\necho copied\nexit 3\n");
    env.extend([
        ("SCENARIO_RUNNER_ROOT".into(), "/b".into()),
        ("CARLA_PYTHON_API_ROOT".into(), "/c".into()),
    ]);
    let output = image.run(&command, &env);
    assert_eq!(output.status.code(), Some(3));
    assert_eq!(output.stdout, b"copied\n");
}

#[test]
fn every_word_gets_past_kubernetes_unchanged() {
    let alphabet = ['$', '(', ')', 'X'];
    let mut words = vec![String::new()];
    for _ in 0..7 {
        words = words
            .iter()
            .flat_map(|word| alphabet.map(|letter| format!("{word}{letter}")))
            .chain([String::new()])
            .collect();
    }
    assert!(words.len() > 16_000);
    for word in words {
        let written = literal(&word);
        assert_eq!(
            kubernetes_expand(&written, &|_| Some("expanded".into())),
            word,
            "{written}"
        );
    }
}
