use super::*;
use crate::import::samples_tests::{Texts, answer, board, entries, texts};
use serde_json::json;

fn parsed(texts: &Texts) -> Pipeline {
    parse(&entries(texts)).unwrap()
}

fn problems(texts: &Texts) -> Vec<String> {
    parse(&entries(texts)).unwrap_err()
}

fn dropped(pipeline: &Pipeline) -> Vec<&str> {
    let names = pipeline.dropped.iter();
    names.map(|line| line.split_once(" (").unwrap().0).collect()
}

/// Without these entries.
fn without(names: &[&str]) -> Texts {
    let mut all = texts();
    all.retain(|name, _| !names.contains(name));
    all
}

#[test]
fn the_entries_of_the_original_are_read_whole() {
    let pipeline = parsed(&texts());
    assert_eq!(pipeline.api_server, "https://eval.ai");
    assert_eq!(pipeline.token_region, "us-west-2");
    let [ten, twenty] = pipeline.boards.as_slice() else {
        panic!("{pipeline:?}")
    };
    assert_eq!((ten.original.version, twenty.original.version), ("V1", "V2"));
    assert_eq!(
        twenty.contents_image,
        "123456789012.dkr.ecr.us-west-2.amazonaws.com/leaderboard-20:latest"
    );
    assert_eq!(twenty.bucket, "leaderboard-20");
    assert_eq!(twenty.log_group.as_deref(), Some("leaderboard-20"));
    assert_eq!(twenty.place.region, "us-west-2");
    assert_eq!(
        twenty.place.role,
        "arn:aws:iam::123456789012:role/leaderboard-submission-worker"
    );
    let tracks: Vec<_> = twenty.tracks.iter().map(|t| (t.phase, t.codename.as_str())).collect();
    assert_eq!(tracks, [(4172, "SENSORS"), (4173, "MAP")]);
    let of =
        |entry| ["certificate_authority", "endpoint", "logcopy_image", "name"].map(|key| format!("{entry}: {key}"));
    assert_eq!(
        dropped(&pipeline),
        [of("leaderboard-10"), of("leaderboard-20")].concat()
    );
}

#[test]
fn everything_that_is_missing_is_named_at_once() {
    let mut all = without(&["evalai-tracks"]);
    all.insert(EVALAI, json!({"auth_token": " "}));
    all.insert("leaderboard-10", json!({"s3_bucket": "b"}));
    all.remove("leaderboard-20");
    assert_eq!(
        problems(&all),
        [
            "there is no answer for the entry evalai-tracks; print that entry too",
            "the entry evalai lacks api_server; add what is missing",
            "evalai-tracks names no phase of leaderboard-10; add \"<phase id>\": \"leaderboard-10-sensors\" and so on, or leave \
             leaderboard-10 out",
            "the entry leaderboard-10 lacks simulator_image, leaderboard_image, dynamodb_submissions_table; add what is missing",
        ]
    );
    assert_eq!(
        problems(&without(&["leaderboard-10", "leaderboard-20"])),
        ["there is no answer for leaderboard-10 or leaderboard-20; print one of them too"]
    );
}

#[test]
fn what_cannot_be_right_is_named_without_its_text() {
    let change = |entry, key: &str, value: Value| {
        let mut all = texts();
        all.get_mut(entry).unwrap()[key] = value;
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
            change(EVALAI, "api_server", json!("https://very@secret")),
            "evalai: api_server is not the root",
        ),
        (
            change(EVALAI, "api_server", json!("https://very.secret\u{1b}[2J")),
            "evalai: api_server is not the root",
        ),
        (
            change(EVALAI, "api_server", json!("https://eval.ai/api")),
            "evalai: api_server is not the root",
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
fn a_text_that_is_no_object_and_an_answer_that_is_none_are_not_shown() {
    for entry in [EVALAI, TRACKS, "leaderboard-10"] {
        for text in ["", "very secret", "\"very secret\"", "[]", "7"] {
            let mut all = entries(&texts());
            all.append(&mut answers(&answer(entry, text).to_string()).unwrap());
            let found = parse(&all).unwrap_err();
            let wanted = format!("the entry {entry} is not a JSON object; store it as {{\"key\": \"text\", …}}");
            assert!(found.contains(&wanted), "{found:?}");
            assert!(found.iter().all(|problem| !problem.contains("secret")), "{found:?}");
        }
    }
    let mut all = entries(&texts());
    let elsewhere = json!({"ARN": "arn:aws:s3:::very-secret", "Name": TRACKS, "SecretString": "{}"});
    all.append(&mut answers(&elsewhere.to_string()).unwrap());
    let wanted = "the answer for evalai-tracks has no ARN of Secrets Manager; print it with its ARN";
    assert_eq!(parse(&all).unwrap_err()[0], wanted);
    for (text, line) in [
        ("{\"auth_token\": \"very secret\"}", 1),
        ("\nvery secret", 2),
        ("{\n\"ARN\":", 2),
    ] {
        assert_eq!(answers(text).err(), Some(line), "{text}");
    }
}

#[test]
fn the_token_may_be_left_out_and_only_it() {
    let mut all = texts();
    assert!(entries(&all)[EVALAI].has_token());
    all.insert(EVALAI, json!({"api_server": "https://evalai.example/"}));
    assert!(!entries(&all)[EVALAI].has_token());
    assert_eq!(parsed(&all).api_server, "https://evalai.example");
    let bare = |name: &str| {
        let mut all = entries(&texts());
        let arn = answer(name, "")["ARN"].clone();
        all.append(&mut answers(&json!({"ARN": arn, "Name": name}).to_string()).unwrap());
        all
    };
    assert!(!bare(EVALAI)[EVALAI].has_token());
    assert_eq!(parse(&bare(EVALAI)).unwrap().api_server, "https://eval.ai");
    assert_eq!(parse(&bare("leaderboard-10")).unwrap_err().len(), 1);
}

#[test]
fn phases_of_other_leaderboards_are_dropped_and_those_of_none_are_asked_for() {
    let mut all = without(&["leaderboard-10"]);
    let phases = json!({"1": "leaderboard-20:sensors", "2": "leaderboard-30-map", "3": "leaderboard-10-map"});
    all.insert(TRACKS, phases);
    let pipeline = parsed(&all);
    assert_eq!(pipeline.boards[0].tracks[0].codename, "SENSORS");
    let names = dropped(&pipeline);
    for wanted in ["evalai-tracks: 2", "evalai-tracks: the phases of leaderboard-10"] {
        assert!(names.contains(&wanted), "{names:?}");
    }
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
    all.insert("leaderboard-20", fields);
    let pipeline = parsed(&all);
    assert_eq!(pipeline.boards[1].table, "leaderboard-20");
    let unknown = "leaderboard-20: qualifier_map (the operator has nothing of this name)".to_owned();
    assert!(pipeline.dropped.contains(&unknown), "{pipeline:?}");
}
