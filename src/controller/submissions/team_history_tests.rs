//! The table of repeated failures: a row for each case.

use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;
use leaderboard_api::Use;
use leaderboard_api::infrastructure_failures::MAX_RECENT_TIMES;
use serde_json::{Value, json};

use super::*;

/// A Submission of team and simulator that ended at an hour on a node: `finished`, or with so many failures of its own.
struct Run {
    team: &'static str,
    end: End,
    hour: i64,
    node: &'static str,
    simulator: &'static str,
}

enum End {
    Finished,
    Failed(i32),
    /// It failed so before, and runs again.
    Resumed(i32),
}

use End::{Failed, Finished, Resumed};

fn run(team: &'static str, end: End, hour: i64, node: &'static str) -> Run {
    Run {
        team,
        end,
        hour,
        node,
        simulator: "carla:1",
    }
}

fn at(hour: i64) -> Timestamp {
    Timestamp::from_second(1_700_000_000 + hour * 3600).unwrap()
}

fn submission(number: usize, run: &Run) -> Submission {
    let plan = json!({
        "runId": "7", "leaderboardVersion": "V2", "track": "sensors", "codename": "SENSORS", "slices": [], "routes": 4, "repetitions": 1,
        "storage": {"bucket": "b"}, "image": "i", "contentsImage": "c", "simulatorImage": run.simulator,
    });
    let time = at(run.hour).to_string();
    let condition = |status: &str, reason: &str| json!([{"type": "Finished", "status": status, "reason": reason, "message": "", "lastTransitionTime": time}]);
    let failures = |number: i32| {
        let recent = vec![&time; usize::try_from(number).unwrap().min(MAX_RECENT_TIMES)];
        json!({"number": number, "firstTime": time, "lastTime": time, "recentTimes": recent, "nodes": [run.node]})
    };
    let mut status: Value = match run.end {
        Finished => json!({"conditions": condition("True", "Finished"), "times": {"finished": time}}),
        Failed(number) => json!({
            "conditions": condition("True", "SimulationCrashed"), "times": {"finished": time},
            "infrastructureFailures": failures(number),
        }),
        Resumed(number) => {
            json!({"conditions": condition("False", "Preparing"), "infrastructureFailures": failures(number)})
        }
    };
    status["plan"] = plan;
    status["nodeName"] = json!(run.node);
    let object = json!({
        "apiVersion": "leaderboard.carla.org/v1alpha1", "kind": "Submission",
        "metadata": {"name": format!("s{number}"), "namespace": "n", "uid": format!("s{number}")},
        "spec": {"leaderboardName": "lb", "image": "r/i:1", "team": {"name": run.team}},
        "status": status,
    });
    serde_json::from_value(object).unwrap()
}

/// As the cache shows these Submissions.
fn shown<'a>(all: impl IntoIterator<Item = &'a Submission>) -> Teams {
    let teams = Teams::default();
    for one in all {
        teams.changed(None, Some(one));
    }
    teams
}

fn submissions(runs: &[Run]) -> Vec<Submission> {
    runs.iter().enumerate().map(|(i, run)| submission(i, run)).collect()
}

fn board() -> Leaderboard {
    let mut board = crate::controller::fixtures::leaderboard("lb", "http://127.0.0.1:9");
    board.metadata.namespace = Some("n".into());
    board
}

/// Whether an attempt of team `a` that ends so at hour 20 on node `n9` would be the agent's fault, with two free.
fn is_blamed(before: &[Run]) -> bool {
    let own = submission(99, &run("a", Resumed(0), 20, "n9"));
    let teams = shown(&submissions(before));
    teams.history(&own, at(20)).blames_agent(Some("n9"), 2)
}

type Case = (&'static str, bool, Vec<Run>);

/// Two failures of a team in a row on two nodes, and what else has run.
fn twice_and(more: Vec<Run>) -> Vec<Run> {
    let mut runs = vec![run("a", Failed(1), 10, "n1"), run("a", Failed(1), 12, "n2")];
    runs.extend(more);
    runs
}

fn check(cases: Vec<Case>) {
    for (what, expected, before) in cases {
        assert_eq!(is_blamed(&before), expected, "{what}");
    }
}

#[test]
fn only_a_row_of_failures_between_other_teams_finishes_blames_the_agent() {
    let other_simulator = Run {
        simulator: "carla:2",
        ..run("b", Finished, 15, "n3")
    };
    check(vec![
        (
            "others finish meanwhile",
            true,
            twice_and(vec![run("b", Finished, 15, "n3")]),
        ),
        ("nobody else runs", false, twice_and(Vec::new())),
        (
            "others finished before",
            false,
            twice_and(vec![run("b", Finished, 9, "n3")]),
        ),
        (
            "others finish with another simulator",
            false,
            twice_and(vec![other_simulator]),
        ),
        (
            "its simulator fails for others as well",
            false,
            twice_and(vec![run("b", Finished, 15, "n3"), run("c", Failed(1), 16, "n4")]),
        ),
        (
            "only its own runs finish",
            false,
            twice_and(vec![run("a", Finished, 9, "n3")]),
        ),
    ]);
}

#[test]
fn neither_a_node_nor_a_finish_between_nor_a_like_name_makes_a_row() {
    check(vec![
        (
            "one failure only",
            false,
            vec![run("a", Failed(1), 10, "n1"), run("b", Finished, 15, "n3")],
        ),
        (
            "a run of its own finished between",
            false,
            twice_and(vec![run("a", Finished, 11, "n1"), run("b", Finished, 15, "n3")]),
        ),
        (
            "each failure was resumed by the team itself",
            true,
            vec![run("a", Resumed(2), 12, "n1"), run("b", Finished, 15, "n3")],
        ),
        (
            "one node has all of its failures, and nobody else uses it",
            false,
            vec![run("a", Failed(2), 12, "n9"), run("b", Finished, 15, "n3")],
        ),
        (
            "one node has all of its failures, and others finish there",
            true,
            vec![run("a", Failed(2), 12, "n9"), run("b", Finished, 15, "n9")],
        ),
        (
            "others fail on its node, too",
            false,
            vec![
                run("a", Failed(2), 12, "n9"),
                run("b", Failed(1), 13, "n9"),
                run("b", Finished, 14, "n3"),
                run("c", Finished, 15, "n9"),
            ],
        ),
        (
            "teams that look alike are others",
            false,
            vec![
                run("A", Failed(1), 10, "n1"),
                run("a ", Failed(1), 11, "n2"),
                run("\u{430}", Failed(1), 12, "n3"),
                run("b", Finished, 15, "n4"),
            ],
        ),
    ]);
}

#[test]
fn without_free_failures_the_first_one_is_free_all_the_same() {
    let own = submission(99, &run("a", Resumed(0), 20, "n9"));
    let others = shown(&submissions(&[run("b", Finished, 15, "n9")]));
    assert!(!others.history(&own, at(20)).blames_agent(Some("n9"), 0));
}

#[test]
fn within_a_day_every_attempt_of_the_team_counts_also_those_that_were_resumed() {
    let runs = [
        run("a", Failed(2), 10, "n1"),
        run("a", Resumed(1), 12, "n1"),
        run("a", Failed(4), -5, "n1"),
        run("b", Failed(8), 10, "n1"),
        run("a", Finished, 15, "n1"),
    ];
    let all = submissions(&runs);
    let teams = shown(&all);
    let found = teams.history(&all[0], at(20));
    assert_eq!((found.within_a_day, found.in_a_row), (3, 0));
    let mut nobodys = submission(9, &runs[0]);
    nobodys.spec.team = None;
    assert_eq!(teams.history(&nobodys, at(20)), TeamHistory::default());
}

#[test]
fn within_a_day_an_older_failure_of_the_same_submission_does_not_count() {
    const WEEK: i64 = 7 * 24;
    // Four failures each, and the hours of those that are remembered; it is hour 20.
    for (what, hours, expected) in [
        ("one a week", vec![19 - 2 * WEEK, 19 - WEEK, 19], (1, false)),
        ("two today", vec![19 - WEEK, 18, 19], (2, false)),
        ("as many today as are remembered, or more", vec![17, 18, 19], (3, true)),
        ("an older operator's, today", vec![], (1, true)),
    ] {
        let mut one = submission(0, &run("a", Failed(4), 19, "n1"));
        let failures = one.status.as_mut().unwrap().infrastructure_failures.as_mut().unwrap();
        failures.recent_times = hours.into_iter().map(|hour| Time(at(hour))).collect();
        let found = shown([&one]).history(&one, at(20));
        assert_eq!((found.within_a_day, found.may_be_more), expected, "{what}");
        assert_eq!(found.in_a_row, 4, "{what}");
    }
    let mut old = submission(0, &run("a", Failed(4), 20 - 24, "n1"));
    let failures = old.status.as_mut().unwrap().infrastructure_failures.as_mut().unwrap();
    failures.recent_times = Vec::new();
    let found = shown([&old]).history(&old, at(20));
    assert_eq!((found.within_a_day, found.may_be_more, found.in_a_row), (0, false, 4));
}

#[test]
fn a_leaderboard_shows_the_teams_with_the_most_failures_in_a_row() {
    let runs = [
        run("a", Failed(1), 10, "n1"),
        run("b", Failed(2), 11, "n1"),
        run("b", Resumed(1), 12, "n1"),
        run("c", Failed(5), 9, "n1"),
        run("c", Finished, 10, "n1"),
    ];
    let found: Vec<_> = shown(&submissions(&runs))
        .failures(&board())
        .into_iter()
        .map(|t| (t.team, t.number, t.last_time.0))
        .collect();
    assert_eq!(found, [("b".to_owned(), 3, at(12)), ("a".to_owned(), 1, at(10))]);
    let of_team = |i: usize| {
        let mut one = submission(i, &runs[0]);
        one.spec.team.as_mut().unwrap().name = Some(format!("team {i}"));
        one
    };
    let many: Vec<_> = (0..40).map(of_team).collect();
    assert_eq!(shown(&many).failures(&board()).len(), MAX_TEAMS);
}

#[test]
fn the_teams_that_have_used_the_most_come_first_and_no_more_than_ten() {
    let used = |number: usize, team: &str, gpu_seconds: i64| {
        let mut one = submission(number, &run("a", Resumed(0), 10, "n1"));
        one.spec.team.as_mut().unwrap().name = Some(team.to_owned());
        let status = one.status.as_mut().unwrap();
        status.infrastructure_failures = None;
        status.usage = Some(Use { gpus: 4, gpu_seconds });
        one
    };
    let sums = |all: &[Submission]| -> Vec<(String, i64)> {
        let found = shown(all).gpu_use(&board()).into_iter();
        found.map(|team| (team.team, team.gpu_seconds)).collect()
    };
    let all = [("b", 5), ("a", 3), ("b", 7), ("c", 0), ("d", 12)];
    let all: Vec<_> = (0..)
        .zip(all)
        .map(|(i, (team, seconds))| used(i, team, seconds))
        .collect();
    assert_eq!(sums(&all), [("b".into(), 12), ("d".into(), 12), ("a".into(), 3)]);
    let many: Vec<_> = (1..=30)
        .map(|i| used(i, &format!("team-{i}"), i64::try_from(i).unwrap()))
        .collect();
    assert_eq!(sums(&many).len(), MAX_USING_TEAMS);
    assert_eq!(sums(&many)[0], ("team-30".into(), 30));
}

#[test]
fn whatever_changes_the_sums_are_those_of_what_is_there() {
    let state = |teams: &Teams, own: &Submission| {
        let board = board();
        (
            teams.history(own, at(20)),
            teams.failures(&board),
            teams.gpu_use(&board),
        )
    };
    let own = submission(99, &run("a", Resumed(0), 20, "n9"));
    let before = submissions(&twice_and(vec![
        run("b", Finished, 15, "n3"),
        run("c", Failed(1), 16, "n4"),
    ]));
    let mut after = before.clone();
    // One has used a GPU, one fails again, one is resumed and runs, one is gone.
    after[0].status.as_mut().unwrap().usage = Some(Use {
        gpus: 1,
        gpu_seconds: 60,
    });
    after[1] = submission(1, &run("a", Failed(2), 17, "n7"));
    after[3].status.as_mut().unwrap().infrastructure_failures = None;
    after.remove(2);
    let teams = shown(&before);
    teams.changed(Some(&before[0]), Some(&after[0]));
    teams.changed(Some(&before[1]), Some(&after[1]));
    teams.changed(Some(&before[2]), None);
    teams.changed(Some(&before[3]), Some(&after[2]));
    assert_eq!(state(&teams, &own), state(&shown(&after), &own));
    assert_eq!(
        (state(&teams, &own).0.in_a_row, state(&teams, &own).2[0].gpu_seconds),
        (3, 60)
    );
    for one in &after {
        teams.changed(Some(one), None);
    }
    assert!(lock(&teams.0).is_empty(), "nothing is left of what is gone");
}

#[test]
fn a_finish_counts_although_it_was_deleted_and_no_more_than_a_thousand_are_kept() {
    let all = submissions(&[
        run("a", Failed(1), 10, "n1"),
        run("a", Finished, 11, "n1"),
        run("a", Failed(2), 12, "n2"),
    ]);
    let teams = shown(&all);
    teams.changed(Some(&all[1]), None);
    assert_eq!(teams.history(&all[0], at(20)).in_a_row, 2);
    let hours = 0..i64::try_from(FINISHES).unwrap() + 500;
    let many: Vec<_> = hours.map(|hour| run("b", Finished, hour, "n3")).collect();
    let teams = shown(&submissions(&many));
    let boards = lock(&teams.0);
    let kept = &boards["n/lb"].finishes;
    assert_eq!((kept.len(), kept.first().unwrap().at), (FINISHES, at(500)));
}
