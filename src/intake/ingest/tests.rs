//! The whole table of what an incoming submission means.

use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;
use serde_json::Value;

use super::*;
use leaderboard_api::conditions::{self, Condition};

const BOARD: &str = "leaderboard-20";

fn incoming(source: Source, sent_ms: i64) -> Incoming {
    Incoming {
        evalai: EvalaiRef {
            challenge: 1,
            phase: 2,
            submission: 3,
        },
        image: Some("r.example/a:1".into()),
        source,
        sent_ms,
    }
}

fn message(id: &str, sent_ms: i64) -> Incoming {
    incoming(Source::Message(id.into()), sent_ms)
}

fn sweep(sent_ms: i64) -> Incoming {
    incoming(Source::Sweep(Swept::New), sent_ms)
}

/// A resume that the sweep finds, because its message was lost.
fn swept_resume(sent_ms: i64) -> Incoming {
    incoming(Source::Sweep(Swept::Resuming), sent_ms)
}

/// The object that the API server holds after the first `incoming`.
fn made_by(first: &Incoming) -> Submission {
    let Ingest::Create(fresh) = decide_ingest(BOARD, None, first) else {
        panic!("nothing exists, so it is created");
    };
    let mut made = *fresh;
    made.metadata.resource_version = Some("10".into());
    made.metadata.creation_timestamp = Some(Time(jiff::Timestamp::from_millisecond(first.sent_ms).unwrap()));
    made
}

fn with_state(mut made: Submission, state: State) -> Submission {
    let condition = |type_: &str, is_true: bool| Condition {
        type_: type_.into(),
        status: if is_true { "True" } else { "False" }.into(),
        reason: state.as_str().into(),
        message: "".into(),
        observed_generation: None,
        last_transition_time: Time(jiff::Timestamp::UNIX_EPOCH),
    };
    let failure = json!({"class": "Participant", "reason": "Test", "message": "It failed."});
    made.status = Some(SubmissionStatus {
        attempt: Some(made.spec.attempt),
        conditions: vec![
            condition(conditions::FINISHED, state.is_terminal()),
            condition(conditions::RUNNING, matches!(state, State::Running | State::Resumed)),
        ],
        failure: (state == State::Failed).then(|| serde_json::from_value(failure).unwrap()),
        ..SubmissionStatus::default()
    });
    made
}

/// The object after a bump was carried out and the controller has not read it yet.
fn bumped(mut made: Submission, by: &Incoming) -> Submission {
    made.spec.attempt = made.spec.attempt.next();
    let (key, text) = annotation(&record(Some(&made), by, made.spec.attempt));
    made.metadata.annotations.get_or_insert_default().insert(key, text);
    made.metadata.resource_version = Some("11".into());
    made
}

fn bump_to(attempt: i64) -> Ingest {
    Ingest::Bump(Attempt(attempt))
}

#[test]
fn the_first_message_makes_the_object_with_everything_it_needs() {
    let made = made_by(&message("a", 100));
    assert_eq!(made.metadata.name.as_deref(), Some("submission-3"));
    assert_eq!(
        made.metadata.finalizers,
        Some(vec![names::FINALIZER_SUBMISSION.to_owned()])
    );
    let labels = made.metadata.labels.unwrap();
    assert_eq!(labels[names::LABEL_LEADERBOARD], BOARD);
    assert_eq!(labels[names::LABEL_PHASE], "2");
    let record: Value = serde_json::from_str(&made.metadata.annotations.unwrap()[names::ANNOTATION_INGESTED]).unwrap();
    assert_eq!(record, json!({"message": "a", "sent": 100, "attempt": 1}));
    let spec = made.spec;
    assert!(!spec.check, "no message makes a check");
    assert_eq!(
        (spec.leaderboard_name.as_str(), spec.attempt, spec.cancel),
        (BOARD, Attempt(1), false)
    );
    assert_eq!(spec.image.as_deref(), Some("r.example/a:1"));
    assert_eq!(
        spec.evalai.map(|e| (e.challenge, e.phase, e.submission)),
        Some((1, 2, 3))
    );
}

const REPEAT: Ingest = Ingest::Leave(Outcome::Repeat);

fn check(what: &str, existing: &Submission, incoming: &Incoming, want: &Ingest) {
    assert_eq!(decide_ingest(BOARD, Some(existing), incoming), *want, "{what}");
}

#[test]
fn a_message_that_comes_again_changes_nothing() {
    let first = message("a", 100_000);
    let failed = with_state(made_by(&first), State::Failed);
    check("at once", &made_by(&first), &first, &REPEAT);
    check(
        "while it runs",
        &with_state(made_by(&first), State::Running),
        &first,
        &REPEAT,
    );
    check("after its end", &failed, &first, &REPEAT);
    check("after its end, for the third time", &failed, &first, &REPEAT);
    check(
        "late, after a resume had made the object",
        &failed,
        &message("z", 50_000),
        &REPEAT,
    );
    check(
        "under another id, sent in the same millisecond",
        &failed,
        &message("b", 100_000),
        &REPEAT,
    );
}

#[test]
fn a_resume_bumps_what_has_failed_or_was_cancelled() {
    let (first, resume) = (message("a", 100_000), message("b", 200_000));
    let in_state = |state| with_state(made_by(&first), state);
    check("failed", &in_state(State::Failed), &resume, &bump_to(2));
    check("cancelled", &in_state(State::Cancelled), &resume, &bump_to(2));
    check("finished", &in_state(State::Finished), &resume, &refuse(2));
    check("pending", &in_state(State::Pending), &resume, &REPEAT);
    check("running", &in_state(State::Running), &resume, &REPEAT);
    check("resumed", &in_state(State::Resumed), &resume, &REPEAT);
    check("not read by the controller", &made_by(&first), &resume, &REPEAT);
    let by_person = |state| {
        let mut made = in_state(state);
        made.spec.attempt = Attempt(2);
        made
    };
    check("a person restarts it", &by_person(State::Running), &resume, &REPEAT);
    check(
        "the run had finished by then",
        &by_person(State::Finished),
        &resume,
        &refuse(3),
    );
    let fresh = bumped(in_state(State::Failed), &resume);
    check(
        "the resume again, before the controller read it",
        &fresh,
        &resume,
        &REPEAT,
    );
    check(
        "the next one, before the controller read it",
        &fresh,
        &message("c", 300_000),
        &REPEAT,
    );
    check(
        "the resume again, after its end",
        &with_state(fresh, State::Failed),
        &resume,
        &REPEAT,
    );
}

#[test]
fn the_sweep_and_the_message_that_it_stood_in_for_count_once() {
    let (first, swept) = (message("a", 100_000), sweep(100_000));
    let by_message = with_state(made_by(&first), State::Failed);
    let by_sweep = with_state(made_by(&swept), State::Failed);
    let last = 100_000 + SWEEP_AGE_MS;
    check(
        "the late message, sent after the row's time",
        &by_sweep,
        &message("b", 100_400),
        &REPEAT,
    );
    check(
        "the same, as late as it can be",
        &by_sweep,
        &message("b", last),
        &REPEAT,
    );
    check("a resume after that", &by_sweep, &message("b", last + 1), &bump_to(2));
    check("the same row again", &by_sweep, &swept, &REPEAT);
    check("the next lost resume", &by_sweep, &swept_resume(300_000), &bump_to(2));
    check("a row that a message served", &by_message, &sweep(99_500), &REPEAT);
    check(
        "a lost resume after a message",
        &by_message,
        &swept_resume(300_000),
        &bump_to(2),
    );
    check(
        "a row of one that runs",
        &with_state(made_by(&first), State::Running),
        &swept_resume(300_000),
        &REPEAT,
    );
    let mut edited = by_message.clone();
    edited.status.as_mut().unwrap().state = Some(State::Finished);
    check(
        "a row of one that failed, and whose stored state somebody has edited",
        &edited,
        &swept_resume(300_000),
        &bump_to(2),
    );
}

fn refuse(attempt: i64) -> Ingest {
    Ingest::Refuse(Attempt(attempt))
}

/// The object after a refusal was noted.
fn refused(mut made: Submission, sent_ms: i64) -> Submission {
    let record = Ingested {
        refused: Some(RefusedAttempt {
            attempt: made.spec.attempt.next(),
            at: sent_ms,
        }),
        ..Ingested::of(&made).unwrap_or_default()
    };
    let (key, text) = annotation(&record);
    made.metadata.annotations.get_or_insert_default().insert(key, text);
    made
}

#[test]
fn a_row_that_was_edited_to_submitted_begins_no_other_attempt() {
    let failed = with_state(made_by(&message("a", 100_000)), State::Failed);
    check("the first time", &failed, &sweep(300_000), &refuse(2));
    let noted = refused(failed, 300_000);
    check("the same row again", &noted, &sweep(300_000), &REPEAT);
    check("edited once more", &noted, &sweep(400_000), &REPEAT);
    check("a message", &noted, &message("b", 350_000), &bump_to(2));
    // A person has raised the attempt.
    let mut raised = noted;
    raised.spec.attempt = Attempt(2);
    let raised = with_state(raised, State::Failed);
    check("after another attempt", &raised, &sweep(500_000), &refuse(3));
}

#[test]
fn one_attempt_begins_without_a_message_until_the_next_message_comes() {
    let failed = with_state(made_by(&message("a", 100_000)), State::Failed);
    let lost = swept_resume(300_000);
    check("a resume whose message was lost", &failed, &lost, &bump_to(2));
    let second = with_state(bumped(failed, &lost), State::Failed);
    assert_eq!(Ingested::of(&second).unwrap().without_message, [Attempt(2)]);
    check("another one", &second, &swept_resume(600_000), &refuse(3));
    let noted = refused(second, 600_000);
    check("and another one", &noted, &swept_resume(900_000), &REPEAT);
    let resume = message("b", 950_000);
    let third = with_state(bumped(noted, &resume), State::Failed);
    assert!(Ingested::of(&third).unwrap().without_message.is_empty());
    check("after a message", &third, &swept_resume(1_300_000), &bump_to(4));
}

#[test]
fn the_sweep_resumes_only_what_has_failed_and_nobody_cancelled() {
    let in_state = |state| with_state(made_by(&message("a", 100_000)), state);
    let lost = swept_resume(300_000);
    check("failed", &in_state(State::Failed), &lost, &bump_to(2));
    // EvalAI resumes only what has failed: the row of one that was cancelled was edited.
    check("cancelled", &in_state(State::Cancelled), &lost, &refuse(2));
    let mut by_host = in_state(State::Cancelled);
    by_host.spec.cancel = true;
    check("cancelled by a host", &by_host, &lost, &refuse(2));
    let mut late = in_state(State::Failed);
    late.spec.cancel = true;
    check("failed, while a host cancelled it", &late, &lost, &refuse(2));
    check(
        "a message after the cancel",
        &by_host,
        &message("b", 300_000),
        &bump_to(2),
    );
}

#[test]
fn a_resume_without_a_message_begins_nothing_where_its_object_is_gone() {
    assert_eq!(
        decide_ingest(BOARD, None, &swept_resume(100_000)),
        Ingest::Leave(Outcome::NotNew)
    );
    let first = with_state(made_by(&sweep(100_000)), State::Failed);
    check("of a first run", &first, &swept_resume(600_000), &bump_to(2));
}

#[test]
fn a_row_that_was_run_before_makes_no_object_without_a_message() {
    let swept = |kind| incoming(Source::Sweep(kind), 300_000);
    assert_eq!(
        decide_ingest(BOARD, None, &swept(Swept::Edited)),
        Ingest::Leave(Outcome::NotNew)
    );
    assert!(matches!(
        decide_ingest(BOARD, None, &message("a", 300_000)),
        Ingest::Create(_)
    ));
    // Its participant can have edited the row of a re-run: that is shown, and counts.
    let rerun = with_state(made_by(&swept(Swept::Rerun)), State::Failed);
    assert_eq!(Ingested::of(&rerun).unwrap().without_message, [Attempt(1)]);
    check("its resume", &rerun, &swept_resume(600_000), &refuse(2));
    let failed = with_state(made_by(&message("a", 100_000)), State::Failed);
    check("of one that is there", &failed, &swept(Swept::Edited), &refuse(2));
}

#[test]
fn a_resume_of_a_resume_goes_on_counting() {
    let resumed = with_state(
        bumped(
            with_state(made_by(&message("a", 100)), State::Failed),
            &message("b", 200),
        ),
        State::Cancelled,
    );
    assert_eq!(decide_ingest(BOARD, Some(&resumed), &message("c", 300)), bump_to(3));
}

#[test]
fn an_object_being_deleted_is_waited_for() {
    let mut existing = with_state(made_by(&message("a", 100)), State::Failed);
    existing.metadata.deletion_timestamp = Some(Time(jiff::Timestamp::UNIX_EPOCH));
    assert_eq!(
        decide_ingest(BOARD, Some(&existing), &message("b", 200)),
        Ingest::Leave(Outcome::Deleting)
    );
    assert_eq!(
        decide_ingest("another", Some(&existing), &message("b", 200)),
        Ingest::Leave(Outcome::Deleting)
    );
}

#[test]
fn a_name_of_another_submission_is_taken() {
    let other = |change: fn(&mut Submission)| {
        let mut existing = with_state(made_by(&message("a", 100)), State::Failed);
        change(&mut existing);
        existing
    };
    let cases: Vec<(&str, Submission)> = vec![
        (
            "leaderboard",
            other(|s| s.spec.leaderboard_name = "leaderboard-10".into()),
        ),
        ("challenge", other(|s| s.spec.evalai.as_mut().unwrap().challenge = 9)),
        ("phase", other(|s| s.spec.evalai.as_mut().unwrap().phase = 9)),
        (
            "not of EvalAI",
            other(|s| (s.spec.evalai, s.spec.track) = (None, Some("sensors".into()))),
        ),
    ];
    for (what, existing) in cases {
        let decided = decide_ingest(BOARD, Some(&existing), &message("b", 200));
        assert!(
            matches!(&decided, Ingest::Leave(Outcome::IdTaken(text)) if text.contains("submission-3 belongs to")),
            "{what}: {decided:?}"
        );
    }
}

#[test]
fn one_made_by_hand_is_resumed_only_by_what_was_sent_later() {
    for broken in [None, Some("no json"), Some("{}")] {
        let mut existing = with_state(made_by(&message("a", 5_000)), State::Failed);
        existing.metadata.annotations =
            broken.map(|text| BTreeMap::from([(names::ANNOTATION_INGESTED.to_owned(), text.to_owned())]));
        assert_eq!(
            decide_ingest(BOARD, Some(&existing), &message("b", 4_000)),
            Ingest::Leave(Outcome::Repeat),
            "{broken:?}"
        );
        // Creation times have no milliseconds.
        assert_eq!(
            decide_ingest(BOARD, Some(&existing), &message("b", 5_900)),
            Ingest::Leave(Outcome::Repeat),
            "{broken:?}"
        );
        assert_eq!(
            decide_ingest(BOARD, Some(&existing), &message("b", 6_000)),
            bump_to(2),
            "{broken:?}"
        );
    }
}

mod races_tests;
