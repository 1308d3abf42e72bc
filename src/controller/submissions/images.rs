//! What registries tell of submitted images. A task of its own asks, one question for each attempt before its first Job, and an answer
//! wakes its submission. No reconcile waits for a registry.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use futures::stream::FuturesUnordered;
use futures::{FutureExt, StreamExt};
use k8s_openapi::api::core::v1::Secret;
use kube::runtime::reflector::ObjectRef;
use kube::{Api, Client};
use tokio::sync::Notify;
use tokio::time::Instant;

use super::view::ObservedImage;
use crate::controller::objects::{Wake, uid_of};
use crate::kubernetes::CALL_TIMEOUT;
use crate::observability::tasks::Tasks;
use crate::services::aws::Aws;
use crate::services::registry::{Credentials, Facts, Fault, Image, Registries};
use leaderboard_api::Submission;

/// How many registries are asked at once. Each answer is at most a few MiB.
const AT_ONCE: usize = 4;
/// How long an answer is kept that nobody has taken: it is in the status long before.
const KEPT: Duration = Duration::from_mins(10);

/// What is asked of a registry.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Question {
    /// An attempt asks anew: its image may have been pushed since.
    pub attempt: i64,
    pub image: Image,
    /// Secrets of the Leaderboard's Pods with credentials of registries.
    pub secrets: Vec<String>,
}

struct Entry {
    question: Question,
    by: ObjectRef<Submission>,
    asked: Instant,
    is_under_way: bool,
    answer: Option<Arc<Result<Facts, Fault>>>,
}

#[derive(Default)]
struct Shared {
    /// By the UID of the submission.
    entries: Mutex<HashMap<String, Entry>>,
    notify: Notify,
}

/// The questions and their answers.
#[derive(Clone)]
pub struct Images(Arc<Shared>);

impl Images {
    /// Starts the task that asks.
    pub fn start(aws: &Aws, client: Client, tasks: &Tasks, wake: Wake<Submission>) -> Self {
        let shared = Arc::new(Shared::default());
        let stop = tasks.stop().clone();
        let asking = ask(Registries::new(aws), client, Arc::clone(&shared), wake);
        tasks.stay("images", async move {
            tokio::select! { () = stop.wait() => {}, () = asking => {} }
        });
        Self(shared)
    }

    /// Asks, unless that is asked already.
    pub fn want(&self, submission: &Submission, question: Question) {
        self.0
            .want(uid_of(submission), ObjectRef::from_obj(submission), question);
    }

    /// What is known for the submission's present attempt.
    pub fn observe(&self, submission: &Submission) -> ObservedImage {
        let attempt = submission.status.as_ref().and_then(|status| status.attempt);
        self.0.observe(&uid_of(submission), attempt.unwrap_or(1))
    }

    /// Drops what is known for an object that is gone.
    pub fn forget(&self, uid: &str) {
        self.0.lock().remove(uid);
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, HashMap<String, Entry>> {
        self.entries.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn want(&self, uid: String, by: ObjectRef<Submission>, question: Question) {
        let now = Instant::now();
        let mut entries = self.lock();
        let is_waited_for = |entry: &Entry| entry.answer.is_none() || now.saturating_duration_since(entry.asked) < KEPT;
        entries.retain(|_, entry| is_waited_for(entry));
        if entries.get(&uid).is_some_and(|entry| entry.question == question) {
            return;
        }
        let entry = Entry {
            question,
            by,
            asked: now,
            is_under_way: false,
            answer: None,
        };
        entries.insert(uid, entry);
        self.notify.notify_one();
    }

    fn observe(&self, uid: &str, attempt: i64) -> ObservedImage {
        let entries = self.lock();
        let Some(entry) = entries.get(uid).filter(|entry| entry.question.attempt == attempt) else {
            return ObservedImage::NotAsked;
        };
        match &entry.answer {
            Some(answer) => ObservedImage::Answered(Arc::clone(answer)),
            None => ObservedImage::Asked(entry.asked.elapsed()),
        }
    }

    /// The question that has waited longest.
    fn next(&self) -> Option<(String, Question, String)> {
        let mut entries = self.lock();
        let waiting = entries
            .iter_mut()
            .filter(|(_, entry)| !entry.is_under_way && entry.answer.is_none());
        let (uid, entry) = waiting.min_by_key(|(_, entry)| entry.asked)?;
        entry.is_under_way = true;
        let namespace = entry.by.namespace.clone().unwrap_or_default();
        Some((uid.clone(), entry.question.clone(), namespace))
    }

    /// Takes an answer in. Returns whom it is for.
    fn done(&self, uid: &str, question: &Question, answer: Result<Facts, Fault>) -> Option<ObjectRef<Submission>> {
        let mut entries = self.lock();
        let entry = entries.get_mut(uid).filter(|entry| entry.question == *question)?;
        entry.is_under_way = false;
        entry.answer = Some(Arc::new(answer));
        Some(entry.by.clone())
    }
}

async fn ask(registries: Registries, client: Client, shared: Arc<Shared>, wake: Wake<Submission>) {
    let mut under_way = FuturesUnordered::new();
    loop {
        while under_way.len() < AT_ONCE
            && let Some((uid, question, namespace)) = shared.next()
        {
            let (client, registries) = (&client, &registries);
            let asking = async move {
                let credentials = credentials(client, &namespace, &question).await;
                let answer = registries.look_up(&question.image, credentials).await;
                (uid, question, answer)
            };
            under_way.push(asking.boxed());
        }
        tokio::select! {
            Some((uid, question, answer)) = under_way.next() => {
                shared.done(&uid, &question, answer).into_iter().for_each(&wake);
            }
            () = shared.notify.notified() => {}
        }
    }
}

/// The first of the Leaderboard's pull secrets that has credentials for the registry. One that cannot be read has none: the registry
/// then says what it lets everybody read.
async fn credentials(client: &Client, namespace: &str, question: &Question) -> Option<Credentials> {
    let api: Api<Secret> = Api::namespaced(client.clone(), namespace);
    for name in &question.secrets {
        let secret = match tokio::time::timeout(CALL_TIMEOUT, api.get(name)).await {
            Ok(Ok(secret)) => secret,
            Ok(Err(error)) => {
                tracing::warn!(namespace, secret = name, "the pull secret cannot be read: {error}");
                continue;
            }
            Err(_) => continue,
        };
        let data = secret.data.as_ref().and_then(|data| data.get(".dockerconfigjson"));
        let found = data.and_then(|data| Credentials::of_secret(&data.0, &question.image.registry));
        if found.is_some() {
            return found;
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    fn question(attempt: i64, reference: &str) -> Question {
        Question {
            attempt,
            image: Image {
                registry: "r.example".into(),
                path: "a".into(),
                reference: reference.into(),
                may_be_local: false,
            },
            secrets: Vec::new(),
        }
    }

    fn by(name: &str) -> ObjectRef<Submission> {
        ObjectRef::new(name).within("one")
    }

    #[tokio::test(start_paused = true)]
    async fn a_question_is_asked_once_and_its_answer_stays_for_its_attempt() {
        let shared = Shared::default();
        let first = question(1, "one");
        shared.want("u".into(), by("s"), first.clone());
        assert_eq!(shared.next(), Some(("u".into(), first.clone(), "one".into())));
        shared.want("u".into(), by("s"), first.clone());
        assert_eq!(shared.next(), None, "it is under way");
        tokio::time::advance(Duration::from_secs(3)).await;
        assert_eq!(shared.observe("u", 1), ObservedImage::Asked(Duration::from_secs(3)));
        assert_eq!(shared.done("u", &first, Err(Fault::NotFound)), Some(by("s")));
        assert_eq!(
            shared.observe("u", 1),
            ObservedImage::Answered(Arc::new(Err(Fault::NotFound)))
        );
        assert_eq!(shared.observe("u", 2), ObservedImage::NotAsked);
        shared.want("u".into(), by("s"), question(2, "one"));
        assert_eq!(shared.next().unwrap().1.attempt, 2, "it may have been pushed since");
    }

    #[tokio::test(start_paused = true)]
    async fn the_answer_to_an_older_question_is_nobodys() {
        let shared = Shared::default();
        let (old, new) = (question(1, "one"), question(1, "other"));
        shared.want("u".into(), by("s"), old.clone());
        shared.next();
        shared.want("u".into(), by("s"), new.clone());
        assert_eq!(shared.done("u", &old, Err(Fault::NotFound)), None);
        assert_eq!(shared.observe("u", 1), ObservedImage::Asked(Duration::ZERO));
        assert_eq!(shared.next().unwrap().1, new);
    }

    #[tokio::test(start_paused = true)]
    async fn who_asked_first_is_served_first_and_old_answers_go() {
        let shared = Shared::default();
        for uid in ["a", "b"] {
            shared.want(uid.into(), by(uid), question(1, uid));
            tokio::time::advance(Duration::from_secs(1)).await;
        }
        let (uid, question, _) = shared.next().unwrap();
        assert_eq!(uid, "a");
        shared.done(&uid, &question, Err(Fault::Denied));
        tokio::time::advance(KEPT).await;
        shared.want("c".into(), by("c"), super::tests::question(1, "c"));
        assert_eq!(shared.observe("a", 1), ObservedImage::NotAsked);
        assert!(
            matches!(shared.observe("b", 1), ObservedImage::Asked(_)),
            "it still waits"
        );
    }
}
