use serde_json::{Value, json};

use super::*;

fn driving(order: Order) -> Ranking {
    Ranking {
        metric: "Driving score".into(),
        order,
    }
}

/// A finished submission of a team, submitted at this minute.
fn finished(name: &str, team: &str, score: &str, minute: u8) -> Value {
    json!({
        "apiVersion": "leaderboard.carla.org/v1alpha1", "kind": "Submission",
        "metadata": {"name": name, "namespace": "carla", "uid": format!("uid-{name}")},
        "spec": {"leaderboardName": "lb", "image": "i", "track": "sensors"},
        "status": {
            "attempt": 1, "track": "sensors", "team": {"id": team, "name": format!("Team {team}")},
            "score": {"name": "Driving score", "value": score, "text": score, "final": true},
            "metrics": [{"name": "Route completion", "value": "80.00"}, {"name": "Infraction penalty", "value": "0.500"}],
            "times": {"submitted": format!("2026-01-01T00:{minute:02}:00Z"), "finished": "2026-01-02T00:00:00Z"},
            "conditions": [condition("Finished", "True", "Finished"), condition("Published", "True", "Published")],
        },
    })
}

fn condition(type_: &str, status: &str, reason: &str) -> Value {
    json!({"type": type_, "status": status, "reason": reason, "message": "", "lastTransitionTime": "2026-01-02T00:00:00Z"})
}

fn objects(all: impl IntoIterator<Item = Value>) -> Vec<Submission> {
    all.into_iter()
        .map(|one| serde_json::from_value(one).unwrap())
        .collect()
}

fn of(ranking: &Ranking, all: &[Submission], stored: &[Standing]) -> Vec<(i32, String, String)> {
    let rows = standings("sensors", ranking, all, stored).into_iter();
    rows.map(|row| (row.rank, row.submission, row.score.value)).collect()
}

fn rows(expected: &[(i32, &str, &str)]) -> Vec<(i32, String, String)> {
    let rows = expected.iter();
    rows.map(|(rank, name, score)| (*rank, (*name).to_owned(), (*score).to_owned()))
        .collect()
}

#[test]
fn each_team_has_its_best_result_in_the_order_of_the_metric() {
    let all = objects([
        finished("s-1", "a", "40.00", 1),
        finished("s-2", "b", "9.50", 2),
        finished("s-3", "a", "43.13", 3),
        finished("s-4", "c", "100.00", 4),
    ]);
    for (order, expected) in [
        (
            Order::Descending,
            [(1, "s-4", "100.00"), (2, "s-3", "43.13"), (3, "s-2", "9.50")],
        ),
        (
            Order::Ascending,
            [(1, "s-2", "9.50"), (2, "s-1", "40.00"), (3, "s-4", "100.00")],
        ),
    ] {
        assert_eq!(of(&driving(order), &all, &[]), rows(&expected), "{order:?}");
    }
}

#[test]
fn of_two_equal_results_the_earlier_leads_in_any_order_of_the_list() {
    let mut all = objects([
        finished("s-1", "a", "40.00", 3),
        finished("s-2", "b", "40.000", 1),
        finished("s-3", "c", "40", 2),
        finished("s-4", "a", "40.00", 0),
        finished("s-5", "d", "40.00", 2),
    ]);
    let expected = rows(&[
        (1, "s-4", "40.00"),
        (2, "s-2", "40.000"),
        (3, "s-3", "40"),
        (4, "s-5", "40.00"),
    ]);
    for order in [Order::Descending, Order::Ascending] {
        for _ in 0..all.len() {
            all.rotate_left(1);
            assert_eq!(of(&driving(order), &all, &[]), expected);
        }
    }
}

#[test]
fn what_has_no_result_that_counts_does_not_rank() {
    let changed = |path: &str, value: Value| {
        let mut one = finished("s-1", "a", "40.00", 1);
        *one.pointer_mut(path).unwrap() = value;
        one
    };
    let with = |field: &str, value: Value| {
        let mut one = finished("s-1", "a", "40.00", 1);
        one["spec"][field] = value;
        one
    };
    let conditions = |all: Value| changed("/status/conditions", all);
    let cases = [
        ("a check", with("check", json!(true))),
        ("another track", changed("/status/track", json!("map"))),
        ("no status", changed("/status", Value::Null)),
        ("running", conditions(json!([condition("Running", "True", "Running")]))),
        (
            "failed",
            changed("/status/conditions/0", condition("Finished", "True", "AgentCrashed")),
        ),
        ("not final", changed("/status/score/final", json!(false))),
        ("no number", changed("/status/score/value", json!("NaN"))),
        ("no score", changed("/status/score", Value::Null)),
        (
            "cancelled in EvalAI",
            changed(
                "/status/conditions/1",
                condition("Published", "False", "CancelledInEvalAI"),
            ),
        ),
    ];
    for (name, one) in cases {
        assert_eq!(of(&driving(Order::Descending), &objects([one]), &[]), [], "{name}");
    }
    let waits = changed("/status/conditions/1", condition("Published", "False", "Waiting"));
    assert_eq!(of(&driving(Order::Descending), &objects([waits]), &[]).len(), 1);
}

#[test]
fn the_score_is_the_metric_that_ranks_and_the_others_follow() {
    let all = objects([finished("s-1", "a", "40.00", 1)]);
    let completion = Ranking {
        metric: "Route completion".into(),
        order: Order::Descending,
    };
    let row = standings("sensors", &completion, &all, &[]).remove(0);
    assert_eq!(
        (row.score.name.as_str(), row.score.value.as_str()),
        ("Route completion", "80.00")
    );
    let names = |row: &Standing| row.metrics.iter().map(|metric| metric.name.clone()).collect::<Vec<_>>();
    assert_eq!(names(&row), ["Driving score", "Infraction penalty"]);
    // The metric that ranks is another one now: a stored row has both.
    let again = standings("sensors", &driving(Order::Descending), &[], &[row]).remove(0);
    assert_eq!(
        (again.score.value.as_str(), again.metric("Route completion")),
        ("40.00", Some("80.00"))
    );
    let unknown = Ranking {
        metric: "Comfort".into(),
        order: Order::Descending,
    };
    assert_eq!(standings("sensors", &unknown, &all, &[again]), []);
}

#[test]
fn a_stored_row_stays_while_its_submission_is_gone_and_leaves_when_that_no_longer_ranks() {
    let ranking = driving(Order::Descending);
    let all = objects([finished("s-1", "a", "40.00", 1), finished("s-2", "b", "30.00", 2)]);
    let stored = standings("sensors", &ranking, &all, &[]);
    assert_eq!(standings("sensors", &ranking, &[], &stored), stored);
    assert_eq!(
        standings("sensors", &ranking, &all, &stored),
        stored,
        "nothing counts twice"
    );

    let mut cancelled = finished("s-1", "a", "40.00", 1);
    cancelled["status"]["conditions"][1] = condition("Published", "False", "CancelledInEvalAI");
    let left = of(&ranking, &objects([cancelled]), &stored);
    assert_eq!(left, rows(&[(1, "s-2", "30.00")]));

    // A message for s-1 came once more after its retention. The new object has no result, so the old one stays.
    let mut anew = finished("s-1", "a", "40.00", 1);
    anew["metadata"]["uid"] = json!("another");
    anew["status"]["conditions"] = json!([condition("Finished", "True", "EndedInEvalAI")]);
    assert_eq!(
        of(&ranking, &objects([anew]), &stored),
        rows(&[(1, "s-1", "40.00"), (2, "s-2", "30.00")])
    );

    let better = objects([finished("s-3", "b", "50.00", 3)]);
    assert_eq!(
        of(&ranking, &better, &stored),
        rows(&[(1, "s-3", "50.00"), (2, "s-1", "40.00")])
    );
}

#[test]
fn teams_are_told_apart_by_id_then_name_and_a_submission_without_a_team_by_itself() {
    let team = |name: &str, team: Value, minute| {
        let mut one = finished(name, "", "40.00", minute);
        one["status"]["team"] = team;
        one
    };
    let all = objects([
        team("s-1", json!({"id": "7", "name": "Old name"}), 1),
        team("s-2", json!({"id": "7", "name": "New name"}), 2),
        team("s-3", json!({"id": "8", "name": "New name"}), 3),
        team("s-4", json!({"name": "New name"}), 4),
        team("s-5", json!({"name": "New name"}), 5),
        team("s-6", Value::Null, 6),
        team("s-7", Value::Null, 7),
    ]);
    let names: Vec<String> = of(&driving(Order::Descending), &all, &[])
        .into_iter()
        .map(|row| row.1)
        .collect();
    assert_eq!(names, ["s-1", "s-3", "s-4", "s-6", "s-7"]);
}

#[test]
fn the_status_has_room_for_twenty_rows_of_a_track_and_a_bounded_number_of_bytes() {
    let long = |length| "\u{1f697}".repeat(length);
    let widest = |index: usize| {
        let mut one = finished(&format!("s-{index:0>50}"), &long(300), "40.00", 1);
        let team = format!("{index} {}", long(300));
        one["status"]["team"] = json!({"id": team, "name": team});
        let metrics = (0..32).map(|metric| json!({"name": format!("{metric} {}", long(60)), "value": "1".repeat(32)}));
        one["status"]["metrics"] = metrics.collect();
        one
    };
    let all = objects((0..40).map(widest));
    let rows = standings("sensors", &driving(Order::Descending), &all, &[]);
    assert_eq!(rows.len(), 40);
    let bytes = |rows: &[Standing]| serde_json::to_string(rows).unwrap().len();
    assert_eq!(shown(rows.clone(), 1).len(), MAX_STANDINGS);
    let each = shown(rows.clone(), 32);
    assert!(!each.is_empty() && each.len() < MAX_STANDINGS && bytes(&each) * 32 <= MAX_STANDINGS_BYTES + 32 * 2);
    // CARLA's rows fit whatever their teams are called.
    let mut carla = rows;
    for row in &mut carla {
        row.metrics.truncate(2);
        for (metric, name) in row.metrics.iter_mut().zip(["Route completion", "Infraction penalty"]) {
            (metric.name, metric.value) = (name.into(), "80.00".into());
        }
        row.team_id = Some("1234567890".into());
        row.team = long(MAX_STANDING_TEAM);
    }
    assert_eq!(shown(carla, 32).len(), MAX_STANDINGS);
}
