//! Where the time of a submission goes: waiting, starting, running, publishing. Pure.

use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;
use leaderboard_api::{Submission, Times};
use serde::Serialize;

/// When each phase began, in seconds since 1970; a phase goes on until the next one begins, and the last one until `end`.
#[derive(Serialize, Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Phases {
    pub submitted: Option<i64>,
    pub scheduled: Option<i64>,
    pub started: Option<i64>,
    pub finished: Option<i64>,
    pub published: Option<i64>,
}

/// Medians in seconds over the runs that ended last.
#[derive(Serialize, Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Typical {
    pub runs: usize,
    pub waiting: i64,
    pub starting: i64,
    pub running: i64,
    pub publishing: i64,
}

impl Phases {
    pub(super) fn of(submission: &Submission) -> Self {
        let none = Times::default();
        let times = submission.status.as_ref().map_or(&none, |status| &status.times);
        let seconds = |time: &Option<Time>| time.as_ref().map(|time| time.0.as_second());
        let created = submission.metadata.creation_timestamp.clone();
        Self {
            submitted: seconds(&times.submitted).or_else(|| seconds(&created)),
            scheduled: seconds(&times.scheduled),
            started: seconds(&times.started),
            finished: seconds(&times.finished),
            published: seconds(&times.published),
        }
    }

    /// How long each phase took, of a run that went through all of them. The clocks of EvalAI, kubelet and operator may differ.
    fn lengths(&self) -> Option<[i64; 4]> {
        let (submitted, scheduled) = (self.submitted?, self.scheduled?);
        let (started, finished) = (self.started?, self.finished?);
        let published = self.published.unwrap_or(finished);
        let between = |from: i64, to: i64| to.saturating_sub(from).max(0);
        Some([
            between(submitted, scheduled),
            between(scheduled, started),
            between(started, finished),
            between(finished, published),
        ])
    }
}

/// Medians over these runs; none if none went through all phases.
pub(super) fn typical(runs: &[Phases]) -> Option<Typical> {
    let lengths: Vec<[i64; 4]> = runs.iter().filter_map(Phases::lengths).collect();
    let median = |phase: usize| {
        let mut of: Vec<i64> = lengths.iter().filter_map(|each| each.get(phase).copied()).collect();
        of.sort_unstable();
        of.get(of.len() / 2).copied()
    };
    Some(Typical {
        runs: lengths.len(),
        waiting: median(0)?,
        starting: median(1)?,
        running: median(2)?,
        publishing: median(3)?,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run(moments: [i64; 5]) -> Phases {
        let [submitted, scheduled, started, finished, published] = moments.map(Some);
        Phases {
            submitted,
            scheduled,
            started,
            finished,
            published,
        }
    }

    #[test]
    fn the_typical_run_has_the_median_of_each_phase() {
        let runs = [
            run([0, 10, 20, 120, 121]),
            run([0, 30, 33, 1033, 1040]),
            run([0, 500, 509, 609, 612]),
            // It never ran.
            Phases {
                scheduled: None,
                ..run([0, 1, 2, 3, 4])
            },
        ];
        let expected = Typical {
            runs: 3,
            waiting: 30,
            starting: 9,
            running: 100,
            publishing: 3,
        };
        assert_eq!(typical(&runs), Some(expected));
        assert_eq!(typical(&runs[3..]), None);
    }

    #[test]
    fn a_phase_that_clocks_turn_around_took_no_time() {
        let found = typical(&[run([100, 90, 95, 94, 90])]).unwrap();
        assert_eq!(
            (found.waiting, found.starting, found.running, found.publishing),
            (0, 5, 0, 0)
        );
    }
}
