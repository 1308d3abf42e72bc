//! Verdicts on starts, writes and ends, given what EvalAI shows: the server itself enforces nothing.
//!
//! Called by `queue` with each read. Pure: a status in, a verdict out.
//!
//! An [`Attempt`] has `begun` when the end of an earlier one no longer stands:
//!
//! - its Job is in the row's `job_name`;
//! - or the read was sent after EvalAI had answered our `queued`;
//! - or an earlier read showed the submission as live.
//!
//! Until then `failed` belongs to the attempt before. `cancelled` does so only for an attempt that a person has begun here: EvalAI resumes
//! only what has failed, so before an attempt that it has asked for has begun, `cancelled` is a new cancel.

use leaderboard_api as api;
use leaderboard_api::evalai_status::{Outcome, Progress, Status};

/// The attempt that a status may be about.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Attempt {
    pub number: api::Attempt,
    /// A person has begun it here: EvalAI has not asked for it.
    pub by_hand: bool,
    /// See the module's text.
    pub begun: bool,
    /// It was on its way here before the status was read.
    pub under_way: bool,
}

/// Verdict on the start of an attempt.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Start {
    /// It may.
    Run,
    /// EvalAI has ended it: nothing runs, nothing is written.
    Drop(Status),
    /// EvalAI's status is unknown: neither start nor end because of it.
    Unclear,
}

/// Verdict on an update to `queued`, `running` or partial results.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Interim {
    /// Write.
    Send,
    /// EvalAI shows it already: a repeated PATCH would reset the execution time.
    There,
    /// Not now.
    Wait,
    /// EvalAI has ended the run.
    Ended(Status),
}

/// Verdict on an update to the end.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum End {
    /// Write.
    Put,
    /// EvalAI shows it already.
    Done(Status),
    /// EvalAI has ended it otherwise: the outcome becomes Cancelled, nothing is written.
    Amend(Status),
    /// It was deleted there before its end: `cancelled` is written in place of the outcome, which becomes Cancelled.
    Cancel,
    /// EvalAI's status is unknown: read again later.
    Wait,
}

/// Judges the start of this attempt.
pub fn start(status: Status, attempt: Attempt) -> Start {
    match standing(status, attempt) {
        Status::Unknown => Start::Unclear,
        standing if standing.is_live() => Start::Run,
        // EvalAI lets participants write it. The end is ours alone, and is written over it.
        Status::Finished if attempt.under_way => Start::Run,
        _ => Start::Drop(status),
    }
}

/// Judges an update to `queued` or `running`. `is_known`: EvalAI has stored this attempt. Before that, a later attempt writes even over
/// `running`, which an earlier one has written.
pub fn progress(status: Status, attempt: Attempt, is_known: bool, wanted: Progress) -> Interim {
    match start(status, attempt) {
        Start::Drop(status) => Interim::Ended(status),
        Start::Unclear => Interim::Wait,
        Start::Run if (attempt.number == api::Attempt::FIRST || is_known) && reached(status, wanted) => Interim::There,
        Start::Run => Interim::Send,
    }
}

/// Judges partial results. An earlier attempt's end is first overwritten by `queued` or `running`.
pub fn partial(status: Status, attempt: Attempt) -> Interim {
    match start(status, attempt) {
        Start::Drop(status) => Interim::Ended(status),
        Start::Unclear => Interim::Wait,
        Start::Run if standing(status, attempt) != status => Interim::Wait,
        Start::Run => Interim::Send,
    }
}

/// Judges the update to the end.
pub fn end(status: Status, attempt: Attempt, wanted: Outcome) -> End {
    match (standing(status, attempt), wanted) {
        (Status::Unknown, _) => End::Wait,
        (Status::Deleted, Outcome::Finished | Outcome::Failed) => End::Cancel,
        // A result that was published before, as of an object that was restored since. EvalAI's leaderboard lists what is finished alone.
        (Status::Finished, Outcome::Cancelled) if !attempt.under_way => End::Done(status),
        (Status::Failed, Outcome::Failed | Outcome::Cancelled)
        | (Status::Cancelled | Status::Archived | Status::Ignored | Status::Missing, Outcome::Cancelled) => {
            End::Done(status)
        }
        (Status::Cancelled | Status::Archived | Status::Ignored | Status::Missing, _) => End::Amend(status),
        _ => End::Put,
    }
}

/// The status as it is about this attempt: the end of an earlier attempt is a beginning.
fn standing(status: Status, attempt: Attempt) -> Status {
    let follows = attempt.number > api::Attempt::FIRST && !attempt.begun;
    match status {
        Status::Failed if follows => Status::Resuming,
        Status::Cancelled if follows && attempt.by_hand => Status::Resuming,
        other => other,
    }
}

fn reached(status: Status, wanted: Progress) -> bool {
    match wanted {
        Progress::Queued => matches!(status, Status::Queued | Status::Running | Status::PartiallyEvaluated),
        Progress::Running => matches!(status, Status::Running | Status::PartiallyEvaluated),
    }
}

#[cfg(test)]
mod tests {
    use super::Status as S;
    use super::*;

    const LIVE: [S; 6] = [
        S::Submitted,
        S::Submitting,
        S::Resuming,
        S::Queued,
        S::Running,
        S::PartiallyEvaluated,
    ];
    const GONE: [S; 3] = [S::Archived, S::Ignored, S::Missing];
    const DELETED: [S; 1] = [S::Deleted];

    /// One that a person has begun, as all were once.
    fn of(number: i64, begun: bool) -> Attempt {
        Attempt {
            number: api::Attempt(number),
            by_hand: true,
            begun,
            under_way: false,
        }
    }

    #[test]
    fn a_cancel_before_the_first_read_of_an_attempt_that_evalai_has_asked_for_stays() {
        let asked_for = |number, begun| Attempt {
            by_hand: false,
            ..of(number, begun)
        };
        for begun in [false, true] {
            let attempt = asked_for(2, begun);
            assert_eq!(start(S::Cancelled, attempt), Start::Drop(S::Cancelled));
            for wanted in [Progress::Queued, Progress::Running] {
                let ended = Interim::Ended(S::Cancelled);
                assert_eq!(progress(S::Cancelled, attempt, false, wanted), ended);
            }
            assert_eq!(partial(S::Cancelled, attempt), Interim::Ended(S::Cancelled));
            assert_eq!(end(S::Cancelled, attempt, Outcome::Finished), End::Amend(S::Cancelled));
        }
        assert_eq!(
            start(S::Failed, asked_for(2, false)),
            Start::Run,
            "that is what was resumed"
        );
        assert_eq!(start(S::Failed, asked_for(2, true)), Start::Drop(S::Failed));
    }

    #[test]
    fn nobody_but_us_finishes_a_run_that_is_under_way() {
        for (number, begun) in [(1, false), (1, true), (2, false), (2, true)] {
            let under_way = Attempt {
                under_way: true,
                ..of(number, begun)
            };
            assert_eq!(start(S::Finished, under_way), Start::Run);
            for is_known in [false, true] {
                let sent = progress(S::Finished, under_way, is_known, Progress::Running);
                assert_eq!(sent, Interim::Send, "{number} {begun} {is_known}");
            }
            assert_eq!(partial(S::Finished, under_way), Interim::Send);
            for wanted in [Outcome::Finished, Outcome::Failed, Outcome::Cancelled] {
                assert_eq!(end(S::Finished, under_way, wanted), End::Put);
            }
            for status in [S::Archived, S::Deleted, S::Ignored, S::Missing] {
                assert_eq!(start(status, under_way), Start::Drop(status));
            }
        }
        let under_way = Attempt {
            under_way: true,
            ..of(1, true)
        };
        for status in [S::Failed, S::Cancelled] {
            assert_eq!(start(status, under_way), Start::Drop(status));
        }
    }

    #[test]
    fn a_live_row_is_started_and_an_ended_one_is_dropped() {
        for begun in [false, true] {
            for attempt in [1, 2, 7] {
                for status in LIVE {
                    assert_eq!(
                        start(status, of(attempt, begun)),
                        Start::Run,
                        "{status} {attempt} {begun}"
                    );
                }
                for status in GONE.into_iter().chain(DELETED).chain([S::Finished]) {
                    assert_eq!(
                        start(status, of(attempt, begun)),
                        Start::Drop(status),
                        "{status} {attempt} {begun}"
                    );
                }
                assert_eq!(start(S::Unknown, of(attempt, begun)), Start::Unclear);
            }
        }
        for status in [S::Failed, S::Cancelled] {
            assert_eq!(start(status, of(1, false)), Start::Drop(status), "attempt 1");
            assert_eq!(start(status, of(1, true)), Start::Drop(status), "attempt 1");
            assert_eq!(
                start(status, of(2, false)),
                Start::Run,
                "the end of attempt 1 does not end attempt 2"
            );
            assert_eq!(
                start(status, of(2, true)),
                Start::Drop(status),
                "attempt 2 itself was ended"
            );
        }
    }

    #[test]
    fn finals_follow_their_table() {
        use Outcome::{Cancelled, Failed, Finished};
        let all = [(1, false), (1, true), (2, false), (2, true)].map(|(attempt, begun)| of(attempt, begun));
        for status in LIVE.into_iter().chain([S::Finished]) {
            for (attempt, wanted) in all
                .iter()
                .flat_map(|attempt| [Finished, Failed, Cancelled].map(|o| (*attempt, o)))
            {
                let under_way = Attempt {
                    under_way: true,
                    ..attempt
                };
                assert_eq!(end(status, under_way, wanted), End::Put, "{status} {wanted:?}");
                let is_kept = status == S::Finished && wanted == Cancelled;
                let expected = if is_kept { End::Done(status) } else { End::Put };
                assert_eq!(end(status, attempt, wanted), expected, "{status} {wanted:?}");
            }
        }
        assert_eq!(end(S::Failed, of(1, true), Finished), End::Put);
        assert_eq!(end(S::Failed, of(1, true), Failed), End::Done(S::Failed));
        assert_eq!(end(S::Failed, of(1, true), Cancelled), End::Done(S::Failed));
        for status in GONE.into_iter().chain([S::Cancelled]) {
            assert_eq!(end(status, of(1, true), Finished), End::Amend(status));
            assert_eq!(end(status, of(1, true), Failed), End::Amend(status));
            assert_eq!(end(status, of(1, true), Cancelled), End::Done(status));
            assert_eq!(end(status, of(2, true), Finished), End::Amend(status));
        }
        assert_eq!(end(S::Unknown, of(1, true), Finished), End::Wait);
    }

    #[test]
    fn a_submission_deleted_before_its_end_is_cancelled_whatever_its_outcome() {
        for (attempt, begun) in [(1, false), (1, true), (2, false), (2, true)] {
            for wanted in [Outcome::Finished, Outcome::Failed] {
                assert_eq!(end(S::Deleted, of(attempt, begun), wanted), End::Cancel);
            }
            assert_eq!(end(S::Deleted, of(attempt, begun), Outcome::Cancelled), End::Put);
        }
    }

    #[test]
    fn a_short_later_attempt_is_published_over_the_end_of_the_earlier_one() {
        for wanted in [Outcome::Finished, Outcome::Failed, Outcome::Cancelled] {
            assert_eq!(end(S::Cancelled, of(2, false), wanted), End::Put);
            assert_eq!(end(S::Failed, of(2, false), wanted), End::Put);
        }
        assert_eq!(
            end(S::Archived, of(2, false), Outcome::Finished),
            End::Amend(S::Archived)
        );
    }

    #[test]
    fn progress_is_written_once() {
        use Progress::{Queued, Running};
        for (status, wanted, first, later) in [
            (S::Submitted, Queued, Interim::Send, Interim::Send),
            (S::Resuming, Running, Interim::Send, Interim::Send),
            (S::Queued, Queued, Interim::There, Interim::Send),
            (S::Queued, Running, Interim::Send, Interim::Send),
            (S::Running, Queued, Interim::There, Interim::Send),
            (S::Running, Running, Interim::There, Interim::Send),
            (S::PartiallyEvaluated, Running, Interim::There, Interim::Send),
            (S::Cancelled, Queued, Interim::Ended(S::Cancelled), Interim::Send),
            (S::Failed, Running, Interim::Ended(S::Failed), Interim::Send),
            (
                S::Finished,
                Running,
                Interim::Ended(S::Finished),
                Interim::Ended(S::Finished),
            ),
            (S::Unknown, Queued, Interim::Wait, Interim::Wait),
        ] {
            assert_eq!(
                progress(status, of(1, false), false, wanted),
                first,
                "{status} {wanted:?}, attempt 1"
            );
            assert_eq!(
                progress(status, of(2, false), false, wanted),
                later,
                "{status} {wanted:?}, attempt 2 before it has begun"
            );
            assert_eq!(
                progress(status, of(2, true), true, wanted),
                first,
                "{status} {wanted:?}, attempt 2 after it has begun"
            );
        }
    }

    #[test]
    fn a_later_attempt_is_published_once_even_where_the_earlier_one_left_its_texts() {
        assert_eq!(
            progress(S::Running, of(2, true), false, Progress::Queued),
            Interim::Send
        );
        assert_eq!(
            progress(S::Cancelled, of(2, true), false, Progress::Queued),
            Interim::Ended(S::Cancelled)
        );
    }

    #[test]
    fn partials_follow_only_a_run_that_evalai_has() {
        for status in LIVE {
            assert_eq!(partial(status, of(1, false)), Interim::Send);
        }
        for status in GONE
            .into_iter()
            .chain(DELETED)
            .chain([S::Cancelled, S::Failed, S::Finished])
        {
            assert_eq!(partial(status, of(1, true)), Interim::Ended(status));
        }
        assert_eq!(partial(S::Cancelled, of(2, false)), Interim::Wait);
        assert_eq!(partial(S::Cancelled, of(2, true)), Interim::Ended(S::Cancelled));
        assert_eq!(partial(S::Unknown, of(1, true)), Interim::Wait);
    }
}
