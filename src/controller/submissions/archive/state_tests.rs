//! Demands and answers, under a clock that only the test moves.

use super::*;
use crate::controller::submissions::archive::request::Answer;
use crate::controller::submissions::report_digest::ReportDigest;
use crate::controller::submissions::view::{LogAt, LogPlace, ObservedReport};
use leaderboard_api::Attempt;

struct Bench {
    state: State,
    now: Instant,
    target: Arc<Target>,
}

fn uid(name: &str) -> Uid {
    name.into()
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

fn found(done: u32) -> Answer {
    let report = ReportDigest {
        attempt: Attempt(1),
        done,
        ..ReportDigest::default()
    };
    Answer::Found {
        etag: Some(done.to_string()),
        report: Arc::new(report),
    }
}

impl Bench {
    fn new() -> Self {
        Self {
            state: State::default(),
            now: Instant::now(),
            target: Arc::new(Target {
                namespace: "one".into(),
                name: "sub".into(),
                leaderboard: "carla".into(),
                prefix: "7/".into(),
                submission_uid: "u".into(),
                attempt: Attempt(1),
                ended: None,
            }),
        }
    }

    fn wait(&mut self, time: Duration) {
        self.now += time;
    }

    fn demand(&mut self, stage: Stage) {
        self.demand_as(Some(demand(stage)));
    }

    fn demand_as(&mut self, demand: Option<ReportDemand>) {
        self.state.demand(&uid("u"), &self.target, demand, self.now);
    }

    #[track_caller]
    fn begin(&mut self) -> Work {
        self.state.next(self.now).expect("something is due")
    }

    fn is_idle(&mut self) -> bool {
        self.state.next(self.now).is_none()
    }

    fn answer(&mut self, work: &Work, answer: Answer) -> bool {
        self.state.done(work, Done::Report(answer), self.now)
    }

    /// Reads what is due now.
    #[track_caller]
    fn read(&mut self, answer: Answer) -> bool {
        let work = self.begin();
        self.answer(&work, answer)
    }

    fn seen(&self) -> ReportView {
        self.state
            .report("u", JobNumber::first(Attempt(1)), Some("p"), self.now)
    }

    fn stage(&self) -> Option<Stage> {
        self.seen().stage
    }

    fn done(&self) -> Option<u32> {
        self.seen().ours().map(|report| report.done)
    }

    fn want_fence(&mut self, retry: i32) {
        self.state
            .want_fence(&uid("u"), &self.target, again(retry), "m".into(), self.now);
    }

    fn fence(&self) -> ObservedFence {
        self.state.fence("u", JobNumber::first(Attempt(1)), self.now)
    }

    fn want_log(&mut self, is_over: bool) {
        self.state.want_log(&uid("u"), &self.target, log(is_over), self.now);
    }

    fn log(&self, is_over: bool) -> ObservedLog {
        self.state.log("u", JobNumber::first(Attempt(1)), is_over, self.now)
    }
}

fn log(is_over: bool) -> LogDemand {
    let key = "agent/agent1/leaderboard.log".to_owned();
    LogDemand {
        job: JobNumber::first(Attempt(1)),
        places: vec![LogPlace {
            container: "agent-1".into(),
            at: LogAt::Bucket { key },
        }],
        is_over,
    }
}

fn tail() -> Tail {
    Tail {
        container: "agent-1".into(),
        attempt: Attempt(1),
        key: None,
        text: "boom".into(),
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
    assert!(bench.read(found(1)));
    assert_eq!((bench.stage(), bench.done()), (Some(Stage::Live), Some(1)));
    assert!(bench.is_idle());

    // The Job ends while a live read is under way.
    bench.wait(Duration::from_secs(10));
    let under_way = bench.begin();
    bench.demand(Stage::JobEnded);
    assert!(bench.is_idle(), "one read of a report at a time");
    bench.answer(&under_way, found(2));
    assert_eq!(
        (bench.stage(), bench.done()),
        (Some(Stage::Live), Some(2)),
        "it may lack what was stored last"
    );
    bench.wait(SPACING);
    let second = bench.begin();
    assert!(bench.answer(&second, found(4)));
    assert_eq!((bench.stage(), bench.done()), (Some(Stage::JobEnded), Some(4)));
    bench.wait(Duration::from_hours(1));
    assert!(bench.is_idle(), "an end is read once");
}

#[test]
fn an_end_takes_two_reads_and_what_has_not_changed_counts_as_read() {
    let mut bench = Bench::new();
    bench.demand(Stage::Live);
    bench.read(found(4));
    for stage in [Stage::RunEnded, Stage::JobEnded] {
        bench.wait(SPACING);
        bench.demand(stage);
        let work = bench.begin();
        assert!(matches!(&work.what, What::Report { etag: Some(etag), .. } if etag == "4"));
        assert!(bench.answer(&work, Answer::NotModified), "the end may be decided now");
        assert_eq!((bench.stage(), bench.done()), (Some(stage), Some(4)));
    }
}

#[test]
fn what_was_read_for_one_pod_or_job_is_no_answer_for_another() {
    let mut bench = Bench::new();
    bench.demand(Stage::RunEnded);
    bench.read(found(4));
    let of = |bench: &Bench, retry, pod| bench.state.report("u", again(retry), pod, bench.now).stage;
    assert_eq!(of(&bench, 0, Some("p")), Some(Stage::RunEnded));
    assert_eq!(of(&bench, 0, Some("q")), None);
    assert_eq!(of(&bench, 0, None), None);
    assert_eq!(of(&bench, 1, Some("p")), None);
    let seen = bench
        .state
        .report("u", JobNumber::first(Attempt(2)), Some("p"), bench.now);
    assert_eq!(seen.stored, ObservedReport::Foreign, "another attempt's");
    // The Pod goes with its Job.
    bench.wait(SPACING);
    bench.demand(Stage::JobEnded);
    bench.read(Answer::NotModified);
    assert_eq!(of(&bench, 0, None), Some(Stage::JobEnded));
    bench.demand_as(Some(ReportDemand {
        pod: None,
        ..demand(Stage::JobEnded)
    }));
    assert!(bench.is_idle());
}

#[test]
fn a_read_that_failed_is_an_answer_and_is_made_again() {
    let mut bench = Bench::new();
    bench.demand(Stage::Live);
    bench.read(found(1));
    bench.wait(SPACING);
    bench.demand(Stage::JobEnded);
    assert!(bench.read(Answer::Failed("away".into())));
    let seen = bench.seen();
    assert_eq!(
        (seen.stored, seen.stage),
        (ObservedReport::Unreadable("away".into()), Some(Stage::JobEnded))
    );
    bench.demand(Stage::JobEnded);
    assert!(bench.is_idle(), "not at once");
    bench.wait(READ_AGAIN);
    assert!(!bench.read(Answer::Failed("still away".into())), "nothing new");
    bench.wait(READ_AGAIN);
    assert_eq!(bench.seen().waited, READ_AGAIN * 2);
    assert!(bench.read(Answer::NotModified), "what is known is still so");
    assert_eq!(bench.done(), Some(1));
}

#[test]
fn live_reports_are_read_once_a_period_which_stretches_with_their_number() {
    let mut bench = Bench::new();
    let many = 2000;
    for number in 0..many {
        let uid = uid(&number.to_string());
        bench
            .state
            .demand(&uid, &bench.target, Some(demand(Stage::Live)), bench.now);
    }
    let (mut reads, begin) = (Vec::new(), bench.now);
    while bench.now < begin + Duration::from_mins(1) {
        while let Some(work) = bench.state.next(bench.now) {
            reads.push(bench.now - begin);
            assert_eq!(
                bench.answer(&work, found(1)),
                reads.len() <= many,
                "the same is nothing new"
            );
        }
        bench.wait(SPACING);
    }
    let in_second = |second: u64| reads.iter().filter(|at| at.as_secs() == second).count();
    assert!((0..60).all(|second| in_second(second) <= 100), "at most 100 a second");
    assert!(in_second(30) >= 90, "{}", in_second(30));
    assert!(
        reads.len() <= 3 * many,
        "each every 20 s, not every 10: {}",
        reads.len()
    );
}

#[test]
fn an_end_is_read_before_live_reports() {
    let mut bench = Bench::new();
    for number in 0..50 {
        bench.state.demand(
            &uid(&number.to_string()),
            &bench.target,
            Some(demand(Stage::Live)),
            bench.now,
        );
    }
    bench.wait(Duration::from_secs(1));
    bench.demand(Stage::RunEnded);
    assert_eq!(bench.begin().uid, uid("u"));
}

#[test]
fn what_nobody_needs_is_dropped() {
    let mut bench = Bench::new();
    bench.demand(Stage::Live);
    let under_way = bench.begin();
    bench.demand_as(None);
    assert!(bench.state.runs.is_empty());
    assert!(!bench.answer(&under_way, found(1)), "nobody is woken");
    bench.demand(Stage::Live);
    bench.want_fence(0);
    bench.state.forget("u");
    bench.wait(Duration::from_mins(1));
    assert!(bench.is_idle() && bench.state.runs.is_empty());
    assert!(bench.state.due.iter().all(BTreeSet::is_empty));
}

#[test]
fn what_is_dropped_or_goes_on_again_is_not_answered_by_what_was_asked_before() {
    // The Job is gone, and another one is made while that is being read.
    let mut bench = Bench::new();
    bench.demand(Stage::JobEnded);
    let under_way = bench.begin();
    bench.demand_as(None);
    bench.demand(Stage::Live);
    assert!(!bench.answer(&under_way, found(4)));
    assert_eq!((bench.stage(), bench.done()), (None, None));

    let mut bench = Bench::new();
    bench.demand(Stage::JobEnded);
    let under_way = bench.begin();
    bench.demand(Stage::Live);
    bench.answer(&under_way, found(3));
    assert_eq!(bench.stage(), Some(Stage::Live));
    bench.wait(SPACING);
    bench.demand(Stage::JobEnded);
    bench.read(found(3));
    bench.demand(Stage::Live);
    assert_eq!((bench.stage(), bench.done()), (None, Some(3)), "its numbers stay");
    bench.wait(SPACING);
    bench.demand(Stage::JobEnded);
    assert!(bench.read(found(4)), "the second end is read too");
}

#[test]
fn a_fence_is_tried_until_it_is_held_or_its_time_is_over() {
    let mut bench = Bench::new();
    assert_eq!(bench.fence(), ObservedFence::NotRequested);
    bench.want_fence(0);
    bench.want_fence(0);
    assert_eq!(bench.fence(), ObservedFence::Pending(Duration::ZERO));
    let mut tries = 0;
    let begin = bench.now;
    while bench.now < begin + Duration::from_mins(10) {
        while let Some(work) = bench.state.next(bench.now) {
            tries += 1;
            let is_new = bench.state.done(&work, Done::Fence(Err("away".into())), bench.now);
            assert_eq!(is_new, tries == 1, "the same is nothing new");
            assert!(matches!(bench.fence(), ObservedFence::Failed(_)));
            assert!(bench.now < begin + FENCE_TRIES, "a late mark would stop the next Pod");
        }
        bench.wait(Duration::from_secs(1));
    }
    assert_eq!(tries, 20);

    bench.want_fence(1);
    assert_eq!(
        bench.fence(),
        ObservedFence::NotRequested,
        "another Job has another fence"
    );
    let work = bench.begin();
    bench.state.done(&work, Done::Fence(Ok(())), bench.now);
    assert_eq!(bench.state.fence("u", again(1), bench.now), ObservedFence::Held);
    assert!(bench.is_idle());
}

#[test]
fn a_log_that_was_found_is_stored_at_the_end_and_given_up_after_some_tries() {
    let mut bench = Bench::new();
    bench.want_log(false);
    bench.wait(Duration::from_secs(2));
    assert_eq!(bench.log(false), ObservedLog::Pending(Duration::from_secs(2)));
    let answer = |tail, is_unclear| Done::Log(LogAnswer { tail, is_unclear });
    let work = bench.begin();
    assert!(bench.state.done(&work, answer(Some(tail()), false), bench.now));
    assert_eq!(
        (bench.log(false), bench.log(true)),
        (ObservedLog::Kept, ObservedLog::NotRequested)
    );
    bench.want_log(false);
    assert!(bench.is_idle(), "it was found");

    bench.want_log(true);
    assert_eq!(bench.log(true), ObservedLog::Pending(Duration::ZERO));
    for is_last in [false, false, true] {
        let work = bench.begin();
        assert!(
            matches!(&work.what, What::Log { tail: Some(_), .. }),
            "only to be stored"
        );
        assert_eq!(bench.state.done(&work, answer(Some(tail()), true), bench.now), is_last);
        bench.want_log(true);
        bench.wait(TRY_AGAIN);
    }
    assert_eq!(bench.log(true), ObservedLog::GivenUp);
    assert_eq!(
        bench.state.tail("u", JobNumber::first(Attempt(1))),
        Some(tail()),
        "EvalAI's hosts get it all the same"
    );
    assert_eq!(bench.state.tail("u", again(1)), None);
    assert!(bench.is_idle());
}

#[test]
fn each_kind_has_its_own_limit() {
    let mut bench = Bench::new();
    for number in 0..100 {
        bench.state.demand(
            &uid(&number.to_string()),
            &bench.target,
            Some(demand(Stage::JobEnded)),
            bench.now,
        );
    }
    let mut reads = 0;
    for _ in 0..200 {
        reads += usize::from(bench.state.next(bench.now).is_some());
        bench.wait(SPACING);
    }
    assert_eq!(reads, 32, "the bucket hangs");
    assert_eq!(bench.state.wake_at(), None, "an answer wakes the worker");
    bench.want_fence(0);
    assert_eq!(bench.begin().kind, Kind::Fence, "nothing else waits for it");
}
