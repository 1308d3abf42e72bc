//! Brings what the evaluators read at `/input`: the submitted file of the mode Predictions, or the files that `collect` of an earlier Pod
//! has copied.
//!
//! Called by `workspace`. A file counts only with exactly the size and the digest that it has to have.

use std::collections::BTreeMap;
use std::sync::Arc;

use futures::{StreamExt, TryStreamExt};

use super::stored::{AT_ONCE, download, is_evaluators, remove, unknown};
use super::{WorkspaceError, get, place, volume};
use crate::blocking;
use crate::collect::{self, bounds, digest_of, usable};
use crate::upload::Stored;
use leaderboard_api::Agents;
use leaderboard_aws::archive::{Archive, Listed};
use leaderboard_contract::collected::MAX_BYTES;
use leaderboard_contract::keys::{COLLECTED, INPUT, INPUT_FILE};
use leaderboard_contract::report::StoredFile;
use leaderboard_contract::run::{Run, STATUS_FOLDER};
use leaderboard_evidence::Tree;
use leaderboard_protocol::files::{Mark, Pair, StatusFile};

/// True for the key of what evaluators read, or of its list.
pub(super) fn is_input(key: &str) -> bool {
    key.starts_with(INPUT) || key == COLLECTED
}

/// Brings the submitted file of the mode Predictions, which is in the bucket before the Pod is.
pub(super) async fn submitted(run: &Run, archive: &Archive, tree: &Arc<Tree>) -> Result<(), WorkspaceError> {
    if run.plan.agents() != Agents::Absent {
        return Ok(());
    }
    let missing = |why| {
        let place = place(run, INPUT_FILE);
        Err(WorkspaceError::InputMissing { place, why })
    };
    let Some(file) = &run.input else {
        return missing("is not named by the submission's status");
    };
    let file = StoredFile {
        size: u64::try_from(file.size).unwrap_or(0),
        sha256: file.sha256.clone(),
    };
    let listing = archive.list(INPUT_FILE, 1).await?;
    let Some(object) = listing.objects.into_iter().find(|object| object.key == INPUT_FILE) else {
        return missing("is not there");
    };
    match fetch(archive, tree, object, file).await? {
        Some(_) => Ok(()),
        None => missing("has another size or SHA-256 than the one that was submitted"),
    }
}

/// Takes what evaluators read out of the stored objects, and brings it in the mode Batch, or removes it. Returns the other objects, and what
/// is stored of it.
pub(super) async fn take(
    run: &Run,
    archive: &Archive,
    tree: &Arc<Tree>,
    mut objects: Vec<Listed>,
) -> Result<(Vec<Listed>, BTreeMap<String, Stored>), WorkspaceError> {
    let input: Vec<Listed> = objects.extract_if(.., |object| is_input(&object.key)).collect();
    let mut stored: BTreeMap<String, Stored> = unknown(input.iter()).collect();
    if run.plan.agents() == Agents::First {
        if let Some(brought) = collected(run, archive, tree, &input).await? {
            stored.extend(brought);
        } else {
            // The agent runs anew. What it has left before does not go with the files that it leaves now, nor what the evaluators made of it.
            let others = objects.extract_if(.., |object| is_evaluators(&object.key));
            remove(archive, others.chain(input).collect()).await?;
            stored.clear();
        }
    }
    Ok((objects, stored))
}

/// Brings the files that `collect` of an earlier Pod has copied, if each of them is stored; the agent is done then. `None` if not, and
/// nothing is left of them.
async fn collected(
    run: &Run,
    archive: &Archive,
    tree: &Arc<Tree>,
    stored: &[Listed],
) -> Result<Option<Vec<(String, Stored)>>, WorkspaceError> {
    forget(tree)?;
    let by_key: BTreeMap<&str, &Listed> = stored.iter().map(|object| (object.key.as_str(), object)).collect();
    let object = get(archive, COLLECTED, MAX_BYTES).await?;
    let Some(list) = object.and_then(|object| usable(&object.bytes, &bounds(run))) else {
        tracing::info!("no {COLLECTED} that can be used is stored; the agent runs anew");
        return Ok(None);
    };
    let wanted = list.files.iter().map(|(path, file)| {
        let object = by_key.get(format!("{INPUT}{path}").as_str())?;
        (object.size == file.size).then(|| (Listed::clone(object), file.clone()))
    });
    let Some(wanted) = wanted.collect::<Option<Vec<_>>>() else {
        tracing::info!("not all files of {COLLECTED} are stored; the agent runs anew");
        return Ok(None);
    };
    let fetched = futures::stream::iter(wanted)
        .map(|(object, file)| fetch(archive, tree, object, file))
        .buffer_unordered(AT_ONCE);
    let fetched: Vec<Option<(String, Stored)>> = fetched.try_collect().await?;
    let Some(fetched) = fetched.into_iter().collect::<Option<Vec<_>>>() else {
        tracing::warn!("a stored file of the agent's is another one than {COLLECTED} names; the agent runs anew");
        forget(tree)?;
        return Ok(None);
    };
    let noted = tree.write(COLLECTED, &list.to_json());
    noted.map_err(|error| volume(COLLECTED, error))?;
    end_agent(tree)?;
    Ok(Some(fetched))
}

/// Downloads a file. `None` if it is not the one with this size and digest.
async fn fetch(
    archive: &Archive,
    tree: &Arc<Tree>,
    object: Listed,
    file: StoredFile,
) -> Result<Option<(String, Stored)>, WorkspaceError> {
    if object.size != file.size {
        return Ok(None);
    }
    let path = object.key.clone();
    let stored = match download(archive, tree, object, &path).await {
        // Another one has taken its place since it was listed.
        Err(WorkspaceError::Storage(error)) if error.is_too_large() => return Ok(None),
        stored => stored?,
    };
    let (reading, key) = (Arc::clone(tree), path.clone());
    let found = blocking(move || digest_of(&reading, &key)).await;
    let is_it = found.map_err(|error| volume(&path, error))? == Some(file);
    Ok(stored.filter(|_| is_it))
}

/// Forgets on the volume what an earlier try has brought: that the agent is done, the list, and its files.
fn forget(tree: &Tree) -> Result<(), WorkspaceError> {
    for agent in Pair::first(1).map(Pair::agent) {
        let folder = format!("{STATUS_FOLDER}/{agent}");
        tree.clear(&folder).map_err(|error| volume(&folder, error))?;
    }
    collect::forget(tree, volume)
}

/// Marks the one agent as done, so that it does not run again.
fn end_agent(tree: &Tree) -> Result<(), WorkspaceError> {
    for agent in Pair::first(1).map(Pair::agent) {
        let folder = format!("{STATUS_FOLDER}/{agent}");
        // Its own runner writes there, too.
        tree.folder(&folder).map_err(|error| volume(&folder, error))?;
        let done = StatusFile::Of(agent, Mark::Done).create(&tree.path().join(STATUS_FOLDER));
        done.map_err(|error| volume(&folder, error.into()))?;
    }
    Ok(())
}
