//! What no watch shows and is asked of the API server now and then: why a Job has no Pod, whether a node is on its way for a Pod
//! that none accepts, and, where nodes are not watched, whether one reports. Asked by a task of its own, once for all who want to know; an answer that differs wakes them. No reconcile waits
//! for it.

use std::collections::HashMap;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use futures::stream::FuturesUnordered;
use futures::{FutureExt, StreamExt};
use k8s_openapi::api::core::v1::Event;
use kube::api::ListParams;
use kube::runtime::reflector::ObjectRef;
use kube::{Api, Client};
use tokio::sync::Notify;
use tokio::time::Instant;

use super::{node, scale_up};
use crate::controller::objects::Wake;
use crate::controller::submissions::view::{NodeView, ScaleUp};
use crate::kubernetes::call;
use crate::lock::lock;
use crate::observability::tasks::Tasks;
use leaderboard_api::Submission;
use leaderboard_api::text::{LONGEST_MESSAGE, one_line};

/// How many questions are under way at once.
const AT_ONCE: usize = 4;
/// Who has not asked again for so long does not want to know any more: a live run is reconciled more often.
const FORGOTTEN: Duration = Duration::from_mins(6);
/// How long an answer is passed on.
const FRESH: Duration = Duration::from_mins(1);
/// How often it is checked which questions are due.
const TICK: Duration = Duration::from_secs(1);

/// Something to ask the API server.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
enum Question {
    Node(String),
    /// The last FailedCreate event of a Job.
    Refusal {
        namespace: String,
        job: String,
    },
    /// What an autoscaler reports of a Pod.
    ScaleUp {
        namespace: String,
        pod: String,
    },
}

#[derive(Clone, Debug, PartialEq)]
enum Answer {
    Node(NodeView),
    Refusal(Option<String>),
    ScaleUp(Option<ScaleUp>),
}

#[derive(Default)]
struct Entry {
    answer: Option<Answer>,
    asked: Option<Instant>,
    is_under_way: bool,
    /// Who wants to know, and when they said so last.
    wanted_by: HashMap<ObjectRef<Submission>, Instant>,
}

#[derive(Default)]
struct Shared {
    entries: Mutex<HashMap<Question, Entry>>,
    notify: Notify,
}

/// What was asked, and what came of it.
#[derive(Clone)]
pub struct Lookups(Arc<Shared>);

impl Lookups {
    /// Starts the task that asks.
    pub fn start(client: Client, tasks: &Tasks, wake: Wake<Submission>) -> Self {
        let shared = Arc::new(Shared::default());
        tasks.until_stop("lookups", ask(client, Arc::clone(&shared), wake));
        Self(shared)
    }

    /// How a node is, as far as it was read.
    pub fn node(&self, name: &str, by: ObjectRef<Submission>) -> NodeView {
        match self.0.want(Question::Node(name.to_owned()), by) {
            Some(Answer::Node(seen)) => seen,
            _ => NodeView::default(),
        }
    }

    /// What an autoscaler reports of a Pod, as far as it was read.
    pub fn scale_up(&self, namespace: &str, pod: &str, by: ObjectRef<Submission>) -> Option<ScaleUp> {
        let question = Question::ScaleUp {
            namespace: namespace.to_owned(),
            pod: pod.to_owned(),
        };
        match self.0.want(question, by) {
            Some(Answer::ScaleUp(report)) => report,
            _ => None,
        }
    }

    /// The text of a Job's last FailedCreate event, as far as it was read.
    pub fn refusal(&self, namespace: &str, job: &str, by: ObjectRef<Submission>) -> Option<String> {
        let question = Question::Refusal {
            namespace: namespace.to_owned(),
            job: job.to_owned(),
        };
        match self.0.want(question, by) {
            Some(Answer::Refusal(text)) => text,
            _ => None,
        }
    }
}

impl Shared {
    fn want(&self, question: Question, by: ObjectRef<Submission>) -> Option<Answer> {
        let mut entries = lock(&self.entries);
        let entry = entries.entry(question).or_default();
        entry.wanted_by.insert(by, Instant::now());
        if entry.asked.is_none() {
            self.notify.notify_one();
        }
        entry.answer.clone()
    }

    /// The next question that is due.
    fn next(&self, now: Instant) -> Option<Question> {
        let mut entries = lock(&self.entries);
        entries.retain(|_, entry| {
            entry
                .wanted_by
                .retain(|_, at| now.saturating_duration_since(*at) < FORGOTTEN);
            entry.is_under_way || !entry.wanted_by.is_empty()
        });
        let is_due = |entry: &Entry| {
            let is_fresh = entry.asked.is_some_and(|at| now.saturating_duration_since(at) < FRESH);
            !entry.is_under_way && !is_fresh
        };
        let (question, entry) = entries.iter_mut().find(|(_, entry)| is_due(entry))?;
        entry.is_under_way = true;
        entry.asked = Some(now);
        Some(question.clone())
    }

    /// Takes an answer in. Returns whom it is new to.
    fn done(&self, question: &Question, answer: Answer) -> Vec<ObjectRef<Submission>> {
        let mut entries = lock(&self.entries);
        let Some(entry) = entries.get_mut(question) else {
            return Vec::new();
        };
        entry.is_under_way = false;
        let is_nothing = match &answer {
            Answer::Node(node) => *node == NodeView::default() || *node == node::healthy(),
            Answer::Refusal(text) => text.is_none(),
            Answer::ScaleUp(report) => report.is_none(),
        };
        let is_new = match &entry.answer {
            Some(known) => *known != answer,
            None => !is_nothing,
        };
        entry.answer = Some(answer);
        if is_new {
            entry.wanted_by.keys().cloned().collect()
        } else {
            Vec::new()
        }
    }
}

async fn ask(client: Client, shared: Arc<Shared>, wake: Wake<Submission>) {
    let mut under_way = FuturesUnordered::new();
    let mut tick = tokio::time::interval(TICK);
    loop {
        while under_way.len() < AT_ONCE
            && let Some(question) = shared.next(Instant::now())
        {
            let client = client.clone();
            let asking = async move {
                let answer = answer(&client, &question).await;
                (question, answer)
            };
            under_way.push(asking.boxed());
        }
        tokio::select! {
            Some((question, answer)) = under_way.next() => shared.done(&question, answer).into_iter().for_each(&wake),
            _ = tick.tick() => {}
            () = shared.notify.notified() => {}
        }
    }
}

async fn answer(client: &Client, question: &Question) -> Answer {
    match question {
        Question::Node(name) => Answer::Node(node::read(client, name).await),
        Question::Refusal { namespace, job } => Answer::Refusal(refusal(client, namespace, job).await),
        Question::ScaleUp { namespace, pod } => {
            let selector = format!("involvedObject.kind=Pod,involvedObject.name={pod}");
            let found = events(client, namespace, &selector).await;
            Answer::ScaleUp(found.and_then(scale_up::of))
        }
    }
}

async fn events(client: &Client, namespace: &str, selector: &str) -> Option<Vec<Event>> {
    let events: Api<Event> = Api::namespaced(client.clone(), namespace);
    let params = ListParams::default().fields(selector).limit(50);
    let found = call("the events", selector, events.list(&params)).await;
    Some(found.ok()?.items)
}

async fn refusal(client: &Client, namespace: &str, job: &str) -> Option<String> {
    let selector = format!("involvedObject.kind=Job,involvedObject.name={job},reason=FailedCreate");
    let found = events(client, namespace, &selector).await?;
    let latest = found.into_iter().max_by_key(|e| {
        e.last_timestamp
            .as_ref()
            .or(e.first_timestamp.as_ref())
            .map(|t| t.0)
            .or(e.event_time.as_ref().map(|t| t.0))
    })?;
    latest.message.map(|message| one_line(&message, LONGEST_MESSAGE))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::controller::submissions::view::ObservedNode;

    fn by(name: &str) -> ObjectRef<Submission> {
        ObjectRef::new(name).within("one")
    }

    #[tokio::test(start_paused = true)]
    async fn a_question_is_asked_once_for_all_and_again_when_its_answer_is_old() {
        let shared = Shared::default();
        let node = Question::Node("a".into());
        assert_eq!(shared.want(node.clone(), by("1")), None);
        assert_eq!(shared.want(node.clone(), by("2")), None);
        assert_eq!(shared.next(Instant::now()), Some(node.clone()));
        assert_eq!(shared.next(Instant::now()), None, "it is under way");
        assert!(
            shared.done(&node, Answer::Node(node::healthy())).is_empty(),
            "nothing to decide on"
        );
        tokio::time::advance(Duration::from_secs(59)).await;
        assert_eq!(shared.next(Instant::now()), None);
        tokio::time::advance(Duration::from_secs(1)).await;
        assert_eq!(shared.next(Instant::now()), Some(node.clone()));
        let gone = || {
            Answer::Node(NodeView {
                state: ObservedNode::Gone,
                leaving: None,
            })
        };
        let mut woken = shared.done(&node, gone());
        woken.sort_by(|one, other| one.name.cmp(&other.name));
        assert_eq!(woken, [by("1"), by("2")]);
        assert_eq!(shared.want(node.clone(), by("2")), Some(gone()));
    }

    #[tokio::test(start_paused = true)]
    async fn who_does_not_ask_again_is_forgotten_with_the_answer() {
        let shared = Shared::default();
        let question = Question::Refusal {
            namespace: "one".into(),
            job: "s-1".into(),
        };
        shared.want(question.clone(), by("1"));
        shared.next(Instant::now());
        let refused = Answer::Refusal(Some("exceeded quota".into()));
        assert_eq!(shared.done(&question, refused), [by("1")]);
        tokio::time::advance(FORGOTTEN).await;
        assert_eq!(shared.next(Instant::now()), None);
        assert!(lock(&shared.entries).is_empty());
    }
}
