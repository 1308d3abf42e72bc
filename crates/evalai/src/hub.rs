//! The controller's way to EvalAI: desired updates in, what is known out, nothing waits.
//!
//! Called by the controller's reconciles. Hands each update to the queue of its server, namespace and token, and starts a task for
//! each, which ends when nothing uses the token any more. A submission is where its Leaderboard is: with another token of that, both go to
//! another queue, as they are. Knows no policy.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, Weak};

use jiff::{SignedDuration, Timestamp};
use tokio::sync::{Semaphore, watch};
use tokio::task::JoinHandle;
use tokio::time::Instant;

use super::client::Client;
use super::files::{InputAddress, InputError, InputStream};
use super::labels::Labels;
use super::options::Options;
use super::queue::{Now, PAYLOADS, Purse, Queue};
use super::request::{Reply, Request};
use super::task::{Shared, Task, now, run};
use super::transport::ClientError;
use super::types::{DesiredUpdate, InboxTrouble, Key, Load, Publisher, Subject, SubmissionState, Target, Usage};
use leaderboard_base::clock::Clock;
use leaderboard_base::lock::lock;

/// See the module's text. Clones are the same hub.
#[derive(Clone)]
pub struct Hub(Arc<Inner>);

struct Inner {
    options: Arc<Options>,
    /// All queues count time from here, so that a moment means the same in each.
    start: Instant,
    /// `not_before` as wall-clock time.
    writes_from: Timestamp,
    /// Places of payloads in memory.
    places: Arc<Semaphore>,
    closing: watch::Sender<bool>,
    state: Mutex<State>,
}

#[derive(Default)]
struct State {
    tokens: BTreeMap<Account, Entry>,
    /// Which queue an object is in.
    places: BTreeMap<Key, Account>,
    purses: BTreeMap<Payer, Weak<Purse>>,
}

/// One holder of a token in a namespace.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Holder<T> {
    server: String,
    namespace: String,
    name: T,
}

/// Names one queue. The token is named by its digest: the user that it claims could be anybody's.
type Account = Holder<[u8; 32]>;
/// Names a budget. A claimed user counts within a namespace alone, so that no namespace slows another.
type Payer = Holder<String>;

struct Entry {
    shared: Arc<Shared>,
    /// So many objects are in its queue.
    users: usize,
    /// None once its end is waited for.
    task: Option<JoinHandle<Option<bool>>>,
}

impl<T> Holder<T> {
    fn of(target: &Target, name: T) -> Self {
        Self {
            server: target.api_server.trim_end_matches('/').to_owned(),
            namespace: target.leaderboard.namespace.clone(),
            name,
        }
    }
}

impl State {
    /// The account of an object: that of its Leaderboard, which alone may change its token.
    fn account_of(&self, key: &Key, target: &Target) -> Account {
        let of_leaderboard = self
            .places
            .get(&target.leaderboard)
            .filter(|_| *key != target.leaderboard);
        let own = || Account::of(target, target.token.digest());
        of_leaderboard.cloned().unwrap_or_else(own)
    }

    /// Puts an object into the queue of an account. Returns the one that it was in before, if that is another one.
    fn enter(&mut self, key: &Key, account: &Account) -> Option<Arc<Shared>> {
        let before = self.places.insert(key.clone(), account.clone());
        if before.as_ref() == Some(account) {
            return None;
        }
        self.count(account, 1);
        self.count(&before?, -1)
    }

    /// The purse of a user, made if there is none.
    fn purse_of(&mut self, target: &Target, now: Now) -> Arc<Purse> {
        self.purses.retain(|_, purse| purse.strong_count() > 0);
        let payer = Payer::of(target, target.token.claimed_user());
        let known = self.purses.get(&payer).and_then(Weak::upgrade);
        let purse = known.unwrap_or_else(|| Purse::new(target.requests_per_minute, now.at));
        self.purses.insert(payer, Arc::downgrade(&purse));
        purse
    }

    fn leave(&mut self, key: &Key) -> Option<Arc<Shared>> {
        let account = self.places.remove(key)?;
        self.count(&account, -1)
    }

    fn count(&mut self, account: &Account, by: isize) -> Option<Arc<Shared>> {
        let entry = self.tokens.get_mut(account)?;
        entry.users = entry.users.saturating_add_signed(by);
        Some(entry.shared.clone())
    }

    /// Removes an account that no object uses. False if one does.
    fn remove_unused(&mut self, account: &Account) -> bool {
        let is_unused = self.tokens.get(account).is_none_or(|entry| entry.users == 0);
        if is_unused {
            self.tokens.remove(account);
        }
        is_unused
    }
}

impl Inner {
    fn state(&self) -> MutexGuard<'_, State> {
        lock(&self.state)
    }

    fn now(&self) -> Now {
        now(&self.options.clock, self.start)
    }
}

impl Hub {
    /// A hub without any task yet.
    pub fn new(options: Options) -> Self {
        Self(Arc::new(Inner {
            writes_from: wall(&options.clock, options.not_before),
            options: Arc::new(options),
            start: Instant::now(),
            places: Arc::new(Semaphore::new(PAYLOADS)),
            closing: watch::Sender::new(false),
            state: Mutex::default(),
        }))
    }

    /// From when on EvalAI is written to, while it is not yet: the process before has not confirmed its last requests. Then
    /// every Leaderboard that is served and every submission with something to write is woken.
    pub fn writes_from(&self) -> Option<Timestamp> {
        let inner = &self.0;
        (Instant::now() < inner.options.not_before).then_some(inner.writes_from)
    }

    /// A Leaderboard serves its challenge: it is swept and checked. Called again, it and its submissions go on with the token of now.
    pub fn serve(&self, leaderboard: &Key, target: &Target) -> Result<(), ClientError> {
        self.with(leaderboard, target, |queue, now| queue.serve(leaderboard, target, now))
    }

    /// A Leaderboard is gone.
    pub fn retire(&self, leaderboard: &Key) {
        self.leave(leaderboard, |queue, now| queue.retire(leaderboard, now));
    }

    /// Asks whether an attempt may run; with `image`, also which image it is. The answer is in the state:
    /// `answered` reaches the attempt, `ended` shows whether it may run.
    pub fn ask(&self, subject: &Subject, image: bool) -> Result<(), ClientError> {
        self.with_subject(subject, |queue, now| queue.ask(subject, image, now))
    }

    /// From now on, until its end or [`Hub::forget`], a cancellation of this attempt is checked for each period.
    /// `submitted_at` is EvalAI's own time of the submission.
    pub fn live(&self, subject: &Subject, submitted_at: Timestamp) -> Result<(), ClientError> {
        self.with_subject(subject, |queue, _| queue.live(subject, submitted_at))
    }

    /// Requests an update of EvalAI. May be called in each reconcile: what is already done or requested changes nothing.
    pub fn update(&self, publisher: &Publisher, update: DesiredUpdate) -> Result<(), ClientError> {
        let subject = publisher.subject();
        self.with_subject(subject, |queue, now| queue.update(subject, update, now))
    }

    /// The object is gone, or needs no further update. What is on its way is still waited for. A Leaderboard may have gone without
    /// [`Hub::retire`]: somebody took its finalizer away.
    pub fn forget(&self, key: &Key) {
        self.leave(key, |queue, now| {
            queue.retire(key, now);
            queue.forget(key, now);
        });
    }

    /// State of a submission, as far as it is known.
    pub fn view(&self, key: &Key) -> Option<SubmissionState> {
        self.place(key)?.queue().view(key)
    }

    /// Where the uploaded file of a submission is, as its row was last read; none while that is not known, or outdated.
    pub fn input_address(&self, key: &Key) -> Option<InputAddress> {
        let row = self.place(key)?.queue().present_row(key)?;
        let (key, url) = (key.clone(), row.input_file.clone());
        Some(InputAddress { key, url })
    }

    /// Opens an uploaded file, without any token. The row is read again if the address gives none out: it may have expired.
    pub async fn open_input(&self, address: &InputAddress) -> Result<InputStream, InputError> {
        let not_served = || InputError::Silent("EvalAI is not asked about the submission now".to_owned());
        let shared = self.place(&address.key).ok_or_else(not_served)?;
        let opened = match &address.url {
            Some(url) => shared.client.files.open(url).await,
            None => Err(InputError::NoFile),
        };
        if matches!(opened, Err(InputError::Gone(_) | InputError::NoFile)) {
            shared.queue().outdate(&address.key);
            shared.notify.notify_one();
        }
        opened
    }

    /// How a Leaderboard fits its challenge, checked at its start and hourly, and why there is no newer check.
    pub fn labels(&self, leaderboard: &Key) -> (Option<Labels>, Option<String>) {
        self.place(leaderboard)
            .map_or((None, None), |shared| shared.queue().labels(leaderboard))
    }

    /// True if partial results are on the leaderboards of a phase; false as long as that is not known.
    pub fn shows_partial(&self, leaderboard: &Key, phase: i64) -> bool {
        self.place(leaderboard)
            .is_some_and(|shared| shared.queue().shows_partial(leaderboard, phase))
    }

    /// When the list was asked for that shows a submission as cancelled which has its end here; none if the last one does not.
    pub fn cancelled_as_of(&self, leaderboard: &Key, pk: i64) -> Option<Timestamp> {
        self.place(leaderboard)?.queue().cancelled_as_of(leaderboard, pk)
    }

    /// How the requests of a Leaderboard's token are used.
    pub fn usage(&self, leaderboard: &Key) -> Option<Usage> {
        let shared = self.place(leaderboard)?;
        let usage = shared.queue().usage(shared.now());
        Some(usage)
    }

    /// Over all tokens.
    pub fn load(&self) -> Load {
        let state = self.state();
        let queues: Vec<_> = state.tokens.values().map(|entry| entry.shared.clone()).collect();
        let purses: Vec<_> = state.purses.values().filter_map(Weak::upgrade).collect();
        drop(state);
        let now = self.0.now().at;
        let uses = purses.iter().map(|purse| purse.use_at(now));
        let (used, limit) = uses.fold((0, 0), |(used, limit), (one, of)| {
            (used + one as usize, limit + of as usize)
        });
        Load {
            used,
            limit,
            waiting: queues.iter().map(|shared| shared.queue().waiting()).sum(),
        }
    }

    /// Why EvalAI refuses a Leaderboard's token, at all or for the challenge; none while it does not.
    pub fn token_refused(&self, leaderboard: &Key) -> Option<String> {
        let shared = self.place(leaderboard)?;
        let queue = shared.queue();
        let refused = queue.token_refused().or_else(|| queue.challenge_refused(leaderboard));
        refused.map(str::to_owned)
    }

    /// Since when EvalAI has answered no request with a Leaderboard's token, and why; none if that is not long.
    pub fn silence(&self, leaderboard: &Key) -> Option<(Timestamp, String)> {
        let shared = self.place(leaderboard)?;
        let queue = shared.queue();
        queue.silence().map(|(since, why)| (since, why.to_owned()))
    }

    /// Makes a request about the queue of a Leaderboard's challenge, within a third of its token's; none if that is not served any more.
    pub async fn pass(&self, leaderboard: &Key, request: Request) -> Option<Reply> {
        let answer = self.place(leaderboard)?.pass(request);
        answer.await.ok()
    }

    /// Why the queue of a Leaderboard's challenge is not read; none while it is, or need not be.
    pub fn inbox_trouble(&self, leaderboard: &Key) -> Option<InboxTrouble> {
        let shared = self.place(leaderboard)?;
        shared.queue().inbox_trouble(leaderboard, shared.now())
    }

    /// Takes nothing new and waits for what is on its way, at most 70 s. True if every write is answered, so that the next
    /// leader may write at once.
    pub async fn drain(&self) -> bool {
        self.0.closing.send_replace(true);
        let tasks: Vec<_> = self
            .state()
            .tokens
            .values_mut()
            .filter_map(|entry| entry.task.take())
            .collect();
        let mut drained = true;
        for task in tasks {
            // A task that has panicked may have left a write without its answer.
            drained &= matches!(task.await, Ok(Some(true)));
        }
        drained
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.0.state()
    }

    /// Takes an object out of its queue, whose task may then end.
    fn leave(&self, key: &Key, act: impl FnOnce(&mut Queue, Now)) {
        let left = self.state().leave(key);
        if let Some(shared) = left {
            act(&mut shared.queue(), shared.now());
            shared.notify.notify_one();
        }
    }

    fn place(&self, key: &Key) -> Option<Arc<Shared>> {
        let state = self.state();
        let account = state.places.get(key)?;
        state.tokens.get(account).map(|entry| entry.shared.clone())
    }

    fn with_subject(&self, subject: &Subject, act: impl FnOnce(&mut Queue, Now) -> bool) -> Result<(), ClientError> {
        self.with(&subject.key, &subject.target, act)
    }

    /// Does something with the queue that an object belongs to, and wakes its task.
    fn with(&self, key: &Key, target: &Target, act: impl FnOnce(&mut Queue, Now) -> bool) -> Result<(), ClientError> {
        if *self.0.closing.borrow() {
            return Ok(());
        }
        let shared = self.shared(key, target)?;
        let news = act(&mut shared.queue(), shared.now());
        if news {
            shared.publish();
            shared.notify.notify_one();
        }
        Ok(())
    }

    fn shared(&self, key: &Key, target: &Target) -> Result<Arc<Shared>, ClientError> {
        let mut state = self.state();
        let account = state.account_of(key, target);
        let known = state.tokens.get(&account).map(|entry| entry.shared.clone());
        let shared = if let Some(shared) = known {
            shared
        } else {
            let entry = self.start(&mut state, target, &account)?;
            let shared = entry.shared.clone();
            state.tokens.insert(account.clone(), entry);
            shared
        };
        if let Some(old) = state.enter(key, &account) {
            self.move_over(&mut state, key, &old, (&account, &shared));
        }
        Ok(shared)
    }

    /// An object whose token is another one now: all that waits goes on with that, and what is on its way is waited out.
    fn move_over(&self, state: &mut State, key: &Key, old: &Shared, (account, new): (&Account, &Shared)) {
        let (now, options) = (self.0.now(), &self.0.options);
        let settled = now.at + options.timing.hold + options.timeouts.write;
        let leaving = old.queue().part_with(key, settled, now);
        for submission in leaving.submissions().filter(|submission| *submission != key) {
            state.enter(submission, account);
        }
        new.queue().take_over(leaving);
        new.notify.notify_one();
        old.notify.notify_one();
    }

    fn start(&self, state: &mut State, target: &Target, account: &Account) -> Result<Entry, ClientError> {
        let inner = &self.0;
        let options = &inner.options;
        let transport = (options.connect)(&target.api_server, options.timeouts)?;
        let (token, meter) = (target.token.clone(), options.meter.clone());
        let client = Client::new(transport, &target.api_server, token, options.timeouts, meter);
        let (timing, now) = (options.timing, inner.now());
        let not_before = options.not_before.saturating_duration_since(inner.start);
        let share = state.purse_of(target, now).share(target.requests_per_minute, now.at);
        let queue = Queue::new(timing, share, not_before, now);
        let shared = Arc::new(Shared::new(queue, client, options.clone(), inner.start));
        let (weak, account) = (Arc::downgrade(inner), account.clone());
        let work = run(Task {
            shared: shared.clone(),
            places: inner.places.clone(),
            closing: inner.closing.subscribe(),
            is_unused: Box::new(move || weak.upgrade().is_none_or(|hub| hub.state().remove_unused(&account))),
        });
        let name = format!("EvalAI requests of {}", target.token.label());
        // It ends when its token is no longer used.
        let task = options.tasks.may_end(name, work);
        Ok(Entry {
            shared,
            users: 0,
            task: Some(task),
        })
    }
}

/// A moment as wall-clock time, if it is still to come.
fn wall(clock: &Clock, at: Instant) -> Timestamp {
    let now = clock.now();
    let wait = SignedDuration::try_from(at.saturating_duration_since(Instant::now())).unwrap_or_default();
    now.checked_add(wait).unwrap_or(now)
}

#[cfg(test)]
mod tests;
