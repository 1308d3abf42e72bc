//! The tables whose keys are known, so that each is described once.

use std::sync::Mutex;

use super::{ObservedRow, Row, Table, TableError, Written};
use crate::clients::Aws;
use leaderboard_api as api;
use leaderboard_base::lock::lock;

/// Reads and writes rows of any table.
pub struct Tables {
    aws: Aws,
    known: Mutex<Vec<(api::DynamoTable, Table)>>,
}

impl Tables {
    pub fn new(aws: Aws) -> Self {
        Self {
            aws,
            known: Mutex::default(),
        }
    }

    /// Writes a row, unless the table holds a later one. Safe twice.
    pub async fn write(&self, table: &api::DynamoTable, row: &Row) -> Result<Written, TableError> {
        let written = self.described(table).await?.write(row).await;
        self.noted(table, written)
    }

    /// The row of a submission; none if there is none.
    pub async fn read(
        &self,
        table: &api::DynamoTable,
        team: &str,
        run_id: &str,
    ) -> Result<Option<ObservedRow>, TableError> {
        let read = self.described(table).await?.read(team, run_id).await;
        self.noted(table, read)
    }

    async fn described(&self, table: &api::DynamoTable) -> Result<Table, TableError> {
        let is_known = |(known, _): &&(api::DynamoTable, Table)| known == table;
        let found = lock(&self.known).iter().find(is_known).cloned();
        if let Some((_, described)) = found {
            return Ok(described);
        }
        let described = Table::describe(&self.aws, table).await?;
        lock(&self.known).push((table.clone(), described.clone()));
        Ok(described)
    }

    /// A table that refuses may have been made again with other keys.
    fn noted<T>(&self, table: &api::DynamoTable, answer: Result<T, TableError>) -> Result<T, TableError> {
        if matches!(answer, Err(TableError::Missing { .. } | TableError::Refused { .. })) {
            lock(&self.known).retain(|(known, _)| known != table);
        }
        answer
    }
}
