//! A Leaderboard with a queue, for tests here and of the bridge.

use std::sync::Arc;

use leaderboard_api::Leaderboard;
use serde_json::json;

/// A Leaderboard of challenge 1 with phases 2 and 3, created at this second.
pub fn board(name: &str, second: i64) -> Leaderboard {
    let created = jiff::Timestamp::from_second(second).unwrap().to_string();
    serde_json::from_value(json!({
        "apiVersion": "leaderboard.carla.org/v1alpha1",
        "kind": "Leaderboard",
        "metadata": {"name": name, "namespace": "ns", "creationTimestamp": created},
        "spec": {
            "evalai": {"apiServer": "https://e", "challenge": 1, "token": {"secretKeyRef": {"name": "t", "key": "k"}}},
            "tracks": [{"name": "sensors", "phase": 2}, {"name": "map", "phase": 3}],
            "evaluation": {"carla": {
                "version": "V2", "contents": {"image": "c"}, "simulator": {"image": "s"},
            }},
            "storage": {"s3": {"bucket": "bbb"}}
        }
    }))
    .unwrap()
}

pub fn with_queue(mut board: Leaderboard, url: &str) -> Arc<Leaderboard> {
    board.spec.queue = Some(serde_json::from_value(json!({"sqs": {"url": url}})).unwrap());
    Arc::new(board)
}

/// The same with an evaluation by a container in this mode.
pub fn in_mode(mut board: Leaderboard, mode: &str) -> Leaderboard {
    let evaluation = json!({"container": {"mode": mode, "image": "e", "command": ["e"]}});
    board.spec.evaluation = serde_json::from_value(evaluation).unwrap();
    board
}
