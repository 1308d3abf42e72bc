//! Slots of a Leaderboard as the whole controller grants them: there are no more Jobs than slots, and waiting submissions show their
//! place. A new leader counts the Jobs that the old one started.

use k8s_openapi::api::batch::v1::Job;
use kube::ResourceExt;
use kube::api::{Api, DeleteParams, Patch, PatchParams};
use kube::runtime::wait::await_condition;
use leaderboard_api::{Leaderboard, Reason, State, Submission};
use serde_json::json;
use tokio::time::timeout;

use super::bridge::{LIMIT, StandIn};
use super::objects::{Kind, create};
use super::operator::Operator;
use crate::support::apiserver::server;

const NAME: &str = "carla";

struct World {
    aws: StandIn,
    namespace: String,
}

impl World {
    /// A Leaderboard with one slot.
    async fn new() -> Self {
        let world = Self {
            aws: StandIn::start().await,
            namespace: server().await.namespace("slots").await,
        };
        let storage = json!({"bucket": world.aws.name("bucket"), "endpoint": world.aws.endpoint});
        let patch = json!({"spec": {"storage": {"s3": storage}, "concurrency": {"total": 1}}});
        let api = Kind::Leaderboard.api(&server().await.client(), &world.namespace);
        create(&api, Kind::Leaderboard.object(NAME, &[&patch]), false)
            .await
            .unwrap();
        world
    }

    async fn operator(&self) -> Operator {
        Operator::start(&self.namespace, self.aws.aws.clone()).await
    }

    async fn submit(&self, name: &str) {
        let api = Kind::Submission.api(&server().await.client(), &self.namespace);
        let patch = json!({"spec": {"leaderboardName": NAME}});
        create(&api, Kind::Submission.object(name, &[&patch]), false)
            .await
            .unwrap();
    }

    async fn check(&self, name: &str) {
        let api = Kind::Submission.api(&server().await.client(), &self.namespace);
        let patch = json!({"spec": {"leaderboardName": NAME, "check": true}});
        create(&api, Kind::Submission.object(name, &[&patch]), false)
            .await
            .unwrap();
    }

    async fn edit(&self, spec: serde_json::Value) {
        let api: Api<Leaderboard> = Api::namespaced(server().await.client(), &self.namespace);
        let patch = Patch::Merge(json!({ "spec": spec }));
        api.patch(NAME, &PatchParams::default(), &patch).await.unwrap();
    }

    async fn has_job(&self, submission: &str) {
        let jobs: Api<Job> = Api::namespaced(server().await.client(), &self.namespace);
        let name = format!("{submission}-1");
        let made = await_condition(jobs, &name, |job: Option<&Job>| job.is_some());
        timeout(LIMIT, made).await.expect("a Job is made").unwrap();
    }

    /// Waits until a submission shows this reason and place.
    async fn shows(&self, name: &str, reason: Reason, position: i32) {
        let api: Api<Submission> = Api::namespaced(server().await.client(), &self.namespace);
        let found = |object: Option<&Submission>| {
            let status = object.and_then(|object| object.status.as_ref());
            status.is_some_and(|status| {
                let place = status.waiting.as_ref().map(|waiting| waiting.position);
                status.shows(reason) && place == Some(position) && status.job_name.is_none()
            })
        };
        if timeout(LIMIT, await_condition(api.clone(), name, found)).await.is_err() {
            let status = api.get(name).await.unwrap().status;
            panic!("{name} is not at {position} ({reason}): {status:?}");
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn one_slot_is_one_job_also_after_a_takeover() {
    let world = World::new().await;
    let operator = world.operator().await;
    // Submissions of one second stand in the order of their names.
    world.submit("first").await;
    world.has_job("first").await;
    world.submit("second").await;
    world.shows("second", Reason::WaitingForSlot, 1).await;
    operator.end().await;

    let operator = world.operator().await;
    world.submit("third").await;
    world.shows("third", Reason::WaitingForSlot, 2).await;
    world.edit(json!({"paused": true})).await;
    world.shows("second", Reason::Paused, 1).await;
    world.shows("third", Reason::Paused, 2).await;
    world.edit(json!({"paused": false, "concurrency": {"total": 2}})).await;
    world.has_job("second").await;
    world.shows("third", Reason::WaitingForSlot, 1).await;
    world.edit(json!({"concurrency": null})).await;
    world.has_job("third").await;
    operator.end().await;
}

/// A host checks a Leaderboard before it serves: while it is paused, and before all that wait.
#[tokio::test(flavor = "multi_thread")]
async fn a_check_starts_while_the_leaderboard_is_paused_and_others_wait() {
    let world = World::new().await;
    world.edit(json!({"paused": true})).await;
    let operator = world.operator().await;
    world.submit("first").await;
    world.shows("first", Reason::Paused, 1).await;
    world.check("check-one").await;
    world.has_job("check-one").await;
    world.check("check-two").await;
    // The only slot is taken, also for a check.
    world.shows("check-two", Reason::WaitingForSlot, 1).await;
    let api: Api<Submission> = Api::namespaced(server().await.client(), &world.namespace);
    let status = api.get("check-one").await.unwrap().status.unwrap();
    let plan = status.plan.unwrap();
    let carla = plan.carla().unwrap();
    assert_eq!((plan.workers(), carla.routes, carla.repetitions), (1, 1, 1));
    assert_eq!(api.get("check-one").await.unwrap().finalizers().len(), 0);

    // One without a Job ends at once.
    api.patch(
        "check-two",
        &PatchParams::default(),
        &Patch::Merge(json!({"spec": {"cancel": true}})),
    )
    .await
    .unwrap();
    let cancelled = |object: Option<&Submission>| {
        let status = object.and_then(|object| object.status.as_ref());
        status.is_some_and(|status| status.state == Some(State::Cancelled))
    };
    let ended = Box::pin(await_condition(api, "check-two", cancelled));
    timeout(LIMIT, ended).await.expect("it ends").unwrap();
    let boards: Api<Leaderboard> = Api::namespaced(server().await.client(), &world.namespace);
    let counted = |object: Option<&Leaderboard>| {
        let status = object.and_then(|board| board.status.as_ref());
        let counts = status.and_then(|status| status.counts).unwrap_or_default();
        (counts.pending, counts.running, counts.cancelled) == (1, 0, 0)
    };
    let counts = Box::pin(await_condition(boards, NAME, counted));
    timeout(LIMIT, counts).await.expect("a check is in no count").unwrap();
    operator.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn one_that_no_other_system_has_is_deleted_at_once() {
    let world = World::new().await;
    let operator = world.operator().await;
    world.submit("first").await;
    world.has_job("first").await;
    world.submit("second").await;
    world.shows("second", Reason::WaitingForSlot, 1).await;
    let client = server().await.client();
    let submissions: Api<Submission> = Api::namespaced(client.clone(), &world.namespace);
    let jobs: Api<Job> = Api::namespaced(client, &world.namespace);

    let uid = submissions.get("first").await.unwrap().uid().unwrap();
    let deleted = submissions.delete("first", &DeleteParams::default()).await.unwrap();
    assert!(deleted.is_right(), "no finalizer holds it: {deleted:?}");
    // The Job goes with it.
    let job = jobs.get("first-1").await.unwrap();
    assert_eq!(job.owner_references()[0].uid, uid);
    assert_eq!(job.spec.unwrap().ttl_seconds_after_finished, Some(604_800));
    world.has_job("second").await;
    operator.end().await;
}
