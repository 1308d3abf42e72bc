//! The matrix of the cases that a submission can meet. Each case is a line: the cause, the expected and the seen words of all systems,
//! and the time until `kubectl get submissions` showed the reason.
//!
//! A case is opened before its cause and closed when its end is known. A case that is neither closed nor filtered out is shown as failed.
//! Each line is printed at once, and `make test` prints the table at its end. The cases are in the modules `matrix_*`, and in tests of
//! their own that other modules have.
//!
//! The unit tests of decisions make up Pods, events and nodes. Each fact that they assume has one case with a real one here. A case that
//! differs only in the decision belongs to the unit tests.
//!
//! | fact of the kubelet, the scheduler or the Job controller | case |
//! |---|---|
//! | no node fits: `PodScheduled` False, `Unschedulable`, the scheduler's words | no node fits |
//! | a quota refuses the Pod: event `FailedCreate` of the Job, no Pod | quota exceeded |
//! | `ErrImagePull` and `ImagePullBackOff`, "not found" | image missing |
//! | the same, "401 Unauthorized" | image unauthorised |
//! | the same, "no match for platform" | image for another machine |
//! | `InvalidImageName`, "couldn't parse image name" | name of the contents' image that is none |
//! | a pull that hangs: `PodInitializing` without words, all statuses frozen, a deletion without effect | registry that never answers |
//! | `CreateContainerConfigError`, "secret … not found" | missing Secret |
//! | `CreateContainerConfigError`, "image will run as root" | image of root where the Pod forbids it |
//! | the agent's program is not in the image | command missing in the image |
//! | the kernel can't execute the agent's program | exec format error |
//! | an init container ends with another code than 0 and is tried again, phase `Pending` | contents fail |
//! | the termination log of an init container | workspace can't reach S3 |
//! | a container that ended starts again in its Pod: `restartCount`, `lastState` | agent crashes once |
//! | the termination log of a container is whatever its image writes | agent forges its verdict |
//! | both containers of a pair start again | simulator crashes once |
//! | `OOMKilled` | agent out of memory always |
//! | `Evicted`, the words about a container's disk, and a new Pod of the same Job | evicted for disk by the agent |
//! | `DisruptionTarget`, `EvictionByEvictionAPI` | Pod evicted |
//! | a Pod that is deleted gets a successor from its Job | Pod deleted by hand |
//! | the Pod of a suspended Job is deleted, and its Job makes one again when it is resumed | Job suspended in mid-run |
//! | the Pod of a deleted Job stops by itself | Job deleted by hand |
//! | the Pod of a node that is deleted is gone | node lost |
//! | taints of nodes are seen while Pods run | node about to be taken away |
//! | an annotation reaches the files of a container that runs | cancel while it runs |
//! | an init container gets SIGTERM, with the Pod's grace | cancel in the contents |
//! | a Pod whose image can't be pulled is deleted at once | cancel while an image can't be pulled |
//! | a sidecar that dies starts again, and nothing else does | logcopy killed, and S3 away and back |
//! | containers run on without their kubelet | kubelet of the node killed |
//!
//! The unit tests alone have `UnexpectedAdmissionError`, `PreemptionByScheduler`, a node that falls silent, and what autoscalers
//! report: nothing on one machine makes them.

use std::any::Any;
use std::fs::OpenOptions;
use std::io::Write as _;
use std::panic::AssertUnwindSafe;
use std::time::{Duration, Instant};

use evalai_stand_in::model::Status;
use futures::future::LocalBoxFuture;
use futures::{FutureExt, StreamExt, stream};
use jiff::Timestamp;
use leaderboard_api::{FailureClass, State, Submission};

use crate::scene::{Scene, reason, say, state};

/// How long a reason may take to be shown after its cause. It is a minute by design; a loaded machine takes longer.
pub const SHOWN: Duration = Duration::from_mins(2);
/// Wait for a reason whose cause has no moment of its own. Before it a Pod is made, images are pulled, and containers are started.
const PATIENCE: Duration = Duration::from_mins(5);
/// File that the lines go into, for the program that prints them.
const VARIABLE: &str = "LEADERBOARD_MATRIX";

/// An open case.
pub struct Case {
    name: &'static str,
    expected: &'static str,
    seen: Vec<String>,
    /// When the cause happened whose reason is not shown yet, and how long that may take.
    cause: Option<(Instant, Duration)>,
    /// From a cause until its reason was shown, the longest of them.
    shown: Option<Duration>,
    /// Reasons that were shown too late.
    late: Vec<String>,
    is_closed: bool,
}

impl Case {
    /// Opens a case; `expected` is what [`Case::shows`] and [`Case::ends`] put together.
    pub fn open(name: &'static str, expected: &'static str) -> Self {
        Self {
            name,
            expected,
            seen: Vec::new(),
            cause: None,
            shown: None,
            late: Vec::new(),
            is_closed: false,
        }
    }

    /// Its cause happens now: the next reason that is shown is timed from here.
    pub fn cause(&mut self) {
        self.cause_within(SHOWN);
    }

    /// Like [`Case::cause`], with another limit.
    pub fn cause_within(&mut self, limit: Duration) {
        self.cause = Some((Instant::now(), limit));
    }

    /// Waits until the submission gives the reason, with these words in its message.
    pub async fn shows(&mut self, scene: &Scene, name: &str, wanted: &'static str, words: &'static str) -> Submission {
        let shows = move |s: &Submission| {
            let message = s.status.as_ref().and_then(|status| status.message.as_deref());
            reason(s) == wanted && message.unwrap_or_default().contains(words)
        };
        let what = format!("it says {wanted}: … {words} …");
        let found = scene.submission(name, &what, PATIENCE, shows).await;
        if let Some((cause, limit)) = self.cause.take() {
            self.is_shown(wanted, cause.elapsed(), limit);
        }
        let state = state(&found).map_or("", State::as_str);
        self.seen.push(format!("{state} {}", reason(&found)));
        found
    }

    /// Waits until the submission has come to its end everywhere. Without another cause the reason of a failure is timed
    /// from the end of the container that decided it.
    pub async fn ends(&mut self, scene: &Scene, name: &str, limit: Duration) -> Submission {
        let finished = |s: &Submission| {
            s.status
                .as_ref()
                .is_some_and(|status| status.state.is_some_and(State::is_terminal))
        };
        scene.submission(name, "it has ended", limit, finished).await;
        let now = Timestamp::now();
        let since_cause = self.cause.take().map(|(cause, limit)| (cause.elapsed(), limit));
        let settled = scene.settled(name, limit).await;
        let crash = last_crash(&settled).and_then(|crash| now.duration_since(crash).try_into().ok());
        if let Some((after, limit)) = since_cause.or(crash.map(|after| (after, SHOWN))) {
            self.is_shown("its end", after, limit);
        }
        self.seen.push(end(&settled));
        settled
    }

    /// Notes the status in EvalAI at the end.
    pub fn evalai(&mut self, status: Status) {
        self.also(&format!("EvalAI {}", status.as_str()));
    }

    /// Something else that was seen.
    pub fn also(&mut self, seen: &str) {
        self.seen.push(seen.to_owned());
    }

    /// Closes the case. Fails unless the words so far are the expected ones, and each reason came in time.
    pub fn close(mut self) {
        self.is_closed = true;
        let seen = self.seen.join("; ");
        let is_expected = seen == self.expected;
        print_line(
            self.name,
            self.expected,
            if is_expected { "as expected" } else { &seen },
            self.shown,
        );
        assert!(is_expected, "{}: {seen:?}, not {:?}", self.name, self.expected);
        assert!(self.late.is_empty(), "{}: {}", self.name, self.late.join("; "));
    }

    fn is_shown(&mut self, what: &str, after: Duration, limit: Duration) {
        if after > limit {
            self.late
                .push(format!("{what} is shown after {after:.0?}, not within {limit:.0?}"));
        }
        self.shown = Some(self.shown.map_or(after, |known| known.max(after)));
    }
}

impl Drop for Case {
    fn drop(&mut self) {
        if !self.is_closed {
            let seen = format!("FAILED after {:?}", self.seen.join("; "));
            print_line(self.name, self.expected, &seen, self.shown);
        }
    }
}

/// An end in the words of the table.
fn end(submission: &Submission) -> String {
    let state = state(submission).map_or("", State::as_str);
    let failure = submission.status.as_ref().and_then(|status| status.failure.as_ref());
    let Some(failure) = failure else {
        let reason = reason(submission);
        return if reason == state {
            state.to_owned()
        } else {
            format!("{state} {reason}")
        };
    };
    let class = match failure.class {
        FailureClass::Participant => "participant, charged",
        FailureClass::Infrastructure => "infrastructure, not charged",
    };
    format!("{state} {} ({class})", reason(submission))
}

/// When the container ended whose end decided a failed run.
fn last_crash(submission: &Submission) -> Option<Timestamp> {
    let status = submission.status.as_ref().filter(|status| status.failure.is_some())?;
    status
        .workers
        .iter()
        .filter_map(|worker| Some(worker.last.as_ref()?.time.as_ref()?.0))
        .max()
}

/// Prints a line of the table.
fn print_line(name: &str, expected: &str, seen: &str, shown: Option<Duration>) {
    let seconds = shown.map_or_else(|| "-".to_owned(), |shown| format!("{:.1}", shown.as_secs_f64()));
    let line = format!("{name}\t{expected}\t{seen}\t{seconds}\n");
    say(&format!("matrix: {}", line.trim_end().replace('\t', " | ")));
    let Some(path) = std::env::var_os(VARIABLE) else { return };
    let file = OpenOptions::new().create(true).append(true).open(&path);
    // One write a line: tests that end at once must not mix theirs.
    if let Err(error) = file.and_then(|mut file| file.write_all(line.as_bytes())) {
        say(&format!("matrix: {} can't be written: {error}", path.display()));
    }
}

/// Prints a measurement among the table's lines.
pub fn measured(what: &str, took: Duration, aim: &str) {
    print_line(what, aim, "measured", Some(took));
}

/// A line of something that was tried without waiting for anything, with what was seen of it.
pub fn as_expected(name: &str, expected: &str, seen: &str) {
    print_line(name, expected, &format!("as expected: {seen}"), None);
}

/// A line of a trial with another result than the expected one.
pub fn not_as_expected(name: &str, expected: &str, seen: &str) {
    print_line(name, expected, seen, None);
}

/// Runs cases, so many at once, to the end of all of them; fails if one has failed.
pub async fn together(width: usize, cases: Vec<LocalBoxFuture<'_, ()>>) {
    let ends: Vec<_> = stream::iter(cases)
        .map(|case| AssertUnwindSafe(case).catch_unwind())
        .buffer_unordered(width)
        .collect()
        .await;
    let all = ends.len();
    let failed: Vec<_> = ends
        .into_iter()
        .filter_map(Result::err)
        .map(|panic| message(&*panic))
        .collect();
    let count = failed.len();
    assert!(
        failed.is_empty(),
        "{count} of {all} cases failed:\n{}",
        failed.join("\n")
    );
}

/// The text of a panic.
fn message(panic: &(dyn Any + Send)) -> String {
    let text = panic.downcast_ref::<&str>().map(|text| (*text).to_owned());
    let text = text.or_else(|| panic.downcast_ref::<String>().cloned());
    text.unwrap_or_else(|| "a panic without a text".to_owned())
}
