//! The policy and the condition that follow from answers, caches and findings.

use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;
use serde_json::{Value, json};

use super::*;
use crate::fixtures::{self, Cluster, Surroundings, surroundings};
use crate::leaderboards::reconcile;
use crate::observability::logging::tests::Lines;
use leaderboard_api::conditions::Truth;
use leaderboard_policy::leaderboards::isolated::condition;

fn leaderboard(network: &Value, generation: i64) -> Leaderboard {
    let spec = json!({
        "tracks": [{"name": "sensors"}],
        "evaluation": {"carla": {
            "version": "V2", "contents": {"image": "c"}, "simulator": {"image": "s"},
        }}, "storage": {"s3": {"bucket": "bucket"}}, "network": network,
    });
    let mut object = Leaderboard::new("carla", serde_json::from_value(spec).unwrap());
    object.metadata.generation = Some(generation);
    object
}

fn verdict(reason: WorkspaceReason) -> WorkspaceVerdict {
    WorkspaceVerdict::new(reason, "It was tried.".into())
}

/// A Leaderboard whose condition shows this of this generation.
fn shown(reason: Reason, of: i64) -> Leaderboard {
    let mut object = leaderboard(&json!({}), 2);
    let mut conditions = Vec::new();
    let now = Time(Timestamp::UNIX_EPOCH);
    conditions::set(
        &mut conditions,
        conditions::ISOLATED,
        Truth::False,
        reason,
        "As before.",
        Some(of),
        &now,
    );
    object.status.get_or_insert_default().conditions = conditions;
    object
}

#[test]
fn only_what_was_measured_is_called_enforced() {
    use WorkspaceReason::{Enforced, NotEnforced, NotIsolated, NotKnownIsolated, NotMeasured};
    let (on, off) = (
        leaderboard(&json!({}), 2),
        leaderboard(&json!({"enforcement": "Disabled"}), 2),
    );
    let in_place = || Policy::InPlace;
    let cases = [
        (&on, Policy::External, Some(Enforced), Truth::Unknown, Reason::External),
        (
            &on,
            Policy::Refused("no".into()),
            Some(Enforced),
            Truth::False,
            Reason::Forbidden,
        ),
        (
            &on,
            Policy::NotApplied("no".into()),
            None,
            Truth::False,
            Reason::NotApplied,
        ),
        (&on, in_place(), None, Truth::Unknown, Reason::NotMeasured),
        (&on, in_place(), Some(NotMeasured), Truth::Unknown, Reason::NotMeasured),
        (&on, in_place(), Some(Enforced), Truth::True, Reason::Enforced),
        (&on, in_place(), Some(NotEnforced), Truth::False, Reason::NotEnforced),
        (&on, in_place(), Some(NotIsolated), Truth::False, Reason::NotEnforced),
        (
            &on,
            in_place(),
            Some(NotKnownIsolated),
            Truth::Unknown,
            Reason::NotMeasured,
        ),
        (&off, in_place(), Some(Enforced), Truth::Unknown, Reason::NotMeasured),
    ];
    for (leaderboard, policy, found, truth, reason) in cases {
        let (is, why, message) = condition(leaderboard, &policy, found.map(verdict).as_ref());
        assert_eq!((is, why), (truth, reason), "{policy:?} {found:?}");
        assert!(!message.is_empty());
    }
}

#[tokio::test]
async fn what_a_pod_found_outlives_it_until_the_spec_changes() {
    let around = surroundings(Cluster::default(), "http://127.0.0.1:1").await;
    let said = |leaderboard: &Leaderboard| {
        let state = &around.context.leaderboards;
        let found = measured(state, leaderboard);
        condition(leaderboard, &Policy::InPlace, found.as_ref())
    };
    for (reason, of) in [(Reason::NotEnforced, 1), (Reason::Enforced, 1), (Reason::Forbidden, 2)] {
        assert_eq!(said(&shown(reason, of)).1, Reason::NotMeasured, "{reason} of {of}");
    }
    assert_eq!(said(&shown(Reason::Enforced, 2)).0, Truth::True);
    let (truth, reason, message) = said(&shown(Reason::NotEnforced, 2));
    assert_eq!(
        (truth, reason, message.as_str()),
        (Truth::False, Reason::NotEnforced, "As before.")
    );
    let (truth, ..) = condition(
        &shown(Reason::NotEnforced, 2),
        &Policy::InPlace,
        Some(&verdict(WorkspaceReason::Enforced)),
    );
    assert_eq!(truth, Truth::True, "what was found last counts");

    // It was refused for a moment.
    let (_, reason, message) = said(&shown(Reason::Forbidden, 2));
    assert_eq!((reason, message.as_str()), (Reason::NotEnforced, "As before."));
    let mut edited = shown(Reason::Forbidden, 2);
    edited.metadata.generation = Some(3);
    assert_eq!(said(&edited).1, Reason::NotMeasured, "of another spec");
}

#[test]
fn the_newest_pod_of_the_newest_spec_counts_also_when_it_is_gone() {
    use WorkspaceReason::{Enforced, NotEnforced, NotMeasured};
    let state = LeaderboardState::default();
    let of = |generation: i64| leaderboard(&json!({}), generation);
    let found = |generation: i64| measured(&state, &of(generation)).map(|verdict| verdict.reason);
    let pod = |generation: &str, second: i64, reason: WorkspaceReason| -> Pod {
        let at = Timestamp::from_second(second).unwrap().to_string();
        let ended = json!({"terminated": {"exitCode": 0, "message": verdict(reason).to_json(), "finishedAt": at}});
        let status = json!({"name": "workspace", "image": "i", "imageID": "", "ready": false, "restartCount": 0, "state": ended});
        let annotations = json!({names::ANNOTATION_GENERATION: generation});
        let pod = json!({"metadata": {"annotations": annotations}, "status": {"initContainerStatuses": [status]}});
        serde_json::from_value(pod).unwrap()
    };
    assert_eq!(found(2), None);
    for (what, pod, expected) in [
        ("the first", pod("2", 10, Enforced), Some(Enforced)),
        (
            "an earlier one of the same spec",
            pod("2", 5, NotMeasured),
            Some(Enforced),
        ),
        (
            "a later one of an older spec",
            pod("1", 20, NotMeasured),
            Some(Enforced),
        ),
        ("a later one", pod("2", 11, NotEnforced), Some(NotEnforced)),
        ("one of no spec", pod("", 30, Enforced), Some(NotEnforced)),
    ] {
        assert!(note_finding(&state, &of(2), &pod), "{what}");
        assert_eq!(found(2), expected, "{what}");
    }
    assert_eq!(found(3), None, "of another spec");
    let silent = serde_json::from_value(json!({"metadata": {}})).unwrap();
    assert!(!note_finding(&state, &of(2), &silent));
}

#[test]
fn a_finding_is_read_from_workspace_alone() {
    let pod = |container: &str, message: &str| -> Pod {
        let ended = json!({"terminated": {"exitCode": 0, "message": message, "finishedAt": "2026-11-01T12:00:00Z"}});
        let status =
            json!({"name": container, "image": "i", "imageID": "", "ready": false, "restartCount": 0, "state": ended});
        serde_json::from_value(json!({"metadata": {}, "status": {"initContainerStatuses": [status]}})).unwrap()
    };
    let said = verdict(WorkspaceReason::NotEnforced);
    let found = finding(&pod("workspace", &said.to_json()));
    assert_eq!(
        found.map(|(at, verdict)| (at > Timestamp::MIN, verdict)),
        Some((true, said.clone()))
    );
    assert!(finding(&pod("contents", &said.to_json())).is_none());
    assert!(finding(&pod("workspace", &verdict(WorkspaceReason::StorageFailed).to_json())).is_none());
    assert!(finding(&pod("workspace", "Error")).is_none());
}

#[test]
fn what_the_cache_shows_decides_with_the_answer() {
    let (refused, failed) = (Policy::Refused("no".into()), Policy::NotApplied("no".into()));
    let cases = [
        ("seen", Policy::InPlace, true, false, Policy::InPlace),
        ("not seen yet", Policy::InPlace, false, false, Policy::InPlace),
        (
            "a timeout of a look at it",
            failed.clone(),
            true,
            false,
            Policy::InPlace,
        ),
        ("not there", failed.clone(), false, false, failed.clone()),
        ("a right that is missing", refused.clone(), true, false, refused.clone()),
        ("refused and unseen", refused.clone(), false, true, refused.clone()),
    ];
    for (name, answer, is_shown, is_blind, expected) in cases {
        assert_eq!(settled(answer, is_shown, is_blind), expected, "{name}");
    }
    let Policy::NotApplied(why) = settled(Policy::InPlace, false, true) else {
        panic!("nobody would notice that it was deleted");
    };
    assert!(why.contains("list and watch of networkpolicies"), "{why}");
    assert_eq!(again(&Policy::InPlace, true), RESYNC);
    assert_eq!(again(&Policy::InPlace, false), SOONEST);
    assert_eq!(again(&refused, true), POLICY_AGAIN, "it does not come and go");
    assert_eq!(again(&failed, false), POLICY_AGAIN);
    assert_eq!(again(&failed, true), SOONEST, "seen after all");
}

/// A Leaderboard whose policy the cache shows.
async fn in_place() -> (Leaderboard, Surroundings) {
    let mut board = fixtures::leaderboard("carla", "http://127.0.0.1:1");
    board.metadata.generation = Some(1);
    let cluster = Cluster {
        policies: vec![network_policy(&board)],
        ..Cluster::default()
    };
    let around = surroundings(cluster, "http://127.0.0.1:1").await;
    (board, around)
}

fn note(state: &LeaderboardState, board: &Leaderboard, policy: Policy, at: Timestamp) {
    let applied = Applied {
        at,
        generation: board.metadata.generation,
        policy,
        unseen: None,
    };
    state.change(&uid_of(board), |entry| entry.applied = Some(applied));
}

#[tokio::test]
async fn no_job_is_made_while_the_last_apply_is_refused_whatever_the_cache_shows() {
    let (board, around) = in_place().await;
    let context = &around.context;
    let is_in_place = || context.policies().is_in_place(&board);
    assert!(is_in_place());
    for failed in [Policy::Refused("no".into()), Policy::NotApplied("no".into())] {
        note(&context.leaderboards, &board, failed, Timestamp::now());
        assert!(!is_in_place());
    }
    note(&context.leaderboards, &board, Policy::InPlace, Timestamp::now());
    assert!(is_in_place());
    context.stores.policies_synced.set(false);
    assert!(!is_in_place(), "what the cache shows may be long gone");
}

#[tokio::test]
async fn what_was_refused_stays_so_until_it_is_tried_again_and_then_wakes_who_waits() {
    let (board, mut around) = in_place().await;
    let began = Timestamp::now();
    let after = |seconds: i64| began + jiff::SignedDuration::from_secs(seconds);
    let refused = Policy::Refused("no".into());
    note(&around.context.leaderboards, &board, refused.clone(), began);
    assert_eq!(keep(around.context.policies(), &board, after(5)).await, refused);
    assert!(around.requests.try_recv().is_err() && around.woken.try_recv().is_err());
    assert_eq!(
        keep(around.context.policies(), &board, after(11)).await,
        Policy::InPlace
    );
    assert_eq!(around.requests.try_recv().unwrap().method, http::Method::PATCH);
    assert_eq!(around.woken.try_recv().unwrap(), "carla");
    assert_eq!(
        keep(around.context.policies(), &board, after(20)).await,
        Policy::InPlace
    );
    assert!(around.requests.try_recv().is_err() && around.woken.try_recv().is_err());
}

#[tokio::test]
async fn an_apply_that_is_never_seen_is_tried_every_ten_seconds_and_called_missing() {
    let mut board = fixtures::leaderboard("carla", "http://127.0.0.1:1");
    board.metadata.generation = Some(1);
    let mut around = surroundings(Cluster::default(), "http://127.0.0.1:1").await;
    let lines = Lines::default();
    let _guard = lines.collect();
    let began = Timestamp::now();
    let mut said = Vec::new();
    for second in 0..60 {
        let now = began + jiff::SignedDuration::from_secs(second);
        said.push(keep(around.context.policies(), &board, now).await == Policy::InPlace);
    }
    assert!(said[..10].iter().all(|is_fine| *is_fine), "the cache may lag");
    assert!(said[10..].iter().all(|is_fine| !is_fine));
    let mut requests = 0;
    while around.requests.try_recv().is_ok() {
        requests += 1;
    }
    assert_eq!(requests, 10 + 5);
    let logged = lines.take();
    assert_eq!(
        logged.matches("the NetworkPolicy is not in place").count(),
        1,
        "{logged}"
    );
    assert!(logged.contains("one/carla"), "{logged}");
    around.context.stores.policies_synced.set(false);
    board.metadata.generation = Some(2);
    let policy = keep(around.context.policies(), &board, began).await;
    assert!(matches!(policy, Policy::NotApplied(_)), "never listed: said at once");
}

#[tokio::test(start_paused = true)]
async fn a_leaderboard_and_with_it_the_policy_stays_while_a_pod_of_it_runs() {
    let pod = |leaderboard: &str, phase: &str| -> Pod {
        let metadata =
            json!({"name": "p", "namespace": fixtures::NAMESPACE, "labels": {names::LABEL_LEADERBOARD: leaderboard}});
        serde_json::from_value(json!({"metadata": metadata, "status": {"phase": phase}})).unwrap()
    };
    for (left, stays) in [
        (Some(pod("carla", "Running")), true),
        (Some(pod("carla", "Pending")), true),
        (Some(pod("carla", "Unknown")), true),
        (Some(pod("carla", "Succeeded")), false),
        (Some(pod("carla", "Failed")), false),
        (Some(pod("other", "Running")), false),
        (None, false),
    ] {
        let mut board = fixtures::leaderboard("carla", "http://127.0.0.1:1");
        board.metadata.finalizers = Some(vec![names::FINALIZER_LEADERBOARD.into()]);
        board.metadata.deletion_timestamp = Some(Time(Timestamp::now()));
        let cluster = Cluster {
            policies: vec![network_policy(&board)],
            pods: left.iter().cloned().collect(),
            ..Cluster::default()
        };
        let mut around = surroundings(cluster, "http://127.0.0.1:1").await;
        // The mock's answer to a finalizer is no Leaderboard.
        let _ = reconcile(Arc::new(board), around.context.for_leaderboards()).await;
        let sent = std::iter::from_fn(|| around.requests.try_recv().ok());
        let is_released = sent
            .into_iter()
            .any(|request| request.path.ends_with("/leaderboards/carla"));
        assert_eq!(!is_released, stays, "{left:?}");
    }
}
