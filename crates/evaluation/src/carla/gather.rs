//! The results that the pairs have so far: checkpoints, which it reads, merges and renders, and status files.
//!
//! Called by `logcopy` once a round. Reads the `logs` volume through [`Tree`] and writes nothing; knows no S3. A checkpoint that
//! is torn, gone, refused or poorer leaves the last good one in place. Results are handed out from memory for storing, so that no torn
//! file and no full disk comes between them and S3. [`Plan::limits_of`] bounds the memory of all pairs together.

use std::path::PathBuf;
use std::sync::Arc;

use super::measures;
use crate::carla::results_format;
use crate::{Gathered, Object, Objects, Refused, Results, Summary, Texts, WorkerSeen};
use leaderboard_api::Verify;
use leaderboard_contract::keys::{MERGED, METADATA, STDOUT, checkpoint_path};
use leaderboard_contract::report::{Outcome, RefusedResults, ReportWorker};
use leaderboard_contract::run::{Run, STATUS_FOLDER};
use leaderboard_evidence::{Stamp, Tree, TreeError};
use leaderboard_protocol::files::{KEPT_CHECKPOINT, Pair};
use leaderboard_results::{Checkpoint, Files, Merged, Plan, Refusal, Slice, Strictness, read_worker};

impl From<Refusal> for Refused {
    fn from(refusal: Refusal) -> Self {
        Self {
            problem: refusal.to_string(),
            next_step: refusal.next_step().to_owned(),
        }
    }
}

/// The plan of the results, from the plan of the run.
pub fn results_plan(run: &Run) -> Result<Plan, Refusal> {
    let slices = run.plan.carla.slices.iter();
    let pairs: Vec<Slice> = slices
        .map(|slice| Slice {
            first: slice.first,
            last: slice.last,
        })
        .collect();
    let plan = Plan {
        format: results_format(run.plan.carla.version),
        strictness: Strictness::Pod,
        routes: pairs.iter().map(|slice| slice.routes()).fold(0, u32::saturating_add),
        pairs,
        repetitions: u32::try_from(run.plan.carla.repetitions).unwrap_or(0),
        verify: match run.verify {
            Verify::Disabled => leaderboard_results::Verify::Disabled,
            Verify::Warn => leaderboard_results::Verify::Warn,
            Verify::Refuse => leaderboard_results::Verify::Refuse,
        },
        as_original: false,
    };
    if plan.pairs.is_empty() {
        let problem = "it has no pair".to_owned();
        return Err(Refusal::Plan { problem });
    }
    plan.check()?;
    Ok(plan)
}

/// Its last whole copy, which the agent's runner keeps.
fn kept_path(pair: Pair) -> String {
    format!("{STATUS_FOLDER}/{}/{KEPT_CHECKPOINT}", pair.agent())
}

/// The last good checkpoint of one worker, and the state of its files, kept from round to round.
#[derive(Debug, Default)]
struct Worker {
    good: Option<Checkpoint>,
    seen: Option<Stamp>,
    /// The runner's copy as it was read last.
    kept: Option<Stamp>,
    refused: Option<String>,
    /// Why this node can't read it at present, which says nothing about its content.
    unreadable: Option<String>,
}

/// The outcome of reading a checkpoint.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum ReadOutcome {
    /// Another good one.
    New,
    /// Nothing that was not known.
    Same,
    /// None, or half of one.
    Unusable,
}

impl From<&Merged> for Summary {
    fn from(merged: &Merged) -> Self {
        Self {
            done: merged.done,
            score: measures::score(merged),
            metrics: measures::others(merged),
            is_complete: merged.is_final,
            has_ended: merged.pairs.iter().all(|pair| pair.ended),
            eligible: merged.eligible,
            outcome: outcome(merged.outcome),
            warnings: merged.warnings.clone(),
        }
    }
}

fn outcome(of_results: leaderboard_results::Outcome) -> Outcome {
    use leaderboard_results::Outcome as Of;
    match of_results {
        Of::Running => Outcome::Running,
        Of::Finished => Outcome::Finished,
        Of::Crashed => Outcome::Crashed,
        Of::Rejected => Outcome::Rejected,
        Of::Invalid => Outcome::Invalid,
    }
}

/// Takes in EvalAI's texts. The merged file can be large, so it is moved: it is in memory once, under both of its keys.
fn take_texts(objects: &mut Objects, files: Files) -> Arc<Texts> {
    objects.insert(
        "evalai/results.json".to_owned(),
        Object::new(files.results_json.clone()),
    );
    objects.insert(STDOUT.to_owned(), Object::new(files.stdout_txt));
    if let Some(metadata) = files.metadata_json {
        let merged = Object::new(metadata);
        objects.insert(MERGED.to_owned(), merged.clone());
        objects.insert(METADATA.to_owned(), merged);
    }
    Arc::new(Texts {
        results: files.results_json,
        partial_results: files.partial_json,
    })
}

/// Reads the volume round by round.
#[derive(Debug)]
pub struct Gatherer {
    plan: Plan,
    tree: Arc<Tree>,
    status: PathBuf,
    workers: Vec<Worker>,
    merged: Option<Arc<Summary>>,
    texts: Arc<Texts>,
    objects: Objects,
    unmerged: Option<RefusedResults>,
}

impl Results for Gatherer {
    fn round(&mut self) -> Gathered {
        // The status files are read before the results: an agent that is done has written everything.
        let pairs = Pair::first(self.workers.len());
        let seen: Vec<WorkerSeen> = pairs.clone().map(|pair| WorkerSeen::read(&self.status, pair)).collect();
        let mut changed = false;
        for pair in pairs {
            changed |= match self.read(pair) {
                ReadOutcome::New => true,
                ReadOutcome::Same => false,
                ReadOutcome::Unusable => self.read_kept(pair),
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
            workers,
            seen,
            refused: self.workers.iter().map(|worker| worker.refused.clone()).collect(),
            unreadable: self.workers.iter().map(|worker| worker.unreadable.is_some()).collect(),
            unmerged: self.unmerged.clone(),
        }
    }

    /// None of the routes of another plan counts here, and a checkpoint that is complete would be taken for a pair with nothing left to drive.
    fn remove_others(&self) -> Result<(), TreeError> {
        for pair in Pair::first(self.workers.len()) {
            let (path, index) = (checkpoint_path(pair), pair.index());
            let found = match self.tree.read(&path, self.plan.limits_of(index).bytes as u64) {
                Ok(Some((bytes, _))) => read_worker(&self.plan, index, &bytes),
                // A round refuses it.
                Ok(None) | Err(TreeError::TooLarge { .. }) => continue,
                Err(error) => return Err(error),
            };
            if let Err(refusal) = found
                && refusal.is_of_other_routes()
            {
                tracing::warn!("{refusal}: the stored checkpoint is not gone on with, and the pair begins anew");
                self.tree.remove(&path)?;
            }
        }
        Ok(())
    }
}

impl Gatherer {
    /// For a run whose plan holds.
    pub fn new(run: &Run, tree: Arc<Tree>) -> Result<Self, Refused> {
        let plan = results_plan(run)?;
        let mut objects = Objects::new();
        let texts = take_texts(&mut objects, leaderboard_results::render(&plan, None)?);
        Ok(Self {
            status: tree.path().join(STATUS_FOLDER),
            workers: plan.pairs.iter().map(|_| Worker::default()).collect(),
            plan,
            tree,
            merged: None,
            texts,
            objects,
            unmerged: None,
        })
    }

    /// Reads one worker's checkpoint, if it is not the one of the last round.
    fn read(&mut self, pair: Pair) -> ReadOutcome {
        let (path, index) = (checkpoint_path(pair), pair.index());
        let limit = self.plan.limits_of(index).bytes as u64;
        let Some(worker) = self.workers.get_mut(index) else {
            return ReadOutcome::Unusable;
        };
        let (file, stamp) = match self.tree.file(&path) {
            Ok(Some(found)) => found,
            Ok(None) => {
                worker.unreadable = None;
                return ReadOutcome::Unusable;
            }
            Err(error) => return worker.cannot_read(pair, &error),
        };
        if worker.seen == Some(stamp) {
            worker.unreadable = None;
            return ReadOutcome::Same;
        }
        drop(file);
        let (bytes, stamp) = match self.tree.read(&path, limit) {
            Ok(Some(read)) => read,
            // The next round finds it whole.
            Ok(None) | Err(TreeError::Changed) => return ReadOutcome::Unusable,
            Err(error) => return worker.cannot_read(pair, &error),
        };
        worker.unreadable = None;
        match read_worker(&self.plan, index, &bytes) {
            Ok(None) => ReadOutcome::Unusable,
            Ok(Some(checkpoint)) => {
                worker.seen = Some(stamp);
                if let Some(why) = worker.refused.take() {
                    tracing::info!(pair = pair.get(), "the checkpoint is good again; before: {why}");
                }
                if !worker.take(checkpoint) {
                    tracing::info!(
                        pair = pair.get(),
                        "the new checkpoint has less than the one before, which stays"
                    );
                    return ReadOutcome::Same;
                }
                self.objects.insert(path, Object::new(bytes));
                ReadOutcome::New
            }
            Err(refusal) => {
                worker.seen = Some(stamp);
                worker.refuse_with(reason(&refusal))
            }
        }
    }

    /// Reads what the agent's runner has kept, when the file itself is being written: that is further than what this logcopy has
    /// read, if its rounds are rare, or it has begun just now.
    fn read_kept(&mut self, pair: Pair) -> bool {
        let (path, index) = (kept_path(pair), pair.index());
        let limit = self.plan.limits_of(index).bytes as u64;
        let Some(worker) = self.workers.get_mut(index) else {
            return false;
        };
        match self.tree.file(&path) {
            Ok(Some((_, stamp))) if worker.kept != Some(stamp) => {}
            _ => return false,
        }
        let Ok(Some((bytes, stamp))) = self.tree.read(&path, limit) else {
            return false;
        };
        worker.kept = Some(stamp);
        let Ok(Some(kept)) = read_worker(&self.plan, index, &bytes) else {
            return false;
        };
        let is_taken = worker.take(kept);
        if is_taken {
            self.objects.insert(checkpoint_path(pair), Object::new(bytes));
        }
        is_taken
    }

    fn merge(&mut self) {
        let workers: Vec<Option<&Checkpoint>> = self.workers.iter().map(|worker| worker.good.as_ref()).collect();
        if workers.iter().all(Option::is_none) {
            return;
        }
        let merged = leaderboard_results::merge(&self.plan, &workers).and_then(|merged| {
            let files = leaderboard_results::render(&self.plan, Some(&merged))?;
            Ok((merged, files))
        });
        match merged {
            Ok((merged, files)) => {
                self.texts = take_texts(&mut self.objects, files);
                self.merged = Some(Arc::new(Summary::from(&merged)));
                self.unmerged = None;
            }
            Err(refusal) => {
                let worker = refusal
                    .pair()
                    .and_then(|pair| u32::try_from(pair.saturating_add(1)).ok());
                let refused = RefusedResults::new(worker, reason(&refusal));
                tracing::warn!("the checkpoints are not merged: {refused}");
                self.unmerged = Some(refused);
            }
        }
    }

    fn reported(&self, seen: &[WorkerSeen]) -> Vec<ReportWorker> {
        let slices = self.plan.pairs.iter().zip(&self.workers).zip(seen);
        (1..)
            .zip(slices)
            .map(|(id, ((slice, worker), seen))| {
                let total = slice.routes().saturating_mul(self.plan.repetitions);
                let done = worker.good.as_ref().map_or(0, Checkpoint::done);
                ReportWorker {
                    id,
                    done: done.min(total),
                    total,
                    crashes: seen.crashes(),
                    state: seen.state(),
                    names_crash: worker.good.as_ref().is_some_and(Checkpoint::names_crash),
                }
            })
            .collect()
    }
}

impl Worker {
    /// Takes a checkpoint, unless it has less than the last good one. Returns whether it did.
    fn take(&mut self, found: Checkpoint) -> bool {
        let next = match &self.good {
            Some(good) => found.after(good),
            None => Some(found),
        };
        let is_taken = next.is_some();
        self.good = next.or(self.good.take());
        is_taken
    }

    fn cannot_read(&mut self, pair: Pair, error: &TreeError) -> ReadOutcome {
        if error.is_the_writers() {
            self.unreadable = None;
            return self.refuse_with(format!(
                "pair {pair}: the checkpoint can't be read: {error}. Leave it to the evaluator."
            ));
        }
        let reason = format!("pair {pair}: the checkpoint can't be read on this node: {error}");
        if self.unreadable.as_ref() != Some(&reason) {
            tracing::warn!("{reason}. It is tried again in each round.");
        }
        self.unreadable = Some(reason);
        ReadOutcome::Unusable
    }

    fn refuse_with(&mut self, reason: String) -> ReadOutcome {
        if self.refused.as_ref() != Some(&reason) {
            tracing::warn!("a checkpoint is refused, the last good one stays: {reason}");
        }
        self.refused = Some(reason);
        ReadOutcome::Same
    }
}

/// Which checkpoint, why, and what to do.
fn reason(refusal: &Refusal) -> String {
    format!("{refusal}. {}", refusal.next_step())
}
