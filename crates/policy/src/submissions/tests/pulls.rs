//! How long the start of a Pod may take: its pulls apart from all the rest.

use jiff::Timestamp;
use leaderboard_api::{Agents, Deadlines};

use super::super::limits::{limit, waiting};
use crate::view::{ContainerView, EndView, PodView};

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

/// The stages of a Pod that starts, each with the containers that wait for an image, and by when it has to be further.
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
        assert_eq!(waiting(&pod, Agents::Beside), names, "{what}");
        let limit = limit(&pod, Agents::Beside, &deadlines(), None).unwrap();
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
    assert!(
        waiting(&failing(), Agents::Beside).is_empty(),
        "a restart pulls nothing"
    );
    for (stalled, second) in [(None, 1800), (Some(3900), 5700), (Some(9000), 5400 + 1800)] {
        let found = limit(&failing(), Agents::Beside, &deadlines(), stalled.map(at)).unwrap();
        assert_eq!((found.at, found.is_of_pulls), (at(second), false), "{stalled:?}");
    }
    let unscheduled = PodView::default();
    assert_eq!(
        limit(&unscheduled, Agents::Beside, &deadlines(), None),
        None,
        "there is no node yet"
    );
}

/// The Pod of an agent that ends at second 9000, before two evaluators.
fn agent_first(containers: Vec<ContainerView>, later: &[&str]) -> PodView {
    let first = [
        ran("workspace", 0, 10),
        ran("dataset", 500, 1000),
        runs("logcopy", 1010),
    ];
    pod(starts(first.into_iter().chain(containers).collect(), later))
}

type Stage = (&'static str, PodView, Option<i64>, &'static [&'static str], Option<i64>);

/// The stages of such a Pod, each with the containers that wait for an image, and by when it has to be further.
fn stages_of_agent_first() -> [Stage; 6] {
    const EVALUATORS: [&str; 2] = ["evaluator-1", "evaluator-2"];
    let agent = || ran("agent-1", 2000, 9000);
    let collect = || ran("collect", 9010, 30_000);
    let failing = || waits("evaluator-1", "ErrImagePull");
    [
        (
            "its image is pulled",
            agent_first(vec![], &["agent-1", "collect", "evaluator-1", "evaluator-2"]),
            None,
            &["agent-1"][..],
            Some(510 + 5400),
        ),
        (
            "collect is next",
            agent_first(vec![agent()], &["collect", "evaluator-1", "evaluator-2"]),
            None,
            &["collect"],
            Some(9000 + 5400),
        ),
        (
            "its files are copied",
            agent_first(vec![agent(), runs("collect", 9010)], &EVALUATORS),
            None,
            &[],
            None,
        ),
        (
            "the images of the evaluators are pulled",
            agent_first(vec![agent(), collect()], &EVALUATORS),
            None,
            &EVALUATORS,
            Some(30_000 + 5400),
        ),
        (
            "one cannot be pulled",
            agent_first(vec![agent(), collect(), failing()], &["evaluator-2"]),
            Some(30_100),
            &["evaluator-2"],
            Some(30_100 + 1800),
        ),
        (
            "causes take turns",
            agent_first(vec![agent(), collect(), failing()], &["evaluator-2"]),
            Some(80_000),
            &["evaluator-2"],
            Some(30_000 + 5400 + 1800),
        ),
    ]
}

#[test]
fn after_an_agent_that_runs_first_the_evaluators_have_the_deadlines_of_a_start_from_its_end() {
    for (what, pod, stalled, names, second) in stages_of_agent_first() {
        assert_eq!(waiting(&pod, Agents::First), names, "{what}");
        let found = limit(&pod, Agents::First, &deadlines(), stalled.map(at));
        assert_eq!(found.map(|limit| limit.at), second.map(at), "{what}");
    }
}

#[test]
fn a_workspace_that_copies_an_input_has_all_the_time_that_this_takes() {
    let copying = pod(starts(vec![runs("workspace", 100)], &["logcopy"]));
    for (agents, stalled, second) in [
        (Agents::Beside, None, Some(100 + 1800)),
        (Agents::First, None, None),
        (Agents::Absent, None, None),
        (Agents::Absent, Some(500), Some(500 + 1800)),
    ] {
        let found = limit(&copying, agents, &deadlines(), stalled.map(at));
        assert_eq!(found.map(|limit| limit.at), second.map(at), "{agents:?}");
    }
    // A pull after it has the whole time of pulls.
    let copied = pod(starts(vec![ran("workspace", 100, 20_000)], &["logcopy"]));
    let found = limit(&copied, Agents::Absent, &deadlines(), None).unwrap();
    assert_eq!(found.at, at(19_900 + 5400));
}
