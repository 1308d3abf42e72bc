//! The gate before a Job that all of a Leaderboard share: a slot, for which a submission stands in line.

use super::super::plan::Action;
use super::super::run;
use super::super::status::PlanBuilder;
use crate::slots::member::check_team;
use crate::slots::turns::{InLine, Turn};
use leaderboard_api::{Eta, Reason, ResourceExt, Waiting};

/// A submission that waits for nothing but a slot joins the line, and shows its place there.
pub(in super::super) fn waits(draft: &mut PlanBuilder<'_>) -> bool {
    let (position, eta, reason, message) = match draft.view.turn.clone() {
        Turn::Go => return false,
        Turn::NotInLine => {
            join(draft);
            // Its first place is worth a write, that it has none yet is not.
            draft.keeps_status();
            return true;
        }
        Turn::Wait { position, eta } => (
            position,
            known_eta(draft, position).or(eta),
            Reason::WaitingForSlot,
            "All slots of the Leaderboard are in use; concurrency.total and concurrency.perTeam set their number.",
        ),
        Turn::Paused { position } => (
            position,
            None,
            Reason::Paused,
            "The Leaderboard is paused; it starts again with paused: false.",
        ),
    };
    draft.status.waiting = Some(Box::new(Waiting::new(position, eta)));
    draft.waits(reason);
    draft.show(reason, message);
    // Its priority may have been edited since.
    join(draft);
    run::update_evalai(draft);
    true
}

pub(super) fn join(draft: &mut PlanBuilder<'_>) {
    let status = &draft.status;
    let team = status.team.as_ref();
    let team = team.and_then(|team| team.id.clone().or_else(|| team.name.clone()));
    let is_check = draft.spec().check;
    let own = is_check.then(|| check_team(&draft.submission().name_any()));
    let place = InLine {
        uid: draft.submission().metadata.uid.clone().unwrap_or_default(),
        name: draft.submission().name_any(),
        team: own.or(team).unwrap_or_default(),
        track: status.track.clone().unwrap_or_default(),
        priority: draft.spec().priority,
        submitted: status.times.submitted.as_ref().map_or(draft.now(), |time| time.0),
        is_check,
    };
    draft.act(Action::JoinLine(place));
}

/// The wait that is shown of this place. One that is only estimated anew is not worth a write; it follows the place.
fn known_eta(draft: &PlanBuilder<'_>, position: i32) -> Option<Eta> {
    let known = draft.status.waiting.as_deref();
    known.filter(|known| known.position == position)?.eta()
}
