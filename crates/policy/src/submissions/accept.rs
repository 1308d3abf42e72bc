//! Acceptance: a Leaderboard, EvalAI's word, a team, a track, and an image or a file. Then the plan is pinned: what is run stays as it was
//! accepted, however the Leaderboard is edited.

use std::time::Duration;

use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;

use super::end;
use super::failure::{charged, participant};
use super::gates;
use super::plan::{Action, Question};
use super::status::PlanBuilder;
use super::waits::Wait;
use crate::view::Standing;
use leaderboard_api::conditions::{self, Truth};
use leaderboard_api::evalai_status::Status;
use leaderboard_api::text::{LONGEST_NAME, one_line, sentence};
use leaderboard_api::{
    Attempt, ContainerEvaluation, Evaluation, Failure, ImagePattern, ImageReference, LeaderboardSpec, Reason,
    Repository, RunPlan, Team, TeamStatus, Track, effective, image_pattern,
};

/// Pins the plan and returns true if the submission may go on to its turn. Otherwise the draft shows why not. EvalAI's own end goes before all
/// that it may wait for, and the look for another program before anything that could end it: an end is written over what that one writes.
pub(super) fn decide(draft: &mut PlanBuilder<'_>) -> bool {
    let Some(leaderboard) = draft.leaderboard() else {
        let message = draft.no_leaderboard();
        draft.refuse(Reason::LeaderboardNotFound, &message);
        return false;
    };
    // Before anything of it is looked at: the bucket and the table may be somebody else's.
    if let Some(why) = &draft.view.not_allowed {
        let message = gates::leaderboard_not_ready(draft, Reason::NotAllowed, why);
        draft.refuse(Reason::LeaderboardNotReady, &message);
        return false;
    }
    if !is_wanted(draft) {
        return false;
    }
    take_team(draft);
    let Some(track) = find_track(draft, leaderboard) else {
        let message = missing_track(draft, leaderboard);
        draft.refuse(Reason::TrackNotFound, &message);
        return false;
    };
    draft.status.track = Some(track.name.clone());
    if gates::waits_for_other_program(draft) || gates::waits_for_phase(draft) {
        return false;
    }
    let image = match brought(draft, leaderboard) {
        Ok(image) => image,
        Err(untaken) => {
            show_untaken(draft, leaderboard, track, untaken);
            return false;
        }
    };
    if gates::waits_for_leaderboard(draft) || gates::waits_for_policy(draft) {
        return false;
    }
    if !pin(draft, leaderboard, track, image) {
        return false;
    }
    if let Some(file) = &draft.spec().input {
        draft.status.input = Some(file.clone());
    }
    draft.condition(conditions::ACCEPTED, Truth::True, Reason::Accepted, "");
    draft.condition(conditions::SUCCEEDED, Truth::Unknown, Reason::InProgress, "");
    true
}

/// Why what a submission brings is not taken.
enum Untaken {
    /// It could not be asked for yet.
    Unread,
    /// It can never run.
    Never { image: Option<String>, found: Box<Failure> },
}

impl Untaken {
    fn never(image: Option<String>, found: Failure) -> Self {
        let found = Box::new(found);
        Self::Never { image, found }
    }
}

/// The image of the submission, which the Leaderboard allows; None of one that is a file.
fn brought(draft: &PlanBuilder<'_>, leaderboard: &LeaderboardSpec) -> Result<Option<String>, Untaken> {
    let pinned = draft.status.plan.as_ref();
    if pinned.is_some_and(|pinned| !is_of_kind(pinned, leaderboard)) {
        // Nobody has submitted to what the Leaderboard is now, which `pin` shows.
        return Ok(None);
    }
    let takes_files = leaderboard.evaluation.container().filter(|of| !of.mode.has_agent());
    if let Some(evaluation) = takes_files {
        let fault = file_not_allowed(draft, evaluation);
        return fault.map_or(Ok(None), |found| Err(Untaken::never(None, found)));
    }
    if draft.spec().input.is_some() {
        let what = "This leaderboard takes container images, and the submission is a file.";
        let found = participant(Reason::InputInvalid, what, "Submit a container image.");
        return Err(Untaken::never(None, found));
    }
    let image = named_image(draft)?;
    match image_not_allowed(draft, leaderboard, &image) {
        Some(found) => Err(Untaken::never(Some(image), found)),
        None => Ok(Some(image)),
    }
}

/// Why a Leaderboard of files does not take the submission.
fn file_not_allowed(draft: &PlanBuilder<'_>, evaluation: &ContainerEvaluation) -> Option<Failure> {
    if draft.spec().image.is_some() {
        let what = "This leaderboard takes files, and the submission is a container image.";
        return Some(participant(Reason::InputInvalid, what, "Submit a file."));
    }
    let file = draft.spec().input.as_ref().filter(|_| !draft.status.has_run())?;
    let limit = evaluation.input_bounds().max_bytes.bytes();
    let is_within = u64::try_from(file.size).is_ok_and(|size| size <= limit);
    (!is_within).then(|| gates::input::too_large(limit))
}

/// Shows why a submission is not taken. One that can never run is ended: the plan makes it a row of the table, as any other failure.
fn show_untaken(draft: &mut PlanBuilder<'_>, leaderboard: &LeaderboardSpec, track: &Track, untaken: Untaken) {
    match untaken {
        Untaken::Unread => {
            let message = image_unread(draft);
            draft.stall_with(Reason::ImageMissing, &message);
            draft.refuse(Reason::ImageMissing, &message);
        }
        Untaken::Never { image, found } => {
            if pin(draft, leaderboard, track, image) {
                draft.condition(conditions::ACCEPTED, Truth::False, found.reason.clone(), &found.message);
                end::failed(draft, *found);
            }
        }
    }
}

/// The message for a row that has come to its end without us. EvalAI resumes only what has failed, re-runs all but what was deleted,
/// and counts what was deleted before its end as being processed until it is ended.
fn ended_in_evalai(status: Status) -> String {
    let done = if status == Status::Deleted {
        "`cancelled` is written there"
    } else {
        "nothing is reported"
    };
    let next = match status {
        Status::Failed => "Resume it there if it is to run.",
        Status::Deleted | Status::Ignored | Status::Missing => {
            "EvalAI takes up nothing that was deleted; the participant can submit again."
        }
        _ => "EvalAI resumes only what has failed; re-run it there if it is to run.",
    };
    format!("EvalAI shows {status}: nothing is run and {done}. {next}")
}

/// The image that was pinned, else the object's, else that of the file in EvalAI.
fn named_image(draft: &PlanBuilder<'_>) -> Result<String, Untaken> {
    let info = draft.evalai_info();
    let pinned = draft.status.plan.as_ref().and_then(|plan| plan.image.clone());
    let named = pinned
        .filter(|image| !image.is_empty())
        .or_else(|| draft.spec().image.clone())
        .or_else(|| info.and_then(|i| i.image.clone()));
    let Some(image) = named else {
        let why = info.and_then(|i| i.image_problem.as_deref()).ok_or(Untaken::Unread)?;
        let what = sentence(&format!("The submission names no usable image: {why}"));
        return Err(Untaken::never(None, charged(Reason::ImageInvalid, &what)));
    };
    if let Err(why) = ImageReference::parse(&image) {
        let what = sentence(&format!("The submitted image is not a valid image reference: {why}"));
        return Err(Untaken::never(Some(image), charged(Reason::ImageInvalid, &what)));
    }
    Ok(image)
}

/// The message while the file in EvalAI cannot be read.
fn image_unread(draft: &PlanBuilder<'_>) -> String {
    let why = last_failure(draft);
    format!(
        "The image is not known: spec.image is empty, and the file in EvalAI that names it could not be read; it is tried \
         again.{why} If this lasts, check that EvalAI serves the submission's input_file."
    )
}

/// True if EvalAI wants the submission to run, or need not be asked.
fn is_wanted(draft: &mut PlanBuilder<'_>) -> bool {
    if draft.spec().evalai.is_none() {
        return true;
    }
    if let Some(info) = draft.evalai_info() {
        if info.standing == Standing::Ended {
            end::close_as(draft, Reason::EndedInEvalAI, &ended_in_evalai(info.status));
        }
        return info.standing != Standing::Ended;
    }
    draft.act(Action::Ask(Question::Evalai));
    let view = draft.view.evalai.as_ref();
    if draft.waits_quietly(Wait::EVALAI, view.map_or(Duration::ZERO, |evalai| evalai.waited)) {
        return false;
    }
    draft.look_again(Wait::EVALAI);
    let why = last_failure(draft);
    let mut message = format!("EvalAI is asked whether the submission wants to run.{why}");
    if !why.is_empty() {
        message = draft.stall(Reason::AskingEvalAI, &message);
    }
    draft.show(Reason::AskingEvalAI, message);
    draft.condition(conditions::ACCEPTED, Truth::Unknown, Reason::AskingEvalAI, "");
    false
}

/// Why the last request to EvalAI failed, after a blank; empty if it did not.
fn last_failure(draft: &PlanBuilder<'_>) -> String {
    let error = draft.view.evalai.as_ref().and_then(|view| view.error.as_deref());
    error.map_or_else(String::new, |e| format!(" The last request failed: {}", sentence(e)))
}

fn find_track<'a>(draft: &PlanBuilder<'_>, leaderboard: &'a LeaderboardSpec) -> Option<&'a Track> {
    match (&draft.spec().evalai, &draft.spec().track) {
        (Some(evalai), _) => leaderboard.tracks.iter().find(|t| t.phase == Some(evalai.phase)),
        (None, Some(name)) => leaderboard.tracks.iter().find(|t| t.name == *name),
        (None, None) => None,
    }
}

fn missing_track(draft: &PlanBuilder<'_>, leaderboard: &LeaderboardSpec) -> String {
    let known: Vec<&str> = leaderboard.tracks.iter().map(|t| t.name.as_str()).collect();
    let what = match (&draft.spec().evalai, &draft.spec().track) {
        (Some(evalai), _) => format!("No track has the phase {}", evalai.phase),
        (None, track) => format!("There is no track {}", track.as_deref().unwrap_or("")),
    };
    format!(
        "{what} in Leaderboard {}, whose tracks are {}. Add it there, or cancel this submission.",
        draft.spec().leaderboard_name,
        known.join(", ")
    )
}

/// A team of a Submission as people see it: anybody who may create one writes its name.
fn shown(team: &Team) -> Team {
    let line = |text: &Option<String>| text.as_deref().map(|text| one_line(text, LONGEST_NAME));
    Team {
        id: line(&team.id),
        name: line(&team.name),
    }
}

fn take_team(draft: &mut PlanBuilder<'_>) {
    let info = draft.evalai_info();
    let given = draft.spec().team.as_ref().map(shown);
    let is_pinned = draft.status.plan.is_some() && draft.status.team.is_some();
    if is_pinned {
        // A row that is edited later changes neither the run's place in line nor its row of the table.
    } else if let Some(info) = info {
        let name = given.and_then(|t| t.name).or_else(|| info.team_name.clone());
        let id = Some(info.team_id.clone());
        draft.status.team = Some(Team { id, name }.into());
    } else if given.is_some() {
        draft.status.team = given.map(TeamStatus::from);
    }
    let submitted = info.and_then(|info| info.submitted_at).map(Time);
    let created = draft.submission().metadata.creation_timestamp.clone();
    let known = draft.status.times.submitted.take();
    draft.status.times.submitted = known.or(submitted).or(created);
}

/// Why the Leaderboard does not allow the image.
fn image_not_allowed(draft: &PlanBuilder<'_>, leaderboard: &LeaderboardSpec, image: &str) -> Option<Failure> {
    let reference = ImageReference::parse(image).ok().filter(|_| !draft.status.has_run())?;
    let repository = Repository::of(&reference);
    let own = leaderboard.host_images();
    let is_hosts = own
        .into_iter()
        .any(|own| ImageReference::parse(own).is_ok_and(|own| Repository::of(&own).is_same(&repository)));
    let team = draft.status.team.as_ref().and_then(|team| team.id.as_deref());
    let patterns = image_patterns(draft, leaderboard);
    let is_allowed = patterns
        .as_ref()
        .is_none_or(|all| all.iter().any(|p| p.allows(&repository, team)))
        || is_check_image(draft, leaderboard, &repository);
    if is_allowed && !is_hosts {
        return None;
    }
    let what = "The submitted image is not one that your team may submit to this leaderboard.";
    Some(charged(Reason::ImageNotAllowed, what))
}

/// True if a check runs what its Leaderboard names for that.
fn is_check_image(draft: &PlanBuilder<'_>, leaderboard: &LeaderboardSpec, repository: &Repository<'_>) -> bool {
    let named = leaderboard.check.as_ref().filter(|_| draft.spec().check);
    let named = named.and_then(|check| ImageReference::parse(&check.image).ok());
    named.is_some_and(|named| Repository::of(&named).is_same(repository))
}

/// Patterns of the images that may be submitted; None: all may.
fn image_patterns(draft: &PlanBuilder<'_>, leaderboard: &LeaderboardSpec) -> Option<Vec<ImagePattern>> {
    match &leaderboard.agent.images {
        Some(images) if images.is_empty() => None,
        Some(images) => Some(images.clone()),
        None => {
            let of_evalai = || vec![ImagePattern(image_pattern::OF_EVALAI.to_owned())];
            draft.spec().evalai.is_some().then(of_evalai)
        }
    }
}

/// Pins the plan. False, with the reason shown, if the Leaderboard of today can't run the submission.
fn pin(draft: &mut PlanBuilder<'_>, leaderboard: &LeaderboardSpec, track: &Track, image: Option<String>) -> bool {
    let plan = match &draft.status.plan {
        Some(pinned) if is_of_kind(pinned, leaderboard) => Ok(again(draft, leaderboard, pinned.clone(), image)),
        Some(_) => Err(
            "It was made anew with another kind of evaluation than the submission was accepted for. Cancel this submission.".to_owned(),
        ),
        None => first_plan(draft, leaderboard, track, image)
            .ok_or_else(|| format!("Its track {} names no score. Set container.score of the track.", track.name)),
    };
    let plan = match plan {
        Ok(plan) => plan,
        Err(why) => {
            let name = &draft.spec().leaderboard_name;
            let message = format!("Leaderboard {name} can't run the submission. {why}");
            draft.refuse(Reason::TrackNotFound, &message);
            return false;
        }
    };
    draft.status.results_url = Some(effective::results_url(&plan.storage.s3, &plan.run_id));
    draft.status.plan = Some(plan);
    let now = draft.time();
    draft.status.times.accepted.get_or_insert(now);
    true
}

/// The plan of a submission that has none; `None` for a track without what its kind of evaluation needs.
fn first_plan(
    draft: &PlanBuilder<'_>,
    leaderboard: &LeaderboardSpec,
    track: &Track,
    image: Option<String>,
) -> Option<RunPlan> {
    let resumed = draft.evalai_info().is_some_and(|i| i.standing == Standing::Resumed);
    let resume = resumed || draft.spec().attempt > Attempt::FIRST || draft.is_adopted();
    let plan = effective::plan(leaderboard, track, draft.submission().run_id(), image, resume)?;
    let plan = if draft.spec().check { plan.of_check() } else { plan };
    Some(RunPlan {
        earlier_attempts: attempts_before(draft),
        submission_uid: draft.submission().metadata.uid.clone(),
        ..plan
    })
}

/// True if a plan is of the kind of evaluation that the Leaderboard has, and of its mode.
fn is_of_kind(plan: &RunPlan, leaderboard: &LeaderboardSpec) -> bool {
    match &leaderboard.evaluation {
        Evaluation::Carla(_) => plan.carla().is_some(),
        Evaluation::Container(now) => plan.container().is_some_and(|pinned| pinned.mode == now.mode),
    }
}

/// The plan of a submission that has one. A person who hands it over has it take up what is stored.
fn again(draft: &PlanBuilder<'_>, leaderboard: &LeaderboardSpec, pinned: RunPlan, image: Option<String>) -> RunPlan {
    let pinned = RunPlan {
        resume: pinned.resume || draft.is_adopted(),
        ..pinned
    };
    if draft.status.retry > 0 || draft.status.job_name.is_some() {
        return pinned;
    }
    // The host's images belong to the attempt and follow the Leaderboard until its first Job is made; all else belongs to the submission.
    RunPlan {
        // It changes only if an earlier attempt had none.
        image,
        ..pinned.renewed(leaderboard)
    }
}

/// How many attempts the table's row counts before those of an object that was made anew, as EvalAI's row names their Jobs: the table takes
/// no attempt that is not above its own. An object with a history asks the table alone, since participants can edit EvalAI's row.
fn attempts_before(draft: &PlanBuilder<'_>) -> i64 {
    let is_new = draft.spec().attempt == Attempt::FIRST;
    let resumed = draft
        .evalai_info()
        .filter(|info| is_new && info.standing == Standing::Resumed);
    resumed.and_then(|info| info.last_attempt).map_or(0, |last| last.0)
}
