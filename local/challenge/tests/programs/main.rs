//! The agent and the simulator as processes, each test in a folder of its own.

// `cfg(test)` shows clippy that the helpers may unwrap too.
#[cfg(test)]
mod agent;
#[cfg(test)]
mod resume;
#[cfg(test)]
mod simulator;
#[cfg(test)]
mod support;
