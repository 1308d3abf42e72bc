use leaderboard_api::Order;
use serde_json::{Value, json};

use super::*;

fn ranking(metric: &str, order: Order) -> Ranking {
    let metric = metric.to_owned();
    Ranking { metric, order }
}

/// A Leaderboard with two tracks, of which EvalAI has the first, and with these tracks in its status.
fn leaderboard(has_evalai: bool, tracks: &Value) -> Leaderboard {
    let evalai =
        json!({"apiServer": "https://e", "challenge": 1, "token": {"secretKeyRef": {"name": "t", "key": "k"}}});
    let object = json!({
        "apiVersion": "leaderboard.carla.org/v1alpha1", "kind": "Leaderboard",
        "metadata": {"name": "lb", "namespace": "ns"},
        "spec": {
            "evalai": has_evalai.then_some(evalai),
            "tracks": [{"name": "sensors", "phase": has_evalai.then_some(7)}, {"name": "map"}],
            "evaluation": {"carla": {"version": "V2", "contents": {"image": "c"}, "simulator": {"image": "s"}}},
            "storage": {"s3": {"bucket": "b"}},
        },
        "status": {"tracks": tracks},
    });
    serde_json::from_value(object).unwrap()
}

fn track(ranking: Option<&Ranking>, standings: &[Standing]) -> Value {
    let carla = json!({"pairs": 1, "routes": 1, "repetitions": 1});
    let mut track = json!({"name": "sensors", "carla": carla, "standings": standings});
    if let Some(ranking) = ranking {
        track["ranking"] = json!(ranking);
    }
    json!([track])
}

fn finished(name: &str, score: u32) -> Submission {
    let object = json!({
        "apiVersion": "leaderboard.carla.org/v1alpha1", "kind": "Submission",
        "metadata": {"name": name, "namespace": "ns", "uid": format!("uid-{name}")},
        "spec": {"leaderboardName": "lb", "image": "i", "track": "sensors"},
        "status": {
            "attempt": 1, "track": "sensors", "team": {"id": name},
            "score": {"name": "Driving score", "value": format!("{score}.00"), "text": "x", "final": true},
            "metrics": [{"name": "Route completion", "value": "80.00"}],
            "times": {"submitted": "2026-01-01T00:00:00Z"},
            "conditions": [{"type": "Finished", "status": "True", "reason": "Finished", "message": "",
                            "lastTransitionTime": "2026-01-01T00:00:00Z"}],
        },
    });
    serde_json::from_value(object).unwrap()
}

fn cancelled(name: &str, score: u32) -> Submission {
    let mut one = serde_json::to_value(finished(name, score)).unwrap();
    one["status"]["conditions"].as_array_mut().unwrap().push(json!(
        {"type": "Published", "status": "False", "reason": "CancelledInEvalAI", "message": "",
         "lastTransitionTime": "2026-01-01T00:00:00Z"}
    ));
    serde_json::from_value(one).unwrap()
}

fn rows(submissions: &[Submission]) -> Vec<Standing> {
    standings(
        "sensors",
        &ranking("Driving score", Order::Descending),
        submissions,
        &[],
    )
}

fn driving() -> Ranking {
    ranking("Driving score", Order::Descending)
}

fn completion() -> Ranking {
    ranking("Route completion", Order::Ascending)
}

/// A Leaderboard of EvalAI whose status has this ranking of the first track.
fn known(stored: Option<&Ranking>) -> Leaderboard {
    leaderboard(true, &track(stored, &[]))
}

/// Fails unless the first track ranks as expected, and the second, which has no phase, as its evaluation.
fn assert_ranked(name: &str, board: &Leaderboard, named: &Named, ranking: Ranking, lacking: Option<Ranking>) {
    let notes = notes(board, named);
    assert_eq!(notes.len(), usize::from(lacking.is_some()), "{name}: {notes:?}");
    let found = ranked(board, &board.spec.tracks[0], named);
    assert_eq!(found, Ranked { ranking, lacking }, "{name}");
    let local = ranked(board, &board.spec.tracks[1], named);
    assert_eq!(local.ranking, driving(), "{name}: a track without a phase");
}

#[test]
fn a_track_ranks_as_evalai_does_then_as_before_then_as_its_evaluation() {
    let named = || Some([(7, completion())].into());
    for (name, stored, named, expected) in [
        ("EvalAI's", None, named(), completion()),
        ("EvalAI's new one", Some(driving()), named(), completion()),
        ("EvalAI names none", Some(completion()), Some([].into()), driving()),
        ("not asked yet", None, None, driving()),
        ("not asked yet by a new leader", Some(completion()), None, completion()),
    ] {
        assert_ranked(name, &known(stored.as_ref()), &named, expected, None);
    }
    let local = leaderboard(false, &track(Some(&completion()), &[]));
    assert_ranked("local", &local, &None, driving(), None);
}

#[test]
fn a_metric_that_results_do_not_show_is_noted_and_ranks_nothing() {
    let comfort = ranking("Comfort", Order::Descending);
    let (board, named) = (known(None), Some([(7, comfort.clone())].into()));
    assert_ranked("not shown here", &board, &named, driving(), Some(comfort));
    assert_eq!(
        notes(&board, &named),
        [
            "EvalAI ranks the phase of track sensors by Comfort, which the status of a submission does not show: the standings here go by \
             Driving score, the highest first."
        ]
    );
}

#[test]
fn standings_are_made_anew_from_results_and_kept_without() {
    let stored = rows(&[finished("a", 40), finished("b", 30)]);
    let driving = ranking("Driving score", Order::Descending);
    let board = leaderboard(true, &track(Some(&driving), &stored));
    let of = |submissions: Vec<Submission>, gone: &[&str]| {
        let results = Results {
            submissions: submissions.into_iter().map(Arc::new).collect(),
            cancelled: gone.iter().map(|name| (*name).to_owned()).collect(),
        };
        let rows = of_track(&board, &board.spec.tracks[0], &driving, Some(&results));
        rows.into_iter().map(|row| row.submission).collect::<Vec<_>>()
    };
    assert_eq!(of_track(&board, &board.spec.tracks[0], &driving, None), stored);
    for (name, submissions, gone, expected) in [
        ("all are deleted", vec![], &[][..], &["a", "b"][..]),
        ("a better one", vec![finished("c", 50)], &[], &["c", "a", "b"]),
        ("cancelled here", vec![cancelled("a", 40)], &[], &["b"]),
        ("cancelled after it was deleted", vec![], &["a"], &["b"]),
        (
            "one that is still shown decides itself",
            vec![finished("a", 40)],
            &["a"],
            &["a", "b"],
        ),
    ] {
        assert_eq!(of(submissions, gone), expected, "{name}");
    }
    let many = (0..30)
        .map(|index| finished(&format!("many-{index:02}"), 60 + index))
        .collect();
    let found = of(many, &[]);
    assert_eq!(
        (found.len(), found[0].as_str(), found[19].as_str()),
        (20, "many-29", "many-10")
    );
}

#[test]
fn an_object_is_deleted_only_when_the_standings_are_right_without_it() {
    let best: Vec<Submission> = (0..20).map(|index| finished(&format!("best-{index:02}"), 50)).collect();
    let driving = || ranking("Driving score", Order::Descending);
    let with = |stored: &[Submission]| leaderboard(true, &track(Some(&driving()), &rows(stored)));
    let full = with(&best);
    for (name, board, submission, expected) in vec![
        ("not stored yet", with(&[]), finished("a", 40), false),
        ("stored", with(&[finished("a", 40)]), finished("a", 40), true),
        ("none of the best", full.clone(), finished("a", 40), true),
        ("one of the best", full, finished("a", 60), false),
        (
            "cancelled in EvalAI and still stored",
            with(&[finished("a", 40)]),
            cancelled("a", 40),
            false,
        ),
        ("cancelled in EvalAI", with(&[]), cancelled("a", 40), true),
        (
            "never looked at",
            leaderboard(true, &json!([])),
            finished("a", 40),
            false,
        ),
        (
            "an older version's status",
            leaderboard(true, &track(None, &[])),
            finished("a", 40),
            false,
        ),
        ("no result", leaderboard(true, &json!([])), cancelled("a", 40), true),
    ] {
        assert_eq!(can_spare(&board, &submission), expected, "{name}");
    }
    let mut elsewhere = with(&[]);
    elsewhere.spec.tracks.remove(0);
    assert!(can_spare(&elsewhere, &finished("a", 40)), "the track is gone");
}

#[test]
fn a_track_of_an_evaluator_ranks_by_its_own_score_or_by_what_evalai_names() {
    let board = |split: Option<&str>| {
        let mut board = leaderboard(true, &json!([]));
        let evaluation = json!({"container": {"mode": "Interactive", "image": "e", "command": ["/e"]}});
        board.spec.evaluation = serde_json::from_value(evaluation).unwrap();
        let score = json!({"split": split, "metric": "accuracy", "order": "Descending"});
        for track in &mut board.spec.tracks {
            track.container = Some(serde_json::from_value(json!({"score": score})).unwrap());
        }
        board
    };
    let named = || Some([(7, ranking("loss", Order::Ascending))].into_iter().collect());
    for (name, board, named, expected) in [
        (
            "not asked yet",
            board(None),
            None,
            ranking("accuracy", Order::Descending),
        ),
        ("EvalAI's", board(None), named(), ranking("loss", Order::Ascending)),
        (
            "its own of a split",
            board(Some("test")),
            None,
            ranking("test_accuracy", Order::Descending),
        ),
        (
            "EvalAI's of a split",
            board(Some("test")),
            named(),
            ranking("test_loss", Order::Ascending),
        ),
    ] {
        let found = ranked(&board, &board.spec.tracks[0], &named);
        assert_eq!((found.ranking, found.lacking), (expected, None), "{name}");
        assert_eq!(notes(&board, &named), Vec::<String>::new(), "{name}");
    }
}
