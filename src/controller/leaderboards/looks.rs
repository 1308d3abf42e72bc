//! The looks at what Leaderboards name: their tokens, their places in AWS, their Pods and claims. One task for all of them, several
//! Leaderboards at once, and one look at a time for each. A reconcile reports that something is due, and is woken with what was found.

use std::sync::Arc;

use futures::{StreamExt, stream};
use jiff::Timestamp;
use kube::runtime::reflector::ObjectRef;
use tokio::sync::mpsc;

use super::probe;
use super::state::LeaderboardState;
use crate::controller::objects::{Wake, uid_of};
use leaderboard_api::Leaderboard;

/// Leaderboards that are looked at at once: one whose bucket hangs takes its place for ten seconds.
const AT_ONCE: usize = 16;

/// What the looks use.
#[derive(Clone, Copy)]
pub struct Uses<'a> {
    pub places: probe::Uses<'a>,
    pub state: &'a LeaderboardState,
    pub wake: &'a Wake<Leaderboard>,
}

/// A Leaderboard, and what is due of it. Its state shows that a look is under way.
#[derive(Debug)]
pub struct Look {
    pub(super) leaderboard: Arc<Leaderboard>,
    pub(super) due: probe::Due,
}

/// Carries out all looks that come.
pub async fn carry_out(mut looks: mpsc::UnboundedReceiver<Look>, uses: Uses<'_>) {
    let looks = stream::poll_fn(move |cx| looks.poll_recv(cx));
    looks.for_each_concurrent(AT_ONCE, |one| look(uses, one)).await;
}

/// What was found of a Leaderboard that is gone is nobody's, and what was found of a spec that has changed leaves the new one due.
async fn look(uses: Uses<'_>, Look { leaderboard, due }: Look) {
    let (uid, now) = (uid_of(leaderboard.as_ref()), Timestamp::now());
    let known = uses.state.read(&uid, |entry| entry.looked.known.clone());
    let found = known.look(uses.places, &leaderboard, due, now).await;
    if uses.state.end_look(&uid, found) {
        (uses.wake)(ObjectRef::from_obj(leaderboard.as_ref()));
    }
}

#[cfg(test)]
#[path = "looks_tests.rs"]
mod tests;
