//! The results of all workers, read and merged round by round, whatever kind of evaluation they are of.
//!
//! Called by `logcopy` once a round. Reads the `logs` volume through [`Tree`] and writes nothing; knows no S3. Results that are torn,
//! gone, refused or poorer leave the last good ones in place. These are handed out from memory to be stored, so that no torn file and no
//! full disk comes between the results and S3. [`Kind::limit`] bounds the memory.

use std::fmt::Debug;
use std::path::PathBuf;
use std::sync::Arc;

use leaderboard_contract::keys::results_path;
use leaderboard_contract::report::{RefusedResults, ReportWorker};
use leaderboard_contract::run::{Run, STATUS_FOLDER};
use leaderboard_evidence::{Stamp, Tree, TreeError};
use leaderboard_protocol::files::{Host, Pair};

use crate::judge::Ending;
use crate::{Gathered, Object, Objects, Refused, Results, Summary, Texts, WorkerSeen};

/// A kind's own knowledge of its results.
pub(crate) trait Kind: Debug + Send + Sized {
    /// The results of one worker, read and within bounds.
    type Found: Debug + Send;
    const HOST: Host;
    /// The side of a worker that writes results, and their file, in sentences.
    const WRITER: &'static str;
    const FILE: &'static str;
    /// Next step after a file that is none.
    const NEXT_STEP: &'static str;
    /// The end that follows from results that can't be read, or are not complete.
    const FAULT: fn(RefusedResults) -> Ending;

    /// For a run whose plan holds.
    fn of(run: &Run) -> Result<Self, Refused>;

    /// Largest results of a worker, in bytes.
    fn limit(&self, worker: Pair) -> u64;

    /// Reads the results of a worker; `None` for half of them.
    fn read(&self, worker: Pair, bytes: &[u8]) -> Result<Option<Self::Found>, Ending>;

    /// The results that count after others; `None` if they have less.
    fn after(found: Self::Found, good: &Self::Found) -> Option<Self::Found>;

    /// A worker that has done nothing yet, but for what its results say.
    fn reported(&self, worker: Pair, good: Option<&Self::Found>) -> ReportWorker;

    /// Why a worker that ends with these results spoils the run; `None` if they are complete.
    fn incomplete(reported: &ReportWorker, good: Option<&Self::Found>) -> Option<String>;

    /// The results of all workers as one.
    fn merge(&self, workers: &[Option<&Self::Found>]) -> Result<Merged, Ending>;

    /// A copy of a worker's results that is whole while the file is written.
    fn kept_path(_worker: Pair) -> Option<String> {
        None
    }

    /// Removes restored results that belong to another plan.
    fn remove_others(&self, _tree: &Tree) -> Result<(), TreeError> {
        Ok(())
    }
}

/// The results of all workers as one.
pub(crate) struct Merged {
    /// `None` before the first results.
    pub(crate) summary: Option<Summary>,
    pub(crate) texts: Texts,
    /// Files beside the results of the workers.
    pub(crate) objects: Objects,
}

/// One worker, over the rounds.
#[derive(Debug)]
struct Worker<F> {
    pair: Pair,
    has_agent: bool,
    good: Option<F>,
    seen: Option<Stamp>,
    /// The copy as it was read last.
    kept: Option<Stamp>,
    refused: Option<Ending>,
    /// Why this node can't read it at present, which says nothing about its content.
    unreadable: Option<String>,
}

/// State of a file after a look at it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum ReadOutcome {
    /// Another good one.
    New,
    /// Nothing that was not known.
    Same,
    /// None, or half of one.
    Unusable,
}

/// Reads the volume round by round.
#[derive(Debug)]
pub(crate) struct Gatherer<K: Kind> {
    kind: K,
    tree: Arc<Tree>,
    status: PathBuf,
    workers: Vec<Worker<K::Found>>,
    merged: Option<Arc<Summary>>,
    texts: Arc<Texts>,
    objects: Objects,
    unmerged: Option<Ending>,
}

impl<K: Kind> Results for Gatherer<K> {
    fn round(&mut self) -> Gathered {
        // The status files are read before the results: a worker that is done has written everything.
        let seen: Vec<WorkerSeen> = self
            .workers
            .iter()
            .map(|worker| WorkerSeen::read(&self.status, worker.pair, K::HOST, worker.has_agent))
            .collect();
        let mut changed = false;
        for index in 0..self.workers.len() {
            changed |= match self.read(index) {
                ReadOutcome::New => true,
                ReadOutcome::Same => false,
                ReadOutcome::Unusable => self.read_kept(index),
            };
        }
        if changed {
            self.merge();
        }
        let workers = self.reported(&seen);
        Gathered {
            merged: self.merged.clone(),
            texts: Arc::clone(&self.texts),
            objects: self.objects.clone(),
            if_ended: self.workers.iter().zip(&workers).map(if_ended::<K>).collect(),
            workers,
            seen,
            refused: self.workers.iter().map(|worker| worker.refused.clone()).collect(),
            unreadable: self.workers.iter().map(|worker| worker.unreadable.is_some()).collect(),
            unmerged: self.unmerged.clone(),
        }
    }

    fn remove_others(&self) -> Result<(), TreeError> {
        self.kind.remove_others(&self.tree)
    }
}

impl<K: Kind> Gatherer<K> {
    /// For a run whose plan holds.
    pub(crate) fn new(run: &Run, tree: Arc<Tree>) -> Result<Self, Refused> {
        let kind = K::of(run)?;
        let workers = Pair::first(run.plan.workers()).map(|pair| Worker {
            pair,
            has_agent: run.plan.has_agent(pair.get().into()),
            good: None,
            seen: None,
            kept: None,
            refused: None,
            unreadable: None,
        });
        let mut gatherer = Self {
            status: tree.path().join(STATUS_FOLDER),
            workers: workers.collect(),
            kind,
            tree,
            merged: None,
            texts: Arc::default(),
            objects: Objects::new(),
            unmerged: None,
        };
        gatherer.merge();
        Ok(gatherer)
    }

    /// Reads one worker's results, if they are not those of the last round.
    fn read(&mut self, index: usize) -> ReadOutcome {
        let Some(worker) = self.workers.get_mut(index) else {
            return ReadOutcome::Unusable;
        };
        let path = results_path(K::HOST, worker.pair);
        let (file, stamp) = match self.tree.file(&path) {
            Ok(Some(found)) => found,
            Ok(None) => {
                worker.unreadable = None;
                return ReadOutcome::Unusable;
            }
            Err(error) => return worker.cannot_read::<K>(&error),
        };
        if worker.seen == Some(stamp) {
            worker.unreadable = None;
            return ReadOutcome::Same;
        }
        drop(file);
        let (bytes, stamp) = match self.tree.read(&path, self.kind.limit(worker.pair)) {
            Ok(Some(read)) => read,
            // The next round finds it whole.
            Ok(None) | Err(TreeError::Changed) => return ReadOutcome::Unusable,
            Err(error) => return worker.cannot_read::<K>(&error),
        };
        worker.unreadable = None;
        match self.kind.read(worker.pair, &bytes) {
            Ok(None) => ReadOutcome::Unusable,
            Ok(Some(found)) => {
                worker.seen = Some(stamp);
                if let Some(before) = worker.refused.take() {
                    tracing::info!(
                        "{} of {} {} is good again; before: {before}",
                        K::FILE,
                        K::WRITER,
                        worker.pair
                    );
                }
                if !worker.take::<K>(found) {
                    tracing::info!("{} {} has less than before, which stays", K::WRITER, worker.pair);
                    return ReadOutcome::Same;
                }
                self.objects.insert(path, Object::new(bytes));
                ReadOutcome::New
            }
            Err(refused) => {
                worker.seen = Some(stamp);
                worker.refuse(refused)
            }
        }
    }

    /// Reads the copy, when the file itself is being written: that is further than what this logcopy has read, if its rounds are rare, or
    /// it has begun just now.
    fn read_kept(&mut self, index: usize) -> bool {
        let Some(worker) = self.workers.get_mut(index) else {
            return false;
        };
        let Some(path) = K::kept_path(worker.pair) else {
            return false;
        };
        match self.tree.file(&path) {
            Ok(Some((_, stamp))) if worker.kept != Some(stamp) => {}
            _ => return false,
        }
        let Ok(Some((bytes, stamp))) = self.tree.read(&path, self.kind.limit(worker.pair)) else {
            return false;
        };
        worker.kept = Some(stamp);
        let Ok(Some(kept)) = self.kind.read(worker.pair, &bytes) else {
            return false;
        };
        let is_taken = worker.take::<K>(kept);
        if is_taken {
            let path = results_path(K::HOST, worker.pair);
            self.objects.insert(path, Object::new(bytes));
        }
        is_taken
    }

    fn merge(&mut self) {
        let workers: Vec<Option<&K::Found>> = self.workers.iter().map(|worker| worker.good.as_ref()).collect();
        match self.kind.merge(&workers) {
            Ok(merged) => {
                self.objects.extend(merged.objects);
                self.texts = Arc::new(merged.texts);
                self.merged = merged.summary.map(Arc::new);
                self.unmerged = None;
            }
            Err(ending) => {
                tracing::warn!("the results are not merged: {ending}");
                self.unmerged = Some(ending);
            }
        }
    }

    fn reported(&self, seen: &[WorkerSeen]) -> Vec<ReportWorker> {
        let workers = self.workers.iter().zip(seen);
        let reported = workers.map(|(worker, seen)| ReportWorker {
            crashes: seen.crashes(),
            state: seen.state(),
            ..self.kind.reported(worker.pair, worker.good.as_ref())
        });
        reported.collect()
    }
}

/// A worker that is done has complete results, or ends the run.
fn if_ended<K: Kind>((worker, reported): (&Worker<K::Found>, &ReportWorker)) -> Option<Ending> {
    let why = K::incomplete(reported, worker.good.as_ref())?;
    let incomplete = || K::FAULT(RefusedResults::new(Some(reported.id), why));
    Some(worker.refused.clone().unwrap_or_else(incomplete))
}

impl<F> Worker<F> {
    /// Takes results, unless they have less than the last good ones. Returns whether it did.
    fn take<K: Kind<Found = F>>(&mut self, found: F) -> bool {
        let next = match &self.good {
            Some(good) => K::after(found, good),
            None => Some(found),
        };
        let is_taken = next.is_some();
        self.good = next.or(self.good.take());
        is_taken
    }

    fn cannot_read<K: Kind>(&mut self, error: &TreeError) -> ReadOutcome {
        let place = format!("{} {}: {}", K::WRITER, self.pair, K::FILE);
        if error.is_the_writers() {
            self.unreadable = None;
            let why = format!("{place} can't be read: {error}. {}", K::NEXT_STEP);
            return self.refuse(K::FAULT(RefusedResults::new(Some(self.pair.get().into()), why)));
        }
        let reason = format!("{place} can't be read on this node: {error}");
        if self.unreadable.as_ref() != Some(&reason) {
            tracing::warn!("{reason}. It is tried again in each round.");
        }
        self.unreadable = Some(reason);
        ReadOutcome::Unusable
    }

    fn refuse(&mut self, ending: Ending) -> ReadOutcome {
        if self.refused.as_ref() != Some(&ending) {
            tracing::warn!("results are not taken, the last good ones stay: {ending}");
        }
        self.refused = Some(ending);
        ReadOutcome::Same
    }
}
