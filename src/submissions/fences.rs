//! Our own mark in the place of a lost Pod's, so that the Pod stores nothing more.

use std::sync::Arc;
use std::time::Duration;

use super::reports::{RunFiles, silent};
use crate::ask::Asked;
use leaderboard_api::JobNumber;
use leaderboard_aws::clients::Aws;
use leaderboard_contract::report::{OWNER_KEY, Owner};
use leaderboard_policy::ask::{Ask, Failure, Lookup, Service};
use leaderboard_policy::view::ObservedFence;

/// Time before a write that failed is made again.
const TRY_AGAIN: Duration = Duration::from_secs(3);
/// Time for which the fence is tried. After that `decide` goes on without it, and a late mark would stop the next Pod.
const TRIES: Duration = Duration::from_mins(1);

/// A mark that is to be written against the Pod of one Job.
#[derive(Clone, Debug, PartialEq)]
pub struct Fence {
    pub job: JobNumber,
    pub mark: String,
    pub files: Arc<RunFiles>,
}

impl Ask for Fence {
    type Answer = ();
    const AT_ONCE: usize = 64;
    const AT_ONCE_OF_A_SERVICE: usize = 16;
    const LONGEST: Duration = TRIES;

    fn service(&self) -> Service {
        self.files.service()
    }

    fn again(&self, result: &Result<(), Failure>, _failures: u32, waited: Duration) -> Option<Duration> {
        (result.is_err() && waited + TRY_AGAIN < TRIES).then_some(TRY_AGAIN)
    }
}

/// Writes the mark.
pub async fn write(aws: Aws, asked: Asked<Fence>) -> Result<(), Failure> {
    let Fence { mark, files, .. } = &asked.question;
    let archive = files.archive(&aws);
    let put = archive.put(OWNER_KEY, Owner::new(mark).to_json());
    let written = match tokio::time::timeout(TRIES.saturating_sub(asked.waited), put).await {
        Ok(written) => written.map(|_| ()).map_err(|error| silent(&error)),
        Err(_) => Err(Failure::silent(format!(
            "the bucket {} did not answer in time",
            archive.bucket()
        ))),
    };
    if let Err(failure) = &written {
        tracing::warn!(why = failure.why, "the fence against a lost Pod was not written");
    }
    written
}

/// The fence against the Pod of a Job.
pub fn seen(lookup: &Lookup<Fence>, job: JobNumber) -> ObservedFence {
    let Some(asked) = lookup.asked.as_ref().filter(|asked| asked.job == job) else {
        return ObservedFence::NotRequested;
    };
    let waited = lookup.waited.unwrap_or_default();
    match lookup.answer_to(asked).map(|answer| answer.result.as_ref()) {
        None => ObservedFence::Pending(waited),
        Some(Ok(())) => ObservedFence::Held,
        Some(Err(_)) => ObservedFence::Failed(waited),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixtures::{leaderboard, with_job};
    use leaderboard_api::Attempt;
    use leaderboard_policy::ask::Answered;

    fn fence(retry: i32) -> Fence {
        let (submission, _) = with_job("sub", &leaderboard("one", "http://127.0.0.1:9"));
        let plan = submission.status.unwrap().plan.unwrap();
        Fence {
            job: JobNumber {
                attempt: Attempt(1),
                retry,
            },
            mark: "m".into(),
            files: RunFiles::of(&plan, "uid-of-sub"),
        }
    }

    #[test]
    fn a_fence_is_tried_until_it_is_held_or_its_time_is_over() {
        let away = || Err(Failure::silent("away"));
        let again = |result, waited| fence(0).again(&result, 1, Duration::from_secs(waited));
        assert_eq!(again(away(), 0), Some(TRY_AGAIN));
        assert_eq!(again(away(), 56), Some(TRY_AGAIN));
        assert_eq!(again(away(), 57), None, "a late mark would stop the next Pod");
        assert_eq!(again(Ok(()), 0), None);
    }

    #[test]
    fn another_job_has_another_fence() {
        let waited = Duration::from_secs(2);
        let asked = Lookup {
            asked: Some(fence(1)),
            waited: Some(waited),
            ..Lookup::default()
        };
        let of = |lookup: &Lookup<Fence>, retry| seen(lookup, fence(retry).job);
        assert_eq!(of(&asked, 0), ObservedFence::NotRequested);
        assert_eq!(of(&asked, 1), ObservedFence::Pending(waited));
        let answered = |result| Lookup {
            last: Some(Answered {
                question: fence(1),
                sent_ago: Duration::ZERO,
                result: Arc::new(result),
            }),
            ..asked.clone()
        };
        let failure = Failure::silent("away");
        assert_eq!(of(&answered(Err(failure)), 1), ObservedFence::Failed(waited));
        assert_eq!(of(&answered(Ok(())), 1), ObservedFence::Held);
    }
}
