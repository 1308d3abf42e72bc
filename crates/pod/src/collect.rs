//! Copies the files that an agent of the mode Batch has left to where the evaluators read them, within bounds.
//!
//! Called by `leaderboard-operator collect`, the init container after the agent. Knows the `logs` volume and has no identity. A stranger's
//! image wrote the files: nothing of them is followed, and what is no plain file ends the run as the participant's fault. The list of the
//! copies is written last, so that files without a list count for nothing.

use std::collections::BTreeMap;
use std::fs::{File, Permissions};
use std::io::{self, Read, Write};
use std::os::unix::fs::PermissionsExt;

use sha2::{Digest, Sha256};

use super::places::Places;
use leaderboard_api::InputBounds;
use leaderboard_api::text::one_line;
use leaderboard_contract::collected::{Collected, MAX_BYTES};
use leaderboard_contract::keys::{COLLECTED, INPUT, SUBMISSION_FOLDER};
use leaderboard_contract::report::StoredFile;
use leaderboard_contract::run::Run;
use leaderboard_contract::verdict::{WorkspaceReason, WorkspaceVerdict};
use leaderboard_evidence::{Stamp, Tree, TreeError, is_plain};
use leaderboard_protocol::files::StatusFile;

/// Most files and folders that an agent may leave, which bounds what is in memory.
pub(crate) const ENTRIES: usize = 20_000;
/// Bytes that are copied at once.
const PIECE: usize = 256 << 10;
/// Characters of a path in a sentence: the containers of a Pod share 12 KiB for their termination messages.
const SHOWN: usize = 60;

/// Why there are no files for the evaluators, and what to do.
#[derive(thiserror::Error, Debug)]
pub enum CollectError {
    /// A file below the volume's root.
    #[error("{path} on the logs volume can't be used: {error}. Look at the node's disk and the Pod's volumes.")]
    Volume {
        /// Which.
        path: String,
        /// The system's own text.
        error: TreeError,
    },
    /// The agent has left none.
    #[error("The agent has left no file in /submission; have it write one there before it ends, and submit again.")]
    Nothing,
    /// One that is no plain file.
    #[error(
        "{file} in /submission can't be taken: {why}; have the agent write regular files that all may read, and submit \
         again."
    )]
    File {
        /// Which.
        file: String,
        /// Why not.
        why: String,
    },
    /// More files than are taken.
    #[error(
        "/submission has {found} files, more than the {limit} of evaluation.container.input.maxFiles; have the agent \
         write fewer, and submit again."
    )]
    TooMany {
        /// How many.
        found: usize,
        /// The bound.
        limit: usize,
    },
    /// More bytes than are taken.
    #[error(
        "/submission has more than the {limit} bytes of evaluation.container.input.maxBytes, {size} of them in {file}; \
         have the agent write less, and submit again."
    )]
    TooLarge {
        /// The file with which the bound is exceeded.
        file: String,
        /// Its bytes.
        size: u64,
        /// The bound.
        limit: u64,
    },
}

impl CollectError {
    /// For the termination message.
    pub fn verdict(&self) -> WorkspaceVerdict {
        let reason = match self {
            Self::Volume { .. } => WorkspaceReason::VolumeFailed,
            Self::Nothing | Self::File { .. } | Self::TooMany { .. } | Self::TooLarge { .. } => {
                WorkspaceReason::InputRefused
            }
        };
        WorkspaceVerdict::new(reason, self.to_string())
    }
}

/// Copies the files, unless the run is to stop or they are copied already. A failure is also written to the termination log.
pub async fn main(run: Run, places: Places) -> Result<(), CollectError> {
    let work = move || {
        let collected = collect(&run, &places);
        if let Err(error) = &collected {
            places.tell(&error.verdict());
        }
        collected
    };
    let done = tokio::task::spawn_blocking(work).await;
    done.map_err(|error| volume("/", io::Error::other(error).into()))?
}

fn collect(run: &Run, places: &Places) -> Result<(), CollectError> {
    if StatusFile::Cancel.exists(&places.status()) {
        tracing::info!("the run is to stop, so nothing is copied");
        return Ok(());
    }
    let tree = Tree::open(&places.logs).map_err(|error| volume("/", error.into()))?;
    let bounds = bounds(run);
    let noted = tree
        .read(COLLECTED, MAX_BYTES)
        .map_err(|error| volume(COLLECTED, error))?;
    let list = noted.as_ref().and_then(|(bytes, _)| usable(bytes, &bounds));
    if let Some(list) = list
        && is_complete(&tree, &list)?
    {
        tracing::info!("the files are copied already");
        return Ok(());
    }
    match find(&tree, &bounds).and_then(|files| copy_all(&tree, &files)) {
        Ok(list) => {
            tracing::info!(files = list.files.len(), bytes = list.bytes(), "copied");
            Ok(())
        }
        // The list says that there were some, here or in a Pod before this one.
        Err(CollectError::Nothing) if noted.is_some() => {
            Err(volume(INPUT, io::Error::other("copied files are gone").into()))
        }
        Err(error) => {
            // Nothing starts after a failure, so a rest that stays is read by nobody.
            let _ = forget(&tree, volume);
            Err(error)
        }
    }
}

/// Bounds of what a submission brings.
pub(crate) fn bounds(run: &Run) -> InputBounds {
    let container = run.plan.container();
    container
        .and_then(|container| container.input.clone())
        .unwrap_or_default()
}

fn most_files(bounds: &InputBounds) -> usize {
    usize::try_from(bounds.max_files).unwrap_or(0)
}

/// A list that this run can use: it names files within the bounds, by paths that lead nowhere else.
pub(crate) fn usable(bytes: &[u8], bounds: &InputBounds) -> Option<Collected> {
    let list = Collected::parse(bytes)?;
    let is_file = |path: Option<&str>| path.is_some_and(|path| list.files.contains_key(path));
    let is_below_file = |path: &str| path.match_indices('/').any(|(at, _)| is_file(path.get(..at)));
    let is_usable = |path: &String| is_plain(&format!("{INPUT}{path}")) && !is_below_file(path);
    let fits = list.files.len() <= most_files(bounds) && list.bytes() <= bounds.max_bytes.bytes();
    let is_good = fits && !list.files.is_empty() && list.files.keys().all(is_usable);
    is_good.then_some(list)
}

/// True if each file of the list is there, as it says.
fn is_complete(tree: &Tree, list: &Collected) -> Result<bool, CollectError> {
    for (path, file) in &list.files {
        let path = format!("{INPUT}{path}");
        let found = digest_of(tree, &path).map_err(|error| volume(&path, error))?;
        if found.as_ref() != Some(file) {
            return Ok(false);
        }
    }
    Ok(true)
}

/// The files that the agent has left, by path below its folder.
fn find(tree: &Tree, bounds: &InputBounds) -> Result<BTreeMap<String, Stamp>, CollectError> {
    let walk = tree.walk(SUBMISSION_FOLDER, ENTRIES);
    let below = |path: &str| {
        let rest = path.strip_prefix(SUBMISSION_FOLDER);
        rest.and_then(|rest| rest.strip_prefix('/')).unwrap_or(path).to_owned()
    };
    if let Some((path, why)) = &walk.first {
        return Err(if why.is_the_writers() {
            refused(&below(path), why)
        } else {
            volume(path, io::Error::other(*why).into())
        });
    }
    let files: BTreeMap<String, Stamp> = walk.files.iter().map(|(path, stamp)| (below(path), *stamp)).collect();
    let (found, limit) = (files.len(), most_files(bounds));
    if found == 0 {
        return Err(CollectError::Nothing);
    }
    if found > limit {
        return Err(CollectError::TooMany { found, limit });
    }
    let limit = bounds.max_bytes.bytes();
    let mut left = limit;
    for (path, stamp) in &files {
        let (file, size) = (one_line(path, SHOWN), stamp.size);
        let after = left.checked_sub(size);
        left = after.ok_or(CollectError::TooLarge { file, size, limit })?;
    }
    Ok(files)
}

/// Copies all of them, and lists them then.
fn copy_all(tree: &Tree, files: &BTreeMap<String, Stamp>) -> Result<Collected, CollectError> {
    forget(tree, volume)?;
    let copied = files
        .iter()
        .map(|(path, stamp)| copy(tree, path, *stamp).map(|copied| (path.clone(), copied)));
    let list = Collected::new(copied.collect::<Result<_, CollectError>>()?);
    let noted = tree.write(COLLECTED, &list.to_json());
    noted.map_err(|error| volume(COLLECTED, error))?;
    Ok(list)
}

/// Removes the list, and then the copies. `failed` makes the error of a path.
pub(crate) fn forget<E>(tree: &Tree, failed: fn(&str, TreeError) -> E) -> Result<(), E> {
    tree.remove(COLLECTED).map_err(|error| failed(COLLECTED, error))?;
    let cleared = tree.clear(INPUT.trim_end_matches('/'));
    cleared.map_err(|error| failed(INPUT, error))
}

/// Copies one file, which has to be the one with this stamp from its first byte to its last.
fn copy(tree: &Tree, path: &str, stamp: Stamp) -> Result<StoredFile, CollectError> {
    let opened = tree.file(&format!("{SUBMISSION_FOLDER}/{path}"));
    let opened = opened.map_err(|error| unreadable(path, error))?;
    let Some((file, _)) = opened else {
        return Err(unreadable(path, TreeError::Changed));
    };
    copy_from(tree, path, stamp, &file, &file)
}

fn copy_from(tree: &Tree, path: &str, stamp: Stamp, file: &File, bytes: impl Read) -> Result<StoredFile, CollectError> {
    let target = format!("{INPUT}{path}");
    let failed = |error: TreeError| volume(&target, error);
    let mut into = tree.create(&target).map_err(failed)?;
    // One byte more, so that a file that grows meanwhile is noticed.
    let bytes = bytes.take(stamp.size.saturating_add(1));
    let write = |piece: &[u8]| into.write_all(piece).map_err(|error| failed(error.into()));
    let copied = digest(bytes, |error| unreadable(path, error.into()), write)?;
    let after = file.metadata().map_err(|error| unreadable(path, error.into()))?;
    if copied.size != stamp.size || Stamp::of(&after) != stamp {
        return Err(unreadable(path, TreeError::Changed));
    }
    let for_all = into.set_permissions(Permissions::from_mode(0o644));
    for_all.map_err(|error| failed(error.into()))?;
    Ok(copied)
}

/// Size and digest of a file; `None` if there is none.
pub(crate) fn digest_of(tree: &Tree, path: &str) -> Result<Option<StoredFile>, TreeError> {
    let Some((file, _)) = tree.file(path)? else {
        return Ok(None);
    };
    digest(&file, TreeError::from, |_| Ok(())).map(Some)
}

/// Reads to the end, piece by piece.
fn digest<E>(
    mut from: impl Read,
    failed: impl Fn(io::Error) -> E,
    mut each: impl FnMut(&[u8]) -> Result<(), E>,
) -> Result<StoredFile, E> {
    let (mut hash, mut size, mut piece) = (Sha256::new(), 0_u64, vec![0; PIECE]);
    loop {
        let read = match from.read(&mut piece) {
            Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
            read => read.map_err(&failed)?,
        };
        let Some(bytes) = piece.get(..read).filter(|bytes| !bytes.is_empty()) else {
            let sha256 = hex::encode(hash.finalize());
            return Ok(StoredFile { size, sha256 });
        };
        hash.update(bytes);
        size = size.saturating_add(bytes.len() as u64);
        each(bytes)?;
    }
}

/// A file of the agent's that can't be read: by its own fault, or the node's.
fn unreadable(path: &str, error: TreeError) -> CollectError {
    if error.is_the_writers() {
        refused(path, &error)
    } else {
        volume(&format!("{SUBMISSION_FOLDER}/{path}"), error)
    }
}

fn refused(path: &str, why: &dyn std::error::Error) -> CollectError {
    let (file, why) = (one_line(path, SHOWN), why.to_string());
    CollectError::File { file, why }
}

fn volume(path: &str, error: TreeError) -> CollectError {
    let path = one_line(path, SHOWN);
    CollectError::Volume { path, error }
}

#[cfg(test)]
mod tests;
