//! Requests of a controller while its submissions only run or wait. Nothing is new, so it only looks at their reports.

use std::collections::BTreeMap;
use std::time::Duration;

use jiff::Timestamp;
use k8s_openapi::api::batch::v1::Job;
use k8s_openapi::api::core::v1::Event;
use kube::ResourceExt;
use kube::api::{ListParams, PostParams};
use leaderboard_api::{Reason, Submission};
use serde::{Deserialize, Serialize};
use serde_json::json;
use tokio::time::sleep;

use crate::support::player::Cluster;

use super::lifecycle::{Controller, Scenario, Watched, World, has_job, is_read, is_running};

/// Submissions.
const COUNT: usize = 4;
/// As a Leaderboard has them that sets nothing else.
const PERIOD: u32 = 10;
const MINUTE: Duration = Duration::from_mins(1);

/// Cost of a minute.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct Rest {
    /// Requests to the API server by verb and resource, as of a submission's life.
    pub writes: BTreeMap<String, u64>,
    pub reads: BTreeMap<String, u64>,
    pub s3_requests: u64,
    pub reconciles: u64,
}

/// A minute with live runs that have nothing to report.
pub async fn of_live_runs() -> Rest {
    let world = World::reading_every(PERIOD, Scenario::ALL[0]).await;
    let controller = Controller::start(&world, Watched::default()).await;
    world.ready().await;
    let player = world.play();
    submit(&world).await;
    for name in names() {
        world.until(&name, "it runs", is_running).await;
    }
    let rest = minute(&world, &controller).await;
    drop(player);
    controller.end().await;
    rest
}

/// A minute with Jobs that a quota gives no Pod. Their reasons come from events, so no request asks for them.
pub async fn of_refused_jobs() -> Rest {
    let world = World::reading_every(PERIOD, Scenario::ALL[0]).await;
    let controller = Controller::start(&world, Watched::default()).await;
    world.ready().await;
    submit(&world).await;
    let cluster = Cluster::new(&world.client, &world.namespace);
    for name in names() {
        world.until(&name, "it has a Job", has_job).await;
        // The status names a Job before it is there.
        cluster.job(&format!("{name}-1")).await;
    }
    let jobs = world.api::<Job>().list(&ListParams::default()).await.unwrap();
    assert_eq!(jobs.items.len(), COUNT);
    for job in &jobs {
        refuse(&world, job).await;
    }
    for name in names() {
        world.until(&name, "it shows its quota", shows_quota).await;
    }
    // As the Job controller tries it again.
    for job in &jobs {
        refuse(&world, job).await;
    }
    let rest = minute(&world, &controller).await;
    let asked = controller.requests().await.into_iter();
    let lists = asked.filter(|request| request.verb == "list" && request.resource() == "events");
    assert_eq!(lists.count(), 2, "one for each watch, however many wait");
    controller.end().await;
    rest
}

fn names() -> impl Iterator<Item = String> {
    (0..COUNT).map(|number| format!("s{number}"))
}

async fn submit(world: &World) {
    for name in names() {
        world.submit(&name).await;
    }
}

fn shows_quota(submission: &Submission) -> bool {
    let status = submission.status.as_ref();
    status.is_some_and(|status| {
        let message = status.message.as_deref().unwrap_or_default();
        status.shows(Reason::QuotaExceeded) && message.contains("exceeded quota: none")
    })
}

/// Reports as the Job controller that the API server has refused a Pod: each try has a name of its own.
async fn refuse(world: &World, job: &Job) {
    let (name, now) = (job.name_any(), Timestamp::now().to_string());
    let tried = format!("{name}-{}", &fastrand::u64(1 << 40..).to_string()[..5]);
    let event = json!({
        "metadata": {"generateName": format!("{name}."), "namespace": world.namespace},
        "involvedObject": {"apiVersion": "batch/v1", "kind": "Job", "name": name, "namespace": world.namespace,
            "uid": job.uid()},
        "reason": "FailedCreate", "type": "Warning", "source": {"component": "job-controller"},
        "message": format!("Error creating: pods \"{tried}\" is forbidden: exceeded quota: none, requested: pods=1"),
        "firstTimestamp": now, "lastTimestamp": now, "count": 1,
    });
    let event: Event = serde_json::from_value(event).unwrap();
    world.api().create(&PostParams::default(), &event).await.unwrap();
}

/// Cost of a minute that begins at rest.
async fn minute(world: &World, controller: &Controller) -> Rest {
    controller.quiet().await;
    let before = (
        controller.requests().await.len(),
        controller.reconciles(),
        world.s3.counts().requests,
    );
    // There is no event to wait for: what does not come is what is counted.
    sleep(MINUTE).await;
    let mut rest = Rest {
        s3_requests: world.s3.counts().requests - before.2,
        reconciles: controller.reconciles() - before.1,
        ..Rest::default()
    };
    for request in controller.requests().await.split_off(before.0) {
        let of = if is_read(&request) {
            &mut rest.reads
        } else {
            &mut rest.writes
        };
        let what = format!("{} {}", request.verb, request.resource());
        *of.entry(what).or_insert(0) += 1;
    }
    rest
}
