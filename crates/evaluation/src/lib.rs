//! Kinds of evaluation: what a Pod runs, how its results are read, and in which words people read of it.
//!
//! ```text
//!   api: spec, plan ──► of(), of_plan() ──► a member: carla, container
//!                                             │  plain data
//!        pod-spec ◄── Workload, Contents ─────┤
//!        pod      ◄── Gathered, each round ───┤──► judge, one for all kinds
//!        policy, table, page ◄── Words, Columns┘
//! ```
//!
//! No member makes a type of Kubernetes, and none knows S3, EvalAI or a clock.
#![cfg_attr(not(test), deny(clippy::indexing_slicing, clippy::arithmetic_side_effects))]

pub mod carla;
pub mod container;
#[cfg(any(test, feature = "fixtures"))]
#[allow(clippy::unwrap_used, clippy::arithmetic_side_effects)]
pub mod fixtures;
mod gather;
mod gathered;
pub mod judge;
pub mod workload;

use std::sync::Arc;

use leaderboard_api::{Agents, LeaderboardSpec, PlannedEvaluation, Ranking, RunPlan, Track};
use leaderboard_contract::run::Run;
use leaderboard_evidence::{Tree, TreeError};
use leaderboard_protocol::files::{Host, Pair};

pub use gathered::{Gathered, Object, Objects, Refused, Summary, Texts, WorkerSeen};
pub use leaderboard_results::number_text;
use workload::{Asked, Contents, Data, Reserved, Workload};

/// One kind of evaluation.
pub trait Evaluation {
    fn words(&self) -> &'static Words;

    /// Program in the containers with the host's image.
    fn host(&self) -> Host;

    /// How its agents stand to these containers.
    fn agents(&self) -> Agents {
        Agents::Beside
    }

    /// The numbers of a result, in EvalAI's order; empty where EvalAI's own labels are taken.
    fn columns(&self) -> Vec<Column>;

    /// True if a result's status shows the number of this name.
    fn shows(&self, metric: &str) -> bool;

    /// The number that ranks a track, and its order, where EvalAI names none.
    fn ranking(&self, track: &Track) -> Ranking;

    /// Names that the host of this Leaderboard may not use.
    fn reserved(&self, spec: &LeaderboardSpec) -> Reserved;

    /// Data of the host's, each in a volume of its own.
    fn data<'a>(&self, _spec: &'a LeaderboardSpec) -> Vec<Data<'a>> {
        Vec::new()
    }

    /// The container that fills the volumes with what the host keeps private, before the workers start; `None` if there is none.
    fn contents(&self, asked: &Asked<'_>) -> Option<Contents>;

    /// The containers of one worker; `None` if plan and Leaderboard are of two kinds.
    fn workload(&self, asked: &Asked<'_>, worker: Pair) -> Option<Workload>;

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
    /// One worker: a container with the host's image, and its agent if it has one.
    pub worker: &'static str,
    /// What a participant can try an agent on, in the plural.
    pub practice: &'static str,
    /// Next step after results that are refused, a sentence.
    pub after_refused: &'static str,
    /// Next step after complete results that do not count, a sentence.
    pub after_rejected: &'static str,
}

/// The words where no kind is known yet.
const PLAIN: Words = Words {
    units: "units",
    unit: "unit",
    host: "host's container",
    worker: "worker",
    practice: "data",
    after_refused: "Correct this, and submit again.",
    after_rejected: "Compare the submission with the rules of the challenge, and submit again.",
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
    match &spec.evaluation {
        leaderboard_api::Evaluation::Carla(carla) => carla::of(carla.version),
        leaderboard_api::Evaluation::Container(container) => container::of(container.mode),
    }
}

/// The kind of evaluation of a plan.
pub fn of_plan(plan: &RunPlan) -> &'static dyn Evaluation {
    match &plan.evaluation {
        PlannedEvaluation::Carla(carla) => carla::of(carla.version),
        PlannedEvaluation::Container(container) => container::of(container.mode),
    }
}

/// The words of a plan's kind.
pub fn words(plan: Option<&RunPlan>) -> &'static Words {
    plan.map_or(&PLAIN, |plan| of_plan(plan).words())
}
