//! Volumes that take no bytes: a full disk, and a log folder that is read-only. Each test runs again in a mount namespace of its own, so
//! that its mounts are not seen outside. If the machine allows none, the test reports that.

use std::fs::{self, OpenOptions};
use std::io::Write;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

use fastrand::Rng;
use leaderboard_api::LeaderboardVersion;
use leaderboard_contract::run::Stop;
use leaderboard_protocol::files::{Mark, Member, Side, StatusFile};

use super::kubelet::{Kubelet, Name, all_done, members};
use super::process::say;
use super::results::{next_route, report};
use super::submission::Submission;
use crate::ministack::server;

const LIMIT: Duration = Duration::from_mins(2);
/// Set in the second life of a test.
const INSIDE: &str = "LEADERBOARD_TEST_OWN_MOUNTS";

/// True in the second life of the test `name`. In the first life it starts the second one, and judges it.
fn is_inside(name: &str) -> bool {
    if std::env::var_os(INSIDE).is_some() {
        return true;
    }
    let options = if nix::unistd::geteuid().is_root() {
        "--mount"
    } else {
        "--map-root-user"
    };
    let unshare = || {
        let mut command = Command::new("unshare");
        command.args(["--mount", options, "--propagation", "private"]);
        command
    };
    let probe = unshare().args(["mount", "-t", "tmpfs", "none", "/mnt"]).output();
    if !probe.is_ok_and(|probe| probe.status.success()) {
        say(&format!(
            "{name}: left out, as this machine lets nobody mount anything here"
        ));
        return false;
    }
    let again = std::env::current_exe().unwrap();
    let output = unshare()
        .arg(again)
        .args(["--exact", name, "--nocapture"])
        .env(INSIDE, "1")
        .output();
    let output = output.unwrap();
    let said = [output.stdout, output.stderr].concat();
    let said = String::from_utf8_lossy(&said);
    // The failure itself comes first, as the end of a long text is what a summary keeps.
    let why = said.split_once("panicked at").map_or("", |(_, why)| why);
    assert!(
        output.status.success() && said.contains("1 passed"),
        "{said}\nfailed at {}",
        why.lines().take(12).collect::<Vec<_>>().join("\n")
    );
    false
}

fn mount(arguments: &[&str]) {
    assert!(
        Command::new("mount").args(arguments).status().unwrap().success(),
        "mount {arguments:?}"
    );
}

/// Goes on until the Pod is complete. `stop_when`: then the controller, whose patience with crashes is over, stops it.
async fn run_to_the_end(kubelet: &mut Kubelet<'_>, mut stop_when: impl FnMut(&Kubelet<'_>) -> bool) {
    let end = async {
        let mut stopped = false;
        loop {
            let (name, status) = kubelet.ended().await;
            if kubelet.handle(name, status) {
                return;
            }
            if !stopped && stop_when(kubelet) {
                stopped = true;
                fs::write(kubelet.places().stop(), Stop::Retries.as_str()).unwrap();
            }
        }
    };
    let in_time = tokio::time::timeout(LIMIT, end).await;
    assert!(in_time.is_ok(), "it does not end\n{}", kubelet.story());
}

fn agents() -> impl Iterator<Item = Member> {
    members().filter(|member| member.side == Side::Agent)
}

/// Goes on until each pair has two routes done, and its agent hangs in the third. An agent that is killed before it has left its marker
/// hangs once more.
async fn run_to_the_third_route(kubelet: &mut Kubelet<'_>, submission: &Submission) {
    let begun = async {
        while !agents().all(|agent| kubelet.path(&submission.hang_marker(agent, 3)).exists())
            || report(&submission.archive)
                .await
                .is_none_or(|report| report.workers.iter().any(|pair| pair.done < 2))
        {
            let ended = tokio::time::timeout(Duration::from_millis(20), kubelet.ended()).await;
            if let Ok((name, status)) = ended {
                kubelet.handle(name, status);
            }
        }
    };
    let in_time = tokio::time::timeout(LIMIT, begun).await;
    assert!(in_time.is_ok(), "it does not begin\n{}", kubelet.story());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_disk_that_runs_full_ends_the_run_in_order() {
    if !is_inside("resume::volumes::a_disk_that_runs_full_ends_the_run_in_order") {
        return;
    }
    let bucket = server().await.bucket().await;
    let mut submission = Submission::new(&bucket, LeaderboardVersion::V2, &mut Rng::new()).await;
    submission.route_waits_for_copy = false;
    // All agents hang while the disk is filled, so no process writes anything.
    submission.agent_knobs = "hang@3:once".to_owned();
    let mut kubelet = Kubelet::new(&submission);
    kubelet.make_pod_on(|root| {
        let logs = root.join("logs");
        mount(&["-t", "tmpfs", "-o", "size=2m", "none", logs.to_str().unwrap()]);
    });
    run_to_the_third_route(&mut kubelet, &submission).await;
    let filler = kubelet.path("simulator/filler");
    fill(&filler);
    for agent in agents() {
        assert!(kubelet.kill_command(agent), "{agent} hangs in its third route");
    }
    run_to_the_end(&mut kubelet, |kubelet| {
        fill(&filler);
        agents().all(|agent| {
            [Mark::Crash(1), Mark::Done]
                .iter()
                .any(|mark| kubelet.has(StatusFile::Of(agent, *mark)))
        })
    })
    .await;
    assert!(kubelet.has(StatusFile::Stored));
    assert!(kubelet.end_logcopy().await.success());
    let last = report(&submission.archive).await.unwrap();
    assert!(
        last.is_final && !last.eligible && last.stopped == Some(Stop::Retries),
        "{last:?}"
    );
    // A copy that found no room is a route older than its file; half of a file is stored nowhere.
    for pair in &last.workers {
        let key = format!("agent/agent{}/agent_results.json", pair.id);
        let stored = submission.archive.get(&key, 1 << 26).await.unwrap().unwrap();
        assert_eq!(next_route(&stored.bytes), Some(pair.done.into()), "{key}");
    }
    let said = members()
        .map(|member| kubelet.log(Name::Of(member)))
        .collect::<String>();
    assert!(said.contains("No space left on device"), "{said}");
    assert!(
        kubelet.log(Name::Logcopy).contains("No space left on device"),
        "{}",
        kubelet.log(Name::Logcopy)
    );
}

/// Takes what room is left.
fn fill(path: &Path) {
    let mut file = OpenOptions::new().append(true).create(true).open(path).unwrap();
    for size in [65_536, 4096, 512, 16, 1] {
        while file.write_all(&vec![b'x'; size]).is_ok() {}
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_read_only_log_folder_costs_its_pair_and_nothing_else() {
    if !is_inside("resume::volumes::a_read_only_log_folder_costs_its_pair_and_nothing_else") {
        return;
    }
    let bucket = server().await.bucket().await;
    let submission = Submission::new(&bucket, LeaderboardVersion::V2, &mut Rng::new()).await;
    let mut kubelet = Kubelet::new(&submission);
    kubelet.make_pod_on(|root| {
        let folder = root.join("logs/agent/agent1");
        fs::create_dir_all(&folder).unwrap();
        let folder = folder.to_str().unwrap();
        mount(&["--bind", folder, folder]);
        mount(&["-o", "remount,bind,ro", folder]);
    });
    let rest_done = |kubelet: &Kubelet<'_>| {
        let mut rest = members().filter(|member| member.side == Side::Agent).skip(1);
        rest.all(|agent| kubelet.has(StatusFile::Of(agent, Mark::Done)))
    };
    run_to_the_end(&mut kubelet, rest_done).await;
    assert!(!all_done(&kubelet.places().status()));
    assert!(kubelet.end_logcopy().await.success());
    let last = report(&submission.archive).await.unwrap();
    assert!(
        last.is_final && !last.eligible && last.stopped == Some(Stop::Retries),
        "{last:?}"
    );
    assert_eq!(
        last.workers.iter().map(|pair| pair.done).collect::<Vec<_>>(),
        [0, 5, 5, 5]
    );
    let agent = members().nth(1).unwrap();
    let said = kubelet.log(Name::Of(agent));
    assert!(said.contains("Read-only file system"), "{said}");
    assert!(said.contains("there is no checkpoint file"), "{said}");
}
