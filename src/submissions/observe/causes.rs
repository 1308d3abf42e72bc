//! Why a Job has no Pod, and if a node is on its way for a Pod that no node takes. Kubernetes, cluster-autoscaler and Karpenter report
//! this in events.
//!
//! Two watches hand them in, so that no reconcile asks for them. The last word on each object is kept, and wakes its submission.

use std::collections::HashMap;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use jiff::Timestamp;
use kube::runtime::reflector::ObjectRef;
use tokio::time::Instant;

use crate::kubernetes::Store;
use crate::kubernetes::objects::{Event, Involved, Job, Meta, Pod};
use crate::runtime::objects::Wake;
use crate::runtime::stores::Stores;
use leaderboard_api::Submission;
use leaderboard_api::text::{LONGEST_MESSAGE, one_line};
use leaderboard_base::lock::lock;
use leaderboard_policy::view::ScaleUp;

/// Why Jobs have no Pod.
pub const OF_JOBS: &str = "involvedObject.kind=Job,reason=FailedCreate";
/// Events of autoscalers about Pods. The API server leaves out those of the kubelet, some 35 of each Pod, and of the scheduler.
pub const OF_PODS: &str = "involvedObject.kind=Pod,source!=kubelet,source!=default-scheduler";

/// As long as Kubernetes keeps an event.
const LASTS: Duration = Duration::from_hours(1);
/// Time between two sweeps, which drop the words on objects that are gone. An event may come before the cache shows its object.
const SWEPT: Duration = Duration::from_mins(1);
/// How an event begins that stands for several.
const COMBINED: &str = "(combined from similar events): ";
/// Characters at the end of a Pod's name that the API server makes up.
const MADE_UP: usize = 5;

/// The last word on each Job and Pod. Clones are the same.
#[derive(Clone, Default)]
pub struct Causes(Arc<Mutex<Known>>);

#[derive(Default)]
struct Known {
    /// By UID.
    causes: HashMap<Box<str>, Cause>,
    swept: Option<Instant>,
}

struct Cause {
    of: Involved,
    word: Word,
    at: Option<Timestamp>,
    heard: Instant,
}

#[derive(Clone, Debug, PartialEq)]
enum Word {
    Refused(String),
    ScaleUp(ScaleUp),
}

/// Where the objects of events are found.
#[derive(Clone)]
pub struct Objects {
    pub jobs: Store<Job>,
    pub pods: Store<Pod>,
}

impl Causes {
    /// Takes the events of a watch in.
    pub fn taking(&self, objects: Objects, wake: Wake<Submission>) -> impl FnMut(Event) + Send + 'static {
        let causes = self.clone();
        move |event| {
            let now = Instant::now();
            causes.sweep(&objects, now);
            if causes.hear(&event, now)
                && let Some(owner) = objects.owner(&event.involved_object)
            {
                wake(owner);
            }
        }
    }

    /// Why a Job has no Pod.
    pub fn refusal(&self, job: &str) -> Option<String> {
        match self.word(job)? {
            Word::Refused(words) => Some(words),
            Word::ScaleUp(_) => None,
        }
    }

    /// An autoscaler's report about a Pod; None if its last word is another.
    pub fn scale_up(&self, pod: &str) -> Option<ScaleUp> {
        match self.word(pod)? {
            Word::ScaleUp(report) => Some(report),
            Word::Refused(_) => None,
        }
    }

    /// The Job has a Pod: what was shown before no longer holds.
    pub fn has_pod(&self, job: &str) {
        lock(&self.0).causes.remove(job);
    }

    fn word(&self, uid: &str) -> Option<Word> {
        let known = lock(&self.0);
        let cause = known.causes.get(uid)?;
        (cause.heard.elapsed() < LASTS).then(|| cause.word.clone())
    }

    /// Returns whether it shows something new.
    fn hear(&self, event: &Event, now: Instant) -> bool {
        let Some(word) = word(event) else { return false };
        let (of, at) = (event.involved_object.clone(), event.at());
        let mut known = lock(&self.0);
        let before = known.causes.get(&of.uid);
        // A list has them in any order.
        if before.is_some_and(|before| before.at > at) {
            return false;
        }
        let is_new = before.is_none_or(|before| before.word != word);
        let cause = Cause {
            word,
            at,
            heard: now,
            of,
        };
        known.causes.insert(cause.of.uid.clone(), cause);
        is_new
    }

    /// Drops what is old, and what the caches no longer have.
    fn sweep(&self, objects: &Objects, now: Instant) {
        let mut known = lock(&self.0);
        let is_due = |last: Instant| now.saturating_duration_since(last) >= SWEPT;
        if !known.swept.is_none_or(is_due) {
            return;
        }
        known.swept = Some(now);
        known.causes.retain(|_, cause| {
            let age = now.saturating_duration_since(cause.heard);
            age < SWEPT || (age < LASTS && objects.owner(&cause.of).is_some())
        });
    }
}

impl Objects {
    /// The submission whose Job or Pod it is.
    fn owner(&self, of: &Involved) -> Option<ObjectRef<Submission>> {
        let owner = |meta: &Meta| (meta.uid == of.uid).then(|| Stores::owner_of(meta)).flatten();
        match &*of.kind {
            "Job" => {
                let job = self.jobs.get(&ObjectRef::new(&of.name).within(&of.namespace))?;
                owner(&job.metadata)
            }
            "Pod" => {
                let pod = self.pods.get(&ObjectRef::new(&of.name).within(&of.namespace))?;
                owner(&pod.metadata)
            }
            _ => None,
        }
    }
}

fn word(event: &Event) -> Option<Word> {
    let message = event.message.as_deref().unwrap_or_default();
    let words = || one_line(message, LONGEST_MESSAGE);
    match (&*event.involved_object.kind, event.reason.as_deref()?) {
        ("Job", "FailedCreate") => {
            let refused = steady(message, &event.involved_object.name);
            Some(Word::Refused(one_line(&refused, LONGEST_MESSAGE)))
        }
        ("Pod", "TriggeredScaleUp" | "Nominated") => Some(Word::ScaleUp(ScaleUp::Coming(words()))),
        ("Pod", "NotTriggerScaleUp") => Some(Word::ScaleUp(ScaleUp::Refused(words()))),
        // A scheduler's has the same reason, and shows nothing of nodes that are not there yet.
        ("Pod", "FailedScheduling") if is_karpenters(event) => Some(Word::ScaleUp(ScaleUp::Refused(words()))),
        _ => None,
    }
}

fn is_karpenters(event: &Event) -> bool {
    event
        .sources()
        .any(|name| ["karpenter", "eks-auto-mode/compute"].contains(&name))
}

/// The part of a message that each try of a Job shares. With the made up name of the refused Pod, each message would be new, and a write.
fn steady(message: &str, job: &str) -> String {
    let message = message.strip_prefix(COMBINED).unwrap_or(message);
    let start = format!("\"{job}-");
    let is_name = |rest: &str| rest.find('"') == Some(MADE_UP);
    match message.split_once(start.as_str()) {
        Some((before, rest)) if is_name(rest) => format!("{before}\"{job}{}", &rest[MADE_UP..]),
        _ => message.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc;

    use leaderboard_api::names;
    use serde_json::json;

    use super::*;

    fn event(kind: &str, reason: &str, component: &str, second: i64, message: &str) -> Event {
        let time = Timestamp::from_second(second).unwrap().to_string();
        let of = json!({"kind": kind, "namespace": "n", "name": "s-1", "uid": "u"});
        serde_json::from_value(json!({
            "metadata": {"name": format!("{reason}.{second}")}, "involvedObject": of, "reason": reason,
            "message": message, "source": {"component": component}, "lastTimestamp": time,
        }))
        .unwrap()
    }

    fn heard(events: &[Event]) -> Causes {
        let causes = Causes::default();
        for event in events {
            causes.hear(event, Instant::now());
        }
        causes
    }

    #[tokio::test]
    async fn an_autoscalers_last_message_differs_from_the_schedulers() {
        let scheduler = || {
            let words = "0/3 nodes are available.";
            event("Pod", "FailedScheduling", "a-scheduler", 900, words)
        };
        let triggered = "pod triggered scale-up: [{gpu-nodes 0->1 (max: 2)}]";
        let full = "pod didn't trigger scale-up: 1 max node group size reached";
        let nominated = "Pod should schedule on: nodeclaim/gpu-abc";
        let incompatible = "Failed to schedule pod, incompatible with nodepool \"gpu\"";
        let coming = |words: &str| Some(ScaleUp::Coming(words.into()));
        let refused = |words: &str| Some(ScaleUp::Refused(words.into()));
        let autoscaler =
            |reason: &str, second: i64, words: &str| event("Pod", reason, "cluster-autoscaler", second, words);
        let nominates = |component: &str| event("Pod", "Nominated", component, 10, nominated);
        let cases = [
            (vec![], None),
            (vec![scheduler()], None),
            (
                vec![autoscaler("TriggeredScaleUp", 10, triggered), scheduler()],
                coming(triggered),
            ),
            (
                vec![autoscaler("NotTriggerScaleUp", 10, full), scheduler()],
                refused(full),
            ),
            (
                vec![
                    autoscaler("TriggeredScaleUp", 30, triggered),
                    autoscaler("NotTriggerScaleUp", 20, full),
                ],
                coming(triggered),
            ),
            (vec![nominates("karpenter")], coming(nominated)),
            (vec![nominates("eks-auto-mode/compute")], coming(nominated)),
            (
                vec![
                    nominates("karpenter"),
                    event("Pod", "FailedScheduling", "karpenter", 60, incompatible),
                ],
                refused(incompatible),
            ),
            (vec![event("Pod", "Scheduled", "default-scheduler", 10, "")], None),
            (
                vec![event("Job", "TriggeredScaleUp", "cluster-autoscaler", 10, triggered)],
                None,
            ),
        ];
        for (events, expected) in cases {
            let shown = format!("{:?}", events.iter().map(|event| &event.reason).collect::<Vec<_>>());
            assert_eq!(heard(&events).scale_up("u"), expected, "{shown}");
        }
    }

    #[tokio::test]
    async fn a_word_without_a_time_is_older_than_any_other() {
        let timeless = json!({
            "involvedObject": {"kind": "Pod", "uid": "u"}, "reason": "TriggeredScaleUp", "message": "once",
        });
        let timeless: Event = serde_json::from_value(timeless).unwrap();
        let known = event("Pod", "NotTriggerScaleUp", "cluster-autoscaler", 5, "full");
        for events in [[known.clone(), timeless.clone()], [timeless, known]] {
            assert_eq!(heard(&events).scale_up("u"), Some(ScaleUp::Refused("full".into())));
        }
    }

    #[tokio::test]
    async fn each_try_of_a_job_that_is_refused_alike_is_no_news() {
        let causes = Causes::default();
        let quota = |pod: &str| format!("Error creating: pods \"{pod}\" is forbidden: exceeded quota: q, used: pods=0");
        let policy = "Error creating: admission webhook \"a.b\" denied the request: no\nroot";
        let shown = Some(quota("s-1"));
        for (what, message, is_new, expected) in [
            ("the first", quota("s-1-x7abc"), true, shown.clone()),
            ("the same of another Pod", quota("s-1-9zzzz"), false, shown.clone()),
            (
                "many as one",
                format!("{COMBINED}{}", quota("s-1-x7abd")),
                false,
                shown.clone(),
            ),
            (
                "another Job's Pod",
                quota("s-10-x7abd"),
                true,
                Some(quota("s-10-x7abd")),
            ),
            (
                "another cause",
                policy.to_owned(),
                true,
                Some(policy.replace('\n', " ")),
            ),
        ] {
            let said = event("Job", "FailedCreate", "job-controller", 5, &message);
            assert_eq!(causes.hear(&said, Instant::now()), is_new, "{what}");
            assert_eq!(causes.refusal("u"), expected, "{what}");
        }
        causes.has_pod("u");
        assert_eq!(causes.refusal("u"), None);
    }

    #[tokio::test(start_paused = true)]
    async fn its_submission_is_woken_and_nothing_is_kept_of_what_is_gone_or_of_another_program() {
        let meta = |uid: &str| {
            let labels = json!({names::LABEL_SUBMISSION: "s"});
            json!({"metadata": {"name": "s-1", "namespace": "n", "uid": uid, "labels": labels}})
        };
        let objects = |uid: &str| Objects {
            jobs: Store::of([serde_json::from_value(meta(uid)).unwrap()], |_| None),
            pods: Store::of([], |_| None),
        };
        let (woken, wakes) = mpsc::channel();
        let causes = Causes::default();
        let says = |objects: Objects, uid: &str, words: &str| {
            let woken = woken.clone();
            let mut said = event("Job", "FailedCreate", "job-controller", 5, words);
            said.involved_object.uid = uid.into();
            causes.taking(objects, Box::new(move |one| woken.send(one.name).unwrap()))(said);
            wakes.try_iter().collect::<Vec<_>>()
        };
        assert_eq!(says(objects("u"), "u", "quota"), ["s"]);
        assert!(says(objects("u"), "u", "quota").is_empty());
        assert!(says(objects("u"), "of another program", "quota").is_empty());
        tokio::time::advance(SWEPT).await;
        says(objects("u"), "u", "quota");
        assert_eq!(causes.refusal("u").as_deref(), Some("quota"));
        assert_eq!(causes.refusal("of another program"), None);
        tokio::time::advance(LASTS).await;
        assert_eq!(causes.refusal("u"), None, "Kubernetes has dropped the event, too");
        says(objects("u"), "u", "quota");
        tokio::time::advance(SWEPT).await;
        says(objects("made again"), "other", "quota");
        assert_eq!(causes.refusal("u"), None, "its Job is gone");
        assert_eq!(lock(&causes.0).causes.len(), 1);
    }
}
