//! One container's life: looks at the world, asks `decide`, does what it decides. Called by `main`.
//!
//! All waiting is one `poll` over signals, folders and output; a look once a second stands behind it. Policy is `decide`'s.

mod agent_gpu;
mod evaluated;
mod nothing_left;
mod own_server;

use std::time::{Duration, Instant};

use leaderboard_protocol::files::{KEPT_CHECKPOINT, MAX_ROUNDS, Mark, Member, Progress, StatusFile};
use leaderboard_protocol::verdict::{CODE_NODE_REFUSED, Verdict};
use nix::sys::signal::Signal;

use crate::decide::{self, Action, Cause, Child, Conclusion, EndMark, Hold, Leave, Part, Phase, Seen, Skip};
use crate::group::{self, Group, Status};
use crate::keep::Keeper;
use crate::launch;
use crate::tee::{self, Tee};
use crate::wake::{Folders, Signals};
use crate::{kernel, memory, own_folder, report, result, say};
use leaderboard_runner::args::Job;

/// Behind inotify, for whatever it misses.
const SLOW_POLL: Duration = Duration::from_secs(1);
/// Longest pause between two tries of the server's port, and between two looks at what does not report its end.
const PROBE_EVERY: Duration = Duration::from_millis(100);
/// Shortest pause between two tries of the port. The pauses grow with the time the server takes.
const FIRST_PROBE: Duration = Duration::from_millis(2);
/// After SIGKILL, and for the last output: then the rest is given up.
const LAST_WAIT: Duration = Duration::from_secs(10);

/// One container of a pair.
#[derive(Debug)]
pub(crate) struct Runner {
    job: Job,
    part: Part,
    me: Member,
    peer: Member,
    round: u32,
    phase: Phase,
    /// When the present phase, or an agent's present round, began.
    since: Instant,
    next_probe: Instant,
    signals: Signals,
    folders: Folders,
    terminated: bool,
    group: Option<Group>,
    tee: Option<Tee>,
    /// A driver's.
    keeper: Option<Keeper>,
    /// An evaluator's.
    result: Option<result::Watched>,
    /// When an evaluator that runs has seen that its agent is done; one that is alone, when it began to run.
    agent_done: Option<Instant>,
    memory_kills: u64,
    /// A port of the host's command that another container has.
    taken_port: Option<u16>,
    /// A host's command was ready once.
    was_ready: bool,
    detail: Option<String>,
}

impl Runner {
    /// Prepares it; nothing is started or written yet.
    pub(crate) fn new(job: Job, signals: Signals) -> Self {
        let (me, peer) = (job.member(), job.peer());
        let logcopy = StatusFile::Stored.folder();
        let (checkpoint, result) = (job.checkpoint.clone(), job.result());
        let watched = checkpoint.as_deref().or(result.as_deref());
        let folders = Folders::watch(&job.status, &[peer.to_string(), logcopy], watched, job.inotify);
        let own = job.status.join(me.to_string());
        own_folder::reopen(&own);
        let keeper = checkpoint.map(|checkpoint| Keeper::new(checkpoint, own.join(KEPT_CHECKPOINT)));
        let round = Progress::read(&job.status, me).crashes;
        let now = Instant::now();
        Self {
            part: job.part,
            job,
            me,
            peer,
            round,
            phase: Phase::Opening,
            since: now,
            next_probe: now,
            signals,
            folders,
            terminated: false,
            group: None,
            tee: None,
            keeper,
            result: result.map(result::Watched::new),
            agent_done: None,
            memory_kills: memory::kills(),
            taken_port: None,
            was_ready: false,
            detail: None,
        }
    }

    /// Lives, ends, and returns the exit code.
    pub(crate) fn run(mut self) -> i32 {
        self.write_verdict(&Verdict::silent_death(self.round));
        let cause = self.live();
        let cause = self.of_the_server(cause);
        if cause == Cause::HasResult {
            self.let_end();
        }
        self.end_processes();
        let cause = self.of_its_ports(cause);
        let conclusion = self.conclude(cause);
        let code = self.hold(conclusion);
        self.say(&format!("exit {code}"));
        code
    }

    fn live(&mut self) -> Cause {
        if self.round >= MAX_ROUNDS {
            return self.too_many_crashes();
        }
        if let Err(cause) = self.report_gpu().and_then(|()| self.close_if_driven()) {
            return cause;
        }
        loop {
            let seen = self.look();
            let done = match decide::next(self.part, self.phase, &seen) {
                Action::Wait => {
                    self.wait(self.patience());
                    Ok(())
                }
                Action::Skip(skip) => self.skip(skip),
                Action::Launch => self.launch(),
                Action::Announce => self.announce(),
                Action::End(cause) => return cause,
            };
            if let Err(cause) = done {
                return cause;
            }
        }
    }

    fn look(&mut self) -> Seen {
        self.folders.refresh();
        if let Some(group) = &mut self.group {
            group.reap();
        }
        let (child, has_result) = (self.child(), self.has_result());
        let (me, peer, round) = (self.me, self.peer, self.round);
        let of = |member, mark| StatusFile::Of(member, mark).exists(&self.job.status);
        let seen = Seen {
            own_started: of(me, Mark::Start(round)),
            own_done: of(me, Mark::Done),
            peer_started: of(peer, Mark::Start(round)),
            peer_crashed: of(peer, Mark::Crash(round)),
            peer_done: of(peer, Mark::Done),
            has_result,
            held: self.phase == Phase::Opening && self.is_held(),
            cancel: StatusFile::Cancel.exists(&self.job.status),
            stored: StatusFile::Stored.exists(&self.job.status),
            child,
            agent_gpu: self.agent_gpu(),
            terminated: self.terminated,
            idle: self.idle_left() == Some(Duration::ZERO),
            overdue: false,
        };
        let seen = if self.job.alone { seen.alone(self.part) } else { seen };
        let since = seen.peer_done.then(|| self.agent_done.unwrap_or_else(Instant::now));
        self.agent_done = since.filter(|_| self.phase == Phase::Running);
        Seen {
            overdue: self.time_left() == Some(Duration::ZERO),
            ..seen
        }
    }

    fn child(&mut self) -> Child {
        if self.status().is_some() {
            return Child::Ended;
        }
        if self.phase == Phase::Booting && !self.was_ready && Instant::now() >= self.next_probe {
            self.next_probe = Instant::now() + (self.since.elapsed() / 8).clamp(FIRST_PROBE, PROBE_EVERY);
            self.was_ready = self.is_ready();
        }
        if self.was_ready { Child::Ready } else { Child::Quiet }
    }

    /// Until the agent has been silent for too long.
    fn idle_left(&self) -> Option<Duration> {
        let (idle, tee) = (self.job.idle?, self.tee.as_ref()?);
        // Output that waits in its pipe while the node reads no standard output is no silence. Only the node reads
        // there, so no command can bring this about.
        if tee.wants_stdout() {
            return Some(idle);
        }
        Some(idle.saturating_sub(tee.last_output().elapsed()))
    }

    /// Until what this side waits for is late. An agent grants its host the time to say so first.
    fn time_left(&self) -> Option<Duration> {
        let (since, limit) = match self.phase {
            Phase::Opening if !self.part.is_host() => (self.since, self.job.ready + self.job.peer),
            Phase::Booting => (self.since, self.job.ready),
            Phase::Running if self.part == Part::Evaluator => (self.agent_done?, self.job.answer),
            Phase::Opening | Phase::Running => return None,
        };
        Some(limit.saturating_sub(since.elapsed()))
    }

    fn patience(&self) -> Duration {
        let probe = self.next_probe.saturating_duration_since(Instant::now());
        let probe = (self.phase == Phase::Booting && !self.was_ready).then_some(probe);
        let copy = self.keeper.as_ref().and_then(Keeper::pause);
        [probe, copy, self.idle_left(), self.time_left()]
            .into_iter()
            .flatten()
            .fold(SLOW_POLL, Duration::min)
    }

    fn skip(&mut self, skip: Skip) -> Result<(), Cause> {
        let round = self.round;
        self.mark(Mark::Crash(round))?;
        self.say(match skip {
            Skip::SilentDeath => "was killed in this round without a word; it counts as a crash",
            Skip::CatchUp => "the other side crashed in this round before this one started; on to the next",
        });
        if round + 1 >= MAX_ROUNDS {
            return Err(self.too_many_crashes());
        }
        self.round = round + 1;
        self.write_verdict(&Verdict::silent_death(self.round));
        if !self.part.is_host() {
            self.since = Instant::now();
        }
        Ok(())
    }

    fn launch(&mut self) -> Result<(), Cause> {
        if !self.part.is_host() {
            self.mark(Mark::Start(self.round))?;
        }
        if let Some(Err(error)) = self.keeper.as_mut().map(Keeper::prepare) {
            self.detail = Some(error.to_string());
            return Err(if error.is_nodes() {
                Cause::NodeRefused
            } else {
                Cause::CannotStart(decide::CODE_NOT_RESUMED)
            });
        }
        self.since = Instant::now();
        match launch::launch(&self.job, self.round) {
            Ok((group, tee)) => {
                self.say("the command is started");
                (self.group, self.tee) = (Some(group), tee);
                self.phase = if self.part.is_host() {
                    Phase::Booting
                } else {
                    Phase::Running
                };
                Ok(())
            }
            Err(error) => {
                self.detail = Some(error.to_string());
                Err(error.cause())
            }
        }
    }

    fn announce(&mut self) -> Result<(), Cause> {
        self.mark(Mark::Start(self.round))?;
        self.say(&format!(
            "the {} is ready after {:.1} s",
            report::noun(self.part),
            self.since.elapsed().as_secs_f64()
        ));
        self.phase = Phase::Running;
        Ok(())
    }

    /// No run crashes so often: an agent has made the files itself, and its host must not answer for it.
    fn too_many_crashes(&mut self) -> Cause {
        let of_peer = StatusFile::Of(self.peer, Mark::Crash(MAX_ROUNDS - 1));
        if self.part.is_host() && of_peer.exists(&self.job.status) {
            return Cause::PeerCrashed;
        }
        self.mute("the status folder holds more crashes than can be counted".to_owned())
    }

    fn mark(&mut self, mark: Mark) -> Result<(), Cause> {
        self.write(&StatusFile::Of(self.me, mark))
    }

    fn write(&mut self, file: &StatusFile) -> Result<(), Cause> {
        let Err(error) = file.create(&self.job.status) else {
            return Ok(());
        };
        let cause = self.mute(format!("the status file {} cannot be created: {error}", file.name()));
        // Once the command has run, what the runner lacks can be the command's doing.
        let is_nodes = self.group.is_none() && kernel::is_nodes(&error);
        Err(if is_nodes { Cause::NodeRefused } else { cause })
    }

    fn mute(&mut self, detail: String) -> Cause {
        self.detail = Some(detail);
        Cause::Mute
    }

    /// Ends everything the command has started: SIGTERM to its group, after the grace SIGKILL, also to what had left the
    /// group; then reads the rest of the output. In a container nothing is left that could write over the verdict.
    fn end_processes(&mut self) {
        if let Some(group) = &self.group {
            group.signal(Signal::SIGTERM);
        }
        let begin = Instant::now();
        let (grace, limit) = (self.job.grace, self.job.grace + LAST_WAIT);
        while let Some(group) = &mut self.group {
            group.reap();
            let (group_lives, spent) = (group.lives(), begin.elapsed());
            if group_lives && spent >= grace {
                group.signal(Signal::SIGKILL);
            }
            let stragglers = if !group_lives || spent >= grace {
                group::kill_all_others();
                Group::kill_children()
            } else {
                0
            };
            if !group_lives && stragglers == 0 {
                break;
            }
            if spent >= limit {
                self.say("processes are left that do not die of SIGKILL");
                break;
            }
            // Only the command's own end comes as a signal; that of its grandchildren, while their parent lives, does not.
            self.wait(Duration::from_millis(20));
        }
        self.drain_output();
    }

    fn drain_output(&mut self) {
        let begin = Instant::now();
        while self.tee.as_ref().is_some_and(|tee| !tee.finished()) {
            if begin.elapsed() >= LAST_WAIT {
                let unsent = self.tee.as_ref().map_or(0, Tee::unsent);
                self.say(&format!(
                    "the output did not end; {unsent} bytes of it were not taken by standard output"
                ));
                break;
            }
            self.wait(PROBE_EVERY);
        }
    }

    fn conclude(&mut self, cause: Cause) -> Conclusion {
        let ran = self.group.is_some();
        own_folder::reopen(&self.job.status.join(self.me.to_string()));
        let (complete, left) = self.results(cause);
        let cause = self.of_the_result(cause, complete);
        self.report(&report::End {
            status: self.status(),
            out_of_memory: ran && memory::kills() > self.memory_kills,
            left,
            ..self.end(cause)
        });
        let seen = self.look();
        self.announce_end(decide::conclude(self.part, cause, complete, &seen))
    }

    /// Writes the file that belongs to the conclusion. If that fails, the conclusion changes: other containers rely on the file.
    fn announce_end(&mut self, conclusion: Conclusion) -> Conclusion {
        let mark = match conclusion.mark {
            None => return conclusion,
            Some(EndMark::Done) => Mark::Done,
            Some(EndMark::Crash) => Mark::Crash(self.round),
        };
        let Err(cause) = self.mark(mark) else { return conclusion };
        self.report(&self.end(cause));
        Conclusion {
            mark: None,
            hold: Hold::Free,
            code: if cause == Cause::NodeRefused {
                CODE_NODE_REFUSED
            } else {
                decide::CODE_MUTE
            },
        }
    }

    fn hold(&mut self, mut conclusion: Conclusion) -> i32 {
        let mut since = Instant::now();
        loop {
            let left = self.hold_limit(conclusion.hold).saturating_sub(since.elapsed());
            let seen = self.look();
            match decide::leave(self.part, conclusion, &seen, left.is_zero()) {
                Leave::Exit(code) => return code,
                Leave::Wait => self.wait(left.min(SLOW_POLL)),
                Leave::Hold(next) => {
                    since = Instant::now();
                    conclusion = self.announce_end(next);
                }
            }
        }
    }

    fn hold_limit(&self, hold: Hold) -> Duration {
        match hold {
            Hold::Peer if !self.job.alone => self.job.peer,
            Hold::Flush => self.job.flush,
            Hold::Cancel => self.job.cancel,
            Hold::Free | Hold::Peer => Duration::ZERO,
        }
    }

    /// Waits until something may have changed, at most `limit`, and handles signals and output.
    fn wait(&mut self, limit: Duration) {
        let awake = self.signals.fds().into_iter().chain(self.folders.fd());
        let readable = tee::wait(awake, self.tee.as_ref(), limit);
        self.terminated |= self.signals.drain();
        let written = self.folders.drain();
        if let Some(keeper) = self.keeper.as_mut().filter(|_| self.group.is_some()) {
            keeper.follow(written);
        }
        if let Some(tee) = &mut self.tee {
            if readable {
                tee.read();
            }
            tee.write();
        }
        if let Some(group) = &mut self.group {
            group.reap();
        }
    }

    /// How the command ended, if it has.
    fn status(&self) -> Option<Status> {
        self.group.as_ref().and_then(Group::status)
    }

    /// An end of which nothing but its cause is known.
    fn end(&self, cause: Cause) -> report::End<'_> {
        report::End {
            alone: self.job.alone,
            ..report::End::of(self.part, self.round, cause, self.detail.as_deref())
        }
    }

    fn report(&self, end: &report::End<'_>) {
        let verdict = report::verdict(end);
        self.write_verdict(&verdict);
        self.say(&verdict.why);
    }

    fn write_verdict(&self, verdict: &Verdict) {
        report::write(&self.job.termination_log, &verdict.to_json());
    }

    fn say(&self, text: &str) {
        say(format_args!("{} round {}: {text}", self.me, self.round));
    }
}
