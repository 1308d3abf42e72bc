//! The sidecar that stores a run while it runs: merges the workers' results, stores what changed, and reports.
//!
//! Called by `leaderboard-operator logcopy`. Knows S3, CloudWatch and the Pod's volumes. It never ends by itself, since the
//! kubelet would start it again: after its work it waits for SIGTERM. Results are safe before `logcopy.done` is written,
//! and the host's containers hold the Pod until then.

pub(super) mod describe;
mod round;

use std::future::Future;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::sync::watch;
use tokio::task::JoinHandle;

use super::blocking;
use super::identity;
use super::places::{Places, Setting};
use super::ship::{STREAM_A_DAY, Shipper};
use super::upload::quota::Quota;
use super::upload::send::Uploader;
use super::watch::Watch;
use leaderboard_aws::archive::{Archive, ArchiveError};
use leaderboard_aws::clients::Aws;
use leaderboard_aws::logs::LogClient;
use leaderboard_base::shutdown;
use leaderboard_base::tasks::{TaskFailed, Tasks};
use leaderboard_contract::report::Logs;
use leaderboard_contract::run::Stop;
use leaderboard_evaluation::{Refused, of_plan};
use leaderboard_evidence::{Tree, TreeError};
use leaderboard_protocol::files::StatusFile;
use round::{News, Rounds, Why};

/// Longest last flush after SIGTERM; the Pod's grace is 600 s and the containers had their part of it.
const LAST_FLUSH: Duration = Duration::from_mins(5);
/// Time for a round under way to land after SIGTERM. A request that is dropped may still be served, and then replace the newer
/// log that the last flush has stored meanwhile.
const LANDING: Duration = Duration::from_secs(3);
/// How often the stop file is read where inotify reports nothing.
const STOP_POLL: Duration = Duration::from_secs(2);
/// Time between two rounds over the logs for CloudWatch.
const SHIP_PERIOD: Duration = Duration::from_secs(5);

/// Errors that logcopy can't work with.
#[derive(thiserror::Error, Debug)]
pub enum LogcopyError {
    /// The plan does not hold; `workspace` has refused it before.
    #[error(transparent)]
    Plan(#[from] Refused),
    /// The volume.
    #[error("the logs volume can't be used: {0}. Look at the node's disk and the Pod's volumes.")]
    Volume(#[from] TreeError),
    /// S3, in a round.
    #[error(transparent)]
    Storage(#[from] ArchiveError),
    /// Without one of its tasks it would miss a stop, or lines.
    #[error(transparent)]
    Task(#[from] TaskFailed),
}

impl From<std::io::Error> for LogcopyError {
    fn from(error: std::io::Error) -> Self {
        Self::Volume(error.into())
    }
}

/// Works until `shutdown` (SIGTERM) comes.
pub async fn main(setting: Setting, shutdown: impl Future<Output = ()>) -> Result<(), LogcopyError> {
    let aws = identity::aws(&setting, "logcopy").await;
    let plan = &setting.run.plan;
    let archive = Archive::of_run(&aws, &plan.storage.s3, &plan.run_id);
    work(setting, &aws, archive, shutdown).await
}

/// This work with ready clients.
pub async fn work(
    setting: Setting,
    aws: &Aws,
    archive: Archive,
    shutdown: impl Future<Output = ()>,
) -> Result<(), LogcopyError> {
    let tree = Arc::new(Tree::open(&setting.places.logs)?);
    let plan = &setting.run.plan;
    let kind = of_plan(plan);
    let results = kind.results(&setting.run, Arc::clone(&tree))?;
    let quota = Quota::new(plan.storage.s3.size_limit.bytes(), plan.workers(), kind.host());
    let uploader = Uploader::new(archive.clone(), Arc::clone(&tree), quota);

    let (end, ending) = shutdown::Stop::new();
    let tasks = Tasks::new(ending);
    let (told, logs) = watch::channel(None);
    let (shipped, shipping) = ship(&setting, aws, &tree, &uploader, (&tasks, told));
    let (stop, stop_watch) = watch_stop(setting.places.clone(), &tasks);
    let rounds = Rounds::new(setting, archive, tree, results, uploader, News { stop, logs });
    let result = tokio::select! {
        biased;
        failed = tasks.failed() => Err(failed.into()),
        result = keep_going(rounds, shutdown) => result,
    };

    end.send_replace(true);
    stop_watch.abort();
    // The task has its own bound on its last round; nothing to do about one that fails.
    let _ = shipped.send(true);
    if let Some(shipping) = shipping {
        let _ = shipping.await;
    }
    result
}

/// Starts the task for CloudWatch, if the run has a log group.
fn ship(
    setting: &Setting,
    aws: &Aws,
    tree: &Arc<Tree>,
    uploader: &Uploader,
    (tasks, told): (&Tasks, watch::Sender<Option<Logs>>),
) -> (watch::Sender<bool>, Option<JoinHandle<Option<()>>>) {
    let (sender, receiver) = watch::channel(false);
    let task = setting.run.log_group().map(|group| {
        let plan = &setting.run.plan;
        let client = LogClient::of_group(aws, group);
        let workers = (plan.workers(), of_plan(plan).host());
        let memory = uploader.memory();
        let shipper = Shipper::new(client, Arc::clone(tree), &plan.run_id, workers, memory, STREAM_A_DAY);
        tasks.stay("logs to CloudWatch", shipper.run(SHIP_PERIOD, receiver, told))
    });
    (sender, task)
}

/// Obeys the stop annotation at once, whatever a round is waiting for: a task reads the downward API's file, writes
/// `simulation.cancel`, and notifies the rounds.
fn watch_stop(places: Places, tasks: &Tasks) -> (watch::Receiver<Option<Stop>>, JoinHandle<Option<()>>) {
    let (sender, receiver) = watch::channel(None);
    let task = tasks.stay("watch of the stop annotation", async move {
        let folder = Watch::new(|_| true).ok();
        let status = places.status();
        let mut obeyed = false;
        loop {
            // A watch on the file itself would die with the first change: the kubelet swaps the folder `..data`.
            let watched = folder.as_ref().filter(|watch| watch.add(&places.podinfo));
            let text = tokio::fs::read_to_string(places.stop()).await.unwrap_or_default();
            if let Some(stop) = Stop::parse(&text) {
                // The rounds first: the volume may be what hangs.
                sender.send_if_modified(|known| known.replace(stop) != Some(stop));
                if !obeyed {
                    tracing::info!(reason = stop.as_str(), "asked to stop");
                    obeyed = create(StatusFile::Cancel, &status).await;
                }
            }
            let wake = async {
                match watched {
                    Some(watch) => watch.changed().await,
                    None => std::future::pending().await,
                }
            };
            // Either is a reason to read it again.
            let _ = tokio::time::timeout(STOP_POLL, wake).await;
        }
    });
    (receiver, task)
}

/// Creates one of logcopy's own status files, for which the other containers wait. Returns whether it is there.
async fn create(file: StatusFile, status: &Path) -> bool {
    let folder = status.to_owned();
    let created = blocking(move || file.create(&folder)).await;
    if let Err(error) = &created {
        tracing::error!("{} can't be written: {error}", file.name());
    }
    created.is_ok()
}

/// Rounds until SIGTERM, then what is left.
async fn keep_going(mut rounds: Rounds, shutdown: impl Future<Output = ()>) -> Result<(), LogcopyError> {
    tokio::pin!(shutdown);
    let mut failures: u32 = 0;
    loop {
        let Some(outcome) = unless_stopped(rounds.round(Why::Period), &mut shutdown).await else {
            break;
        };
        let pause = match outcome {
            Ok(pause) => {
                if failures > 0 {
                    tracing::info!("storing works again");
                }
                failures = 0;
                pause
            }
            Err(error) => {
                failures = failures.saturating_add(1);
                if failures.is_power_of_two() {
                    tracing::warn!(failures, "{error}");
                }
                rounds.after_failures(failures)
            }
        };
        tokio::select! {
            biased;
            () = &mut shutdown => break,
            () = rounds.wake(pause) => {}
        }
    }
    tracing::info!("asked to end; storing what is left");
    let longest = LAST_FLUSH.min(rounds.flush());
    last_flush(&mut rounds, longest).await;
    Ok(())
}

/// A round's outcome; `None` after SIGTERM, when the round has landed or its time to land is over.
async fn unless_stopped<T>(round: impl Future<Output = T>, shutdown: impl Future<Output = ()>) -> Option<T> {
    tokio::pin!(round);
    tokio::select! {
        biased;
        () = shutdown => {
            // Whatever it comes to, the last flush reads everything once more.
            let _ = tokio::time::timeout(LANDING, &mut round).await;
            None
        }
        outcome = &mut round => Some(outcome),
    }
}

/// Stores what is left, again and again while that fails: S3 may be back before the Pod's grace is over.
async fn last_flush(rounds: &mut Rounds, longest: Duration) {
    let began = Instant::now();
    let mut last = None;
    let flush = async {
        let mut failures: u32 = 0;
        while let Err(error) = rounds.round(Why::Shutdown).await {
            failures = failures.saturating_add(1);
            if failures.is_power_of_two() {
                tracing::warn!(failures, "the last changes are not stored yet: {error}");
            }
            last = Some(error);
            tokio::time::sleep(rounds.after_failures(failures)).await;
        }
    };
    let in_time = tokio::time::timeout(longest, flush).await.is_ok();
    match last {
        _ if in_time => tracing::info!(milliseconds = began.elapsed().as_millis(), "stored"),
        Some(error) => tracing::error!(seconds = longest.as_secs(), "the last changes are not stored: {error}"),
        None => tracing::error!(
            "the last changes are not stored: it took more than {} s",
            longest.as_secs()
        ),
    }
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::future::{pending, ready};
    use std::sync::mpsc;

    use aws_config::{BehaviorVersion, Region};
    use aws_credential_types::Credentials;
    use leaderboard_protocol::files::Host;

    use super::*;
    use crate::upload::Haste;
    use crate::upload::send::Window;
    use crate::upload::wanted::Wanted;

    /// Longer than a stop takes to be noticed, and still an end of a test that would hang.
    const PATIENCE: Duration = Duration::from_secs(20);

    async fn round_of(seconds: u64) -> u64 {
        tokio::time::sleep(Duration::from_secs(seconds)).await;
        seconds
    }

    #[tokio::test(start_paused = true)]
    async fn a_round_under_way_lands_before_the_last_flush() {
        let landed = std::cell::Cell::new(false);
        let round = async {
            round_of(2).await;
            landed.set(true);
        };
        assert_eq!(unless_stopped(round, ready(())).await, None);
        assert!(landed.get());
    }

    #[tokio::test(start_paused = true)]
    async fn a_round_that_hangs_takes_little_of_the_last_flush() {
        let began = tokio::time::Instant::now();
        assert_eq!(unless_stopped(round_of(3600), ready(())).await, None);
        assert_eq!(began.elapsed(), LANDING);
        assert_eq!(unless_stopped(round_of(3600), pending()).await, Some(3600));
    }
    async fn aws(endpoint: &str) -> Aws {
        let config = aws_config::defaults(BehaviorVersion::latest())
            .http_client(aws_smithy_http_client::Builder::new().build_http())
            .region(Region::new("us-east-1"))
            .credentials_provider(Credentials::new("test", "test", None, None, "tests"))
            .endpoint_url(endpoint)
            .load()
            .await;
        Aws::from_config(config)
    }

    #[tokio::test]
    async fn a_disk_that_hangs_does_not_hide_the_stop() {
        let folder = tempfile::tempdir().unwrap();
        let places = Places::below(folder.path());
        for made in [
            places.logs.join("agent/agent1"),
            places.status(),
            places.podinfo.clone(),
        ] {
            fs::create_dir_all(made).unwrap();
        }
        fs::write(places.logs.join("agent/agent1/log"), "a line\n").unwrap();
        let tree = Arc::new(Tree::open(&places.logs).unwrap());
        let stamp = tree.file("agent/agent1/log").unwrap().unwrap().1;
        // Nothing is stored here, only how the file is read is tested.
        let nowhere = "http://127.0.0.1:9";
        let s3 = aws(nowhere).await.s3(None, Some(nowhere));
        let mut uploader = Uploader::new(
            Archive::new(s3, "b", ""),
            Arc::clone(&tree),
            Quota::new(1 << 20, 1, Host::Simulator),
        );
        let (_end, ending) = shutdown::Stop::new();
        let tasks = Tasks::new(ending);
        let (mut stop, watching) = watch_stop(places.clone(), &tasks);

        let (hangs, disk_hangs) = mpsc::channel();
        let (seen, stop_seen) = mpsc::channel();
        let disk = std::thread::spawn(move || {
            let _held = tree.disk.lock().unwrap();
            hangs.send(()).unwrap();
            stop_seen.recv_timeout(PATIENCE).is_ok()
        });
        disk_hangs.recv().unwrap();
        let files = [Wanted::new("agent/agent1/log", stamp, Haste::Now)];
        let asked = async {
            fs::write(places.stop(), Stop::Cancel.as_str()).unwrap();
            stop.wait_for(Option::is_some).await.unwrap();
            let _ = seen.send(());
        };
        // One thread for all: a read that blocks it blocks the watch of the stop as well.
        let (_, ()) = tokio::join!(uploader.sync(&files, Window::default()), asked);
        assert!(
            disk.join().unwrap(),
            "the stop was noticed only when the disk answered again"
        );
        // Without the watch no stop would be noticed any more, so logcopy ends and starts anew.
        watching.abort();
        assert_eq!(tasks.failed().await.task, "watch of the stop annotation");
    }
}
