//! Acceptance: a Leaderboard, a track, an image, and EvalAI's word that the submission wants to run. Then the plan is pinned.

use std::time::Duration;

use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;

use super::failure::{self, infrastructure};
use super::isolation::Missing;
use super::plan::{Action, Question};
use super::status::{PlanBuilder, Terms};
use super::waits::Wait;
use super::{end, gates, image, isolation, pin};
use crate::controller::submissions::view::{EvalaiInfo, Standing};
use crate::services::evalai::Status;
use leaderboard_api::conditions::{self, Truth};
use leaderboard_api::text::{LONGEST_NAME, one_line, sentence};
use leaderboard_api::{Failure, ImageReference, LeaderboardSpec, Team, TeamStatus, Track, reasons};

/// Whether the submission may go on to its turn. Otherwise the draft shows why not. EvalAI's own end goes before all that it may
/// wait for.
pub(super) fn decide(draft: &mut PlanBuilder<'_>) -> bool {
    let Some(leaderboard) = draft.leaderboard() else {
        let message = no_leaderboard(draft);
        return refuse(draft, reasons::LEADERBOARD_NOT_FOUND, &message);
    };
    // Before anything of it is looked at: the bucket and the table may be somebody else's.
    if let Some(why) = &draft.view.not_allowed {
        let message = leaderboard_not_ready(draft, reasons::NOT_ALLOWED, why);
        return refuse(draft, reasons::LEADERBOARD_NOT_READY, &message);
    }
    let info = match ask_evalai(draft) {
        Answer::NotNeeded => None,
        Answer::Waiting => return false,
        Answer::Ended(status) => {
            end::cancelled(draft, reasons::ENDED_IN_EVALAI, &ended_in_evalai(status));
            return false;
        }
        Answer::Wanted(info) => Some(info),
    };
    take_team(draft, info);
    let Some(track) = find_track(draft, leaderboard) else {
        let message = missing_track(draft, leaderboard);
        return refuse(draft, reasons::TRACK_NOT_FOUND, &message);
    };
    draft.status.track = Some(track.name.clone());
    let terms = Terms {
        leaderboard,
        track,
        info,
    };
    // Before anything that could end it comes the look for another program: an end is written over what that one writes.
    if gates::waits(draft, terms) || waits_for_phase(draft, info) {
        return false;
    }
    decide_run(draft, terms)
}

/// Whether a submission that is wanted, and that nobody else runs, may go on to its turn.
fn decide_run(draft: &mut PlanBuilder<'_>, terms: Terms<'_>) -> bool {
    let Some(image) = allowed_image(draft, terms) else {
        return false;
    };
    if let Some(message) = not_ready(draft) {
        return refuse(draft, reasons::LEADERBOARD_NOT_READY, &message);
    }
    if let Some(missing) = isolation::missing(draft) {
        return wait_for_policy(draft, &missing);
    }
    pin::pin(draft, terms, image);
    draft.condition(conditions::ACCEPTED, Truth::True, reasons::ACCEPTED, "");
    true
}

/// The image, if one is named that the Leaderboard allows. Otherwise the draft shows why not.
fn allowed_image(draft: &mut PlanBuilder<'_>, terms: Terms<'_>) -> Option<String> {
    let (image, fault) = match named_image(draft, terms.info) {
        Image::Named(image) => {
            let fault = image::not_allowed(draft, terms.leaderboard, &image);
            (image, fault)
        }
        Image::Invalid { image, what } => (image, Some(failure::image_invalid(&what))),
        Image::Unknown => {
            let message = image_unread(draft);
            draft.stall_with(reasons::IMAGE_MISSING, &message);
            refuse(draft, reasons::IMAGE_MISSING, &message);
            return None;
        }
    };
    if let Some(found) = fault {
        refuse_image(draft, terms, image, found);
        return None;
    }
    Some(image)
}

/// Ends a submission whose image can never run. The plan makes it a row of the table, as any other failure.
fn refuse_image(draft: &mut PlanBuilder<'_>, terms: Terms<'_>, image: String, found: Failure) -> bool {
    pin::pin(draft, terms, image);
    draft.condition(conditions::ACCEPTED, Truth::False, &found.reason, &found.message);
    end::failed(draft, found);
    false
}

/// A Leaderboard and its first submission may come together: that the policy takes a moment then is no news.
fn wait_for_policy(draft: &mut PlanBuilder<'_>, missing: &Missing) -> bool {
    let created = draft.submission().metadata.creation_timestamp.as_ref();
    let until = Wait::POLICY.shown_at(created.map_or(draft.now(), |time| time.0));
    if draft.now() < until && !missing.is_refused {
        draft.requeue_at(until);
        return refuse(draft, reasons::PREPARING, &missing.message);
    }
    refuse(draft, reasons::NOT_ISOLATED, &missing.message)
}

/// What is shown of a row that has come to its end without us. EvalAI resumes only what has failed, re-runs all but what was deleted,
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

/// What is shown while the Leaderboard does not exist.
pub(super) fn no_leaderboard(draft: &PlanBuilder<'_>) -> String {
    let name = &draft.spec().leaderboard_name;
    format!("There is no Leaderboard {name} in this namespace. Apply it, and the submission goes on.")
}

/// Faults of the Leaderboard with which no Job can be made, or none may. The others speak for themselves where they hurt.
fn not_ready(draft: &PlanBuilder<'_>) -> Option<String> {
    let ready = draft.view.leaderboard.as_ref()?.condition(conditions::READY);
    let ready = ready.filter(|c| c.status == "False")?;
    let blocks = [
        reasons::CLAIMS_NOT_SERVED,
        reasons::CLAIM_TEMPLATE_MISSING,
        reasons::INVALID_POD,
        reasons::PREFIX_CONFLICT,
    ]
    .contains(&ready.reason.as_str());
    blocks.then(|| leaderboard_not_ready(draft, &ready.reason, &ready.message))
}

fn leaderboard_not_ready(draft: &PlanBuilder<'_>, reason: &str, why: &str) -> String {
    format!(
        "Leaderboard {} is not ready ({reason}): {} Fix it, and the submission goes on.",
        draft.spec().leaderboard_name,
        sentence(why)
    )
}

/// What is known of the participant's image.
enum Image {
    Named(String),
    /// It could not be asked for yet.
    Unknown,
    /// It can never be pulled, and why.
    Invalid {
        image: String,
        what: String,
    },
}

/// The image that was pinned, else the object's, else that of the file in EvalAI.
fn named_image(draft: &PlanBuilder<'_>, info: Option<&EvalaiInfo>) -> Image {
    let pinned = draft.status.plan.as_ref().map(|plan| plan.image.clone());
    let named = pinned
        .filter(|image| !image.is_empty())
        .or_else(|| draft.spec().image.clone())
        .or_else(|| info.and_then(|i| i.image.clone()));
    let Some(image) = named else {
        let problem = info.and_then(|i| i.image_problem.as_deref());
        return problem.map_or(Image::Unknown, |why| Image::Invalid {
            image: String::new(),
            what: sentence(&format!("The submission names no usable image: {why}")),
        });
    };
    match ImageReference::parse(&image) {
        Ok(_) => Image::Named(image),
        Err(why) => {
            let what = sentence(&format!("The submitted image is not a valid image reference: {why}"));
            Image::Invalid { image, what }
        }
    }
}

/// What is shown while the file in EvalAI cannot be read.
fn image_unread(draft: &PlanBuilder<'_>) -> String {
    let error = draft.view.evalai.as_ref().and_then(|view| view.error.as_deref());
    let why = error.map_or_else(String::new, |e| format!(" The last request failed: {}", sentence(e)));
    format!(
        "The image is not known: spec.image is empty, and the file in EvalAI that names it could not be read; it is tried \
         again.{why} If this lasts, check that EvalAI serves the submission's input_file."
    )
}

/// What is shown of a row that belongs to another phase than the Submission: its run would count for neither.
fn foreign_phase(draft: &PlanBuilder<'_>, info: Option<&EvalaiInfo>) -> Option<String> {
    let evalai = draft.spec().evalai?;
    let (pk, ours) = (evalai.submission, evalai.phase);
    let theirs = info?.phase.filter(|theirs| *theirs != ours)?;
    Some(format!(
        "In EvalAI submission {pk} belongs to phase {theirs}, not to phase {ours} of this Submission, so it is not run."
    ))
}

/// Whether the row is of another phase, and has to be of ours again. The object may have been applied with a wrong phase, so nothing
/// is reported at once; but the participant's submission does not wait for an end without limit.
fn waits_for_phase(draft: &mut PlanBuilder<'_>, info: Option<&EvalaiInfo>) -> bool {
    let Some(what) = foreign_phase(draft, info) else {
        return false;
    };
    let message = format!(
        "{what} Set phase {} back in EvalAI, or delete this Submission and apply it with the right phase; after {} min it \
         fails, uncharged.",
        draft.spec().evalai.map_or(0, |evalai| evalai.phase),
        Wait::PHASE.longest / 60
    );
    let message = draft.stall(reasons::PHASE_DIFFERS, &message);
    let since = draft.blocked_since(reasons::PHASE_DIFFERS).unwrap_or(draft.now());
    let until = Wait::PHASE.over_at(since);
    if draft.now() >= until {
        end::failed(draft, infrastructure(reasons::PHASE_DIFFERS, &what));
    } else {
        draft.requeue_at(until);
        refuse(draft, reasons::PHASE_DIFFERS, &message);
    }
    true
}

enum Answer<'a> {
    NotNeeded,
    Waiting,
    Ended(Status),
    Wanted(&'a EvalaiInfo),
}

fn ask_evalai<'a>(draft: &mut PlanBuilder<'a>) -> Answer<'a> {
    if draft.spec().evalai.is_none() {
        return Answer::NotNeeded;
    }
    match draft.evalai_info() {
        Some(info) if info.standing == Standing::Ended => Answer::Ended(info.status),
        Some(info) => Answer::Wanted(info),
        None => {
            draft.act(Action::Ask(Question::Evalai));
            let view = draft.view.evalai.as_ref();
            if draft.waits_quietly(Wait::EVALAI, view.map_or(Duration::ZERO, |evalai| evalai.waited)) {
                return Answer::Waiting;
            }
            draft.look_again(Wait::EVALAI);
            let message = match view.and_then(|view| view.error.as_deref()) {
                Some(error) => draft.stall(reasons::ASKING_EVALAI, &asking(Some(error))),
                None => asking(None),
            };
            draft.show(reasons::ASKING_EVALAI, message);
            draft.condition(conditions::ACCEPTED, Truth::Unknown, reasons::ASKING_EVALAI, "");
            Answer::Waiting
        }
    }
}

fn asking(error: Option<&str>) -> String {
    let why = error.map(|e| format!(" The last request failed: {}", sentence(e)));
    format!(
        "EvalAI is asked whether the submission wants to run.{}",
        why.unwrap_or_default()
    )
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

fn take_team(draft: &mut PlanBuilder<'_>, info: Option<&EvalaiInfo>) {
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
    draft.status.times.submitted = draft.status.times.submitted.take().or(submitted);
    if draft.status.times.submitted.is_none() {
        draft.status.times.submitted = draft.submission().metadata.creation_timestamp.clone();
    }
}

fn refuse(draft: &mut PlanBuilder<'_>, reason: &str, message: &str) -> bool {
    draft.condition(conditions::ACCEPTED, Truth::False, reason, message);
    draft.show(reason, message);
    false
}
