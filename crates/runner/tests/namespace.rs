//! The runner as what it is in a container: the first process of a PID namespace.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on fails")]

mod support;

use std::fs;
use std::io::Write;
use std::process::Command;

use leaderboard_protocol::files::{Mark, StatusFile};
use leaderboard_protocol::verdict::What;
use support::{AGENT, Pod, SIMULATOR};

/// Chains of forks at once.
const CHAINS: usize = 30;

/// Forks without an end, leaves every group, and writes a verdict of its own each time.
const CHAIN: &str = r#"
import os, sys
forged = b'{"what":"notReady","round":0,"schema":1,"why":"forged"}'
open(sys.argv[2], 'w').close()
while True:
    if os.fork():
        os._exit(0)
    os.setsid()
    log = os.open(sys.argv[1], os.O_WRONLY | os.O_TRUNC)
    os.write(log, forged)
    os.close(log)
"#;

/// The words that start a program as the first process of a PID namespace. None if this machine lets no process make one; the test
/// reports it then.
fn namespace() -> Option<Vec<String>> {
    let mut words = vec!["unshare", "--pid", "--fork", "--mount-proc", "--kill-child"];
    if !nix::unistd::geteuid().is_root() {
        words.extend(["--user", "--map-root-user"]);
    }
    let probe = Command::new(words[0]).args(&words[1..]).arg("true").output();
    if probe.is_ok_and(|probe| probe.status.success()) {
        return Some(words.into_iter().map(str::to_owned).collect());
    }
    // Not captured: a test that is left out shows it in any run.
    let _ = writeln!(
        std::io::stderr(),
        "left out: this machine lets nobody make a PID namespace; run the tests as root"
    );
    None
}

/// Processes whose arguments hold this text and that are no runner.
fn processes_with(text: &str) -> usize {
    let all = fs::read_dir("/proc").unwrap().flatten();
    let command = |process: fs::DirEntry| fs::read(process.path().join("cmdline")).unwrap_or_default();
    let is_one = |command: &String| command.contains(text) && command.starts_with("python3");
    all.map(|process| String::from_utf8_lossy(&command(process)).into_owned())
        .filter(is_one)
        .count()
}

#[test]
fn chains_of_forks_have_ended_before_the_verdict_on_their_agent() {
    let Some(starter) = namespace() else { return };
    let mut pod = Pod::new();
    pod.starter = starter;
    pod.options.push("--peer-seconds=600".to_owned());
    pod.write(StatusFile::Of(SIMULATOR, Mark::Start(0)));
    let chain = pod.path("chain.py");
    fs::write(&chain, CHAIN).unwrap();
    let log = pod.path("agent-1.termination");
    let begun = pod.path("begun");
    fs::create_dir(&begun).unwrap();
    let (chain, log, begun) = (chain.display(), log.display(), begun.display());
    let script = format!(
        "for i in $(seq {CHAINS}); do (setsid python3 {chain} {log} {begun}/$i > /dev/null 2>&1 &); done; \
         until [ $(ls {begun} | wc -l) = {CHAINS} ]; do sleep 0.05; done; exit 3"
    );
    let mut agent = pod.agent(&script);
    // It has its verdict, and waits for its peer.
    pod.until(AGENT, Mark::Crash(0));
    assert_eq!(processes_with(&chain.to_string()), 0);
    let verdict = agent.verdict();
    assert_eq!(
        (verdict.what, verdict.exit_code),
        (What::Exited, Some(3)),
        "{}",
        verdict.why
    );
    pod.write(StatusFile::Of(SIMULATOR, Mark::Crash(0)));
    assert_eq!(agent.code(), 1);
    assert_eq!(agent.verdict(), verdict, "nobody has written since");
}
