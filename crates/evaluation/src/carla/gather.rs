//! CARLA's part of a round: the pairs' checkpoints read, merged and rendered. [`Plan::limits_of`] bounds the memory of all pairs together.

use super::{HOST, measures};
use crate::carla::results_format;
use crate::gather::{self, Kind, Merged};
use crate::judge::Ending;
use crate::{Object, Objects, Refused, Summary, Texts};
use leaderboard_api::{Verify, WorkerState};
use leaderboard_contract::keys::{MERGED, METADATA, RESULTS, STDOUT, checkpoint_path};
use leaderboard_contract::report::{Outcome, RefusedResults, ReportWorker};
use leaderboard_contract::run::{Run, STATUS_FOLDER};
use leaderboard_evidence::{Tree, TreeError};
use leaderboard_protocol::files::{Host, KEPT_CHECKPOINT, Pair};
use leaderboard_results::{Checkpoint, Files, Plan, Refusal, Slice, Strictness, read_worker};

pub(crate) type Gatherer = gather::Gatherer<Checkpoints>;

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
    let Some(planned) = run.plan.carla() else {
        let problem = "it is of another kind of evaluation".to_owned();
        return Err(Refusal::Plan { problem });
    };
    let slices = planned.slices.iter();
    let pairs: Vec<Slice> = slices
        .map(|slice| Slice {
            first: slice.first,
            last: slice.last,
        })
        .collect();
    let plan = Plan {
        format: results_format(planned.version),
        strictness: Strictness::Pod,
        routes: pairs.iter().map(|slice| slice.routes()).fold(0, u32::saturating_add),
        pairs,
        repetitions: u32::try_from(planned.repetitions).unwrap_or(0),
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

impl From<&leaderboard_results::Merged> for Summary {
    fn from(merged: &leaderboard_results::Merged) -> Self {
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

/// EvalAI's texts. The merged file can be large, so it is moved: it is in memory once, under both of its keys.
fn texts(files: Files) -> (Texts, Objects) {
    let mut objects = Objects::new();
    objects.insert(RESULTS.to_owned(), Object::new(files.results_json.clone()));
    objects.insert(STDOUT.to_owned(), Object::new(files.stdout_txt));
    if let Some(metadata) = files.metadata_json {
        let merged = Object::new(metadata);
        objects.insert(MERGED.to_owned(), merged.clone());
        objects.insert(METADATA.to_owned(), merged);
    }
    let texts = Texts {
        results: files.results_json,
        partial_results: files.partial_json,
    };
    (texts, objects)
}

/// The checkpoints of all pairs.
#[derive(Debug)]
pub(crate) struct Checkpoints(Plan);

impl Kind for Checkpoints {
    type Found = Checkpoint;
    const HOST: Host = HOST;
    const WRITER: &'static str = "pair";
    const FILE: &'static str = "the checkpoint";
    const NEXT_STEP: &'static str = "Leave it to the evaluator.";
    const FAULT: fn(RefusedResults) -> Ending = Ending::Invalid;

    fn of(run: &Run) -> Result<Self, Refused> {
        Ok(Self(results_plan(run)?))
    }

    fn limit(&self, pair: Pair) -> u64 {
        self.0.limits_of(pair.index()).bytes as u64
    }

    fn read(&self, pair: Pair, bytes: &[u8]) -> Result<Option<Checkpoint>, Ending> {
        read_worker(&self.0, pair.index(), bytes).map_err(|refusal| refused(Some(pair.get().into()), &refusal))
    }

    fn after(found: Checkpoint, good: &Checkpoint) -> Option<Checkpoint> {
        found.after(good)
    }

    fn reported(&self, pair: Pair, good: Option<&Checkpoint>) -> ReportWorker {
        let slice = self.0.pairs.get(pair.index());
        let total = slice.map_or(0, |slice| slice.routes().saturating_mul(self.0.repetitions));
        ReportWorker {
            id: pair.get().into(),
            done: good.map_or(0, Checkpoint::done).min(total),
            total,
            crashes: 0,
            state: WorkerState::Waiting,
            names_crash: good.is_some_and(Checkpoint::names_crash),
        }
    }

    fn incomplete(reported: &ReportWorker, _good: Option<&Checkpoint>) -> Option<String> {
        let ReportWorker { id, done, total, .. } = reported;
        let why =
            || format!("pair {id} ended with {done} of its {total} route runs. Leave the checkpoint to the evaluator.");
        (done < total).then(why)
    }

    fn merge(&self, pairs: &[Option<&Checkpoint>]) -> Result<Merged, Ending> {
        let merge = || -> Result<_, Refusal> {
            let has_results = pairs.iter().any(Option::is_some);
            let merged = has_results
                .then(|| leaderboard_results::merge(&self.0, pairs))
                .transpose()?;
            let files = leaderboard_results::render(&self.0, merged.as_ref())?;
            Ok((merged, files))
        };
        let (merged, files) = merge().map_err(|refusal| {
            let pair = refusal
                .pair()
                .and_then(|pair| u32::try_from(pair.saturating_add(1)).ok());
            refused(pair, &refusal)
        })?;
        let (texts, objects) = texts(files);
        Ok(Merged {
            summary: merged.as_ref().map(Summary::from),
            texts,
            objects,
        })
    }

    /// The agent's runner keeps the last whole one.
    fn kept_path(pair: Pair) -> Option<String> {
        Some(format!("{STATUS_FOLDER}/{}/{KEPT_CHECKPOINT}", pair.agent()))
    }

    /// None of the routes of another plan counts here, and a checkpoint that is complete would be taken for a pair with nothing left to drive.
    fn remove_others(&self, tree: &Tree) -> Result<(), TreeError> {
        for pair in Pair::first(self.0.pairs.len()) {
            let path = checkpoint_path(pair);
            let found = match tree.read(&path, self.limit(pair)) {
                Ok(Some((bytes, _))) => read_worker(&self.0, pair.index(), &bytes),
                // A round refuses it.
                Ok(None) | Err(TreeError::TooLarge { .. }) => continue,
                Err(error) => return Err(error),
            };
            if let Err(refusal) = found
                && refusal.is_of_other_routes()
            {
                tracing::warn!("{refusal}: the stored checkpoint is not gone on with, and the pair begins anew");
                tree.remove(&path)?;
            }
        }
        Ok(())
    }
}

/// Which checkpoint, why, and what to do.
fn refused(pair: Option<u32>, refusal: &Refusal) -> Ending {
    Ending::Invalid(RefusedResults::new(pair, format!("{refusal}. {}", refusal.next_step())))
}
