//! CARLA: pairs of a simulator and an agent share out the routes, and each agent's evaluator writes a checkpoint.

mod commands;
mod display;
pub mod gather;
mod layout;
mod measures;
mod workload;

use std::sync::Arc;

use leaderboard_api::{LeaderboardSpec, LeaderboardVersion, Order, Ranking, Track};
use leaderboard_contract::run::Run;
use leaderboard_evidence::Tree;
use leaderboard_protocol::files::{Host, Pair};
use leaderboard_results::{Format, metrics};

use crate::workload::{Asked, Contents, Reserved, Workload};
use crate::{Column, Evaluation, Refused, Results, Words};
use gather::Gatherer;

const WORDS: Words = Words {
    units: measures::UNIT,
    unit: "route",
    host: HOST.name(),
    worker: "pair",
    practice: measures::UNIT,
    after_refused: "Check what the agent writes into its checkpoint, and submit again.",
    after_rejected: "Compare the agent's sensors with those the track allows, and submit again.",
};
const HOST: Host = Host::Simulator;

/// The CARLA Leaderboard, by its version.
#[derive(Clone, Copy, Debug)]
struct Carla(LeaderboardVersion);

/// The member of a version.
pub fn of(version: LeaderboardVersion) -> &'static dyn Evaluation {
    match version {
        LeaderboardVersion::V1 => &Carla(LeaderboardVersion::V1),
        LeaderboardVersion::V2 => &Carla(LeaderboardVersion::V2),
    }
}

impl Evaluation for Carla {
    fn words(&self) -> &'static Words {
        &WORDS
    }

    fn host(&self) -> Host {
        HOST
    }

    fn columns(&self) -> Vec<Column> {
        let of_format = metrics(results_format(self.0)).iter();
        of_format
            .map(|metric| Column {
                label: metric.name,
                name: metric.column,
            })
            .collect()
    }

    fn shows(&self, metric: &str) -> bool {
        measures::NAMES.contains(&metric)
    }

    fn ranking(&self, _track: &Track) -> Ranking {
        Ranking {
            metric: measures::DRIVING_SCORE.to_owned(),
            order: Order::Descending,
        }
    }

    fn reserved(&self, _spec: &LeaderboardSpec) -> Reserved {
        workload::reserved()
    }

    fn contents(&self, asked: &Asked<'_>) -> Option<Contents> {
        workload::contents(asked)
    }

    fn workload(&self, asked: &Asked<'_>, worker: Pair) -> Option<Workload> {
        workload::workload(asked, worker)
    }

    fn check(&self, run: &Run) -> Result<(), Refused> {
        gather::results_plan(run)?;
        Ok(())
    }

    fn results(&self, run: &Run, tree: Arc<Tree>) -> Result<Box<dyn Results>, Refused> {
        Ok(Box::new(Gatherer::new(run, tree)?))
    }
}

/// The format of the results of a version.
fn results_format(version: LeaderboardVersion) -> Format {
    match version {
        LeaderboardVersion::V1 => Format::V1,
        LeaderboardVersion::V2 => Format::V2,
    }
}
