//! The service that an answer may have to wait for.

use std::fmt;

use leaderboard_api::{Storage, Table};

/// Something that may hang: an endpoint of the host's own hangs with all that it has, a bucket or table of AWS alone.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct Service(String);

impl Service {
    /// The bucket of a run.
    pub fn bucket(storage: &Storage) -> Self {
        Self::of(
            "bucket",
            storage.endpoint.as_deref(),
            storage.region.as_deref(),
            &storage.bucket,
        )
    }

    /// A table of rows.
    pub fn table(table: &Table) -> Self {
        Self::of("table", table.endpoint.as_deref(), table.region.as_deref(), &table.name)
    }

    fn of(kind: &str, endpoint: Option<&str>, region: Option<&str>, name: &str) -> Self {
        Self(match (endpoint, region) {
            (Some(endpoint), _) => endpoint.to_owned(),
            (None, Some(region)) => format!("{kind} {name} in {region}"),
            (None, None) => format!("{kind} {name}"),
        })
    }
}

/// For people.
impl fmt::Display for Service {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}
