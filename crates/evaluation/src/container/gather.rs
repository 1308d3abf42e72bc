//! A container's part of a round: the results of its evaluators read and merged.

use leaderboard_api::evaluator_result::{MAX_BYTES, ResultFile, parse};
use leaderboard_api::{ContainerPlan, MAX_NAME, WorkerState};
use leaderboard_contract::keys::{RESULT_FILE, RESULTS, STDOUT};
use leaderboard_contract::report::{RefusedResults, ReportWorker};
use leaderboard_contract::run::Run;
use leaderboard_protocol::files::{Host, Pair};

use super::HOST;
use super::merge::{MergeError, merge};
use crate::gather::{self, Kind, Merged};
use crate::judge::Ending;
use crate::{Object, Refused};

pub(crate) type Gatherer = gather::Gatherer<Evaluators>;

/// Next step for a plan that no operator of this version makes.
const OF_VERSIONS: &str = "Operator and Pod must be of the same version";

/// The results of all evaluators.
#[derive(Debug)]
pub(crate) struct Evaluators(ContainerPlan);

impl Kind for Evaluators {
    type Found = ResultFile;
    const HOST: Host = HOST;
    const WRITER: &'static str = "evaluator";
    const FILE: &'static str = RESULT_FILE;
    const NEXT_STEP: &'static str = "Write a regular file.";
    const FAULT: fn(RefusedResults) -> Ending = Ending::Unusable;

    fn of(run: &Run) -> Result<Self, Refused> {
        let refused = |problem: &str, next_step: &str| Refused {
            problem: format!("the plan of the run does not hold: {problem}"),
            next_step: next_step.to_owned(),
        };
        let plan = run.plan.container();
        let plan = plan.ok_or_else(|| refused("it is of another kind of evaluation", OF_VERSIONS))?;
        if run.plan.sharing() == 0 {
            return Err(refused("it has no worker", OF_VERSIONS));
        }
        // A status could not show it, and the run would end without a score.
        if plan.score.name().chars().count() > MAX_NAME {
            let problem = format!("the name of its score has more than {MAX_NAME} characters");
            return Err(refused(&problem, "Set shorter names in tracks[].container.score"));
        }
        Ok(Self(plan.clone()))
    }

    fn limit(&self, _worker: Pair) -> u64 {
        MAX_BYTES as u64
    }

    fn read(&self, worker: Pair, bytes: &[u8]) -> Result<Option<ResultFile>, Ending> {
        let of_worker = |why: String| RefusedResults::new(Some(worker.get().into()), why);
        let has_score = |found: &ResultFile| match self.0.merger() {
            Some(_) if !self.merges(worker) => Ok(()),
            _ => found.check_score(&self.0.score),
        };
        let read = parse(bytes).and_then(|found| has_score(&found).map(|()| found));
        match read {
            Ok(ResultFile { refused: Some(why), .. }) => Err(Ending::Invalid(of_worker(why))),
            Ok(found) => Ok(Some(found)),
            Err(error) => {
                let why = format!("evaluator {worker}: {RESULT_FILE} can't be used: {error}");
                Err(Ending::Unusable(of_worker(why)))
            }
        }
    }

    fn after(found: ResultFile, good: &ResultFile) -> Option<ResultFile> {
        let has_less = !found.is_final && (good.is_final || found.done < good.done);
        (!has_less).then_some(found)
    }

    fn reported(&self, worker: Pair, good: Option<&ResultFile>) -> ReportWorker {
        // The units are those of the others.
        let good = good.filter(|_| !self.merges(worker));
        let (done, total) = good.map(|good| (good.done, good.total)).unwrap_or_default();
        ReportWorker {
            id: worker.get().into(),
            done,
            total,
            crashes: 0,
            state: WorkerState::Waiting,
            names_crash: false,
        }
    }

    fn incomplete(reported: &ReportWorker, good: Option<&ResultFile>) -> Option<String> {
        let id = reported.id;
        let why =
            || format!("evaluator {id} ended without a final result. Have it write {RESULT_FILE} last, and once.");
        good.is_none_or(|good| !good.is_final).then(why)
    }

    fn merge(&self, workers: &[Option<&ResultFile>]) -> Result<Merged, Ending> {
        let merged = merge(self.0.merge, workers).map_err(|error| unusable(&error))?;
        let texts = merged.texts();
        let objects = [
            (RESULTS, texts.results.clone()),
            (STDOUT, merged.stdout(self.0.merger(), workers)),
        ];
        let has_results = workers.iter().any(Option::is_some);
        Ok(Merged {
            summary: has_results.then(|| merged.summary(&self.0.score)),
            texts,
            objects: objects.map(|(key, text)| (key.to_owned(), Object::new(text))).into(),
        })
    }
}

impl Evaluators {
    /// True for the worker whose result is that of the run.
    fn merges(&self, worker: Pair) -> bool {
        self.0.merger() == Some(worker.get().into())
    }
}

fn unusable(error: &MergeError) -> Ending {
    let worker = match error {
        MergeError::Lacking { worker, .. } => u32::try_from(*worker).ok(),
        MergeError::TooLarge { .. } | MergeError::TooMany => None,
    };
    Ending::Unusable(RefusedResults::new(worker, error.to_string()))
}

#[cfg(test)]
mod command_tests;
#[cfg(test)]
mod tests;
