//! Which objects an event concerns, and how urgent it is: the streams of the watches and services, mapped for the two queues.
//!
//! Each mapping takes the event in where something is remembered of it, and leaves out the echo of our own writes.

use std::collections::hash_map::DefaultHasher;
use std::collections::{HashMap, HashSet};
use std::hash::Hasher;
use std::sync::Arc;

use futures::future::ready;
use futures::stream::{self, BoxStream, StreamExt, select_all};
use k8s_openapi::api::networking::v1::NetworkPolicy;
use kube::ResourceExt;
use kube::runtime::reflector::ObjectRef;
use tokio::sync::mpsc;

use super::Shared;
use super::queue::{Class, Key, Queue, urgency};
use super::watches::Watches;
use crate::kubernetes::objects::{Job, Pod};
use crate::kubernetes::{Store, WatchEvent};
use crate::runtime::objects::{Wake, board_of, key_of, uid};
use crate::runtime::stores::Stores;
use crate::slots;
use leaderboard_api::{Leaderboard, Submission, conditions, names};
use leaderboard_base::object_key::ObjectKey;
use leaderboard_evalai::Changed;

/// Objects that something has happened to, and how urgent that is.
pub(super) type Events<K> = BoxStream<'static, (ObjectRef<K>, Class)>;

/// Every Submission with an event, and how urgent it is. Events that concern its Leaderboard wake that as well.
pub(super) fn of_submissions(
    watches: &Watches,
    evalai: mpsc::UnboundedReceiver<Changed>,
    shared: &Arc<Shared>,
) -> Events<Submission> {
    let boards = Arc::clone(&shared.queues.leaderboards);
    let store = shared.context.stores.submissions.clone();
    let of_evalai = move |change| match change {
        Changed::Submission(key) => Some(ranked(&store, reference(&key), urgency::of_evalai)),
        Changed::Leaderboard(key) => {
            boards.add(&reference::<Leaderboard>(&key), Class::Refresh);
            None
        }
    };
    select_all([
        mapped(watches.submissions.subscribe(), of_submission(Arc::clone(shared))),
        mapped(watches.jobs.subscribe(), of_job(Arc::clone(shared))),
        mapped(watches.pods.subscribe(), of_pod(Arc::clone(shared))),
        mapped(received(evalai), of_evalai),
    ])
    .boxed()
}

/// Puts a Submission into the queue that has an answer from S3, or of the API server.
pub(super) fn waking(queue: &Arc<Queue>, submissions: &Store<Submission>) -> Wake<Submission> {
    waking_as(urgency::of_answer, queue, submissions)
}

/// Puts a Submission into the queue, as urgent as this.
pub(super) fn waking_as(
    urgency: fn(&Submission) -> Class,
    queue: &Arc<Queue>,
    submissions: &Store<Submission>,
) -> Wake<Submission> {
    let (queue, submissions) = (Arc::clone(queue), submissions.clone());
    Box::new(move |object| {
        let (object, class) = ranked(&submissions, object, urgency);
        queue.add(&object, class);
    })
}

fn ranked(
    submissions: &Store<Submission>,
    object: ObjectRef<Submission>,
    urgency: fn(&Submission) -> Class,
) -> (ObjectRef<Submission>, Class) {
    let class = submissions.get(&object).map_or(Class::Refresh, |found| urgency(&found));
    (object, class)
}

/// Every Leaderboard that something has happened to; those that wait for it are woken.
pub(super) fn of_leaderboards(watches: &Watches, shared: &Arc<Shared>) -> Events<Leaderboard> {
    let slots = Arc::clone(&shared.context.slots);
    let of_policy = move |event: WatchEvent<NetworkPolicy>| {
        let board = Stores::leaderboard_of_policy(&event.object)?;
        slots.wake(&board);
        Some((board, Class::Urgent))
    };
    select_all([
        mapped(watches.leaderboards.subscribe(), of_leaderboard(Arc::clone(shared))),
        mapped(watches.policies.subscribe(), of_policy),
    ])
    .boxed()
}

fn of_submission(
    shared: Arc<Shared>,
) -> impl FnMut(WatchEvent<Submission>) -> Option<(ObjectRef<Submission>, Class)> + Send {
    let (mut marks, mut counted) = (Marks::default(), Marks::default());
    move |event| {
        let (object, queues) = (event.object.as_ref(), &shared.queues);
        let (board, slots) = (board_of(object), &shared.context.slots);
        if event.is_gone || counted.moved(uid(object), &slots::mark(object)) {
            slots.changed(&board);
        }
        // One that is being deleted waits for its last submission; of the others the walk of the gauges compares the counts.
        let known = shared.context.stores.leaderboards.get(&board);
        if known.is_some_and(|known| known.metadata.deletion_timestamp.is_some()) {
            queues.leaderboards.add(&board, Class::Refresh);
        }
        if event.is_gone {
            marks.forget(uid(object));
            counted.forget(uid(object));
            slots.leaves(object);
            queues.submissions.forget(&Key::from(&ObjectRef::from_obj(object)));
            shared.forget(&key_of(object));
            return None;
        }
        shared.context.memory.is_shown(object);
        let is_news = marks.moved(uid(object), &own_fields(object, names::FINALIZER_SUBMISSION));
        is_news.then(|| (ObjectRef::from_obj(object), urgency::of_submission(object)))
    }
}

fn of_job(shared: Arc<Shared>) -> impl FnMut(WatchEvent<Job>) -> Option<(ObjectRef<Submission>, Class)> + Send {
    let mut marks = Marks::default();
    move |event| {
        let job = event.object.as_ref();
        if let Some(board) = Stores::leaderboard_of(&job.metadata) {
            shared.context.slots.changed(&board);
        }
        let owner = Stores::owner_of(&job.metadata).filter(|_| marks.job_has_news(job, event.is_gone));
        owner.map(|owner| (owner, urgency::of_job(job, event.is_gone)))
    }
}

fn of_leaderboard(
    shared: Arc<Shared>,
) -> impl FnMut(WatchEvent<Leaderboard>) -> Option<(ObjectRef<Leaderboard>, Class)> + Send {
    let (mut marks, mut standings) = (Marks::default(), Marks::default());
    move |event| {
        let (object, slots) = (event.object.as_ref(), &shared.context.slots);
        let reference = ObjectRef::from_obj(object);
        slots.changed(&reference);
        if event.is_gone {
            marks.forget(uid(object));
            standings.forget(uid(object));
            shared.queues.leaderboards.forget(&Key::from(&reference));
            shared.forget(&key_of(object));
            slots.wake(&reference);
            return None;
        }
        let stands_otherwise = standings.moved(uid(object), &standing(object));
        let is_news = marks.moved(uid(object), &own_fields(object, names::FINALIZER_LEADERBOARD));
        if is_news || stands_otherwise {
            slots.wake(&reference);
        }
        is_news.then_some((reference, Class::Urgent))
    }
}

/// Part of a Leaderboard's status that may hold its submissions up.
fn standing(leaderboard: &Leaderboard) -> String {
    let status = leaderboard.status.as_ref();
    let condition = |type_: &str| {
        let found = leaderboard.condition(type_);
        found.map(|c| (&c.status, &c.reason, &c.message))
    };
    format!(
        "{:?} {:?} {:?}",
        status.and_then(|status| status.operator.as_deref()),
        condition(conditions::READY),
        condition(conditions::ISOLATED)
    )
}

/// A Pod concerns its Submission, and its Leaderboard once it has measured its isolation.
fn of_pod(shared: Arc<Shared>) -> impl FnMut(WatchEvent<Pod>) -> Option<(ObjectRef<Submission>, Class)> + Send {
    let mut measured = HashSet::new();
    move |event| {
        let pod = event.object.as_ref();
        let uid = pod.metadata.uid.clone();
        let board = Stores::leaderboard_of(&pod.metadata);
        // A Leaderboard that is being deleted waits for the end of its last Pod.
        let known = board
            .as_ref()
            .and_then(|board| shared.context.stores.leaderboards.get(board));
        let is_awaited = known.is_some_and(|known| known.metadata.deletion_timestamp.is_some());
        let is_measured = if event.is_gone {
            measured.remove(&uid);
            false
        } else {
            !measured.contains(&uid) && shared.context.measured(pod) && measured.insert(uid)
        };
        if let Some(board) = board.filter(|_| is_awaited || is_measured) {
            shared.queues.leaderboards.add(&board, Class::Refresh);
        }
        Stores::owner_of(&pod.metadata).map(|owner| (owner, urgency::of_pod(pod, event.is_gone)))
    }
}

/// Part of an object that is news to us: neither its status nor our own finalizer, which both are our own writes.
fn own_fields(object: &impl ResourceExt, own_finalizer: &str) -> String {
    let meta = object.meta();
    let finalizers = meta
        .finalizers
        .iter()
        .flatten()
        .filter(|finalizer| *finalizer != own_finalizer);
    let finalizers: Vec<&String> = finalizers.collect();
    let (generation, annotations) = (meta.generation, &meta.annotations);
    format!(
        "{generation:?} {:?} {finalizers:?} {annotations:?}",
        meta.deletion_timestamp
    )
}

/// Hash of each object as it was last observed: the same hash again is no news.
#[derive(Default)]
struct Marks(HashMap<String, u64>);

impl Marks {
    fn moved(&mut self, uid: &str, mark: &str) -> bool {
        let mut hasher = DefaultHasher::new();
        hasher.write(mark.as_bytes());
        let mark = hasher.finish();
        self.0.insert(uid.to_owned(), mark) != Some(mark)
    }

    /// True for the end and the deletion of a Job: it was made by us, and all else that happens shows in its Pod.
    fn job_has_news(&mut self, job: &Job, is_gone: bool) -> bool {
        let (uid, deleted) = (&*job.metadata.uid, &job.metadata.deletion_timestamp);
        if is_gone {
            self.forget(uid);
            return true;
        }
        let conditions = &job.status.conditions;
        let has_moved = self.moved(uid, &format!("{deleted:?} {conditions:?}"));
        has_moved && (!conditions.is_empty() || deleted.is_some())
    }

    fn forget(&mut self, uid: &str) {
        self.0.remove(uid);
    }
}

fn reference<K: kube::Resource<DynamicType = ()>>(key: &ObjectKey) -> ObjectRef<K> {
    ObjectRef::new(&key.name).within(&key.namespace)
}

fn mapped<E: 'static, R: Send + 'static>(
    events: impl futures::Stream<Item = E> + Send + 'static,
    mut map: impl FnMut(E) -> Option<R> + Send + 'static,
) -> BoxStream<'static, R> {
    events.filter_map(move |event| ready(map(event))).boxed()
}

fn received<T: Send + 'static>(
    mut queue: mpsc::UnboundedReceiver<T>,
) -> impl futures::Stream<Item = T> + Send + 'static {
    stream::poll_fn(move |cx| queue.poll_recv(cx))
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    fn changed(change: &Value) -> Submission {
        let mut object = json!({
            "apiVersion": "leaderboard.carla.org/v1alpha1", "kind": "Submission",
            "metadata": {"name": "s", "namespace": "one", "uid": "u", "generation": 1},
            "spec": {"leaderboardName": "l", "track": "t", "image": "i"},
        });
        for (part, fields) in change.as_object().unwrap() {
            let part = object.as_object_mut().unwrap().entry(part).or_insert_with(|| json!({}));
            part.as_object_mut()
                .unwrap()
                .extend(fields.as_object().unwrap().clone());
        }
        serde_json::from_value(object).unwrap()
    }

    #[test]
    fn our_own_writes_of_a_submission_are_no_news() {
        let (ours, other) = (names::FINALIZER_SUBMISSION, "example.org/other");
        let both = [ours, other];
        let mut marks = Marks::default();
        let mut is_news = |change: Value| {
            let object = changed(&change);
            marks.moved(uid(&object), &own_fields(&object, ours))
        };
        for (what, change, expected) in [
            ("it is new", json!({}), true),
            ("a status", json!({"status": {"jobName": "j"}}), false),
            ("our finalizer", json!({"metadata": {"finalizers": [ours]}}), false),
            ("another finalizer", json!({"metadata": {"finalizers": both}}), true),
            (
                "a spec",
                json!({"metadata": {"finalizers": both, "generation": 2}}),
                true,
            ),
            (
                "an annotation",
                json!({"metadata": {"finalizers": both, "generation": 2, "annotations": {"a": "b"}}}),
                true,
            ),
        ] {
            assert_eq!(is_news(change), expected, "{what}");
        }
    }

    #[test]
    fn of_a_job_only_its_end_and_its_deletion_are_news() {
        let mut marks = Marks::default();
        let time = "2026-01-01T00:00:00Z";
        let ended = json!({"conditions": [{"type": "Complete", "status": "True"}]});
        let ttl = json!({"ttlSecondsAfterFinished": 1, "template": {}});
        for (what, change, is_gone, expected) in [
            ("made by us", json!({}), false, false),
            (
                "its Pod was made",
                json!({"status": {"active": 1, "startTime": time}}),
                false,
                false,
            ),
            ("its end", json!({"status": ended}), false, true),
            ("its time to live", json!({"spec": ttl, "status": ended}), false, false),
            (
                "its deletion",
                json!({"metadata": {"deletionTimestamp": time}, "status": ended}),
                false,
                true,
            ),
            ("it is gone", json!({}), true, true),
        ] {
            let mut job: Job = serde_json::from_value(change).unwrap();
            job.metadata.uid = "u".into();
            assert_eq!(marks.job_has_news(&job, is_gone), expected, "{what}");
        }
    }
}
