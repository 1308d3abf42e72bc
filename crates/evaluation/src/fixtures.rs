//! Runs and their results, for the tests of this crate and of others.

use std::fs;
use std::path::Path;

use leaderboard_protocol::files::{Mark, Member, Pair, Side, StatusFile};

use leaderboard_api::{
    Attempt, ByteQuantity, CarlaPlan, ContainerPlan, EvaluationMode, InputBounds, LeaderboardVersion, MergeMethod,
    Order, PlannedEvaluation, RouteSlice, RunPlan, S3Bucket, ScoreMetric, Storage, Verify,
};
use leaderboard_contract::run::{Run, SCHEMA, STATUS_FOLDER};

/// Two pairs of two routes each, once.
pub fn run() -> Run {
    Run {
        schema: SCHEMA,
        namespace: "default".to_owned(),
        submission: "submission-77".to_owned(),
        uid: "uid-1".to_owned(),
        attempt: Attempt(1),
        plan: RunPlan {
            run_id: "77".parse().unwrap(),
            track: "sensors".into(),
            phase: None,
            storage: Storage {
                s3: S3Bucket {
                    bucket: "results".to_owned(),
                    prefix: Some("2026/".to_owned()),
                    region: None,
                    endpoint: None,
                    size_limit: ByteQuantity::gibibytes(1),
                    kms_key_arn: None,
                    storage_class: None,
                },
            },
            image: Some("image".to_owned()),
            evaluation: PlannedEvaluation::Carla(CarlaPlan {
                version: LeaderboardVersion::V2,
                codename: "SENSORS".into(),
                slices: vec![RouteSlice { first: 0, last: 1 }, RouteSlice { first: 2, last: 3 }],
                routes: 4,
                repetitions: 1,
                contents_image: "contents".into(),
                simulator_image: "simulator".into(),
            }),
            resume: false,
            earlier_attempts: 0,
            submission_uid: None,
        },
        input: None,
        verify: Verify::Disabled,
        period_seconds: 1,
        flush_seconds: 60,
        cancel_seconds: 20,
        logs: None,
        isolation: None,
    }
}

/// The same with other pairs.
pub fn run_of(slices: Vec<RouteSlice>) -> Run {
    let mut run = run();
    if let PlannedEvaluation::Carla(carla) = &mut run.plan.evaluation {
        carla.slices = slices;
    }
    run
}

/// Two workers of a host's evaluator, in phase 7.
pub fn container_run() -> Run {
    run_of_mode(EvaluationMode::Interactive)
}

/// The same in another mode.
pub fn run_of_mode(mode: EvaluationMode) -> Run {
    let mut run = run();
    run.plan.track = "test".into();
    run.plan.phase = Some(7);
    run.plan.image = run.plan.image.filter(|_| mode.has_agent());
    run.plan.evaluation = PlannedEvaluation::Container(ContainerPlan {
        mode,
        workers: 2,
        merge: MergeMethod::Mean,
        score: ScoreMetric {
            split: None,
            metric: "accuracy".to_owned(),
            order: Order::Descending,
        },
        image: "evaluator".into(),
        input: mode.has_input().then(InputBounds::default),
    });
    run
}

/// A run whose results a command merges.
pub fn merging_run(mode: EvaluationMode) -> Run {
    let mut run = run_of_mode(mode);
    if let PlannedEvaluation::Container(container) = &mut run.plan.evaluation {
        container.merge = MergeMethod::Command;
    }
    run
}

/// A result with an accuracy over the units `done` of `total`, which is final if none is missing.
pub fn result(done: u32, total: u32, accuracy: f64) -> String {
    let splits = serde_json::json!([{"name": "test", "metrics": {"accuracy": accuracy}}]);
    let file = serde_json::json!({"schema": 1, "done": done, "total": total, "final": done == total, "splits": splits});
    file.to_string()
}

/// Puts a result where the evaluator of a worker would.
pub fn put_result(logs: &Path, worker: usize, text: &str) {
    let folder = logs.join(format!("evaluators/{worker}"));
    fs::create_dir_all(&folder).unwrap();
    let part = folder.join(".result.json");
    fs::write(&part, text).unwrap();
    fs::rename(part, folder.join("result.json")).unwrap();
}

/// A V2 checkpoint with the routes `first..first + done` of `total`.
pub fn checkpoint(first: u32, done: u32, total: u32) -> String {
    let record = |index: u32| {
        serde_json::json!({
            "index": index,
            "route_id": format!("RouteScenario_{}_rep0", first + index),
            "status": "Completed",
            "num_infractions": 0,
            "infractions": {"collisions_pedestrian": [], "collisions_vehicle": [], "collisions_layout": [],
                "red_light": [], "stop_infraction": [], "outside_route_lanes": [], "min_speed_infractions": [],
                "yield_emergency_vehicle_infractions": [], "scenario_timeouts": [], "route_dev": [],
                "vehicle_blocked": [], "route_timeout": []},
            "scores": {"score_route": 100.0, "score_penalty": 1.0, "score_composed": 100.0},
            "meta": {"route_length": 100.0, "duration_game": 10.0, "duration_system": 20.0},
        })
    };
    let global = if done == total {
        serde_json::json!({"index": -1, "status": "Completed"})
    } else {
        serde_json::json!({})
    };
    let file = serde_json::json!({
        "_checkpoint": {
            "global_record": global,
            "progress": [done, total],
            "records": (0..done).map(record).collect::<Vec<_>>(),
        },
        "entry_status": if done == total { "Finished" } else { "Started" },
        "eligible": done == total,
        "sensors": ["carla_camera", "carla_gnss"],
        "values": [],
        "labels": [],
    });
    file.to_string()
}

/// Puts a checkpoint where the agent of a pair would.
pub fn put_checkpoint(logs: &Path, pair: usize, text: &str) {
    let folder = logs.join(format!("agent/agent{pair}"));
    fs::create_dir_all(&folder).unwrap();
    fs::write(folder.join("agent_results.json"), text).unwrap();
}

/// Puts a status file where the container would.
pub fn put_status(logs: &Path, side: Side, pair: u16, mark: Mark) {
    let pair = Pair::new(pair).unwrap();
    let root = logs.join(STATUS_FOLDER);
    fs::create_dir_all(&root).unwrap();
    StatusFile::Of(Member { side, pair }, mark).create(&root).unwrap();
}
