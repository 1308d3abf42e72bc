//! Plays the kubelet and the Job for one submission. It starts the containers in their order, restarts those that fail, and makes another
//! Pod when one is lost. A test can kill any of them.

use std::collections::{BTreeMap, VecDeque};
use std::fs::{self, OpenOptions};
use std::path::{Path, PathBuf};
use std::process::{ExitStatus, Stdio};

use leaderboard_pod::places::Places;
use leaderboard_protocol::files::{Host, Mark, Member, Pair, Side, StatusFile};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use tokio::sync::mpsc;

use super::process::{children, gone, kill_container, terminate};
use super::submission::{PAIRS, Submission, make_volumes};
use crate::files::until_there;

/// A container of the Pod.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Name {
    Workspace,
    Logcopy,
    Of(Member),
}

impl std::fmt::Display for Name {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Workspace => f.write_str("workspace"),
            Self::Logcopy => f.write_str("logcopy"),
            Self::Of(member) => member.fmt(f),
        }
    }
}

/// The host's container of a pair.
pub const SIMULATOR: Side = Side::Host(Host::Simulator);

/// Both members of every pair.
pub fn members() -> impl Iterator<Item = Member> {
    (1..=PAIRS)
        .filter_map(Pair::new)
        .flat_map(|pair| [SIMULATOR, Side::Agent].map(|side| Member { side, pair }))
}

/// True if all agents report that they are done.
pub fn all_done(status: &Path) -> bool {
    let mut agents = members().filter(|member| member.side == Side::Agent);
    agents.all(|agent| StatusFile::Of(agent, Mark::Done).exists(status))
}

struct Container {
    /// Tells one life of a container from the next.
    life: u64,
    pid: Pid,
    /// Its last life ended so.
    ended: Option<ExitStatus>,
}

/// The node with the Pod on it.
pub struct Kubelet<'a> {
    submission: &'a Submission,
    folder: tempfile::TempDir,
    root: PathBuf,
    pods: u32,
    lives: u64,
    containers: BTreeMap<Name, Container>,
    ends: mpsc::UnboundedReceiver<(Name, u64, ExitStatus)>,
    sender: mpsc::UnboundedSender<(Name, u64, ExitStatus)>,
    backlog: VecDeque<(Name, ExitStatus)>,
    /// Containers that are not restarted for now, as in a back-off.
    pub held_back: Vec<Member>,
}

impl<'a> Kubelet<'a> {
    pub fn new(submission: &'a Submission) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let (sender, ends) = mpsc::unbounded_channel();
        Self {
            submission,
            root: folder.path().to_owned(),
            folder,
            pods: 0,
            lives: 0,
            containers: BTreeMap::new(),
            ends,
            sender,
            backlog: VecDeque::new(),
            held_back: Vec::new(),
        }
    }

    /// A new Pod with empty volumes.
    pub fn make_pod(&mut self) {
        self.make_pod_on(|_| {});
    }

    /// Makes a Pod on a node that mounts something of its own.
    pub fn make_pod_on(&mut self, mount: impl FnOnce(&Path)) {
        self.pods += 1;
        self.root = self.folder.path().join(format!("pod-{}", self.pods));
        make_volumes(&self.root);
        mount(&self.root);
        self.start(Name::Workspace);
    }

    /// Holds the Pods' volumes and the containers' logs.
    pub fn folder(&self) -> &Path {
        self.folder.path()
    }

    pub fn pod_uid(&self) -> String {
        format!("pod-{}", self.pods)
    }

    pub fn places(&self) -> Places {
        Places::below(&self.root)
    }

    pub fn path(&self, below_logs: &str) -> PathBuf {
        self.places().logs.join(below_logs)
    }

    pub fn has(&self, file: StatusFile) -> bool {
        file.exists(&self.places().status())
    }

    pub async fn until_has(&self, file: StatusFile) {
        until_there(&file.path(&self.places().status())).await;
    }

    pub fn start(&mut self, name: Name) {
        self.lives += 1;
        let life = self.lives;
        let mut command = match name {
            Name::Workspace => self.submission.own("workspace", &self.root, &self.pod_uid()),
            Name::Logcopy => self.submission.own("logcopy", &self.root, &self.pod_uid()),
            Name::Of(member) => {
                self.mount(member);
                self.submission.member(member, &self.root)
            }
        };
        let output = self.output(name);
        let mut child = command
            .stdin(Stdio::null())
            .stdout(output.try_clone().unwrap())
            .stderr(output)
            .spawn()
            .unwrap();
        let pid = Pid::from_raw(child.id().unwrap().try_into().unwrap());
        let sender = self.sender.clone();
        tokio::spawn(async move {
            let status = child.wait().await.unwrap();
            // The test may be over, and its receiver gone.
            let _ = sender.send((name, life, status));
        });
        let ended = None;
        self.containers.insert(name, Container { life, pid, ended });
    }

    /// The folders of a container's mounts, made when it is created, for every user.
    fn mount(&self, member: Member) {
        let status = self.places().status().join(member.to_string());
        let own = match member.side {
            Side::Host(_) => self.path("simulator"),
            Side::Agent => self.path(&format!("agent/agent{}", member.pair)),
        };
        for folder in [status, own] {
            fs::create_dir_all(folder).unwrap();
        }
        fs::write(self.root.join(format!("{member}.termination")), "").unwrap();
    }

    /// The container's log, over all its lives and Pods.
    fn output(&self, name: Name) -> fs::File {
        let path = self.folder.path().join(format!("{name}.log"));
        OpenOptions::new().append(true).create(true).open(path).unwrap()
    }

    /// The output of a container, of all its lives.
    pub fn log(&self, name: Name) -> String {
        fs::read(self.folder.path().join(format!("{name}.log")))
            .map(|bytes| String::from_utf8_lossy(&bytes).into_owned())
            .unwrap_or_default()
    }

    /// The next end of a container.
    pub async fn ended(&mut self) -> (Name, ExitStatus) {
        if let Some(end) = self.backlog.pop_front() {
            return end;
        }
        loop {
            let (name, life, status) = self.ends.recv().await.unwrap();
            if self.note(name, life, status) {
                return (name, status);
            }
        }
    }

    fn note(&mut self, name: Name, life: u64, status: ExitStatus) -> bool {
        let container = self
            .containers
            .get_mut(&name)
            .filter(|container| container.life == life);
        container.map(|container| container.ended = Some(status)).is_some()
    }

    /// Waits for the end of one container's present life, and leaves what else ends to [`Self::ended`].
    async fn end_of(&mut self, name: Name) {
        while self
            .containers
            .get(&name)
            .is_some_and(|container| container.ended.is_none())
        {
            let (other, life, status) = self.ends.recv().await.unwrap();
            if self.note(other, life, status) && other != name {
                self.backlog.push_back((other, status));
            }
        }
        self.backlog.retain(|(other, _)| *other != name);
    }

    /// Acts on an end as the kubelet does. Returns true if the Pod is complete.
    pub fn handle(&mut self, name: Name, status: ExitStatus) -> bool {
        match name {
            Name::Workspace if status.success() => {
                self.start(Name::Logcopy);
                for member in members() {
                    self.start(Name::Of(member));
                }
            }
            Name::Workspace | Name::Logcopy => self.start(name),
            Name::Of(member) if !status.success() && !self.held_back.contains(&member) => self.start(name),
            Name::Of(_) => {}
        }
        let ended = |member| self.containers.get(&Name::Of(member)).and_then(|c| c.ended);
        members().all(|member| ended(member).is_some_and(|status| status.success()))
    }

    pub fn runs(&self, name: Name) -> bool {
        self.pid(name).is_some()
    }

    /// The pid of a container that runs.
    fn pid(&self, name: Name) -> Option<Pid> {
        let container = self.containers.get(&name)?;
        container.ended.is_none().then_some(container.pid)
    }

    /// Sends a signal to a container's first process.
    pub fn signal(&self, name: Name, signal: Signal) {
        kill(self.pid(name).unwrap(), signal).unwrap();
    }

    /// Kills the command behind a runner. Returns whether there was one.
    pub fn kill_command(&self, member: Member) -> bool {
        let commands = self.pid(Name::Of(member)).map(children).unwrap_or_default();
        commands.iter().any(|command| kill(*command, Signal::SIGKILL).is_ok())
    }

    /// Kills a whole container and lets the kubelet see it. Returns whether it ran.
    pub async fn kill(&mut self, name: Name) -> bool {
        let Some(pid) = self.pid(name) else { return false };
        let orphans = kill_container(pid).await;
        self.end_of(name).await;
        gone(&orphans).await;
        let status = self.containers[&name].ended.unwrap();
        if self.handle(name, status) {
            // It had ended by itself, as the last one.
            self.backlog.push_back((name, status));
        }
        true
    }

    /// Kills everything. Nothing is restarted.
    pub async fn kill_all(&mut self) {
        let names: Vec<Name> = self.containers.keys().copied().collect();
        let mut orphans = Vec::new();
        for name in &names {
            if let Some(pid) = self.pid(*name) {
                orphans.extend(kill_container(pid).await);
            }
        }
        for name in names {
            self.end_of(name).await;
        }
        gone(&orphans).await;
        self.forget();
    }

    /// Ends everything as an eviction does: the sidecar last. Nothing is restarted.
    pub async fn evict(&mut self) {
        // An init container has nothing to end in order.
        if let Some(pid) = self.pid(Name::Workspace) {
            let _ = kill(pid, Signal::SIGKILL);
        }
        let mains: Vec<Name> = members().map(Name::Of).collect();
        for names in [mains, vec![Name::Logcopy]] {
            for name in &names {
                if let Some(pid) = self.pid(*name) {
                    terminate(pid).await;
                }
            }
            for name in names {
                self.end_of(name).await;
            }
        }
        self.forget();
    }

    /// The node is back: the same Pod with its volumes, from the first init container on.
    pub fn restart_pod(&mut self) {
        self.start(Name::Workspace);
    }

    fn forget(&mut self) {
        self.backlog.clear();
        self.containers.clear();
    }

    /// The volume is gone for good.
    pub fn lose_volumes(&mut self) {
        fs::remove_dir_all(&self.root).unwrap();
    }

    /// SIGTERM to logcopy, whose Pod is complete. Returns its exit status.
    pub async fn end_logcopy(&mut self) -> ExitStatus {
        if let Some(pid) = self.pid(Name::Logcopy) {
            terminate(pid).await;
        }
        self.end_of(Name::Logcopy).await;
        self.containers[&Name::Logcopy].ended.unwrap()
    }

    /// Routes that were begun on each pair's simulators, in their order. A simulator writes its log itself, so that no line is
    /// lost with a runner.
    pub fn begun(&self) -> Vec<Vec<String>> {
        let simulators = members().filter(|member| member.side == SIMULATOR);
        simulators.map(|member| begun(&self.log(Name::Of(member)))).collect()
    }

    /// The tails of all logs, for a failure.
    pub fn story(&self) -> String {
        let names = [Name::Workspace, Name::Logcopy]
            .into_iter()
            .chain(members().map(Name::Of));
        let tail = |name: Name| {
            let log = self.log(name);
            let from = log.lines().count().saturating_sub(40);
            let lines: Vec<&str> = log.lines().skip(from).collect();
            format!("--- {name}\n{}\n", lines.join("\n"))
        };
        let files = files_below(&self.places().logs);
        names.map(tail).chain([format!("--- files\n{files}")]).collect()
    }
}

impl Drop for Kubelet<'_> {
    fn drop(&mut self) {
        for pid in self.containers.keys().filter_map(|name| self.pid(*name)) {
            let orphans = children(pid);
            for pid in orphans.into_iter().chain([pid]) {
                let _ = kill(pid, Signal::SIGKILL);
            }
        }
    }
}

fn begun(log: &str) -> Vec<String> {
    let routes = log
        .lines()
        .filter_map(|line| line.strip_prefix("route ")?.split_once(" begins"));
    routes.map(|(route, _)| route.to_owned()).collect()
}

fn files_below(folder: &Path) -> String {
    let mut text = String::new();
    for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
        let path = entry.path();
        if path.is_dir() {
            text.push_str(&files_below(&path));
        } else {
            let size = entry.metadata().map_or(0, |metadata| metadata.len());
            text = format!("{text}{} {size}\n", path.display());
        }
    }
    text
}
