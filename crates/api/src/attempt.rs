//! The number of an attempt of a submission.
//!
//! Pure.

use std::fmt;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Number of an attempt. It counts within one object; the number in a row of the table counts those of earlier objects as well.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[serde(transparent)]
#[schemars(inline)]
pub struct Attempt(pub i64);

impl Attempt {
    /// The one that a new Submission begins with.
    pub const FIRST: Self = Self(1);
    /// The highest that `spec.attempt` takes.
    pub const HIGHEST: Self = Self(9999);

    /// The one after it.
    #[must_use]
    pub fn next(self) -> Self {
        Self(self.0.saturating_add(1))
    }
}

impl Default for Attempt {
    fn default() -> Self {
        Self::FIRST
    }
}

impl fmt::Display for Attempt {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(out)
    }
}
