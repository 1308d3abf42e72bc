//! Stores files by the rules of the parent module: a few at a time, at most one part of each in memory.
//!
//! Called by `logcopy`. A file that can't be read, or for which there is no room, is left out and named; only S3's own failures
//! end a round.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use futures::StreamExt;
use tokio::sync::Semaphore;
use tokio::task::{JoinError, JoinSet};

use super::complaints::{Complaints, Why};
use super::job::{Job, Outcome, in_time, put};
use super::quota::{Kind, Ledger, Quota, cost};
use super::wanted::Wanted;
use super::{Decision, Memory, Stored, decide_upload};
use crate::blocking;
use crate::daily::today;
use leaderboard_aws::archive::{Archive, ArchiveError, Cause};
use leaderboard_evaluation::Object;
use leaderboard_evidence::{Stamp, Tree};

/// Files in the air at once.
const AT_ONCE: usize = 4;
/// Pause before a file that was cut is tried again; doubled each time.
const AFTER_A_CUT: Duration = Duration::from_mins(10);

/// Outcome of one round of files.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Sent {
    /// Objects written.
    pub objects: usize,
    /// Files that were due when the time was over.
    pub late: usize,
    /// Files that could not be read, did not fit into a limit, or took too long.
    pub left_out: usize,
}

/// How long files may take.
#[derive(Clone, Copy, Debug, Default)]
pub struct Window {
    /// From then on no file is begun.
    pub begin_until: Option<Instant>,
    /// Time at which requests under way are cut.
    pub cut_at: Option<Instant>,
    /// There is no later time for what would wait: neither the day's allowance nor an earlier cut holds it back.
    pub is_last: bool,
    /// Nobody reads any more what the evaluators have read: all else is sent before it.
    pub input_last: bool,
}

impl Window {
    /// Place of a kind in the order in which files are sent.
    fn place(self, kind: Kind) -> (bool, Kind) {
        (self.input_last && kind == Kind::Input, kind)
    }
}

/// Stores the files of one run.
#[derive(Debug)]
pub struct Uploader {
    archive: Archive,
    tree: Arc<Tree>,
    memory: Memory,
    quota: Quota,
    epoch: Instant,
    complaints: Complaints,
    /// Files that were cut.
    slow: BTreeMap<String, Slow>,
    /// Uploads of what the evaluators read, on their way beside the rounds: they may take longer than one. A failure there fails the next round.
    beside: JoinSet<(String, Outcome)>,
}

/// A file that was cut.
#[derive(Clone, Copy, Debug)]
struct Slow {
    /// When it is tried again, on the clock of [`Stored::at`].
    again: Duration,
    times: u32,
}

impl Uploader {
    /// With the memory of what an earlier program of this Pod stored.
    pub fn new(archive: Archive, tree: Arc<Tree>, quota: Quota) -> Self {
        Self {
            memory: Memory::load(&tree),
            archive,
            tree,
            quota,
            epoch: Instant::now(),
            complaints: Complaints::default(),
            slow: BTreeMap::new(),
            beside: JoinSet::new(),
        }
    }

    /// Stored objects.
    pub fn memory(&self) -> &Memory {
        &self.memory
    }

    /// Logs once why something is not stored.
    pub fn complain(&mut self, key: &str, why: &Why) {
        self.complaints.say(key, why);
    }

    /// Stores results that are in memory, each that is not what is stored already. They are stored even beyond the limit: what
    /// is in memory is bounded.
    pub async fn put(&mut self, objects: &BTreeMap<String, Object>) -> Result<Sent, ArchiveError> {
        let now = self.epoch.elapsed();
        let is_stored = |key: &String, object: &Object| {
            let known = self.memory.stored.get(key);
            known.is_some_and(|known| {
                known.stamp.size == object.digest.size && known.fingerprint == object.digest.sha256
            })
        };
        let new = objects.iter().filter(|(key, object)| !is_stored(key, object));
        let work = new.map(|(key, object)| {
            let known = self.memory.stored.get(key).and_then(|known| known.etag.clone());
            put(self.archive.clone(), key.clone(), object.clone(), known, now)
        });
        let work: Vec<_> = work.collect();
        let outcomes = futures::stream::iter(work).buffer_unordered(AT_ONCE).collect().await;
        let mut sent = Sent::default();
        let failed = self.settle(outcomes, None, &mut sent);
        if sent.objects > 0 || failed.is_some() {
            self.remember().await;
        }
        failed.map_or(Ok(sent), Err)
    }

    /// Gives up what is on its way beside the rounds.
    pub fn give_up(&mut self) {
        self.beside = JoinSet::new();
    }

    /// Stores what is due, the known logs first, as far as several at once allow. The first failure of S3 ends it; what was
    /// stored until then is remembered.
    pub async fn sync(&mut self, files: &[Wanted], window: Window) -> Result<Sent, ArchiveError> {
        let sent = self.pass(files, window).await?;
        if !window.is_last || self.beside.is_empty() {
            return Ok(sent);
        }
        let landed = self.land(window.cut_at).await?;
        // It sends what was not on its way yet, and counts what is missing.
        let rest = self.pass(files, window).await?;
        let objects = sent.objects.saturating_add(landed.objects);
        let objects = objects.saturating_add(rest.objects);
        Ok(Sent { objects, ..rest })
    }

    /// Waits for what is on its way beside the rounds, and gives up what still is when the time is over.
    async fn land(&mut self, cut_at: Option<Instant>) -> Result<Sent, ArchiveError> {
        let (mut sent, mut failed) = (Sent::default(), None);
        let all = async {
            while let Some(ended) = self.beside.join_next().await {
                let outcome = outcome_of(ended).into_iter().collect();
                failed = self.settle(outcome, None, &mut sent).or(failed.take());
            }
        };
        let _ = in_time(cut_at, all).await;
        self.give_up();
        self.remember().await;
        failed.map_or(Ok(sent), Err)
    }

    /// One pass over the files.
    async fn pass(&mut self, files: &[Wanted], window: Window) -> Result<Sent, ArchiveError> {
        let began = Instant::now();
        let mut sent = Sent::default();
        self.memory.sent.begin(today());
        let arrived = std::iter::from_fn(|| self.beside.try_join_next());
        let arrived: Vec<_> = arrived.filter_map(outcome_of).collect();
        let mut has_changed = !arrived.is_empty();
        let failed_beside = self.settle(arrived, None, &mut sent);
        let (jobs, left_out) = self.due(files, window);
        sent.left_out = sent.left_out.saturating_add(left_out.len());
        for (key, why) in &left_out {
            self.complaints.say(key, why);
        }
        for job in jobs.iter().filter(|job| job.is_shortened) {
            let Wanted { key, stamp, .. } = &job.wanted;
            self.complaints.say(key, &Why::Shortened(stamp.size));
        }
        let new = self.count_new(&jobs).await;
        let outcomes = send(self.send_beside(jobs, window), window).await;
        has_changed |= !outcomes.is_empty();
        let outcomes = outcomes.into_iter().map(|(job, outcome)| {
            let key = job.wanted.key;
            if !matches!(outcome, Outcome::Late) {
                self.memory.sent.add(&job.purse, job.cost);
            }
            if matches!(outcome, Outcome::Late | Outcome::LeftOut(_)) && new.contains(&key) {
                self.memory.stored.remove(&key);
            }
            (key, outcome)
        });
        let outcomes = outcomes.collect();
        let time = window.cut_at.map(|cut_at| cut_at.saturating_duration_since(began));
        let failed = self.settle(outcomes, time, &mut sent).or(failed_beside);
        if has_changed {
            self.remember().await;
        }
        failed.map_or(Ok(sent), Err)
    }

    /// Begins to send what the evaluators read, unless no round follows. Returns the other files.
    fn send_beside(&mut self, jobs: Vec<Job>, window: Window) -> Vec<Job> {
        let is_beside = |job: &Job| !window.is_last && self.quota.kind(&job.wanted.key) == Kind::Input;
        let (beside, others): (Vec<Job>, Vec<Job>) = jobs.into_iter().partition(is_beside);
        let places = Arc::new(Semaphore::new(AT_ONCE));
        for job in beside {
            let places = Arc::clone(&places);
            self.beside.spawn(async move {
                let _place = places.acquire().await;
                let outcome = job.store(None).await;
                (job.wanted.key, outcome)
            });
        }
        others
    }

    /// Counts the objects that are going to be made, before the first of them is: a logcopy that is killed meanwhile must not
    /// forget any. Returns their keys.
    async fn count_new(&mut self, jobs: &[Job]) -> BTreeSet<String> {
        let files = jobs.iter().map(|job| &job.wanted);
        let new = files.filter(|file| !self.memory.stored.contains_key(&file.key));
        let new = new.map(|file| (file.key.clone(), Stored::unknown(file.stamp.size)));
        let new: BTreeMap<String, Stored> = new.collect();
        if !new.is_empty() {
            self.memory.stored.extend(new.clone());
            self.remember().await;
        }
        new.into_keys().collect()
    }

    /// Takes in what became of the files, of which none had more time than `time`. Returns S3's failure, if there was one.
    fn settle(
        &mut self,
        outcomes: Vec<(String, Outcome)>,
        time: Option<Duration>,
        sent: &mut Sent,
    ) -> Option<ArchiveError> {
        let mut failed = None;
        for (key, outcome) in outcomes {
            match outcome {
                Outcome::Stored(stored, written) => {
                    sent.objects = sent.objects.saturating_add(usize::from(written));
                    self.slow.remove(&key);
                    self.memory.stored.insert(key, *stored);
                }
                Outcome::LeftOut(why) => {
                    sent.left_out = sent.left_out.saturating_add(1);
                    self.complaints.say(&key, &Why::File(why));
                }
                Outcome::Slow => {
                    sent.left_out = sent.left_out.saturating_add(1);
                    self.complaints.say(&key, &Why::Slow(time.unwrap_or_default()));
                    self.wait_after_a_cut(key);
                }
                Outcome::Late => sent.late = sent.late.saturating_add(1),
                Outcome::Failed(error) => {
                    if matches!(error.cause, Cause::Changed) {
                        // Another writer's object: it is written whole the next time.
                        self.forget_content(&key);
                    }
                    failed = Some(error);
                }
            }
        }
        failed
    }

    /// Forgets the content under a key: it is another's, or not known. It counts all the same.
    fn forget_content(&mut self, key: &str) {
        if let Some(known) = self.memory.stored.get_mut(key) {
            *known = Stored::unknown(known.stamp.size);
        }
    }

    fn wait_after_a_cut(&mut self, key: String) {
        let times = self.slow.get(&key).map_or(0, |slow| slow.times);
        let pause = AFTER_A_CUT.saturating_mul(1 << times.min(8));
        let again = self.epoch.elapsed().saturating_add(pause);
        let times = times.saturating_add(1);
        self.slow.insert(key, Slow { again, times });
    }

    /// The files that are due and fit, the known logs first, and what is to be shown of the others.
    fn due(&self, files: &[Wanted], window: Window) -> (Vec<Job>, Vec<(String, Why)>) {
        let is_last = window.is_last;
        let now = self.epoch.elapsed();
        let stored = self.memory.stored.iter();
        let stored = stored.map(|(key, stored)| (key.as_str(), stored.stamp.size));
        let (mut ledger, mut planned) = (self.quota.ledger(stored), self.memory.sent.clone());
        let mut files: Vec<&Wanted> = files.iter().collect();
        files.sort_by_key(|file| window.place(self.quota.kind(&file.key)));
        let (mut jobs, mut left_out, mut keys) = (Vec::new(), Vec::new(), BTreeSet::new());
        for file in files {
            let key = file.key.as_str();
            // Each of them is begun again only when all have ended.
            if !self.beside.is_empty() && self.quota.kind(key) == Kind::Input {
                continue;
            }
            // Two files under one key would overwrite each other in any order.
            if !keys.insert(key) {
                left_out.push((key.to_owned(), Why::SameKey));
                continue;
            }
            if !is_last && self.slow.get(key).is_some_and(|slow| slow.again > now) {
                continue;
            }
            let job = match self.job(file, &ledger, now) {
                Ok(None) => continue,
                Ok(Some(job)) => job,
                Err(why) => {
                    left_out.push((key.to_owned(), why));
                    continue;
                }
            };
            let allowed = self.quota.purse(key).1;
            if !is_last && !planned.of(&job.purse).plus(job.cost).fits(allowed) {
                left_out.push((key.to_owned(), Why::Day));
                continue;
            }
            ledger.take(
                key,
                job.known.as_ref().map(|known| known.stamp.size),
                job.wanted.stamp.size,
            );
            planned.add(&job.purse, job.cost);
            jobs.push(job);
        }
        (jobs, left_out)
    }

    /// A file that is due, with as many bytes as there is room for.
    fn job(&self, file: &Wanted, ledger: &Ledger<'_>, now: Duration) -> Result<Option<Job>, Why> {
        let known = self.memory.stored.get(&file.key);
        if decide_upload(&file.stamp, known, now, file.haste) == Decision::Keep {
            return Ok(None);
        }
        let before = known.map(|known| known.stamp.size);
        let size = ledger.admit(&file.key, before, file.stamp.size).map_err(Why::Limit)?;
        let stamp = Stamp { size, ..file.stamp };
        let is_shortened = size < file.stamp.size;
        // The beginning of a log that is too large is stored, and that does not change while the log grows.
        if is_shortened && known.is_some_and(|known| known.stamp.inode == stamp.inode && known.stamp.size >= size) {
            return Ok(None);
        }
        let decision = decide_upload(&stamp, known, now, file.haste);
        let job = || Job {
            archive: self.archive.clone(),
            tree: Arc::clone(&self.tree),
            wanted: Wanted { stamp, ..file.clone() },
            is_shortened,
            decision,
            known: known.cloned(),
            now,
            purse: self.quota.purse(&file.key).0.to_owned(),
            cost: cost(decision, size),
        };
        Ok((decision != Decision::Keep).then(job))
    }

    async fn remember(&self) {
        let (memory, tree) = (self.memory.clone(), Arc::clone(&self.tree));
        if let Err(error) = blocking(move || memory.save(&tree)).await {
            tracing::warn!("what is stored can't be noted down, a restart will send it again: {error}");
        }
    }
}

/// Outcome of an upload beside the rounds.
fn outcome_of(ended: Result<(String, Outcome), JoinError>) -> Option<(String, Outcome)> {
    let logged = ended.inspect_err(|error| {
        if !error.is_cancelled() {
            tracing::error!("an upload of what the evaluators read broke off, and is begun again: {error}");
        }
    });
    logged.ok()
}

/// Stores files. After a failure, or the end of the window, none begins. Those under way end or are cut, so that each is remembered.
async fn send(jobs: Vec<Job>, window: Window) -> Vec<(Job, Outcome)> {
    let broken = Arc::new(AtomicBool::new(false));
    let work = jobs.into_iter().map(|job| {
        let broken = Arc::clone(&broken);
        async move {
            let is_over = window.begin_until.is_some_and(|until| Instant::now() >= until);
            if is_over || broken.load(Ordering::Relaxed) {
                return (job, Outcome::Late);
            }
            let outcome = job.store(window.cut_at).await;
            if matches!(outcome, Outcome::Failed(_)) {
                broken.store(true, Ordering::Relaxed);
            }
            (job, outcome)
        }
    });
    futures::stream::iter(work).buffer_unordered(AT_ONCE).collect().await
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_the_evaluators_have_read_is_sent_last_when_nobody_reads_it_any_more() {
        use Kind::{Agent, Host, Input, Log, Result};
        for (input_last, expected) in [
            (false, [Result, Log, Input, Host, Agent]),
            (true, [Result, Log, Host, Agent, Input]),
        ] {
            let window = Window {
                input_last,
                ..Window::default()
            };
            let mut kinds = [Agent, Input, Host, Log, Result];
            kinds.sort_by_key(|kind| window.place(*kind));
            assert_eq!(kinds, expected);
        }
    }
}
