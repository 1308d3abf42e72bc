//! From a new object to a pinned plan.

use std::sync::Arc;
use std::time::Duration;

use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;

use super::builders::*;
use crate::submissions::{Action, EvalaiUpdate, Question, TableUpdate};
use crate::view::{Standing, Turn};
use leaderboard_api::State::{Cancelled, Failed, Pending};
use leaderboard_api::conditions::{ACCEPTED, FINISHED, PUBLISHED, READY, RECORDED, STALLED};
use leaderboard_api::evalai_status::Status;
use leaderboard_api::{Attempt, FailureClass, JobNumber, Reason, SubmissionStatus, Team, conditions};

#[test]
fn a_local_submission_is_accepted_and_its_job_made_in_one_reconcile() {
    let mut world = World::local();
    let plan = world.pass_to(Pending, Reason::Preparing);
    assert_eq!(plan.actions[0], Action::CreateJob(JobNumber::first(Attempt(1))));
    assert!(events(&plan).is_empty(), "the status shows it");
    assert_eq!(condition(&plan, ACCEPTED), ("True".into(), Reason::Accepted.into()));
    assert_eq!(condition(&plan, FINISHED).0, "False");
    let status = world.status();
    assert_eq!(status.job_name.as_deref(), Some("sub-1"));
    assert_eq!(status.track.as_deref(), Some("sensors"));
    assert_eq!(status.results_url.as_deref(), Some("s3://results/sub"));
    assert_eq!(status.team.unwrap().id.as_deref(), Some("t1"));
    assert_eq!(status.times.submitted, Some(Time(at(0))));
    let pinned = status.plan.unwrap();
    assert_eq!(pinned.carla().unwrap().slices, leaderboard_api::effective::slices(4, 2));
    assert_eq!((pinned.image.as_deref(), pinned.resume), (Some("team/agent:1"), false));
}

#[test]
fn the_team_of_a_submission_is_shown_as_one_harmless_line() {
    let mut world = World::local();
    world.submission().spec.team = Some(Team {
        id: Some("t1\u{7}".into()),
        name: Some("Team\u{1b}[2J\nSeven".into()),
    });
    world.pass();
    let team = world.status().team.unwrap();
    assert_eq!(team.id.as_deref(), Some("t1\u{fffd}"));
    assert_eq!(team.name.as_deref(), Some("Team\u{fffd}[2J Seven"));
}

#[test]
fn an_answer_of_evalai_within_five_seconds_costs_no_write() {
    let mut world = World::evalai();
    world.in_evalai().info = None;
    world.in_evalai().waited = Duration::from_secs(2);
    let plan = world.pass();
    assert_eq!(plan.status, SubmissionStatus::default());
    assert!(has(&plan, |a| *a == Action::Ask(Question::Evalai)));
    assert_eq!(plan.requeue, Some(Duration::from_secs(3)));
    let mut answered = world.clone();
    answered.in_evalai().info = Some(info());
    assert!(creates(&answered.pass_to(Pending, Reason::Preparing)));
    world.in_evalai().waited = Duration::from_secs(5);
    let plan = world.pass_to(Pending, Reason::AskingEvalAI);
    assert!(events(&plan).is_empty());
}

#[test]
fn evalais_submission_takes_team_and_time_from_evalai_and_is_reported_as_queued() {
    let mut world = World::evalai();
    let plan = world.pass_to(Pending, Reason::Preparing);
    assert_eq!(evalai_updates(&plan), [EvalaiUpdate::Queued]);
    let status = world.status();
    assert_eq!(status.plan.as_ref().unwrap().run_id.as_str(), "77");
    assert_eq!(
        status.plan.unwrap().image.as_deref(),
        Some("team/agent:1"),
        "the object's image goes before EvalAI's"
    );
    assert_eq!(status.times.submitted, Some(Time(at(-60))));
    assert_eq!(status.team.unwrap().name.as_deref(), Some("Team"));
}

#[test]
fn an_image_is_taken_from_evalai_where_the_object_names_none() {
    let mut world = World::evalai();
    world.submission().spec.image = None;
    world.pass();
    assert_eq!(world.status().plan.unwrap().image.as_deref(), Some("ecr/agent:9"));

    let mut world = World::evalai();
    world.submission().spec.image = None;
    world.in_evalai().info.as_mut().unwrap().image = None;
    world.in_evalai().error = Some("EvalAI answered 404: not found".into());
    let plan = world.pass_to(Pending, Reason::ImageMissing);
    assert_eq!(condition(&plan, ACCEPTED).0, "False");
    assert!(!creates(&plan));
    let message = plan.status.message.unwrap();
    assert!(
        message.contains("it is tried again. The last request failed: EvalAI answered 404"),
        "{message}"
    );
    world.in_evalai().info.as_mut().unwrap().image = Some("ecr/agent:9".into());
    assert!(creates(&world.pass_to(Pending, Reason::Preparing)));
}

#[test]
fn evalai_is_asked_and_its_silence_shown() {
    let mut world = World::evalai();
    world.in_evalai().info = None;
    let plan = world.pass_to(Pending, Reason::AskingEvalAI);
    assert!(has(&plan, |a| *a == Action::Ask(Question::Evalai)) && !creates(&plan));
    assert_eq!(condition(&plan, ACCEPTED).0, "Unknown");

    world.in_evalai().error = Some("401 Unauthorized, request 7".into());
    let plan = world.pass_to(Pending, Reason::AskingEvalAI);
    assert!(plan.status.message.unwrap().contains("401 Unauthorized"));
    assert_eq!(condition(&world.pass(), STALLED).0, "True");
    // Another request id of the same error is not another write.
    let before = world.status();
    world.in_evalai().error = Some("401 Unauthorized, request 8".into());
    assert_eq!(world.pass().status, before);
}

#[test]
fn what_evalai_has_ended_never_runs_and_is_not_written() {
    let mut world = World::evalai();
    world.in_evalai().info = Some(crate::view::EvalaiInfo {
        standing: Standing::Ended,
        status: Status::Cancelled,
        ..info()
    });
    let plan = world.pass_to(Cancelled, Reason::EndedInEvalAI);
    assert!(!creates(&plan) && evalai_updates(&plan).is_empty());
    assert_eq!(
        condition(&plan, PUBLISHED),
        ("False".into(), Reason::NotRequired.into())
    );
}

#[test]
fn resumed_in_evalai_takes_up_what_is_stored() {
    let mut world = World::evalai();
    world.in_evalai().info.as_mut().unwrap().standing = Standing::Resumed;
    world.pass();
    assert!(world.status().plan.unwrap().resume);
}

#[test]
fn an_unknown_leaderboard_or_track_is_waited_for() {
    let mut world = World::local();
    let leaderboard = world.view.leaderboard.take();
    let plan = world.pass_to(Pending, Reason::LeaderboardNotFound);
    assert_eq!(
        condition(&plan, ACCEPTED),
        ("False".into(), Reason::LeaderboardNotFound.into())
    );
    assert!(events(&world.pass()).is_empty(), "one event a transition");

    world.view.leaderboard = leaderboard;
    world.leaderboard().tracks[0].name = "map".into();
    let plan = world.pass_to(Pending, Reason::TrackNotFound);
    assert!(plan.status.message.unwrap().contains("whose tracks are map"));

    world.leaderboard().tracks[0].name = "sensors".into();
    assert!(creates(&world.pass_to(Pending, Reason::Preparing)));
}

/// Its Leaderboard is not ready, for this reason.
fn not_ready(world: &mut World, reason: Reason) {
    let leaderboard = Arc::make_mut(world.view.leaderboard.as_mut().unwrap());
    let conditions = &mut leaderboard.status.get_or_insert_default().conditions;
    let now = Time(at(0));
    conditions::set(
        conditions,
        READY,
        conditions::Truth::False,
        reason,
        "spec.podOverrides: no",
        None,
        &now,
    );
}

#[test]
fn a_leaderboard_that_cannot_make_jobs_is_waited_for() {
    let mut world = World::local();
    not_ready(&mut world, Reason::InvalidPod);
    let plan = world.pass_to(Pending, Reason::LeaderboardNotReady);
    assert!(
        plan.status
            .message
            .unwrap()
            .contains("(InvalidPod): spec.podOverrides: no. Fix it")
    );

    let mut world = World::local();
    not_ready(&mut world, Reason::QueueBlocked);
    assert!(creates(&world.pass()), "a blocked queue is the bridge's affair");
}

/// Whatever its status shows: that may be of an earlier spec.
#[test]
fn a_leaderboard_that_names_what_it_may_not_starts_nothing_and_has_nothing_looked_at() {
    for world in [World::local, World::evalai] {
        let mut world = world();
        world.view.not_allowed = Some("It may not name the bucket theirs.".to_owned());
        let plan = world.pass_to(Pending, Reason::LeaderboardNotReady);
        let message = plan.status.message.as_ref().unwrap();
        assert!(
            message.contains("(NotAllowed): It may not name the bucket theirs."),
            "{message}"
        );
        assert!(!creates(&plan), "{:?}", plan.actions);
        assert!(!has(&plan, |action| matches!(action, Action::Ask(Question::Row(_)))));
        world.view.not_allowed = None;
        assert!(creates(&world.pass()));
    }
}

#[test]
fn an_image_that_can_never_be_pulled_fails_at_once_without_a_job() {
    let long = "x".repeat(513);
    let of_object = ["team/Agent:1", "team/agent:", "ägent", &long].map(|image| (Some(image), None));
    let of_file = (None, Some("the uploaded file has no submitted_image_uri"));
    for (image, problem) in of_object.into_iter().chain([of_file]) {
        for mut world in [World::local(), World::evalai()] {
            world.submission().spec.image = image.map(str::to_owned);
            let is_evalais = world.view.evalai.is_some();
            if let Some(info) = world.in_evalai().info.as_mut() {
                (info.image, info.image_problem) = (None, problem.map(str::to_owned));
            }
            if !is_evalais {
                world.view.evalai = None;
                if image.is_none() {
                    continue;
                }
            }
            let plan = world.pass_to(Failed, Reason::ImageInvalid);
            assert!(!creates(&plan), "{image:?}");
            assert_eq!(
                condition(&plan, ACCEPTED),
                ("False".into(), Reason::ImageInvalid.into())
            );
            let failure = plan.status.failure.clone().unwrap();
            assert_eq!(failure.class, FailureClass::Participant);
            let said = problem.map_or("is not a valid image reference", |_| "no submitted_image_uri");
            assert!(failure.message.contains(said), "{}", failure.message);
            assert!(failure.message.contains("Submit again"), "{}", failure.message);
            let wanted: &[EvalaiUpdate] = if is_evalais { &[EvalaiUpdate::Failed] } else { &[] };
            assert_eq!(evalai_updates(&plan), wanted);
            world.published();
            if !is_evalais {
                world.view.evalai = None;
            }
            let plan = world.pass();
            assert!(
                has(&plan, |a| *a == Action::Record(TableUpdate::End)),
                "{:?}",
                plan.actions
            );
            world.recorded();
            assert!(has(&world.pass(), |a| *a == Action::Forget));
        }
    }
}

#[test]
fn a_later_attempt_with_an_image_runs_that_image() {
    let mut world = World::evalai();
    world.submission().spec.image = None;
    let info = world.in_evalai().info.as_mut().unwrap();
    (info.image, info.image_problem) = (None, Some("the uploaded file is no JSON".into()));
    world.pass_to(Failed, Reason::ImageInvalid);
    world.submission().spec.attempt = Attempt(2);
    world.pass();
    world.in_evalai().info.as_mut().unwrap().image = Some("ecr/agent:9".into());
    assert!(creates(&world.pass_to(Pending, Reason::Preparing)));
    assert_eq!(world.status().plan.unwrap().image.as_deref(), Some("ecr/agent:9"));
}

/// EvalAI's row is of this phase.
fn moved_to(world: &mut World, phase: i64) {
    world.in_evalai().info.as_mut().unwrap().phase = Some(phase);
}

#[test]
fn a_row_of_another_phase_is_not_run_until_it_is_of_ours_again() {
    let mut world = World::evalai();
    moved_to(&mut world, 9);
    let plan = world.pass_to(Pending, Reason::PhaseDiffers);
    assert!(!creates(&plan) && evalai_updates(&plan).is_empty());
    assert_eq!(
        condition(&plan, ACCEPTED),
        ("False".into(), Reason::PhaseDiffers.into())
    );
    let message = plan.status.message.unwrap();
    assert!(
        message.contains("submission 77 belongs to phase 9, not to phase 7"),
        "{message}"
    );
    world.go_to(3599);
    world.pass_to(Pending, Reason::PhaseDiffers);
    let mut back = world.clone();
    moved_to(&mut back, 7);
    assert!(creates(&back.pass_to(Pending, Reason::Preparing)));
    world.go_to(3600);
    let plan = world.pass_to(Failed, Reason::PhaseDiffers);
    assert_eq!(plan.status.failure.unwrap().class, FailureClass::Infrastructure);
    assert_eq!(
        evalai_updates(&world.pass()),
        [EvalaiUpdate::Failed],
        "the participant has an end"
    );
    world.published();
    let plan = world.pass();
    assert_eq!(condition(&plan, RECORDED), ("False".into(), Reason::NotRequired.into()));
    assert!(has(&plan, |a| *a == Action::Forget));
}

#[test]
fn a_submission_with_a_wrong_phase_is_taken_back_without_ending_the_row() {
    let mut world = World::evalai();
    moved_to(&mut world, 9);
    world.pass_to(Pending, Reason::PhaseDiffers);
    world.delete();
    let plan = world.pass_to(Cancelled, Reason::Deleted);
    assert_eq!(evalai_updates(&plan), []);
    assert_eq!(condition(&plan, PUBLISHED).1, Reason::NotRequired);
    assert!(has(&plan, |a| *a == Action::SetFinalizer(false)), "{:?}", plan.actions);

    // It was accepted, and EvalAI has heard that it is queued.
    let mut world = World::evalai();
    let (position, eta) = (3, None);
    world.view.turn = Turn::Wait { position, eta };
    world.pass_to(Pending, Reason::WaitingForSlot);
    moved_to(&mut world, 9);
    world.pass_to(Pending, Reason::PhaseDiffers);
    world.submission().spec.cancel = true;
    assert_eq!(
        evalai_updates(&world.pass_to(Cancelled, Reason::Cancelled)),
        [EvalaiUpdate::Cancelled]
    );
}

#[test]
fn what_waits_before_its_acceptance_hears_of_its_end_in_evalai() {
    type Wait = fn(&mut World);
    let waits: [(Reason, Wait); 5] = [
        (Reason::TrackNotFound, |w| w.leaderboard().tracks[0].phase = Some(8)),
        (Reason::ImageMissing, |w| {
            w.submission().spec.image = None;
            w.in_evalai().info.as_mut().unwrap().image = None;
        }),
        (Reason::LeaderboardNotReady, |w| not_ready(w, Reason::InvalidPod)),
        (Reason::NotIsolated, |w| {
            w.view.is_policy_in_place = false;
            w.go_to(5);
        }),
        (Reason::PhaseDiffers, |w| moved_to(w, 9)),
    ];
    for (reason, wait) in waits {
        let mut world = World::evalai();
        wait(&mut world);
        let plan = world.pass_to(Pending, reason);
        assert!(
            has(&plan, |a| *a == Action::Ask(Question::EvalaisEnd)),
            "{reason}: {:?}",
            plan.actions
        );
        assert_eq!(
            plan.status.times.submitted,
            Some(Time(at(-60))),
            "{reason}: EvalAI's lists are asked from then on"
        );
        world.in_evalai().cancelled = true;
        let plan = world.pass_to(Cancelled, Reason::EndedInEvalAI);
        assert_eq!(evalai_updates(&plan), [], "{reason}");
        assert!(has(&plan, |a| *a == Action::Forget), "{reason}: {:?}", plan.actions);
    }
}

#[test]
fn evalai_is_asked_also_where_the_track_is_missing() {
    let mut world = World::evalai();
    world.leaderboard().tracks[0].phase = Some(8);
    world.in_evalai().info = None;
    assert!(has(&world.pass(), |a| *a == Action::Ask(Question::Evalai)));
    world.in_evalai().info = Some(crate::view::EvalaiInfo {
        standing: Standing::Ended,
        status: Status::Cancelled,
        ..info()
    });
    world.pass_to(Cancelled, Reason::EndedInEvalAI);
}

#[test]
fn what_waits_between_two_tries_is_followed_after_a_restart() {
    let mut world = World::evalai().running();
    world.job().end = Some(crate::view::JobEnd::Failed {
        at: None,
        reason: "BackoffLimitExceeded".into(),
        message: "no".into(),
    });
    world.view.report.stored = crate::view::ObservedReport::Absent;
    world.pass_to(Pending, Reason::Replacing);
    world.job_gone();
    let plan = world.pass_to(Pending, Reason::Replacing);
    assert!(
        has(&plan, |a| *a == Action::Ask(Question::EvalaisEnd)),
        "{:?}",
        plan.actions
    );
}

#[test]
fn a_row_of_another_phase_that_its_participant_deleted_is_ended_there() {
    let mut world = World::evalai();
    moved_to(&mut world, 9);
    world.pass_to(Pending, Reason::PhaseDiffers);
    let mut cancelled = world.clone();
    (world.in_evalai().cancelled, world.in_evalai().overtaken) = (true, true);
    let plan = world.pass_to(Cancelled, Reason::EndedInEvalAI);
    assert_eq!(
        evalai_updates(&plan),
        [EvalaiUpdate::Cancelled],
        "EvalAI counts it as being processed"
    );
    assert_eq!(
        condition(&plan, PUBLISHED),
        ("False".into(), Reason::ConcurrentUpdate.into())
    );
    world.published();
    assert_eq!(condition(&world.pass(), PUBLISHED).0, "True");

    cancelled.in_evalai().cancelled = true;
    let plan = cancelled.pass_to(Cancelled, Reason::EndedInEvalAI);
    assert_eq!(evalai_updates(&plan), []);
    assert_eq!(condition(&plan, PUBLISHED).1, Reason::NotRequired);
}

#[test]
fn the_next_step_after_evalais_own_end_is_one_that_evalai_takes() {
    for (status, is_written, step) in [
        (Status::Failed, false, "Resume it there if it is to run."),
        (Status::Cancelled, false, "re-run it there if it is to run."),
        (Status::Archived, false, "re-run it there if it is to run."),
        (Status::Finished, false, "re-run it there if it is to run."),
        (Status::Deleted, true, "the participant can submit again."),
        (Status::Ignored, false, "the participant can submit again."),
        (Status::Missing, false, "the participant can submit again."),
    ] {
        let mut world = World::evalai();
        world.in_evalai().info = Some(crate::view::EvalaiInfo {
            standing: Standing::Ended,
            status,
            ..info()
        });
        let message = world.pass_to(Cancelled, Reason::EndedInEvalAI).status.message.unwrap();
        assert!(message.starts_with(&format!("EvalAI shows {status}: ")), "{message}");
        assert!(message.ends_with(step), "{message}");
        assert_eq!(
            message.contains("`cancelled` is written there"),
            is_written,
            "{message}"
        );
        assert_eq!(message.contains("nothing is reported"), !is_written, "{message}");
    }
}

#[test]
fn why_an_image_is_unknown_follows_its_cause() {
    let mut world = World::evalai();
    world.submission().spec.image = None;
    world.in_evalai().info.as_mut().unwrap().image = None;
    world.in_evalai().error = Some("EvalAI answered 404".into());
    world.pass_to(Pending, Reason::ImageMissing);
    let since = conditions::get(&world.status().conditions, STALLED).cloned().unwrap();
    world.wait(60);
    world.in_evalai().error = Some("EvalAI answered 503".into());
    let status = world.pass_to(Pending, Reason::ImageMissing).status;
    let stalled = conditions::get(&status.conditions, STALLED).unwrap();
    for message in [&stalled.message, status.message.as_ref().unwrap()] {
        assert!(
            message.contains("answered 503") && !message.contains("404"),
            "{message}"
        );
    }
    assert_eq!(stalled.last_transition_time, since.last_transition_time);
}
