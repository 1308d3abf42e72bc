//! One round: read, judge, check the fence, store, report.
//!
//! Called by the loop of the parent module. The content of a report is in [`super::describe`].

use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use hyper::body::Bytes;
use tokio::sync::watch;

use super::describe::{describe, to_bytes};
use super::{LANDING, LAST_FLUSH, LogcopyError, create};
use crate::blocking;
use crate::places::Setting;
use crate::upload::Haste;
use crate::upload::complaints::Why as Complaint;
use crate::upload::send::{Uploader, Window};
use crate::upload::wanted::{Files, Wanted};
use crate::watch::Watch;
use leaderboard_aws::archive::{Archive, ArchiveError, Fetched};
use leaderboard_base::lock::lock;
use leaderboard_contract::keys::agent_folder;
use leaderboard_contract::report::{Logs, OWNER_KEY, Owner, REPORT_KEY, Report};
use leaderboard_contract::run::{STATUS_FOLDER, Stop};
use leaderboard_evaluation::judge::{Ending, Judge, Outside, Step, decide};
use leaderboard_evaluation::{Gathered, Object, Results, of_plan};
use leaderboard_evidence::Tree;
use leaderboard_protocol::files as protocol;
use leaderboard_protocol::files::{Host, Mark, Pair, StatusFile};

/// Rounds of a container whose status files are stored: far more than retries a host forgives.
const STATUS_ROUNDS: u32 = 64;
/// Longest time for the last logs if the node is about to be taken away: with the agents' end before it and their hosts' after it,
/// all is stored before the controller deletes the Pod, 90 s after it has noticed.
const LAST_LOGS_BEFORE_NODE: Duration = Duration::from_secs(40);
/// Bytes of the owner that are read.
const OWNER_BYTES: u64 = 1024;

/// Why there is a round.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Why {
    /// Its time has come, or something changed.
    Period,
    /// The last one.
    Shutdown,
}

/// Files on the volume.
#[derive(Debug)]
struct Found {
    gathered: Gathered,
    /// Without the logs, which are taken out.
    files: Files,
    logs: Vec<Wanted>,
    statuses: Vec<StatusFile>,
}

/// News for the rounds from other tasks.
pub(super) struct News {
    pub(super) stop: watch::Receiver<Option<Stop>>,
    /// State of the lines for CloudWatch.
    pub(super) logs: watch::Receiver<Option<Logs>>,
}

/// The rounds of one life.
pub(super) struct Rounds {
    setting: Setting,
    archive: Archive,
    tree: Arc<Tree>,
    results: Arc<Mutex<Box<dyn Results>>>,
    uploader: Uploader,
    stop: watch::Receiver<Option<Stop>>,
    logs: watch::Receiver<Option<Logs>>,
    judge: Judge,
    folders: Option<Arc<Watch>>,
    epoch: Instant,
    last: Instant,
    reported: Option<Report>,
    report_etag: Option<String>,
    owner_etag: Option<String>,
    owner_missed: bool,
    ending: Option<Ending>,
    /// Until when the last logs are stored, and in which kind of round that began.
    logs_until: Option<(Why, Instant)>,
    /// The final report is stored, and the logs as far as there was time.
    finished: bool,
    /// Another Pod owns the prefix.
    fenced: bool,
}

impl Rounds {
    pub(super) fn new(
        setting: Setting,
        archive: Archive,
        tree: Arc<Tree>,
        results: Box<dyn Results>,
        uploader: Uploader,
        News { stop, logs }: News,
    ) -> Self {
        // A logcopy before this one may have come to the end already.
        let finished = StatusFile::Stored.exists(&setting.places.status());
        Self {
            setting,
            archive,
            tree,
            results: Arc::new(Mutex::new(results)),
            uploader,
            stop,
            logs,
            judge: Judge::default(),
            folders: Watch::new(is_news).ok().map(Arc::new),
            epoch: Instant::now(),
            last: Instant::now(),
            reported: None,
            report_etag: None,
            owner_etag: None,
            owner_missed: false,
            ending: None,
            logs_until: None,
            finished,
            fenced: false,
        }
    }

    /// How long storing may take at the end.
    pub(super) fn flush(&self) -> Duration {
        Duration::from_secs(self.setting.run.flush_seconds)
    }

    /// Time for the last logs: as much is left for what comes after them.
    fn time_for_last_logs(&self, why: Why) -> Duration {
        let longest = match why {
            Why::Period => self.flush(),
            Why::Shutdown => self.flush().min(LAST_FLUSH),
        };
        let longest = longest.checked_div(2).unwrap_or(longest);
        match *self.stop.borrow() {
            Some(Stop::Interruption) => longest.min(LAST_LOGS_BEFORE_NODE),
            _ => longest,
        }
    }

    fn period(&self) -> Duration {
        Duration::from_secs(self.setting.run.period_seconds).max(self.setting.pace.least)
    }

    /// The pause after this many failures in a row.
    pub(super) fn after_failures(&self, failures: u32) -> Duration {
        let factor = 1 << failures.saturating_sub(1).min(8);
        let pause = self.setting.pace.least.saturating_mul(factor);
        pause.min(self.setting.pace.backoff)
    }

    /// Waits for the next round: its time, a stop, or a change that can't wait. There is none after the end.
    pub(super) async fn wake(&mut self, pause: Duration) {
        if self.finished || self.fenced {
            return std::future::pending().await;
        }
        self.watch_folders().await;
        let folders = self.folders.as_ref();
        let changed = async {
            match folders {
                Some(watch) => watch.changed().await,
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            biased;
            stopped = self.stop.changed() => if stopped.is_err() {
                tokio::time::sleep(pause).await;
            },
            () = changed => {}
            () = tokio::time::sleep(pause) => {}
        }
        let spacing = self.setting.pace.least.saturating_sub(self.last.elapsed());
        tokio::time::sleep(spacing).await;
    }

    /// The kubelet makes the folders when it makes the containers, so they are looked for again each time.
    async fn watch_folders(&self) {
        let Some(watch) = self.folders.clone() else { return };
        let status = self.setting.places.status();
        let mut folders = vec![status.clone(), self.tree.path().join("agent")];
        for pair in Pair::first(self.pairs()) {
            folders.push(self.tree.path().join(agent_folder(pair)));
            let members = [pair.host(self.host()), pair.agent()];
            folders.extend(members.map(|member| status.join(member.to_string())));
        }
        // Without a watch the period is all there is.
        let _ = tokio::task::spawn_blocking(move || folders.iter().for_each(|folder| _ = watch.add(folder))).await;
    }

    fn pairs(&self) -> usize {
        self.setting.run.plan.workers()
    }

    fn host(&self) -> Host {
        of_plan(&self.setting.run.plan).host()
    }

    /// One round. Returns how long the next one may wait.
    pub(super) async fn round(&mut self, why: Why) -> Result<Duration, LogcopyError> {
        self.last = Instant::now();
        if self.fenced || (self.finished && why == Why::Period) {
            return Ok(self.period());
        }
        let found = self.read().await?;
        let pause = self.judge(&found).await;
        if !self.owns_prefix().await? {
            self.give_up().await;
            return Ok(self.period());
        }
        let at_end = self.ending.is_some() || why == Why::Shutdown;
        if !self.finished {
            self.uploader.put(&found.gathered.objects).await?;
        }
        // After the final report only what has come since: the last status files and our own last lines.
        self.store_statuses(&found.statuses).await?;
        if !self.finished {
            // Logs must keep neither the progress back nor the end.
            self.report(&found).await?;
        }
        if found.files.left_out > 0 {
            let left_out = Complaint::Entries(found.files.left_out);
            self.uploader.complain("logs", &left_out);
        }
        self.store_logs(found.logs, at_end.then_some(why)).await?;
        if self.ending.is_some() && !self.finished {
            self.finish(&found.gathered).await?;
        }
        Ok(pause)
    }

    /// Reads the volume, on a thread that may block.
    async fn read(&self) -> Result<Found, LogcopyError> {
        let (tree, reader) = (Arc::clone(&self.tree), Arc::clone(&self.results));
        let status = self.setting.places.status();
        let (pairs, host) = (self.pairs(), self.host());
        let read = move || {
            let gathered = lock(&reader).round();
            let mut files = Files::find(&tree, pairs, host);
            Ok(Found {
                logs: files.wanted(&gathered.refused, host),
                gathered,
                statuses: protocol::present(&status, u16::try_from(pairs).unwrap_or(u16::MAX), host),
                files,
            })
        };
        blocking(read).await
    }

    /// Draws the consequences of what was read. Returns how long the next round may wait.
    async fn judge(&mut self, found: &Found) -> Duration {
        let outside = Outside {
            stop: *self.stop.borrow_and_update(),
            cancelled: found.statuses.contains(&StatusFile::Cancel),
            activity: found.files.activity,
            now: self.epoch.elapsed(),
        };
        let seen = self.judge.see(&found.gathered, outside);
        if self.ending.is_some() {
            return self.setting.pace.least;
        }
        let longest = Duration::from_secs(self.setting.run.cancel_seconds);
        match decide(&seen, &self.setting.pace, longest) {
            Step::GoOn => {}
            Step::Cancel => {
                create(StatusFile::Cancel, &self.setting.places.status()).await;
            }
            Step::Finish(ending) => {
                tracing::info!("{ending}; storing the rest");
                self.ending = Some(ending);
            }
        }
        let is_ending = seen.stop.is_some() || seen.complete.is_some() || seen.spoiled.is_some();
        let soon = Duration::from_secs(1).max(self.setting.pace.least);
        if is_ending {
            soon.min(self.period())
        } else {
            self.period()
        }
    }

    /// True if this Pod's writes still count.
    async fn owns_prefix(&mut self) -> Result<bool, ArchiveError> {
        let known = self.owner_etag.as_deref();
        match self.archive.get_if_none_match(OWNER_KEY, known, OWNER_BYTES).await? {
            Fetched::NotModified => Ok(true),
            Fetched::Found(object) => {
                let ours = Owner::parse(&object.bytes).is_some_and(|owner| owner.owner == self.setting.pod_uid);
                self.owner_etag = object.etag.filter(|_| ours);
                Ok(ours)
            }
            Fetched::Absent => {
                if !std::mem::replace(&mut self.owner_missed, true) {
                    tracing::warn!(
                        "{OWNER_KEY} is gone from the prefix; no other Pod has taken it, so this one goes on"
                    );
                }
                Ok(true)
            }
        }
    }

    /// Another Pod has taken over: this one ends, and nothing of it is stored any more.
    async fn give_up(&mut self) {
        tracing::warn!("another Pod owns this run's prefix; this one stores nothing more and stops");
        self.fenced = true;
        self.uploader.give_up();
        let status = self.setting.places.status();
        create(StatusFile::Cancel, &status).await;
        // Frees the host's containers from waiting for a store that will not come.
        create(StatusFile::Stored, &status).await;
    }

    /// The status files, flat, as they have always been stored. Only their names mean something, so they are stored empty:
    /// what an agent puts into its own is never read.
    async fn store_statuses(&mut self, statuses: &[StatusFile]) -> Result<(), ArchiveError> {
        let empty = Object::new(Bytes::new());
        let key = |file: &StatusFile| format!("{STATUS_FOLDER}/{}", file.name());
        let (stored, endless): (Vec<&StatusFile>, Vec<&StatusFile>) =
            statuses.iter().partition(|file| is_of_first_rounds(file));
        if let Some(first) = endless.first() {
            self.uploader.complain(&key(first), &Complaint::Statuses(STATUS_ROUNDS));
        }
        let objects: BTreeMap<String, Object> = stored.into_iter().map(|file| (key(file), empty.clone())).collect();
        self.uploader.put(&objects).await.map(drop)
    }

    /// The logs: what is due, no longer than a period, and what is in the air then not much longer. `last`: all of them, in a
    /// part of the time that the end may take.
    async fn store_logs(&mut self, mut files: Vec<Wanted>, last: Option<Why>) -> Result<(), ArchiveError> {
        let now = Instant::now();
        let Some(why) = last else {
            let begin_until = now.checked_add(self.period().max(self.setting.pace.logs));
            let cut_at = begin_until.and_then(|until| until.checked_add(self.setting.pace.in_air));
            let window = Window {
                begin_until,
                cut_at,
                ..Window::default()
            };
            return tokio::select! {
                biased;
                // The results come first then; the last logs read everything once more.
                () = before_node_goes(self.stop.clone()) => Ok(()),
                sent = self.uploader.sync(&files, window) => sent.map(drop),
            };
        };
        for file in &mut files {
            file.haste = Haste::Now;
        }
        let until = match self.logs_until {
            // A round that failed has used some of it.
            Some((begun, until)) if begun == why => until,
            _ => now.checked_add(self.time_for_last_logs(why)).unwrap_or(now),
        };
        self.logs_until = Some((why, until));
        let window = Window {
            begin_until: Some(until),
            cut_at: Some(until),
            is_last: true,
            input_last: self.ending == Some(Ending::Complete),
        };
        let sent = self.uploader.sync(&files, window).await?;
        if sent.late > 0 {
            self.uploader.complain("logs", &Complaint::Ended(sent.late));
        }
        Ok(())
    }

    /// Stores the report, if it differs from the last one.
    async fn report(&mut self, found: &Found) -> Result<(), ArchiveError> {
        let mut report = describe(
            &self.setting.run,
            &self.setting.pod_uid,
            &found.gathered,
            self.ending.as_ref(),
        );
        report.round = self.reported.as_ref().map_or(0, |reported| reported.round);
        report.agents_fill_disk = found.files.agents_fill_disk;
        report.logs.clone_from(&self.logs.borrow());
        if self.reported.as_ref() == Some(&report) {
            return Ok(());
        }
        report.round = report.round.saturating_add(1);
        let (bytes, known) = (to_bytes(&report).into(), self.report_etag.as_deref());
        self.report_etag = self.archive.replace(REPORT_KEY, bytes, known).await?;
        self.reported = Some(report);
        Ok(())
    }

    /// The final report is stored: announces that in the Pod, and ends the agents that still run.
    async fn finish(&mut self, gathered: &Gathered) -> Result<(), LogcopyError> {
        let status = self.setting.places.status();
        let folder = status.clone();
        blocking(move || StatusFile::Stored.create(&folder)).await?;
        self.finished = true;
        tracing::info!("the final report is stored");
        if let Err(error) = self.store_statuses(&[StatusFile::Stored]).await {
            tracing::warn!("logcopy.done is not stored: {error}");
        }
        if gathered.seen.iter().any(|worker| !worker.done) {
            // Complete results need no running worker.
            create(StatusFile::Cancel, &status).await;
        }
        Ok(())
    }
}

/// Ends when a round under way has had its time to land, once the node is known to be taken away. Any other stop leaves a log its
/// time.
async fn before_node_goes(mut stop: watch::Receiver<Option<Stop>>) {
    let is_it = |stop: &Option<Stop>| *stop == Some(Stop::Interruption);
    if stop.wait_for(is_it).await.is_err() {
        return std::future::pending().await;
    }
    tokio::time::sleep(LANDING).await;
}

/// An agent can make any number of them.
fn is_of_first_rounds(file: &StatusFile) -> bool {
    match file {
        StatusFile::Of(_, Mark::Start(round) | Mark::Crash(round)) => *round < STATUS_ROUNDS,
        _ => true,
    }
}

/// True for a name that can't wait for the period: a container's new status file, or its new folder. Results can wait: an agent that writes
/// all the time must not set the pace.
fn is_news(name: &OsStr) -> bool {
    let Some(name) = name.to_str() else { return false };
    let is_mark = [".start", ".crash", ".done"].iter().any(|mark| name.contains(mark));
    let starts = ["agent", "simulator-", "evaluator-"];
    let is_folder = starts.iter().any(|start| name.starts_with(start)) && !name.contains('.');
    is_mark || is_folder
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_marks_and_the_folders_of_containers_are_news() {
        for news in [
            "evaluator-1",
            "simulator-2",
            "agent-1",
            "agent1",
            "evaluator-1.start0",
            "agent-1.done",
        ] {
            assert!(is_news(OsStr::new(news)), "{news}");
        }
        for other in [
            "result.json",
            ".result.json",
            "console.log",
            "evaluators",
            "agent_results.json",
        ] {
            assert!(!is_news(OsStr::new(other)), "{other}");
        }
    }

    #[tokio::test(start_paused = true)]
    async fn only_a_node_that_goes_cuts_the_logs_of_a_round_under_way() {
        let (sender, receiver) = watch::channel(None);
        for stop in [Stop::Cancel, Stop::Retries, Stop::RunDeadline] {
            sender.send_replace(Some(stop));
            let hour = Duration::from_hours(1);
            let cut = tokio::time::timeout(hour, before_node_goes(receiver.clone())).await;
            assert!(cut.is_err(), "{stop:?}");
        }
        let began = tokio::time::Instant::now();
        let cut = before_node_goes(receiver);
        sender.send_replace(Some(Stop::Interruption));
        cut.await;
        assert_eq!(began.elapsed(), LANDING, "what is in the air has its time to land");
    }
}
