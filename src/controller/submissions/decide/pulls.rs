//! How long the start of a Pod may take: the pulls of its images apart from all the rest.
//!
//! Called by `start`. Pure. The kubelet's events are not watched, and no condition covers images, so a pull is known by its containers: the
//! kubelet starts them in order, and one that was never started, has no error and is next is waiting for its image. The kubelet
//! changes no status of a Pod while it pulls for it, so two pulls in a row look like one.

use jiff::Timestamp;

use super::waits::after;
use crate::controller::submissions::view::{ContainerView, PodView};
use leaderboard_api::{Deadlines, names};
use leaderboard_protocol::files::Member;

/// How a container waits that the kubelet has not come to yet.
const NOT_BEGUN: [&str; 3] = ["", "ContainerCreating", "PodInitializing"];

/// When a start has taken too long.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Limit {
    pub(super) at: Timestamp,
    /// The deadline that is over then.
    pub(super) seconds: i64,
    pub(super) is_of_pulls: bool,
}

/// The limit of a start; none before the Pod has a node. `stalled` is since when a container of it does not start, and that is known.
pub(super) fn limit(pod: &PodView, deadlines: &Deadlines, stalled: Option<Timestamp>) -> Option<Limit> {
    let scheduled = pod.scheduled?;
    let pulled_by = after(after(scheduled, run_seconds(pod)), deadlines.pull_seconds);
    if stalled.is_none() && !waiting(pod).is_empty() {
        return Some(Limit {
            at: pulled_by,
            seconds: deadlines.pull_seconds,
            is_of_pulls: true,
        });
    }
    let since = stalled.or_else(|| last_begun(pod)).unwrap_or(scheduled);
    // Causes that take turns put the end off no further.
    let latest = after(pulled_by, deadlines.start_seconds);
    Some(Limit {
        at: after(since.max(scheduled), deadlines.start_seconds).min(latest),
        seconds: deadlines.start_seconds,
        is_of_pulls: false,
    })
}

/// The containers that wait for an image, if the Pod is at a pull.
pub(super) fn waiting(pod: &PodView) -> Vec<&str> {
    // Ours before the agents go one by one. Those of an overlay hold them up, wherever they stand.
    let mut before = pod.containers.iter().filter(|container| container.is_before_agents());
    match before.find(|container| !is_through(container)) {
        Some(next) if is_before_its_pull(next) => vec![&next.name],
        Some(_) => Vec::new(),
        None => {
            let of_workers = pod
                .containers
                .iter()
                .filter(|container| Member::parse(&container.name).is_some());
            let waiting = of_workers.filter(|container| is_before_its_pull(container));
            waiting.map(|container| container.name.as_str()).collect()
        }
    }
}

/// Seconds in which containers before the agents have run: no pull was under way then.
fn run_seconds(pod: &PodView) -> i64 {
    let before = pod.containers.iter().filter(|container| container.is_before_agents());
    before
        .filter_map(|container| {
            let end = container.last.as_ref().filter(|end| end.exit_code == 0)?;
            Some(end.at?.duration_since(end.began?).as_secs().max(0))
        })
        .fold(0, i64::saturating_add)
}

/// When the kubelet came to a container last. A restart is none of its pulls.
fn last_begun(pod: &PodView) -> Option<Timestamp> {
    let first_lives = pod.containers.iter().filter(|container| container.restarts == 0);
    let begun = first_lives.filter_map(|container| container.began.or_else(|| container.last.as_ref()?.began));
    begun.max()
}

/// Whether the kubelet goes on to the next one.
fn is_through(container: &ContainerView) -> bool {
    let has_ended_well = container.last.as_ref().is_some_and(|end| end.exit_code == 0);
    let stays = container.running && container.name == names::CONTAINER_LOGCOPY;
    stays || (has_ended_well && !container.running)
}

fn is_before_its_pull(container: &ContainerView) -> bool {
    let waits = container
        .waiting
        .as_ref()
        .is_some_and(|(reason, _)| NOT_BEGUN.contains(&reason.as_str()));
    waits && container.restarts == 0 && container.last.is_none()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::controller::submissions::view::EndView;

    fn at(second: i64) -> Timestamp {
        Timestamp::from_second(second).unwrap()
    }

    fn waits(name: &str, reason: &str) -> ContainerView {
        ContainerView {
            name: name.into(),
            waiting: Some((reason.into(), String::new())),
            ..ContainerView::default()
        }
    }

    fn runs(name: &str, since: i64) -> ContainerView {
        ContainerView {
            name: name.into(),
            running: true,
            began: Some(at(since)),
            ..ContainerView::default()
        }
    }

    fn ran(name: &str, from: i64, to: i64) -> ContainerView {
        ContainerView {
            name: name.into(),
            last: Some(EndView {
                began: Some(at(from)),
                at: Some(at(to)),
                ..EndView::default()
            }),
            ..ContainerView::default()
        }
    }

    fn pod(containers: Vec<ContainerView>) -> PodView {
        PodView {
            scheduled: Some(at(0)),
            containers,
            ..PodView::default()
        }
    }

    fn deadlines() -> Deadlines {
        Deadlines {
            pull_seconds: 5400,
            start_seconds: 1800,
            ..Deadlines::default()
        }
    }

    fn init(name: &str) -> ContainerView {
        waits(name, "PodInitializing")
    }

    /// A Pod that starts: what has been, and who waits for its turn.
    fn starts(first: Vec<ContainerView>, later: &[&str]) -> Vec<ContainerView> {
        first.into_iter().chain(later.iter().map(|name| init(name))).collect()
    }

    /// The containers of a pair, once everything before them is there.
    fn pair(containers: [ContainerView; 2]) -> Vec<ContainerView> {
        let first = [
            ran("contents", 2000, 3000),
            ran("workspace", 3010, 3020),
            runs("logcopy", 3030),
        ];
        first.into_iter().chain(containers).collect()
    }

    const PAIR: [&str; 2] = ["simulator-1", "agent-1"];

    /// What a Pod that starts goes through, with who waits for an image, and by when it has to be further.
    fn stages() -> [(&'static str, Vec<ContainerView>, &'static [&'static str], i64); 9] {
        const WORKSPACE: [&str; 4] = ["workspace", "logcopy", "simulator-1", "agent-1"];
        const ALL: [&str; 5] = ["contents", "workspace", "logcopy", "simulator-1", "agent-1"];
        let contents = ran("contents", 2000, 3000);
        let copying = starts(vec![runs("contents", 2000)], &WORKSPACE);
        let no_reason = pair(PAIR.map(|name| waits(name, "")));
        let simulator = || runs("simulator-1", 4000);
        let odd = pair([simulator(), waits("agent-1", "Odd")]);
        let one = pair([simulator(), waits("agent-1", "ContainerCreating")]);
        [
            ("nothing is known of it", Vec::new(), &[], 1800),
            ("the contents are pulled", starts(Vec::new(), &ALL), &["contents"], 5400),
            ("the contents are copied", copying, &[], 2000 + 1800),
            (
                "the operator's image is pulled",
                starts(vec![contents], &WORKSPACE),
                &["workspace"],
                1000 + 5400,
            ),
            (
                "the images of the pairs are pulled",
                pair(PAIR.map(init)),
                &PAIR,
                1010 + 5400,
            ),
            ("one of them is there", one, &["agent-1"], 1010 + 5400),
            ("a new kubelet gives no reason", no_reason, &PAIR, 1010 + 5400),
            (
                "all are there",
                pair([simulator(), runs("agent-1", 4700)]),
                &[],
                4700 + 1800,
            ),
            ("another reason is no pull", odd, &[], 4000 + 1800),
        ]
    }

    #[test]
    fn pulls_and_the_rest_of_a_start_have_deadlines_of_their_own() {
        for (what, containers, names, second) in stages() {
            let pod = pod(containers);
            assert_eq!(waiting(&pod), names, "{what}");
            let limit = limit(&pod, &deadlines(), None).unwrap();
            assert_eq!((limit.at, limit.is_of_pulls), (at(second), !names.is_empty()), "{what}");
            assert_eq!(limit.seconds, if names.is_empty() { 1800 } else { 5400 }, "{what}");
        }
    }

    #[test]
    fn what_does_not_start_has_its_time_from_when_it_was_seen_and_never_more_than_all_deadlines() {
        let failing = || {
            let mut contents = ran("contents", 4000, 4010);
            contents.restarts = 3;
            contents.last.as_mut().unwrap().exit_code = 3;
            pod(vec![contents, waits("workspace", "PodInitializing")])
        };
        assert!(waiting(&failing()).is_empty(), "a restart pulls nothing");
        for (stalled, second) in [(None, 1800), (Some(3900), 5700), (Some(9000), 5400 + 1800)] {
            let found = limit(&failing(), &deadlines(), stalled.map(at)).unwrap();
            assert_eq!((found.at, found.is_of_pulls), (at(second), false), "{stalled:?}");
        }
        let unscheduled = PodView::default();
        assert_eq!(limit(&unscheduled, &deadlines(), None), None, "there is no node yet");
    }
}
