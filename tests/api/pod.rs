//! The programs in the Pod against a stand-in for AWS: the objects that they store and restore, and their reports. In some tests S3 is
//! away, or another Pod has taken over.

mod archives;
mod checksums;
mod cloudwatch;
mod endpoints;
mod evaluators;
mod hostile;
mod input;
mod limits;
mod measure;
mod preparing;
mod restarted;
mod role;
mod shelf;
mod sidecar;
mod uploads;

use std::collections::BTreeMap;
use std::fs::{self, File, OpenOptions};
use std::future::Future;
use std::io::Write;
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use tokio::sync::oneshot;
use tokio::task::JoinHandle;

use crate::support::files::until_there;
use crate::support::ministack::{self, server};
use leaderboard_api::names::FAILURE_LOG_KEY;
use leaderboard_api::{Attempt, CarlaPlan, PlannedEvaluation, StorageClass};
use leaderboard_aws::archive::{Archive, Cause, Fetched, Kept};
use leaderboard_aws::clients::Aws;
use leaderboard_aws::logs::LogClient;
use leaderboard_contract::report::{MAX_BYTES, OWNER_KEY, Owner, REPORT_KEY, Report};
use leaderboard_contract::run::{Run, STATUS_FOLDER, Stop};
use leaderboard_contract::verdict::{WorkspaceReason, WorkspaceVerdict};
use leaderboard_evaluation::Object;
use leaderboard_evaluation::fixtures::{self, checkpoint};
use leaderboard_evaluation::judge::Pace;
use leaderboard_evidence::Tree;
use leaderboard_pod::logcopy::{self, LogcopyError};
use leaderboard_pod::places::{Places, Setting};
use leaderboard_pod::upload::Haste;
use leaderboard_pod::upload::quota::{LEAST, Quota};
use leaderboard_pod::upload::send::{Sent, Uploader, Window};
use leaderboard_pod::upload::wanted::Wanted;
use leaderboard_pod::workspace::{self, WorkspaceError};
use leaderboard_pod::{identity, ship};
use leaderboard_protocol::files::{Host, Mark, Member, Pair, Side, StatusFile};

const LIMIT: u64 = 1 << 30;
const MIB: usize = 1 << 20;
const PATIENCE: Duration = Duration::from_mins(2);
const SIMULATOR: Side = Side::Host(Host::Simulator);

/// A Pod's volumes in a temporary folder, and its prefix in a bucket of its own.
struct Pod {
    folder: tempfile::TempDir,
    setting: Setting,
    archive: Archive,
    aws: Aws,
}

impl Pod {
    async fn new() -> Self {
        let bucket = server().await.bucket().await;
        Self::on(&server().await.endpoint(), &bucket, run(&bucket)).await
    }

    async fn on(endpoint: &str, bucket: &str, run: Run) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        for name in ["logs", "tools", "podinfo"] {
            fs::create_dir(at(name)).unwrap();
        }
        fs::write(at("runner"), "#!runner").unwrap();
        fs::write(at("podinfo/stop"), "").unwrap();
        let aws = ministack::aws(endpoint).await;
        Self {
            archive: Archive::new(aws.s3(None, Some(endpoint)), bucket, "runs/77/"),
            aws,
            setting: Setting {
                run,
                pod_uid: "pod-1".to_owned(),
                api_server: None,
                role_arn: None,
                places: Places {
                    logs: at("logs"),
                    tools: at("tools"),
                    runner: at("runner"),
                    root: folder.path().to_owned(),
                    podinfo: at("podinfo"),
                    token: at("token"),
                    termination_log: at("termination-log"),
                },
                pace: Pace {
                    settle: Duration::from_secs(1),
                    quiet: Duration::from_secs(1),
                    grace: Duration::from_secs(5),
                    least: Duration::from_millis(100),
                    backoff: Duration::from_millis(500),
                    logs: Duration::from_secs(10),
                    in_air: Duration::from_mins(1),
                    enforced_within: Duration::from_secs(2),
                },
            },
            folder,
        }
    }

    /// The Pod that replaces this one, with the same prefix.
    async fn replaced(&self, uid: &str) -> Self {
        let bucket = &self.setting.run.plan.storage.s3.bucket;
        let mut next = Self::on(&server().await.endpoint(), bucket, self.setting.run.clone()).await;
        uid.clone_into(&mut next.setting.pod_uid);
        next
    }

    fn logs(&self) -> &Path {
        &self.setting.places.logs
    }

    fn path(&self, relative: &str) -> PathBuf {
        self.logs().join(relative)
    }

    fn put(&self, relative: &str, bytes: &[u8]) {
        let path = self.path(relative);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, bytes).unwrap();
    }

    fn append(&self, relative: &str, bytes: &[u8]) {
        fs::create_dir_all(self.path(relative).parent().unwrap()).unwrap();
        let file = OpenOptions::new().append(true).create(true).open(self.path(relative));
        file.unwrap().write_all(bytes).unwrap();
    }

    /// Writes the checkpoint of a pair's agent.
    fn checkpoint(&self, pair: u32, done: u32) {
        let text = checkpoint((pair - 1) * 2, done, 2);
        self.put(&format!("agent/agent{pair}/agent_results.json"), text.as_bytes());
    }

    fn mark(&self, side: Side, pair: u16, mark: Mark) {
        let pair = Pair::new(pair).unwrap();
        let root = self.path(STATUS_FOLDER);
        StatusFile::Of(Member { side, pair }, mark).create(&root).unwrap();
    }

    fn has(&self, file: StatusFile) -> bool {
        file.exists(&self.path(STATUS_FOLDER))
    }

    async fn until_has(&self, file: StatusFile) {
        let path = file.path(&self.path(STATUS_FOLDER));
        let there = tokio::time::timeout(PATIENCE, until_there(&path)).await;
        there.unwrap_or_else(|_| panic!("no {}", path.display()));
    }

    async fn stored(&self, key: &str) -> Option<Vec<u8>> {
        self.archive.get(key, LIMIT).await.unwrap().map(|object| object.bytes)
    }

    /// UID of the Pod whose writes count.
    async fn owner(&self) -> String {
        Owner::parse(&self.stored(OWNER_KEY).await.unwrap()).unwrap().owner
    }

    async fn report(&self) -> Option<Report> {
        let bytes = self.archive.get(REPORT_KEY, MAX_BYTES as u64).await.ok()??.bytes;
        Some(Report::parse(&bytes).unwrap())
    }

    async fn keys(&self) -> Vec<String> {
        let listing = self.archive.list("", 1000).await.unwrap();
        listing.objects.into_iter().map(|object| object.key).collect()
    }

    async fn prepare(&self) -> Result<(), WorkspaceError> {
        workspace::prepare(&self.setting, &self.archive).await
    }

    fn uploader(&self) -> Uploader {
        let tree = Arc::new(Tree::open(self.logs()).unwrap());
        Uploader::new(self.archive.clone(), tree, Quota::new(LIMIT, 2, Host::Simulator))
    }

    /// Starts logcopy.
    fn logcopy(&self) -> Logcopy {
        let (end, ended) = oneshot::channel::<()>();
        let (setting, aws, archive) = (self.setting.clone(), self.aws.clone(), self.archive.clone());
        let shutdown = async {
            let _ = ended.await;
        };
        let task = tokio::spawn(async move { logcopy::work(setting, &aws, archive, shutdown).await });
        Logcopy { end, task }
    }

    /// Waits for a report of which this holds.
    async fn reported(&self, what: impl Fn(&Report) -> bool) -> Report {
        let seen = until(|| async { self.report().await.filter(|report| what(report)) });
        seen.await
    }
}

struct Logcopy {
    end: oneshot::Sender<()>,
    task: JoinHandle<Result<(), LogcopyError>>,
}

impl Logcopy {
    /// SIGTERM.
    async fn end(self) {
        let _ = self.end.send(());
        tokio::time::timeout(PATIENCE, self.task)
            .await
            .unwrap()
            .unwrap()
            .unwrap();
    }

    /// SIGKILL.
    async fn kill(self) {
        self.task.abort();
        assert!(self.task.await.is_err());
    }
}

/// Asks until there is an answer. For what is in S3, which reports no changes.
async fn until<T, F: Future<Output = Option<T>>>(ask: impl Fn() -> F) -> T {
    let asking = async {
        loop {
            if let Some(answer) = ask().await {
                return answer;
            }
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    };
    tokio::time::timeout(PATIENCE, asking)
        .await
        .expect("it never came to be")
}

/// Two pairs of two routes each, in a bucket of the stand-in.
fn run(bucket: &str) -> Run {
    let mut run = fixtures::run();
    let s3 = &mut run.plan.storage.s3;
    bucket.clone_into(&mut s3.bucket);
    s3.prefix = Some("runs/".to_owned());
    s3.size_limit = LIMIT.to_string().parse().unwrap();
    run
}

/// The plan of CARLA's evaluation.
fn carla(run: &mut Run) -> &mut CarlaPlan {
    match &mut run.plan.evaluation {
        PlannedEvaluation::Carla(carla) => carla,
        PlannedEvaluation::Container(_) => panic!("it is not CARLA's"),
    }
}

/// Text that compresses to nothing and repeats nowhere.
fn noise(len: usize, seed: u64) -> Vec<u8> {
    let mut random = fastrand::Rng::with_seed(seed);
    (0..len).map(|_| random.u8(b' '..b'~')).collect()
}
