//! A namespace of the API server, a person at a terminal who runs the plugin there, and statuses as the operator writes them.

use std::path::{Path, PathBuf};
use std::process::{Output, Stdio};

use kube::api::{DynamicObject, Patch, PatchParams};
use kube::{Api, Client};
use serde_json::{Value, json};
use tokio::io::{AsyncBufReadExt, BufReader, Lines};
use tokio::process::{Child, ChildStdout, Command};
use tokio::time::timeout;

use crate::api::bridge::LIMIT;
use crate::api::objects::{Kind, create, merge};
use crate::support::apiserver::{ApiServer, server};

const TIME: &str = "2026-11-01T10:00:00Z";

/// The plugin's program, next to the operator's: cargo builds it for the tests of its own package.
pub fn plugin() -> PathBuf {
    let program = Path::new(env!("CARGO_BIN_EXE_leaderboard-operator")).with_file_name("kubectl-leaderboard");
    assert!(
        program.exists(),
        "{} is missing: run cargo build --workspace --bins",
        program.display()
    );
    program
}

/// A namespace, and a person at a terminal.
pub struct Terminal {
    pub server: &'static ApiServer,
    pub client: Client,
    pub namespace: String,
    pub kubeconfig: PathBuf,
}

impl Terminal {
    pub async fn new() -> Self {
        let server = server().await;
        Self {
            server,
            client: server.client(),
            namespace: server.namespace("plugin").await,
            kubeconfig: kubeconfig(server),
        }
    }

    pub fn api(&self, kind: Kind) -> Api<DynamicObject> {
        kind.api(&self.client, &self.namespace)
    }

    /// A Leaderboard `local` that is Ready, with this spec laid over it.
    pub async fn leaderboard(&self, spec: &Value) {
        let api = self.api(Kind::Leaderboard);
        let object = Kind::Leaderboard.object("local", &[&json!({"spec": spec})]);
        create(&api, object, false).await.unwrap();
        self.status(
            Kind::Leaderboard,
            "local",
            &json!({"conditions": [condition("Ready", "True", "Ready")]}),
        )
        .await;
    }

    pub async fn submission(&self, name: &str, spec: &Value, status: &Value) {
        let api = self.api(Kind::Submission);
        let object = Kind::Submission.object(name, &[&json!({"spec": spec})]);
        create(&api, object, false).await.unwrap();
        self.status(Kind::Submission, name, status).await;
    }

    pub async fn status(&self, kind: Kind, name: &str, status: &Value) {
        let patch = Patch::Merge(json!({ "status": status }));
        let patched = self.api(kind).patch_status(name, &PatchParams::default(), &patch).await;
        patched.unwrap();
    }

    /// Attempt and cancel of a submission as they are stored.
    pub async fn requested(&self, name: &str) -> (i64, bool) {
        let object = self.api(Kind::Submission).get(name).await.unwrap();
        let spec = &object.data["spec"];
        (spec["attempt"].as_i64().unwrap(), spec["cancel"].as_bool().unwrap())
    }

    pub fn command(&self, arguments: &[&str]) -> Command {
        let mut command = Command::new(plugin());
        command
            .env("KUBECONFIG", &self.kubeconfig)
            .args(arguments)
            .args(["--namespace", &self.namespace])
            .stdin(Stdio::null())
            .kill_on_drop(true);
        command
    }

    pub async fn run(&self, arguments: &[&str]) -> Printed {
        Printed::of(&ended(&mut self.command(arguments)).await)
    }

    /// Runs a command with the kubeconfig of a person, who has few rights.
    pub async fn run_as(&self, person: &Path, arguments: &[&str]) -> Printed {
        let mut command = self.command(arguments);
        Printed::of(&ended(command.arg("--kubeconfig").arg(person)).await)
    }

    pub fn waits(&self, arguments: &[&str]) -> Waits {
        Waits::start(&mut self.command(arguments))
    }
}

/// The output of a command.
#[derive(Debug)]
pub struct Printed {
    pub code: Option<i32>,
    pub out: String,
    pub err: String,
}

impl Printed {
    pub fn of(output: &Output) -> Self {
        let text = |bytes: &[u8]| String::from_utf8(bytes.to_vec()).unwrap();
        Self {
            code: output.status.code(),
            out: text(&output.stdout),
            err: text(&output.stderr),
        }
    }

    /// Its output, if it succeeded.
    pub fn well(self) -> String {
        assert_eq!((self.code, self.err.as_str()), (Some(0), ""), "{self:?}");
        for line in self.out.lines() {
            assert!(line.chars().count() <= 100, "{line}");
        }
        self.out
    }

    /// Its one line, if it failed.
    pub fn refused(self) -> String {
        assert_eq!((self.code, self.out.as_str()), (Some(1), ""), "{self:?}");
        assert_eq!(self.err.lines().count(), 1, "{}", self.err);
        let text = self.err.strip_prefix("kubectl leaderboard: ");
        text.expect("it begins with the program's name").trim_end().to_owned()
    }
}

/// A command that waits.
pub struct Waits {
    pub child: Child,
    pub lines: Lines<BufReader<ChildStdout>>,
}

impl Waits {
    pub fn start(command: &mut Command) -> Self {
        let mut child = command.stdout(Stdio::piped()).spawn().unwrap();
        let lines = BufReader::new(child.stdout.take().unwrap()).lines();
        Self { child, lines }
    }

    /// Reads until a line contains this text.
    pub async fn until(&mut self, text: &str) {
        let found = async {
            while let Some(line) = self.lines.next_line().await.unwrap() {
                if line.contains(text) {
                    return true;
                }
            }
            false
        };
        assert!(timeout(LIMIT, found).await.expect(text), "it ended without {text}");
    }

    pub async fn code(mut self) -> Option<i32> {
        timeout(LIMIT, self.child.wait())
            .await
            .expect("it ends")
            .unwrap()
            .code()
    }
}

pub async fn ended(command: &mut Command) -> Output {
    timeout(LIMIT, command.output()).await.expect("it ends").unwrap()
}

pub fn kubeconfig(server: &ApiServer) -> PathBuf {
    let kubectl = server.kubectl();
    let mut variables = kubectl.get_envs();
    let found = variables.find(|(name, _)| *name == "KUBECONFIG").unwrap();
    found.1.unwrap().into()
}

pub fn condition(type_: &str, truth: &str, reason: &str) -> Value {
    json!({"type": type_, "status": truth, "reason": reason, "message": "", "lastTransitionTime": TIME})
}

pub fn evalai(submission: i64) -> Value {
    json!({"track": null, "evalai": {"challenge": 3, "phase": 7, "submission": submission}})
}

pub fn waiting() -> Value {
    json!({
        "state": "Pending", "attempt": 1, "reason": "WaitingForSlot", "message": "All slots are in use.",
        "track": "sensors", "waiting": {"position": 3, "etaMinSeconds": 1200, "etaMaxSeconds": 2100, "text": "3rd, 20-35 min"},
        "conditions": [condition("Finished", "False", "Preparing")],
    })
}

pub fn running() -> Value {
    json!({
        "state": "Running", "attempt": 1, "message": "12/20 routes done.", "track": "sensors",
        "jobName": "a-1", "times": {"started": TIME},
        "conditions": [condition("Finished", "False", "Preparing"), condition("Running", "True", "Running")],
    })
}

/// An end of the first attempt.
pub fn end(state: &str, reason: &str) -> Value {
    json!({
        // Absent where it repeats the state.
        "state": state, "attempt": 1, "reason": (reason != state).then_some(reason), "message": "It has ended.", "track": "sensors",
        "times": {"finished": TIME}, "resultsURL": "s3://results/42",
        "conditions": [condition("Finished", "True", reason), condition("Published", "True", "Published")],
    })
}

pub fn failed(class: &str, reason: &str) -> Value {
    let mut status = end("Failed", reason);
    let failure = json!({"class": class, "reason": reason, "message": "It has ended.", "worker": 2});
    merge(&mut status, &json!({ "failure": failure }));
    status
}

pub fn finished() -> Value {
    let mut status = end("Finished", "Finished");
    merge(
        &mut status,
        &json!({"score": {"name": "Driving score", "value": "43.13", "final": true, "text": "43.13"}, "progress": {"done": 20, "total": 20, "unit": "routes", "text": "20/20"}}),
    );
    status
}

pub fn assert_has(text: &str, expected: &[&str]) {
    for part in expected {
        assert!(text.contains(part), "{part}\n\n{text}");
    }
}
