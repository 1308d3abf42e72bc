//! Programs of others that the lab builds once and keeps: their paths, and the start of one that listens on a port of its own.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

use tokio::io::{AsyncBufReadExt, BufReader};
use tokio::process::{Child, ChildStderr};
use tokio::time::timeout;

/// A second on an idle machine.
const START_LIMIT: Duration = Duration::from_mins(2);

/// The folder with these programs; what is missing of them is built first.
pub fn of_lab(names: &[&str]) -> Result<PathBuf, String> {
    let lab = Path::new(env!("CARGO_MANIFEST_DIR")).join("local/lab");
    let output = Command::new(&lab).arg("tools").args(names).output();
    let output = output.map_err(|error| format!("{} does not run ({error})", lab.display()))?;
    if output.status.success() {
        return Ok(PathBuf::from(String::from_utf8_lossy(&output.stdout).trim()));
    }
    let said = String::from_utf8_lossy(&output.stderr);
    Err(format!("`local/lab tools` failed: {}", said.trim()))
}

/// A program of the lab; building it may take minutes.
pub async fn program(name: &'static str) -> PathBuf {
    let folder = tokio::task::spawn_blocking(move || of_lab(&[name])).await.unwrap();
    folder.unwrap_or_else(|why| panic!("{why}")).join(name)
}

/// Starts a program that prints on standard error, in a line with `listens`, at which address of loopback. It ends when it is dropped, and
/// with the test.
pub async fn start(program: &Path, arguments: &[String], listens: &'static str) -> (Child, SocketAddr) {
    // A killed test drops nothing; the kernel ends its children all the same.
    let mut command = tokio::process::Command::new("setpriv");
    command.args(["--pdeathsig", "KILL"]).arg(program).args(arguments);
    command
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped());
    let mut child = command.kill_on_drop(true).spawn().unwrap();
    let said = address(child.stderr.take().unwrap(), listens);
    let found = timeout(START_LIMIT, said).await;
    let found = found.unwrap_or_else(|_| panic!("{} does not listen", program.display()));
    (
        child,
        found.unwrap_or_else(|said| panic!("{} has ended: {said}", program.display())),
    )
}

/// Reads on in the background: a full pipe would stop the program.
async fn address(stderr: ChildStderr, listens: &str) -> Result<SocketAddr, String> {
    let mut lines = BufReader::new(stderr).lines();
    let mut said = String::new();
    while let Ok(Some(line)) = lines.next_line().await {
        if line.contains(listens)
            && let Some(address) = loopback(&line)
        {
            tokio::spawn(async move { while let Ok(Some(_)) = lines.next_line().await {} });
            return Ok(address);
        }
        said = said + &line + "\n";
    }
    Err(said)
}

/// The first address of loopback in a line.
pub fn loopback(line: &str) -> Option<SocketAddr> {
    let at = line.find("127.0.0.1:")?;
    let is_part = |letter: char| letter.is_ascii_digit() || letter == '.' || letter == ':';
    line[at..].split(|letter| !is_part(letter)).next()?.parse().ok()
}
