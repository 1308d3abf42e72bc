//! After a disaster: all Submissions and Leaderboards of a namespace come back from a backup under other UIDs, with their statuses or
//! without. A real API server and stand-ins of S3, DynamoDB and EvalAI know the rest.
#![cfg(test)]

mod newer;

use std::collections::BTreeMap;
use std::time::Duration;

use k8s_openapi::api::batch::v1::Job;
use k8s_openapi::api::core::v1::Pod;
use k8s_openapi::api::networking::v1::NetworkPolicy;
use kube::api::{DeleteParams, ListParams, Patch, PatchParams, PostParams};
use kube::core::NamespaceResourceScope;
use kube::{Resource, ResourceExt};
use leaderboard_api::{Attempt, JobNumber, Leaderboard, Reason, State, Submission, SubmissionStatus, names};
use leaderboard_aws::archive::Archive;
use leaderboard_contract::report::REPORT_KEY;
use serde::de::DeserializeOwned;
use serde_json::{Value, json};

use super::boards::make_table;
use super::world::{World, is_settled};
use crate::support::apiserver::server;
use crate::support::player::{self, ROUTES};

/// Routes that what still runs has done.
const DONE: u32 = 12;

/// The submissions before the disaster, by their state.
struct Season {
    world: World,
    table: String,
    finished: (u64, String),
    failed: (u64, String),
    cancelled: (u64, String),
    /// It runs.
    running: (u64, String),
    /// It has ended, and the controller has not read that.
    unread: (u64, String),
    /// It waits for its turn.
    pending: (u64, String),
}

const LOCAL_FINISHED: &str = "local-finished";
const LOCAL_RUNNING: &str = "local-running";

impl Season {
    async fn play() -> Self {
        let world = World::new().await;
        let table = world.aws.name("restored-rows");
        make_table(&world.aws, &table).await;
        let spec = json!({"evaluation": {"carla": {"routes": ROUTES}}, "table": {"dynamoDB": {"name": table, "endpoint": world.aws.endpoint}}});
        world.leaderboard_with("lb", 1, "Hosts", &spec).await;
        world
            .leaderboard_with("held", 2, "Hosts", &json!({"paused": true}))
            .await;
        let local = json!({
            "evalai": null, "evaluation": {"carla": {"routes": ROUTES}}, "tracks": [{"name": "sensors"}],
        });
        world.leaderboard_with("local", 1, "Hosts", &local).await;
        let controller = world.controller();
        let finished = world.submit("lb", 1).await;
        local_submission(&world, LOCAL_FINISHED).await;
        finish(&world, [finished.1.as_str(), LOCAL_FINISHED]).await;
        let (failed, cancelled) = (world.submit("lb", 1).await, world.submit("held", 2).await);
        world.run_that_crashes(failed.0, &failed.1).await;
        let cancel = Patch::Merge(json!({"spec": {"cancel": true}}));
        let submissions = world.api::<Submission>();
        submissions
            .patch(&cancelled.1, &PatchParams::default(), &cancel)
            .await
            .unwrap();
        for name in [&failed.1, &cancelled.1] {
            world
                .until(name, &format!("{name} has its end everywhere"), is_settled)
                .await;
        }
        let (running, unread) = (world.submit("lb", 1).await, world.submit("lb", 1).await);
        local_submission(&world, LOCAL_RUNNING).await;
        for (run, name) in [
            (running.0.to_string(), running.1.as_str()),
            (unread.0.to_string(), unread.1.as_str()),
            (LOCAL_RUNNING.to_owned(), LOCAL_RUNNING),
        ] {
            begin(&world, &run, name).await;
        }
        let pending = world.submit("held", 2).await;
        let is_held = |status: &SubmissionStatus| status.shows(Reason::Paused);
        world.until(&pending.1, "it is held", is_held).await;
        drop(controller);
        until_released(&world).await;
        // The Pod ends while no controller runs.
        report(&world, &unread.0.to_string(), &unread.1, ROUTES).await;
        Self {
            world,
            table,
            finished,
            failed,
            cancelled,
            running,
            unread,
            pending,
        }
    }

    /// All that other systems know, as text.
    async fn outside(&self, pk: u64) -> (String, Vec<String>) {
        let rows = self.rows().await;
        let row = rows.get(&pk.to_string()).cloned().unwrap_or_default();
        (row, self.written(pk))
    }

    async fn rows(&self) -> BTreeMap<String, String> {
        let client = self.world.aws.aws.dynamodb(None, Some(&self.world.aws.endpoint));
        let items = client
            .scan()
            .table_name(&self.table)
            .send()
            .await
            .unwrap()
            .items
            .unwrap();
        let text =
            |item: std::collections::HashMap<_, _>| format!("{:?}", item.into_iter().collect::<BTreeMap<_, _>>());
        let id = |item: &std::collections::HashMap<String, aws_sdk_dynamodb::types::AttributeValue>| {
            item["submission_id"].as_s().unwrap().clone()
        };
        items.into_iter().map(|item| (id(&item), text(item))).collect()
    }

    /// Requests that have changed a submission in EvalAI.
    fn written(&self, pk: u64) -> Vec<String> {
        let all = self
            .world
            .evalai
            .requests()
            .into_iter()
            .filter(|entry| entry.method != "GET");
        let texts = all.map(|entry| format!("{} {} {}", entry.method, entry.path, entry.body));
        let of = [format!("\"submission\":\"{pk}\""), format!("\"submission\":{pk},")];
        texts
            .filter(|text| of.iter().any(|id| text.contains(id.as_str())))
            .collect()
    }

    async fn status(&self, name: &str) -> SubmissionStatus {
        let found = self.world.api::<Submission>().get(name).await.unwrap();
        found.status.unwrap_or_default()
    }

    async fn jobs(&self) -> Vec<String> {
        let all = self.world.api::<Job>().list(&ListParams::default()).await.unwrap();
        all.items.iter().map(ResourceExt::name_any).collect()
    }
}

async fn local_submission(world: &World, name: &str) {
    let spec = json!({"leaderboardName": "local", "track": "sensors", "image": "r/agent:1", "team": {"id": "7"}});
    let submission = Submission::new(name, serde_json::from_value(spec).unwrap());
    world.api().create(&PostParams::default(), &submission).await.unwrap();
}

/// Plays both runs to a good end.
async fn finish(world: &World, names: [&str; 2]) {
    let player = world.play(Duration::from_millis(500));
    let runs = |status: &SubmissionStatus| status.progress.as_ref().is_some_and(|progress| progress.done > 0);
    for name in names {
        world.until(name, "a route is done", runs).await;
    }
    player.fall_the_curtain();
    for name in names {
        world
            .until(name, &format!("{name} has its end everywhere"), is_settled)
            .await;
    }
}

/// A Pod runs and has stored some routes.
async fn begin(world: &World, run: &str, name: &str) {
    let job = world.job(name, 0).await;
    world.cluster().running_pod(&job).await;
    report(world, run, name, DONE).await;
    let is_read = |status: &SubmissionStatus| status.progress.as_ref().is_some_and(|p| p.done == 12);
    world.until(name, "its report is read", is_read).await;
}

/// Stores the report of a run as logcopy does; the last one if `done` is all routes.
async fn report(world: &World, run: &str, name: &str, done: u32) {
    let uid = world.api::<Submission>().get(name).await.unwrap().uid().unwrap();
    let job = names::job(name, JobNumber::first(Attempt(1)));
    let pod = world.api::<Pod>().get(&job).await.unwrap().uid().unwrap();
    let report = player::report(uid, pod, done);
    let s3 = world.aws.aws.s3(None, Some(&world.aws.endpoint));
    let archive = Archive::new(s3, &world.bucket, format!("{run}/"));
    archive
        .put(REPORT_KEY, serde_json::to_vec(&report).unwrap())
        .await
        .unwrap();
}

async fn until_released(world: &World) {
    use k8s_openapi::api::coordination::v1::Lease;
    let is_free = |lease: Option<&Lease>| {
        lease.is_some_and(|lease| lease.spec.as_ref().is_some_and(|spec| spec.holder_identity.is_none()))
    };
    let seen = kube::runtime::wait::await_condition(world.api::<Lease>(), "operator", is_free);
    tokio::time::timeout(super::bridge::LIMIT, seen)
        .await
        .expect("the Lease is released")
        .unwrap();
}

/// Runs a person's commands.
async fn shell(world: &World, commands: &str) {
    let kubectl = server().await.kubectl();
    let folder = std::path::Path::new(kubectl.get_program()).parent().unwrap().to_owned();
    let path = format!("{}:{}", folder.display(), std::env::var("PATH").unwrap());
    let mut bash = std::process::Command::new("bash");
    bash.args(["-euo", "pipefail", "-c", commands])
        .env("PATH", path)
        .env("KUBECONFIG", server().await.kubeconfig())
        .env("NS", &world.namespace);
    let done = bash.output().unwrap();
    assert!(
        done.status.success(),
        "{commands}: {}",
        String::from_utf8_lossy(&done.stderr)
    );
}

/// Removes all objects of a kind at once; no finalizer does its work.
async fn lose<K>(world: &World)
where
    K: Resource<Scope = NamespaceResourceScope, DynamicType = ()> + Clone + std::fmt::Debug + DeserializeOwned,
{
    let api = world.api::<K>();
    for object in api.list(&ListParams::default()).await.unwrap().items {
        let name = object.meta().name.clone().unwrap();
        let now = DeleteParams::default().grace_period(0);
        api.delete(&name, &now).await.unwrap();
        let bare = Patch::Merge(json!({"metadata": {"finalizers": null}}));
        let freed = api.patch(&name, &PatchParams::default(), &bare).await;
        assert!(
            freed.is_ok()
                || freed.is_err_and(|error| matches!(error, kube::Error::Api(status) if status.is_not_found()))
        );
    }
    assert_eq!(api.list(&ListParams::default()).await.unwrap().items.len(), 0);
}

async fn lose_all(world: &World) {
    lose::<Submission>(world).await;
    lose::<Leaderboard>(world).await;
    lose::<Job>(world).await;
    lose::<Pod>(world).await;
    lose::<NetworkPolicy>(world).await;
}

/// The commands of docs/availability.md that make the objects of a file anew; `$BACKUP` is that file.
const CREATE: &str = r"sed -E '/^    (resourceVersion|uid): /d' $BACKUP > $BACKUP.new
kubectl --namespace $NS create --filename $BACKUP.new";
/// The command that gives them their statuses.
const STATUSES: &str = "kubectl --namespace $NS apply --server-side --force-conflicts --subresource=status \
                        --field-manager=leaderboard-operator/status --filename $BACKUP.new";
/// The command of a tool that writes statuses under a name of its own.
const STATUSES_OF_A_TOOL: &str = "kubectl --namespace $NS replace --subresource=status --filename $BACKUP.new";
/// The commands after such a tool.
const HAND_OVER: &str = r#"kubectl --namespace $NS get submissions --output json --show-managed-fields \
    | jq '.items[].metadata.managedFields |= map(if .subresource == "status" then .manager = "leaderboard-operator/status" | .operation = "Apply" else . end)' \
    | kubectl replace --filename -"#;

/// A file of the backup, and the shell's words for it.
struct Backup(tempfile::TempDir);

impl Backup {
    /// Keeps these kinds or objects.
    async fn of(world: &World, what: &str) -> Self {
        let backup = Self(tempfile::tempdir().unwrap());
        backup
            .run(
                world,
                &format!("kubectl --namespace $NS get {what} --output yaml > $BACKUP"),
            )
            .await;
        backup
    }

    async fn run(&self, world: &World, commands: &str) {
        let file = self.0.path().join("backup.yaml");
        shell(world, &format!("BACKUP={}\n{commands}", file.display())).await;
    }
}

/// The status, but for the number of the spec that it speaks of: that of an object that is made anew begins at one.
fn of_any_generation(mut status: SubmissionStatus) -> SubmissionStatus {
    status.observed_generation = None;
    for condition in &mut status.conditions {
        condition.observed_generation = None;
    }
    status
}

/// Writes to EvalAI that are no GET, since so many before, which end the submission there.
fn ends_since(season: &Season, pk: u64, before: usize) -> usize {
    let since = season.written(pk).split_off(before);
    let ends = ["finished", "failed", "cancelled"];
    let is_end = |text: &&String| ends.iter().any(|end| text.to_lowercase().contains(end));
    since.iter().filter(is_end).count()
}

/// The objects and other systems right before the objects are lost.
struct Before {
    /// Statuses of submissions that are over, by name.
    statuses: Vec<(String, SubmissionStatus)>,
    /// Rows of submissions that are over in EvalAI, and the writes to EvalAI about them, by key.
    outside: Vec<(u64, (String, Vec<String>))>,
    /// Number of writes to EvalAI about the submission with an unread end.
    unread: usize,
}

impl Season {
    async fn before(&self) -> Before {
        let over = [&self.finished.1, &self.failed.1, &self.cancelled.1, LOCAL_FINISHED];
        let mut before = Before {
            statuses: Vec::new(),
            outside: Vec::new(),
            unread: self.written(self.unread.0).len(),
        };
        for name in over {
            let status = of_any_generation(self.status(name).await);
            before.statuses.push((name.to_owned(), status));
        }
        for pk in [self.finished.0, self.failed.0, self.cancelled.0] {
            before.outside.push((pk, self.outside(pk).await));
        }
        before
    }

    /// A run that was under way has a Job again, with the progress of before.
    async fn assert_goes_on(&self, name: &str) {
        self.world.job(name, 0).await;
        // Times of the lost Job are no longer shown: all fields are this operator's.
        let is_renewed = |status: &SubmissionStatus| status.recreated == 1 && status.times.scheduled.is_none();
        self.world.until(name, "its Job is made again", is_renewed).await;
        let status = self.status(name).await;
        assert_eq!(status.progress.unwrap().text, format!("{DONE}/{ROUTES}"));
        let uid = self.world.api::<Submission>().get(name).await.unwrap().uid();
        assert_ne!(
            status.plan.unwrap().submission_uid,
            uid,
            "its reports name the UID of before"
        );
    }

    /// Fails unless all that was over is unchanged in all systems, and only unfinished submissions run.
    async fn assert_rest_is_as(&self, before: Before) {
        for (name, before) in before.statuses {
            assert_eq!(of_any_generation(self.status(&name).await), before, "{name}");
        }
        for (pk, before) in before.outside {
            let now = self.outside(pk).await;
            assert_eq!(now, before, "{pk} is as it was in table and EvalAI");
        }
        let mut jobs = self.jobs().await;
        jobs.sort();
        let expected = [format!("{LOCAL_RUNNING}-1"), format!("{}-1", self.running.1)];
        assert_eq!(jobs, expected, "nothing else runs");
        assert_eq!(ends_since(self, self.unread.0, before.unread), 1);
        assert!(self.rows().await[&self.unread.0.to_string()].contains("FINISHED"));
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_a_backup_brings_back_with_its_status_goes_on_as_it_was() {
    let season = Box::pin(Season::play()).await;
    let world = &season.world;
    let boards = Backup::of(world, "leaderboards").await;
    let locals = Backup::of(world, &format!("submissions {LOCAL_FINISHED} {LOCAL_RUNNING}")).await;
    let of_evalai = [
        &season.finished,
        &season.failed,
        &season.cancelled,
        &season.running,
        &season.unread,
        &season.pending,
    ];
    let names = of_evalai.map(|(_, name)| name.as_str()).join(" ");
    let others = Backup::of(world, &format!("submissions {names}")).await;
    assert!(season.status(&season.running.1).await.times.scheduled.is_some());
    let before = season.before().await;
    lose_all(world).await;

    boards.run(world, CREATE).await;
    // One half as docs/availability.md restores a file, the other half as a tool such as Velero does.
    others.run(world, CREATE).await;
    others.run(world, STATUSES).await;
    locals.run(world, CREATE).await;
    locals.run(world, STATUSES_OF_A_TOOL).await;
    locals.run(world, HAND_OVER).await;
    let _controller = world.controller();
    for name in [season.running.1.as_str(), LOCAL_RUNNING] {
        season.assert_goes_on(name).await;
    }
    let is_read = |status: &SubmissionStatus| status.state == Some(State::Finished) && is_settled(status);
    world.until(&season.unread.1, "its end is read", is_read).await;
    let is_held = |status: &SubmissionStatus| status.shows(Reason::Paused);
    world.until(&season.pending.1, "it is held again", is_held).await;
    season.assert_rest_is_as(before).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_a_backup_brings_back_without_a_status_is_neither_run_nor_published_again() {
    let season = Box::pin(Season::play()).await;
    let world = &season.world;
    let all = Backup::of(world, "leaderboards,submissions").await;
    lose_all(world).await;
    let ended = [&season.finished, &season.failed, &season.cancelled];
    let mut before = Vec::new();
    for (pk, _) in ended {
        before.push(season.outside(*pk).await);
    }
    let live = [&season.running, &season.unread];
    let written = live.map(|(pk, _)| season.written(*pk).len());

    all.run(world, CREATE).await;
    let _controller = world.controller();
    // EvalAI shows the end of each that had ended; the spec of the cancelled one says so too.
    for ((pk, name), before) in ended.into_iter().zip(before) {
        let is_ended = |status: &SubmissionStatus| status.state == Some(State::Cancelled) && is_settled(status);
        world.until(name, "EvalAI has its end", is_ended).await;
        assert_eq!(
            season.outside(*pk).await,
            before,
            "{pk} is as it was in table and EvalAI"
        );
    }
    // The results of all others are under the UID of before: nothing is run over them.
    for name in [
        season.running.1.as_str(),
        &season.unread.1,
        LOCAL_FINISHED,
        LOCAL_RUNNING,
    ] {
        world.finds_its_prefix_in_use(name).await;
    }
    assert_eq!(season.jobs().await, [""; 0]);
    for ((pk, _), before) in live.into_iter().zip(written) {
        assert_eq!(ends_since(&season, *pk, before), 0);
    }
    // A person hands one over.
    let command =
        format!("kubectl --namespace $NS annotate submission {LOCAL_RUNNING} leaderboard.carla.org/adopt=true");
    shell(world, &command).await;
    world.job(LOCAL_RUNNING, 0).await;
    assert!(season.status(LOCAL_RUNNING).await.plan.unwrap().resume);
}
