//! The status of a Leaderboard, and when it may go: a pure function of one reconcile's view.

use std::sync::Arc;

use jiff::Timestamp;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;

use super::refusal::Refusal;
use super::standings::{self, Named, Results};
use super::view::{Claims, EvalaiStanding, Policy, Unreachable, previous_controller};
use leaderboard_api::conditions::{self, Truth};
use leaderboard_api::leaderboard::Counts;
use leaderboard_api::{
    CarlaShape, ContainerShape, Evalai, EvalaiUse, Leaderboard, LeaderboardStatus, Reason, ResourceExt, S3Bucket,
    TableUse, TeamUse, Track, TrackStatus, effective, names,
};
use leaderboard_contract::verdict::WorkspaceVerdict;

const CLAIMS_NOT_SERVED: &str = "gpu.mode is Claim, and the API server does not serve resource.k8s.io/v1, which Kubernetes has from 1.34 on. \
                                 Update the cluster, or choose another gpu.mode.";
const FIRST_LOOK: &str = "The bucket and whatever else the Leaderboard names are being asked for the first time, and not all have answered yet.";
/// Note for the host of a Leaderboard that only observes.
const OBSERVES: &str = "evalai.mode is Observe: nothing is written to EvalAI.";

/// One reconcile's view of a Leaderboard.
#[derive(Clone, Debug)]
pub struct LeaderboardView {
    pub now: Timestamp,
    pub leaderboard: Arc<Leaderboard>,
    /// All Leaderboards that the operator watches, this one included.
    pub all: Vec<Arc<Leaderboard>>,
    pub counts: Counts,
    /// Its teams that have used the most.
    pub gpu_use: Vec<TeamUse>,
    /// Submissions that are live or not yet published and recorded.
    pub in_use: usize,
    /// How EvalAI ranks its phases.
    pub named: Named,
    /// The results that rank, if anything of them may have changed since the standings were stored.
    pub results: Option<Results>,
    /// The note about images that several teams lack.
    pub image_note: Option<String>,
    /// Its Pods that have not ended, counted while it is being deleted.
    pub pods: usize,
    /// How the NetworkPolicy of its Pods stands.
    pub policy: Policy,
    /// The last finding of its Pods about its isolation.
    pub measured: Option<WorkspaceVerdict>,
    /// The name that it may not use. With one, none of its services is asked or read.
    pub refusal: Option<Refusal>,
    /// True if all that follows was read for the present spec. Until then it decides nothing.
    pub is_looked_at: bool,
    /// Why its Pods could not be made.
    pub invalid_pod: Option<String>,
    /// Warnings about Pods that can be made all the same.
    pub pod_notes: Vec<String>,
    /// How the template of its claims stands.
    pub claims: Claims,
    /// The places among its bucket, table and queues that cannot be reached.
    pub unreachable: Option<Unreachable>,
    /// Warnings about places that it can do without.
    pub place_notes: Vec<String>,
    pub evalai: EvalaiStanding,
    /// Until when nothing is written to EvalAI, because the controller before may still have requests under way.
    pub evalai_writes_from: Option<Timestamp>,
    /// How the requests of its token are used.
    pub usage: Option<EvalaiUse>,
    /// Rows that have waited for its table for a while.
    pub rows_waiting: Option<usize>,
}

/// The result of a reconcile.
#[derive(Clone, Debug, PartialEq)]
pub struct LeaderboardPlan {
    pub status: LeaderboardStatus,
    /// Put the finalizer on (`true`) or take it off (`false`).
    pub finalizer: Option<bool>,
}

/// Decides one reconcile.
pub fn decide(view: &LeaderboardView) -> LeaderboardPlan {
    let leaderboard = &view.leaderboard;
    let mut status = leaderboard.status.clone().unwrap_or_default();
    let generation = leaderboard.metadata.generation;
    if view.is_looked_at {
        status.observed_generation = generation;
    }
    status.counts = Some(view.counts);
    status.gpu_use.clone_from(&view.gpu_use);
    status.evalai = view.usage.clone().filter(|_| view.refusal.is_none());
    let waiting = view.rows_waiting.filter(|waiting| *waiting > 0).map(number);
    status.table = waiting.map(|waiting| TableUse { waiting });
    status.tracks = tracks(view);
    let now = Time(view.now);
    let set = |status: &mut LeaderboardStatus, type_, (truth, reason, message): (Truth, Reason, String)| {
        conditions::set(&mut status.conditions, type_, truth, reason, &message, generation, &now);
    };
    if let Some(ready) = ready(view) {
        set(&mut status, conditions::READY, with_notes(view, ready));
    }
    let isolated = crate::leaderboards::isolated::condition(leaderboard, &view.policy, view.measured.as_ref());
    set(&mut status, conditions::ISOLATED, isolated);
    let deleting = leaderboard.metadata.deletion_timestamp.is_some();
    let is_in_use = view.in_use > 0 || view.pods > 0;
    if deleting && is_in_use {
        let in_use = (Truth::True, Reason::InUse, in_use(view));
        set(&mut status, conditions::TERMINATING, in_use);
    }
    let held = leaderboard
        .finalizers()
        .iter()
        .any(|f| f == names::FINALIZER_LEADERBOARD);
    let finalizer = match (deleting, held) {
        (false, false) => Some(true),
        (true, true) if !is_in_use => Some(false),
        _ => None,
    };
    LeaderboardPlan { status, finalizer }
}

fn number(count: usize) -> i32 {
    i32::try_from(count).unwrap_or(i32::MAX)
}

/// Message for a Leaderboard that is being deleted and still in use. Its NetworkPolicy goes with it, and has to outlive the last Pod.
fn in_use(view: &LeaderboardView) -> String {
    match (view.in_use, view.pods) {
        (0, pods) => {
            format!("{pods} Pods still run; the Leaderboard and its NetworkPolicy are removed when they have ended.")
        }
        (submissions, _) => {
            format!("{submissions} submissions are live or unpublished; the Leaderboard is removed when they are done.")
        }
    }
}

/// The first problem, the gravest first; an unknown state comes after a sure problem. None during the first look if there is a
/// condition of an earlier spec, or of the controller before: it stays.
fn ready(view: &LeaderboardView) -> Option<(Truth, Reason, String)> {
    if let Some(wrong) = of_spec(view) {
        return Some(wrong);
    }
    if view.is_looked_at {
        return Some(found(view));
    }
    let is_new = view.leaderboard.condition(conditions::READY).is_none();
    is_new.then(|| (Truth::Unknown, Reason::Checking, FIRST_LOOK.to_owned()))
}

/// The condition by the looks at its places and EvalAI.
fn found(view: &LeaderboardView) -> (Truth, Reason, String) {
    let of_evalai = evalai(&view.evalai);
    match &view.unreachable {
        Some(found) if found.truth == Truth::False || of_evalai.0 != Truth::False => {
            (found.truth, found.reason, found.message.clone())
        }
        _ => of_evalai,
    }
}

/// A Leaderboard that is ready shows what its host should know all the same: that a new controller waits with its first write to
/// EvalAI, which runs have no limit, which images several teams lack, and what its Pods give to strangers.
fn with_notes(view: &LeaderboardView, ready: (Truth, Reason, String)) -> (Truth, Reason, String) {
    let (truth, reason, message) = ready;
    if truth != Truth::True {
        return (truth, reason, message);
    }
    let spec = &view.leaderboard.spec;
    let delay = view.evalai_writes_from.filter(|_| spec.evalai.is_some());
    let observes = spec.observes().then(|| OBSERVES.to_owned());
    let notes = [
        Some(message),
        observes,
        delay.map(previous_controller),
        without_limit(&view.leaderboard),
        view.image_note.clone(),
    ];
    let texts = notes.into_iter().flatten();
    let texts = texts.chain(standings::notes(&view.leaderboard, &view.named));
    let texts = texts.chain(view.pod_notes.iter().chain(&view.place_notes).cloned());
    let texts: Vec<String> = texts.filter(|text| !text.is_empty()).collect();
    (truth, reason, texts.join(" "))
}

/// The first problem of the Leaderboard as it is written. None if there is none.
fn of_spec(view: &LeaderboardView) -> Option<(Truth, Reason, String)> {
    let no = |reason, message: String| Some((Truth::False, reason, message));
    if let Some(refusal) = &view.refusal {
        return no(refusal.reason, refusal.message.clone());
    }
    if let Some(older) = phase_conflict(view) {
        return no(
            Reason::PhaseConflict,
            format!("Leaderboard {older} is older and serves a phase of this one; give each phase to one Leaderboard."),
        );
    }
    if let Some(older) = prefix_conflict(view) {
        return no(
            Reason::PrefixConflict,
            format!(
                "Leaderboard {older} is older, of another namespace or another EvalAI server, and stores below the same bucket and prefix: \
                 the runs of one could replace those of the other. Make this one anew with a storage.s3.prefix of its own."
            ),
        );
    }
    if let Some(why) = &view.invalid_pod {
        return no(Reason::InvalidPod, why.clone());
    }
    match &view.claims {
        Claims::NotServed => return no(Reason::ClaimsNotServed, CLAIMS_NOT_SERVED.to_owned()),
        Claims::Missing(why) => return no(Reason::ClaimTemplateMissing, why.clone()),
        Claims::NotRequired | Claims::InPlace => {}
    }
    match &view.policy {
        Policy::Refused(why) | Policy::NotApplied(why) => no(Reason::NotIsolated, why.clone()),
        Policy::InPlace | Policy::External => None,
    }
}

fn evalai(standing: &EvalaiStanding) -> (Truth, Reason, String) {
    let no = |reason, message: String| (Truth::False, reason, message);
    match standing {
        EvalaiStanding::NoToken(why) => no(Reason::TokenMissing, why.clone()),
        EvalaiStanding::TokenRefused(why) => no(Reason::TokenRefused, why.clone()),
        EvalaiStanding::QueueUnread { is_refused: true, why } => no(Reason::QueueUnreachable, why.clone()),
        EvalaiStanding::QueueUnread { why, .. } => {
            let message = format!("EvalAI's queue has not been read for minutes: {why}. It is retried each minute.");
            (Truth::Unknown, Reason::QueueUnreachable, message)
        }
        EvalaiStanding::Misfit(why) => no(Reason::LabelsDiffer, why.clone()),
        EvalaiStanding::Unchecked(why) => {
            let why = why
                .clone()
                .unwrap_or_else(|| "EvalAI is being asked for its phases and labels.".into());
            (Truth::Unknown, Reason::AskingEvalAI, why)
        }
        EvalaiStanding::Fits { note } => (Truth::True, Reason::Ready, note.clone().unwrap_or_default()),
        EvalaiStanding::NotRequired => (Truth::True, Reason::Ready, String::new()),
    }
}

/// An older Leaderboard of the same server that serves one of our phases.
fn phase_conflict(view: &LeaderboardView) -> Option<String> {
    let mine = &view.leaderboard;
    let server = server(mine)?;
    let phases = |l: &Leaderboard| -> Vec<i64> { l.spec.tracks.iter().filter_map(|t| t.phase).collect() };
    let ours = phases(mine);
    let serves_ours = |l: &Leaderboard| phases(l).iter().any(|phase| ours.contains(phase));
    let mut older = older(view).filter(|l| self::server(l).as_ref() == Some(&server));
    older.find(|l| serves_ours(l)).map(|l| qualified(l))
}

/// An older Leaderboard below whose prefix ours could come upon runs that it takes for its own: ids of runs are unique in one namespace
/// for one server.
fn prefix_conflict(view: &LeaderboardView) -> Option<String> {
    let mine = &view.leaderboard;
    let ours = &mine.spec.storage.s3;
    let is_same_place = |theirs: &S3Bucket| {
        theirs.bucket == ours.bucket && theirs.prefix == ours.prefix && theirs.endpoint == ours.endpoint
    };
    let is_foreign = |l: &Leaderboard| {
        let is_of_other_server = matches!((server(l), server(mine)), (Some(a), Some(b)) if a != b);
        is_of_other_server || l.namespace() != mine.namespace()
    };
    let mut older = older(view).filter(|l| is_same_place(&l.spec.storage.s3));
    older.find(|l| is_foreign(l)).map(|l| qualified(l))
}

/// The older Leaderboards that are to stay.
fn older(view: &LeaderboardView) -> impl Iterator<Item = &Arc<Leaderboard>> {
    let ours = view.leaderboard.seniority();
    let others = view.all.iter().filter(|l| l.uid() != view.leaderboard.uid());
    others.filter(move |l| l.metadata.deletion_timestamp.is_none() && l.seniority() < ours)
}

fn server(leaderboard: &Leaderboard) -> Option<String> {
    leaderboard.spec.evalai.as_ref().map(Evalai::server)
}

fn qualified(leaderboard: &Leaderboard) -> String {
    format!(
        "{}/{}",
        leaderboard.namespace().unwrap_or_default(),
        leaderboard.name_any()
    )
}

fn tracks(view: &LeaderboardView) -> Vec<TrackStatus> {
    let leaderboard = view.leaderboard.as_ref();
    let status = |track: &Track| {
        let evaluation = &leaderboard.spec.evaluation;
        let carla = evaluation.carla().map(|carla| effective::shape(carla, track));
        let container = evaluation
            .container()
            .map(|container| effective::workers(container, track));
        let ranking = standings::ranked(leaderboard, track, &view.named).ranking;
        TrackStatus {
            name: track.name.clone(),
            carla: carla.map(|shape| CarlaShape {
                pairs: number(shape.pairs),
                routes: number(shape.routes),
                repetitions: number(shape.repetitions),
            }),
            container: container.map(|workers| ContainerShape { workers }),
            standings: standings::of_track(leaderboard, track, &ranking, view.results.as_ref()),
            ranking: Some(ranking),
        }
    };
    leaderboard.spec.tracks.iter().map(status).collect()
}

/// Tracks whose runs have no time limit, as a note.
fn without_limit(leaderboard: &Leaderboard) -> Option<String> {
    let spec = &leaderboard.spec;
    let has_none = |track: &&Track| effective::deadlines(spec, Some(*track)).run_seconds.is_none();
    let names: Vec<&str> = spec
        .tracks
        .iter()
        .filter(has_none)
        .map(|track| track.name.as_str())
        .collect();
    let (runs, names) = match names.as_slice() {
        [] => return None,
        [one] => ("Runs of the track", (*one).to_owned()),
        several => ("Runs of the tracks", several.join(", ")),
    };
    let who = if spec.evaluation.takes_files() {
        "an evaluator"
    } else {
        "an agent"
    };
    Some(format!(
        "{runs} {names} have no time limit: {who} that does not end keeps its nodes until it is cancelled; set \
         deadlines.runSeconds."
    ))
}

#[cfg(test)]
mod tests;
