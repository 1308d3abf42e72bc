//! Demands and answers, under a clock that only the test moves.

use tokio::time::Instant;

use super::*;
use crate::ask::state::{State, Work};
use crate::fixtures::{leaderboard, with_job};
use leaderboard_base::object_key::ObjectKey;
use leaderboard_base::spans::LogSpan;

struct Bench {
    state: State<Report>,
    now: Instant,
    files: Arc<RunFiles>,
}

fn demand(stage: Stage) -> ReportDemand {
    ReportDemand {
        job: JobNumber::first(Attempt(1)),
        pod: Some("p".into()),
        stage,
        period: Duration::from_secs(10),
    }
}

/// The Job after so many that infrastructure failures ended.
fn again(retry: i32) -> JobNumber {
    JobNumber {
        attempt: Attempt(1),
        retry,
    }
}

fn key(uid: &str) -> ObjectKey {
    ObjectKey {
        namespace: "one".into(),
        name: "sub".into(),
        uid: uid.into(),
    }
}

fn found(done: u32) -> Stored {
    let digest = ReportDigest {
        attempt: Attempt(1),
        done,
        ..ReportDigest::default()
    };
    Stored {
        etag: Some(done.to_string()),
        digest: Some(Arc::new(digest)),
    }
}

fn failed(why: &str) -> Result<Option<Stored>, Failure> {
    Err(Failure::silent(why))
}

impl Bench {
    fn new() -> Self {
        let (submission, _) = with_job("sub", &leaderboard("one", "http://127.0.0.1:9"));
        Self {
            state: State::default(),
            now: Instant::now(),
            files: RunFiles::of(&submission.status.unwrap().plan.unwrap(), "u"),
        }
    }

    fn wait(&mut self, time: Duration) {
        self.now += time;
    }

    fn demand(&mut self, stage: Stage) {
        self.demand_of("u", demand(stage), None);
    }

    fn demand_of(&mut self, uid: &str, demand: ReportDemand, ended: Option<i64>) {
        let question = Report {
            demand,
            ended: Timestamp::from_second(ended.unwrap_or(1_800_000_000)).unwrap(),
            files: Arc::clone(&self.files),
        };
        self.state.want(&key(uid), question, LogSpan::default(), self.now);
    }

    #[track_caller]
    fn begin(&mut self) -> Work<Report> {
        self.state.next(self.now).expect("something is due")
    }

    fn is_idle(&mut self) -> bool {
        self.state.next(self.now).is_none()
    }

    fn answer(&mut self, work: &Work<Report>, answer: Result<Option<Stored>, Failure>) -> bool {
        self.state.done(work, answer, self.now)
    }

    /// Reads what is due now.
    #[track_caller]
    fn read(&mut self, answer: Result<Option<Stored>, Failure>) -> bool {
        let work = self.begin();
        self.answer(&work, answer)
    }

    fn seen(&self) -> ReportView {
        self.seen_of(0, Some("p"))
    }

    fn seen_of(&self, retry: i32, pod: Option<&str>) -> ReportView {
        seen(&self.state.get("u", self.now), again(retry), pod)
    }

    fn stage(&self) -> Option<Stage> {
        self.seen().stage
    }

    fn done(&self) -> Option<u32> {
        self.seen().ours().map(|report| report.done)
    }
}

#[test]
fn an_answer_has_the_stage_that_was_known_when_it_was_asked_for() {
    let mut bench = Bench::new();
    assert_eq!(
        (bench.stage(), bench.done()),
        (None, None),
        "after a restart nothing is known"
    );
    bench.demand(Stage::Live);
    assert!(bench.read(Ok(Some(found(1)))));
    assert_eq!((bench.stage(), bench.done()), (Some(Stage::Live), Some(1)));
    assert!(bench.is_idle());

    // The Job ends while a live read is under way.
    bench.wait(Duration::from_secs(10));
    let under_way = bench.begin();
    bench.demand(Stage::JobEnded);
    assert!(bench.is_idle(), "one read of a report at a time");
    bench.answer(&under_way, Ok(Some(found(2))));
    assert_eq!(
        (bench.stage(), bench.done()),
        (Some(Stage::Live), Some(2)),
        "it may lack what was stored last"
    );
    bench.wait(Report::SPACING);
    let second = bench.begin();
    assert!(bench.answer(&second, Ok(Some(found(4)))));
    assert_eq!((bench.stage(), bench.done()), (Some(Stage::JobEnded), Some(4)));
    bench.wait(Duration::from_hours(1));
    assert!(bench.is_idle(), "an end is read once");
}

#[test]
fn an_end_takes_two_reads_and_the_same_report_counts_as_read() {
    let mut bench = Bench::new();
    bench.demand(Stage::Live);
    bench.read(Ok(Some(found(4))));
    for stage in [Stage::RunEnded, Stage::JobEnded] {
        bench.wait(Report::SPACING);
        bench.demand(stage);
        let work = bench.begin();
        let known = work.asked.last.as_ref().map(|last| last.result.as_ref());
        assert_eq!(known, Some(&Ok(Some(found(4)))), "S3 is asked for a change");
        assert!(bench.answer(&work, Ok(Some(found(4)))), "the end may be decided now");
        assert_eq!((bench.stage(), bench.done()), (Some(stage), Some(4)));
    }
}

#[test]
fn what_was_read_for_one_pod_or_job_is_no_answer_for_another() {
    let mut bench = Bench::new();
    bench.demand(Stage::RunEnded);
    bench.read(Ok(Some(found(4))));
    assert_eq!(bench.seen_of(0, Some("p")).stage, Some(Stage::RunEnded));
    assert_eq!(bench.seen_of(0, Some("q")).stage, None);
    assert_eq!(bench.seen_of(0, None).stage, None);
    assert_eq!(bench.seen_of(1, Some("p")).stage, None);
    let other = JobNumber::first(Attempt(2));
    let seen = seen(&bench.state.get("u", bench.now), other, Some("p"));
    assert_eq!(seen.stored, ObservedReport::Foreign, "another attempt's");
    // The Pod goes with its Job.
    bench.wait(Report::SPACING);
    bench.demand(Stage::JobEnded);
    bench.read(Ok(Some(found(4))));
    assert_eq!(bench.seen_of(0, None).stage, Some(Stage::JobEnded));
    let gone = ReportDemand {
        pod: None,
        ..demand(Stage::JobEnded)
    };
    bench.demand_of("u", gone, None);
    assert!(bench.is_idle());
}

#[test]
fn a_read_that_failed_is_an_answer_and_is_made_again() {
    let mut bench = Bench::new();
    bench.demand(Stage::Live);
    bench.read(Ok(Some(found(1))));
    bench.wait(Report::SPACING);
    bench.demand(Stage::JobEnded);
    assert!(bench.read(failed("away")));
    let seen = bench.seen();
    assert_eq!(
        (seen.stored, seen.stage),
        (ObservedReport::Unreadable("away".into()), Some(Stage::JobEnded))
    );
    bench.demand(Stage::JobEnded);
    assert!(bench.is_idle(), "not at once");
    bench.wait(READ_AGAIN);
    assert!(!bench.read(failed("still away")), "nothing new");
    bench.wait(READ_AGAIN);
    assert_eq!(bench.seen().waited, READ_AGAIN * 2);
    let work = bench.begin();
    let known = work.asked.last.as_ref().map(|last| last.result.as_ref());
    assert_eq!(known, Some(&Ok(Some(found(1)))), "what is known may still be so");
    assert!(bench.answer(&work, Ok(Some(found(1)))));
    assert_eq!(bench.done(), Some(1));
}

#[test]
fn live_reports_are_read_once_a_period_and_with_too_many_in_turn() {
    let mut bench = Bench::new();
    let many = 2000;
    for number in 0..many {
        bench.demand_of(&number.to_string(), demand(Stage::Live), None);
    }
    let (mut reads, begin) = (Vec::new(), bench.now);
    while bench.now < begin + Duration::from_mins(1) {
        while let Some(work) = bench.state.next(bench.now) {
            reads.push(bench.now - begin);
            let is_new = bench.answer(&work, Ok(Some(found(1))));
            assert_eq!(is_new, reads.len() <= many, "the same is nothing new");
        }
        bench.wait(Report::SPACING);
    }
    let in_second = |second: u64| reads.iter().filter(|at| at.as_secs() == second).count();
    assert!((0..60).all(|second| in_second(second) <= 100), "at most 100 a second");
    assert!(in_second(30) >= 90, "{}", in_second(30));
}

#[test]
fn an_end_is_read_before_live_reports_and_of_ends_the_oldest_first() {
    let mut bench = Bench::new();
    for number in 0..50 {
        bench.demand_of(&number.to_string(), demand(Stage::Live), None);
    }
    bench.wait(Duration::from_secs(1));
    for (uid, ended) in [("new", 30), ("oldest", 1), ("old", 20)] {
        bench.demand_of(uid, demand(Stage::JobEnded), Some(ended));
    }
    let mut order = Vec::new();
    for _ in 0..4 {
        order.push(bench.begin().asked.about.uid);
        bench.wait(Report::SPACING);
    }
    assert_eq!(order[..3], ["oldest", "old", "new"]);
    assert_eq!(order[3].len(), 1, "the first of those that live");
}

#[test]
fn what_goes_on_again_is_not_answered_by_what_was_asked_before() {
    let mut bench = Bench::new();
    bench.demand(Stage::JobEnded);
    let under_way = bench.begin();
    bench.demand(Stage::Live);
    assert!(!bench.answer(&under_way, Ok(Some(found(3)))));
    assert_eq!(bench.stage(), None);
    bench.wait(Report::SPACING);
    bench.read(Ok(Some(found(3))));
    assert_eq!((bench.stage(), bench.done()), (Some(Stage::Live), Some(3)));
    bench.wait(Report::SPACING);
    bench.demand(Stage::JobEnded);
    bench.read(Ok(Some(found(3))));
    bench.demand(Stage::Live);
    bench.demand(Stage::JobEnded);
    assert_eq!(bench.stage(), None, "the first end is no answer to the second");
    bench.wait(Report::SPACING);
    assert!(bench.read(Ok(Some(found(4)))), "the second end is read too");
    assert_eq!((bench.stage(), bench.done()), (Some(Stage::JobEnded), Some(4)));
}

#[test]
fn what_is_dropped_is_not_answered_by_what_was_asked_before() {
    // The Job is gone, and another one is made while that is being read.
    let mut bench = Bench::new();
    bench.demand(Stage::JobEnded);
    let under_way = bench.begin();
    bench.state.forget("u");
    bench.demand(Stage::Live);
    assert!(!bench.answer(&under_way, Ok(Some(found(4)))));
    assert_eq!((bench.stage(), bench.done()), (None, None));
    bench.wait(Report::SPACING);
    assert!(bench.read(Ok(Some(found(0)))), "it is read in its turn");
}

#[test]
fn a_bucket_that_hangs_is_asked_by_no_more_than_its_places() {
    let mut bench = Bench::new();
    for number in 0..100 {
        bench.demand_of(&number.to_string(), demand(Stage::JobEnded), None);
    }
    let mut reads = 0;
    for _ in 0..200 {
        reads += usize::from(!bench.is_idle());
        bench.wait(Report::SPACING);
    }
    assert_eq!(reads, Report::AT_ONCE_OF_A_SERVICE);
    assert_eq!(bench.state.next_due(bench.now), None, "an answer wakes the task");
}
