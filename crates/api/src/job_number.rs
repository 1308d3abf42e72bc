//! Which Job of a submission one is: the attempt, and how many Jobs of it infrastructure failures have ended.
//!
//! Pure.

use crate::SubmissionStatus;

/// Which Job of a submission.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct JobNumber {
    /// From 1.
    pub attempt: i64,
    /// Jobs of this attempt that infrastructure failures ended before it.
    pub retry: i32,
}

impl JobNumber {
    /// The first Job of an attempt.
    pub fn first(attempt: i64) -> Self {
        Self { attempt, retry: 0 }
    }

    /// What the name of its Job ends with.
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
            attempt: self.attempt.unwrap_or(1),
            retry: self.retry,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::names;

    #[test]
    fn each_job_of_a_submission_has_a_name_of_its_own() {
        for (attempt, retry, name) in [(1, 0, "a-1"), (2, 0, "a-2"), (1, 1, "a-1-r1"), (12, 3, "a-12-r3")] {
            assert_eq!(names::job("a", JobNumber { attempt, retry }), name);
        }
    }

    #[test]
    fn a_status_without_an_attempt_speaks_of_the_first_job() {
        let mut status = SubmissionStatus::default();
        assert_eq!(status.job_number(), JobNumber::first(1));
        (status.attempt, status.retry) = (Some(3), 2);
        let expected = JobNumber { attempt: 3, retry: 2 };
        assert_eq!(status.job_number(), expected);
    }
}
