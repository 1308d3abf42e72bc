//! The processes of a Pod's containers, seen from outside: the cluster's only node is this machine, and the tests are root.

use std::fs;
use std::time::{Duration, Instant};

use k8s_openapi::api::core::v1::Pod;
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use tokio::time::{sleep, timeout};

use super::scene::containers;

/// Processes have no events for others: they are looked for this often.
const LOOK: Duration = Duration::from_millis(5);

/// Processes of all containers; none if they have ended already.
pub fn of_pod(pod: &Pod) -> Vec<Pid> {
    let ids = containers(pod)
        .into_iter()
        .filter_map(|container| container.container_id);
    ids.flat_map(|id| of_container(&id)).collect()
}

/// Waits for a container's process with this name.
pub async fn named(pod: &Pod, container: &str, name: &str, limit: Duration) -> Pid {
    let id = id_of(pod, container);
    let is_it = |pid: &Pid| fs::read_to_string(format!("/proc/{pid}/comm")).is_ok_and(|comm| comm.trim_end() == name);
    let found = async {
        loop {
            if let Some(pid) = of_container(&id).into_iter().find(is_it) {
                return pid;
            }
            sleep(LOOK).await;
        }
    };
    let found = timeout(limit, found).await;
    found.unwrap_or_else(|_| panic!("{container} runs no {name} on this machine"))
}

/// Waits until all of them have ended; hands back when the last one had.
pub async fn ended(processes: &[Pid], limit: Duration) -> Instant {
    let ended = async {
        while processes.iter().any(|process| kill(*process, None).is_ok()) {
            sleep(LOOK).await;
        }
        Instant::now()
    };
    let ended = timeout(limit, ended).await;
    ended.unwrap_or_else(|_| panic!("some of {processes:?} run on after {} s", limit.as_secs()))
}

/// Kills those of a container without a word, as the kernel does when memory is short.
pub fn kill_container(pod: &Pod, container: &str) {
    let processes = of_container(&id_of(pod, container));
    assert!(!processes.is_empty(), "no process of {container} is on this machine");
    for process in processes {
        kill(process, Signal::SIGKILL).unwrap();
    }
}

/// Kills the processes of a container that may have ended; returns true if there was any.
pub fn kill_if_running(pod: &Pod, container: &str) -> bool {
    let processes = of_container(&id_of(pod, container)).into_iter();
    processes.flat_map(|process| kill(process, Signal::SIGKILL)).count() > 0
}

fn id_of(pod: &Pod, container: &str) -> String {
    let all = containers(pod).into_iter();
    let found = all
        .filter(|found| found.name == container)
        .find_map(|found| found.container_id);
    found.unwrap_or_else(|| panic!("{container} has never run"))
}

fn of_container(id: &str) -> Vec<Pid> {
    let id = id.split_once("://").map_or(id, |(_, id)| id);
    let entries = fs::read_dir("/proc").unwrap().flatten();
    let pids = entries.filter_map(|entry| entry.file_name().to_str()?.parse().ok());
    let is_its = |pid: &i32| fs::read_to_string(format!("/proc/{pid}/cgroup")).is_ok_and(|groups| groups.contains(id));
    pids.filter(is_its).map(Pid::from_raw).collect()
}
