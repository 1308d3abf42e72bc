//! Evaluators, the agents that they evaluate, and what any container has left at its end. For `run`.
//!
//! The evaluator's result alone ends such a pair. An agent can forge its own marks, so that its `.done` does no more than start the time
//! that the evaluator has for the result.

use std::path::Path;
use std::time::{Duration, Instant};

use super::Runner;
use crate::decide::{Cause, Part};
use crate::group::Status;
use crate::result::{self, REFUSED, State};
use crate::{checkpoint, left_files, report};
use leaderboard_protocol::files::{Host, Mark, Pair, RESULT, StatusFile};

/// Time that an evaluator with a complete result has to end by itself: what it has printed last may still be in its own buffers.
const LAST_WORDS: Duration = Duration::from_secs(5);

impl Runner {
    /// True if an evaluator's result is complete, or if it has refused the submission by its exit code.
    pub(super) fn has_result(&mut self) -> bool {
        let has_refused = self.has_refused();
        self.result
            .as_mut()
            .is_some_and(|result| has_refused || result.is_complete())
    }

    /// True if a pair before this one is not done, or has no final result, and the evaluator's command begins after them.
    pub(super) fn is_held(&self) -> bool {
        let Some(folder) = &self.job.after else { return false };
        let mut before = Pair::first(self.job.pair.index());
        !before.all(|pair| {
            // All its processes have ended then, so that nothing is written any more.
            let done = StatusFile::Of(pair.host(Host::Evaluator), Mark::Done);
            done.exists(&self.job.status) && result::is_final(&folder.join(pair.to_string()).join(RESULT))
        })
    }

    fn has_refused(&self) -> bool {
        self.status() == Some(Status::Exited(REFUSED))
    }

    /// Gives an evaluator the time to end by itself.
    pub(super) fn let_end(&mut self) {
        let begin = Instant::now();
        while self.group.is_some() && self.status().is_none() && !self.terminated {
            let left = LAST_WORDS.saturating_sub(begin.elapsed());
            if left.is_zero() {
                return;
            }
            self.wait(left);
        }
    }

    /// Completeness of the results, and what is left, in words. Asked once every process has ended.
    pub(super) fn results(&self, cause: Cause) -> (bool, Option<String>) {
        let job = &self.job;
        match (self.part, job.result(), &job.checkpoint) {
            (_, Some(path), _) => {
                let state = self.result(&path, cause);
                (state.is_complete(), Some(state.to_string()))
            }
            (_, _, Some(checkpoint)) if self.group.is_some() => {
                checkpoint::make_readable(checkpoint);
                let found = checkpoint::read(checkpoint);
                let complete = matches!(&found, Ok(found) if found.complete || self.is_driven(found));
                (complete, Some(report::of_checkpoint(&found)))
            }
            (Part::Plain, ..) if self.status() == Some(Status::Exited(0)) => {
                if let Some(folder) = &job.leaves {
                    left_files::make_readable(folder, left_files::ENTRIES);
                }
                (true, None)
            }
            _ => (false, None),
        }
    }

    /// Cause of an evaluator's end, now that nothing can change its result any more: what was complete a moment ago can have been written
    /// over, and what was not can be complete.
    pub(super) fn of_the_result(&self, cause: Cause, complete: bool) -> Cause {
        match cause {
            Cause::HasResult if !complete => Cause::ChildEnded,
            Cause::ChildEnded | Cause::PeerCrashed | Cause::NoResult if complete && self.part == Part::Evaluator => {
                Cause::HasResult
            }
            _ => cause,
        }
    }

    /// An evaluator that refused the submission by its exit code has written no text, so that its runner writes one.
    fn result(&self, path: &Path, cause: Cause) -> State {
        let state = result::read(path);
        let was_asked = matches!(cause, Cause::Terminated | Cause::Cancelled);
        if state.is_complete() || was_asked || !self.has_refused() {
            return state;
        }
        result::refuse(path).map_or_else(State::Unwritten, |()| result::read(path))
    }
}
