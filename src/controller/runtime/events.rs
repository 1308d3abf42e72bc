//! Which objects an event concerns: the streams of the watches and services, mapped straight into the two work queues.
//!
//! Each mapping takes the event in where something is remembered of it, and leaves out the echo of our own writes.

use std::collections::{HashMap, HashSet};
use std::sync::Arc;

use futures::stream::{self, BoxStream, StreamExt, select_all};
use k8s_openapi::api::batch::v1::Job;
use k8s_openapi::api::core::v1::Pod;
use k8s_openapi::api::networking::v1::NetworkPolicy;
use kube::ResourceExt;
use kube::runtime::reflector::ObjectRef;
use tokio::sync::mpsc;

use super::{Shared, Watches};
use crate::controller::leaderboards::isolation;
use crate::controller::objects::key_of;
use crate::controller::stores::Stores;
use crate::kubernetes::WatchEvent;
use crate::services::ObjectKey;
use crate::services::evalai::Changed;
use leaderboard_api::{Leaderboard, Submission, conditions};

/// What the services report.
pub(super) struct Reports {
    /// Submissions whose row in DynamoDB has news.
    pub(super) rows: mpsc::UnboundedReceiver<ObjectKey>,
    /// What EvalAI has news of.
    pub(super) evalai: mpsc::UnboundedReceiver<Changed>,
    /// Submissions that have an answer from S3, or of the API server.
    pub(super) answers: mpsc::UnboundedReceiver<ObjectRef<Submission>>,
}

/// Wakes a Leaderboard.
pub(super) type Boards = mpsc::UnboundedSender<ObjectRef<Leaderboard>>;

/// Every Submission that something has happened to. What concerns its Leaderboard goes to `boards`, after it was counted.
pub(super) fn of_submissions(
    watches: &Watches,
    reports: Reports,
    boards: &Boards,
    shared: &Arc<Shared>,
) -> BoxStream<'static, ObjectRef<Submission>> {
    let own = of_submission(Arc::clone(shared), boards.clone());
    let slots = Arc::clone(&shared.context.slots);
    let of_job = move |event: WatchEvent<Job>| {
        slots.job(&event.object, event.is_gone);
        Stores::owner_of(event.object.as_ref())
    };
    let (to_boards, evalai) = (boards.clone(), received(reports.evalai));
    let of_evalai = move |change| match change {
        Changed::Submission(key) => Some(reference(&key)),
        Changed::Leaderboard(key) => {
            // Without a receiver the process is ending.
            let _ = to_boards.send(reference(&key));
            None
        }
    };
    select_all([
        mapped(watches.submissions.subscribe(), own),
        mapped(watches.jobs.subscribe(), of_job),
        mapped(watches.pods.subscribe(), of_pod(Arc::clone(shared), boards.clone())),
        mapped(received(reports.rows), |key| Some(reference(&key))),
        mapped(evalai, of_evalai),
        received(reports.answers).boxed(),
        shared.context.slots.woken().boxed(),
    ])
    .boxed()
}

/// Every Leaderboard that something has happened to; those that wait for it are woken.
pub(super) fn of_leaderboards(
    watches: &Watches,
    woken: mpsc::UnboundedReceiver<ObjectRef<Leaderboard>>,
    shared: &Arc<Shared>,
) -> BoxStream<'static, ObjectRef<Leaderboard>> {
    let slots = Arc::clone(&shared.context.slots);
    let of_policy = move |event: WatchEvent<NetworkPolicy>| {
        let board = Stores::leaderboard_of(event.object.as_ref())?;
        slots.wake_pending(&board);
        Some(board)
    };
    select_all([
        mapped(watches.leaderboards.subscribe(), of_leaderboard(Arc::clone(shared))),
        mapped(watches.policies.subscribe(), of_policy),
        received(woken).boxed(),
    ])
    .boxed()
}

fn of_submission(
    shared: Arc<Shared>,
    boards: Boards,
) -> impl FnMut(WatchEvent<Submission>) -> Vec<ObjectRef<Submission>> + Send {
    let mut marks = Marks::default();
    move |event| {
        let object = event.object.as_ref();
        if shared.context.slots.submission(object, event.is_gone) {
            let namespace = object.namespace().unwrap_or_default();
            let _ = boards.send(ObjectRef::new(&object.spec.leaderboard_name).within(&namespace));
        }
        let original = shared.context.reruns.moved(object, event.is_gone);
        if event.is_gone {
            marks.forget(object);
            shared.forget(&key_of(object));
            return Vec::new();
        }
        let is_news = marks.moved(object, "");
        let own = is_news.then(|| ObjectRef::from_obj(object));
        own.into_iter().chain(original).collect()
    }
}

fn of_leaderboard(shared: Arc<Shared>) -> impl FnMut(WatchEvent<Leaderboard>) -> Option<ObjectRef<Leaderboard>> + Send {
    let (mut marks, mut standings) = (Marks::default(), Marks::default());
    move |event| {
        let (object, slots) = (event.object.as_ref(), &shared.context.slots);
        slots.leaderboard(object, event.is_gone);
        let reference = ObjectRef::from_obj(object);
        if event.is_gone {
            marks.forget(object);
            standings.forget(object);
            shared.forget(&key_of(object));
            slots.wake_pending(&reference);
            return None;
        }
        if standings.moved(object, &standing(object)) {
            slots.wake_pending(&reference);
        }
        marks.moved(object, "").then_some(reference)
    }
}

/// What of a Leaderboard's status may hold its submissions up.
fn standing(leaderboard: &Leaderboard) -> String {
    let status = leaderboard.status.as_ref();
    let conditions = status.map(|status| status.conditions.as_slice()).unwrap_or_default();
    let condition = |type_: &str| conditions::get(conditions, type_).map(|c| (&c.status, &c.reason, &c.message));
    format!(
        "{:?} {:?} {:?}",
        status.and_then(|status| status.operator.as_deref()),
        condition(conditions::READY),
        condition(conditions::ISOLATED)
    )
}

/// A Pod concerns its Submission, and its Leaderboard once it has measured its isolation.
fn of_pod(shared: Arc<Shared>, boards: Boards) -> impl FnMut(WatchEvent<Pod>) -> Option<ObjectRef<Submission>> + Send {
    let mut measured = HashSet::new();
    move |event| {
        let pod = event.object.as_ref();
        let uid = pod.uid().unwrap_or_default();
        let board = Stores::leaderboard_of(pod);
        // A Leaderboard that is being deleted waits for the end of its last Pod.
        let known = board
            .as_ref()
            .and_then(|board| shared.context.stores.leaderboards.get(board));
        let is_awaited = known.is_some_and(|known| known.metadata.deletion_timestamp.is_some());
        let is_measured = if event.is_gone {
            measured.remove(&uid);
            false
        } else {
            isolation::finding(pod).is_some() && measured.insert(uid)
        };
        if let Some(board) = board.filter(|_| is_awaited || is_measured) {
            let _ = boards.send(board);
        }
        Stores::owner_of(pod)
    }
}

/// What was last seen of each object, to tell our own status writes from what others did.
#[derive(Default)]
struct Marks(HashMap<String, String>);

impl Marks {
    fn moved(&mut self, object: &impl ResourceExt, standing: &str) -> bool {
        let meta = object.meta();
        let mark = format!(
            "{:?} {:?} {:?} {:?} {standing}",
            meta.generation, meta.deletion_timestamp, meta.finalizers, meta.annotations
        );
        let old = self.0.insert(object.uid().unwrap_or_default(), mark.clone());
        old != Some(mark)
    }

    fn forget(&mut self, object: &impl ResourceExt) {
        self.0.remove(&object.uid().unwrap_or_default());
    }
}

fn reference<K: kube::Resource<DynamicType = ()>>(key: &ObjectKey) -> ObjectRef<K> {
    ObjectRef::new(&key.name).within(&key.namespace)
}

fn mapped<E, R, I>(
    events: impl futures::Stream<Item = E> + Send + 'static,
    map: impl FnMut(E) -> I + Send + 'static,
) -> BoxStream<'static, R>
where
    E: 'static,
    R: Send + 'static,
    I: IntoIterator<Item = R> + Send + 'static,
    I::IntoIter: Send,
{
    events.map(map).flat_map(stream::iter).boxed()
}

fn received<T: Send + 'static>(
    mut queue: mpsc::UnboundedReceiver<T>,
) -> impl futures::Stream<Item = T> + Send + 'static {
    stream::poll_fn(move |cx| queue.poll_recv(cx))
}
