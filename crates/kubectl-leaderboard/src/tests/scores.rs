//! `scores`: who leads, as text, JSON and for a spreadsheet.

use serde_json::{Value, json};

use super::docs::assert_documented;
use super::{assert_width, condition, finished, frame, leaderboard, named, running, with};
use crate::scores::{Board, boards, comma_separated, nothing, text};
use crate::text::Frame;
use leaderboard_api::{Leaderboard, Submission};

/// The Leaderboard with a ranking, and with a stored row of a Submission that is gone.
fn ranked() -> Leaderboard {
    let mut board = serde_json::to_value(leaderboard()).unwrap();
    board["status"]["tracks"] = json!([{
        "name": "sensors", "carla": {"pairs": 4, "routes": 20, "repetitions": 1},
        "ranking": {"metric": "Driving score", "order": "Descending"},
        "standings": [{
            "rank": 1, "team": "Team Nine", "teamId": "9", "submission": "submission-17", "uid": "gone",
            "score": {"name": "Driving score", "value": "40.02", "text": "40.02"},
            "metrics": [{"name": "Route completion", "value": "71.30"}, {"name": "Infraction penalty", "value": "0.610"}],
            "attempt": 1, "submittedAt": "2026-09-30T20:00:00Z", "finishedAt": "2026-10-01T08:30:00Z",
        }],
    }]);
    serde_json::from_value(board).unwrap()
}

fn scored(name: &str, team: &str, score: &str) -> Submission {
    let status = json!({
        "team": {"id": team, "name": team}, "track": "sensors",
        "score": {"name": "Driving score", "value": score, "text": score, "final": true},
        "metrics": [{"name": "Route completion", "value": "80.00"}, {"name": "Infraction penalty", "value": "0.515"}],
        "times": {"submitted": "2026-11-01T10:00:00Z", "finished": "2026-11-01T11:57:00Z"},
    });
    named(name, &with(finished(), &status))
}

fn all() -> Vec<Submission> {
    vec![
        scored("submission-42", "Team Seven", "43.13"),
        scored("submission-43", "Team Seven", "38.90"),
        scored("submission-44", "Team Eight", "12.50"),
        named("submission-45", &running()),
    ]
}

fn ours() -> Vec<Board> {
    boards(&[ranked()], &all(), None)
}

#[test]
fn each_team_has_one_row_and_what_retention_has_deleted_counts() {
    let lines = text(&ours(), frame());
    assert_documented(&lines);
    assert_width(&lines);
    let rows: Vec<_> = ours().remove(0).rows;
    let rows: Vec<_> = rows.iter().map(|row| (row.rank, row.submission.as_str())).collect();
    assert_eq!(rows, [(1, "submission-42"), (2, "submission-17"), (3, "submission-44")]);
}

#[test]
fn a_narrow_page_leaves_metrics_out_and_cuts_no_name_of_a_submission() {
    let narrow = Frame { width: 80, ..frame() };
    let lines = text(&ours(), narrow);
    assert!(lines.iter().all(|line| line.chars().count() <= 80), "{lines:#?}");
    assert!(
        lines[1].contains("DRIVING SCORE") && !lines[1].contains("INFRACTION"),
        "{lines:#?}"
    );
    assert!(lines[2].contains("submission-42"), "{lines:#?}");
    let wide = text(&ours(), Frame { width: 400, ..frame() });
    assert!(wide[1].contains("ROUTE COMPLETION  INFRACTION PENALTY"), "{wide:#?}");
}

#[test]
fn programs_get_what_the_status_has() {
    let value = json!(ours());
    assert_eq!(
        value[0]["ranking"],
        json!({"metric": "Driving score", "order": "Descending"})
    );
    assert_eq!(
        (&value[0]["leaderboard"], &value[0]["track"]),
        (&json!("carla-20"), &json!("sensors"))
    );
    let first = &value[0]["standings"][0];
    assert_eq!(
        (&first["rank"], &first["team"], &first["score"]["value"]),
        (&json!(1), &json!("Team Seven"), &json!("43.13"))
    );
}

#[test]
fn a_spreadsheet_gets_a_line_for_each_row_and_no_formula() {
    let mut all = all();
    all.push(scored("submission-46", "=HYPERLINK(\"http://x\",\"a\")", "1.00"));
    let lines = comma_separated(&boards(&[ranked()], &all, None));
    assert_eq!(
        lines,
        [
            "namespace,leaderboard,track,rank,team,metric,score,Route completion,Infraction penalty,submission,attempt,submitted,finished",
            "carla,carla-20,sensors,1,Team Seven,Driving score,43.13,80.00,0.515,submission-42,1,2026-11-01T10:00:00Z,2026-11-01T11:57:00Z",
            "carla,carla-20,sensors,2,Team Nine,Driving score,40.02,71.30,0.610,submission-17,1,2026-09-30T20:00:00Z,2026-10-01T08:30:00Z",
            "carla,carla-20,sensors,3,Team Eight,Driving score,12.50,80.00,0.515,submission-44,1,2026-11-01T10:00:00Z,2026-11-01T11:57:00Z",
            r#"carla,carla-20,sensors,4,"'=HYPERLINK(""http://x"",""a"")",Driving score,1.00,80.00,0.515,submission-46,1,2026-11-01T10:00:00Z,2026-11-01T11:57:00Z"#,
        ]
    );
}

#[test]
fn a_leaderboard_that_the_operator_has_not_looked_at_ranks_nothing() {
    let found = boards(&[leaderboard()], &all(), None);
    assert_eq!(
        text(&found, frame()),
        ["carla-20, track sensors", "No result ranks yet."]
    );
}

#[test]
fn a_submission_of_another_namespace_or_leaderboard_does_not_rank() {
    let elsewhere = |field: &str, change: &str| {
        let mut one: Value = serde_json::to_value(scored("submission-50", "x", "99.00")).unwrap();
        *one.pointer_mut(field).unwrap() = json!(change);
        serde_json::from_value::<Submission>(one).unwrap()
    };
    let others = [
        elsewhere("/metadata/namespace", "other"),
        elsewhere("/spec/leaderboardName", "other"),
    ];
    assert!(
        boards(&[ranked()], &others, None)[0]
            .rows
            .iter()
            .all(|row| row.submission == "submission-17")
    );
    let mut cancelled = finished();
    cancelled["conditions"][2] = condition("Published", "False", "CancelledInEvalAI", "");
    let cancelled = named("submission-51", &cancelled);
    let found = boards(&[ranked()], &[cancelled], None);
    assert!(found[0].rows.iter().all(|row| row.submission == "submission-17"));
}

#[test]
fn an_unknown_track_is_answered_with_the_tracks() {
    let board = [ranked()];
    assert_eq!(boards(&board, &[], Some("map")), []);
    assert_eq!(
        nothing(&board, Some("map"), "carla"),
        "there is no track map. The tracks are sensors"
    );
    let none = "there is no such Leaderboard in namespace carla. Use -n NAMESPACE, or -A";
    assert_eq!(nothing(&[], None, "carla"), none);
}
