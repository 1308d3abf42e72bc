//! The direction of a ranking.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Direction in which a metric ranks.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum Order {
    /// The lowest value leads.
    Ascending,
    /// The highest value leads.
    #[default]
    Descending,
}

impl Order {
    /// Its name in the status.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Ascending => "Ascending",
            Self::Descending => "Descending",
        }
    }
}
