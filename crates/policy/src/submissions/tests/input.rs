//! Submissions that are files: which Leaderboards take them, and the copy of EvalAI's file before the Job.

use std::sync::Arc;
use std::time::Duration;

use serde_json::{Value, json};

use super::builders::*;
use crate::ask::{Answered, Failure, Lookup};
use crate::questions::{Absence, Fetched, Input};
use crate::submissions::{Action, EvalaiUpdate, Plan, Question, SlotUse};
use crate::view::Turn;
use leaderboard_api::State::{Failed, Pending};
use leaderboard_api::conditions::{ACCEPTED, STALLED};
use leaderboard_api::{Attempt, FailureClass, Reason, SubmissionStatus, SubmittedFile};

/// Most bytes of a file where the Leaderboard says nothing.
const MOST: u64 = 1 << 30;

fn of_mode(mut world: World, mode: &str) -> World {
    let evaluation = json!({"container": {"mode": mode, "image": "evaluator:1", "command": ["/evaluate"]}});
    let spec = world.leaderboard();
    spec.evaluation = serde_json::from_value(evaluation).unwrap();
    spec.tracks[0].container = Some(serde_json::from_value(json!({"score": {"metric": "accuracy"}})).unwrap());
    world
}

/// EvalAI's submission to a Leaderboard of files.
fn evalais() -> World {
    let mut world = of_mode(World::evalai(), "Predictions");
    world.submission().spec.image = None;
    world.in_evalai().info.as_mut().unwrap().image = None;
    world
}

/// A local one, with a file of so many bytes.
fn local(size: i64) -> World {
    let mut world = of_mode(World::local(), "Predictions");
    world.submission().spec.image = None;
    world.submission().spec.input = Some(file(size));
    world
}

fn file(size: i64) -> SubmittedFile {
    SubmittedFile {
        sha256: "5a".repeat(32),
        size,
    }
}

/// The question of an attempt.
fn question(attempt: i64) -> Input {
    Input {
        attempt: Attempt(attempt),
        server: "https://evalai.example".into(),
        run_id: "77".parse().unwrap(),
        storage: leaderboard(true).spec.storage.s3,
        submission: 77,
        limit: MOST,
    }
}

/// What is known of the copy for the first attempt.
fn known(result: Result<Fetched, Failure>) -> Lookup<Input> {
    Lookup {
        last: Some(Answered {
            question: question(1),
            sent_ago: Duration::ZERO,
            result: Arc::new(result),
        }),
        ..Lookup::default()
    }
}

fn stored() -> Lookup<Input> {
    known(Ok(Fetched::Stored(file(12))))
}

fn missing(why: Absence, times: u32) -> Lookup<Input> {
    known(Ok(Fetched::Missing { why, times }))
}

fn asked(plan: &Plan) -> Option<&Input> {
    plan.actions.iter().find_map(|action| match action {
        Action::Ask(Question::Input(input)) => Some(&**input),
        _ => None,
    })
}

#[track_caller]
fn fails(world: &mut World, reason: Reason, class: FailureClass, says: &str) -> Plan {
    let plan = world.pass_to(Failed, reason);
    assert!(!creates(&plan) && asked(&plan).is_none(), "{:?}", plan.actions);
    let failure = plan.status.failure.as_ref().unwrap();
    assert_eq!(failure.class, class);
    assert!(failure.message.contains(says), "{}", failure.message);
    plan
}

#[test]
fn a_local_file_runs_without_an_image_and_without_a_copy() {
    for size in [0, 12, MOST.try_into().unwrap()] {
        let mut world = local(size);
        let plan = world.pass_to(Pending, Reason::Preparing);
        assert!(creates(&plan) && asked(&plan).is_none());
        assert_eq!(condition(&plan, ACCEPTED), ("True".into(), Reason::Accepted.into()));
        assert_eq!(plan.status.input, Some(file(size)));
        assert_eq!(plan.status.plan.unwrap().image, None);
    }
}

#[test]
fn a_leaderboard_takes_the_kind_of_its_mode_alone() {
    let image = |mode| of_mode(World::local(), mode);
    let file_for = |mode| of_mode(local(12), mode);
    let mut for_carla = local(12);
    for_carla.leaderboard().evaluation = leaderboard(false).spec.evaluation;
    let mut check = image("Predictions");
    check.submission().spec.check = true;
    for (mut world, says) in [
        (
            image("Predictions"),
            "takes files, and the submission is a container image. Submit",
        ),
        (check, "takes files"),
        (
            file_for("Interactive"),
            "takes container images, and the submission is a file. Submit",
        ),
        (file_for("Batch"), "takes container images"),
        (for_carla, "takes container images"),
        (
            local(i64::try_from(MOST).unwrap() + 1),
            "more than the 1073741824 bytes",
        ),
    ] {
        let plan = fails(&mut world, Reason::InputInvalid, FailureClass::Participant, says);
        let shown = condition(&plan, ACCEPTED);
        assert_eq!(shown, ("False".into(), Reason::InputInvalid.into()), "{says}");
        assert_eq!(plan.status.input, None);
    }
    for mode in ["Interactive", "Batch"] {
        assert!(creates(&image(mode).pass_to(Pending, Reason::Preparing)), "{mode}");
    }
    let mut named = of_mode(World::evalai(), "Predictions");
    let plan = fails(
        &mut named,
        Reason::InputInvalid,
        FailureClass::Participant,
        "takes files",
    );
    assert_eq!(evalai_updates(&plan), [EvalaiUpdate::Failed]);
}

#[test]
fn the_leaderboards_own_bound_counts() {
    for (size, is_taken) in [(1024, true), (1025, false)] {
        let mut world = local(size);
        let spec: Value = serde_json::to_value(&world.leaderboard().evaluation).unwrap();
        let mut container = spec["container"].clone();
        container["input"] = json!({"maxBytes": "1Ki"});
        world.leaderboard().evaluation = serde_json::from_value(json!({"container": container})).unwrap();
        assert_eq!(creates(&world.pass()), is_taken, "{size}");
    }
}

#[test]
fn evalais_file_is_copied_once_its_turn_has_come_and_then_the_job_is_made() {
    let mut world = evalais();
    world.view.turn = Turn::Wait { position: 1, eta: None };
    let plan = world.pass_to(Pending, Reason::WaitingForSlot);
    assert_eq!(asked(&plan), None, "an address may hold for an hour only");

    let mut world = evalais();
    let plan = world.pass();
    assert_eq!(
        (asked(&plan), &plan.status),
        (Some(&question(1)), &SubmissionStatus::default())
    );
    assert_eq!(plan.slot(), SlotUse::Waits, "it keeps its slot");
    world.view.input.waited = Some(Duration::from_secs(4));
    assert_eq!(
        world.pass().status,
        SubmissionStatus::default(),
        "a fast copy costs no write"
    );
    world.view.input.waited = Some(Duration::from_secs(5));
    let plan = world.pass_to(Pending, Reason::FetchingInput);
    assert_eq!((asked(&plan), plan.slot()), (Some(&question(1)), SlotUse::Waits));
    assert_eq!(
        condition(&plan, STALLED),
        ("False".into(), Reason::FetchingInput.into())
    );
    assert_eq!(evalai_updates(&plan), [EvalaiUpdate::Queued]);

    world.view.input = stored();
    let plan = world.pass_to(Pending, Reason::Preparing);
    assert!(creates(&plan) && asked(&plan).is_none());
    assert_eq!(plan.status.input, Some(file(12)));
    assert_eq!(plan.status.plan.unwrap().image, None);
}

#[test]
fn what_waits_for_its_file_waits_without_the_image_that_another_file_would_name() {
    let mut world = evalais();
    world.in_evalai().info.as_mut().unwrap().image_problem = Some("the uploaded file is no JSON".into());
    assert_eq!(asked(&world.pass()), Some(&question(1)));
}

#[test]
fn a_file_that_is_too_large_is_the_participants() {
    let mut world = evalais();
    world.view.input = known(Ok(Fetched::TooLarge));
    let says = "more than the 1073741824 bytes that this leaderboard takes. Submit a smaller file.";
    let plan = fails(&mut world, Reason::InputInvalid, FailureClass::Participant, says);
    assert_eq!(evalai_updates(&plan), [EvalaiUpdate::Failed]);
}

#[test]
fn a_file_that_is_not_given_out_three_times_ends_it_uncharged_and_a_resume_asks_anew() {
    for (why, says) in [
        (
            Absence::NoFile,
            "3 times in a row: EvalAI's row of the submission names no file. ",
        ),
        (
            Absence::Late,
            "3 times in a row: it could not be copied within 30 min. ",
        ),
    ] {
        let mut world = evalais();
        world.view.input = missing(why, 3);
        fails(&mut world, Reason::InputMissing, FailureClass::Infrastructure, says);
    }
    let mut world = evalais();
    let gone = |times| missing(Absence::Status(404), times);
    for times in [1, 2] {
        world.view.input = gone(times);
        let plan = world.pass_to(Pending, Reason::FetchingInput);
        assert!(!creates(&plan) && asked(&plan) == Some(&question(1)), "{times}");
        assert_eq!(plan.slot(), SlotUse::Leaves, "others may go meanwhile");
        let message = plan.status.message.unwrap();
        assert!(message.contains("answers 404. It is tried again."), "{message}");
    }
    world.view.input = gone(3);
    let says = "3 times in a row: EvalAI's address of it answers 404. ";
    let plan = fails(&mut world, Reason::InputMissing, FailureClass::Infrastructure, says);
    assert_eq!(evalai_updates(&plan), [EvalaiUpdate::Failed]);
    assert_eq!(plan.status.retry, 0);

    world.submission().spec.attempt = Attempt(2);
    world.pass();
    assert_eq!(
        asked(&world.pass()),
        Some(&question(2)),
        "the answer to the first attempt is none"
    );
}

#[test]
fn silence_is_waited_out_and_a_refusal_is_a_persons_to_fix() {
    let mut world = evalais();
    world.view.input = known(Err(Failure::silent("EvalAI did not answer in time")));
    for (second, stalled) in [(0, "False"), (299, "False"), (300, "True"), (90_000, "True")] {
        world.go_to(second);
        let plan = world.pass_to(Pending, Reason::FetchingInput);
        assert_eq!(asked(&plan), Some(&question(1)));
        assert_eq!(
            (condition(&plan, STALLED).0.as_str(), plan.slot()),
            (stalled, SlotUse::Leaves),
            "{second}"
        );
        let message = plan.status.message.unwrap();
        assert!(
            message.contains("yet: EvalAI did not answer in time. It is"),
            "{message}"
        );
    }
    world.view.input = stored();
    assert!(creates(&world.pass_to(Pending, Reason::Preparing)));

    let mut refused = evalais();
    let why = "the file has an address of the cluster's own network".to_owned();
    refused.view.input = known(Err(Failure { is_refused: true, why }));
    let plan = refused.pass_to(Pending, Reason::FetchingInput);
    assert_eq!(condition(&plan, STALLED), ("True".into(), Reason::FetchingInput.into()));
}

#[test]
fn a_copy_that_has_failed_waits_for_no_slot() {
    let in_line = [Turn::NotInLine, Turn::Wait { position: 1, eta: None }];
    for turn in in_line.clone() {
        for (found, reason) in [
            (known(Ok(Fetched::TooLarge)), Reason::InputInvalid),
            (missing(Absence::Status(404), 3), Reason::InputMissing),
        ] {
            let mut world = evalais();
            world.view.turn = turn.clone();
            world.view.input = found;
            world.pass_to(Failed, reason);
        }
    }
    // Whatever its turn is meanwhile, the failure is counted from its beginning.
    let mut world = evalais();
    world.view.input = known(Err(Failure::silent("no")));
    for (second, turn) in (0..).step_by(60).zip(in_line.iter().cycle().take(5)) {
        world.view.turn = turn.clone();
        world.go_to(second);
        let plan = world.pass_to(Pending, Reason::FetchingInput);
        assert_eq!((asked(&plan), plan.slot()), (Some(&question(1)), SlotUse::Leaves));
    }
    world.go_to(300);
    let plan = world.pass_to(Pending, Reason::FetchingInput);
    assert_eq!(condition(&plan, STALLED).0, "True");
    // A file that is there stands in line.
    world.view.input = stored();
    world.view.turn = Turn::Wait { position: 1, eta: None };
    let plan = world.pass_to(Pending, Reason::WaitingForSlot);
    assert_eq!((asked(&plan), plan.status.input.as_ref()), (None, Some(&file(12))));
}

#[test]
fn a_job_that_is_made_again_waits_for_its_file() {
    let mut world = evalais();
    world.view.input = stored();
    let mut world = world.with_job();
    world.view.input = Lookup::default();
    // Somebody removes the status, and then the Job.
    world.submission().status = None;
    assert_eq!(world.pass().status.input, None);
    world.job_gone();
    let plan = world.pass();
    assert_eq!((asked(&plan), creates(&plan)), (Some(&question(1)), false));
    world.view.input = stored();
    let plan = world.pass();
    assert_eq!((creates(&plan), plan.status.input), (true, Some(file(12))));
}

#[test]
fn an_answer_about_another_bound_is_none() {
    let mut world = evalais();
    let mut other = stored();
    other.last.as_mut().unwrap().question.limit = 1;
    world.view.input = other;
    let plan = world.pass();
    assert!(!creates(&plan) && asked(&plan) == Some(&question(1)));
}

#[test]
fn a_retry_and_a_resume_take_what_the_bucket_has() {
    let mut world = evalais();
    world.view.input = stored();
    let mut world = world.with_job();
    world.view.input = Lookup::default();
    world.gets_another_job();
    assert_eq!((world.status().input, world.status().retry), (Some(file(12)), 1));

    world.leaderboard().retries.infrastructure = 0;
    world.complete();
    world.pass_to(Failed, Reason::ResultsNotStored);
    world.submission().spec.attempt = Attempt(2);
    world.job_gone();
    world.pass();
    let plan = world.pass_to(Pending, Reason::Preparing);
    assert!(creates(&plan) && asked(&plan).is_none(), "{:?}", plan.actions);
    assert_eq!(plan.status.input, Some(file(12)));
}
