//! Two controllers as processes, with submissions coming in: the leader ends, stopped or killed, and the other one goes on. How long
//! that takes is printed; that no two of them ever wrote in turns is asserted, from the API server's own log.
#![cfg(test)]

use std::fmt;
use std::fs;
use std::time::Duration;

use jiff::Timestamp;
use k8s_openapi::api::coordination::v1::Lease;
use kube::api::PostParams;
use leaderboard_api::{Leaderboard, Submission, conditions};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::{Value, json};
use tokio::process::{Child, Command};
use tokio::task::JoinHandle;
use tokio::time::{sleep, timeout};

use super::bridge::LIMIT;
use super::process::operator;
use super::world::World;
use crate::support::apiserver::{Request, server};

/// Between two submissions: there is always something to write.
const PERIOD: Duration = Duration::from_millis(250);
/// The audit log of the API server is read this often.
const LOOK: Duration = Duration::from_millis(100);
/// Resources that a process writes also without the lead.
const OF_THE_PROCESS: [&str; 1] = ["leases"];
const READS: [&str; 3] = ["get", "list", "watch"];

/// How a leader ends.
#[derive(Clone, Copy)]
enum End {
    Told,
    Killed,
}

/// A controller with an API server's user of its own, started again under the same name after each end.
struct Replica {
    user: String,
    kubeconfig: Value,
    namespace: String,
    folder: tempfile::TempDir,
    child: Child,
}

impl Replica {
    async fn start(namespace: &str) -> Self {
        let (_, user) = server().await.counted();
        let file = fs::read_to_string(server().await.kubeconfig()).unwrap();
        let mut kubeconfig: Value = serde_json::from_str(&file).unwrap();
        kubeconfig["users"][0]["user"]["token"] = json!(user);
        let folder = tempfile::tempdir().unwrap();
        let child = command(&user, &kubeconfig, namespace, &folder).spawn().unwrap();
        Self {
            user,
            kubeconfig,
            namespace: namespace.to_owned(),
            folder,
            child,
        }
    }

    fn start_again(&mut self) {
        let mut command = command(&self.user, &self.kubeconfig, &self.namespace, &self.folder);
        self.child = command.spawn().unwrap();
    }

    /// Ends it; hands back when it was asked to.
    async fn end(&mut self, end: End) -> Timestamp {
        let pid = Pid::from_raw(i32::try_from(self.child.id().expect("it runs")).unwrap());
        let at = Timestamp::now();
        let signal = match end {
            End::Told => Signal::SIGTERM,
            End::Killed => Signal::SIGKILL,
        };
        kill(pid, signal).unwrap();
        let status = timeout(LIMIT, self.child.wait()).await.expect("it ends").unwrap();
        let log = fs::read_to_string(self.folder.path().join("log")).unwrap_or_default();
        let is_orderly = matches!(end, End::Killed) || status.success();
        assert!(is_orderly, "{status}: {}", log.lines().last().unwrap_or_default());
        at
    }

    /// Writes that it has made as a leader.
    async fn writes(&self) -> Vec<Request> {
        let all = server().await.requests(&self.user).into_iter();
        let is_write = |request: &Request| {
            !READS.contains(&request.verb.as_str()) && !OF_THE_PROCESS.contains(&request.resource().as_str())
        };
        all.filter(is_write).collect()
    }

    /// Its first write that came in after a moment.
    async fn first_write_after(&self, at: Timestamp) -> Timestamp {
        let found = async {
            loop {
                let first = self
                    .writes()
                    .await
                    .into_iter()
                    .map(|request| request.received)
                    .find(|time| *time > at);
                if let Some(first) = first {
                    return first;
                }
                sleep(LOOK).await;
            }
        };
        timeout(LIMIT, found).await.expect("the other one goes on")
    }
}

fn command(user: &str, kubeconfig: &Value, namespace: &str, folder: &tempfile::TempDir) -> Command {
    let path = folder.path().join("kubeconfig");
    fs::write(&path, kubeconfig.to_string()).unwrap();
    let mut command = operator("controller", user, namespace, &path, &folder.path().join("log"));
    command.env("RUST_LOG", "info");
    command
}

/// Submissions that come in all the time. They end with this.
struct Traffic(JoinHandle<()>);

impl Traffic {
    fn start(world: &World) -> Self {
        let api = world.api::<Submission>();
        Self(tokio::spawn(async move {
            for number in 0.. {
                let spec =
                    json!({"leaderboardName": "lb", "track": "sensors", "image": "r/agent:1", "team": {"id": "7"}});
                let submission = Submission::new(&format!("s-{number}"), serde_json::from_value(spec).unwrap());
                api.create(&PostParams::default(), &submission).await.unwrap();
                sleep(PERIOD).await;
            }
        }))
    }
}

impl Drop for Traffic {
    fn drop(&mut self) {
        self.0.abort();
    }
}

/// Seconds from the end of a leader to its successor's first write.
struct Figures(&'static str, Vec<f64>);

impl fmt::Display for Figures {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut sorted = self.1.clone();
        sorted.sort_by(f64::total_cmp);
        let (low, middle, high) = (sorted[0], sorted[sorted.len() / 2], sorted[sorted.len() - 1]);
        write!(
            f,
            "{}: {} times, min {low:.2} s, median {middle:.2} s, max {high:.2} s",
            self.0,
            sorted.len()
        )
    }
}

async fn leads(world: &World, user: &str) {
    let holds = |lease: Option<&Lease>| {
        let holder = lease.and_then(|lease| lease.spec.as_ref()?.holder_identity.as_ref());
        holder.is_some_and(|holder| holder.starts_with(user))
    };
    let seen = kube::runtime::wait::await_condition(world.api::<Lease>(), "operator", holds);
    timeout(LIMIT, seen).await.expect("it leads").unwrap();
}

/// The host of a Leaderboard of EvalAI's reads that nothing is written there for a while, and until when.
async fn says_that_evalai_waits(world: &World) {
    let says = |board: Option<&Leaderboard>| {
        let status = board.and_then(|board| board.status.as_ref());
        let ready = status.and_then(|status| conditions::get(&status.conditions, conditions::READY));
        ready.is_some_and(|ready| ready.message.contains("Nothing is written to EvalAI before"))
    };
    let seen = kube::runtime::wait::await_condition(world.api::<Leaderboard>(), "hosts", says);
    timeout(LIMIT, seen).await.expect("the Leaderboard says so").unwrap();
}

/// Ends the leader `count` times; the other one goes on each time.
async fn end_leaders(replicas: &mut [Replica; 2], leader: &mut usize, end: End, count: usize) -> Vec<f64> {
    let mut took = Vec::new();
    for _ in 0..count {
        let old = *leader;
        let new = 1 - old;
        let at = replicas[old].end(end).await;
        let first = replicas[new].first_write_after(at).await;
        took.push(first.duration_since(at).as_secs_f64());
        *leader = new;
        replicas[old].start_again();
    }
    took
}

/// The writes of both, in the order in which the API server had them, are of one process at a time.
async fn assert_in_order(replicas: &[Replica; 2], ends: usize) {
    let mut all: Vec<(usize, Request)> = Vec::new();
    for (index, replica) in replicas.iter().enumerate() {
        all.extend(replica.writes().await.into_iter().map(|request| (index, request)));
    }
    all.sort_by_key(|(_, request)| request.received);
    let mut changes = 0;
    for pair in all.windows(2) {
        let [(before, earlier), (after, later)] = pair else {
            continue;
        };
        if before != after {
            changes += 1;
            assert!(
                earlier.answered <= later.received,
                "both wrote at once: {earlier:?} {later:?}"
            );
        }
    }
    assert_eq!(changes, ends, "each end hands over once, and nobody writes out of turn");
}

async fn measure(count: usize) {
    let world = World::new().await;
    let spec = json!({"evalai": null, "tracks": [{"name": "sensors"}]});
    world.leaderboard_with("lb", 1, "Hosts", &spec).await;
    world
        .leaderboard_with("hosts", 1, "Hosts", &json!({"storage": {"s3": {"prefix": "hosts/"}}}))
        .await;
    let traffic = Traffic::start(&world);
    let began = Timestamp::now();
    let first = Replica::start(&world.namespace).await;
    leads(&world, &first.user).await;
    first.first_write_after(began).await;
    let mut replicas = [first, Replica::start(&world.namespace).await];
    let mut leader = 0;
    let told = end_leaders(&mut replicas, &mut leader, End::Told, count).await;
    let killed = end_leaders(&mut replicas, &mut leader, End::Killed, count).await;
    says_that_evalai_waits(&world).await;
    drop(traffic);
    println!("{}", Figures("SIGTERM to the successor's first write", told));
    println!("{}", Figures("SIGKILL to the successor's first write", killed));
    assert_in_order(&replicas, 2 * count).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn of_two_replicas_the_other_goes_on_and_no_two_write_at_once() {
    measure(2).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
#[ignore = "it measures for some minutes: make measure-failover"]
async fn the_leader_ends_ten_times_in_each_way() {
    measure(10).await;
}
