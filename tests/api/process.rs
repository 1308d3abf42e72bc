//! One of the operator's programs as a child process of a test.

use std::fs::File;
use std::path::Path;
use std::process::Stdio;

use tokio::process::Command;

/// The command of a program in a Pod of this name. Its output is appended to the file `log`.
pub fn operator(program: &str, name: &str, namespace: &str, kubeconfig: &Path, log: &Path) -> Command {
    let log = File::options().create(true).append(true).open(log).unwrap();
    // A killed test drops nothing; the kernel ends its children all the same.
    let mut command = Command::new("setpriv");
    command
        .args(["--pdeathsig", "KILL", env!("CARGO_BIN_EXE_leaderboard-operator")])
        .args([program, "--namespace", namespace, "--http", "127.0.0.1:0"]);
    if program == "controller" {
        command.args([
            "--image",
            "operator:1",
            "--lease",
            "operator",
            "--lease-namespace",
            namespace,
        ]);
    }
    command
        .env("KUBECONFIG", kubeconfig)
        .env("POD_NAME", name)
        .env("AWS_ACCESS_KEY_ID", "test")
        .env("AWS_SECRET_ACCESS_KEY", "test")
        .env("AWS_REGION", "us-east-1")
        .env("AWS_EC2_METADATA_DISABLED", "true")
        .env_remove("AWS_ENDPOINT_URL")
        .stdin(Stdio::null())
        .stdout(log.try_clone().unwrap())
        .stderr(log)
        .kill_on_drop(true);
    command
}
