//! A run under way: its Pod, its time, its report, and what EvalAI and the table hear of it.
//!
//! A Pod that waits for a node takes neither time nor GPUs; one that is prepared has its GPUs, and takes no time before its first agent. The
//! Pods of one Job share one time. An end is decided only on a report that was asked for after that end was seen: one that was asked for
//! before may lack what was stored last.

use std::time::Duration;

use jiff::Timestamp;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;

use super::failure::{self, charged};
use super::plan::{Action, EvalaiUpdate, Question, TableUpdate};
use super::status::PlanBuilder;
use super::waits::{Wait, after};
use super::workers::{agents_of, only_merges};
use super::{blame, cause, limits};
use crate::report_digest::{ReportDigest, clamp};
use crate::view::{ContainerView, ObservedJob, ObservedReport, PodView, ReportDemand, Stage, Standing, View};
use leaderboard_api::conditions::{self, Condition, Truth};
use leaderboard_api::text::sentence;
use leaderboard_api::{
    Failure, ImageReference, PinnedImage, Progress, Reason, Repository, Score, State, SubmissionStatus, WorkerStatus,
};
use leaderboard_contract::report::{Logs, Patience};

/// Takes in what Pod and report show.
pub(super) fn take_in(draft: &mut PlanBuilder<'_>) {
    let view = draft.view;
    if let Some(pod) = &view.pod {
        let known = draft.status.node_name.take();
        draft.status.node_name = pod.node.clone().or(known);
        take_node(draft, pod);
        take_agents(draft, pod);
        pin_digest(draft, pod);
        blame::note_crashes(&mut draft.status, pod, view.now);
    }
    if let Some(report) = view.report.ours() {
        take_report(draft, report);
    }
}

/// Ends a run under way for a full disk, agents with different images, crashes, time.
pub(super) fn watch(draft: &mut PlanBuilder<'_>) {
    let found = cause::disk_full(draft).or_else(|| image_changed(draft));
    if let Some(found) = found.or_else(|| blame::too_many(draft)) {
        return draft.fail(found);
    }
    // A run that outlives its Leaderboard has no limit that a host has set, and is charged for none. The Pod has a deadline of its own.
    let Some(ran) = run_seconds(draft).filter(|_| draft.leaderboard().is_some()) else {
        return;
    };
    let Some(limit) = draft.deadlines().run_seconds.filter(|_| !awaits_images(draft)) else {
        return;
    };
    if ran >= limit {
        let found = over_time(draft, limit);
        draft.fail(found);
    } else if goes_on(draft) {
        draft.requeue_at(after(draft.now(), limit - ran));
    }
}

/// True if the images of evaluators are pulled after an agent that runs first. That has a deadline of its own.
fn awaits_images(draft: &PlanBuilder<'_>) -> bool {
    let agents = agents_of(&draft.status);
    let pod = draft.view.pod.as_ref();
    pod.is_some_and(|pod| limits::awaits_evaluators(pod, agents) && !limits::copies_input(pod, agents))
}

/// The failure of a run that took longer than its limit: the hosts' own, where no agent was at work.
pub(super) fn over_time(draft: &PlanBuilder<'_>, limit: i64) -> Failure {
    let pod = draft.view.pod.as_ref();
    if limits::is_agents_time(pod, agents_of(&draft.status)) && !only_merges(&draft.status) {
        failure::time_limit(limit, draft.words())
    } else {
        failure::evaluators_late(limit, draft.words())
    }
}

/// Shows a live submission in EvalAI; each update is sent once, however often it is requested.
pub(super) fn update_evalai(draft: &mut PlanBuilder<'_>) {
    if draft.spec().evalai.is_none() {
        return;
    }
    if !draft.is_running() {
        // Between two tries EvalAI keeps saying running.
        if draft.status.times.started.is_none() {
            draft.act(Action::UpdateEvalai(EvalaiUpdate::Queued));
        }
        return;
    }
    draft.act(Action::UpdateEvalai(EvalaiUpdate::Running));
    let Some(report) = draft.view.report.ours() else { return };
    let evalai = draft.view.evalai.as_ref();
    if report.done > 0 && Some(report.done) != evalai.and_then(|evalai| evalai.partial_done) {
        // EvalAI keeps a partial result, and would show it as final of a row that its participant calls finished.
        let is_shown = evalai.is_some_and(|evalai| evalai.shows_partial);
        draft.act(Action::UpdateEvalai(EvalaiUpdate::Partial { is_shown }));
    }
}

/// Looks for its end in EvalAI, also while it waits and nothing is sent to EvalAI, whatever it waits for.
pub(super) fn follow(draft: &mut PlanBuilder<'_>) {
    // The time of its submission is taken with EvalAI's answer; without it nothing would be found.
    let is_known = draft.status.times.submitted.is_some();
    let may_run = is_known && draft.evalai_info().is_some_and(|info| info.standing != Standing::Ended);
    if draft.does(is_progress) || (may_run && !draft.is_finished() && !draft.is_to_stop()) {
        draft.act(Action::Ask(Question::EvalaisEnd));
    }
}

/// EvalAI learns that it is in line or runs.
fn is_progress(action: &Action) -> bool {
    matches!(
        action,
        Action::UpdateEvalai(EvalaiUpdate::Queued | EvalaiUpdate::Running)
    )
}

pub(super) fn record_progress(draft: &mut PlanBuilder<'_>) {
    if draft.has_row() {
        draft.act(Action::Record(TableUpdate::Progress));
    }
}

/// Takes the digest that the first agent runs, wherever its tag moves later.
fn pin_digest(draft: &mut PlanBuilder<'_>, pod: &PodView) {
    if draft.status.image.is_none() {
        let first = digests(&draft.status, pod).first().map(|digest| (*digest).to_owned());
        draft.status.image = first.map(|digest| PinnedImage { digest });
    }
}

/// Agents of one Pod run different images: their tag moved between two pulls.
fn image_changed(draft: &PlanBuilder<'_>) -> Option<Failure> {
    let found = digests(&draft.status, draft.view.pod.as_ref()?);
    let is_one = found.windows(2).all(|pair| pair[0] == pair[1]);
    let what = "The tag of the submitted image moved while the run started, so its agents would run different images.";
    (!is_one).then(|| charged(Reason::ImageChanged, what))
}

/// The digests of the submitted image that a Pod's agents run. A node may show an image under the name of another repository that has
/// the same content; such a digest proves nothing of this repository.
fn digests<'a>(status: &SubmissionStatus, pod: &'a PodView) -> Vec<&'a str> {
    let image = status.plan.as_ref().and_then(|plan| plan.image.as_deref());
    let Some(Ok(submitted)) = image.map(ImageReference::parse) else {
        return Vec::new();
    };
    let repository = Repository::of(&submitted);
    let digest = |agent: &'a ContainerView| {
        let image = ImageReference::parse(agent.image_id.as_deref()?).ok()?;
        let is_submitted = Repository::of(&image).is_same(&repository);
        image
            .digest
            .filter(|digest| is_submitted && digest.starts_with("sha256:"))
    };
    let agents = pod.containers.iter().filter(|container| container.is_agents());
    agents.filter_map(digest).collect()
}

/// The image as the Pods of the submission pull it.
pub fn pinned(image: &str, pinned: Option<&PinnedImage>) -> String {
    let Some(pinned) = pinned else {
        return image.to_owned();
    };
    let name = image.split('@').next().unwrap_or(image);
    let tag = ImageReference::parse(image).ok().and_then(|reference| reference.tag);
    let name = tag
        .and_then(|tag| name.strip_suffix(tag)?.strip_suffix(':'))
        .unwrap_or(name);
    format!("{name}@{}", pinned.digest)
}

/// Takes in how far the run is.
pub(super) fn take_report(draft: &mut PlanBuilder<'_>, report: &ReportDigest) {
    draft.status.progress = Some(Progress::new(clamp(report.done), clamp(report.total), &report.unit));
    let is_complete = report.is_final && report.done == report.total;
    if let Some(score) = report.score.clone() {
        draft.status.score = Some(Score::new(score, is_complete));
        draft.status.metrics.clone_from(&report.metrics);
    }
    let old = std::mem::take(&mut draft.status.workers);
    draft.status.workers = report
        .workers
        .iter()
        .map(|worker| {
            let known = old.iter().find(|k| k.id == clamp(worker.id));
            WorkerStatus {
                id: clamp(worker.id),
                done: clamp(worker.done),
                total: clamp(worker.total),
                // The kubelet counts them: a report can know of a crash before its end shows whose fault it was.
                crashes: known.map_or(0, |k| k.crashes),
                state: worker.state,
                last: known.and_then(|k| k.last.clone()),
                ended_from_outside: known.map_or(0, |k| k.ended_from_outside),
                environment_failed: known.is_some_and(|k| k.environment_failed),
            }
        })
        .collect();
    note_scores(draft, report);
    note_logs(draft, report);
}

/// A report of before a restore may be of a later attempt than the object knows of. The table's row counts on from it.
pub(super) fn count_attempts(draft: &mut PlanBuilder<'_>) {
    let present = draft.status.attempt.unwrap_or_default();
    let (Some(report), Some(plan)) = (draft.view.report.ours(), draft.status.plan.as_mut()) else {
        return;
    };
    let ahead = report.attempt.0.saturating_sub(present.0);
    plan.earlier_attempts = plan.earlier_attempts.max(ahead);
}

/// True if a report can be of the present Job, rather than of one before it whose end is settled: it stays where it is until the present
/// Job's first round. The Pod decides. Without one, what was stopped is the present Job's only if that is being ended too.
pub(super) fn is_of_present_job(draft: &PlanBuilder<'_>, report: &ReportDigest) -> bool {
    draft.is_first_job()
        || match &draft.view.pod {
            Some(pod) => pod.uid == report.pod_uid,
            None => report.stopped.is_none() || draft.is_to_stop(),
        }
}

/// Reports that scores do not follow from the infractions, and that they do again.
fn note_scores(draft: &mut PlanBuilder<'_>, report: &ReportDigest) {
    let (truth, reason, message) = match &report.warning {
        Some(first) => {
            let message = format!("Scores do not follow from the infractions: {}", sentence(first));
            (Truth::False, Reason::UnexplainedScores, message)
        }
        None if draft.status.condition(conditions::PLAUSIBLE).is_none() => return,
        None => (Truth::True, Reason::ScoresExplained, String::new()),
    };
    draft.condition(conditions::PLAUSIBLE, truth, reason, &message);
}

/// Reports that CloudWatch refuses the lines of the run, and that it takes them again.
fn note_logs(draft: &mut PlanBuilder<'_>, report: &ReportDigest) {
    let is_known = draft.status.condition(conditions::LOGGED).is_some();
    match &report.logs {
        Some(Logs::Refused(why)) => {
            let why = sentence(why);
            draft.condition(conditions::LOGGED, Truth::False, Reason::LogsRefused, &why);
        }
        Some(Logs::Sent) if is_known => {
            draft.condition(conditions::LOGGED, Truth::True, Reason::LogsSent, "");
        }
        _ => {}
    }
}

/// Which report the present state of the run needs.
pub(super) fn demand(draft: &PlanBuilder<'_>) -> Option<ReportDemand> {
    let status = &draft.status;
    status.plan.as_ref()?;
    let stage = if draft.is_finished() {
        draft.needs_report.then(|| stage_after_end(draft))?
    } else {
        stage_of_live(draft)?
    };
    Some(ReportDemand {
        job: status.job_number(),
        pod: draft.view.pod.as_ref().map(|pod| pod.uid.as_str().into()),
        stage,
        period: draft.period(),
    })
}

/// An end that was decided on a complete run waits for its Job no more.
fn stage_after_end(draft: &PlanBuilder<'_>) -> Stage {
    let is_live = draft.view.job.ours().is_some_and(|job| job.end.is_none());
    let has_ended = draft.view.pod.as_ref().is_some_and(|pod| pod.run_ended.is_some());
    if is_live && has_ended && draft.is_successful() {
        Stage::RunEnded
    } else {
        Stage::JobEnded
    }
}

fn stage_of_live(draft: &PlanBuilder<'_>) -> Option<Stage> {
    draft.status.job_name.as_ref()?;
    match &draft.view.job {
        ObservedJob::Ours(job) if job.end.is_some() => Some(Stage::JobEnded),
        ObservedJob::Ours(_) if draft.view.pod.as_ref().is_some_and(|pod| pod.run_ended.is_some()) => {
            Some(Stage::RunEnded)
        }
        ObservedJob::Ours(_) => draft.status.times.scheduled.as_ref().map(|_| Stage::Live),
        ObservedJob::Created => None,
        // One that is created only now is not there either, and what is stored is not its own.
        ObservedJob::Absent { .. } if draft.does(|action| matches!(action, Action::CreateJob(_))) => None,
        // The report shows if the first Job of an attempt was there.
        ObservedJob::Absent { .. } if draft.is_first_job() => Some(Stage::JobEnded),
        ObservedJob::Absent { .. } | ObservedJob::Foreign => {
            (draft.is_to_stop() || draft.was_job_seen()).then_some(Stage::JobEnded)
        }
    }
}

/// True if the report that is known was asked for at this stage of the run, or later.
pub(super) fn is_of(draft: &PlanBuilder<'_>, stage: Stage) -> bool {
    draft.view.report.stage >= Some(stage)
}

/// How long is still waited for an answer before anything is shown.
pub(super) fn answer_left(draft: &PlanBuilder<'_>) -> Option<Duration> {
    Wait::REPORT.silence_left(draft.view.report.waited)
}

/// Asks for the report of an ended run. Ok if as much is read as there ever will be; else it is being read, or cannot be read and why.
pub(super) fn report_of_end(draft: &mut PlanBuilder<'_>) -> Result<(), Option<String>> {
    // A submission that never had a Job has stored nothing.
    if draft.status.plan.is_none() || !draft.status.has_run() {
        return Ok(());
    }
    draft.needs_report = true;
    let view = draft.view;
    let is_read = is_of(draft, stage_after_end(draft)) && view.report.stored != ObservedReport::NotRead;
    // A Finished submission needs its result.
    if !draft.is_successful() && !may_wait(draft) {
        return Ok(());
    }
    match &view.report.stored {
        _ if !is_read => Err(None),
        ObservedReport::Unreadable(why) => Err(Some(why.clone())),
        _ => Ok(()),
    }
}

/// True if an end is still to be sent to EvalAI, with the texts that were read.
pub fn awaits_publication(status: &SubmissionStatus) -> bool {
    let published = status.condition(conditions::PUBLISHED);
    let is_open = |c: &Condition| c.reason != Reason::Refused && !status.is_delivered(conditions::PUBLISHED);
    status.has_ended() && published.is_some_and(is_open)
}

/// Deadlines of the wait for results that cannot be read, or cannot be used. A Finished submission waits without a limit.
pub fn patience(view: &View, status: &SubmissionStatus) -> Patience {
    let unread = waits_until(view, status, Wait::UNREAD);
    let is_successful = status.state_of_conditions() == State::Finished;
    Patience {
        unfit: waits_until(view, status, Wait::UNFIT),
        unread,
        report: if is_successful { Timestamp::MAX } else { unread },
    }
}

/// True if an end that is published once waits for its result: so long after it was decided, and not until the finalizer gives up.
fn may_wait(draft: &PlanBuilder<'_>) -> bool {
    draft.now() < waits_until(draft.view, &draft.status, Wait::UNREAD)
}

fn waits_until(view: &View, status: &SubmissionStatus, wait: Wait) -> Timestamp {
    let end = status.condition(conditions::FINISHED);
    let patience = wait.over_at(end.map_or(view.now, |c| c.last_transition_time.0));
    let Some(deleted) = &view.submission.metadata.deletion_timestamp else {
        return patience;
    };
    let leaderboard = view.leaderboard.as_ref();
    let seconds = leaderboard.map_or(0, |leaderboard| leaderboard.spec.deadlines.finalize_seconds);
    patience.min(after(deleted.0, seconds - Wait::BEFORE_RELEASE.longest))
}

/// Notes when the Pod got its node, and counts the run and the use of the Pod before it.
fn take_node(draft: &mut PlanBuilder<'_>, pod: &PodView) {
    let Some(scheduled) = pod.scheduled else { return };
    if let Some(before) = scheduled_at(draft) {
        let is_another = scheduled > before && pod.created.is_some_and(|made| made > before);
        if !is_another {
            return;
        }
        let lost = lost_at(draft, before);
        draft.status.ran_seconds += began_at(draft).map_or(0, |began| seconds_between(began, lost));
        count_use(draft, lost);
        draft.status.times.agent_started = None;
    }
    draft.status.times.scheduled = Some(Time(scheduled));
}

/// Notes when the first agent of the attempt started, and that of its present Pod. The time that a Pod shows moves when its
/// containers are started again.
fn take_agents(draft: &mut PlanBuilder<'_>, pod: &PodView) {
    let Some(first) = pod.agent_started.map(Time) else {
        return;
    };
    let is_known = began_at(draft).is_some();
    let times = &mut draft.status.times;
    if !is_known && times.agent_started.is_none() {
        times.agent_started = Some(first.clone());
    }
    if times.started.is_none() {
        times.started = Some(first);
    }
}

/// The present Job is gone, and another one begins anew.
pub(super) fn restart_clock(draft: &mut PlanBuilder<'_>) {
    draft.status.times.scheduled = None;
    draft.status.times.agent_started = None;
    draft.status.ran_seconds = 0;
}

/// How long the present Job has run; None before its first agent.
fn run_seconds(draft: &PlanBuilder<'_>) -> Option<i64> {
    let before = draft.status.ran_seconds;
    let Some(began) = began_at(draft) else {
        return (before > 0).then_some(before);
    };
    let until = counted_until(draft, draft.now());
    Some(before.saturating_add(seconds_between(began, until)))
}

/// Counts what the present Pod of the Job has used, from its scheduling until its end.
pub(super) fn count_use(draft: &mut PlanBuilder<'_>, end: Timestamp) {
    let end = counted_until(draft, end);
    if let (Some(scheduled), Some(usage)) = (scheduled_at(draft), draft.status.usage.as_mut()) {
        usage.add(seconds_between(scheduled, end));
    }
}

/// True if the run takes time at present: the Pod that is there has a node, and an agent of it has started.
fn goes_on(draft: &PlanBuilder<'_>) -> bool {
    has_node(draft) && began_at(draft).is_some()
}

fn has_node(draft: &PlanBuilder<'_>) -> bool {
    draft.view.pod.as_ref().is_some_and(|pod| pod.scheduled.is_some())
}

fn scheduled_at(draft: &PlanBuilder<'_>) -> Option<Timestamp> {
    draft.status.times.scheduled.as_ref().map(|time| time.0)
}

/// From when on the Pod that had a node last takes time: its first agent. Its clock may be behind that of its scheduling.
fn began_at(draft: &PlanBuilder<'_>) -> Option<Timestamp> {
    let times = &draft.status.times;
    let started = times.started.as_ref()?.0;
    let Some(scheduled) = scheduled_at(draft) else {
        return draft.is_first_job().then_some(started);
    };
    // An operator before this field has left it out: the attempt's first agent is that of this Pod if the Pod had its node before.
    let older = (started >= scheduled).then_some(started);
    let agent = times.agent_started.as_ref().map(|time| time.0).or(older)?;
    Some(agent.max(scheduled))
}

/// The end of what runs: it has ended with the Pod that had a node, if none has one.
fn counted_until(draft: &PlanBuilder<'_>, end: Timestamp) -> Timestamp {
    match scheduled_at(draft) {
        Some(scheduled) if !has_node(draft) => end.min(lost_at(draft, scheduled)),
        _ => end,
    }
}

/// When the Pod was lost that had got its node at that time: its successor was made then, or it was seen that its agents no longer
/// ran; else now.
fn lost_at(draft: &PlanBuilder<'_>, scheduled: Timestamp) -> Timestamp {
    let made = draft.view.pod.as_ref().and_then(|pod| pod.created);
    let running = draft.status.condition(conditions::RUNNING);
    let stopped = running
        .filter(|running| !running.is_true())
        .map(|running| running.last_transition_time.0);
    let known = [made, stopped].into_iter().flatten().filter(|at| *at > scheduled);
    known.min().unwrap_or(draft.now())
}

fn seconds_between(from: Timestamp, until: Timestamp) -> i64 {
    until.duration_since(from).as_secs().max(0)
}
