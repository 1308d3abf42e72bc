use super::*;
use crate::cli::import::samples::{board, texts, tracks};
use serde_json::json;

fn parsed(texts: &Texts) -> Entries {
    parse(texts, &Board::ALL).unwrap()
}

fn problems(texts: &Texts) -> Vec<String> {
    let found = parse(texts, &Board::ALL).unwrap_err();
    found.iter().map(ToString::to_string).collect()
}

#[test]
fn the_entries_of_the_original_are_read_whole() {
    let entries = parsed(&texts());
    assert_eq!(entries.api_server, "https://eval.ai");
    assert_eq!(entries.token, Ok(None));
    let [ten, twenty] = entries.boards.as_slice() else {
        panic!("{entries:?}")
    };
    assert_eq!((ten.board, twenty.board), (Board::Ten, Board::Twenty));
    assert_eq!(
        twenty.contents_image,
        "123456789012.dkr.ecr.us-west-2.amazonaws.com/leaderboard-20:latest"
    );
    assert_eq!(twenty.bucket, "leaderboard-20");
    assert_eq!(twenty.log_group.as_deref(), Some("leaderboard-20"));
    let tracks: Vec<_> = twenty.tracks.iter().map(|t| (t.phase, t.codename.as_str())).collect();
    assert_eq!(tracks, [(4172, "SENSORS"), (4173, "MAP")]);
    let dropped: Vec<_> = entries.dropped.iter().map(|d| (d.entry, d.key.as_str())).collect();
    let of = |entry| ["certificate_authority", "endpoint", "logcopy_image", "name"].map(|key| (entry, key));
    assert_eq!(dropped, [of("leaderboard-10"), of("leaderboard-20")].concat());
}

#[test]
fn everything_that_is_missing_is_named_at_once() {
    let mut texts = texts();
    texts.insert(EVALAI, json!({"auth_token": " "}).to_string());
    texts.insert("leaderboard-10", json!({"s3_bucket": "b"}).to_string());
    assert_eq!(
        problems(&texts),
        [
            "the entry evalai lacks api_server, auth_token; add what is missing",
            "the entry leaderboard-10 lacks simulator_image, leaderboard_image, dynamodb_submissions_table; add what is missing",
        ]
    );
}

#[test]
fn what_cannot_be_right_is_named_without_its_text() {
    let change = |entry, key: &str, value: Value| {
        let mut all = texts();
        let mut fields: Value = serde_json::from_str(&all[entry]).unwrap();
        fields[key] = value;
        all.insert(entry, fields.to_string());
        all
    };
    for (texts, text) in [
        (
            change("leaderboard-10", "simulator_image", json!("very secret")),
            "leaderboard-10: simulator_image is no reference to an image",
        ),
        (
            change("leaderboard-10", "s3_bucket", json!("very secret")),
            "leaderboard-10: s3_bucket has characters",
        ),
        (
            change("leaderboard-10", "s3_bucket", json!(["very secret"])),
            "leaderboard-10: s3_bucket is not a text",
        ),
        (
            change("evalai", "api_server", json!("https://very@secret")),
            "evalai: api_server is not the root",
        ),
        (
            change("evalai", "api_server", json!("https://eval.ai/api")),
            "evalai: api_server is not the root",
        ),
        (
            change("evalai", "auth_token", json!({"very": "secret"})),
            "evalai: auth_token is not a text",
        ),
        (
            change(TRACKS, "sensors", json!("leaderboard-20-sensors")),
            "evalai-tracks: sensors is not the id of a phase",
        ),
        (
            change(TRACKS, "5000", json!("verysecret")),
            "evalai-tracks: 5000 is not of the form",
        ),
    ] {
        let found = problems(&texts);
        assert!(found.len() == 1 && found[0].contains(text), "{found:?}");
        assert!(!found[0].contains("secret"), "{found:?}");
    }
}

#[test]
fn a_text_that_is_no_object_is_not_shown() {
    for entry in [EVALAI, TRACKS, "leaderboard-10"] {
        for text in ["", "very secret", "\"very secret\"", "[]", "7"] {
            let mut texts = texts();
            texts.insert(entry, text.to_owned());
            let want = format!("the entry {entry} is not a JSON object; store it as {{\"key\": \"text\", …}}");
            let mut found = problems(&texts);
            found.retain(|problem| problem != &want);
            assert!(found.iter().all(|problem| !problem.contains("secret")), "{found:?}");
        }
    }
}

#[test]
fn phases_of_other_leaderboards_are_dropped_and_those_of_none_are_asked_for() {
    let mut all = texts();
    all.insert(
        TRACKS,
        tracks(&[("1", "leaderboard-20:sensors"), ("2", "leaderboard-30-map")]),
    );
    let entries = parse(&all, &[Board::Twenty]).unwrap();
    assert_eq!(entries.boards[0].tracks[0].codename, "SENSORS");
    let other = entries.dropped.iter().find(|dropped| dropped.entry == TRACKS).unwrap();
    assert_eq!(other.key, "2");
    assert!(
        problems(&all)
            .iter()
            .all(|problem| problem.starts_with("evalai-tracks names no phase of leaderboard-10"))
    );
}

#[test]
fn both_spellings_of_the_table_are_read_and_unknown_keys_are_reported() {
    let mut all = texts();
    let mut fields = board("20");
    let table = fields
        .as_object_mut()
        .unwrap()
        .remove("dynamodb_submissions_table")
        .unwrap();
    fields["dynamodb_submissinons_table"] = table;
    fields["qualifier_map"] = json!("a:b");
    all.insert("leaderboard-20", fields.to_string());
    let entries = parsed(&all);
    assert_eq!(entries.boards[1].table, "leaderboard-20");
    let unknown = entries
        .dropped
        .iter()
        .find(|dropped| dropped.key == "qualifier_map")
        .unwrap();
    assert_eq!(unknown.why, "the operator has nothing of this name");
}

#[test]
fn a_token_that_evalai_refuses_does_not_stop_the_import() {
    let mut all = texts();
    let entry = json!({"auth_token": "two words", "api_server": "https://eval.ai/"});
    all.insert(EVALAI, entry.to_string());
    assert_eq!(parsed(&all).token, Err(TokenError::Characters));
}
