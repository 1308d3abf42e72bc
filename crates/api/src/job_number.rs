//! Which Job of a submission one is: the attempt, and how many Jobs of it infrastructure failures have ended.
//!
//! Pure.

use crate::{Attempt, Submission, SubmissionStatus};

/// Which Job of a submission.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct JobNumber {
    pub attempt: Attempt,
    /// Jobs of this attempt that infrastructure failures ended before it.
    pub retry: i32,
}

impl JobNumber {
    /// The first Job of an attempt.
    pub fn first(attempt: Attempt) -> Self {
        Self { attempt, retry: 0 }
    }

    /// Suffix of the Job's name: `ATTEMPT`, or `ATTEMPT-rRETRY` from the first retry on.
    pub fn suffix(self) -> String {
        let Self { attempt, retry } = self;
        if retry == 0 {
            attempt.to_string()
        } else {
            format!("{attempt}-r{retry}")
        }
    }
}

impl SubmissionStatus {
    /// The Job that the status speaks of; the very first one before it speaks of any.
    pub fn job_number(&self) -> JobNumber {
        JobNumber {
            attempt: self.attempt.unwrap_or_default(),
            retry: self.retry,
        }
    }
}

impl Submission {
    /// The attempt that all is about which is done now. A higher one in the spec waits until this one has ended.
    pub fn present_attempt(&self) -> Attempt {
        let present = self.status.as_ref().and_then(|status| status.attempt);
        present.unwrap_or(self.spec.attempt)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::names;

    #[test]
    fn each_job_of_a_submission_has_a_name_of_its_own() {
        for (attempt, retry, name) in [(1, 0, "a-1"), (2, 0, "a-2"), (1, 1, "a-1-r1"), (12, 3, "a-12-r3")] {
            let attempt = Attempt(attempt);
            assert_eq!(names::job("a", JobNumber { attempt, retry }), name);
        }
    }

    #[test]
    fn a_status_without_an_attempt_speaks_of_the_first_job() {
        let mut status = SubmissionStatus::default();
        assert_eq!(status.job_number(), JobNumber::first(Attempt(1)));
        (status.attempt, status.retry) = (Some(Attempt(3)), 2);
        let expected = JobNumber {
            attempt: Attempt(3),
            retry: 2,
        };
        assert_eq!(status.job_number(), expected);
    }

    #[test]
    fn an_attempt_that_is_asked_for_is_present_once_the_status_speaks_of_it() {
        let spec = serde_json::json!({"leaderboardName": "lb", "image": "i", "track": "sensors", "attempt": 2});
        let mut submission = Submission::new("a", serde_json::from_value(spec).unwrap());
        assert_eq!(submission.present_attempt(), Attempt(2));
        for attempt in [Attempt(1), Attempt(2)] {
            submission.status = Some(SubmissionStatus {
                attempt: Some(attempt),
                ..SubmissionStatus::default()
            });
            assert_eq!(submission.present_attempt(), attempt);
        }
    }
}
