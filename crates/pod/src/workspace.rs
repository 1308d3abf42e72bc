//! The init container that prepares a Pod: the runner for all containers, the folders, the fence that makes this Pod the one
//! whose writes count, and what earlier Pods stored.
//!
//! Called by `leaderboard-operator workspace`. Knows S3 and the volumes. Everything it does may be done again: the kubelet
//! restarts it when it fails.

pub(crate) mod error;
mod input;
pub mod restore;
mod stored;

use std::collections::BTreeMap;
use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use super::identity;
use super::isolation::{self, Finding};
use super::logcopy::describe::describe;
use super::name_files;
use super::places::{Places, Setting};
use leaderboard_api::names::FAILURE_LOG_KEY;
use leaderboard_api::{Agents, Attempt, Enforcement};
use leaderboard_aws::archive::{Archive, ArchiveError, Listed, Object};
use leaderboard_contract::keys::{INPUT, SUBMISSION_FOLDER, host_folder};
use leaderboard_contract::report::{MAX_BYTES, OWNER_KEY, Owner, REPORT_KEY, Report};
use leaderboard_contract::run::{Run, STATUS_FOLDER};
use leaderboard_contract::verdict::{WorkspaceReason, WorkspaceVerdict};
use leaderboard_evaluation::{Results, of_plan};
use leaderboard_evidence::{Tree, TreeError};
use leaderboard_protocol::files::Pair;

pub use error::WorkspaceError;

/// Folders that no mount makes, beside those of the host's containers. The others are the kubelet's.
const FOLDERS: [&str; 4] = ["agent", STATUS_FOLDER, "logcopy", "contents"];
/// Names the Pod whose volume this is, once it is prepared.
const PREPARED: &str = "logcopy/.prepared";
/// Tries while S3 does not answer, before the kubelet is left to start this again.
const TRIES: u32 = 6;
/// Most objects below a prefix that may be the input of a run.
const INPUT_OBJECTS: usize = 10_001;

/// Verdict on the isolation of a Pod that goes on.
fn verdict_of(finding: &Finding) -> WorkspaceVerdict {
    let reason = match finding {
        Finding::Enforced(..) => WorkspaceReason::Enforced,
        Finding::Open(_) => WorkspaceReason::NotEnforced,
        Finding::Unmeasured(_) => WorkspaceReason::NotMeasured,
    };
    WorkspaceVerdict::new(reason, finding.to_string())
}

/// Prepares the Pod. A failure, and what was found of the Pod's isolation, are also written to the termination log.
pub async fn main(setting: Setting) -> Result<(), WorkspaceError> {
    let result = measure_and_prepare(&setting).await;
    let verdict = match &result {
        Ok(finding) => finding.as_ref().map(verdict_of),
        Err(error) => Some(error.verdict()),
    };
    if let Some(verdict) = verdict {
        setting.places.tell(&verdict);
    }
    result.map(|_| ())
}

async fn measure_and_prepare(setting: &Setting) -> Result<Option<Finding>, WorkspaceError> {
    let plan = &setting.run.plan;
    of_plan(plan).check(&setting.run)?;
    let finding = measure(setting).await?;
    let aws = identity::aws(setting, "workspace").await;
    prepare(setting, &Archive::of_run(&aws, &plan.storage.s3, &plan.run_id)).await?;
    Ok(finding)
}

/// Measures whether the Pod's NetworkPolicy is enforced; an error if the run may not go on as it is.
async fn measure(setting: &Setting) -> Result<Option<Finding>, WorkspaceError> {
    let Some(asked) = &setting.run.isolation else {
        return Ok(None);
    };
    let finding = isolation::find(asked, setting.api_server, setting.pace.enforced_within).await;
    tracing::info!("{finding}");
    if asked.enforcement == Enforcement::Require && !matches!(finding, Finding::Enforced(..)) {
        return Err(WorkspaceError::NotIsolated(finding));
    }
    Ok(Some(finding))
}

/// Does the work, again and again while S3 does not answer.
pub async fn prepare(setting: &Setting, archive: &Archive) -> Result<(), WorkspaceError> {
    of_plan(&setting.run.plan).check(&setting.run)?;
    copy_runner(&setting.places)?;
    name_files::copy(&setting.places)?;
    let tree = folders(setting)?;
    if is_prepared(&tree, &setting.pod_uid) {
        // The node was restarted under the Pod: the volume is newer than what is stored, and the fence may be another's.
        tracing::info!("this Pod's volume is prepared already");
        return Ok(());
    }
    let mut pause = Duration::from_secs(1);
    for _ in 1..TRIES {
        match take(setting, archive, &tree).await {
            Err(WorkspaceError::Storage(error)) if error.cause.is_transient() => tracing::warn!("{error}"),
            other => return other,
        }
        tokio::time::sleep(pause.min(setting.pace.backoff)).await;
        pause = pause.saturating_mul(2);
    }
    take(setting, archive, &tree).await
}

/// Takes the prefix for this Pod.
async fn take(setting: &Setting, archive: &Archive, tree: &Arc<Tree>) -> Result<(), WorkspaceError> {
    let run = &setting.run;
    let mut results = of_plan(&run.plan).results(run, Arc::clone(tree))?;
    let owner = Owner::new(setting.pod_uid.clone()).to_json();
    if let Some(of_nobody) = of_nobody(run, archive).await? {
        // Before the prefix has an owner: a Pod that goes on with it must not take them for this run's.
        stored::remove(archive, of_nobody).await?;
        // Names the prefix's owner before anything else is in it, so that a Pod that is lost early can be replaced.
        let report = first_report(run, &setting.pod_uid, &mut *results);
        let bytes = serde_json::to_vec(&report).unwrap_or_default();
        archive.put(REPORT_KEY, bytes).await?;
        archive.put(OWNER_KEY, owner).await?;
    } else {
        // The fence first: what a Pod before this one still stores, it stores before it next reads the fence, and what is
        // restored is then the last of it.
        archive.put(OWNER_KEY, owner).await?;
        restore::restore(results, run, archive, tree).await?;
    }
    input::submitted(run, archive, tree).await?;
    let noted = tree.write(PREPARED, setting.pod_uid.as_bytes());
    noted.map_err(|error| volume(PREPARED, error))
}

fn is_prepared(tree: &Tree, pod_uid: &str) -> bool {
    let noted = tree.read(PREPARED, 1024).ok().flatten();
    noted.is_some_and(|(bytes, _)| bytes == pod_uid.as_bytes())
}

/// The stored files that no agent of this run has left, where nothing else is stored; `None` where the run goes on with what is.
async fn of_nobody(run: &Run, archive: &Archive) -> Result<Option<Vec<Listed>>, WorkspaceError> {
    if run.plan.resume || run.attempt > Attempt::FIRST {
        return Ok(None);
    }
    let stored = last_report(archive).await?;
    if stored.is_some_and(|report| report.submission_uid == run.uid) {
        return Ok(None);
    }
    // The controller may have taken the fence from a Pod that never came this far, and stored why it failed. A submitted file is there first.
    let controllers = [OWNER_KEY, FAILURE_LOG_KEY];
    let has_input = has_input(run);
    let inputs = if has_input { INPUT_OBJECTS } else { 0 };
    let most = controllers.len().saturating_add(inputs);
    let there = archive.list("", most.saturating_add(1)).await?.objects;
    let is_ours = |key: &str| controllers.contains(&key) || (has_input && input::is_input(key));
    if there.len() <= most && there.iter().all(|object| is_ours(&object.key)) {
        // In the mode Predictions it is the submitted file.
        let is_of_nobody = |object: &Listed| run.plan.agents() == Agents::First && input::is_input(&object.key);
        return Ok(Some(there.into_iter().filter(is_of_nobody).collect()));
    }
    Err(WorkspaceError::PrefixInUse(place(run, "")))
}

/// The report that was stored last; `None` if there is none that can be read.
async fn last_report(archive: &Archive) -> Result<Option<Report>, ArchiveError> {
    let stored = get(archive, REPORT_KEY, MAX_BYTES as u64).await?;
    Ok(stored.and_then(|object| Report::parse(&object.bytes).ok()))
}

/// A stored object. One that is too large to be ours counts as none: it must not stop each Pod of the run.
async fn get(archive: &Archive, key: &str, limit: u64) -> Result<Option<Object>, ArchiveError> {
    match archive.get(key, limit).await {
        Err(error) if error.is_too_large() => Ok(None),
        object => object,
    }
}

/// True if the evaluators read what a submission brings.
fn has_input(run: &Run) -> bool {
    run.plan.container().is_some_and(|container| container.mode.has_input())
}

/// Bucket and key of an object, for people.
fn place(run: &Run, key: &str) -> String {
    let s3 = &run.plan.storage.s3;
    let prefix = leaderboard_api::effective::key_prefix(s3, &run.plan.run_id);
    format!("{}/{prefix}{key}", s3.bucket)
}

/// The report of a run in which no container has started. It names no stored files.
fn first_report(run: &Run, pod_uid: &str, results: &mut dyn Results) -> Report {
    Report {
        files: BTreeMap::new(),
        ..describe(run, pod_uid, &results.round(), None)
    }
}

/// Puts the runner where every container finds it, executable for every user.
fn copy_runner(places: &Places) -> Result<(), WorkspaceError> {
    let target = places.runner_for_all();
    let copy = |target: &Path| {
        let temporary = target.with_extension("tmp");
        fs::copy(&places.runner, &temporary)?;
        fs::set_permissions(&temporary, fs::Permissions::from_mode(0o755))?;
        fs::rename(&temporary, target)
    };
    copy(&target).map_err(|error| WorkspaceError::Runner {
        path: target.display().to_string(),
        error,
    })
}

fn volume(path: &str, error: TreeError) -> WorkspaceError {
    let path = path.to_owned();
    WorkspaceError::Volume { path, error }
}

/// Makes the folders, in which a container of any user may write.
fn folders(setting: &Setting) -> Result<Arc<Tree>, WorkspaceError> {
    let tree = Tree::open(&setting.places.logs).map_err(|error| volume("/", error.into()))?;
    let (plan, host) = (&setting.run.plan, of_plan(&setting.run.plan).host());
    let of_hosts = Pair::first(plan.workers()).map(|worker| host_folder(host, worker));
    let of_input = [SUBMISSION_FOLDER, INPUT.trim_end_matches('/')].map(str::to_owned);
    let of_input = of_input.into_iter().filter(|_| has_input(&setting.run));
    for folder in FOLDERS.map(str::to_owned).into_iter().chain(of_hosts).chain(of_input) {
        tree.folder(&folder).map_err(|error| volume(&folder, error))?;
    }
    Ok(Arc::new(tree))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::isolation::Blocked;
    use leaderboard_api::EvaluationMode;
    use leaderboard_contract::report::RefusedResults;
    use leaderboard_contract::verdict::{NotAVerdict, VERDICT_BYTES};
    use leaderboard_evaluation::fixtures;
    use leaderboard_evaluation::judge::Pace;

    fn first() -> Report {
        let (run, folder) = (fixtures::run(), tempfile::tempdir().unwrap());
        let tree = Arc::new(Tree::open(folder.path()).unwrap());
        let mut results = of_plan(&run.plan).results(&run, tree).unwrap();
        first_report(&run, "pod-1", &mut *results)
    }

    #[test]
    fn the_first_report_is_one_the_controller_takes() {
        let report = first();
        let read = Report::parse(&serde_json::to_vec(&report).unwrap()).unwrap();
        assert!(read.belongs_to("uid-1", Attempt(1)) && !read.is_final);
        assert_eq!((read.total, read.workers.len(), read.workers[1].total), (4, 2, 2));
    }

    #[test]
    fn what_a_report_quotes_is_one_harmless_line() {
        let mut report = first();
        report.refused = Some(RefusedResults::new(Some(1), "pair 1: \u{1b}[2J\nbad"));
        report.warnings = vec!["\u{202e}route 1".into()];
        let read = Report::parse(&serde_json::to_vec(&report).unwrap()).unwrap();
        assert_eq!(read.refused.unwrap().why, "pair 1: \u{fffd}[2J bad");
        assert_eq!(read.warnings, ["\u{fffd}route 1"]);
    }

    #[test]
    fn what_a_pod_found_of_its_isolation_is_no_failure_unless_it_has_to_be_isolated() {
        let address = "10.96.0.1:443".parse().unwrap();
        for (finding, reason, required) in [
            (
                Finding::Enforced(address, Blocked::Silent),
                WorkspaceReason::Enforced,
                WorkspaceReason::NotIsolated,
            ),
            (
                Finding::Open(address),
                WorkspaceReason::NotEnforced,
                WorkspaceReason::NotIsolated,
            ),
            (
                Finding::Unmeasured("No address.".to_owned()),
                WorkspaceReason::NotMeasured,
                WorkspaceReason::NotKnownIsolated,
            ),
        ] {
            let verdict = verdict_of(&finding);
            assert_eq!(verdict.reason, reason);
            assert_eq!(WorkspaceVerdict::parse(&verdict.to_json()), Ok(verdict));
            let verdict = WorkspaceError::NotIsolated(finding).verdict();
            assert_eq!(verdict.reason, required);
            assert!(
                verdict.message.contains("network.enforcement is Require"),
                "{}",
                verdict.message
            );
        }
    }

    /// The volume of a run of evaluators, with its folders.
    fn prepared(mode: EvaluationMode) -> (tempfile::TempDir, Arc<Tree>) {
        let root = tempfile::tempdir().unwrap();
        let setting = Setting {
            run: fixtures::run_of_mode(mode),
            pod_uid: "pod-1".to_owned(),
            api_server: None,
            role_arn: None,
            places: Places::below(root.path()),
            pace: Pace::default(),
        };
        fs::create_dir(&setting.places.logs).unwrap();
        let made = folders(&setting).unwrap();
        (root, made)
    }

    #[test]
    fn each_evaluator_finds_a_folder_that_any_user_may_write() {
        let (_root, made) = prepared(EvaluationMode::Interactive);
        for folder in ["agent", "evaluators/1", "evaluators/2"] {
            let mode = fs::metadata(made.path().join(folder)).unwrap().permissions().mode();
            assert_eq!(mode & 0o777, 0o777, "{folder}");
        }
        for other in ["evaluators/3", "simulator", "submission", "input"] {
            assert!(!made.path().join(other).exists(), "{other}");
        }
    }

    #[test]
    fn an_agent_of_any_user_may_leave_files() {
        let (_root, made) = prepared(EvaluationMode::Batch);
        let mode = fs::metadata(made.path().join("submission"))
            .unwrap()
            .permissions()
            .mode();
        assert_eq!(mode & 0o777, 0o777);
        assert!(made.path().join("input").is_dir());
    }

    #[test]
    fn verdicts_are_short_and_read_back() {
        let verdict = WorkspaceError::PrefixInUse("bucket/77/".to_owned()).verdict();
        assert_eq!(verdict.reason, WorkspaceReason::PrefixInUse);
        assert_eq!(WorkspaceVerdict::parse(&verdict.to_json()), Ok(verdict));
        let long = WorkspaceError::PrefixInUse("é\"".repeat(3000)).verdict();
        assert!(long.to_json().len() <= VERDICT_BYTES);
        assert!(WorkspaceVerdict::parse(&long.to_json()).is_ok());
        assert!(matches!(
            WorkspaceVerdict::parse("Error"),
            Err(NotAVerdict::Malformed(_))
        ));
    }
}
