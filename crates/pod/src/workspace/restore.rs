//! Brings back what earlier Pods of a run have stored, so that the workers go on where they were.
//!
//! Called by `workspace`. Foreign containers wrote the stored objects: keys are checked like paths, sizes against the
//! run's limit. Status files speak of containers that are gone; they are dropped on both sides.
//!
//! The newest pipeline before this operator (carla-simulator/leaderboard-cloud, one Job for each worker) has the checkpoints of its
//! workers at other keys. They are restored to where a pair's is.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use futures::{StreamExt, TryStreamExt};

use super::stored::{AT_ONCE, download, is_evaluators, remove, unknown};
use super::{WorkspaceError, get, input, last_report, volume};
use crate::blocking;
use crate::daily::Daily;
use crate::upload::quota::{LEAST, Quota};
use crate::upload::{Memory, Stored};
use leaderboard_api::RunPlan;
use leaderboard_api::evaluator_result::{MAX_BYTES, parse};
use leaderboard_api::names::FAILURE_LOG_KEY;
use leaderboard_aws::archive::{Archive, ArchiveError, Listed};
use leaderboard_contract::keys::{
    EVALAI, EVALUATORS, MERGED, REFUSED, SUBMISSION_FOLDER, checkpoint_path, result_path,
};
use leaderboard_contract::report::{OWNER_KEY, REPORT_KEY, Report};
use leaderboard_contract::run::{Run, STATUS_FOLDER};
use leaderboard_evaluation::{Results, of_plan};
use leaderboard_evidence::{Tree, is_plain};
use leaderboard_protocol::files::Pair;

/// Most objects of a run.
const MAX_OBJECTS: usize = 100_000;
/// Downloads what the run goes on with, and removes the stored status files.
pub async fn restore(
    results: Box<dyn Results>,
    run: &Run,
    archive: &Archive,
    tree: &Arc<Tree>,
) -> Result<(), WorkspaceError> {
    let (objects, input) = usable(run, archive, tree).await?;
    let (limit, workers) = (run.plan.storage.s3.size_limit.bytes(), run.plan.workers());
    let merger = run.plan.merger().and(Pair::first(workers).last());
    let quota = Quota::new(limit, workers, of_plan(&run.plan).host());
    let chosen = choose(objects, &quota, workers, merger);
    if chosen.left_out > 0 {
        tracing::warn!(
            objects = chosen.left_out,
            "not restored: impossible keys, or beyond storage.s3.sizeLimit"
        );
    }
    let others: Vec<(String, Stored)> = unknown(chosen.others.iter().chain(&chosen.of_workers)).collect();
    for object in chosen.of_workers {
        let path = of_worker(&object.key).map(checkpoint_path).unwrap_or_default();
        // Not known as stored: it gets a pair's key with the first upload.
        download(archive, tree, object, &path).await?;
    }
    let downloads = futures::stream::iter(chosen.objects).map(|object| async move {
        let path = object.key.clone();
        download(archive, tree, object, &path).await
    });
    let stored: Vec<Option<(String, Stored)>> = downloads.buffer_unordered(AT_ONCE).try_collect().await?;
    let removed = blocking(move || results.remove_others()).await;
    removed.map_err(|error| volume("agent", error))?;
    let mut memory = Memory {
        stored: stored.into_iter().flatten().collect(),
        sent: Daily::default(),
    };
    tracing::info!(
        files = memory.stored.len(),
        bytes = memory.bytes(),
        "restored what was stored"
    );
    // An object that is not restored stays stored all the same, and counts.
    memory.stored.extend(others.into_iter().chain(input));
    memory.save(tree).map_err(|error| volume("logcopy", error))
}

/// The stored objects that the run may go on with, and what is stored of its input. Removes what it must not go on with.
async fn usable(
    run: &Run,
    archive: &Archive,
    tree: &Arc<Tree>,
) -> Result<(Vec<Listed>, BTreeMap<String, Stored>), WorkspaceError> {
    let statuses = archive.list(&format!("{STATUS_FOLDER}/"), MAX_OBJECTS).await?;
    remove(archive, statuses.objects).await?;
    let report = last_report(archive).await?;
    remove_refused(run, archive, report.as_ref()).await?;
    let listing = archive.list("", MAX_OBJECTS).await?;
    if !listing.complete {
        tracing::warn!("the prefix holds more than {MAX_OBJECTS} objects; the rest is not restored");
    }
    let (mut objects, input) = input::take(run, archive, tree, listing.objects).await?;
    if !are_ours(&run.plan, report.as_ref(), &objects) {
        let of_others = objects.extract_if(.., |object| is_evaluators(&object.key));
        remove(archive, of_others.collect()).await?;
    }
    Ok((objects, input))
}

/// Removes the final results of evaluators where an attempt before this one has ended because of its results: an evaluator does not start
/// beside a final one, so a corrected one would judge nothing.
async fn remove_refused(run: &Run, archive: &Archive, report: Option<&Report>) -> Result<(), ArchiveError> {
    let is_refused = |report: &Report| {
        let fault = report.refused.as_ref().or(report.unusable.as_ref());
        let worker = fault.and_then(|fault| usize::try_from(fault.worker?).ok());
        // The results that a command merges are not its fault.
        let is_mergers = worker.is_some() && worker == run.plan.merger();
        let is_own = report.belongs_to(&run.uid, run.attempt);
        fault.is_some() && report.is_final && report.stopped.is_none() && !is_mergers && !is_own
    };
    if run.plan.container().is_none() || !report.is_some_and(is_refused) {
        return Ok(());
    }
    let mut finals = Vec::new();
    for path in Pair::first(run.plan.workers()).map(result_path) {
        let stored = get(archive, &path, MAX_BYTES as u64).await?;
        let found = stored.and_then(|object| parse(&object.bytes).ok());
        if found.is_some_and(|result| result.is_final) {
            finals.push(path);
        }
    }
    archive.delete(&finals).await
}

/// True if evaluators that share the work as this plan's do have stored what lies below [`EVALUATORS`]. With another number of them each had
/// another share, and the run begins anew.
fn are_ours(plan: &RunPlan, report: Option<&Report>, objects: &[Listed]) -> bool {
    let (workers, merger) = (
        plan.workers(),
        plan.merger().and_then(|merger| u32::try_from(merger).ok()),
    );
    match report {
        _ if plan.container().is_none() => true,
        Some(report) => report.workers.len() == workers && report.merger == merger,
        None => {
            // Each has a log; that of a command that merges them comes last.
            let last = objects.iter().filter_map(|object| evaluator_of(&object.key)).max();
            last.is_some_and(|last| (plan.sharing()..=workers).contains(&usize::from(last.get())))
        }
    }
}

#[derive(Debug, PartialEq, Eq)]
struct Chosen {
    objects: Vec<Listed>,
    /// The checkpoints of another pipeline's workers, each for the pair of its number.
    of_workers: Vec<Listed>,
    /// Objects that stay in the bucket only.
    others: Vec<Listed>,
    /// How many of them are not left there on purpose.
    left_out: usize,
}

/// Chooses objects: results and known logs first, then the smallest, so that no flood and no huge file keeps a checkpoint out.
fn choose(objects: Vec<Listed>, quota: &Quota, pairs: usize, merger: Option<Pair>) -> Chosen {
    let not_counted = [OWNER_KEY, REPORT_KEY, FAILURE_LOG_KEY];
    let (of_workers, objects) = checkpoints_of_workers(objects, quota, pairs);
    // To merge again is cheap, and an evaluator whose result was refused judges anew.
    let merged = merger.map(result_path);
    let (mut objects, mut others): (Vec<_>, Vec<_>) = objects
        .into_iter()
        .filter(|object| !not_counted.contains(&object.key.as_str()))
        .partition(|Listed { key, .. }| {
            is_restored(key, pairs)
                && (!is_evaluators(key) || evaluator_of(key).is_some_and(|one| one.index() < pairs))
                && merged.as_ref() != Some(key)
        });
    let all = objects.len();
    let shadowed = shadowed(&objects);
    others.extend(objects.extract_if(.., |object| {
        !object.key.contains('/') || !is_plain(&object.key) || shadowed.contains(&object.key)
    }));
    objects.sort_by(|a, b| (quota.kind(&a.key), a.size, &a.key).cmp(&(quota.kind(&b.key), b.size, &b.key)));
    let mut left = quota.bytes;
    others.extend(objects.extract_if(.., |object| {
        let after = left.checked_sub(object.size.max(LEAST));
        left = after.unwrap_or(left);
        after.is_none()
    }));
    Chosen {
        left_out: all.saturating_sub(objects.len()),
        objects,
        of_workers,
        others,
    }
}

/// Takes out the checkpoints of the newest pipeline's workers that belong to pairs without one of their own. As many workers as pairs
/// share the routes out as the pairs do; with another number each has other routes, and the run begins anew. Each worker has logs.
fn checkpoints_of_workers(objects: Vec<Listed>, quota: &Quota, pairs: usize) -> (Vec<Listed>, Vec<Listed>) {
    let workers = objects
        .iter()
        .filter_map(|object| of_worker(&object.key).or_else(|| log_of_worker(&object.key)));
    if workers.max() != Pair::first(pairs).last() {
        return (Vec::new(), objects);
    }
    let own: BTreeSet<String> = objects.iter().map(|object| object.key.clone()).collect();
    let mut left = quota.bytes;
    objects.into_iter().partition(|object| {
        let is_free = of_worker(&object.key).is_some_and(|worker| !own.contains(&checkpoint_path(worker)));
        let after = left.checked_sub(object.size).filter(|_| is_free);
        left = after.unwrap_or(left);
        after.is_some()
    })
}

/// The number of the worker whose checkpoint a key is.
fn of_worker(key: &str) -> Option<Pair> {
    let worker = key.strip_prefix("agent/partial_agent_results")?.strip_suffix(".json")?;
    worker.parse().ok()
}

/// The number of the worker one of whose containers has this log.
fn log_of_worker(key: &str) -> Option<Pair> {
    let (container, worker) = key.strip_prefix("logs/")?.strip_suffix(".log")?.split_once('-')?;
    ["agent", "simulator", "uploader"]
        .contains(&container)
        .then(|| worker.parse().ok())?
}

/// The number of the evaluator whose file a key is.
fn evaluator_of(key: &str) -> Option<Pair> {
    key.strip_prefix(EVALUATORS)?.split_once('/')?.0.parse().ok()
}

/// True if a key is one that the run goes on with.
fn is_restored(key: &str, pairs: usize) -> bool {
    // Logcopy makes its files from the checkpoints again, evidence is for people, and an agent alone leaves files.
    let (statuses, left) = (format!("{STATUS_FOLDER}/"), format!("{SUBMISSION_FOLDER}/"));
    let unread = [statuses.as_str(), left.as_str(), "logcopy/.", EVALAI, REFUSED];
    key != MERGED && !unread.iter().any(|folder| key.starts_with(folder)) && !is_foreign_agent(key, pairs)
}

/// S3 can hold `a` next to `a/b`; a volume can't. These are such `a`.
fn shadowed(objects: &[Listed]) -> BTreeSet<String> {
    let keys: BTreeSet<&str> = objects.iter().map(|object| object.key.as_str()).collect();
    let is_shadowed = |key: &&str| {
        let folder = format!("{key}/");
        keys.range(folder.as_str()..)
            .next()
            .is_some_and(|next| next.starts_with(&folder))
    };
    keys.iter().copied().filter(is_shadowed).map(str::to_owned).collect()
}

/// `agent/agent<n>/…` of a pair this run does not have.
fn is_foreign_agent(key: &str, pairs: usize) -> bool {
    let number = key.strip_prefix("agent/agent").and_then(|rest| rest.split_once('/'));
    number.is_some_and(|(number, _)| !(1..=pairs).any(|pair| pair.to_string() == number))
}

#[cfg(test)]
mod tests {
    use leaderboard_api::EvaluationMode;
    use leaderboard_evaluation::fixtures::{container_run, merging_run};
    use leaderboard_protocol::files::Host;

    use super::*;

    const MIB: u64 = 1 << 20;

    fn listed(key: &str, size: u64) -> Listed {
        Listed {
            key: key.to_owned(),
            size,
            etag: None,
            stored: None,
        }
    }

    fn keys(chosen: &Chosen) -> Vec<&str> {
        chosen.objects.iter().map(|object| object.key.as_str()).collect()
    }

    #[test]
    fn what_belongs_to_the_run_is_restored_and_nothing_else() {
        let objects = vec![
            listed("agent/agent1/agent_results.json", 10),
            listed("agent/agent2/leaderboard.log", 20),
            listed("agent/agent3/agent_results.json", 10),
            listed("agent/agent10/agent_results.json", 10),
            listed("agent/agent01/agent_results.json", 10),
            listed("agent/agent_results.json", 30),
            listed("containers-status/agent-1.done", 0),
            listed("logcopy/report.json", 5),
            listed("logcopy/owner", 5),
            listed("evalai/environment_log.txt", 5),
            listed("evalai/metadata.json", 30),
            listed("logcopy/refused/agent/agent1/agent_results.json", 5),
            listed("logcopy/.stored.json", 5),
            listed("logcopy/logcopy.log", 40),
            listed("submission/forged.csv", 5),
        ];
        let chosen = choose(objects, &Quota::new(MIB, 2, Host::Simulator), 2, None);
        let expected = [
            "agent/agent1/agent_results.json",
            "agent/agent2/leaderboard.log",
            "logcopy/logcopy.log",
        ];
        assert_eq!((keys(&chosen), chosen.left_out), (expected.to_vec(), 0));
    }

    #[test]
    fn the_checkpoints_of_as_many_workers_as_pairs_are_those_of_the_pairs() {
        let partial = |worker: &str| format!("agent/partial_agent_results{worker}.json");
        for (keys, taken) in [
            (vec![partial("1"), partial("2")], vec![partial("1"), partial("2")]),
            // The second worker has begun, and has no route yet.
            (vec![partial("1"), "logs/uploader-2.log".into()], vec![partial("1")]),
            // The routes of one worker, or of three, are not the routes of two pairs.
            (vec![partial("1")], vec![]),
            (vec![partial("1"), partial("2"), partial("3")], vec![]),
            (vec![partial("1"), partial("2"), "logs/agent-3.log".into()], vec![]),
            // The pair has gone on since.
            (
                vec![partial("1"), partial("2"), "agent/agent1/agent_results.json".into()],
                vec![partial("2")],
            ),
            (
                vec![partial("01"), partial("2"), partial(""), partial("0"), partial("-1")],
                vec![partial("2")],
            ),
        ] {
            let objects = keys.iter().map(|key| listed(key, 10)).collect();
            let chosen = choose(objects, &Quota::new(MIB, 2, Host::Simulator), 2, None);
            let found: Vec<_> = chosen.of_workers.iter().map(|object| object.key.clone()).collect();
            assert_eq!(found, taken, "{keys:?}");
            assert!(
                chosen.objects.iter().all(|object| !taken.contains(&object.key)),
                "{keys:?}"
            );
        }
        let large = vec![listed(&partial("1"), 2 * MIB), listed(&partial("2"), 10)];
        let chosen = choose(large, &Quota::new(MIB, 2, Host::Simulator), 2, None);
        assert_eq!(chosen.of_workers.len(), 1, "within the limit of the run");
    }

    #[test]
    fn of_evaluators_all_but_what_a_command_has_merged_comes_back() {
        let workers = ["1", "2", "02", "x", "0", "3", "1000"];
        let of_worker =
            |worker| ["console.log", "result.json", "games.json"].map(|file| format!("evaluators/{worker}/{file}"));
        let objects: Vec<Listed> = workers.iter().flat_map(of_worker).map(|key| listed(&key, 10)).collect();
        for (pairs, merger, restored) in [(2, None, 6), (3, None, 9), (3, Pair::new(3), 8)] {
            let quota = Quota::new(MIB, pairs, Host::Evaluator);
            let chosen = choose(objects.clone(), &quota, pairs, merger);
            let keys = keys(&chosen);
            assert_eq!((keys.len(), chosen.left_out), (restored, 0), "{merger:?}: {keys:?}");
            assert!(keys[0].ends_with("result.json"), "{merger:?}: {keys:?}");
            assert_eq!(keys.contains(&"evaluators/3/result.json"), restored == 9, "{merger:?}");
        }
    }

    #[test]
    fn without_a_report_evaluators_go_on_where_as_many_have_been() {
        let of_two = [("12", true), ("2", true), ("1", false), ("123", false)];
        // The third merges the results of the two, and may not have begun.
        let of_command = [("1", false), ("12", true), ("123", true), ("4", false)];
        let merging = merging_run(EvaluationMode::Interactive);
        for (run, stored) in [(container_run(), of_two), (merging, of_command)] {
            for (workers, expected) in stored {
                let keys = workers.chars().map(|worker| format!("evaluators/{worker}/console.log"));
                let objects: Vec<Listed> = keys.map(|key| listed(&key, 10)).collect();
                assert_eq!(are_ours(&run.plan, None, &objects), expected, "{workers}");
            }
        }
    }

    #[test]
    fn keys_that_lead_elsewhere_are_left_out() {
        let objects = [
            "../x",
            "/etc/x",
            "simulator/../../x",
            "simulator//x",
            "plain",
            "simulator/",
            "simulator/x",
        ];
        let objects = objects.iter().map(|key| listed(key, 1)).collect();
        let chosen = choose(objects, &Quota::new(MIB, 2, Host::Simulator), 2, None);
        assert_eq!((keys(&chosen), chosen.left_out), (vec!["simulator/x"], 6));
    }

    #[test]
    fn a_key_that_is_also_a_folder_is_left_out() {
        let objects = vec![
            listed("simulator/a", 1),
            listed("simulator/a/b", 1),
            listed("simulator/a-b", 1),
        ];
        assert_eq!(
            keys(&choose(objects, &Quota::new(MIB, 1, Host::Simulator), 1, None)),
            ["simulator/a-b", "simulator/a/b"]
        );
    }

    #[test]
    fn what_is_not_restored_counts_all_the_same() {
        let objects = vec![
            listed("agent/agent_results.json", 30),
            listed("agent/agent3/leaderboard.log", 20),
            listed("logcopy/refused/agent/agent1/agent_results.json", 5),
            listed("logcopy/report.json", 5),
            listed("plain", 6),
        ];
        let chosen = choose(objects, &Quota::new(MIB, 2, Host::Simulator), 2, None);
        assert_eq!(keys(&chosen), Vec::<&str>::new());
        let others: Vec<&str> = chosen.others.iter().map(|object| object.key.as_str()).collect();
        let expected = [
            "agent/agent_results.json",
            "agent/agent3/leaderboard.log",
            "logcopy/refused/agent/agent1/agent_results.json",
            "plain",
        ];
        assert_eq!((others, chosen.left_out), (expected.to_vec(), 1));
    }

    #[test]
    fn the_limit_leaves_out_the_largest_of_the_other_files() {
        let objects = vec![
            listed("agent/agent1/a", 0),
            listed("agent/agent1/agent_results.json", MIB / 2),
            listed("agent/agent1/leaderboard.log", MIB / 2 - 2 * LEAST),
            listed("agent/agent1/b", 9),
            listed("agent/agent1/c", 10),
        ];
        let chosen = choose(objects, &Quota::new(MIB, 1, Host::Simulator), 1, None);
        let expected = [
            "agent/agent1/agent_results.json",
            "agent/agent1/leaderboard.log",
            "agent/agent1/a",
            "agent/agent1/b",
        ];
        assert_eq!((keys(&chosen), chosen.left_out), (expected.to_vec(), 1));
        assert_eq!(chosen.others.len(), 1);
    }
}
