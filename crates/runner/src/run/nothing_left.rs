//! Agents with nothing left to drive, which their checkpoints show. For `run`.
//!
//! An evaluator that is started on a complete checkpoint needs a simulator for nothing. In V2 it also writes the file anew without the
//! sensors, which are named at the set-up of a route. The file's own total is no measure: a checkpoint can be of an earlier plan.

use leaderboard_protocol::files::Mark;

use super::Runner;
use crate::checkpoint::{self, Checkpoint};
use crate::decide::Cause;

impl Runner {
    /// An agent whose routes are all driven is done before it begins. Its simulator, which waits for no more than that, ends too.
    pub(super) fn close_if_driven(&mut self) -> Result<(), Cause> {
        let Some(checkpoint) = &self.job.checkpoint else {
            return Ok(());
        };
        if let Some(keeper) = &mut self.keeper {
            // Half of a file hides what it held. One that cannot be put back is reported when the command is to start.
            let _ = keeper.prepare();
        }
        if !checkpoint::read(checkpoint).is_ok_and(|found| self.is_driven(&found)) {
            return Ok(());
        }
        checkpoint::make_readable(checkpoint);
        self.say("all routes are in the checkpoint, so the command is not started");
        self.mark(Mark::Done)
    }

    /// True if the checkpoint has all routes that were to be driven.
    pub(super) fn is_driven(&self, found: &Checkpoint) -> bool {
        self.job.route_runs.is_some() && found.driven == self.job.route_runs
    }
}
