//! Hours of a bad network in milliseconds: a model of the server that reads early and saves late, faults, cancellations,
//! a lease that comes and goes; and what must hold all the same.

mod server;

use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap};

use fastrand::Rng;
use jiff::SignedDuration;

use super::*;
use crate::answer::{Answer, Silence};
use crate::budget::WINDOW;
use crate::request::{Purpose, Reply};
use crate::row::Row;
use leaderboard_api::evalai_status::Status;

const SUBMISSIONS: i64 = 12;
/// Submissions that their participant deletes at some time.
const DELETED: [i64; 2] = [11, 12];
/// Submissions that their participant edits to finished at some times.
const FINISHED: [i64; 3] = [8, 9, 10];
const MINUTE_LIMIT: usize = 54;
/// Faults, cancellations and new attempts end here; what is left must come to its end after it.
const PEACE: Duration = Duration::from_mins(40);
const END: Duration = Duration::from_mins(75);
/// One way to the server.
const WAY: Duration = Duration::from_millis(50);
/// Longest time that the server takes to answer a read.
const READ_SECONDS: f64 = 0.5;
/// A write follows the answer to its read by no more.
const FRESH: Duration = Duration::from_millis(1_001);

/// A submission in the server's table.
#[derive(Clone, Debug)]
struct Record {
    status: Status,
    jobs: Vec<String>,
    /// Rows of the leaderboard.
    rows: u32,
    /// Its participant has deleted it, which leaves its status.
    deleted: bool,
    /// When the participant last cancelled it.
    cancelled_at: Option<Duration>,
}

/// A write that the server works on: the record as it was read, and changed.
#[derive(Clone, Debug)]
struct Work {
    pk: i64,
    kind: &'static str,
    attempt: i64,
    /// When the attempt began: a later attempt overwrites the cancel of an earlier one.
    began: Duration,
    sent: Duration,
    /// When the server answered the read that allowed it.
    checked: Duration,
    read: Record,
    save: Record,
}

#[derive(Debug)]
enum Event {
    Arrive(Ticket),
    Save(Work),
    Answer(Ticket, Reply),
    Reconcile,
    Cancel(i64),
    Delete(i64),
    /// Its participant writes that it has finished.
    Finish(i64),
    Lease(bool),
    Wake,
}

/// A submission as the controller has it.
#[derive(Clone, Debug, Default)]
struct Actor {
    attempt: i64,
    began: Option<Duration>,
    length: Duration,
    settled: bool,
}

struct World {
    rng: Rng,
    at: Duration,
    queue: Queue,
    lease: bool,
    events: BinaryHeap<Reverse<(Duration, u64)>>,
    bodies: BTreeMap<u64, Event>,
    count: u64,
    table: BTreeMap<i64, Record>,
    /// Writes on their way or worked on, by submission.
    working: BTreeMap<i64, u32>,
    sent: Vec<Duration>,
    /// Reads without a write since: when the server made each, and when we had its answer.
    checked: BTreeMap<i64, (Duration, Duration)>,
    actors: BTreeMap<i64, Actor>,
    /// Cancellations overwritten by our writes: while the server worked on one, and between a read and one.
    lost: (usize, usize),
    cancels: usize,
    deleted: usize,
    edited: usize,
    published: u32,
}

fn target() -> Target {
    Target {
        leaderboard: key(0),
        since: submitted_at(),
        ..super::target()
    }
}

fn submitted_at() -> Timestamp {
    Timestamp::from_second(1_800_000_000).unwrap()
}

fn key(pk: i64) -> Key {
    Key {
        namespace: "carla".into(),
        name: format!("submission-{pk}"),
        uid: pk.to_string(),
    }
}

fn row(pk: i64, record: &Record) -> Row {
    let status = match record.status {
        status if record.deleted && status.is_live() => Status::Deleted,
        _ if record.deleted => Status::Ignored,
        status => status,
    };
    Row {
        status,
        phase: Some(1),
        submitted_at: Some(submitted_at()),
        jobs: record.jobs.clone(),
        ..Row::missing(pk)
    }
}

fn results(score: u64) -> Arc<Outline> {
    super::results(f64::from(u32::try_from(score).unwrap()))
}

impl World {
    fn new(seed: u64) -> Self {
        let start = Now {
            at: Duration::ZERO,
            wall: submitted_at(),
        };
        let record = Record {
            status: Status::Submitted,
            jobs: vec![],
            rows: 0,
            deleted: false,
            cancelled_at: None,
        };
        let mut world = Self {
            rng: Rng::with_seed(seed),
            at: Duration::ZERO,
            queue: super::queue_of(54, Duration::from_secs(75), start),
            lease: true,
            events: BinaryHeap::new(),
            bodies: BTreeMap::new(),
            count: 0,
            table: (1..=SUBMISSIONS).map(|pk| (pk, record.clone())).collect(),
            working: BTreeMap::new(),
            sent: vec![],
            checked: BTreeMap::new(),
            actors: BTreeMap::new(),
            lost: (0, 0),
            cancels: 0,
            deleted: 0,
            edited: 0,
            published: 0,
        };
        for pk in 1..=SUBMISSIONS {
            let actor = world.actor(1);
            world.actors.insert(pk, actor);
            for _ in 0..3 {
                let at = world.random(0.0, PEACE.as_secs_f64());
                world.push(at, Event::Cancel(pk));
            }
        }
        for pk in DELETED {
            let at = world.random(0.0, PEACE.as_secs_f64());
            world.push(at, Event::Delete(pk));
        }
        for pk in FINISHED {
            for _ in 0..3 {
                let at = world.random(0.0, PEACE.as_secs_f64());
                world.push(at, Event::Finish(pk));
            }
        }
        for _ in 0..5 {
            let at = world.random(0.0, PEACE.as_secs_f64());
            world.push(at, Event::Lease(false));
            world.push(at + Duration::from_secs(20), Event::Lease(true));
        }
        world.push(Duration::ZERO, Event::Reconcile);
        world
    }

    fn random(&mut self, from: f64, to: f64) -> Duration {
        Duration::from_secs_f64(from + self.rng.f64() * (to - from))
    }

    fn actor(&mut self, attempt: i64) -> Actor {
        Actor {
            attempt,
            length: self.random(0.0, 400.0),
            ..Actor::default()
        }
    }

    fn push(&mut self, at: Duration, event: Event) {
        self.count += 1;
        self.events.push(Reverse((at, self.count)));
        self.bodies.insert(self.count, event);
    }

    fn now(&mut self) -> Now {
        self.at += Duration::from_nanos(1);
        Now {
            at: self.at,
            wall: submitted_at() + SignedDuration::try_from(self.at).unwrap(),
        }
    }

    fn run(mut self) -> Self {
        while let Some(Reverse((at, id))) = self.events.pop() {
            if at > END {
                break;
            }
            self.at = self.at.max(at);
            let event = self.bodies.remove(&id).unwrap();
            self.happen(event);
            self.send_all();
        }
        self
    }

    fn send_all(&mut self) {
        loop {
            let now = self.now();
            match super::next(&mut self.queue, now, self.lease) {
                Next::Read(..) => unreachable!("it was read"),
                Next::Send(ticket) => {
                    self.check_sent(&ticket);
                    self.push(self.at + WAY, Event::Arrive(ticket));
                }
                Next::Wait(until) => {
                    if let Some(until) = until {
                        assert!(until > self.at, "it waits for the past");
                        self.push(until, Event::Wake);
                    }
                    return;
                }
            }
        }
    }

    /// Checks what must hold for every request.
    fn check_sent(&mut self, ticket: &Ticket) {
        let at = self.at;
        if ticket.request.counts() {
            self.sent.push(at);
            let minute = self.sent.iter().rev().take_while(|sent| **sent + WINDOW > at).count();
            assert!(minute <= MINUTE_LIMIT, "{minute} requests in a minute");
        }
        if !ticket.request.is_write() {
            return;
        }
        let pk = ticket.request.submission().unwrap().pk;
        assert!(self.lease, "a write without the lease");
        assert!(at >= Duration::from_secs(75), "a write right after a takeover");
        let working = self.working.entry(pk).or_default();
        assert_eq!(*working, 0, "two writes for submission {pk} at once: {ticket:?}");
        *working += 1;
        let (_, answered) = self.checked.get(&pk).expect("a write without a read of its own");
        let age = at.saturating_sub(*answered);
        assert!(age <= FRESH, "a write {age:?} after its read: {ticket:?}");
    }

    fn happen(&mut self, event: Event) {
        match event {
            Event::Arrive(ticket) => self.arrive(ticket),
            Event::Save(work) => self.save(&work),
            Event::Answer(ticket, reply) => self.answer(&ticket, reply),
            Event::Reconcile => {
                for pk in 1..=SUBMISSIONS {
                    self.reconcile(pk);
                }
                self.push(self.at + Duration::from_secs(2), Event::Reconcile);
            }
            Event::Cancel(pk) => {
                let record = self.table.get_mut(&pk).unwrap();
                if !matches!(record.status, Status::Finished | Status::Failed | Status::Cancelled) {
                    record.status = Status::Cancelled;
                    record.cancelled_at = Some(self.at);
                    self.cancels += 1;
                }
            }
            Event::Delete(pk) => {
                let record = self.table.get_mut(&pk).unwrap();
                record.deleted = true;
                self.deleted += usize::from(record.status.is_live());
            }
            Event::Finish(pk) => {
                let record = self.table.get_mut(&pk).unwrap();
                if record.status.is_live() {
                    record.status = Status::Finished;
                    self.edited += 1;
                }
            }
            Event::Lease(lease) => self.lease = lease,
            Event::Wake => {}
        }
    }

    /// The server gets a request, works on it, answers; or one of the three goes wrong.
    fn answer(&mut self, ticket: &Ticket, reply: Reply) {
        if let (Request::Get(subject), Reply::Row(Answer::Done(_))) = (&ticket.request, &reply) {
            let made = ticket.requested + WAY;
            self.checked.insert(subject.pk, (made, self.at));
        }
        let now = self.now();
        self.queue.answered(ticket, reply, now);
    }

    /// Acts for a submission as the controller does in each reconcile.
    fn reconcile(&mut self, pk: i64) {
        let actor = self.actors[&pk].clone();
        if actor.settled {
            return;
        }
        let now = self.now();
        let subject = Subject {
            target: Arc::new(target()),
            key: key(pk),
            pk,
            run: Run {
                attempt: Attempt(actor.attempt),
                job: format!("submission-{pk}-{}", actor.attempt),
                by_hand: true,
                has_job: actor.began.is_some(),
                ended: None,
                log: LogSpan::default(),
            },
        };
        self.queue.ask(&subject, false, now);
        let view = self.queue.view(&subject.key).unwrap();
        if let Some(end) = view.end {
            return self.settle(pk, &end);
        }
        if view.answered < Some(Attempt(actor.attempt)) {
            return;
        }
        let Some(began) = actor.began else {
            if view.ended.is_some() && view.overtaken {
                let cancelled = DesiredUpdate::Final(Outcome::Cancelled, results(0));
                self.queue.update(&subject, cancelled, now);
                return;
            }
            if view.ended.is_some() {
                return self.settle(pk, &Ended::Otherwise(Status::Cancelled));
            }
            self.queue.live(&subject, submitted_at());
            self.queue.update(&subject, DesiredUpdate::Queued, now);
            self.actors.get_mut(&pk).unwrap().began = Some(self.at);
            return;
        };
        assert_ne!(view.ended, Some(Status::Finished), "no run is finished by others");
        let age = self.at.saturating_sub(began);
        let update = match (view.ended, age >= actor.length) {
            (Some(_), _) => DesiredUpdate::Final(Outcome::Cancelled, results(0)),
            (None, true) if pk % 3 == 0 => DesiredUpdate::Final(Outcome::Failed, results(0)),
            (None, true) => DesiredUpdate::Final(Outcome::Finished, results(100)),
            (None, false) if age < Duration::from_secs(5) => DesiredUpdate::Running,
            (None, false) => DesiredUpdate::Partial(results(age.as_secs() / 10)),
        };
        self.queue.update(&subject, update, now);
    }

    fn settle(&mut self, pk: i64, end: &Ended) {
        let record = self.table[&pk].clone();
        if let Ended::Published { outcome, .. } = end {
            self.published += 1;
            assert_eq!(
                record.status,
                Status::parse(outcome.as_str()),
                "submission {pk} was published"
            );
            assert!(*outcome != Outcome::Finished || record.rows == 1);
        }
        assert!(
            !record.deleted || !record.status.is_live(),
            "submission {pk} counts as being processed, although it was deleted: {end:?}"
        );
        let now = self.now();
        self.queue.forget(&key(pk), now);
        let again = self.at < PEACE && record.status != Status::Finished && !record.deleted;
        let attempt = self.actors[&pk].attempt + 1;
        let actor = if again {
            self.actor(attempt)
        } else {
            Actor {
                settled: true,
                ..self.actors[&pk].clone()
            }
        };
        self.actors.insert(pk, actor);
    }
}

#[test]
fn a_bad_network_breaks_no_promise() {
    let (mut meanwhile, mut between, mut cancels, mut published, mut attempts) = (0, 0, 0, 0, 0);
    let (mut deleted, mut edited) = (0, 0);
    for seed in 0..20 {
        let world = World::new(seed).run();
        let open: Vec<_> = world.actors.iter().filter(|(_, actor)| !actor.settled).collect();
        assert!(open.is_empty(), "seed {seed}: {open:?}");
        meanwhile += world.lost.0;
        between += world.lost.1;
        cancels += world.cancels;
        deleted += world.deleted;
        edited += world.edited;
        published += world.published;
        attempts += world.actors.values().map(|actor| actor.attempt).sum::<i64>();
    }
    println!(
        "{attempts} attempts, {published} published; of {cancels} cancels {meanwhile} and {between} overwritten; {deleted} deleted; \
         {edited} called finished"
    );
    // The world must be as bad as it is meant to be.
    assert!(published > 500 && attempts > 800 && cancels > 200 && deleted > 15 && edited > 40);
    // What falls into a request, which takes up to a minute here, can't be saved; what falls between a read and its write
    // is rare.
    assert!(between * 50 < cancels && meanwhile * 5 < cancels);
}
