//! The stored objects of a run, one by one: fetched, removed, or left where they are.

use std::sync::Arc;

use super::error::WorkspaceError;
use super::volume;
use crate::blocking;
use crate::upload::{Stored, fingerprint};
use leaderboard_aws::archive::{Archive, Listed};
use leaderboard_contract::keys::EVALUATORS;
use leaderboard_evidence::{Stamp, Tree, TreeError};

/// Downloads at once.
pub(super) const AT_ONCE: usize = 4;

pub(super) async fn remove(archive: &Archive, objects: Vec<Listed>) -> Result<(), WorkspaceError> {
    let keys: Vec<String> = objects.into_iter().map(|object| object.key).collect();
    Ok(archive.delete(&keys).await?)
}

/// Objects whose content is not known.
pub(super) fn unknown<'a>(objects: impl Iterator<Item = &'a Listed>) -> impl Iterator<Item = (String, Stored)> {
    objects.map(|one| (one.key.clone(), Stored::unknown(one.size)))
}

pub(super) fn is_evaluators(key: &str) -> bool {
    key.starts_with(EVALUATORS)
}

/// Downloads an object to a path. `None` if it is gone.
pub(super) async fn download(
    archive: &Archive,
    tree: &Arc<Tree>,
    object: Listed,
    path: &str,
) -> Result<Option<(String, Stored)>, WorkspaceError> {
    let local = |error: TreeError| volume(path, error);
    let (creating, key) = (Arc::clone(tree), path.to_owned());
    let created = blocking(move || creating.create(&key)).await;
    let mut file = tokio::fs::File::from_std(created.map_err(local)?);
    // A little more than the list showed, for an object that was replaced since.
    let limit = object.size.saturating_mul(2).max(1 << 20);
    let Some(size) = archive.download(&object.key, &mut file, limit).await? else {
        return Ok(None);
    };
    drop(file);
    let (reading, key) = (Arc::clone(tree), path.to_owned());
    let read = blocking(move || fingerprint_of(&reading, &key)).await;
    let Some((fingerprint, stamp)) = read.map_err(local)? else {
        return Ok(None);
    };
    // Known as stored only if it is what the list showed the tag of.
    let etag = object.etag.filter(|_| size == object.size);
    let stored = Stored {
        fingerprint,
        stamp: Stamp { size, ..stamp },
        etag,
        at: std::time::Duration::ZERO,
    };
    Ok(Some((object.key, stored)))
}

fn fingerprint_of(tree: &Tree, path: &str) -> Result<Option<(String, Stamp)>, TreeError> {
    let Some((file, stamp)) = tree.file(path)? else {
        return Ok(None);
    };
    Ok(Some((fingerprint(&file, stamp.size)?, stamp)))
}
