//! Kinds of evaluation: what a Pod runs, how its results are read, and in which words people read of it.
//!
//! ```text
//!   api: spec, plan ──► of(), of_plan() ──► a member, such as carla
//!                                             │  plain data
//!        pod-spec ◄── Workload, Contents ─────┤
//!        pod      ◄── Gathered, each round ───┤──► judge, one for all kinds
//!        policy, table, page ◄── Words, Columns┘
//! ```
//!
//! No member makes a type of Kubernetes, and none knows S3, EvalAI or a clock.
#![cfg_attr(not(test), deny(clippy::indexing_slicing, clippy::arithmetic_side_effects))]

pub mod carla;
#[cfg(any(test, feature = "fixtures"))]
#[allow(clippy::unwrap_used, clippy::arithmetic_side_effects)]
pub mod fixtures;
mod gathered;
pub mod judge;
pub mod workload;

use std::sync::Arc;

use leaderboard_api::{LeaderboardSpec, Ranking, RunPlan};
use leaderboard_contract::run::Run;
use leaderboard_evidence::{Tree, TreeError};
use leaderboard_protocol::files::Pair;

pub use gathered::{Gathered, Object, Objects, Refused, Summary, Texts, WorkerSeen};
pub use leaderboard_results::number_text;
use workload::{Asked, Contents, Reserved, Workload};

/// One kind of evaluation.
pub trait Evaluation {
    fn words(&self) -> &'static Words;

    /// The numbers of a result, in EvalAI's order.
    fn columns(&self) -> Vec<Column>;

    /// Names of the numbers that a result's status shows, the one that ranks where EvalAI names none first.
    fn measures(&self) -> &'static [&'static str];

    /// The number that ranks, and its order, where EvalAI names none.
    fn ranking(&self) -> Ranking;

    /// Names that no host may use.
    fn reserved(&self) -> Reserved;

    /// The container that fills the volumes with what the host keeps private, before the workers start.
    fn contents(&self, asked: &Asked<'_>) -> Contents;

    /// The containers of one worker.
    fn workload(&self, asked: &Asked<'_>, worker: Pair) -> Workload;

    /// An error if the plan of a run contradicts itself.
    fn check(&self, run: &Run) -> Result<(), Refused>;

    /// The reader of the run's results, on the `logs` volume. An error if the plan cannot be evaluated.
    fn results(&self, run: &Run, tree: Arc<Tree>) -> Result<Box<dyn Results>, Refused>;
}

/// The results of a run as its workers write them.
pub trait Results: Send {
    /// Reads everything once. Blocks: not for an asynchronous thread.
    fn round(&mut self) -> Gathered;

    /// Removes restored files that belong to another plan, so that no worker goes on with them.
    fn remove_others(&self) -> Result<(), TreeError>;
}

/// A kind's own words, for the sentences that people read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Words {
    /// Units of work, in the plural.
    pub units: &'static str,
    /// One unit of work.
    pub unit: &'static str,
    /// The container with the host's image.
    pub host: &'static str,
}

/// The words where no kind is known yet.
const PLAIN: Words = Words {
    units: "units",
    unit: "unit",
    host: "host's container",
};

/// One number of a result, under both of its names.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Column {
    /// The label in EvalAI's result and on its leaderboard.
    pub label: &'static str,
    /// The column of the submissions table.
    pub name: &'static str,
}

/// The kind of evaluation of a Leaderboard.
pub fn of(spec: &LeaderboardSpec) -> &'static dyn Evaluation {
    carla::of(spec.evaluation.carla.version)
}

/// The kind of evaluation of a plan.
pub fn of_plan(plan: &RunPlan) -> &'static dyn Evaluation {
    carla::of(plan.carla.version)
}

/// The words of a plan's kind.
pub fn words(plan: Option<&RunPlan>) -> &'static Words {
    plan.map_or(&PLAIN, |plan| of_plan(plan).words())
}

/// Labels of all kinds, for a reader that does not know the kind.
pub fn labels() -> impl Iterator<Item = &'static str> {
    carla::labels()
}
