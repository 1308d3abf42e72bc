//! Which questions are due, and what came of them. Pure: no clock but the times given.

use std::collections::{BTreeSet, HashMap};
use std::sync::Arc;
use std::time::Duration;

use tokio::time::Instant;

use super::Asked;
use leaderboard_base::object_key::ObjectKey;
use leaderboard_base::spans::LogSpan;
use leaderboard_policy::ask::{Answered, Ask, Failure, Lookup, Rank, Service, Silence};

/// Time after which a question that no caller repeats is asked no more: longer than any object goes without a reconcile.
pub(crate) const KEPT: Duration = Duration::from_mins(15);

type Uid = Arc<str>;

/// All objects of one kind of question.
pub(crate) struct State<Q: Ask> {
    entries: HashMap<Uid, Entry<Q>>,
    /// When each question becomes due. A place that its entry has left is passed over.
    due: BTreeSet<(Instant, Uid)>,
    services: HashMap<Service, Line>,
}

/// The reads of one service.
#[derive(Default)]
struct Line {
    under_way: usize,
    /// Questions that are due, by rank and time. A place that its entry has left is passed over.
    ready: BTreeSet<(Rank, Instant, Uid)>,
    /// When the next read may begin.
    next: Option<Instant>,
}

struct Entry<Q: Ask> {
    about: ObjectKey,
    question: Q,
    service: Service,
    log: LogSpan,
    /// Since when the present question has waited for an answer; None: it has one.
    waits_since: Option<Instant>,
    /// When a caller last asked; None: the object is forgotten, and a read of it is still under way.
    wanted: Option<Instant>,
    /// When the question is to be sent; None: it is under way, or answered for good.
    due: Option<Instant>,
    is_under_way: bool,
    /// The read under way was asked for before the object was forgotten.
    is_dropped: bool,
    failures: u32,
    last: Option<Last<Q>>,
    /// Since when the service has not answered, and the answer before that.
    silence: Option<(Instant, Option<Last<Q>>)>,
}

struct Last<Q: Ask> {
    question: Q,
    sent: Instant,
    result: Arc<Result<Q::Answer, Failure>>,
}

/// One read to be made.
pub(crate) struct Work<Q: Ask> {
    pub asked: Asked<Q>,
    pub service: Service,
    pub log: LogSpan,
    sent: Instant,
}

impl<Q: Ask> Default for State<Q> {
    fn default() -> Self {
        Self {
            entries: HashMap::new(),
            due: BTreeSet::new(),
            services: HashMap::new(),
        }
    }
}

impl<Q: Ask> State<Q> {
    /// Notes a question. Returns whether something is due that was not.
    pub fn want(&mut self, about: &ObjectKey, question: Q, log: LogSpan, now: Instant) -> bool {
        let uid: Uid = about.uid.as_str().into();
        let service = question.service();
        let entry = self.entries.entry(Arc::clone(&uid)).or_insert_with(|| Entry {
            about: about.clone(),
            question: question.clone(),
            service: service.clone(),
            log: log.clone(),
            waits_since: None,
            wanted: None,
            due: None,
            is_under_way: false,
            is_dropped: false,
            failures: 0,
            last: None,
            silence: None,
        });
        if entry.wanted.is_some() && entry.question == question {
            entry.wanted = Some(now);
            return false;
        }
        let last = entry.last.as_ref();
        if last.is_some_and(|last| question.outdates(&last.question)) {
            (entry.last, entry.silence) = (None, None);
        }
        // A newer question keeps the place in line of the one that it replaces.
        let kept = entry.due.filter(|due| *due < now && entry.service == service);
        let place = kept.unwrap_or(now);
        (entry.question, entry.service, entry.log, entry.failures) = (question, service, log, 0);
        (entry.waits_since, entry.wanted, entry.due) = (Some(now), Some(now), Some(place));
        self.due.insert((place, uid));
        true
    }

    pub fn get(&self, uid: &str, now: Instant) -> Lookup<Q> {
        let Some(entry) = self.entries.get(uid).filter(|entry| entry.wanted.is_some()) else {
            return Lookup::default();
        };
        Lookup {
            asked: Some(entry.question.clone()),
            waited: entry.waits_since.map(|since| now.saturating_duration_since(since)),
            last: entry.last.as_ref().map(|last| last.shown(now)),
            silence: entry.silence.as_ref().map(|(since, before)| Silence {
                lasts: now.saturating_duration_since(*since),
                before: before.as_ref().map(|last| last.shown(now)),
            }),
        }
    }

    /// The number of questions to a service that have waited for an answer for longer than this.
    pub fn waiting(&self, service: &Service, time: Duration, now: Instant) -> usize {
        let waits = |entry: &&Entry<Q>| {
            let since = entry.waits_since.filter(|_| entry.service == *service);
            since.is_some_and(|since| since + time < now)
        };
        self.entries.values().filter(waits).count()
    }

    /// Drops the question and its answer. An entry with a read under way stays until that ends, so that none overtakes it.
    pub fn forget(&mut self, uid: &str) {
        let Some(entry) = self.entries.get_mut(uid) else { return };
        if !entry.is_under_way {
            self.entries.remove(uid);
            return;
        }
        (entry.is_dropped, entry.wanted, entry.due, entry.waits_since) = (true, None, None, None);
        (entry.last, entry.silence) = (None, None);
    }

    /// The next read: of the services that have room, the question with the first rank, and then the one that has been due longest.
    pub fn next(&mut self, now: Instant) -> Option<Work<Q>> {
        self.line_up(now);
        while self.services.values().map(|line| line.under_way).sum::<usize>() < Q::AT_ONCE {
            let lines = self.services.values_mut().filter(|line| line.has_room::<Q>(now));
            let line = lines.min_by(|one, other| one.ready.first().cmp(&other.ready.first()))?;
            let (_, at, uid) = line.ready.pop_first()?;
            if let Some(work) = self.begin(&uid, at, now) {
                return Some(work);
            }
        }
        None
    }

    /// Gives each question that is due its place at its service.
    fn line_up(&mut self, now: Instant) {
        while let Some((at, uid)) = self.due.pop_first() {
            if at > now {
                self.due.insert((at, uid));
                return;
            }
            if let Some(entry) = self.entries.get(&uid).filter(|entry| entry.is_due(at)) {
                let line = self.services.entry(entry.service.clone()).or_default();
                line.ready.insert((entry.question.rank(), at, uid));
            }
        }
    }

    /// None: the question is another one now, or no caller has repeated it.
    fn begin(&mut self, uid: &str, at: Instant, now: Instant) -> Option<Work<Q>> {
        let entry = self.entries.get_mut(uid).filter(|entry| entry.is_due(at))?;
        if entry
            .wanted
            .is_none_or(|wanted| now.saturating_duration_since(wanted) >= KEPT)
        {
            self.entries.remove(uid);
            return None;
        }
        let line = self.services.entry(entry.service.clone()).or_default();
        line.under_way += 1;
        line.next = Some(now + Q::SPACING);
        (entry.due, entry.is_under_way) = (None, true);
        let waits_since = entry.waits_since.unwrap_or(now);
        Some(Work {
            asked: Asked {
                about: entry.about.clone(),
                question: entry.question.clone(),
                waited: now.saturating_duration_since(waits_since),
                last: entry.answer().map(|last| last.shown(now)),
            },
            service: entry.service.clone(),
            log: entry.log.clone(),
            sent: now,
        })
    }

    /// When a question becomes due, or a service may be asked again. An answer frees a place as well.
    pub fn next_due(&self, now: Instant) -> Option<Instant> {
        let lines = self.services.values().filter(|line| !line.ready.is_empty());
        let paced = lines.filter_map(|line| line.next.filter(|at| *at > now));
        let due = self.due.first().map(|(at, _)| *at);
        paced.chain(due).min()
    }

    /// Takes an answer in. Returns whether it is news for its object.
    pub fn done(&mut self, work: &Work<Q>, result: Result<Q::Answer, Failure>, now: Instant) -> bool {
        if let Some(line) = self.services.get_mut(&work.service) {
            line.under_way -= 1;
        }
        self.services
            .retain(|_, line| line.under_way > 0 || !line.ready.is_empty() || line.next.is_some_and(|at| at > now));
        let uid = work.asked.about.uid.as_str();
        let Some(entry) = self.entries.get_mut(uid) else {
            return false;
        };
        entry.is_under_way = false;
        let is_news = !std::mem::take(&mut entry.is_dropped) && entry.take(work, result, now);
        let due = entry.due;
        if entry.wanted.is_none() {
            self.entries.remove(uid);
        } else if let Some(at) = due {
            self.due.insert((at, uid.into()));
        }
        is_news
    }
}

impl Line {
    fn has_room<Q: Ask>(&self, now: Instant) -> bool {
        self.under_way < Q::AT_ONCE_OF_A_SERVICE && self.next.is_none_or(|at| at <= now) && !self.ready.is_empty()
    }
}

impl<Q: Ask> Entry<Q> {
    /// True if it stands in a line since this moment. While a read is under way it stands in none.
    fn is_due(&self, at: Instant) -> bool {
        self.due == Some(at) && !self.is_under_way
    }

    /// The last answer, also when the service is silent since.
    fn answer(&self) -> Option<&Last<Q>> {
        match &self.silence {
            Some((_, before)) => before.as_ref(),
            None => self.last.as_ref(),
        }
    }

    fn take(&mut self, work: &Work<Q>, result: Result<Q::Answer, Failure>, now: Instant) -> bool {
        let question = &work.asked.question;
        if self.question.outdates(question) {
            return false;
        }
        let is_silence = result.as_ref().is_err_and(|failure| !failure.is_refused);
        // One that is due has come while this read was under way: this answer is none to it.
        if self.due.is_none() {
            self.failures = if result.is_ok() {
                0
            } else {
                self.failures.saturating_add(1)
            };
            let waited = self.waits_since.map_or(Duration::ZERO, |since| now - since);
            let again = self.question.again(&result, self.failures, waited);
            self.due = again.map(|pause| now + pause);
            self.waits_since.take_if(|_| !is_silence);
        }
        let is_known = self
            .last
            .as_ref()
            .is_some_and(|last| last.question == *question && is_same::<Q>(&last.result, &result));
        let last = self.last.replace(Last {
            question: question.clone(),
            sent: work.sent,
            result: Arc::new(result),
        });
        self.silence = match self.silence.take() {
            Some(silence) if is_silence => Some(silence),
            _ => is_silence.then_some((now, last)),
        };
        !is_known
    }
}

/// The words of a failure may differ each time.
fn is_same<Q: Ask>(one: &Result<Q::Answer, Failure>, other: &Result<Q::Answer, Failure>) -> bool {
    match (one, other) {
        (Ok(one), Ok(other)) => one == other,
        (Err(one), Err(other)) => one.is_refused == other.is_refused,
        (Ok(_), Err(_)) | (Err(_), Ok(_)) => false,
    }
}

impl<Q: Ask> Last<Q> {
    fn shown(&self, now: Instant) -> Answered<Q> {
        Answered {
            question: self.question.clone(),
            sent_ago: now.saturating_duration_since(self.sent),
            result: Arc::clone(&self.result),
        }
    }
}
