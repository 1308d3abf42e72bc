//! The queue, one rule a test: updates in, requests out, answers in.

mod bursts;
mod cancels;
mod faults;
mod life;
mod order;
mod outage;
mod passing;
mod payloads;
mod simulation;
mod splits;
mod sweep;

use jiff::SignedDuration;

use super::*;
use crate::answer::{About, Answer, Refusal, Silence};
use crate::request::{Purpose, Reply};
use crate::row::{DatasetSplit, Phase, PhaseSplit, Row, Schema, Split};
use crate::token::Token;
use crate::types::{ImageAnswer, Metrics, Payload, PayloadProblem, Run, StoredResult, Usage};
use leaderboard_api::evalai_status::Status;
use leaderboard_api::{Attempt, Order};
use leaderboard_base::spans::LogSpan;
use leaderboard_contract::report::{ContentId, Patience};

impl Request {
    /// Its name in these tests.
    fn name(&self) -> &'static str {
        match self {
            Self::Get(_) => "submission",
            Self::Image(..) => "image",
            Self::Progress(_, Progress::Queued, _) => "queued",
            Self::Progress(_, Progress::Running, _) => "running",
            Self::Partial(..) => "partial",
            Self::Final(_, outcome, _) => outcome.as_str(),
            Self::List { purpose, .. } => match purpose {
                Purpose::Cancel => "list of cancelled",
                Purpose::SweepSubmitted => "sweep of submitted",
                Purpose::SweepResuming => "sweep of resuming",
            },
            Self::Phases(_) => "phases",
            Self::Splits(_) => "splits",
            Self::DatasetSplit(..) => "dataset split",
            Self::PhaseSplit(..) => "phase split",
            Self::Challenge(_) => "challenge",
            Self::Receive(_) => "message",
            Self::MessageRow(_) => "row of a message",
            Self::DeleteMessage(..) => "deletion of a message",
        }
    }
}

/// A queue whose time is ours.
struct Bench {
    queue: Queue,
    at: Duration,
}

fn target() -> Target {
    Target {
        leaderboard: key(100),
        api_server: "http://evalai".into(),
        challenge: 1,
        split: "leaderboard".into(),
        token: Arc::new(Token::parse("x").unwrap()),
        requests_per_minute: 54,
        sweep: Duration::from_mins(1),
        period: Duration::from_secs(10),
        phases: [1].into(),
        metrics: Metrics::Fixed(["Driving score".to_owned()].into()),
        inbox: None,
        is_observed: false,
        takes_files: false,
        since: wall(-3600),
    }
}

/// An empty queue whose budget is its own.
fn queue_of(limit: u32, not_before: Duration, now: Now) -> Queue {
    let share = Purse::new(limit, now.at).share(limit, now.at);
    Queue::new(Timing::default(), share, not_before, now)
}

fn wall(seconds: i64) -> Timestamp {
    Timestamp::from_second(1_800_000_000 + seconds).unwrap()
}

fn key(pk: i64) -> Key {
    Key {
        namespace: "carla".into(),
        name: format!("submission-{pk}"),
        uid: format!("uid-{pk}"),
    }
}

fn run(pk: i64, attempt: i64) -> Run {
    Run {
        attempt: Attempt(attempt),
        job: format!("submission-{pk}-{attempt}"),
        by_hand: true,
        has_job: false,
        ended: None,
        log: LogSpan::default(),
    }
}

fn subject(key: &Key, pk: i64, run: &Run) -> Subject {
    Subject {
        target: Arc::new(target()),
        key: key.clone(),
        pk,
        run: run.clone(),
    }
}

/// The attempt of a submission, as its object asks about it.
fn of(pk: i64, attempt: i64) -> Subject {
    subject(&key(pk), pk, &run(pk, attempt))
}

fn row(pk: i64, status: Status) -> Row {
    Row {
        phase: Some(1),
        submitted_at: Some(wall(-60)),
        status,
        ..Row::missing(pk)
    }
}

/// Results whose bucket holds this score.
fn results(score: f64) -> Arc<Outline> {
    results_in("bucket", score)
}

fn results_in(bucket: &str, score: f64) -> Arc<Outline> {
    let storage = serde_json::from_value(serde_json::json!({"bucket": bucket})).unwrap();
    Arc::new(Outline {
        phase: 1,
        stored: Some(StoredResult {
            storage,
            prefix: score.to_string(),
            report: ContentId::default(),
            done: score.trunc().to_string().parse().unwrap(),
            so_far: false,
            patience: Patience::ENDLESS,
        }),
        ..Outline::default()
    })
}

/// Payload that the bucket gives out.
fn stored(outline: &Outline) -> Payload {
    let score = &outline.stored.as_ref().unwrap().prefix;
    Payload {
        result: format!(
            r#"[{{"split":"leaderboard","show_to_participant":true,"accuracies":{{"Driving score":{score}}}}}]"#
        ),
        ..Payload::bare(outline)
    }
}

/// The next request, with what has to be read of a bucket before.
fn next(queue: &mut Queue, now: Now, may_write: bool) -> Next {
    loop {
        match queue.next(now, may_write) {
            Next::Read(key, outline) => queue.took_payload(&key, Ok((stored(&outline), None)), now),
            other => return other,
        }
    }
}

fn unanswered() -> Reply {
    Reply::Written(Answer::Unanswered(Silence {
        sent: true,
        why: "EvalAI did not answer in time".into(),
    }))
}

fn refusal(about: About, status: u16) -> Refusal {
    Refusal {
        about,
        status,
        message: format!("EvalAI answered {status}"),
    }
}

impl Bench {
    /// A minute after its start: the budget has earned its burst.
    fn new() -> Self {
        Self::with_writes_after(0)
    }

    fn with_writes_after(seconds: u64) -> Self {
        let mut bench = Self {
            queue: queue_of(54, Duration::from_secs(seconds), now(Duration::ZERO)),
            at: Duration::ZERO,
        };
        bench.wait(60.0);
        bench
    }

    /// No two moments are the same.
    fn now(&mut self) -> Now {
        self.at += Duration::from_micros(1);
        now(self.at)
    }

    fn wait(&mut self, seconds: f64) {
        self.at += Duration::from_secs_f64(seconds);
    }

    fn ask(&mut self, pk: i64, attempt: i64) {
        let now = self.now();
        self.queue.ask(&of(pk, attempt), false, now);
    }

    fn live(&mut self, pk: i64, attempt: i64) {
        self.queue.live(&of(pk, attempt), wall(-60));
    }

    fn update(&mut self, pk: i64, attempt: i64, update: DesiredUpdate) {
        let now = self.now();
        self.queue.update(&of(pk, attempt), update, now);
    }

    fn forget(&mut self, pk: i64) {
        let now = self.now();
        self.queue.forget(&key(pk), now);
    }

    fn serve(&mut self) {
        let now = self.now();
        self.queue.serve(&key(100), &target(), now);
    }

    fn is_unsure(&mut self) -> bool {
        let now = self.now();
        self.queue.settled_at(now).is_some()
    }

    fn view(&self, pk: i64) -> SubmissionState {
        self.queue.view(&key(pk)).unwrap()
    }

    /// The next request as text, and its ticket.
    fn next(&mut self) -> Option<(String, Ticket)> {
        self.next_or_wait().ok()
    }

    /// Next request, or until when there is nothing to send.
    fn next_or_wait(&mut self) -> Result<(String, Ticket), Option<Duration>> {
        let now = self.now();
        match next(&mut self.queue, now, true) {
            Next::Send(ticket) => {
                let pk = ticket
                    .request
                    .submission()
                    .map(|subject| format!(" {}", subject.pk))
                    .unwrap_or_default();
                Ok((format!("{}{pk}", ticket.request.name()), ticket))
            }
            Next::Wait(until) => Err(until),
            Next::Read(..) => unreachable!("it was read"),
        }
    }

    /// The next request has to be this one.
    fn expect(&mut self, name: &str) -> Ticket {
        let (found, ticket) = self
            .next()
            .unwrap_or_else(|| panic!("nothing is sent, expected {name}"));
        assert_eq!(found, name);
        ticket
    }

    fn expect_nothing(&mut self) {
        if let Some((found, _)) = self.next() {
            panic!("{found} is sent, expected nothing");
        }
    }

    fn answer(&mut self, ticket: &Ticket, reply: Reply) {
        let now = self.now();
        self.queue.answered(ticket, reply, now);
    }

    /// The next request has to be a read of this submission, which EvalAI answers so.
    fn get(&mut self, pk: i64, answer: Row) {
        let ticket = self.expect(&format!("submission {pk}"));
        self.answer(&ticket, Reply::Row(Answer::Done(answer)));
    }

    /// The next request has to be this write, which EvalAI takes.
    fn write(&mut self, name: &str) -> Ticket {
        let ticket = self.expect(name);
        self.answer(&ticket, Reply::Written(Answer::Done(())));
        ticket
    }

    /// The next requests have to be the read of a running submission and this write, which EvalAI takes.
    fn read_and_write(&mut self, pk: i64, name: &str) -> Ticket {
        self.get(pk, row(pk, Status::Running));
        self.write(&format!("{name} {pk}"))
    }

    fn list(&mut self, name: &str, rows: Vec<Row>) -> Ticket {
        let ticket = self.expect(name);
        self.answer(&ticket, Reply::Rows(Answer::Done(rows)));
        ticket
    }

    /// Several submissions that run, each of them read once more.
    fn all_running(&mut self, pks: &[i64]) {
        for pk in pks {
            self.live(*pk, 1);
            self.update(*pk, 1, DesiredUpdate::Running);
            self.answer_all(Status::Submitted);
            self.wait(5.0);
        }
        for _ in 0..30 {
            self.wait(2.0);
            self.answer_all(Status::Running);
        }
    }

    /// Answers all that is sent now: nothing was cancelled, every row has this status, every write is taken.
    fn answer_all(&mut self, status: Status) {
        while let Some((_, ticket)) = self.next() {
            let reply = match &ticket.request {
                Request::List { .. } => Reply::Rows(Answer::Done(vec![])),
                Request::Get(subject) => Reply::Row(Answer::Done(row(subject.pk, status))),
                _ => Reply::Written(Answer::Done(())),
            };
            self.answer(&ticket, reply);
        }
    }

    /// A submission of attempt 1 that EvalAI shows as running, after the first list.
    fn running(&mut self, pk: i64) {
        self.ask(pk, 1);
        self.get(pk, row(pk, Status::Submitted));
        self.live(pk, 1);
        self.list("list of cancelled", vec![]);
        self.update(pk, 1, DesiredUpdate::Queued);
        self.get(pk, row(pk, Status::Submitted));
        self.write(&format!("queued {pk}"));
        self.update(pk, 1, DesiredUpdate::Running);
        self.get(pk, row(pk, Status::Queued));
        self.write(&format!("running {pk}"));
        self.expect_nothing();
    }
}

fn now(at: Duration) -> Now {
    Now {
        at,
        wall: wall(0) + SignedDuration::try_from(at).unwrap(),
    }
}
