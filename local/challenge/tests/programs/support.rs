//! Runs the real programs in a folder of their own. Used by the tests beside it.

use std::{
    fs,
    io::{BufRead, BufReader, Lines},
    path::{Path, PathBuf},
    process::{Child, ChildStdout, Command, ExitStatus, Stdio},
    sync::atomic::{AtomicUsize, Ordering},
};

use serde_json::Value;

static NUMBER: AtomicUsize = AtomicUsize::new(0);

/// A folder that goes away with the test.
pub(crate) struct Folder(PathBuf);

impl Folder {
    pub(crate) fn new() -> Self {
        let number = NUMBER.fetch_add(1, Ordering::Relaxed);
        let path = std::env::temp_dir().join(format!("challenge-{}-{number}", std::process::id()));
        fs::create_dir_all(&path).unwrap();
        Self(path)
    }

    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }

    pub(crate) fn read(&self, name: &str) -> String {
        fs::read_to_string(self.path(name)).unwrap()
    }

    /// The agent's checkpoint.
    pub(crate) fn checkpoint(&self) -> Value {
        serde_json::from_str(&self.read("agent_results.json")).unwrap()
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

/// A program whose output is read line by line; killed with the test.
pub(crate) struct Program {
    child: Child,
    lines: Lines<BufReader<ChildStdout>>,
}

impl Program {
    fn start(command: &mut Command) -> Self {
        let mut child = command.stdout(Stdio::piped()).spawn().unwrap();
        let lines = BufReader::new(child.stdout.take().unwrap()).lines();
        Self { child, lines }
    }

    /// Reads until a line holds `text`; that line.
    pub(crate) fn until(&mut self, text: &str) -> String {
        let found = self.lines.find(|line| line.as_ref().unwrap().contains(text));
        found
            .unwrap_or_else(|| panic!("the program ended without `{text}`"))
            .unwrap()
    }

    pub(crate) fn kill(mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }

    /// All further output, and how it ended.
    pub(crate) fn end(mut self) -> (String, ExitStatus) {
        let rest: Vec<_> = self.lines.by_ref().map(Result::unwrap).collect();
        (rest.join("\n"), self.child.wait().unwrap())
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A simulator on a port of its own, ready.
pub(crate) struct Simulator {
    pub(crate) program: Program,
    pub(crate) port: u16,
}

pub(crate) fn simulator(folder: &Folder, knobs: &str) -> Simulator {
    let mut command = Command::new(env!("CARGO_BIN_EXE_challenge-simulator"));
    command.args(["-vulkan", "-RenderOffScreen", "-nosound", "-carla-rpc-port=0"]);
    command
        .env("SIM_START_MS", "0")
        .env("SIM_KNOBS", knobs)
        .env("CARLA_SAVED", folder.path("Saved"));
    let mut program = Program::start(&mut command);
    let line = program.until("listening on");
    let port = line.rsplit(':').next().unwrap().parse().unwrap();
    Simulator { program, port }
}

pub(crate) fn contents(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("contents").join(path)
}

/// The agent's command as the operator gives it, for the routes of `subset`.
pub(crate) struct Agent<'a> {
    pub(crate) folder: &'a Folder,
    pub(crate) port: u16,
    pub(crate) subset: &'a str,
    pub(crate) resume: &'a str,
    pub(crate) knobs: &'a str,
    pub(crate) v1: bool,
}

impl Agent<'_> {
    pub(crate) fn command(&self) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_challenge-agent"));
        let agent = self.folder.path("agent.py");
        fs::write(&agent, "").unwrap();
        let script = contents("leaderboard/leaderboard/leaderboard_evaluator.py");
        command.arg("-u").arg(script).arg(format!("--port={}", self.port));
        let routes = contents("leaderboard/data/routes_testing.xml");
        if self.v1 {
            let scenarios = contents("leaderboard/data/all_towns_traffic_scenarios_private.json");
            command
                .arg("--trafficManagerPort=2010")
                .arg(format!("--scenarios={}", scenarios.display()));
        } else {
            let live = self.folder.path("live_results.txt");
            command
                .arg("--traffic-manager-port=2010")
                .arg(format!("--debug-checkpoint={}", live.display()));
        }
        command
            .arg(format!("--agent={}", agent.display()))
            .args(["--agent-config=", "--track=SENSORS", "--record=/nowhere", "--debug=0"])
            .arg(format!("--routes={}", routes.display()))
            .arg(format!("--routes-subset={}", self.subset))
            .arg(format!("--repetitions={}", if self.v1 { 2 } else { 1 }))
            .arg(format!("--resume={}", self.resume))
            .arg(format!(
                "--checkpoint={}",
                self.folder.path("agent_results.json").display()
            ));
        let path = [
            contents("CARLA/PythonAPI/carla"),
            contents("scenario_runner"),
            contents("leaderboard"),
        ];
        command.env("PYTHONPATH", std::env::join_paths(path).unwrap());
        command
            .env("ROUTE_MS", "20")
            .env("AGENT_KNOBS", self.knobs)
            .env_remove("CHALLENGE_FORMAT");
        command
    }

    pub(crate) fn start(&self) -> Program {
        Program::start(&mut self.command())
    }

    pub(crate) fn run(&self) -> ExitStatus {
        self.start().end().1
    }
}
