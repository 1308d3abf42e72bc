//! The list of what `collect` has copied for the evaluators: `logcopy/collected.json`. Pure.
//!
//! `collect` writes it last, `logcopy` stores it, and `workspace` of a later Pod restores the files of it and no others.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::report::StoredFile;

/// Version of the list.
pub const SCHEMA: u32 = 1;
/// Largest list that is read, in bytes: of 10,000 files with the longest paths.
pub const MAX_BYTES: u64 = 16 << 20;

/// Files that the evaluators find at `/input`.
#[derive(Serialize, Deserialize, Clone, Debug, PartialEq, Eq)]
pub struct Collected {
    /// [`SCHEMA`].
    pub schema: u32,
    /// By path below `/input`.
    pub files: BTreeMap<String, StoredFile>,
}

impl Collected {
    /// A list of this version.
    pub fn new(files: BTreeMap<String, StoredFile>) -> Self {
        Self { schema: SCHEMA, files }
    }

    /// The JSON that is stored.
    pub fn to_json(&self) -> Vec<u8> {
        serde_json::to_vec(self).unwrap_or_default()
    }

    /// Reads a list; `None` for one of an unknown version, which no Pod of this version wrote.
    pub fn parse(bytes: &[u8]) -> Option<Self> {
        let list: Self = serde_json::from_slice(bytes).ok()?;
        (list.schema == SCHEMA).then_some(list)
    }

    /// Bytes of all files.
    pub fn bytes(&self) -> u64 {
        self.files.values().map(|file| file.size).fold(0, u64::saturating_add)
    }
}
