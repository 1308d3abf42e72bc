//! A container of the host's: each worker's evaluator writes `result.json`, about an agent beside it, or about files.

mod gather;
mod merge;
mod workload;

use std::sync::Arc;

use leaderboard_api::{Agents, EvaluationMode, LeaderboardSpec, Order, Ranking, ScoreMetric, Track};
use leaderboard_contract::run::Run;
use leaderboard_evidence::Tree;
use leaderboard_protocol::files::{Host, Pair};

use crate::gather::Kind;
use crate::workload::{Asked, Contents, Data, Reserved, Workload};
use crate::{Column, Evaluation, Refused, Results, Words};
use gather::{Evaluators, Gatherer};

const HOST: Host = Host::Evaluator;
const INTERACTIVE: Words = Words {
    units: "units",
    unit: "unit",
    host: HOST.name(),
    worker: "worker",
    practice: "data",
    after_refused: "Check what the agent sends to the evaluator, and submit again.",
    after_rejected: "Compare the agent with the rules of the challenge, and submit again.",
};
const BATCH: Words = Words {
    after_refused: "Check the files that the agent writes, and submit again.",
    ..INTERACTIVE
};
const PREDICTIONS: Words = Words {
    after_refused: "Check the submitted file, and submit again.",
    after_rejected: "Compare the submitted file with the rules of the challenge, and submit again.",
    ..INTERACTIVE
};

/// An evaluation by a container of the host's.
#[derive(Clone, Copy, Debug)]
struct Container(EvaluationMode);

/// The member of a mode.
pub(crate) fn of(mode: EvaluationMode) -> &'static dyn Evaluation {
    match mode {
        EvaluationMode::Interactive => &Container(EvaluationMode::Interactive),
        EvaluationMode::Batch => &Container(EvaluationMode::Batch),
        EvaluationMode::Predictions => &Container(EvaluationMode::Predictions),
    }
}

impl Evaluation for Container {
    fn words(&self) -> &'static Words {
        match self.0 {
            EvaluationMode::Interactive => &INTERACTIVE,
            EvaluationMode::Batch => &BATCH,
            EvaluationMode::Predictions => &PREDICTIONS,
        }
    }

    fn host(&self) -> Host {
        HOST
    }

    fn agents(&self) -> Agents {
        self.0.agents()
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

    fn reserved(&self, spec: &LeaderboardSpec) -> Reserved {
        workload::reserved(self.0, spec)
    }

    fn data<'a>(&self, spec: &'a LeaderboardSpec) -> Vec<Data<'a>> {
        workload::data(spec)
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nobody_reads_of_an_agent_where_there_is_none() {
        for (mode, agents) in [
            (EvaluationMode::Interactive, Agents::Beside),
            (EvaluationMode::Batch, Agents::First),
            (EvaluationMode::Predictions, Agents::Absent),
        ] {
            let member = of(mode);
            assert_eq!(member.agents(), agents);
            let names_agent = format!("{:?}", member.words()).contains("agent");
            assert_eq!(names_agent, agents != Agents::Absent, "{:?}", member.words());
        }
    }
}
