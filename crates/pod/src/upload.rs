//! When which file is stored: the rules, and the memory of what is stored already.
//!
//! `decide_upload` is pure. [`send::Uploader`] carries it out; `logcopy` calls that each round, `workspace` fills the memory
//! with what it restored. [`quota`] decides how much may be stored and sent. Nothing here lists the bucket: what is stored is remembered next to the files, so that a restarted
//! logcopy does not send everything again.

pub mod complaints;
mod job;
pub mod quota;
pub mod send;
pub mod wanted;

use std::collections::BTreeMap;
use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt;
use std::time::Duration;

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::daily::Daily;
use leaderboard_aws::archive::MIN_PART;
use leaderboard_evidence::{Stamp, Tree, TreeError};

/// A changed file that is not otherwise due is stored this long after the last time.
const AT_LEAST_EVERY: Duration = Duration::from_mins(1);
/// Growth of a large file that is worth the four requests of an append.
const WORTH_APPENDING: u64 = 1 << 20;
/// Bytes read at each end of a large file to check that it only grew.
const WINDOW: u64 = 64 << 10;
/// Where the memory lies on the `logs` volume.
const MEMORY: &str = "logcopy/.stored.json";
/// Largest memory that is read back, in bytes.
const MEMORY_LIMIT: u64 = 64 << 20;

/// A stored object, as far as it is known.
#[derive(Serialize, Deserialize, Clone, Debug, PartialEq, Eq)]
pub struct Stored {
    /// The file as it was when it was stored.
    pub stamp: Stamp,
    /// The object's entity tag, if S3 gave one.
    pub etag: Option<String>,
    /// Fingerprint of the stored bytes; see [`fingerprint`].
    pub fingerprint: String,
    /// When, on the clock of this process; zero for what an earlier one stored.
    #[serde(skip)]
    pub at: Duration,
}

impl Stored {
    /// An object of which only the size is known: it counts, and is replaced by whatever is to be stored there.
    pub fn unknown(size: u64) -> Self {
        Self {
            stamp: Stamp {
                size,
                ..Stamp::default()
            },
            etag: None,
            fingerprint: String::new(),
            at: Duration::ZERO,
        }
    }

    fn is_unknown(&self) -> bool {
        self.stamp.inode == 0 && self.etag.is_none() && self.fingerprint.is_empty()
    }
}

/// Decision on a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Decision {
    /// Nothing, for now.
    Keep,
    /// All of it is sent.
    PutWhole,
    /// The stored part is kept, and the rest after this byte is sent, provided that the beginning is still the same.
    Append {
        /// First byte to send.
        from: u64,
    },
}

/// How soon a changed file is stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Haste {
    /// In the round in which it is found: results, and everything at the end.
    Now,
    /// When it has grown enough, or a minute after the last time: logs.
    Soon,
}

/// Decides on a file. `now` is on the clock of [`Stored::at`].
pub fn decide_upload(found: &Stamp, stored: Option<&Stored>, now: Duration, haste: Haste) -> Decision {
    let Some(stored) = stored.filter(|stored| !stored.is_unknown()) else {
        return Decision::PutWhole;
    };
    let before = &stored.stamp;
    if found == before {
        return Decision::Keep;
    }
    let is_due = haste == Haste::Now || now.saturating_sub(stored.at) >= AT_LEAST_EVERY;
    let may_append = found.inode == before.inode && before.size >= MIN_PART && stored.etag.is_some();
    if may_append && found.size > before.size {
        return if is_due || found.size.saturating_sub(before.size) >= WORTH_APPENDING {
            Decision::Append { from: before.size }
        } else {
            Decision::Keep
        };
    }
    let has_doubled = found.size > before.size && found.size / 2 >= before.size;
    if is_due || has_doubled {
        Decision::PutWhole
    } else {
        Decision::Keep
    }
}

/// Shows whether the first `len` bytes of a file are what they were: a digest of all of them, or of both ends where that
/// would be too much to read each round.
pub fn fingerprint(file: &File, len: u64) -> io::Result<String> {
    let mut digest = Sha256::new();
    if len <= MIN_PART {
        hash_range(&mut digest, file, 0, len)?;
    } else {
        hash_range(&mut digest, file, 0, WINDOW)?;
        hash_range(&mut digest, file, len.saturating_sub(WINDOW), WINDOW)?;
    }
    Ok(hex::encode(digest.finalize()))
}

fn hash_range(digest: &mut Sha256, file: &File, from: u64, len: u64) -> io::Result<()> {
    let mut bytes = vec![0; usize::try_from(len).map_err(io::Error::other)?];
    file.read_exact_at(&mut bytes, from)?;
    digest.update(&bytes);
    Ok(())
}

/// Stored objects, and today's requests and bytes.
#[derive(Serialize, Deserialize, Clone, Debug, Default, PartialEq, Eq)]
pub struct Memory {
    /// By key.
    pub stored: BTreeMap<String, Stored>,
    /// Requests and bytes, by purse.
    pub sent: Daily,
}

impl Memory {
    /// Memory that an earlier program of this Pod left; none if that can't be read, which costs one upload of everything.
    pub fn load(tree: &Tree) -> Self {
        let read = tree.read(MEMORY, MEMORY_LIMIT).ok().flatten();
        let memory = read.and_then(|(bytes, _)| serde_json::from_slice(&bytes).ok());
        memory.unwrap_or_default()
    }

    /// Leaves it for the next program of this Pod.
    pub fn save(&self, tree: &Tree) -> Result<(), TreeError> {
        let bytes = serde_json::to_vec(self).map_err(io::Error::other)?;
        tree.write(MEMORY, &bytes)
    }

    /// Bytes that are stored.
    pub fn bytes(&self) -> u64 {
        let sizes = self.stored.values().map(|stored| stored.stamp.size);
        sizes.fold(0, u64::saturating_add)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MIB: u64 = 1 << 20;

    fn stamp(size: u64) -> Stamp {
        Stamp {
            size,
            mtime: (i64::try_from(size).unwrap(), 0),
            inode: 7,
        }
    }

    fn stored(size: u64) -> Stored {
        Stored {
            stamp: stamp(size),
            etag: Some("tag".to_owned()),
            fingerprint: String::new(),
            at: Duration::from_secs(100),
        }
    }

    #[test]
    fn each_rule_of_the_table() {
        use Haste::{Now, Soon};
        const KEEP: Decision = Decision::Keep;
        const WHOLE: Decision = Decision::PutWhole;
        const PART: u64 = MIN_PART;
        let append = |from| Decision::Append { from };
        // Name, stored bytes, bytes now, seconds since it was stored, haste.
        let table = [
            ("unchanged", 9, 9, 60, Now, KEEP),
            ("grew a little", 10, 19, 10, Soon, KEEP),
            ("doubled", 10, 20, 10, Soon, WHOLE),
            ("first bytes", 0, 1, 10, Soon, WHOLE),
            ("a minute later", 10, 11, 60, Soon, WHOLE),
            ("at the end", 10, 11, 10, Now, WHOLE),
            ("shrunk", 10, 9, 10, Soon, KEEP),
            ("shrunk, due", 10, 9, 60, Soon, WHOLE),
            ("large, grew a little", PART, PART + MIB - 1, 10, Soon, KEEP),
            ("large, grew enough", PART, PART + MIB, 10, Soon, append(PART)),
            ("large, due", PART, PART + 1, 60, Soon, append(PART)),
            ("large, at the end", PART, PART + 1, 10, Now, append(PART)),
            ("stored is no part", PART - 1, 50 * MIB, 10, Soon, WHOLE),
            ("large, shrunk", 9 * MIB, PART, 60, Soon, WHOLE),
        ];
        for (name, before, after, seconds, haste, expected) in table {
            let known = stored(before);
            let now = known.at + Duration::from_secs(seconds);
            assert_eq!(
                decide_upload(&stamp(after), Some(&known), now, haste),
                expected,
                "{name}"
            );
        }
        for stored in [None, Some(&Stored::unknown(0))] {
            assert_eq!(decide_upload(&stamp(0), stored, Duration::ZERO, Soon), WHOLE);
        }
    }

    #[test]
    fn another_file_of_the_same_name_is_not_appended_to() {
        let found = Stamp {
            inode: 8,
            ..stamp(50 * MIB)
        };
        let decision = decide_upload(&found, Some(&stored(6 * MIB)), Duration::ZERO, Haste::Now);
        assert_eq!(decision, Decision::PutWhole);
    }

    #[test]
    fn an_object_without_a_tag_is_not_appended_to() {
        let untagged = Stored {
            etag: None,
            ..stored(6 * MIB)
        };
        let decision = decide_upload(&stamp(9 * MIB), Some(&untagged), Duration::ZERO, Haste::Now);
        assert_eq!(decision, Decision::PutWhole);
    }

    #[test]
    fn the_fingerprint_sees_a_changed_beginning_and_end() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("log");
        let len = 6 * MIB;
        std::fs::write(&path, vec![b'a'; usize::try_from(len + 10).unwrap()]).unwrap();
        let file = File::options().read(true).write(true).open(&path).unwrap();
        let before = fingerprint(&file, len).unwrap();
        for (at, same) in [(len, true), (len - 1, false), (0, false)] {
            file.write_all_at(b"b", at).unwrap();
            assert_eq!(fingerprint(&file, len).unwrap() == before, same, "byte {at}");
            file.write_all_at(b"a", at).unwrap();
        }
        let small = fingerprint(&file, 3).unwrap();
        file.write_all_at(b"b", 1).unwrap();
        assert_ne!(fingerprint(&file, 3).unwrap(), small);
        assert!(fingerprint(&file, len + 11).is_err());
    }

    #[test]
    fn the_memory_survives_a_restart_and_bad_bytes() {
        let folder = tempfile::tempdir().unwrap();
        let tree = Tree::open(folder.path()).unwrap();
        assert_eq!(Memory::load(&tree), Memory::default());
        let memory = Memory {
            stored: BTreeMap::from([("a/b".to_owned(), stored(5))]),
            ..Memory::default()
        };
        memory.save(&tree).unwrap();
        let loaded = Memory::load(&tree);
        assert_eq!(loaded.stored["a/b"].stamp, stamp(5));
        assert_eq!((loaded.bytes(), loaded.stored["a/b"].at), (5, Duration::ZERO));
        tree.write(MEMORY, b"{").unwrap();
        assert_eq!(Memory::load(&tree), Memory::default());
    }
}
