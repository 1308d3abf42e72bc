//! The status and the plan while they are being made. It knows no stage of life; `write` makes the plan of it.

use std::time::Duration;

use jiff::Timestamp;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;

use super::plan::{Action, Event, job_name};
use super::waits::Wait;
use crate::view::{EvalaiInfo, ObservedJob, View};
use leaderboard_api::conditions::{self, Truth};
use leaderboard_api::{
    Attempt, BlockedSince, Deadlines, Failure, Ingested, LeaderboardSpec, Reason, ReasonName, Retries, RunPlan, Score,
    State, Submission, SubmissionSpec, SubmissionStatus, effective, names,
};
use leaderboard_evaluation::{Words, words};

/// A plan in the making.
pub(super) struct PlanBuilder<'a> {
    pub(super) view: &'a View,
    pub(super) status: SubmissionStatus,
    pub(super) actions: Vec<Action>,
    pub(super) events: Vec<Event>,
    pub(super) requeue: Option<Duration>,
    /// The end is published with the report.
    pub(super) needs_report: bool,
}

impl<'a> PlanBuilder<'a> {
    pub(super) fn new(view: &'a View) -> Self {
        let mut status = view.submission.status.clone().unwrap_or_default();
        status.observed_generation = view.submission.metadata.generation;
        Self {
            view,
            status,
            actions: Vec::new(),
            events: Vec::new(),
            requeue: None,
            needs_report: false,
        }
    }

    pub(super) fn submission(&self) -> &'a Submission {
        &self.view.submission
    }

    pub(super) fn spec(&self) -> &'a SubmissionSpec {
        &self.view.submission.spec
    }

    pub(super) fn leaderboard(&self) -> Option<&'a LeaderboardSpec> {
        self.view.leaderboard.as_ref().map(|l| &l.spec)
    }

    /// Name of the Job that the present attempt has or will have.
    pub(super) fn job_name(&self) -> String {
        job_name(
            self.submission().metadata.name.as_deref().unwrap_or_default(),
            &self.status,
        )
    }

    /// A person has handed the submission over: it takes up what is stored, by whatever program.
    pub(super) fn is_adopted(&self) -> bool {
        let annotations = self.submission().metadata.annotations.as_ref();
        annotations.is_some_and(|all| all.get(names::ANNOTATION_ADOPT).is_some_and(|text| text == "true"))
    }

    /// Nothing is written to EvalAI, where another program runs the submission too.
    pub(super) fn observes(&self) -> bool {
        self.leaderboard().is_some_and(LeaderboardSpec::observes)
    }

    pub(super) fn deadlines(&self) -> Deadlines {
        let track = self.status.track.as_deref().or(self.spec().track.as_deref());
        let of =
            |l: &LeaderboardSpec| effective::deadlines(l, l.tracks.iter().find(|t| Some(t.name.as_str()) == track));
        self.leaderboard().map(of).unwrap_or_default()
    }

    /// The first crash and the first fault of the infrastructure end a check, since they are what it is to show.
    pub(super) fn retries(&self) -> Retries {
        if !self.spec().check {
            return self.leaderboard().map(|l| l.retries).unwrap_or_default();
        }
        Retries {
            per_worker: 0,
            infrastructure: 0,
        }
    }

    /// The words of the kind of evaluation that is run.
    pub(super) fn words(&self) -> &'static Words {
        words(self.status.plan.as_ref())
    }

    pub(super) fn now(&self) -> Timestamp {
        self.view.now
    }

    pub(super) fn time(&self) -> Time {
        Time(self.view.now)
    }

    pub(super) fn is_deleting(&self) -> bool {
        self.submission().metadata.deletion_timestamp.is_some()
    }

    pub(super) fn has_finalizer(&self) -> bool {
        let finalizers = self.submission().metadata.finalizers.as_deref().unwrap_or_default();
        finalizers.iter().any(|f| f == names::FINALIZER_SUBMISSION)
    }

    /// A request to stop that is not a failure: a person's, EvalAI's, or the object's deletion. It holds for the whole attempt, unless a
    /// higher one is asked for.
    pub(super) fn is_cancelled(&self) -> bool {
        let is_stopping = self.status.times.stopping.is_some() && self.status.failure.is_none();
        (is_stopping && !self.is_followed()) || self.spec().cancel || self.is_deleting() || self.is_ended_in_evalai()
    }

    /// A higher attempt is asked for. It takes the place of a live one, once that has stored what it has reached.
    pub(super) fn is_followed(&self) -> bool {
        self.status.is_followed_by(self.spec().attempt)
    }

    /// A run is to stop for a higher attempt. One that has ended by itself is not asked to.
    fn is_to_be_followed(&self) -> bool {
        let pod = self.view.pod.as_ref();
        self.is_followed() && pod.is_none_or(|pod| pod.run_ended.is_none())
    }

    /// EvalAI's last report of it.
    pub(super) fn evalai_info(&self) -> Option<&'a EvalaiInfo> {
        self.view.evalai.as_ref()?.info.as_ref()
    }

    pub(super) fn is_ended_in_evalai(&self) -> bool {
        self.view.evalai.as_ref().is_some_and(|e| e.cancelled)
    }

    /// Nothing of this attempt's Job is to run any more.
    pub(super) fn is_to_stop(&self) -> bool {
        self.is_cancelled() || self.status.failure.is_some() || self.is_to_be_followed()
    }

    pub(super) fn is_finished(&self) -> bool {
        self.status.has_ended()
    }

    /// Its results count.
    pub(super) fn is_successful(&self) -> bool {
        self.status.state_of_conditions() == State::Finished
    }

    /// It is held back, or was when it ended here: its row in EvalAI and in the table may be another program's.
    pub(super) fn is_held(&self) -> bool {
        let accepted = self.status.condition(conditions::ACCEPTED);
        accepted.is_some_and(|c| c.status == "False" && c.reason == Reason::Foreign)
    }

    /// The table has a row for it: without a team's id, as a check has none, there is no key.
    pub(super) fn has_row(&self) -> bool {
        let team = self.status.team.as_ref();
        self.view.record.is_some() && team.is_some_and(|team| team.id.is_some())
    }

    /// How often the report of a live run is read.
    pub(super) fn period(&self) -> Duration {
        Duration::from_secs(self.leaderboard().map_or(10, |l| l.sync_period_seconds).unsigned_abs())
    }

    /// Its agents run, or have run and come back.
    pub(super) fn is_running(&self) -> bool {
        matches!(self.status.state_of_conditions(), State::Running | State::Resumed)
    }

    /// True if the present Job was there. Only then does its absence mean that it was deleted: a crash of the controller before
    /// its creation looks the same. A report proves the first Job of an attempt; that of a later one may be its predecessor's.
    pub(super) fn was_job_seen(&self) -> bool {
        self.status.times.scheduled.is_some() || (self.is_first_job() && self.view.report.ours().is_some())
    }

    /// True if the attempt has had no other Job than the present one.
    pub(super) fn is_first_job(&self) -> bool {
        self.status.retry == 0 && self.status.recreated == 0
    }

    /// Begins an attempt if a new one is requested: a first one, or a higher one after an end that is not Finished, or where no Job has to
    /// be stopped before. True if what this reconcile has read is of another attempt and can't be used.
    pub(super) fn begin_attempt(&mut self) -> bool {
        let wanted = self.spec().attempt;
        let is_first = self.status.attempt.is_none();
        let is_next = self.is_followed() && (self.is_finished() || self.is_without_job());
        if !is_first && !is_next {
            return false;
        }
        self.start_status(wanted);
        self.show_unannounced(wanted);
        // Without a status the world was seen as the first attempt's.
        !is_first || wanted != Attempt::FIRST
    }

    /// True if nothing of the attempt is there that could be stopped.
    fn is_without_job(&self) -> bool {
        let is_seen = matches!(self.view.job, ObservedJob::Ours(_) | ObservedJob::Created);
        self.status.job_name.is_none() && !is_seen
    }

    /// Begins the higher attempt in place of one whose run was stopped for it. EvalAI and the table hear of no end.
    pub(super) fn restart(&mut self) {
        let (before, wanted) = (self.status.attempt.unwrap_or_default(), self.spec().attempt);
        self.start_status(wanted);
        self.condition(conditions::FINISHED, Truth::False, Reason::Replacing, "");
        let message = format!("Attempt {before} was stopped; attempt {wanted} resumes from the results in S3.");
        self.show(Reason::Replacing, message);
        self.requeue_in(Duration::ZERO);
    }

    /// The status of a new attempt, with what was pinned and what earlier attempts reached.
    fn start_status(&mut self, wanted: Attempt) {
        let old = std::mem::take(&mut self.status);
        let failure = old.failure.as_ref();
        let is_lost = failure.is_some_and(|failure| failure.reason == Reason::InputMissing);
        // Objects that Pods from before a restore have stored belong to earlier attempts.
        let submission_uid = self.submission().metadata.uid.clone();
        let next = |plan: RunPlan| RunPlan {
            resume: true,
            submission_uid,
            ..plan
        };
        self.status = SubmissionStatus {
            observed_generation: self.submission().metadata.generation,
            attempt: Some(wanted),
            team: old.team,
            track: old.track,
            plan: old.plan.map(next),
            image: old.image,
            // One that the bucket has lost is fetched anew.
            input: old.input.filter(|_| !is_lost),
            progress: old.progress,
            score: old.score.map(Score::so_far),
            metrics: old.metrics,
            results_url: old.results_url,
            usage: old.usage,
            times: leaderboard_api::Times {
                submitted: old.times.submitted,
                ..Default::default()
            },
            ..Default::default()
        };
        self.condition(conditions::FINISHED, Truth::False, Reason::Preparing, "");
        self.show(Reason::Preparing, "The submission was just taken in.");
    }

    /// Shows that no message has announced an attempt: its row may have been edited by the participant.
    fn show_unannounced(&mut self, attempt: Attempt) {
        let record = Ingested::of(self.submission()).filter(|record| record.without_message.contains(&attempt));
        let Some(record) = record else { return };
        let message = format!(
            "Attempt {attempt} begins without a queue message: EvalAI's row has asked for it since {}. Only hosts can resume or \
             re-run, but participants can edit the row. Check who asked for it; cancel the submission if nobody did.",
            seconds(record.sent)
        );
        self.event(true, Reason::AttemptWithoutMessage, message);
    }

    pub(super) fn act(&mut self, action: Action) {
        self.actions.push(action);
    }

    pub(super) fn does(&self, is_meant: impl Fn(&Action) -> bool) -> bool {
        self.actions.iter().any(is_meant)
    }

    pub(super) fn event(&mut self, warning: bool, reason: impl Into<ReasonName>, message: impl Into<String>) {
        self.events.push(Event {
            warning,
            reason: reason.into(),
            message: message.into(),
        });
    }

    /// Asks for another look after this long, or sooner if somebody else wants so.
    pub(super) fn requeue_in(&mut self, delay: Duration) {
        self.requeue = Some(self.requeue.map_or(delay, |present| present.min(delay)));
    }

    /// Asks for another look, should nothing wake the submission before.
    pub(super) fn look_again(&mut self, wait: Wait) {
        self.requeue_in(wait.again());
    }

    /// Shows nothing new while an answer that was waited for so long may still come soon: it then costs no write. Returns whether it may.
    pub(super) fn waits_quietly(&mut self, wait: Wait, waited: Duration) -> bool {
        let left = wait.silence_left(waited);
        if let Some(left) = left {
            self.keeps_status();
            self.requeue_in(left);
        }
        left.is_some()
    }

    /// Asks for another look at this time.
    pub(super) fn requeue_at(&mut self, at: Timestamp) {
        let left = at.duration_since(self.now());
        self.requeue_in(Duration::try_from(left).unwrap_or_default() + Duration::from_millis(50));
    }

    /// True if this time is still to come; then it asks for another look at it.
    pub(super) fn waits_until(&mut self, at: Timestamp) -> bool {
        let waits = self.now() < at;
        if waits {
            self.requeue_at(at);
        }
        waits
    }

    pub(super) fn condition(&mut self, type_: &str, truth: Truth, reason: impl Into<ReasonName>, message: &str) {
        self.condition_at(&self.time(), type_, truth, reason, message);
    }

    /// Sets a condition that is what it is since this time.
    pub(super) fn condition_at(
        &mut self,
        since: &Time,
        type_: &str,
        truth: Truth,
        reason: impl Into<ReasonName>,
        message: &str,
    ) {
        let generation = self.status.observed_generation;
        conditions::set(
            &mut self.status.conditions,
            type_,
            truth,
            reason,
            message,
            generation,
            since,
        );
    }

    /// Remembers since when it has been blocked for one reason, and returns it: the condition's own time moves with its status alone.
    pub(super) fn blocked(&mut self, reason: Reason) -> Timestamp {
        let now = self.now();
        // A later time is that of a clock that was set back since: what is counted from it would not end.
        let known = self.blocked_since(reason).filter(|since| *since <= now);
        known.unwrap_or_else(|| {
            let since = BlockedSince {
                reason: reason.into(),
                time: self.time(),
            };
            self.status.blocked_since = Some(Box::new(since));
            now
        })
    }

    /// Shows why the submission is in its state.
    pub(super) fn show(&mut self, reason: impl Into<ReasonName>, message: impl Into<String>) {
        let message = message.into();
        self.status.reason = Some(reason.into());
        self.status.message = (!message.is_empty()).then(|| message.into());
    }

    /// Shows why it is not accepted.
    pub(super) fn refuse(&mut self, reason: Reason, message: &str) {
        self.condition(conditions::ACCEPTED, Truth::False, reason, message);
        self.show(reason, message);
    }

    /// Shows a live submission whose agents are gone and come back.
    pub(super) fn replacing(&mut self, message: &str) {
        if self.is_running() {
            self.condition(conditions::RUNNING, Truth::False, Reason::Replacing, "");
        }
        self.show(Reason::Replacing, message);
    }

    /// The message while the Leaderboard does not exist.
    pub(super) fn no_leaderboard(&self) -> String {
        let name = &self.spec().leaderboard_name;
        format!("There is no Leaderboard {name} in this namespace. Apply it, and the submission goes on.")
    }

    /// Shows that nothing moves. The first message is kept while the reason stays, so that a changing detail of an error
    /// (a time, a request id) is not a write to the API in each reconcile.
    pub(super) fn stall(&mut self, reason: Reason, message: &str) -> String {
        let known = self
            .status
            .condition(conditions::STALLED)
            .filter(|c| c.is_true() && c.reason == reason)
            .map(|c| c.message.to_string());
        let message = known.unwrap_or_else(|| message.to_owned());
        self.stall_with(reason, &message);
        message
    }

    /// Stalls with the words of this moment: for a cause that changes while the reason stays.
    pub(super) fn stall_with(&mut self, reason: Reason, message: &str) {
        self.blocked(reason);
        self.condition(conditions::STALLED, Truth::True, reason, message);
    }

    pub(super) fn moves(&mut self) {
        self.waits(Reason::NotStalled);
    }

    /// Shows that it waits for what comes without a person: it is not stalled.
    pub(super) fn waits(&mut self, reason: Reason) {
        self.status.blocked_since = None;
        self.condition(conditions::STALLED, Truth::False, reason, "");
    }

    /// Shows a wait that is a stall once it has lasted for so long.
    pub(super) fn stalls_after(&mut self, wait: Wait, reason: Reason, message: &str) {
        let until = wait.over_at(self.blocked(reason));
        if self.waits_until(until) {
            self.waits_since(reason, message);
        } else {
            self.stall_with(reason, message);
        }
    }

    /// Shows a wait, and remembers since when it has lasted.
    pub(super) fn waits_since(&mut self, reason: Reason, message: &str) {
        self.blocked(reason);
        self.condition(conditions::STALLED, Truth::False, reason, message);
    }

    /// Since when it is blocked for this reason.
    pub(super) fn blocked_since(&self, reason: Reason) -> Option<Timestamp> {
        let blocked = self.status.blocked_since.as_ref();
        let blocked = blocked.filter(|blocked| blocked.reason == reason);
        blocked.map(|blocked| blocked.time.0)
    }

    /// Shows nothing new: the status stays as it was observed, and nothing is published.
    pub(super) fn keeps_status(&mut self) {
        self.status = self.submission().status.clone().unwrap_or_default();
        self.events.clear();
    }

    /// Marks a failure that ends the attempt; the first one stands.
    pub(super) fn fail(&mut self, failure: Failure) {
        if self.status.failure.is_none() {
            self.status.failure = Some(Box::new(failure));
        }
    }

    /// Shows the end that the attempt has come to.
    pub(super) fn ends(&mut self, reason: impl Into<ReasonName>, message: &str) {
        let reason = reason.into();
        let has_succeeded = Truth::from(reason == Reason::Finished);
        self.condition(conditions::FINISHED, Truth::True, reason.clone(), message);
        self.condition(conditions::SUCCEEDED, has_succeeded, reason, "");
    }
}

/// Milliseconds since 1970, for people.
pub(super) fn seconds(milliseconds: i64) -> String {
    let at = Timestamp::from_millisecond(milliseconds).unwrap_or_default();
    format!("{at:.0}")
}
