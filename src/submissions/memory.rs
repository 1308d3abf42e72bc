//! The leader's memory between two reconciles of one object: above all the status it last wrote.
//!
//! Needed because a cache may lag behind our own writes: a reconcile must never decide on a status older than its own.

use std::collections::HashMap;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use tokio::time::Instant;

use crate::runtime::objects::{self, uid, version_number};
use leaderboard_api::{Attempt, Submission, SubmissionStatus};
use leaderboard_base::lock::lock;

/// Time between two writes of places in line, over all Submissions.
const PLACE_PACE: Duration = Duration::from_secs(1);

/// One entry for each Submission, by UID.
#[derive(Default)]
pub struct Memory {
    entries: Mutex<HashMap<Box<str>, Box<Entry>>>,
    /// When the next place may be written.
    next_place: Mutex<Option<Instant>>,
}

#[derive(Default)]
struct Entry {
    written: Option<Written>,
    /// The Job that was created last, and when.
    job: Option<(String, Instant)>,
    /// The Job that the API server refuses to make, and why.
    refused: Option<Box<(String, String)>>,
    /// The attempt about which EvalAI has been asked if it is to run, and since when.
    asked: Option<(Attempt, Instant)>,
    /// When its place may be written, until its status is.
    place_at: Option<Instant>,
}

/// How long a Job that the API server has created is waited for in the cache. One that was deleted at once never shows there.
const JOB_SHOWS: Duration = Duration::from_secs(15);

struct Written {
    version: u64,
    at: Instant,
    /// The written status; None once the cache is as new.
    status: Option<Box<SubmissionStatus>>,
}

impl Memory {
    /// The object with the status that we wrote last, and the version that has it, where the cache does not have it yet.
    pub fn with_own_status(&self, submission: Arc<Submission>) -> Arc<Submission> {
        self.is_shown(&submission);
        let own = self.read(&submission, |entry| {
            let written = entry.written.as_ref()?;
            Some((written.status.as_deref()?.clone(), written.version))
        });
        let Some((status, version)) = own else {
            return submission;
        };
        let mut newer = Arc::unwrap_or_clone(submission);
        newer.status = Some(status);
        newer.metadata.resource_version = Some(version.to_string());
        Arc::new(newer)
    }

    /// Remembers a status that we wrote, and the version that the API server has made of it. The watch may be faster than the
    /// answer: what the cache has `shown` by now is not kept.
    pub fn wrote(&self, submission: &Submission, status: &SubmissionStatus, version: &str, shown: Option<&Submission>) {
        let made = version_number(version);
        let is_shown = shown.is_some_and(|shown| uid(shown) == uid(submission) && objects::version(shown) >= made);
        let written = Written {
            version: made,
            at: Instant::now(),
            status: (!is_shown).then(|| Box::new(status.clone())),
        };
        self.change(submission, |entry| {
            (entry.written, entry.place_at) = (Some(written), None);
        });
    }

    /// The cache shows an object: our own status goes once that is as new.
    pub fn is_shown(&self, submission: &Submission) {
        if let Some(entry) = lock(&self.entries).get_mut(uid(submission))
            && let Some(written) = &mut entry.written
            && objects::version(submission) >= written.version
        {
            written.status = None;
        }
    }

    /// Time since our last write of its status; None if this process has not written it.
    pub fn since_write(&self, submission: &Submission) -> Option<Duration> {
        self.read(submission, |entry| Some(entry.written.as_ref()?.at.elapsed()))
    }

    /// How long a changed place has to wait for its write; None: not at all. Each has a moment of its own, so that a step of a
    /// thousand is not a thousand writes.
    pub fn place_waits(&self, submission: &Submission, now: Instant) -> Option<Duration> {
        let next = || {
            let mut next = lock(&self.next_place);
            let at = next.unwrap_or(now).max(now);
            *next = Some(at + PLACE_PACE);
            at
        };
        let at = self.change(submission, |entry| *entry.place_at.get_or_insert_with(next));
        at.checked_duration_since(now).filter(|left| !left.is_zero())
    }

    /// Remembers a Job that was created.
    pub fn created_job(&self, submission: &Submission, name: String) {
        self.change(submission, |entry| {
            (entry.job, entry.refused) = (Some((name, Instant::now())), None);
        });
    }

    /// Remembers why the API server refuses a Job.
    pub fn refused_job(&self, submission: &Submission, name: String, why: String) {
        self.change(submission, |entry| entry.refused = Some(Box::new((name, why))));
    }

    /// Why the API server refuses the Job of this name, if it did last.
    pub fn refusal(&self, submission: &Submission, name: &str) -> Option<String> {
        self.read(submission, |entry| {
            let refused = entry.refused.as_deref().filter(|(known, _)| known == name);
            refused.map(|(_, why)| why.clone())
        })
    }

    /// Forgets the Job that was created: the cache shows it, or it is being deleted.
    pub fn forget_job(&self, submission: &Submission) {
        if let Some(entry) = lock(&self.entries).get_mut(uid(submission)) {
            entry.job = None;
        }
    }

    /// True if the Job of this name was created so lately that the cache may not show it yet.
    pub fn awaits_job(&self, submission: &Submission, name: &str) -> bool {
        let job = self.read(submission, |entry| entry.job.clone());
        job.is_some_and(|(known, at)| known == name && at.elapsed() < JOB_SHOWS)
    }

    /// Remembers since when EvalAI has been asked about an attempt.
    pub fn asks_evalai(&self, submission: &Submission) {
        let attempt = submission.present_attempt();
        self.change(submission, |entry| {
            if entry.asked.is_none_or(|(of, _)| of != attempt) {
                entry.asked = Some((attempt, Instant::now()));
            }
        });
    }

    /// How long EvalAI has been asked about the present attempt.
    pub fn evalai_waited(&self, submission: &Submission) -> Duration {
        let asked = self.read(submission, |entry| entry.asked);
        let asked = asked.filter(|(of, _)| *of == submission.present_attempt());
        asked.map_or(Duration::ZERO, |(_, at)| at.elapsed())
    }

    /// Drops an object that is gone.
    pub fn forget(&self, uid: &str) {
        lock(&self.entries).remove(uid);
    }

    fn read<T>(&self, submission: &Submission, read: impl FnOnce(&Entry) -> Option<T>) -> Option<T> {
        lock(&self.entries).get(uid(submission)).and_then(|entry| read(entry))
    }

    fn change<T>(&self, submission: &Submission, change: impl FnOnce(&mut Entry) -> T) -> T {
        change(lock(&self.entries).entry(uid(submission).into()).or_default())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn object(version: &str, reason: &str) -> Submission {
        let mut object = Submission::new(
            "s",
            serde_json::from_value(serde_json::json!({"leaderboardName": "l", "track": "t", "image": "i"})).unwrap(),
        );
        object.metadata.uid = Some("u".into());
        object.metadata.resource_version = Some(version.into());
        object.status = Some(SubmissionStatus {
            reason: Some(reason.into()),
            ..Default::default()
        });
        object
    }

    #[tokio::test(start_paused = true)]
    async fn a_step_of_a_thousand_in_line_is_one_write_a_second() {
        let memory = Memory::default();
        let mut object = object("1", "WaitingForSlot");
        let mut writes = Vec::new();
        let begin = Instant::now();
        for second in 0..200 {
            let now = begin + Duration::from_secs(second);
            let mut count = 0;
            for position in 1..=100 {
                object.metadata.uid = Some(format!("u{position}"));
                if memory.place_waits(&object, now).is_none() {
                    memory.wrote(&object, &SubmissionStatus::default(), "1", None);
                    count += 1;
                }
            }
            writes.push(count);
        }
        assert!(writes.iter().all(|count| *count <= 1), "{writes:?}");
        assert!(writes.iter().sum::<u32>() >= 190, "nobody is forgotten: {writes:?}");
    }

    #[tokio::test(start_paused = true)]
    async fn a_created_job_is_remembered_until_it_must_have_shown() {
        let (memory, object) = (Memory::default(), object("1", "Preparing"));
        assert!(!memory.awaits_job(&object, "s-1"));
        memory.created_job(&object, "s-1".into());
        assert!(memory.awaits_job(&object, "s-1"));
        assert!(!memory.awaits_job(&object, "s-1-r1"));
        tokio::time::advance(Duration::from_secs(15)).await;
        assert!(!memory.awaits_job(&object, "s-1"), "it was deleted before it showed");
        memory.created_job(&object, "s-1".into());
        memory.forget_job(&object);
        assert!(!memory.awaits_job(&object, "s-1"));
    }

    #[test]
    fn a_refusal_is_remembered_until_the_job_is_made() {
        let (memory, object) = (Memory::default(), object("1", "Preparing"));
        memory.refused_job(&object, "s-1".into(), "exceeded quota".into());
        assert_eq!(memory.refusal(&object, "s-1").as_deref(), Some("exceeded quota"));
        assert_eq!(memory.refusal(&object, "s-2"), None, "another attempt's is another Job");
        memory.created_job(&object, "s-1".into());
        assert_eq!(memory.refusal(&object, "s-1"), None);
    }

    #[tokio::test(start_paused = true)]
    async fn evalais_silence_counts_from_the_first_question_of_an_attempt() {
        let (memory, mut object) = (Memory::default(), object("1", "Preparing"));
        assert_eq!(memory.evalai_waited(&object), Duration::ZERO);
        memory.asks_evalai(&object);
        tokio::time::advance(Duration::from_secs(4)).await;
        memory.asks_evalai(&object);
        assert_eq!(memory.evalai_waited(&object), Duration::from_secs(4));
        object.spec.attempt = Attempt(2);
        assert_eq!(memory.evalai_waited(&object), Duration::ZERO);
        memory.asks_evalai(&object);
        assert_eq!(memory.evalai_waited(&object), Duration::ZERO);
    }

    #[test]
    fn an_older_cache_does_not_hide_our_own_write() {
        let memory = Memory::default();
        let (old, new) = (object("9", "old"), object("", "new").status.unwrap());
        memory.wrote(&old, &new, "12", Some(&old));
        let reason = |shown: &Submission| {
            let shown = memory.with_own_status(Arc::new(shown.clone()));
            let version = objects::version(shown.as_ref());
            (shown.status.as_ref().unwrap().reason.clone().unwrap(), version)
        };
        assert_eq!(
            reason(&old),
            ("new".into(), 12),
            "what follows is applied to that version"
        );
        memory.is_shown(&object("11", "between"));
        assert_eq!(reason(&old), ("new".into(), 12));
        assert_eq!(reason(&object("13", "newer")), ("newer".into(), 13));
    }

    #[test]
    fn our_own_status_is_kept_no_longer_than_the_cache_lags() {
        let memory = Memory::default();
        let old = object("9", "old");
        memory.wrote(&old, old.status.as_ref().unwrap(), "12", None);
        let keeps = || lock(&memory.entries)["u"].written.as_ref().unwrap().status.is_some();
        assert!(keeps());
        memory.is_shown(&object("12", "new"));
        assert!(!keeps() && memory.since_write(&old).is_some());
        let write = |version: &str, shown: &Submission| {
            memory.wrote(&old, old.status.as_ref().unwrap(), version, Some(shown));
        };
        write("14", &object("13", "between"));
        assert!(keeps());
        write("15", &object("15", "new"));
        assert!(!keeps(), "the watch was faster than the answer");
    }
}
