//! The move from the old pipeline, rehearsed. The pipeline serves both phases of a challenge. This operator takes over one phase after
//! the other, on the same queue, table and bucket, with submissions in flight.
//!
//! The order is that of docs/migrate.md. Each submission's end is a line of the matrix.

use std::collections::BTreeMap;
use std::time::Duration;

use evalai_stand_in::model::Status;
use kube::ResourceExt;
use leaderboard_api::{Reason, Submission, names};
use serde_json::{Value, json};

use super::matrix::Case;
use crate::evalai::{Evalai, REQUESTS_PER_MINUTE};
use crate::old_pipeline::{OldPipeline, PAIRS, ROUTES_A_PAIR, Stage};
use crate::operator::{bridge, controller};
use crate::scene::{Scene, scenario};

const SENSORS: u64 = 1;
const MAP: u64 = 2;
/// Patience with a busy machine; each wait ends with its event.
const LIMIT: Duration = Duration::from_mins(4);
/// A message that has not come after two minutes is lost; the next sweep finds its submission.
const LOST: Duration = Duration::from_mins(6);
/// Half of what EvalAI lets the token do: the old pipeline has the same one.
const REQUESTS: u32 = 27;
/// The driving score of routes 0 to 3: (100 + 70 + 60 + 100) / 4.
const SCORE: f64 = 82.5;

/// Everything of the rehearsal.
struct Rehearsal<'a> {
    scene: &'a Scene,
    evalai: &'a Evalai,
    old: OldPipeline,
    image: String,
}

/// The row and the objects in S3 that the old pipeline has made of a submission.
#[derive(Clone, PartialEq)]
struct Left {
    row: BTreeMap<String, String>,
    objects: BTreeMap<String, String>,
}

/// One submission, and what is to become of it.
struct Story {
    name: &'static str,
    expected: &'static str,
    pk: u64,
    /// Row and objects when the old pipeline was done with it; None if it did not run it.
    left: Option<Left>,
}

#[tokio::test]
async fn this_operator_takes_over_one_phase_after_the_other_from_the_old_pipeline() {
    scenario("cutover", async |scene: &Scene| {
        let evalai = Evalai::start(scene).await;
        let rehearsal = Rehearsal {
            scene,
            evalai: &evalai,
            old: OldPipeline::new(scene, &evalai),
            image: scene.lab.challenge("agent:standard"),
        };
        let mut before = rehearsal.of_the_old_pipeline().await;
        let mut stories = rehearsal.takes_over_map(&mut before).await;
        stories.extend(before);
        rehearsal.assert_all(stories).await;
    })
    .await;
}

const BY_THE_OLD: &str = "old pipeline; EvalAI finished; row FINISHED; results as it left them";
const OURS: &str = "this operator; EvalAI finished; row FINISHED attempt 1; results new";

impl Rehearsal<'_> {
    async fn submit(&self, phase: u64) -> u64 {
        self.evalai.submit(&self.image, phase).await
    }

    async fn left(&self, pk: u64) -> Left {
        let cloud = &self.scene.cloud;
        Left {
            row: cloud.row_of(&cloud.table, pk).await,
            objects: cloud.texts(&pk.to_string()).await,
        }
    }

    /// Waits until the old pipeline has brought a submission to its end.
    async fn ended(&self, name: &'static str, expected: &'static str, pk: u64) -> Story {
        self.old.reached(pk, Stage::Ended, LIMIT).await;
        let left = Some(self.left(pk).await);
        Story {
            name,
            expected,
            pk,
            left,
        }
    }

    /// The old pipeline serves both phases. Two submissions finish, one fails on its way.
    async fn of_the_old_pipeline(&self) -> Vec<Story> {
        self.old.start_pipe(&[SENSORS, MAP]);
        let (sensors, map, fails) = (
            self.submit(SENSORS).await,
            self.submit(MAP).await,
            self.submit(MAP).await,
        );
        self.old.drive(sensors, ROUTES_A_PAIR);
        self.old.drive(map, ROUTES_A_PAIR);
        self.old.drive(fails, 1);
        self.old.reached(fails, Stage::Driven(1), LIMIT).await;
        self.old.crash(fails);
        vec![
            self.ended("cutover: SENSORS, finished before", BY_THE_OLD, sensors)
                .await,
            self.ended("cutover: MAP, finished before", BY_THE_OLD, map).await,
            self.ended(
                "cutover: MAP, failed before; resumed after the first switch",
                "old pipeline, then this operator; EvalAI finished; row FINISHED attempt 1; results taken up",
                fails,
            )
            .await,
        ]
    }

    /// The Leaderboard for MAP alone; the other phase's messages are the old pipeline's.
    async fn apply_leaderboard(&self) {
        let change = json!({
            "evaluation": {"carla": {"pairs": PAIRS, "routes": PAIRS * ROUTES_A_PAIR}},
            "tracks": [{"name": "map", "carla": {"codename": "MAP"}, "phase": MAP}],
            "evalai": {"requestsPerMinute": REQUESTS, "sweepSeconds": 15},
            "queue": {"sqs": {"foreign": "Leave"}},
        });
        self.scene.evalai_leaderboard("lb", self.evalai, change).await;
    }

    async fn exists(&self, pk: u64, limit: Duration) {
        let exists = |found: Option<&Submission>| found.is_some();
        let name = submission(pk);
        self.scene.wait(&name, "it is there", limit, exists).await;
    }

    async fn finished(&self, pk: u64) {
        self.scene.settled(&submission(pk), LIMIT).await;
    }

    /// MAP is switched while the old pipeline goes on with SENSORS; then SENSORS.
    async fn takes_over_map(&self, before: &mut [Story]) -> Vec<Story> {
        let failed = before.last().unwrap().pk;
        // EvalAI shows both as submitted, for as long as a node takes to come.
        let (old_map, old_sensors) = (self.submit(MAP).await, self.submit(SENSORS).await);
        for pk in [old_map, old_sensors] {
            self.old.reached(pk, Stage::Accepted, LIMIT).await;
        }

        // No program takes messages now, so each message goes to the right one.
        self.old.stop_pipe().await;
        let (map, left) = (self.submit(MAP).await, self.submit(SENSORS).await);
        self.evalai.resume(failed).await;
        self.apply_leaderboard().await;
        let controller = controller(self.scene);
        let reader = bridge(self.scene);
        for pk in [map, failed] {
            self.exists(pk, LIMIT).await;
        }
        // A Pipe deletes what its filter does not match, so only one of the two may read. The sweep finds what the Pipe deletes.
        self.scene.change_leaderboard("lb", &json!({"queue": null})).await;
        drop(reader);
        let taken = self.taken_by_a_pipe_that_was_not_stopped().await;
        self.old.start_pipe(&[SENSORS]);
        let (swept, later) = (self.submit(MAP).await, self.submit(SENSORS).await);
        self.old.await_deleted(swept, LIMIT).await;
        for pk in [left, later] {
            self.old.reached(pk, Stage::Accepted, LIMIT).await;
        }
        self.exists(swept, LOST).await;
        self.held_back(taken).await;
        for pk in [map, failed, swept] {
            self.finished(pk).await;
        }
        let not_stopped = self.driven_by_the_old_pipeline(taken).await;
        // The sweep has read this row too: it is as old, in a phase of ours, and still submitted.
        assert_eq!(self.evalai.submission(old_map).status, Status::Submitted);
        self.old.drive(old_map, ROUTES_A_PAIR);
        let under_way = self
            .ended("cutover: MAP, in flight at the first switch", BY_THE_OLD, old_map)
            .await;

        let mut stories = vec![
            under_way,
            not_stopped,
            ours("cutover: MAP, submitted during the first switch", map),
            ours("cutover: MAP, submitted while the Pipe serves SENSORS", swept),
        ];
        stories.extend(self.takes_over_sensors([old_sensors, left, later]).await);
        drop(controller);
        stories
    }

    /// The Pipe takes one of ours, whose run then waits for a node.
    async fn taken_by_a_pipe_that_was_not_stopped(&self) -> u64 {
        self.old.start_pipe(&[SENSORS, MAP]);
        let taken = self.submit(MAP).await;
        self.old.reached(taken, Stage::Accepted, LIMIT).await;
        self.old.stop_pipe().await;
        taken
    }

    async fn held_back(&self, pk: u64) {
        let is_held = |submission: &Submission| {
            let status = submission.status.as_ref();
            status.is_some_and(|status| status.shows(Reason::Foreign))
        };
        let (name, what) = (submission(pk), "it waits for the old pipeline's run");
        self.scene.submission(&name, what, LOST, is_held).await;
    }

    async fn driven_by_the_old_pipeline(&self, pk: u64) -> Story {
        assert_eq!(self.evalai.submission(pk).status, Status::Submitted);
        self.old.drive(pk, ROUTES_A_PAIR);
        let name = "cutover: MAP, taken by a Pipe that was not stopped";
        let story = self.ended(name, BY_THE_OLD, pk).await;
        self.finished(pk).await;
        story
    }

    /// The last phase. The Leaderboard is older than what is in flight, so EvalAI has to show that this is under way.
    async fn takes_over_sensors(&self, in_flight: [u64; 3]) -> Vec<Story> {
        self.old.stop_pipe().await;
        for pk in in_flight {
            self.old.drive(pk, 1);
            self.old.reached(pk, Stage::Driven(1), LIMIT).await;
            assert_eq!(self.evalai.submission(pk).status, Status::PartiallyEvaluated);
        }
        let sensors = self.submit(SENSORS).await;
        let cloud = &self.scene.cloud;
        let change = json!({
            "tracks": [
                {"name": "sensors", "carla": {"codename": "SENSORS"}, "phase": SENSORS},
                {"name": "map", "carla": {"codename": "MAP"}, "phase": MAP},
            ],
            "queue": {"sqs": {
                "url": cloud.queue_url,
                "deadLetterURL": cloud.dead_url,
                "region": crate::aws::REGION,
                "endpoint": self.scene.gate.url,
            }},
        });
        self.scene.change_leaderboard("lb", &change).await;
        let _reader = bridge(self.scene);
        self.finished(sensors).await;
        cloud.await_messages([0, 0], LIMIT).await;
        let mut stories = vec![ours("cutover: SENSORS, submitted during the second switch", sensors)];
        let names = [
            "cutover: SENSORS, in flight at both switches",
            "cutover: SENSORS, submitted during the first switch, in flight at the second",
            "cutover: SENSORS, submitted between the switches, in flight at the second",
        ];
        for (name, pk) in names.into_iter().zip(in_flight) {
            self.old.drive(pk, ROUTES_A_PAIR);
            stories.push(self.ended(name, BY_THE_OLD, pk).await);
        }
        stories
    }

    /// None is lost, none is run twice, and everything is where it was.
    async fn assert_all(&self, stories: Vec<Story>) {
        let jobs = self.scene.jobs().await;
        let jobs_of = |name: &str| jobs.iter().filter(|job| job.starts_with(&format!("{name}-"))).count();
        let objects = self.scene.all::<Submission>().await;
        let (ours, held): (Vec<String>, Vec<String>) = objects
            .iter()
            .map(ResourceExt::name_any)
            .partition(|name| jobs_of(name) > 0);
        assert_eq!(
            (ours.len(), held.len()),
            (jobs.len(), 1),
            "each but one has one Job: {jobs:?}"
        );
        let taken = self.old.taken();
        let all = self.evalai.handle.state().submissions.len();
        assert_eq!(stories.len(), all, "each submission has its story");
        for story in stories {
            let by_old = taken.iter().filter(|pk| **pk == story.pk).count();
            let by_us = ours.contains(&submission(story.pk));
            let mut case = Case::open(story.name, story.expected);
            self.assert_score(story.pk).await;
            case.also(match (by_old, by_us) {
                (1, false) => "old pipeline",
                (0, true) => "this operator",
                (1, true) => "old pipeline, then this operator",
                (0, false) => "LOST",
                _ => "RUN TWICE",
            });
            case.evalai(self.evalai.submission(story.pk).status);
            let now = self.left(story.pk).await;
            case.also(&format!("row {}", row_of(&now.row)));
            case.also(results_of(story.left.as_ref(), &now, by_us));
            case.close();
        }
        let cloud = &self.scene.cloud;
        assert_eq!(cloud.depth(&cloud.dead_url).await, [0, 0], "nothing is dead-lettered");
        let refused = |entry: &evalai_stand_in::log::Entry| entry.status.is_none_or(|status| status >= 400);
        let refused: Vec<_> = self.evalai.requests().into_iter().filter(refused).collect();
        assert!(
            refused.is_empty(),
            "of {REQUESTS_PER_MINUTE} requests a minute both have enough: {refused:?}"
        );
    }

    /// EvalAI's leaderboard, S3 and the table hold the same score, once.
    async fn assert_score(&self, pk: u64) {
        let rows = self.evalai.rows(pk);
        assert_eq!(rows.len(), 1, "{rows:?}");
        assert_eq!(rows[0].result["Driving score"], json!(SCORE));
        let results = self.scene.cloud.text(&pk.to_string(), "evalai/results.json").await;
        let results: Value = serde_json::from_str(&results).unwrap();
        assert_eq!(results[0]["accuracies"]["Driving score"], json!(SCORE));
        let row = self.scene.cloud.row_of(&self.scene.cloud.table, pk).await;
        assert_eq!(row["driving_score"], "82.5");
    }
}

fn ours(name: &'static str, pk: u64) -> Story {
    Story {
        name,
        expected: OURS,
        pk,
        left: None,
    }
}

fn submission(pk: u64) -> String {
    names::submission(i64::try_from(pk).unwrap())
}

fn row_of(row: &BTreeMap<String, String>) -> String {
    let attempt = row
        .get("attempt")
        .map_or_else(String::new, |attempt| format!(" attempt {attempt}"));
    format!("{}{attempt}", row["submission_status"])
}

/// The results in the matrix's words, compared with the ones that the old pipeline had made.
fn results_of(left: Option<&Left>, now: &Left, by_us: bool) -> &'static str {
    match left {
        None => "results new",
        Some(left) if left == now => "results as it left them",
        Some(left) if by_us && is_taken_up(left, now) => "results taken up",
        Some(_) => "results CHANGED",
    }
}

/// Each agent goes on after its first route, which is not driven again, and what was logged before stays.
fn is_taken_up(left: &Left, now: &Left) -> bool {
    (0..PAIRS).all(|pair| {
        let port = 2000 + 100 * pair;
        let (agent, server) = (
            format!("agent/agent{}/leaderboard.log", pair + 1),
            format!("simulator/Logs/CarlaUE4-{port}.log"),
        );
        let goes_on = |key: &str| now.objects[key].strip_prefix(left.objects[key].as_str());
        let (Some(agent), Some(server)) = (goes_on(&agent), goes_on(&server)) else {
            return false;
        };
        let first = pair * ROUTES_A_PAIR;
        let begins = |route: usize| server.matches(&format!("route {route} begins")).count();
        agent.contains("> Resuming at route 2 of 2") && begins(first) == 0 && begins(first + 1) == 1
    })
}
