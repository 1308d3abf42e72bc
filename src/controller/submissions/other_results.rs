//! How many routes another program's run of a submission has, for a Leaderboard that only observes: read once, after both have ended,
//! from the results that the original pipeline stores below the prefix of the run.

use std::time::Duration;

use serde::Deserialize;

use super::questions::{self, Observed, Questions};
use crate::ask::Service;
use crate::controller::objects::Wake;
use crate::observability::tasks::Tasks;
use crate::services::archive::Archive;
use crate::services::aws::Aws;
use leaderboard_api::{Attempt, RunId, RunPlan, Storage, Submission, effective};

/// Time one look may take.
const LIMIT: Duration = Duration::from_secs(20);
/// Bytes of results that are read: a hundred routes have less than one of these eight.
const MOST_BYTES: u64 = 8 << 20;
/// The merged results of the original pipeline, below the prefix of a run.
const RESULTS_KEY: &str = "agent/agent_results.json";

/// Where the other program stores a run.
#[derive(Clone, Debug, PartialEq)]
pub struct Question {
    attempt: Attempt,
    storage: Storage,
    run_id: RunId,
}

/// Routes of a run: how many are done, of how many.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Routes {
    pub done: i32,
    pub total: i32,
}

/// What was found; `Err`: why nothing can be compared.
pub type Answer = Result<Routes, String>;

impl questions::Question for Question {
    type Answer = Answer;
    const AT_ONCE: usize = 2;
    const AT_ONCE_OF_A_SERVICE: usize = 1;
    // A run that has ended stays as it is.
    const GOOD_FOR: Duration = Duration::from_hours(1);

    fn attempt(&self) -> Attempt {
        self.attempt
    }

    fn shares_a_service(&self, other: &Self) -> bool {
        Service::bucket(&self.storage) == Service::bucket(&other.storage)
    }
}

/// The questions and their answers.
pub type OtherResults = Questions<Question>;

/// What is known of a submission's present attempt.
pub type ObservedRoutes = Observed<Answer>;

impl OtherResults {
    /// Starts the task that reads.
    pub fn start(aws: &Aws, tasks: &Tasks, wake: Wake<Submission>) -> Self {
        let aws = aws.clone();
        let read = move |question: Question, _namespace| {
            let aws = aws.clone();
            async move {
                let read = tokio::time::timeout(LIMIT, read(&aws, &question)).await;
                read.unwrap_or_else(|_| {
                    Err(format!(
                        "{} was not read within {} s",
                        question.address(),
                        LIMIT.as_secs()
                    ))
                })
            }
        };
        Self::answered_by(read, "other results", tasks, wake)
    }
}

async fn read(aws: &Aws, question: &Question) -> Answer {
    let archive = Archive::of_run(aws, &question.storage, &question.run_id);
    let object = archive.get(RESULTS_KEY, MOST_BYTES).await;
    let object = object.map_err(|error| error.to_string())?;
    let object = object.ok_or_else(|| format!("there is no {}", question.address()))?;
    routes(&object.bytes).ok_or_else(|| format!("{} has no count of routes", question.address()))
}

/// The count that the evaluator writes: `_checkpoint.progress` is `[done, total]`.
fn routes(bytes: &[u8]) -> Option<Routes> {
    #[derive(Deserialize)]
    struct File {
        #[serde(rename = "_checkpoint")]
        checkpoint: Checkpoint,
    }
    #[derive(Deserialize)]
    struct Checkpoint {
        progress: [i32; 2],
    }
    let file: File = serde_json::from_slice(bytes).ok()?;
    let [done, total] = file.checkpoint.progress;
    (0 <= done && done <= total).then_some(Routes { done, total })
}

impl Question {
    /// The original has no prefix before the ids of runs, and one that observes has one of its own.
    pub fn of(plan: &RunPlan, attempt: Attempt) -> Self {
        let storage = Storage {
            prefix: None,
            ..plan.storage.clone()
        };
        Self {
            attempt,
            storage,
            run_id: plan.run_id.clone(),
        }
    }

    /// For people.
    pub fn address(&self) -> String {
        format!("{}/{RESULTS_KEY}", effective::results_url(&self.storage, &self.run_id))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn routes_are_counted_as_the_evaluator_counts_them() {
        let counted = |text: &str| routes(text.as_bytes()).map(|routes| (routes.done, routes.total));
        for (text, expected) in [
            (
                r#"{"_checkpoint": {"progress": [20, 20], "records": [{"index": 0}]}, "entry_status": "Finished"}"#,
                Some((20, 20)),
            ),
            (r#"{"_checkpoint": {"progress": [16, 20]}}"#, Some((16, 20))),
            (r#"{"_checkpoint": {"progress": [21, 20]}}"#, None),
            (r#"{"_checkpoint": {"progress": []}}"#, None),
            (r#"{"_checkpoint": {"progress": [-1, 20]}}"#, None),
            ("{}", None),
            ("{\"_checkpoint\": ", None),
        ] {
            assert_eq!(counted(text), expected, "{text}");
        }
    }
}
