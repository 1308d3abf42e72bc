//! Stores files by the rules of the parent module: a few at a time, at most one part of each in memory.
//!
//! Called by `logcopy`. A file that can't be read is left out and named; only S3's own failures end a round.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use futures::StreamExt;

use super::{Decision, Haste, Memory, Object, Stored, decide_upload, fingerprint};
use crate::pod::blocking;
use crate::pod::tree::{Stamp, Tree, TreeError};
use crate::services::archive::{Archive, ArchiveError, Cause, Kept, MIN_PART, PART, read_range};

/// Files in the air at once.
const AT_ONCE: usize = 4;

/// A file that is to be stored.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Wanted {
    /// Its key below the run's prefix.
    pub key: String,
    /// Its path below the volume's root.
    pub path: String,
    /// As it was found.
    pub stamp: Stamp,
    /// How soon.
    pub haste: Haste,
}

impl Wanted {
    /// A file whose key is its path.
    pub fn new(path: &str, stamp: Stamp, haste: Haste) -> Self {
        Self {
            key: path.to_owned(),
            path: path.to_owned(),
            stamp,
            haste,
        }
    }
}

/// What became of one round of files.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Sent {
    /// Objects written.
    pub objects: usize,
    /// Files that were due when the time was over.
    pub late: usize,
    /// Files that could not be read, or did not fit into the limit.
    pub left_out: usize,
}

/// Stores the files of one run.
#[derive(Debug)]
pub struct Uploader {
    archive: Archive,
    tree: Arc<Tree>,
    memory: Memory,
    limit: u64,
    epoch: Instant,
    complained: BTreeSet<String>,
}

/// What became of one file.
enum Outcome {
    Stored(Box<Stored>, bool),
    LeftOut(String),
    Failed(ArchiveError),
    Late,
}

impl Uploader {
    /// With the memory of what an earlier program of this Pod stored. `limit`: bytes the run may store.
    pub fn new(archive: Archive, tree: Arc<Tree>, limit: u64) -> Self {
        Self {
            memory: Memory::load(&tree),
            archive,
            tree,
            limit,
            epoch: Instant::now(),
            complained: BTreeSet::new(),
        }
    }

    /// What is stored.
    pub fn memory(&self) -> &Memory {
        &self.memory
    }

    /// Stores results that are in memory, each that is not what is stored already. They are stored even beyond the limit: what
    /// is in memory is bounded.
    pub async fn put(&mut self, objects: &BTreeMap<String, Object>) -> Result<Sent, ArchiveError> {
        let now = self.epoch.elapsed();
        let is_stored = |key: &String, object: &Object| {
            let known = self.memory.0.get(key);
            known.is_some_and(|known| {
                known.stamp.size == object.digest.size && known.fingerprint == object.digest.sha256
            })
        };
        let jobs: Vec<Put> = objects
            .iter()
            .filter(|(key, object)| !is_stored(key, object))
            .map(|(key, object)| Put {
                archive: self.archive.clone(),
                key: key.clone(),
                object: object.clone(),
                known: self.memory.0.get(key).and_then(|known| known.etag.clone()),
                now,
            })
            .collect();
        let work = jobs.into_iter().map(Put::store);
        let outcomes = futures::stream::iter(work).buffer_unordered(AT_ONCE).collect().await;
        let mut sent = Sent::default();
        let failed = self.settle(outcomes, &mut sent);
        if sent.objects > 0 || failed.is_some() {
            self.remember().await;
        }
        failed.map_or(Ok(sent), Err)
    }

    /// Stores what is due, in the order given as far as several at once allow. After `until` no file is begun. The first
    /// failure of S3 ends it; what was stored until then is remembered.
    pub async fn sync(&mut self, files: &[Wanted], until: Option<Instant>) -> Result<Sent, ArchiveError> {
        let (jobs, left_out) = self.due(files);
        let mut sent = Sent {
            left_out: left_out.len(),
            ..Sent::default()
        };
        self.complain(&left_out);
        // What is in the air comes to its end, so that it is remembered; nothing new is begun.
        let broken = Arc::new(AtomicBool::new(false));
        let work = jobs.into_iter().map(|job| {
            let broken = Arc::clone(&broken);
            async move {
                if broken.load(Ordering::Relaxed) || until.is_some_and(|until| Instant::now() >= until) {
                    return (job.wanted.key, Outcome::Late);
                }
                let outcome = job.store().await;
                if matches!(outcome, Outcome::Failed(_)) {
                    broken.store(true, Ordering::Relaxed);
                }
                (job.wanted.key, outcome)
            }
        });
        let outcomes = futures::stream::iter(work).buffer_unordered(AT_ONCE).collect().await;
        let failed = self.settle(outcomes, &mut sent);
        if sent.objects > 0 || failed.is_some() {
            self.remember().await;
        }
        failed.map_or(Ok(sent), Err)
    }

    /// Takes in what became of the files. Returns S3's failure, if there was one.
    fn settle(&mut self, outcomes: Vec<(String, Outcome)>, sent: &mut Sent) -> Option<ArchiveError> {
        let (mut complaints, mut failed) = (BTreeMap::new(), None);
        for (key, outcome) in outcomes {
            match outcome {
                Outcome::Stored(stored, written) => {
                    sent.objects = sent.objects.saturating_add(usize::from(written));
                    self.memory.0.insert(key, *stored);
                }
                Outcome::LeftOut(why) => {
                    sent.left_out = sent.left_out.saturating_add(1);
                    complaints.insert(key, why);
                }
                Outcome::Late => sent.late = sent.late.saturating_add(1),
                Outcome::Failed(error) => {
                    if matches!(error.cause, Cause::Changed) {
                        // Another writer's object: it is written whole the next time.
                        self.memory.0.remove(&key);
                    }
                    failed = Some(error);
                }
            }
        }
        self.complain(&complaints);
        failed
    }

    /// The files that are due and fit, and why the others don't.
    fn due(&self, files: &[Wanted]) -> (Vec<Job>, BTreeMap<String, String>) {
        let now = self.epoch.elapsed();
        let mut used = self.memory.bytes();
        let (mut jobs, mut left_out, mut keys) = (Vec::new(), BTreeMap::new(), BTreeSet::new());
        for file in files {
            // Two files under one key would overwrite each other in any order.
            if !keys.insert(file.key.as_str()) {
                left_out.insert(file.key.clone(), "another file has the same key".to_owned());
                continue;
            }
            let known = self.memory.0.get(&file.key);
            let decision = decide_upload(&file.stamp, known, now, file.haste);
            if decision == Decision::Keep {
                continue;
            }
            let before = known.map_or(0, |known| known.stamp.size);
            let after = used.saturating_sub(before).saturating_add(file.stamp.size);
            if after > self.limit && after > used {
                let why = format!("storage.sizeLimit of {} bytes is reached", self.limit);
                left_out.insert(file.key.clone(), why);
                continue;
            }
            used = after;
            jobs.push(Job {
                archive: self.archive.clone(),
                tree: Arc::clone(&self.tree),
                wanted: file.clone(),
                decision,
                known: known.cloned(),
                now,
            });
        }
        (jobs, left_out)
    }

    /// Logs once per file why it is left out.
    fn complain(&mut self, left_out: &BTreeMap<String, String>) {
        for (key, why) in left_out {
            if self.complained.len() < 1000 && self.complained.insert(key.clone()) {
                tracing::warn!(file = %key, "not stored: {why}");
            }
        }
    }

    async fn remember(&self) {
        let (memory, tree) = (self.memory.clone(), Arc::clone(&self.tree));
        let saved = blocking(move || memory.save(&tree)).await;
        if let Err(error) = saved.map_err(TreeError::from).flatten() {
            tracing::warn!("what is stored can't be noted down, a restart will send it again: {error}");
        }
    }
}

/// One object of memory on its way.
struct Put {
    archive: Archive,
    key: String,
    object: Object,
    /// Entity tag of what was stored last.
    known: Option<String>,
    now: Duration,
}

impl Put {
    async fn store(self) -> (String, Outcome) {
        let Object { bytes, digest } = self.object;
        let outcome = match self.archive.replace(&self.key, bytes, self.known.as_deref()).await {
            Ok(etag) => {
                let stamp = Stamp {
                    size: digest.size,
                    ..Stamp::default()
                };
                let stored = Stored {
                    stamp,
                    etag,
                    fingerprint: digest.sha256,
                    at: self.now,
                };
                Outcome::Stored(Box::new(stored), true)
            }
            Err(error) => Outcome::Failed(error),
        };
        (self.key, outcome)
    }
}

/// One file on its way.
struct Job {
    archive: Archive,
    tree: Arc<Tree>,
    wanted: Wanted,
    decision: Decision,
    known: Option<Stored>,
    now: Duration,
}

/// A file that is open, and the fingerprint of its beginning.
struct Opened {
    file: Arc<File>,
    stamp: Stamp,
    fingerprint: String,
    /// Of as many bytes as were stored before.
    of_known: String,
}

impl Opened {
    /// None if there is no such file. Of one that has grown since it was counted, no more than the counted bytes are there: the
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

enum Problem {
    Local(TreeError),
    Archive(ArchiveError),
}

impl From<std::io::Error> for Problem {
    fn from(error: std::io::Error) -> Self {
        Self::Local(error.into())
    }
}

impl From<TreeError> for Problem {
    fn from(error: TreeError) -> Self {
        Self::Local(error)
    }
}

impl From<ArchiveError> for Problem {
    fn from(error: ArchiveError) -> Self {
        Self::Archive(error)
    }
}

impl Job {
    async fn store(&self) -> Outcome {
        match self.send().await {
            Ok(fate) => fate,
            Err(Problem::Local(error)) => Outcome::LeftOut(error.to_string()),
            Err(Problem::Archive(error)) => match error.cause {
                // The file shrank meanwhile; the next round finds what it became.
                Cause::Local(_) | Cause::Parts(_) => Outcome::LeftOut(error.cause.to_string()),
                _ => Outcome::Failed(error),
            },
        }
    }

    /// Sends the first bytes of the file, as many as it had when it was opened, and no more than were counted.
    async fn send(&self) -> Result<Outcome, Problem> {
        let known_size = self.known.as_ref().map_or(0, |known| known.stamp.size);
        let (tree, path) = (Arc::clone(&self.tree), self.wanted.path.clone());
        let counted = self.wanted.stamp.size;
        let opened = blocking(move || Opened::open(&tree, &path, known_size, counted)).await??;
        let Some(opened) = opened else {
            return Ok(Outcome::LeftOut("it is gone".to_owned()));
        };
        let Opened {
            file,
            stamp,
            fingerprint,
            of_known,
        } = opened;
        let stored = |etag| {
            Box::new(Stored {
                stamp,
                etag,
                fingerprint: fingerprint.clone(),
                at: self.now,
            })
        };
        let prefix = self.known.as_ref();
        let prefix = prefix.filter(|known| known_size <= stamp.size && known.fingerprint == of_known);
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
            let bytes = read_range(&file, 0..stamp.size).await?;
            self.archive.put(key, bytes).await?
        } else {
            self.archive.upload(key, &file, kept, stamp.size).await?
        };
        Ok(Outcome::Stored(stored(etag), true))
    }
}
