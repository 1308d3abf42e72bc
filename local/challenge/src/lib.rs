//! Stand-ins for the images of a challenge: a simulator and an agent. They behave as CARLA and the Leaderboard do towards the programs
//! that run them, in milliseconds and without a GPU. The programs in `bin/` call `simulator::run` and `evaluator::run`. This crate does
//! not know the operator: it is written from the Leaderboard's own behaviour, and so can contradict the operator.

pub mod checkpoint;
pub mod evaluator;
pub mod faults;
pub mod flags;
pub mod knobs;
pub mod link;
pub mod resume;
pub mod routes;
pub mod scenario;
pub mod simulator;
pub mod statistics;
