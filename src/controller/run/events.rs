//! Which objects an event of a watch concerns. Each mapping remembers what it needs to leave out the echo of our own writes.

use std::collections::HashSet;
use std::sync::Arc;

use k8s_openapi::api::core::v1::Pod;
use kube::ResourceExt;
use kube::runtime::reflector::ObjectRef;

use super::marks::{Fingerprints, standing};
use super::{Touched, board, owner};
use crate::controller::context::Context;
use crate::controller::leaderboards::isolation;
use crate::controller::observe::board::Places;
use crate::kubernetes::WatchEvent;
use leaderboard_api::{Leaderboard, Submission};

pub(super) fn of_leaderboards() -> impl FnMut(WatchEvent<Leaderboard>) -> Vec<Touched> + Send {
    let mut leaderboards = Fingerprints::default();
    move |touch| {
        let object = touch.object.as_ref();
        if touch.is_gone {
            return vec![Touched::Gone(leaderboards.drop(object))];
        }
        let moved = leaderboards.moved(object, "");
        let own = moved
            .by_others
            .then(|| Touched::Leaderboard(ObjectRef::from_obj(object)));
        own.into_iter().collect()
    }
}

pub(super) fn of_submissions(context: Arc<Context>) -> impl FnMut(WatchEvent<Submission>) -> Vec<Touched> + Send {
    let (mut submissions, mut places) = (Fingerprints::default(), Places::default());
    move |touch| {
        let object = touch.object.as_ref();
        let namespace = object.namespace().unwrap_or_default();
        let leaderboard = ObjectRef::new(&object.spec.leaderboard_name).within(&namespace);
        // Before anybody is woken by it.
        if places.moved(object, touch.is_gone) {
            context.board.moved(&namespace, &object.spec.leaderboard_name);
        }
        let original = context.reruns.moved(object, touch.is_gone);
        if touch.is_gone {
            return vec![
                Touched::Gone(submissions.drop(object)),
                Touched::Leaderboard(leaderboard),
            ];
        }
        let moved = submissions.moved(object, &standing(object));
        let own = moved
            .by_others
            .then(|| Touched::Submission(ObjectRef::from_obj(object)));
        own.into_iter()
            .chain(moved.in_line.then_some(Touched::Leaderboard(leaderboard)))
            .chain(original.map(Touched::Submission))
            .collect()
    }
}

/// A Pod concerns its Submission, and its Leaderboard once it has measured its isolation.
pub(super) fn of_pods() -> impl FnMut(WatchEvent<Pod>) -> Vec<Touched> + Send {
    let mut measured = HashSet::new();
    move |touch| {
        let pod = touch.object.as_ref();
        let uid = pod.uid().unwrap_or_default();
        let mut concerned = owner(pod);
        if touch.is_gone {
            measured.remove(&uid);
        } else if isolation::finding(pod).is_some() && measured.insert(uid) {
            concerned.extend(board(pod));
        }
        concerned
    }
}
