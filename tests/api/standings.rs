//! The standings of each track in the Leaderboard's status: by EvalAI's metric, without results that EvalAI has cancelled, and after
//! retention.
#![cfg(test)]

use std::time::Duration;

use evalai_stand_in::model::{Split, Status};
use kube::ResourceExt;
use kube::api::{Patch, PatchParams, PostParams};
use kube::runtime::wait::{await_condition, conditions as kubernetes};
use leaderboard_api::{Leaderboard, Order, Standing, Submission, SubmissionStatus, TrackStatus, conditions};
use serde_json::{Value, json};
use tokio::time::timeout;

use super::bridge::LIMIT;
use super::world::World;
use crate::support::player::ROUTES;

/// Changes what EvalAI's stand-in has of the leaderboard of a phase.
pub(super) fn change_board(world: &World, phase: usize, change: impl FnOnce(&mut Split)) {
    world
        .evalai
        .with_state(|state| change(&mut state.seed.challenges[0].phases[phase - 1].splits[0]));
}

pub(super) fn tracks(board: Option<&Leaderboard>) -> &[TrackStatus] {
    let status = board.and_then(|board| board.status.as_ref());
    status.map_or(&[], |status| &status.tracks)
}

fn is_ready(board: Option<&Leaderboard>) -> bool {
    board.is_some_and(|board| {
        board
            .condition(conditions::READY)
            .is_some_and(|ready| ready.status == "True")
    })
}

/// Waits until the Leaderboard `lb` shows this.
pub(super) async fn until(world: &World, what: &str, holds: impl Fn(Option<&Leaderboard>) -> bool) -> Leaderboard {
    let api = world.api::<Leaderboard>();
    let Ok(board) = timeout(LIMIT, await_condition(api.clone(), "lb", holds)).await else {
        panic!("{what}: {:?}", tracks(Some(&api.get("lb").await.unwrap())));
    };
    board.unwrap().unwrap()
}

fn leaders(board: Option<&Leaderboard>) -> Vec<&str> {
    let rows = tracks(board).iter().flat_map(|track| &track.standings);
    rows.map(|row| row.submission.as_str()).collect()
}

/// A local submission that had this score before the controller came.
async fn finished(world: &World, name: &str, team: &str, score: &str) {
    let spec = json!({"leaderboardName": "lb", "image": "r/a:1", "track": "sensors", "team": {"name": team}});
    let object = Submission::new(name, serde_json::from_value(spec).unwrap());
    let api = world.api::<Submission>();
    api.create(&PostParams::default(), &object).await.unwrap();
    let condition = |type_: &str, status: &str, reason: &str| {
        json!({"type": type_, "status": status, "reason": reason, "message": "",
               "lastTransitionTime": "2026-01-01T00:00:00Z"})
    };
    let status = json!({"status": {
        "state": "Finished", "attempt": 1, "reason": "Finished", "track": "sensors", "team": {"name": team, "displayName": team},
        "score": {"name": "Driving score", "value": score, "text": score, "final": true},
        "metrics": [{"name": "Route completion", "value": "80.00"}],
        "times": {"submitted": "2026-01-01T00:00:00Z", "finished": "2026-01-01T00:00:00Z"},
        "conditions": [condition("Finished", "True", "Finished"), condition("Succeeded", "True", "Finished"),
                       condition("Accepted", "True", "Accepted"), condition("Published", "False", "NotRequired"),
                       condition("Recorded", "False", "NotRequired")],
    }});
    let patched = api
        .patch_status(name, &PatchParams::default(), &Patch::Merge(&status))
        .await;
    patched.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_result_leads_as_evalai_ranks_it_until_a_hosts_rerun_cancels_it() {
    let world = World::new().await;
    change_board(&world, 1, |split| split.is_leaderboard_order_descending = false);
    world
        .leaderboard_with("lb", 1, "Hosts", &json!({"evaluation": {"carla": {"routes": ROUTES}}}))
        .await;
    let _controller = world.controller();
    let (pk, name) = world.submit("lb", 1).await;
    let player = world.play(Duration::from_millis(500));
    let runs = |status: &SubmissionStatus| status.progress.as_ref().is_some_and(|progress| progress.done > 0);
    world.until(&name, "a route is done", runs).await;
    player.fall_the_curtain();
    let board = until(&world, "its result leads", |board| leaders(board) == [name.as_str()]).await;
    let track = &tracks(Some(&board))[0];
    let ranking = track.ranking.clone().unwrap();
    assert_eq!(
        (ranking.metric.as_str(), ranking.order),
        ("Driving score", Order::Ascending)
    );
    let Standing {
        rank,
        team,
        team_id,
        score,
        ..
    } = &track.standings[0];
    assert_eq!((*rank, team.as_str(), team_id.as_deref()), (1, "team-a", Some("1")));
    assert_eq!((score.name.as_str(), score.value.as_str()), ("Driving score", "100.00"));

    let is_published = |s: &SubmissionStatus| s.times.published.is_some();
    world.until(&name, "EvalAI has the end", is_published).await;
    // Nothing ends the re-run: EvalAI's list of the cancelled is read while something runs.
    drop(player);
    // The status has whole seconds, and a list within the same one may be older than the result.
    tokio::time::sleep(Duration::from_secs(2)).await;
    world.rerun("lb", 1, pk).await;
    assert_eq!(
        world.evalai.with_state(|state| state.submissions[&pk].status),
        Status::Cancelled
    );
    until(&world, "a cancelled result does not lead", |board| {
        leaders(board).is_empty()
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn each_track_ranks_by_the_schema_of_its_phase_and_a_metric_that_is_not_shown_is_named() {
    let world = World::new().await;
    change_board(&world, 1, |split| {
        split.schema.default_order_by = "Route completion".into();
        split.schema.metadata = json!({"Route completion": {"sort_ascending": true}});
    });
    change_board(&world, 2, |split| {
        split.schema.default_order_by = "Agent blocked".into();
    });
    let tracks_of = json!({"tracks": [{"name": "sensors", "phase": 1}, {"name": "map", "phase": 2}]});
    world.leaderboard_with("lb", 1, "Hosts", &tracks_of).await;
    let _controller = world.controller();
    let board = until(&world, "it is ready", is_ready).await;
    let rankings = tracks(Some(&board)).iter().map(|track| {
        let ranking = track.ranking.clone().unwrap();
        (track.name.clone(), ranking.metric, ranking.order)
    });
    assert_eq!(
        rankings.collect::<Vec<_>>(),
        [
            ("sensors".into(), "Route completion".into(), Order::Ascending),
            ("map".into(), "Driving score".into(), Order::Descending)
        ]
    );
    let ready = board.condition(conditions::READY).unwrap();
    let said = "EvalAI ranks the phase of track map by Agent blocked";
    assert!(ready.message.contains(said), "{}", ready.message);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_best_of_each_team_stay_in_the_standings_when_their_submissions_are_deleted() {
    let world = World::new().await;
    let short: Value = json!({"ttlSecondsAfterFinished": 1, "retention": {"finishedSeconds": 1}});
    world.leaderboard_with("lb", 1, "Hosts", &short).await;
    let all = [
        ("one", "alpha", "40.00"),
        ("two", "=cmd()", "50.00"),
        ("three", "alpha", "45.00"),
        ("four", "gamma", "9.00"),
    ];
    for (name, team, score) in all {
        finished(&world, name, team, score).await;
    }
    let _controller = world.controller();
    for (name, ..) in all {
        let api = world.api::<Submission>();
        let Some(object) = api.get_opt(name).await.unwrap() else {
            continue;
        };
        let uid = object.uid().unwrap();
        let gone = await_condition(api, name, kubernetes::is_deleted(&uid));
        timeout(LIMIT, gone).await.expect("retention deletes it").unwrap();
    }
    let board = world.api::<Leaderboard>().get("lb").await.unwrap();
    let rows = tracks(Some(&board))[0].standings.iter();
    let rows: Vec<_> = rows
        .map(|row| {
            (
                row.rank,
                row.team.as_str(),
                row.submission.as_str(),
                row.score.value.as_str(),
            )
        })
        .collect();
    assert_eq!(
        rows,
        [
            (1, "=cmd()", "two", "50.00"),
            (2, "alpha", "three", "45.00"),
            (3, "gamma", "four", "9.00")
        ]
    );
}
