//! Results of the evaluators so far, read and merged, and their status files.
//!
//! Called by `logcopy` once a round. Reads the `logs` volume through [`Tree`] and writes nothing; knows no S3. A result that is torn,
//! gone, poorer or out of bounds leaves the last good one in place. It is handed out from memory, to be stored.

use std::path::PathBuf;
use std::sync::Arc;

use leaderboard_api::ContainerPlan;
use leaderboard_api::evaluator_result::{MAX_BYTES, ResultError, ResultFile, parse};
use leaderboard_contract::keys::{RESULT_FILE, RESULTS, STDOUT, result_path};
use leaderboard_contract::report::{RefusedResults, ReportWorker};
use leaderboard_contract::run::{Run, STATUS_FOLDER};
use leaderboard_evidence::{Stamp, Tree, TreeError};
use leaderboard_protocol::files::Pair;

use super::HOST;
use super::merge::{MergeError, Merged, NO_RESULTS, NOTHING_YET, merge};
use crate::judge::Ending;
use crate::{Gathered, Object, Objects, Refused, Results, Summary, Texts, WorkerSeen};

/// The plan of a run of this kind.
pub(super) fn plan(run: &Run) -> Result<&ContainerPlan, Refused> {
    let refused = |problem: &str| Refused {
        problem: format!("the plan of the run does not hold: {problem}"),
        next_step: "Operator and Pod must be of the same version".to_owned(),
    };
    let plan = run
        .plan
        .container()
        .ok_or_else(|| refused("it is of another kind of evaluation"))?;
    if run.plan.workers() == 0 {
        return Err(refused("it has no worker"));
    }
    Ok(plan)
}

/// One worker, over the rounds.
#[derive(Debug, Default)]
struct Worker {
    good: Option<ResultFile>,
    seen: Option<Stamp>,
    refused: Option<Ending>,
    /// Why this node can't read it at present, which says nothing about its content.
    unreadable: Option<String>,
}

/// Reads the volume round by round.
#[derive(Debug)]
pub(super) struct Gatherer {
    plan: ContainerPlan,
    tree: Arc<Tree>,
    status: PathBuf,
    workers: Vec<Worker>,
    merged: Option<Arc<Summary>>,
    texts: Arc<Texts>,
    objects: Objects,
    unmerged: Option<Ending>,
}

impl Results for Gatherer {
    fn round(&mut self) -> Gathered {
        // The status files are read before the results: an evaluator that is done has written everything.
        let pairs = Pair::first(self.workers.len());
        let seen: Vec<WorkerSeen> = pairs
            .clone()
            .map(|pair| WorkerSeen::read(&self.status, pair, HOST))
            .collect();
        let mut changed = false;
        for pair in pairs {
            changed |= self.read(pair);
        }
        if changed {
            self.merge();
        }
        Gathered {
            merged: self.merged.clone(),
            texts: Arc::clone(&self.texts),
            objects: self.objects.clone(),
            workers: (1..).zip(&self.workers).zip(&seen).map(reported).collect(),
            seen,
            refused: self.workers.iter().map(|worker| worker.refused.clone()).collect(),
            if_ended: (1..).zip(&self.workers).map(if_ended).collect(),
            unreadable: self.workers.iter().map(|worker| worker.unreadable.is_some()).collect(),
            unmerged: self.unmerged.clone(),
        }
    }

    /// `workspace` restores no result of a run with another number of workers, and a result names no other share.
    fn remove_others(&self) -> Result<(), TreeError> {
        Ok(())
    }
}

impl Gatherer {
    /// For a run whose plan holds.
    pub(super) fn new(run: &Run, tree: Arc<Tree>) -> Result<Self, Refused> {
        let plan = plan(run)?.clone();
        let objects = [(RESULTS, NO_RESULTS), (STDOUT, NOTHING_YET)];
        Ok(Self {
            status: tree.path().join(STATUS_FOLDER),
            workers: (0..run.plan.workers()).map(|_| Worker::default()).collect(),
            plan,
            tree,
            merged: None,
            texts: Arc::new(Texts {
                results: NO_RESULTS.to_owned(),
                partial_results: None,
            }),
            objects: objects.map(|(key, text)| (key.to_owned(), Object::new(text))).into(),
            unmerged: None,
        })
    }

    /// Reads one worker's result, if it is not that of the last round. Returns whether there is another good one.
    fn read(&mut self, pair: Pair) -> bool {
        let path = result_path(pair);
        let Some(worker) = self.workers.get_mut(pair.index()) else {
            return false;
        };
        let (bytes, stamp) = match worker.changed(&self.tree, &path) {
            Ok(Some(read)) => read,
            Ok(None) => {
                worker.unreadable = None;
                return false;
            }
            Err(error) => {
                worker.cannot_read(pair, &error);
                return false;
            }
        };
        (worker.unreadable, worker.seen) = (None, Some(stamp));
        let checked = parse(&bytes).and_then(|found| found.check_score(&self.plan.score).map(|()| found));
        let is_taken = worker.take(pair, checked);
        if is_taken {
            self.objects.insert(path, Object::new(bytes));
        }
        is_taken
    }

    fn merge(&mut self) {
        let workers: Vec<Option<&ResultFile>> = self.workers.iter().map(|worker| worker.good.as_ref()).collect();
        match merge(self.plan.merge, &workers) {
            Ok(None) => {}
            Ok(Some(merged)) => {
                let messages = (1..).zip(&workers);
                let messages = messages.filter_map(|(id, result)| Some((id, (*result)?.message.as_deref()?)));
                let stdout = merged.stdout(&messages.collect::<Vec<_>>());
                self.take(&merged, stdout);
            }
            Err(error) => {
                tracing::warn!("the results are not merged: {error}");
                self.unmerged = Some(unmerged(&error));
            }
        }
    }

    fn take(&mut self, merged: &Merged, stdout: String) {
        let texts = merged.texts();
        self.objects
            .insert(RESULTS.to_owned(), Object::new(texts.results.clone()));
        self.objects.insert(STDOUT.to_owned(), Object::new(stdout));
        self.texts = Arc::new(texts);
        self.merged = Some(Arc::new(merged.summary(&self.plan.score)));
        self.unmerged = None;
    }
}

fn reported(((id, worker), seen): ((u32, &Worker), &WorkerSeen)) -> ReportWorker {
    let units = worker.good.as_ref().map(|good| (good.done, good.total));
    let (done, total) = units.unwrap_or_default();
    ReportWorker {
        id,
        done,
        total,
        crashes: seen.crashes(),
        state: seen.state(),
        names_crash: false,
    }
}

/// An evaluator that is done has a final result, or ends the run.
fn if_ended((id, worker): (u32, &Worker)) -> Option<Ending> {
    if worker.good.as_ref().is_some_and(|good| good.is_final) {
        return None;
    }
    let why = || format!("evaluator {id} ended without a final result. Have it write {RESULT_FILE} last, and once.");
    let unfinished = || Ending::Unusable(RefusedResults::new(Some(id), why()));
    Some(worker.refused.clone().unwrap_or_else(unfinished))
}

fn unmerged(error: &MergeError) -> Ending {
    let worker = match error {
        MergeError::Lacking { worker, .. } => u32::try_from(*worker).ok(),
        MergeError::TooLarge { .. } | MergeError::TooMany => None,
    };
    Ending::Unusable(RefusedResults::new(worker, error.to_string()))
}

impl Worker {
    /// The result, if it is another one than before.
    fn changed(&self, tree: &Tree, path: &str) -> Result<Option<(Vec<u8>, Stamp)>, TreeError> {
        let is_known = match tree.file(path)? {
            Some((_, stamp)) => self.seen == Some(stamp),
            None => true,
        };
        if is_known {
            return Ok(None);
        }
        match tree.read(path, MAX_BYTES as u64) {
            // The next round finds it whole.
            Err(TreeError::Changed) => Ok(None),
            read => read,
        }
    }

    /// Takes a result, unless it has less than the last good one. Returns whether it did.
    fn take(&mut self, pair: Pair, found: Result<ResultFile, ResultError>) -> bool {
        let found = match found {
            Err(error) => {
                self.refuse(Ending::Unusable(unusable(pair, &error)));
                return false;
            }
            Ok(ResultFile { refused: Some(why), .. }) => {
                self.refuse(Ending::Invalid(RefusedResults::new(Some(pair.get().into()), why)));
                return false;
            }
            Ok(found) => found,
        };
        if let Some(before) = self.refused.take() {
            tracing::info!(worker = pair.get(), "the result is good again; before: {before}");
        }
        let is_less = |good: &ResultFile| !found.is_final && (good.is_final || found.done < good.done);
        if self.good.as_ref().is_some_and(is_less) {
            tracing::info!(
                worker = pair.get(),
                "the new result has less than the one before, which stays"
            );
            return false;
        }
        self.good = Some(found);
        true
    }

    fn cannot_read(&mut self, pair: Pair, error: &TreeError) {
        if error.is_the_writers() {
            self.unreadable = None;
            self.refuse(Ending::Unusable(unusable(
                pair,
                &format_args!("{error}. Write a regular file."),
            )));
            return;
        }
        let reason = format!("evaluator {pair}: {RESULT_FILE} can't be read on this node: {error}");
        if self.unreadable.as_ref() != Some(&reason) {
            tracing::warn!("{reason}. It is tried again in each round.");
        }
        self.unreadable = Some(reason);
    }

    fn refuse(&mut self, ending: Ending) {
        if self.refused.as_ref() != Some(&ending) {
            tracing::warn!("a result is not taken, the last good one stays: {ending}");
        }
        self.refused = Some(ending);
    }
}

fn unusable(pair: Pair, problem: &dyn std::fmt::Display) -> RefusedResults {
    let why = format!("evaluator {pair}: {RESULT_FILE} can't be used: {problem}");
    RefusedResults::new(Some(pair.get().into()), why)
}

#[cfg(test)]
mod tests;
