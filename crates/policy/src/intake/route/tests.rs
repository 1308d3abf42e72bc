//! Tables of what becomes of each message.

use std::collections::BTreeSet;

use super::*;
use crate::intake::fixtures::{board, in_mode, with_queue};
use leaderboard_api::Attempt;

fn with(mut board: Arc<Leaderboard>, change: fn(&mut Leaderboard)) -> Arc<Leaderboard> {
    change(Arc::make_mut(&mut board));
    board
}

const URL: &str = "https://q/1";
const NOW: i64 = 10_000_000;

fn one() -> Vec<Arc<Leaderboard>> {
    vec![with_queue(board("a", 1), URL)]
}

fn envelope(challenge: i64, phase: i64, age_seconds: i64) -> Envelope {
    Envelope {
        content: Ok(Message {
            challenge,
            phase,
            submission: 7,
            image: None,
            is_static_code_upload: false,
        }),
        sent_ms: NOW - age_seconds * 1000,
        receives: 1,
        hindrance: None,
    }
}

fn to(name: &str) -> MessageOutcome {
    MessageOutcome::Ingest {
        namespace: "ns".into(),
        leaderboard: name.into(),
    }
}

fn wait(seconds: i32, why: Later) -> MessageOutcome {
    MessageOutcome::Later { seconds, why }
}

fn unknown(challenge: i64, phase: i64) -> MessageOutcome {
    MessageOutcome::Dead(DeadReason::Unknown(format!(
        "no Leaderboard that reads this queue serves challenge {challenge}, phase {phase}"
    )))
}

fn leaving() -> Vec<Arc<Leaderboard>> {
    vec![with(one().remove(0), |lb| queue_mut(lb).foreign = Foreign::Leave)]
}

fn queue_mut(leaderboard: &mut Leaderboard) -> &mut SqsQueue {
    leaderboard.spec.queue.as_mut().unwrap().sqs.as_mut().unwrap()
}

fn check(what: &str, envelope: &Envelope, readers: &[Arc<Leaderboard>], synced: bool, want: &MessageOutcome) {
    assert_eq!(route(&rules(readers), envelope, readers, NOW, synced), *want, "{what}");
}

#[test]
fn a_known_message_goes_to_its_leaderboard() {
    check("known", &envelope(1, 2, 0), &one(), true, &to("a"));
    check("known, its other phase", &envelope(1, 3, 0), &one(), true, &to("a"));
    check("known, not synced yet", &envelope(1, 2, 0), &one(), false, &to("a"));
    check("known and old", &envelope(1, 2, 100_000), &one(), true, &to("a"));
    check(
        "known, among those left to others",
        &envelope(1, 2, 0),
        &leaving(),
        true,
        &to("a"),
    );
    check(
        "no Leaderboard reads the queue any more",
        &envelope(1, 2, 0),
        &[],
        true,
        &MessageOutcome::Lapse,
    );
}

#[test]
fn an_unknown_message_is_given_up_only_when_it_is_old_and_all_is_known() {
    let at_once = [with(one().remove(0), |lb| queue_mut(lb).unknown_after_seconds = 0)];
    let waits = wait(30, Later::Unknown);
    check("young", &envelope(1, 9, 10), &one(), true, &waits);
    check("at the limit", &envelope(1, 9, 900), &one(), true, &waits);
    check("sent in the future", &envelope(1, 9, -5000), &one(), true, &waits);
    check("old, not synced", &envelope(1, 9, 90_000), &one(), false, &waits);
    check("old", &envelope(1, 9, 901), &one(), true, &unknown(1, 9));
    check(
        "of an unknown challenge, old",
        &envelope(9, 2, 901),
        &one(),
        true,
        &unknown(9, 2),
    );
    check("no patience", &envelope(1, 9, 1), &at_once, true, &unknown(1, 9));
    check(
        "left to others",
        &envelope(9, 2, 90_000),
        &leaving(),
        true,
        &wait(30, Later::Foreign),
    );
}

#[test]
fn a_malformed_message_is_given_up_at_once() {
    let malformed = |why: Malformed| Envelope {
        content: Err(why),
        ..envelope(1, 2, 0)
    };
    let dead = |why: &Malformed| MessageOutcome::Dead(DeadReason::Malformed(why.to_string()));
    for why in [Malformed::NotAnObject, Malformed::Missing("phase_pk")] {
        check("synced", &malformed(why.clone()), &one(), true, &dead(&why));
        check("not synced", &malformed(why.clone()), &one(), false, &dead(&why));
    }
    check(
        "left to others",
        &malformed(Malformed::NotAnObject),
        &leaving(),
        true,
        &dead(&Malformed::NotAnObject),
    );
}

#[test]
fn a_static_code_upload_runs_in_the_mode_batch_alone() {
    let of = |phase| {
        let mut envelope = envelope(1, phase, 0);
        envelope.content.as_mut().unwrap().is_static_code_upload = true;
        envelope
    };
    let dead = |kind: &str| {
        MessageOutcome::Dead(DeadReason::Malformed(format!(
            "is_static_dataset_code_upload_submission is set, and the Leaderboard a has {kind}: such submissions need \
             evaluation.container with the mode Batch"
        )))
    };
    let with_mode = |mode| vec![with_queue(in_mode(board("a", 1), mode), URL)];
    for (readers, expected) in [
        (with_mode("Batch"), to("a")),
        (with_mode("Interactive"), dead("the mode Interactive")),
        (with_mode("Predictions"), dead("the mode Predictions")),
        (one(), dead("evaluation.carla")),
        (leaving(), wait(30, Later::Foreign)),
    ] {
        check("of its phase", &of(2), &readers, true, &expected);
        check("of its phase, not synced", &of(2), &readers, false, &expected);
    }
    let young = wait(30, Later::Unknown);
    check("its Leaderboard may come", &of(9), &with_mode("Batch"), true, &young);
    for mode in ["Batch", "Interactive", "Predictions"] {
        let plain = envelope(1, 2, 0);
        check(mode, &plain, &with_mode(mode), true, &to("a"));
    }
}

#[test]
fn waits_double_up_to_their_limit() {
    let seconds = |receives, readers: &[Arc<Leaderboard>]| match route(
        &rules(readers),
        &Envelope {
            receives,
            ..envelope(1, 9, 1)
        },
        readers,
        NOW,
        true,
    ) {
        MessageOutcome::Later { seconds, .. } => seconds,
        other => panic!("{other:?}"),
    };
    let receives = [0, 1, 2, 3, 4, 5, 6, 7, 1000, i32::MAX];
    assert_eq!(
        receives.map(|n| seconds(n, &one())),
        [30, 30, 60, 120, 240, 480, 900, 900, 900, 900]
    );
    assert_eq!(receives.map(|n| seconds(n, &leaving()))[..4], [30, 30, 60, 60]);
    assert_eq!(blocked(6), wait(900, Later::Blocked));
}

#[test]
fn of_two_that_claim_a_phase_the_older_serves_it() {
    let queue = |board| with_queue(board, URL);
    let names = |all: Vec<Arc<Leaderboard>>| readers(URL, &all).iter().map(|lb| lb.name_any()).collect::<Vec<_>>();
    assert_eq!(names(vec![queue(board("a", 20)), queue(board("b", 10))]), ["b", "a"]);
    assert_eq!(
        names(vec![queue(board("b", 10)), queue(board("a", 10))]),
        ["a", "b"],
        "then the name decides"
    );
    let older_leaves = with(queue(board("b", 10)), |lb| {
        lb.metadata.deletion_timestamp = lb.metadata.creation_timestamp.clone();
    });
    assert_eq!(
        names(vec![queue(board("a", 20)), older_leaves]),
        ["a"],
        "one being deleted takes nothing more"
    );
    let elsewhere = with_queue(board("b", 10), "https://q/2");
    assert_eq!(
        names(vec![queue(board("a", 20)), elsewhere, Arc::new(board("c", 1))]),
        ["a"],
        "other queues are others'"
    );
    let both = readers(URL, &[queue(board("a", 20)), queue(board("b", 10))]);
    assert_eq!(route(&rules(&both), &envelope(1, 2, 0), &both, NOW, true), to("b"));
}

#[test]
fn leaderboards_that_share_a_queue_agree_on_the_most_patient_rules() {
    let older = with(with_queue(board("a", 1), URL), |lb| {
        queue_mut(lb).unknown_after_seconds = 5;
    });
    let newer = with(with_queue(board("b", 2), URL), |lb| {
        let queue = queue_mut(lb);
        queue.foreign = Foreign::Leave;
        queue.dead_letter_url = Some("https://q/dead".into());
    });
    let want = Rules {
        dead_letter: Some("https://q/dead".into()),
        unknown_after_ms: 900_000,
        leaves_foreign: true,
        is_common: false,
    };
    assert_eq!(rules(&[older, newer]), want);
}

#[test]
fn a_message_whose_submission_cannot_run_is_given_up_and_one_whose_row_is_hidden_comes_back() {
    let of = |challenge, phase, age, hindrance: &Hindrance| Envelope {
        hindrance: Some(hindrance.clone()),
        ..envelope(challenge, phase, age)
    };
    let gone = Hindrance::Unusable("EvalAI has no submission 7".into());
    let dead = MessageOutcome::Dead(DeadReason::Malformed("EvalAI has no submission 7".into()));
    check("it is not there", &of(1, 2, 0, &gone), &one(), true, &dead);
    for phase in [2, 9] {
        let hidden = of(1, phase, 90_000, &Hindrance::Hidden);
        check("its row is not shown", &hidden, &one(), true, &MessageOutcome::Lapse);
    }
    let common = Rules {
        is_common: true,
        ..rules(&one())
    };
    let foreign = wait(30, Later::Foreign);
    for envelope in [
        envelope(9, 2, 90_000),
        of(9, 2, 0, &gone),
        of(9, 2, 0, &Hindrance::Hidden),
    ] {
        let found = route(&common, &envelope, &one(), NOW, true);
        assert_eq!(found, foreign, "another challenge's: {envelope:?}");
    }
    assert_eq!(route(&common, &envelope(1, 2, 0), &one(), NOW, true), to("a"));
    assert_eq!(route(&common, &envelope(1, 9, 901), &one(), NOW, true), unknown(1, 9));
}

#[test]
fn each_outcome_of_ingest_settles_its_message() {
    let refused = || Err(NotIngested::Refused("spec.image is wrong".into()));
    let cases: Vec<(Result<Outcome, NotIngested>, i64, MessageOutcome)> = vec![
        (Ok(Outcome::Created), 0, MessageOutcome::Delete(Done::Created)),
        (Ok(Outcome::Bumped(Attempt(2))), 0, MessageOutcome::Delete(Done::Bumped)),
        (Ok(Outcome::Repeat), 0, MessageOutcome::Delete(Done::Repeat)),
        (Ok(Outcome::Deleting), 90_000, wait(30, Later::Deleting)),
        (Ok(Outcome::Stopping), 90_000, wait(30, Later::Stopping)),
        (Ok(Outcome::Refused), 0, MessageOutcome::Delete(Done::Repeat)),
        (
            Ok(Outcome::IdTaken("x".into())),
            0,
            MessageOutcome::Dead(DeadReason::IdTaken("x".into())),
        ),
        (refused(), 900, wait(30, Later::Refused)),
        (
            refused(),
            901,
            MessageOutcome::Dead(DeadReason::Refused("spec.image is wrong".into())),
        ),
        (Err(NotIngested::Unknown), 90_000, MessageOutcome::Lapse),
    ];
    let rules = rules(&one());
    for (outcome, age, want) in cases {
        assert_eq!(
            settle(&envelope(1, 2, age), &outcome, &rules, NOW),
            want,
            "{outcome:?} after {age} s"
        );
    }
}

#[test]
fn each_outcome_has_a_sample_from_the_start() {
    let dead = DeadReason::Malformed(String::new());
    let later = [
        Later::Unknown,
        Later::Foreign,
        Later::Deleting,
        Later::Stopping,
        Later::Refused,
        Later::Blocked,
    ];
    let done = [Done::Created, Done::Bumped, Done::Repeat];
    let all: BTreeSet<_> = [MessageOutcome::Dead(dead), MessageOutcome::Lapse]
        .into_iter()
        .chain(later.map(|why| wait(1, why)))
        .chain(done.map(MessageOutcome::Delete))
        .map(|outcome| outcome.as_str())
        .collect();
    assert_eq!(all, OUTCOMES.into());
}
