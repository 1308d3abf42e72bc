//! One object on its way to S3: from memory, or a file piece by piece.
//!
//! Called by [`super::send`]. Nothing here decides what is stored.

use std::fs::File;
use std::future::Future;
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::wanted::Wanted;
use super::{Decision, Stored, fingerprint};
use crate::blocking;
use crate::daily::Spent;
use leaderboard_aws::archive::{Archive, ArchiveError, Cause, Kept, MIN_PART, PART, read_range};
use leaderboard_evaluation::Object;
use leaderboard_evidence::{Stamp, Tree, TreeError};

/// Time to abort an upload that was cut.
const ABORTING: Duration = Duration::from_secs(10);

/// Outcome of one file.
pub(super) enum Outcome {
    /// It is stored, and was sent if that is true.
    Stored(Box<Stored>, bool),
    /// It can't be read.
    LeftOut(String),
    /// It took too long.
    Slow,
    /// S3.
    Failed(ArchiveError),
    /// It was not begun.
    Late,
}

/// Stores an object of memory. `known` is the entity tag of what was stored last.
pub(super) async fn put(
    archive: Archive,
    key: String,
    object: Object,
    known: Option<String>,
    now: Duration,
) -> (String, Outcome) {
    let Object { bytes, digest } = object;
    let outcome = match archive.replace(&key, bytes, known.as_deref()).await {
        Ok(etag) => {
            let stored = Stored {
                etag,
                fingerprint: digest.sha256,
                at: now,
                ..Stored::unknown(digest.size)
            };
            Outcome::Stored(Box::new(stored), true)
        }
        Err(error) => Outcome::Failed(error),
    };
    (key, outcome)
}

/// One file on its way.
pub(super) struct Job {
    pub(super) archive: Archive,
    pub(super) tree: Arc<Tree>,
    /// With as many bytes as it may have.
    pub(super) wanted: Wanted,
    /// True if it has more.
    pub(super) is_shortened: bool,
    pub(super) decision: Decision,
    pub(super) known: Option<Stored>,
    pub(super) now: Duration,
    /// Purse that pays for it.
    pub(super) purse: String,
    pub(super) cost: Spent,
}

/// A file that is open, and the fingerprint of its beginning.
struct Opened {
    file: Arc<File>,
    stamp: Stamp,
    fingerprint: String,
    /// Fingerprint of as many bytes as were stored before.
    of_known: String,
}

impl Opened {
    /// None if there is no such file. If the file has grown since it was counted, only the counted bytes are there: the
    /// next round counts and sends the others.
    fn open(tree: &Tree, path: &str, known_size: u64, counted: u64) -> Result<Option<Self>, TreeError> {
        let Some((file, found)) = tree.file(path)? else {
            return Ok(None);
        };
        let stamp = Stamp {
            size: found.size.min(counted),
            ..found
        };
        Ok(Some(Self {
            of_known: fingerprint(&file, known_size.min(stamp.size))?,
            fingerprint: fingerprint(&file, stamp.size)?,
            file: Arc::new(file),
            stamp,
        }))
    }
}

#[derive(thiserror::Error, Debug)]
enum Problem {
    #[error(transparent)]
    Local(#[from] TreeError),
    #[error(transparent)]
    Archive(#[from] ArchiveError),
}

impl Job {
    /// Stores it, unless that takes longer than until `cut_at`.
    pub(super) async fn store(&self, cut_at: Option<Instant>) -> Outcome {
        // The upload itself is cut in time to abort it; this is for a request that does not end.
        let longest = cut_at.and_then(|cut_at| cut_at.checked_add(ABORTING));
        match in_time(longest, Box::pin(self.send(cut_at))).await {
            None => Outcome::Slow,
            Some(Ok(outcome)) => outcome,
            Some(Err(Problem::Local(error))) => Outcome::LeftOut(error.to_string()),
            Some(Err(Problem::Archive(error))) => match error.cause {
                Cause::Slow => Outcome::Slow,
                // The file shrank meanwhile; the next round finds what it became.
                Cause::Local(_) | Cause::Parts(_) => Outcome::LeftOut(error.cause.to_string()),
                _ => Outcome::Failed(error),
            },
        }
    }

    /// Sends the first bytes of the file, as many as it had when it was opened, and no more than were counted.
    async fn send(&self, cut_at: Option<Instant>) -> Result<Outcome, Problem> {
        let known_size = self.known.as_ref().map_or(0, |known| known.stamp.size);
        let (tree, path) = (Arc::clone(&self.tree), self.wanted.path.clone());
        let counted = self.wanted.stamp.size;
        let opened = blocking(move || Opened::open(&tree, &path, known_size, counted)).await?;
        let Some(opened) = opened else {
            return Ok(Outcome::LeftOut("it is gone".to_owned()));
        };
        let (file, stamp) = (&opened.file, opened.stamp);
        let stored = |etag| {
            let (fingerprint, at) = (opened.fingerprint.clone(), self.now);
            Box::new(Stored {
                stamp,
                etag,
                fingerprint,
                at,
            })
        };
        let prefix = self.known.as_ref();
        let prefix = prefix.filter(|known| known_size <= stamp.size && known.fingerprint == opened.of_known);
        if let Some(known) = prefix.filter(|_| known_size == stamp.size && stamp.size < MIN_PART) {
            // Touched, or written again with the same content.
            return Ok(Outcome::Stored(stored(known.etag.clone()), false));
        }
        let etag = prefix.and_then(|known| known.etag.as_deref());
        let kept = match self.decision {
            Decision::Append { from } if from == known_size => etag.map(|etag| Kept { etag, size: from }),
            _ => None,
        };
        let key = &self.wanted.key;
        let etag = if kept.is_none() && stamp.size <= PART {
            let bytes = read_range(file, 0..stamp.size).await.map_err(TreeError::from)?;
            match in_time(cut_at, self.archive.put(key, bytes)).await {
                Some(stored) => stored?,
                None => return Ok(Outcome::Slow),
            }
        } else {
            self.archive.upload(key, file, kept, stamp.size, cut_at).await?
        };
        Ok(Outcome::Stored(stored(etag), true))
    }
}

/// Output of the work; `None` if it takes longer than until then.
pub(super) async fn in_time<T>(until: Option<Instant>, work: impl Future<Output = T>) -> Option<T> {
    match until {
        Some(until) => tokio::time::timeout_at(until.into(), work).await.ok(),
        None => Some(work.await),
    }
}
