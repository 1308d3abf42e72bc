use serde_json::{Value, json};

use super::*;
use crate::bridge::ingest::Source;

const US: &str = "ns/operator";
const NOW: i64 = 1_800_000_000_000;

fn board(name: &str, second: i64, evalai: &Value) -> Arc<Leaderboard> {
    let created = Timestamp::from_second(second).unwrap().to_string();
    let mut board: Leaderboard = serde_json::from_value(json!({
        "apiVersion": "leaderboard.carla.org/v1alpha1", "kind": "Leaderboard",
        "metadata": {"name": name, "namespace": "ns", "creationTimestamp": created},
        "spec": {
            "evalai": {"apiServer": "https://e/", "challenge": 1, "token": {"secretKeyRef": {"name": "t", "key": "k"}}},
            "tracks": [{"name": "sensors", "codename": "SENSORS", "phase": 2}],
            "leaderboardVersion": "V2", "contents": {"image": "c"}, "simulator": {"image": "s"}, "storage": {"bucket": "bbb"},
        },
    }))
    .unwrap();
    let mut spec = serde_json::to_value(&board.spec.evalai).unwrap();
    for (key, value) in evalai.as_object().unwrap() {
        spec[key] = value.clone();
    }
    board.spec.evalai = serde_json::from_value(spec).unwrap();
    board.status.get_or_insert_default().operator = Some(US.into());
    Arc::new(board)
}

fn reader(name: &str, second: i64) -> Arc<Leaderboard> {
    board(name, second, &json!({"queue": {"name": "q"}}))
}

fn arrival(body: &Value, origin: Origin) -> Arrival {
    Arrival {
        server: "https://e".into(),
        queue: "q".into(),
        body: body.to_string(),
        origin,
    }
}

fn message(challenge: i64, phase: i64) -> Value {
    json!({"challenge_pk": challenge, "phase_pk": phase.to_string(), "submission_pk": 7, "submitted_image_uri": "r.example/a:1"})
}

fn wanted(seconds_ago: i64) -> Origin {
    Origin::Wanted(Timestamp::from_millisecond(NOW - 1000 * seconds_ago).unwrap())
}

fn judged(body: &Value, origin: Origin) -> Verdict {
    judge(&arrival(body, origin), &[reader("a", 1)], NOW, true)
}

#[test]
fn the_queue_belongs_to_the_leaderboards_that_name_it_on_its_server() {
    let mut going = Arc::unwrap_or_clone(reader("going", 0));
    going.metadata.deletion_timestamp = Some(k8s_openapi::apimachinery::pkg::apis::meta::v1::Time(
        Timestamp::UNIX_EPOCH,
    ));
    let mut theirs = Arc::unwrap_or_clone(reader("theirs", 0));
    theirs.status.get_or_insert_default().operator = Some("other/operator".into());
    let all = [
        Arc::new(going),
        Arc::new(theirs),
        board("without", 0, &json!({})),
        board("another", 0, &json!({"queue": {"name": "r"}})),
        board(
            "staging",
            0,
            &json!({"queue": {"name": "q"}, "apiServer": "https://staging"}),
        ),
        reader("young", 3),
        reader("old", 2),
    ];
    let found = readers(&all, US, &arrival(&message(1, 2), wanted(1)));
    let names: Vec<_> = found.iter().map(|leaderboard| leaderboard.name_any()).collect();
    assert_eq!(names, ["old", "young"]);
}

#[test]
fn the_time_of_the_row_is_the_messages_own() {
    let Verdict::Ingest {
        namespace,
        leaderboard,
        message: found,
        sent_ms,
    } = judged(&message(1, 2), wanted(60))
    else {
        panic!("it is taken in");
    };
    assert_eq!((namespace.as_str(), leaderboard.as_str()), ("ns", "a"));
    let incoming = incoming(&found, sent_ms);
    assert_eq!((incoming.challenge, incoming.phase, incoming.submission), (1, 2, 7));
    assert_eq!(incoming.image.as_deref(), Some("r.example/a:1"));
    assert_eq!(incoming.sent_ms, NOW - 60_000);
    assert_eq!(incoming.source, Source::Message(format!("evalai-{}", NOW - 60_000)));
    // A participant can write any time into the row.
    let Verdict::Ingest { sent_ms, .. } = judged(&message(1, 2), wanted(-86_400)) else {
        panic!("it is taken in");
    };
    assert_eq!(sent_ms, NOW);
}

#[test]
fn what_is_dropped_and_what_is_left() {
    let malformed = json!({"challenge_pk": 1});
    let fixed =
        json!({"challenge_pk": 1, "phase_pk": 2, "submission_pk": 7, "is_static_dataset_code_upload_submission": true});
    for (body, origin, dropped) in [
        (malformed, Origin::Hidden, Some("Malformed")),
        (json!("text"), Origin::Hidden, Some("Malformed")),
        (fixed, wanted(1), Some("Malformed")),
        (message(1, 2), Origin::Missing, Some("Malformed")),
        (message(1, 2), Origin::Foreign, Some("Malformed")),
        // Its Leaderboard may still be applied.
        (message(1, 3), wanted(800), None),
        (message(1, 3), wanted(1000), Some("UnknownPhase")),
        (message(1, 3), Origin::Hidden, None),
        (message(1, 2), Origin::Hidden, None),
        // Another challenge's are not ours, however old.
        (message(9, 2), wanted(1_000_000), None),
        (message(9, 2), Origin::Missing, None),
        (message(9, 2), Origin::Foreign, None),
    ] {
        let verdict = judged(&body, origin);
        let found = match &verdict {
            Verdict::Drop(reason) => Some(reason.as_str()),
            Verdict::Leave | Verdict::Foreign => None,
            Verdict::Ingest { .. } => panic!("{body} is taken in"),
        };
        assert_eq!(found, dropped, "{body} {origin:?}: {verdict:?}");
    }
}

#[test]
fn nothing_is_dropped_while_a_leaderboard_may_be_missing() {
    let unknown = arrival(&message(1, 3), wanted(1_000_000));
    assert_eq!(judge(&unknown, &[reader("a", 1)], NOW, false), Verdict::Leave);
    assert_eq!(
        judge(&arrival(&json!("text"), Origin::Hidden), &[], NOW, true),
        Verdict::Leave
    );
}

#[test]
fn a_message_waits_as_long_as_the_most_patient_reader_allows() {
    let patient = board(
        "patient",
        2,
        &json!({"queue": {"name": "q", "unknownAfterSeconds": 5000}}),
    );
    let both = [reader("a", 1), patient];
    assert_eq!(
        judge(&arrival(&message(1, 3), wanted(4000)), &both, NOW, true),
        Verdict::Leave
    );
    let dropped = judge(&arrival(&message(1, 3), wanted(6000)), &both, NOW, true);
    assert!(matches!(dropped, Verdict::Drop(DeadReason::Unknown(_))), "{dropped:?}");
}

#[test]
fn what_is_for_another_challenge_is_no_message_of_ours_that_waits() {
    assert_eq!(judged(&message(9, 2), wanted(1)), Verdict::Foreign);
    assert_eq!(judged(&message(1, 3), wanted(1)), Verdict::Leave);
}

#[tokio::test(start_paused = true)]
async fn a_queue_shows_its_oldest_message_until_that_is_deleted_or_does_not_come_back() {
    let metrics = Arc::new(Metrics::default());
    let mut waiting = Waiting::new(&metrics);
    let oldest = || {
        let text = metrics.text().unwrap();
        let sample = "leaderboard_queue_oldest_message_timestamp_seconds{queue=\"q\"} ";
        text.lines()
            .find_map(|line| line.strip_prefix(sample).map(str::to_owned))
    };
    let (first, second) = (message(1, 2), message(1, 3));
    let (first, second) = (arrival(&first, wanted(60)), arrival(&second, wanted(0)));
    for arrival in [&first, &second] {
        waiting.keep(arrival, sent_ms(arrival, NOW).unwrap());
    }
    assert_eq!(oldest().as_deref(), Some("1799999940"));
    waiting.forget(&first);
    assert_eq!(oldest().as_deref(), Some("1800000000"));
    let began = Instant::now();
    waiting.expired().await;
    assert_eq!(oldest(), None);
    assert_eq!(began.elapsed().as_secs(), SEEN_AGAIN.as_secs());
}

#[test]
fn a_time_of_the_future_makes_a_message_no_younger_than_now() {
    assert_eq!(sent_ms(&arrival(&message(1, 2), wanted(-60)), NOW), Some(NOW));
    assert_eq!(sent_ms(&arrival(&message(1, 2), Origin::Hidden), NOW), None);
}
