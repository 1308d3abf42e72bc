use kube::ResourceExt;
use serde_json::{Value, json};

use super::*;
use leaderboard_evalai::answer::Refusal;
use leaderboard_evalai::{Hub, Options, Status};

const US: &str = "ns/operator";
const SERVER: &str = "https://e/";

fn board(name: &str, second: i64, server: &str, queue: &Value) -> Arc<Leaderboard> {
    let created = Timestamp::from_second(second).unwrap().to_string();
    let mut board: Leaderboard = serde_json::from_value(json!({
        "apiVersion": "leaderboard.carla.org/v1alpha1", "kind": "Leaderboard",
        "metadata": {"name": name, "namespace": "ns", "uid": name, "creationTimestamp": created},
        "spec": {
            "evalai": {"apiServer": server, "challenge": 1, "token": {"secretKeyRef": {"name": "t", "key": "k"}}},
            "tracks": [{"name": "sensors", "phase": 2}],
            "evaluation": {"carla": {
                "version": "V2", "contents": {"image": "c"}, "simulator": {"image": "s"},
            }}, "storage": {"s3": {"bucket": "bbb"}},
            "queue": queue,
        },
    }))
    .unwrap();
    board.status.get_or_insert_default().operator = Some(US.into());
    Arc::new(board)
}

fn reader(name: &str, second: i64) -> Arc<Leaderboard> {
    board(name, second, SERVER, &json!({"evalai": {"name": "q"}}))
}

fn inbox() -> Inbox {
    let (_stop, signal) = leaderboard_base::shutdown::Stop::new();
    let tasks = leaderboard_base::tasks::Tasks::new(signal);
    Inbox {
        way: Way {
            server: "https://e".into(),
            name: "q".into(),
            leaderboard: key_of(reader("old", 2).as_ref()),
        },
        hub: Hub::new(Options::unheard(&tasks, || true)),
        operator: US.into(),
        empty: 0,
        missing: BTreeMap::new(),
    }
}

#[test]
fn the_queue_belongs_to_the_leaderboards_that_name_it_on_its_server() {
    let mut going = Arc::unwrap_or_clone(reader("going", 0));
    going.metadata.deletion_timestamp = Some(k8s_openapi::apimachinery::pkg::apis::meta::v1::Time(
        Timestamp::UNIX_EPOCH,
    ));
    let mut theirs = Arc::unwrap_or_clone(reader("theirs", 0));
    theirs.status.get_or_insert_default().operator = Some("other/operator".into());
    let queue = |name: &str| json!({"evalai": {"name": name}});
    let all = [
        Arc::new(going),
        Arc::new(theirs),
        board("without", 0, SERVER, &Value::Null),
        board("another", 0, SERVER, &queue("r")),
        board("staging", 0, "https://staging", &queue("q")),
        reader("young", 3),
        reader("old", 2),
    ];
    let found = inbox().readers(&all);
    let names: Vec<_> = found.iter().map(|leaderboard| leaderboard.name_any()).collect();
    assert_eq!(names, ["old", "young"]);
    let ways: Vec<_> = desired(&all, US)
        .into_iter()
        .map(|(queue, way)| (queue, way.leaderboard.name))
        .collect();
    let wanted = [
        ("https://e: q", "old"),
        ("https://e: r", "another"),
        ("https://staging: q", "staging"),
    ];
    assert_eq!(ways, wanted.map(|(queue, name)| (queue.to_owned(), name.to_owned())));
}

#[test]
fn a_message_waits_as_long_as_the_most_patient_reader_allows() {
    let patient = json!({"evalai": {"name": "q", "unknownAfterSeconds": 5000}});
    let rules = inbox().rules(&[reader("a", 1), board("patient", 2, SERVER, &patient)]);
    assert_eq!((rules.unknown_after_ms, rules.is_common), (5_000_000, true));
}

#[test]
fn the_time_of_the_row_is_the_messages_own() {
    let now = Timestamp::from_second(1_800_000_000).unwrap();
    let row = |seconds: i64| Row {
        submitted_at: Some(Timestamp::from_second(1_800_000_000 + seconds).unwrap()),
        status: Status::Submitted,
        ..Row::missing(7)
    };
    let refused = |about, status, message: &str| {
        Answer::Refused(Refusal {
            about,
            status,
            message: message.into(),
        })
    };
    let of_another = "EvalAI answered 401: Sorry, you are not authorized to access this submission.";
    let hidden = || (None, Some("hidden"));
    for (answer, expected) in [
        (Answer::Done(row(-60)), (Some(1_799_999_940_000), None)),
        // A participant can write any time into the row.
        (Answer::Done(row(86_400)), (Some(1_800_000_000_000), None)),
        (Answer::Done(Row::missing(7)), hidden()),
        (
            refused(About::Missing, 404, "none"),
            (None, Some("EvalAI has no submission 7")),
        ),
        (
            refused(About::Request, 401, of_another),
            (None, Some("EvalAI does not show submission 7")),
        ),
        // A page of a proxy shows nothing of the submission.
        (refused(About::Request, 401, "a page"), hidden()),
    ] {
        let (sent, hindrance) = origin(7, answer.clone(), now).unwrap();
        let (wanted, why) = expected;
        assert_eq!(sent, wanted, "{answer:?}");
        let is_so = match &hindrance {
            None => why.is_none(),
            Some(Hindrance::Hidden) => why == Some("hidden"),
            Some(Hindrance::Unusable(text)) => why.is_some_and(|why| text.starts_with(why)),
        };
        assert!(is_so, "{answer:?}: {hindrance:?}");
    }
    let broken = origin(7, Answer::Broken("EvalAI answered 500".into()), now);
    assert_eq!(broken, Err("EvalAI answered 500".into()), "it is asked again");
}

#[tokio::test(start_paused = true)]
async fn one_answer_that_a_submission_is_not_there_is_none() {
    let mut inbox = inbox();
    assert!(inbox.is_first_miss(7) && inbox.is_first_miss(8));
    assert!(!inbox.is_first_miss(7), "its message came again");
    tokio::time::advance(MISSING).await;
    assert!(inbox.is_first_miss(8), "that was long ago");
}

#[tokio::test(start_paused = true)]
async fn an_empty_queue_is_asked_ever_more_slowly() {
    let mut inbox = inbox();
    let mut waits = Vec::new();
    for _ in 0..5 {
        let begun = Instant::now();
        // Its Leaderboard is not served: there is no answer.
        let received = inbox.receive(Duration::ZERO, &Clock::system()).await;
        assert!(received.unwrap().is_empty());
        waits.push(begun.elapsed().as_secs());
    }
    assert_eq!(waits, [0, 5, 10, 20, 20]);
}
