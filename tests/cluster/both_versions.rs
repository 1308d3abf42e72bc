//! Leaderboard 1.0 from a message to its score, and 1.0 and 2.0 next to each other as the original has them.

use std::collections::BTreeSet;
use std::time::Duration;

use evalai_stand_in::model::Status;
use k8s_openapi::api::core::v1::Pod;
use kube::ResourceExt as _;
use leaderboard_api::{Attempt, State, Submission};
use serde_json::{Map, Value, json};

use super::matrix::Case;
use crate::evalai::Evalai;
use crate::operator::{bridge, controller};
use crate::scene::{Scene, scenario, score, state};

const LIMIT: Duration = Duration::from_mins(4);
const ROUTES: &str = "/workspace/leaderboard/data/routes_testing.xml";
const SCENARIOS: &str = "/workspace/leaderboard/data/all_towns_traffic_scenarios_private.json";
/// The routes of each pair, each of them twice.
const LEGS: [[u32; 6]; 2] = [[0, 0, 1, 1, 2, 2], [3, 3, 4, 4, 5, 5]];
/// Metrics that only 2.0 has.
const ONLY_V2: [&str; 3] = [
    "yield_emergency_vehicle_infractions",
    "scenario_timeouts",
    "min_speed_infractions",
];

/// Routes 0 to 5, each driven twice, by 1.0's formulas. The points of each are in local/challenge/README.md, and a rate is the sum of
/// each run's own.
fn expected() -> Vec<(&'static str, f64)> {
    vec![
        ("Driving score", (100.0 + 70.0 + 60.0 + 100.0 + 60.0 + 100.0) / 6.0),
        ("Route completion", (5.0 * 100.0 + 60.0) / 6.0),
        ("Infraction penalty", (4.0 + 0.7 + 0.6) / 6.0),
        ("Collisions pedestrians", 0.0),
        ("Collisions vehicles", 2.0 / 0.9),
        ("Collisions layout", 0.0),
        ("Red light infractions", 2.0 / 1.2),
        ("Stop sign infractions", 0.0),
        ("Off-road infractions", 0.0),
        ("Route deviations", 0.0),
        ("Route timeouts", 2.0 / (0.6 * 2.0)),
        ("Agent blocked", 0.0),
    ]
}

/// Makes the agent's log show its command line.
fn prints() -> Value {
    json!({"name": "CHALLENGE_PRINT_ARGUMENTS", "value": "1"})
}

#[tokio::test]
async fn leaderboard_10_comes_from_a_message_over_a_resume_to_its_score() {
    scenario("leaderboard-10", async |scene: &Scene| {
        let evalai = Evalai::start(scene).await;
        let change = json!({
            "evaluation": {"carla": {
                "version": "V1", "pairs": 2, "routes": 6, "repetitions": 2,
            }},
            "evalai": {"challenge": 2},
            "tracks": [{"name": "map", "carla": {"codename": "MAP", "routesFile": ROUTES, "scenariosFile": SCENARIOS}, "phase": 4}],
            "retries": {"perWorker": 0},
            "agent": {"env": [prints(), {"name": "AGENT_KNOBS", "value": "pair=2,crash@4"}]},
        });
        scene.evalai_leaderboard("lb-10", &evalai, change).await;
        let (_controller, _bridge) = (controller(scene), bridge(scene));
        let mut case = Case::open(
            "Leaderboard 1.0: an agent crashes, a host resumes",
            "Failed AgentCrashed (participant, charged); EvalAI failed; Finished; EvalAI finished",
        );
        let pk = evalai.submit(&scene.lab.challenge("agent:standard"), 4).await;
        let (run, name) = (pk.to_string(), format!("submission-{pk}"));
        let pod = scene.first_pod(&name, LIMIT).await;
        case.ends(scene, &name, LIMIT).await;
        case.evalai(evalai.submission(pk).status);
        // Until then it may store what it has.
        scene.wait(&pod.name_any(), "it has ended", LIMIT, has_ended).await;
        let stored = [complete(scene, &run, 1).await, complete(scene, &run, 2).await];
        assert_eq!(stored[1], 3, "the second agent has driven three times");
        let crashed = scene.cloud.row_of(&scene.cloud.table, pk).await;
        assert_eq!((&*crashed["submission_status"], crashed.get("driving_score")), ("FAILED", None));

        scene.change_leaderboard("lb-10", &json!({"agent": {"env": [prints()]}})).await;
        evalai.resume(pk).await;
        assert_eq!(evalai.submission(pk).status, Status::Resuming);
        let resumed = |s: &Submission| s.status.as_ref().and_then(|status| status.attempt) == Some(Attempt(2));
        scene.submission(&name, "the second attempt begins", LIMIT, resumed).await;
        let finished = case.ends(scene, &name, LIMIT).await;
        case.evalai(evalai.submission(pk).status);
        case.close();

        assert_eq!((state(&finished), score(&finished)), (Some(State::Finished), "81.67"));
        assert_command_lines(scene, &run, stored).await;
        assert_nothing_complete_is_driven_again(scene, &run, stored).await;
        assert_published(scene, &evalai, pk).await;
    })
    .await;
}

fn has_ended(pod: Option<&Pod>) -> bool {
    let phase = pod.map(|pod| pod.status.as_ref().and_then(|status| status.phase.as_deref()));
    phase.is_none_or(|phase| matches!(phase, Some("Succeeded" | "Failed")))
}

/// How many runs of routes a pair's stored checkpoint has.
async fn complete(scene: &Scene, run: &str, pair: usize) -> usize {
    let text = scene
        .cloud
        .text(run, &format!("agent/agent{pair}/agent_results.json"))
        .await;
    let checkpoint: Value = serde_json::from_str(&text).unwrap();
    let progress = &checkpoint["_checkpoint"]["progress"];
    assert_eq!(progress[1], 6);
    usize::try_from(progress[0].as_u64().unwrap()).unwrap()
}

/// Fails unless simulator and evaluator were started with the right command lines, as their logs show them.
async fn assert_command_lines(scene: &Scene, run: &str, stored: [usize; 2]) {
    for (pair, subset) in [(1, "0-2"), (2, "3-5")] {
        let port = 1900 + 100 * pair;
        let server = scene
            .cloud
            .text(run, &format!("simulator/Logs/CarlaUE4-{port}.log"))
            .await;
        let started = format!(" arguments: -carla-rpc-port={port} -opengl -nosound\n");
        assert!(server.contains(&started), "{server}");
        let log = scene
            .cloud
            .text(run, &format!("agent/agent{pair}/leaderboard.log"))
            .await;
        for flag in [
            format!("--trafficManagerPort={}", port + 10),
            "--track=MAP".to_owned(),
            format!("--routes={ROUTES}"),
            format!("--routes-subset={subset}"),
            format!("--scenarios={SCENARIOS}"),
            "--repetitions=2".to_owned(),
        ] {
            assert!(log.contains(&flag), "{flag} is not in {log}");
        }
        // The evaluator of a pair with nothing left to drive is not started again.
        let has_rest = stored[pair - 1] < LEGS[pair - 1].len();
        assert_eq!(log.contains("--resume=1"), has_rest, "{log}");
    }
}

/// The servers of the second attempt have seen the rest of each pair's list alone. A server of a pair that was done has seen no route.
async fn assert_nothing_complete_is_driven_again(scene: &Scene, run: &str, stored: [usize; 2]) {
    for (pair, complete) in stored.into_iter().enumerate() {
        let key = format!("simulator/Logs/CarlaUE4-{}.log", 2000 + 100 * pair);
        let server = scene.cloud.text(run, &key).await;
        let all = LEGS[pair].len() == complete;
        let (_, second) = server.rsplit_once(" arguments: ").unwrap();
        let begun = if all { server.as_str() } else { second };
        let begun = begun
            .lines()
            .filter_map(|line| line.strip_prefix("route ")?.split_once(" begins"));
        let begun: Vec<u32> = begun.map(|(route, _)| route.parse().unwrap()).collect();
        let expected = if all { &LEGS[pair][..] } else { &LEGS[pair][complete..] };
        assert_eq!(begun, expected, "pair {}: {server}", pair + 1);
    }
}

/// S3, EvalAI's leaderboard and the table have 1.0's metrics under 1.0's names.
async fn assert_published(scene: &Scene, evalai: &Evalai, pk: u64) {
    let text = scene.cloud.text(&pk.to_string(), "evalai/results.json").await;
    let results: Value = serde_json::from_str(&text).unwrap();
    assert_eq!(results[0]["split"], "leaderboard");
    assert_metrics(results[0]["accuracies"].as_object().unwrap());
    let rows = evalai.rows(pk);
    assert_eq!(rows.len(), 1, "{rows:?}");
    assert_metrics(&rows[0].result);
    let shown = evalai.leaderboard(4).await;
    assert_eq!((shown.len(), &shown[0]["submission__id"]), (1, &json!(pk)));

    let row = scene.cloud.row_of(&scene.cloud.table, pk).await;
    for (name, value) in expected() {
        let column = name.to_lowercase().replace([' ', '-'], "_");
        let found: f64 = row[&column].parse().unwrap();
        assert!((found - value).abs() < 1e-9, "{column} is {found}, not {value}");
    }
    assert!(ONLY_V2.iter().all(|column| !row.contains_key(*column)), "{row:?}");
    for (column, text) in [
        ("submission_status", "FINISHED"),
        ("track_id", "4"),
        ("track_name", "MAP"),
        ("attempt", "2"),
        ("progress", "12/12"),
    ] {
        assert_eq!(row[column], text, "{column} of {row:?}");
    }
}

fn assert_metrics(found: &Map<String, Value>) {
    let names: BTreeSet<&str> = found.keys().map(String::as_str).collect();
    assert_eq!(names, expected().into_iter().map(|(name, _)| name).collect());
    for (name, value) in expected() {
        let found = found[name].as_f64().unwrap();
        assert!((found - value).abs() < 1e-9, "{name} is {found}, not {value}");
    }
}

/// A Leaderboard of the original: its phases, its version, and what is its own.
struct Original {
    name: &'static str,
    phases: [u64; 2],
    folder: &'static str,
    flags: &'static str,
    metrics: usize,
}

const ORIGINALS: [Original; 2] = [
    Original {
        name: "leaderboard-20",
        phases: [1, 2],
        folder: "20",
        flags: "-vulkan -carla-rpc-port=2000 -RenderOffScreen -nosound",
        metrics: 15,
    },
    Original {
        name: "leaderboard-10",
        phases: [3, 4],
        folder: "10",
        flags: "-carla-rpc-port=2000 -opengl -nosound",
        metrics: 12,
    },
];
const TRACKS: [&str; 2] = ["SENSORS", "MAP"];

impl Original {
    async fn apply(&self, scene: &Scene, evalai: &Evalai) {
        let is_first = self.metrics == 12;
        let track = |(codename, phase): (&str, u64)| {
            let mut track = json!({"name": codename.to_lowercase(), "carla": {"codename": codename}, "phase": phase});
            if is_first {
                track["carla"]["scenariosFile"] = SCENARIOS.into();
            }
            track
        };
        let tracks: Vec<Value> = TRACKS.into_iter().zip(self.phases).map(track).collect();
        let change = json!({
            "evaluation": {"carla": {
                "version": if is_first { "V1" } else { "V2" }, "pairs": 1, "routes": 2,
                "repetitions": if is_first { 2 } else { 1 },
            }},
            "tracks": tracks,
            "agent": {"env": [prints()]},
            "evalai": {"requestsPerMinute": 600},
            "storage": {"s3": {"prefix": format!("{}{}/", scene.cloud.prefix, self.folder)}},
            "table": {"dynamoDB": {"name": self.table(scene)}},
        });
        scene.evalai_leaderboard(self.name, evalai, change).await;
    }

    fn table<'a>(&self, scene: &'a Scene) -> &'a str {
        if self.metrics == 12 {
            &scene.cloud.hyphen_table
        } else {
            &scene.cloud.table
        }
    }

    /// A submission went to this Leaderboard and to the track of its phase, and all of it is in the Leaderboard's own places.
    async fn assert_has(&self, scene: &Scene, evalai: &Evalai, codename: &str, phase: u64, pk: u64) {
        let submission = scene
            .api::<Submission>()
            .get(&format!("submission-{pk}"))
            .await
            .unwrap();
        assert_eq!(
            (state(&submission), score(&submission)),
            (Some(State::Finished), "85.00")
        );
        assert_eq!(submission.spec.leaderboard_name, self.name);
        let track = submission.status.unwrap().track;
        assert_eq!(track, Some(codename.to_lowercase()));
        let row = scene.cloud.row_of(self.table(scene), pk).await;
        let column = |name: &str| row[name].as_str();
        assert_eq!(
            (column("submission_status"), column("track_name"), column("track_id")),
            ("FINISHED", codename, phase.to_string().as_str())
        );
        let run = format!("{}/{pk}", self.folder);
        let log = scene.cloud.text(&run, "agent/agent1/leaderboard.log").await;
        assert!(log.contains(&format!("--track={codename}")), "{log}");
        let server = scene.cloud.text(&run, "simulator/Logs/CarlaUE4-2000.log").await;
        assert!(server.contains(&format!(" arguments: {}", self.flags)), "{server}");
        let shown = evalai.leaderboard(phase).await;
        assert_eq!((shown.len(), &shown[0]["submission__id"]), (1, &json!(pk)));
        assert_eq!(evalai.rows(pk)[0].result.len(), self.metrics);
    }
}

#[tokio::test]
async fn one_queue_feeds_both_leaderboards_of_a_challenge_and_all_four_phases() {
    scenario("four-phases", async |scene: &Scene| {
        let evalai = Evalai::start_as_the_original(scene).await;
        for original in &ORIGINALS {
            original.apply(scene, &evalai).await;
        }
        let (_controller, _bridge) = (controller(scene), bridge(scene));
        let image = scene.lab.challenge("agent:standard");
        let mut sent = Vec::new();
        // As they may come: neither Leaderboard's two follow each other.
        for track in [0, 1] {
            for original in &ORIGINALS {
                let phase = original.phases[track];
                sent.push((original, TRACKS[track], phase, evalai.submit(&image, phase).await));
            }
        }
        for (.., pk) in &sent {
            scene.settled(&format!("submission-{pk}"), LIMIT).await;
        }
        for (original, codename, phase, pk) in &sent {
            original.assert_has(scene, &evalai, codename, *phase, *pk).await;
        }
        for original in &ORIGINALS {
            assert_eq!(
                scene.cloud.rows(original.table(scene)).await.len(),
                2,
                "{}",
                original.name
            );
        }
        assert_eq!(scene.jobs().await.len(), 4, "each is run once");
        scene.cloud.await_messages([0, 0], LIMIT).await;
        assert_eq!(scene.cloud.depth(&scene.cloud.dead_url).await, [0, 0]);
    })
    .await;
}
