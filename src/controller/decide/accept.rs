//! Acceptance: a Leaderboard, a track, an image, and EvalAI's word that the submission wants to run. Pins the plan.

use std::time::Duration;

use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;

use super::draft::Draft;
use super::{Action, end, isolation};
use crate::api::conditions::{self, Truth};
use crate::api::{LeaderboardSpec, State, Team, Track, effective, reasons};
use crate::controller::view::{EvalaiInfo, Standing};
use crate::text::sentence;

/// How long EvalAI may take before its silence is shown.
const RETRY: Duration = Duration::from_secs(30);

/// Whether the submission may go on to its turn. Otherwise the draft says why not.
pub(super) fn decide(draft: &mut Draft<'_>) -> bool {
    let Some(leaderboard) = draft.leaderboard() else {
        let message = no_leaderboard(draft);
        return refuse(draft, reasons::LEADERBOARD_NOT_FOUND, &message);
    };
    let Some(track) = find_track(draft, leaderboard) else {
        let message = missing_track(draft, leaderboard);
        return refuse(draft, reasons::TRACK_NOT_FOUND, &message);
    };
    draft.status.track = Some(track.name.clone());
    let info = match ask_evalai(draft) {
        Answer::NotNeeded => None,
        Answer::Waiting => return false,
        Answer::Ended(status) => {
            let message = format!(
                "EvalAI says {status}: nothing is run and nothing is reported. Resume it there if it is to run."
            );
            end::cancelled(draft, reasons::ENDED_IN_EVALAI, &message);
            return false;
        }
        Answer::Wanted(info) => Some(info),
    };
    take_team(draft, info.as_ref());
    let pinned = draft.status.plan.as_ref().map(|plan| plan.image.clone());
    let told = info.as_ref().and_then(|i| i.image.clone());
    let Some(image) = pinned.or_else(|| draft.spec().image.clone()).or(told) else {
        let message = "Neither the Submission nor EvalAI names an image. Ask the participant to push again, and cancel \
                       this submission.";
        return refuse(draft, reasons::IMAGE_MISSING, message);
    };
    if let Some(message) = not_ready(draft) {
        return refuse(draft, reasons::LEADERBOARD_NOT_READY, &message);
    }
    if let Some(message) = isolation::missing(draft) {
        return refuse(draft, reasons::NOT_ISOLATED, &message);
    }
    pin(draft, leaderboard, track, image, info.as_ref());
    draft.condition(conditions::ACCEPTED, Truth::True, reasons::ACCEPTED, "");
    true
}

/// What is said while the Leaderboard does not exist.
pub(super) fn no_leaderboard(draft: &Draft<'_>) -> String {
    let name = &draft.spec().leaderboard;
    format!("There is no Leaderboard {name} in this namespace. Apply it, and the submission goes on.")
}

/// Faults of the Leaderboard with which no Job can be made, or none may. The others speak for themselves where they hurt.
fn not_ready(draft: &Draft<'_>) -> Option<String> {
    let status = draft.view.leaderboard.as_ref()?.status.as_ref()?;
    let ready = conditions::get(&status.conditions, conditions::READY).filter(|c| c.status == "False")?;
    let blocks = [reasons::INVALID_POD, reasons::PREFIX_CONFLICT].contains(&ready.reason.as_str());
    blocks.then(|| {
        format!(
            "Leaderboard {} is not ready ({}): {} Mend it, and the submission goes on.",
            draft.spec().leaderboard,
            ready.reason,
            sentence(&ready.message)
        )
    })
}

enum Answer {
    NotNeeded,
    Waiting,
    Ended(String),
    Wanted(EvalaiInfo),
}

fn ask_evalai(draft: &mut Draft<'_>) -> Answer {
    if draft.spec().evalai.is_none() {
        return Answer::NotNeeded;
    }
    let view = draft.view.evalai.clone().unwrap_or_default();
    match view.info {
        Some(info) if info.standing == Standing::Ended => Answer::Ended(info.status),
        Some(info) => Answer::Wanted(info),
        None => {
            draft.act(Action::AskEvalai);
            draft.requeue_in(RETRY);
            let message = match view.error {
                Some(error) => draft.stall(reasons::ASKING_EVALAI, &asking(Some(&error))),
                None => asking(None),
            };
            draft.say(State::Pending, reasons::ASKING_EVALAI, message);
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

fn find_track<'a>(draft: &Draft<'_>, leaderboard: &'a LeaderboardSpec) -> Option<&'a Track> {
    match (&draft.spec().evalai, &draft.spec().track) {
        (Some(evalai), _) => leaderboard.tracks.iter().find(|t| t.phase == Some(evalai.phase)),
        (None, Some(name)) => leaderboard.tracks.iter().find(|t| t.name == *name),
        (None, None) => None,
    }
}

fn missing_track(draft: &Draft<'_>, leaderboard: &LeaderboardSpec) -> String {
    let known: Vec<&str> = leaderboard.tracks.iter().map(|t| t.name.as_str()).collect();
    let what = match (&draft.spec().evalai, &draft.spec().track) {
        (Some(evalai), _) => format!("No track has the phase {}", evalai.phase),
        (None, track) => format!("There is no track {}", track.as_deref().unwrap_or("")),
    };
    format!(
        "{what} in Leaderboard {}, whose tracks are {}. Add it there, or cancel this submission.",
        draft.spec().leaderboard,
        known.join(", ")
    )
}

fn take_team(draft: &mut Draft<'_>, info: Option<&EvalaiInfo>) {
    let given = draft.spec().team.clone();
    if let Some(info) = info {
        let name = given.and_then(|t| t.name).or_else(|| info.team_name.clone());
        draft.status.team = Some(Team {
            id: Some(info.team_id.clone()),
            name,
        });
        draft.status.times.submitted = draft.status.times.submitted.clone().or(info.submitted_at.map(Time));
    } else if given.is_some() {
        draft.status.team = given;
    }
    if draft.status.times.submitted.is_none() {
        draft.status.times.submitted = draft.submission().metadata.creation_timestamp.clone();
    }
}

fn pin(draft: &mut Draft<'_>, leaderboard: &LeaderboardSpec, track: &Track, image: String, info: Option<&EvalaiInfo>) {
    let resumed = info.is_some_and(|i| i.standing == Standing::Resumed);
    let plan = match draft.status.plan.take() {
        // The images of contents and simulator belong to the attempt and follow the Leaderboard until its first Job is
        // made; all else belongs to the submission.
        Some(pinned) if draft.status.retry == 0 && draft.status.job.is_none() => crate::api::RunPlan {
            contents_image: leaderboard.contents.image.clone(),
            simulator_image: leaderboard.simulator.image.clone(),
            ..pinned
        },
        Some(pinned) => pinned,
        None => {
            let resume = resumed || draft.spec().attempt > 1;
            effective::plan(leaderboard, track, effective::run_id(draft.submission()), image, resume)
        }
    };
    draft.status.results = Some(effective::results_url(&plan.storage, &plan.run_id));
    draft.status.plan = Some(plan);
    if draft.status.times.accepted.is_none() {
        draft.status.times.accepted = Some(draft.time());
    }
}

fn refuse(draft: &mut Draft<'_>, reason: &str, message: &str) -> bool {
    draft.condition(conditions::ACCEPTED, Truth::False, reason, message);
    draft.say(State::Pending, reason, message);
    false
}
