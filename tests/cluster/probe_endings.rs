//! Each way in which a hostile agent lies about its end, or stores a trap. Each has its expected end: state, reason, class, charge and
//! number of Jobs.

use std::time::Duration;

use challenge_probe::endings::{ENDINGS, Ending, VARIABLE};
use futures::FutureExt;
use serde_json::{Value, json};

use super::matrix::{Case, together};
use crate::operator::controller;
use crate::scene::{Scene, lay_over, scenario};

/// Runs at once: each has three or five containers.
const WIDTH: usize = 4;
const LIMIT: Duration = Duration::from_mins(5);
/// Most bytes of the agents' own files in the case that grows one: half of its `storage.s3.sizeLimit`.
const GROWN: i64 = 8 << 20;

#[tokio::test]
async fn a_hostile_agent_gains_nothing_by_how_it_ends() {
    scenario("probe-endings", async |scene: &Scene| {
        let _controller = controller(scene);
        let cases = ENDINGS.iter().map(|ending| run(scene, ending).boxed_local());
        together(WIDTH, cases.collect()).await;
    })
    .await;
}

/// Nothing is tried again within a Pod; a failure of the infrastructure gets two more Jobs, which would be seen.
fn base(ending: &Ending) -> Value {
    json!({
        "evaluation": {"carla": {"pairs": 1, "routes": 2}},
        "retries": {"perWorker": 0, "infrastructure": 2},
        "deadlines": {"readySeconds": 60, "idleSeconds": 60, "cancelSeconds": 20, "flushSeconds": 120},
        "agent": {"env": [{"name": VARIABLE, "value": ending.id}]},
    })
}

async fn run(scene: &Scene, ending: &'static Ending) {
    let mut case = Case::open(ending.attack, ending.expected);
    let mut change = base(ending);
    lay_over(&mut change, serde_json::from_str(ending.change).unwrap());
    scene.leaderboard(ending.id, change).await;
    let image = format!("agent:{}", ending.image.tag());
    scene.submit_to(ending.id, ending.id, &image).await;
    case.ends(scene, ending.id, LIMIT).await;
    let jobs = jobs_of(scene, ending.id).await;
    case.also(&format!("{jobs} {}", if jobs == 1 { "Job" } else { "Jobs" }));
    check_stored(scene, ending.id).await;
    case.close();
}

/// How many Jobs a submission had: that of its only attempt, and those that followed a failure of the infrastructure.
async fn jobs_of(scene: &Scene, submission: &str) -> usize {
    let (first, again) = (format!("{submission}-1"), format!("{submission}-1-r"));
    let jobs = scene.jobs().await;
    jobs.iter()
        .filter(|job| **job == first || job.starts_with(&again))
        .count()
}

/// Status files are empty in S3 whatever they hold, and no agent stores more than it may.
async fn check_stored(scene: &Scene, id: &str) {
    let keys = scene.cloud.keys(id).await;
    let full: Vec<_> = keys
        .iter()
        .filter(|(key, size)| key.starts_with("containers-status/") && **size > 0)
        .collect();
    assert!(full.is_empty(), "{id}: status files with content were stored: {full:?}");
    if id.starts_with("status-") {
        assert!(keys.contains_key("containers-status/agent-1.start1"), "{id}: {keys:?}");
    }
    if id == "growing-file" {
        let stored = keys.get("agent/agent1/zz-growing").copied().unwrap_or_default();
        assert!(stored <= GROWN, "{id}: {stored} bytes in {keys:?}");
    }
}
