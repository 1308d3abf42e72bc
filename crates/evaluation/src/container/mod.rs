//! A container of the host's: each worker's evaluator runs beside an agent and writes `result.json`.

mod gather;
mod merge;
mod workload;

use std::sync::Arc;

use leaderboard_api::{Order, Ranking, ScoreMetric, Track};
use leaderboard_contract::run::Run;
use leaderboard_evidence::Tree;
use leaderboard_protocol::files::{Host, Pair};

use crate::gather::Kind;
use crate::workload::{Asked, Contents, Reserved, Workload};
use crate::{Column, Evaluation, Refused, Results, Words};
use gather::{Evaluators, Gatherer};

const HOST: Host = Host::Evaluator;
const WORDS: Words = Words {
    units: "units",
    unit: "unit",
    host: HOST.name(),
    worker: "worker",
    practice: "data",
    after_refused: "Check what the agent sends to the evaluator, and submit again.",
    after_rejected: "Compare the agent with the rules of the challenge, and submit again.",
};

/// An evaluation by a container of the host's.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Container;

impl Evaluation for Container {
    fn words(&self) -> &'static Words {
        &WORDS
    }

    fn host(&self) -> Host {
        HOST
    }

    fn columns(&self) -> Vec<Column> {
        Vec::new()
    }

    /// The evaluator alone knows its metrics.
    fn shows(&self, _metric: &str) -> bool {
        true
    }

    /// The score of the track; a metric without a name, which no result has, for a track without one.
    fn ranking(&self, track: &Track) -> Ranking {
        let score = track.container.as_ref().map(|own| &own.score);
        Ranking {
            metric: score.map(ScoreMetric::name).unwrap_or_default(),
            order: score.map_or(Order::default(), |score| score.order),
        }
    }

    fn reserved(&self) -> Reserved {
        workload::RESERVED
    }

    fn contents(&self, _asked: &Asked<'_>) -> Option<Contents> {
        None
    }

    fn workload(&self, asked: &Asked<'_>, worker: Pair) -> Option<Workload> {
        workload::workload(asked, worker)
    }

    fn check(&self, run: &Run) -> Result<(), Refused> {
        Evaluators::of(run)?;
        Ok(())
    }

    fn results(&self, run: &Run, tree: Arc<Tree>) -> Result<Box<dyn Results>, Refused> {
        Ok(Box::new(Gatherer::new(run, tree)?))
    }
}
