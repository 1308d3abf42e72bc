//! How long a submission waits for what: one table. Pure.

use std::time::Duration;

use jiff::{SignedDuration, Timestamp};

/// A row of the table, in seconds.
#[derive(Clone, Copy)]
pub(super) struct Wait {
    /// Nothing new is shown for so long.
    pub(super) silent: i64,
    /// It is looked at again after so long, should nothing wake the submission before.
    pub(super) again: i64,
    /// It is given up, or gone on without, after so long.
    pub(super) longest: i64,
}

/// A part of a row that is not used, or a wait without an end.
const NONE: i64 = 0;

impl Wait {
    /// EvalAI's word on a submission that is to run.
    pub(super) const EVALAI: Self = row(5, 30, NONE);
    /// The row of another program's run.
    pub(super) const ROW: Self = row(5, 1, NONE);
    /// The copy of a submitted file. After `longest` without one a person has to look.
    pub(super) const INPUT: Self = row(5, NONE, 5 * 60);
    /// The NetworkPolicy of a Leaderboard, which may come together with its first submission.
    pub(super) const POLICY: Self = row(5, NONE, NONE);
    /// The row's phase in EvalAI: time for a host who has made a mistake, and not too long for a participant, whose team has that
    /// submission in progress.
    pub(super) const PHASE: Self = row(NONE, NONE, 3600);
    /// A slot, and all that comes before it.
    pub(super) const SLOT: Self = row(NONE, 300, NONE);
    /// A Job that was asked for.
    pub(super) const JOB: Self = row(NONE, 15, NONE);
    /// An older object's Job of the same name.
    pub(super) const JOB_NAME: Self = row(NONE, 5, NONE);
    /// The Job of an earlier try, which the next reconcile does not see any more.
    pub(super) const EARLIER_JOB: Self = row(NONE, 1, NONE);
    /// The next Job after an infrastructure failure: `again` is the first delay, which doubles up to `longest`.
    pub(super) const RETRY: Self = row(NONE, 10, 10 << 8);
    /// A Job's Pod.
    pub(super) const POD: Self = row(45, NONE, NONE);
    /// The resume of a suspended Job: a queue with a free quota admits it at once. After `longest` without a queue a person has to look.
    pub(super) const SUSPENDED: Self = row(5, NONE, 15 * 60);
    /// A Pod's node, or a quota: the Pod whose slot it got may still be leaving. After `longest` without an autoscaler that adds a node a
    /// person has to look.
    pub(super) const NODE: Self = row(5, NONE, 15 * 60);
    /// The agents of a Pod: less than the minute in which people want to see a cause.
    pub(super) const PREPARATION: Self = row(45, NONE, NONE);
    /// A live run. A stage that works by the clock asks for its own time.
    pub(super) const RUN: Self = row(NONE, 300, NONE);
    /// The other side's end of a round. A runner ends within moments of its peer.
    pub(super) const PEER: Self = row(NONE, NONE, 120);
    /// The report of a run that has ended. After `longest` a resume can still take up the results in its bucket.
    pub(super) const REPORT: Self = row(15, 10, DAY);
    /// The report of a run that was cancelled, if `deadlines.cancelSeconds` is not longer: a bucket that hung is left alone for up to half of
    /// it.
    pub(super) const CANCELLED_REPORT: Self = row(15, 10, 60);
    /// Our mark in the place of a lost Pod's.
    pub(super) const FENCE: Self = row(NONE, NONE, 60);
    /// The log of a failure, before its Pod goes, or EvalAI has the end without it.
    pub(super) const LOG: Self = row(NONE, NONE, 15);
    /// Added to `deadlines.cancelSeconds`, and to any grace, before the next harder step of a stop.
    pub(super) const STOP_MARGIN: Self = row(NONE, NONE, 15);
    /// A Job that is being deleted; `longest` is the grace of a Pod that did not stop by itself.
    pub(super) const DELETION: Self = row(NONE, 2, 60);
    /// A Job that somebody else deletes.
    pub(super) const OTHERS_DELETION: Self = row(NONE, 5, NONE);
    /// The uploads from a node that is about to go: of the two minutes of a Spot instance's notice, what is left when the cluster has passed
    /// it on.
    pub(super) const LEAVING: Self = row(NONE, NONE, 90);
    /// Grace of such a Pod after that: all that takes longer is lost with the node.
    pub(super) const LEAVING_GRACE: Self = row(NONE, NONE, 5);
    /// A Pod past its grace whose node is not known.
    pub(super) const LOST_POD: Self = row(NONE, NONE, 30);
    /// A Pod past its grace whose kubelet reports: it may still be cleaning up.
    pub(super) const STUCK_POD: Self = row(NONE, NONE, 120);
    /// A Pod that is being deleted on a node that is silent or gone. The node controller itself has waited some 40 s for a word, and 60 s more
    /// before it deletes the Pod.
    pub(super) const SILENT_NODE: Self = row(NONE, NONE, 30);
    /// The last words of logcopy and the kubelet after a run. Its results are stored by then.
    pub(super) const FAREWELL: Self = row(NONE, NONE, 120);
    /// Other systems that get an end, and deletions that follow it.
    pub(super) const DELIVERY: Self = row(NONE, 30, NONE);
    /// The table's answer, to be shown with EvalAI's.
    pub(super) const TOGETHER: Self = row(10, NONE, NONE);
    /// The parts of a result to be published that cannot be read: as long as its end has waited.
    pub(super) const UNREAD: Self = row(NONE, NONE, DAY);
    /// Texts of another round than the report: they hardly change.
    pub(super) const UNFIT: Self = row(NONE, NONE, 600);
    /// The time to publish an end before the finalizer of a deleted object gives up.
    pub(super) const BEFORE_RELEASE: Self = row(NONE, NONE, 120);
    /// The end of a retention, which an edit of the Leaderboard moves.
    pub(super) const RETENTION: Self = row(NONE, 3600, NONE);
    /// The standings, before a result that is among the best is deleted.
    pub(super) const STANDINGS: Self = row(NONE, 15, NONE);
    /// Progress that waits for its write.
    pub(super) const PROGRESS: Self = row(30, NONE, NONE);

    pub(super) const fn again(self) -> Duration {
        Duration::from_secs(self.again.unsigned_abs())
    }

    pub(super) const fn silence(self) -> Duration {
        Duration::from_secs(self.silent.unsigned_abs())
    }

    /// When it begins to be shown.
    pub(super) fn shown_at(self, since: Timestamp) -> Timestamp {
        after(since, self.silent)
    }

    /// When it is over.
    pub(super) fn over_at(self, since: Timestamp) -> Timestamp {
        after(since, self.longest)
    }

    /// How long it still stays silent.
    pub(super) fn silence_left(self, waited: Duration) -> Option<Duration> {
        left_of(self.silence(), waited)
    }

    /// How long it still lasts.
    pub(super) fn left(self, waited: Duration) -> Option<Duration> {
        left_of(Duration::from_secs(self.longest.unsigned_abs()), waited)
    }
}

const DAY: i64 = 86_400;

const fn row(silent: i64, again: i64, longest: i64) -> Wait {
    Wait { silent, again, longest }
}

/// The rest of a time of which so much has passed.
fn left_of(time: Duration, passed: Duration) -> Option<Duration> {
    time.checked_sub(passed).filter(|left| !left.is_zero())
}

/// The moment `seconds` after another.
pub(super) fn after(start: Timestamp, seconds: i64) -> Timestamp {
    start
        .checked_add(SignedDuration::from_secs(seconds))
        .unwrap_or(Timestamp::MAX)
}
