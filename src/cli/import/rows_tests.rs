use super::*;
use leaderboard_api::{State, SubmissionStatus};
use serde_json::{Value, json};

fn board(name: &str, more: &Value) -> Leaderboard {
    let mut spec = json!({
        "tracks": [{"name": "sensors", "codename": "SENSORS"}], "leaderboardVersion": "V2",
        "contents": {"image": "contents:1"}, "simulator": {"image": "simulator:1"},
        "storage": {"bucket": "results"}, "table": {"name": "leaderboard-20"},
    });
    for (key, value) in more.as_object().unwrap() {
        spec[key] = value.clone();
    }
    let mut board = Leaderboard::new(name, serde_json::from_value(spec).unwrap());
    board.metadata.namespace = Some("challenge".into());
    board
}

fn boards() -> Vec<Leaderboard> {
    let token = json!({"secretKeyRef": {"name": "a", "key": "b"}});
    let evalai = |phase: i64| {
        json!({"evalai": {"apiServer": "https://eval.ai", "challenge": 2098, "token": token},
               "tracks": [{"name": "map", "codename": "MAP", "phase": phase}]})
    };
    vec![
        board("leaderboard-10", &evalai(4171)),
        board("leaderboard-20", &evalai(4173)),
        board("local", &json!({})),
    ]
}

fn row(status: &str, attempt: Option<i64>, more: &[(&str, &str)]) -> StoredRow {
    let mut columns = BTreeMap::from([
        ("submission_status", status),
        ("team_name", "Team Seven"),
        ("track_id", "4173"),
        ("track_name", "MAP"),
        ("submitted_image_uri", "registry.example/team-7:1"),
        ("submitted_time", "2026-11-20 10:00:00 UTC"),
        ("start_time", "2026-11-20 10:05:00 UTC"),
        ("end_time", "2026-11-20 12:00:00 UTC"),
    ]);
    columns.extend(more.iter().copied());
    StoredRow {
        team_id: "7".into(),
        run_id: "77".into(),
        attempt,
        columns: columns
            .into_iter()
            .map(|(name, text)| (name.to_owned(), text.to_owned()))
            .collect(),
    }
}

fn decided(row: &StoredRow) -> Outcome {
    outcome(row, &boards(), "leaderboard-20")
}

fn ended(row: &StoredRow) -> (Submission, ImportedEnd) {
    match decided(row) {
        Outcome::Ended(ended) => *ended,
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_finished_row_of_the_original_becomes_a_submission_with_its_score() {
    let metrics = [
        ("driving_score", "41.237"),
        ("route_completion", "80.5"),
        ("infraction_penalty", "0.5151"),
        ("results", "s3://leaderboard-20/77"),
    ];
    let (submission, end) = ended(&row("FINISHED", None, &metrics));
    assert_eq!(submission.name_any(), "submission-77");
    assert_eq!(submission.namespace().as_deref(), Some("challenge"));
    assert_eq!(submission.annotations()[names::ANNOTATION_IMPORTED], "leaderboard-20");
    assert_eq!(submission.labels()[names::LABEL_PHASE], "4173");
    let spec = &submission.spec;
    assert_eq!(
        (spec.leaderboard_name.as_str(), spec.attempt),
        ("leaderboard-20", Attempt(1))
    );
    let evalai = spec.evalai.unwrap();
    assert_eq!((evalai.challenge, evalai.phase, evalai.submission), (2098, 4173, 77));
    let now = Time(Timestamp::UNIX_EPOCH);
    let status = SubmissionStatus::of_imported(spec, end, 1, &now);
    assert_eq!(
        (status.state, status.track.as_deref()),
        (Some(State::Finished), Some("map"))
    );
    assert_eq!(status.score.as_ref().map(|score| score.text.as_str()), Some("41.24"));
    assert_eq!(status.results_url.as_deref(), Some("s3://leaderboard-20/77"));
    assert_eq!(status.team.unwrap().display_name.as_deref(), Some("Team Seven"));
    assert_eq!(status.times.finished.unwrap().0.to_string(), "2026-11-20T12:00:00Z");
    assert_eq!(
        status.conditions[0].last_transition_time.0.to_string(),
        "2026-11-20T12:00:00Z"
    );
}

#[test]
fn the_states_of_ended_rows_are_kept_and_only_a_finished_one_has_a_score() {
    for (status, state) in [
        ("FINISHED", ImportedState::Finished),
        ("FAILED", ImportedState::Failed),
        ("CANCELLED", ImportedState::Cancelled),
        ("finished", ImportedState::Finished),
    ] {
        let (submission, end) = ended(&row(
            status,
            Some(3),
            &[("driving_score", "0.0"), ("progress", "12/20")],
        ));
        assert_eq!((submission.spec.attempt, end.state), (Attempt(3), state));
        assert_eq!(end.score.is_some(), state == ImportedState::Finished, "{status}");
        assert_eq!(end.progress.map(|progress| progress.text).as_deref(), Some("12/20"));
    }
}

#[test]
fn a_live_row_of_ours_is_taken_up_by_the_next_attempt() {
    for status in LIVE {
        let Outcome::Adopted(submission) = decided(&row(status, Some(2), &[])) else {
            panic!("{status}")
        };
        assert_eq!(submission.spec.attempt, Attempt(3));
        assert!(
            submission.metadata.annotations.is_none(),
            "the controller begins at once"
        );
    }
}

#[test]
fn what_a_person_has_to_decide_is_named() {
    for (row, why) in [
        (row("RUNNING", None, &[]), "another pipeline may still run it"),
        (row("SUBMITTED", None, &[]), "another pipeline may still run it"),
        (
            row("FINISHED", None, &[("track_id", "9")]),
            "track_id 9 is the phase of no Leaderboard",
        ),
        (row("FINISHED", None, &[("track_id", "x\ny")]), "track_id x y is"),
        (row("FINISHED", None, &[("track_id", "")]), "no track_id"),
        (row("DANCING", None, &[]), "status DANCING is not known"),
        (row("", None, &[]), "is not known"),
    ] {
        let Outcome::Undecided(found) = decided(&row) else {
            panic!("{row:?}")
        };
        assert!(found.to_string().contains(why), "{found}");
    }
    let mut other = row("FINISHED", None, &[]);
    other.run_id = "0".into();
    assert_eq!(decided(&other), Outcome::Undecided(Undecided::Id));
}

#[test]
fn a_local_row_is_known_by_its_track_and_needs_a_name_and_an_image() {
    let local = [("track_id", "-"), ("track_name", "SENSORS")];
    let mut row = row("FINISHED", Some(1), &local);
    row.run_id = "first".into();
    let (submission, _) = ended(&row);
    assert_eq!(
        (submission.name_any().as_str(), submission.spec.track.as_deref()),
        ("first", Some("sensors"))
    );
    assert_eq!(submission.spec.evalai, None);
    row.columns.insert("submitted_image_uri".into(), "not an image".into());
    assert_eq!(decided(&row), Outcome::Undecided(Undecided::Image));
    row.run_id = "Not.A.Name".into();
    assert_eq!(decided(&row), Outcome::Undecided(Undecided::Name));
}

#[test]
fn nothing_that_a_stranger_wrote_is_taken_as_it_is() {
    let strange = [
        ("team_name", "a\u{1b}[31mb"),
        ("submitted_image_uri", "Not An Image"),
        ("results", "https://evil.example"),
        ("progress", "30/20"),
        ("driving_score", "NaN"),
        ("end_time", "yesterday"),
        ("submitted_time", "-000005-01-01T00:00:00Z"),
        ("start_time", "2026-11-20T10:05:00Z"),
    ];
    let (submission, end) = ended(&row("FINISHED", None, &strange));
    assert_eq!(submission.spec.team.unwrap().name.as_deref(), Some("a\u{fffd}[31mb"));
    assert_eq!(submission.spec.image, None);
    assert_eq!((end.results_url, end.progress, end.score), (None, None, None));
    assert_eq!((end.times.finished, end.times.submitted), (None, None));
    assert_eq!(end.times.started.unwrap().0.to_string(), "2026-11-20T10:05:00Z");
}

#[test]
fn a_forged_score_is_no_score_and_no_text_of_it_is_longer_than_a_status_takes() {
    for (column, forged) in [
        ("infraction_penalty", "1e60"),
        ("infraction_penalty", "1.001"),
        ("infraction_penalty", "-0.5"),
        ("infraction_penalty", "inf"),
        ("route_completion", "1e60"),
        ("route_completion", "-1e60"),
        ("route_completion", "100.1"),
        ("route_completion", "NaN"),
    ] {
        let score = ended(&row("FINISHED", None, &[("driving_score", "50"), (column, forged)])).1;
        let score = score.score.unwrap();
        let parts = [score.route_completion, score.infraction_penalty];
        assert_eq!(parts, [None, None], "{column} {forged}");
        assert_eq!((score.driving.as_str(), score.text.as_str()), ("50.00", "50.00"));
    }
    let longest = [
        ("driving_score", "100"),
        ("route_completion", "99.99999999999999999999999999999999999999"),
        ("infraction_penalty", "0.00000000000000000000000000000000000001"),
    ];
    let score = ended(&row("FINISHED", None, &longest)).1.score.unwrap();
    let texts = [
        score.driving,
        score.text,
        score.route_completion.unwrap(),
        score.infraction_penalty.unwrap(),
    ];
    assert!(texts.iter().all(|text| text.len() <= 32), "{texts:?}");
}
