//! Questions of submissions to services outside the cluster. A task asks them, and an answer wakes its submission, so that no
//! reconcile waits for such a service.

use std::collections::HashMap;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use futures::stream::FuturesUnordered;
use futures::{FutureExt, StreamExt};
use kube::runtime::reflector::ObjectRef;
use tokio::sync::Notify;
use tokio::time::Instant;
use tracing::Instrument;

use crate::controller::objects::{Wake, log_span_of, uid, uid_of};
use crate::lock::lock;
use crate::observability::about::LogSpan;
use crate::observability::tasks::Tasks;
use leaderboard_api::{Attempt, Submission};

/// How long an answer is kept that nobody asks for again.
const KEPT: Duration = Duration::from_mins(10);

/// What is asked for one attempt of a submission.
pub trait Question: Clone + PartialEq + Send + 'static {
    /// What is found.
    type Answer: Send + Sync + 'static;
    /// How many are asked at once.
    const AT_ONCE: usize;
    /// How many of them are asked of one service: one that hangs leaves the rest to the others. By default there is no such share.
    const AT_ONCE_OF_A_SERVICE: usize = Self::AT_ONCE;
    /// How long an answer is good: after that the same question is asked again.
    const GOOD_FOR: Duration;
    /// Another attempt asks anew.
    fn attempt(&self) -> Attempt;
    /// Whether one service is asked both, so that it holds up both if it hangs.
    fn shares_a_service(&self, _other: &Self) -> bool {
        true
    }
}

/// What is known for a submission's present attempt.
#[derive(Clone, Debug, PartialEq)]
pub enum Observed<A> {
    NotAsked,
    /// It was asked this long ago.
    Asked(Duration),
    Answered(Arc<A>),
}

struct Entry<Q: Question> {
    question: Q,
    by: ObjectRef<Submission>,
    /// For the log.
    log: LogSpan,
    asked: Instant,
    is_due: bool,
    is_under_way: bool,
    answer: Option<Arc<Q::Answer>>,
}

/// What the reconciles and the task share.
pub(super) struct Shared<Q: Question> {
    /// By the UID of the submission.
    entries: Mutex<HashMap<String, Entry<Q>>>,
    /// What is being asked, also for a submission that asks for something else by now, or is gone. Locked after the entries.
    under_way: Mutex<Vec<Q>>,
    notify: Notify,
}

/// The questions and their answers.
#[derive(Clone)]
pub struct Questions<Q: Question>(Arc<Shared<Q>>);

impl<Q: Question> Questions<Q> {
    /// Starts the task. `ask` gets a question and the namespace of its submission.
    pub(super) fn answered_by<F>(
        ask: impl Fn(Q, String) -> F + Send + 'static,
        name: &'static str,
        tasks: &Tasks,
        wake: Wake<Submission>,
    ) -> Self
    where
        F: Future<Output = Q::Answer> + Send + 'static,
    {
        let shared = Arc::new(Shared::default());
        tasks.until_stop(name, ask_all(ask, Arc::clone(&shared), wake));
        Self(shared)
    }

    /// Asks, unless there is a good answer or the question is under way.
    pub fn want(&self, submission: &Submission, question: Q) {
        let (uid, by) = (uid_of(submission), ObjectRef::from_obj(submission));
        self.0.want(uid, by, question, log_span_of(submission));
    }

    /// What is known for the submission's present attempt.
    pub fn observe(&self, submission: &Submission) -> Observed<Q::Answer> {
        let attempt = submission.status.as_ref().and_then(|status| status.attempt);
        self.0.observe(uid(submission), attempt.unwrap_or_default())
    }

    /// Drops what is known for an object that is gone.
    pub fn forget(&self, uid: &str) {
        lock(&self.0.entries).remove(uid);
    }
}

impl<Q: Question> Default for Shared<Q> {
    fn default() -> Self {
        Self {
            entries: Mutex::default(),
            under_way: Mutex::default(),
            notify: Notify::default(),
        }
    }
}

impl<Q: Question> Shared<Q> {
    pub(super) fn want(&self, uid: String, by: ObjectRef<Submission>, question: Q, log: LogSpan) {
        let now = Instant::now();
        let age = |entry: &Entry<Q>| now.saturating_duration_since(entry.asked);
        let mut entries = lock(&self.entries);
        entries.retain(|_, entry| entry.answer.is_none() || age(entry) < KEPT);
        if let Some(entry) = entries.get_mut(&uid).filter(|entry| entry.question == question) {
            // The old answer stays until there is another one: what is shown does not flap.
            if entry.is_due || entry.is_under_way || age(entry) < Q::GOOD_FOR {
                return;
            }
            (entry.is_due, entry.asked) = (true, now);
        } else {
            let entry = Entry {
                question,
                by,
                log,
                asked: now,
                is_due: true,
                is_under_way: false,
                answer: None,
            };
            entries.insert(uid, entry);
        }
        self.notify.notify_one();
    }

    pub(super) fn observe(&self, uid: &str, attempt: Attempt) -> Observed<Q::Answer> {
        let entries = lock(&self.entries);
        let Some(entry) = entries.get(uid).filter(|entry| entry.question.attempt() == attempt) else {
            return Observed::NotAsked;
        };
        match &entry.answer {
            Some(answer) => Observed::Answered(Arc::clone(answer)),
            None => Observed::Asked(entry.asked.elapsed()),
        }
    }

    /// The question that has waited longest of those whose services have not their share yet, with the UID and the namespace of its
    /// submission.
    pub(super) fn next(&self) -> Option<(String, Q, String)> {
        let mut entries = lock(&self.entries);
        let mut under_way = lock(&self.under_way);
        let mut oldest: Option<(&String, &mut Entry<Q>)> = None;
        for (uid, entry) in &mut *entries {
            let is_due = entry.is_due && !entry.is_under_way;
            let is_older = oldest.as_ref().is_none_or(|(_, oldest)| entry.asked < oldest.asked);
            // Thousands may be due: services are compared last, and only for one that would be begun.
            if is_due && is_older && has_room(&under_way, &entry.question) {
                oldest = Some((uid, entry));
            }
        }
        let (uid, entry) = oldest?;
        (entry.is_due, entry.is_under_way) = (false, true);
        under_way.push(entry.question.clone());
        let namespace = entry.by.namespace.clone().unwrap_or_default();
        Some((uid.clone(), entry.question.clone(), namespace))
    }

    /// What the lines about a question are written in.
    fn log_of(&self, uid: &str) -> LogSpan {
        lock(&self.entries)
            .get(uid)
            .map(|entry| entry.log.clone())
            .unwrap_or_default()
    }

    /// Takes an answer in. Returns whom it is for.
    pub(super) fn done(&self, uid: &str, question: &Q, answer: Q::Answer) -> Option<ObjectRef<Submission>> {
        let mut entries = lock(&self.entries);
        let mut under_way = lock(&self.under_way);
        if let Some(index) = under_way.iter().position(|asked| asked == question) {
            under_way.swap_remove(index);
        }
        let entry = entries.get_mut(uid).filter(|entry| entry.question == *question)?;
        entry.is_under_way = false;
        entry.answer = Some(Arc::new(answer));
        Some(entry.by.clone())
    }
}

/// Whether the services of a question have not their share of what is under way.
fn has_room<Q: Question>(under_way: &[Q], question: &Q) -> bool {
    let same = under_way.iter().filter(|other| question.shares_a_service(other));
    same.count() < Q::AT_ONCE_OF_A_SERVICE
}

async fn ask_all<Q: Question, F>(ask: impl Fn(Q, String) -> F, shared: Arc<Shared<Q>>, wake: Wake<Submission>)
where
    F: Future<Output = Q::Answer> + Send + 'static,
{
    let mut under_way = FuturesUnordered::new();
    loop {
        while under_way.len() < Q::AT_ONCE
            && let Some((uid, question, namespace)) = shared.next()
        {
            let answer = ask(question.clone(), namespace).instrument(shared.log_of(&uid).span());
            under_way.push(answer.map(move |answer| (uid, question, answer)));
        }
        tokio::select! {
            Some((uid, question, answer)) = under_way.next() => {
                shared.done(&uid, &question, answer).into_iter().for_each(&wake);
            }
            () = shared.notify.notified() => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Clone, Debug, PartialEq)]
    struct Asked {
        attempt: Attempt,
        what: &'static str,
    }

    impl Question for Asked {
        type Answer = &'static str;
        const AT_ONCE: usize = 4;
        const GOOD_FOR: Duration = Duration::MAX;

        fn attempt(&self) -> Attempt {
            self.attempt
        }
    }

    fn question(attempt: i64, what: &'static str) -> Asked {
        let attempt = Attempt(attempt);
        Asked { attempt, what }
    }

    fn by(name: &str) -> ObjectRef<Submission> {
        ObjectRef::new(name).within("one")
    }

    #[tokio::test(start_paused = true)]
    async fn a_question_is_asked_once_and_its_answer_stays_for_its_attempt() {
        let shared = Shared::default();
        let first = question(1, "one");
        shared.want("u".into(), by("s"), first.clone(), LogSpan::default());
        assert_eq!(shared.next(), Some(("u".into(), first.clone(), "one".into())));
        shared.want("u".into(), by("s"), first.clone(), LogSpan::default());
        assert_eq!(shared.next(), None, "it is under way");
        tokio::time::advance(Duration::from_secs(3)).await;
        assert_eq!(shared.observe("u", Attempt(1)), Observed::Asked(Duration::from_secs(3)));
        assert_eq!(shared.done("u", &first, "none"), Some(by("s")));
        assert_eq!(shared.observe("u", Attempt(1)), Observed::Answered(Arc::new("none")));
        assert_eq!(shared.observe("u", Attempt(2)), Observed::NotAsked);
        shared.want("u".into(), by("s"), question(2, "one"), LogSpan::default());
        assert_eq!(shared.next().unwrap().1.attempt, Attempt(2));
    }

    #[tokio::test(start_paused = true)]
    async fn the_answer_to_an_older_question_is_nobodys() {
        let shared = Shared::default();
        let (old, new) = (question(1, "one"), question(1, "other"));
        shared.want("u".into(), by("s"), old.clone(), LogSpan::default());
        shared.next();
        shared.want("u".into(), by("s"), new.clone(), LogSpan::default());
        assert_eq!(shared.done("u", &old, "none"), None);
        assert_eq!(shared.observe("u", Attempt(1)), Observed::Asked(Duration::ZERO));
        assert_eq!(shared.next().unwrap().1, new);
    }

    #[tokio::test(start_paused = true)]
    async fn who_asked_first_is_served_first_and_old_answers_go() {
        let shared = Shared::default();
        for uid in ["a", "b"] {
            shared.want(uid.into(), by(uid), question(1, "one"), LogSpan::default());
            tokio::time::advance(Duration::from_secs(1)).await;
        }
        let (uid, question_of_a, _) = shared.next().unwrap();
        assert_eq!(uid, "a");
        shared.done(&uid, &question_of_a, "none");
        tokio::time::advance(KEPT).await;
        shared.want("c".into(), by("c"), question(1, "one"), LogSpan::default());
        assert_eq!(shared.observe("a", Attempt(1)), Observed::NotAsked);
        assert!(
            matches!(shared.observe("b", Attempt(1)), Observed::Asked(_)),
            "it still waits"
        );
    }
}
