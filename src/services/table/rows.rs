//! All rows of the table, as they are stored: for people who make Submissions from them. The operator itself reads none.

use std::collections::{BTreeMap, HashMap};

use aws_sdk_dynamodb::types::AttributeValue;

use super::{ATTEMPT, Table, TableError, failed};

/// A row as it is stored.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct StoredRow {
    /// Id of the team.
    pub team_id: String,
    /// Id of the run.
    pub run_id: String,
    /// The attempt that this operator has written; none of another pipeline.
    pub attempt: Option<i64>,
    /// All other columns with a text or a number.
    pub columns: BTreeMap<String, String>,
}

impl StoredRow {
    /// A column's text. The original writes `-` for a time that is not known.
    pub fn text(&self, column: &str) -> Option<&str> {
        let text = self.columns.get(column)?.trim();
        (!text.is_empty() && text != "-").then_some(text)
    }
}

impl Table {
    /// Reads all rows.
    pub async fn rows(&self) -> Result<Vec<StoredRow>, TableError> {
        let (mut rows, mut next) = (Vec::new(), None);
        loop {
            let request = self.client.scan().table_name(&self.name).consistent_read(true);
            let request = request.set_exclusive_start_key(next).send();
            let answer = self.meter.aws("dynamodb", "Scan", request).await;
            let answer = answer.map_err(|error| failed(&self.name, "Scan", &error))?;
            let items = answer.items.unwrap_or_default().into_iter();
            rows.extend(items.map(|item| self.stored(item)));
            next = answer.last_evaluated_key.filter(|key| !key.is_empty());
            if next.is_none() {
                return Ok(rows);
            }
        }
    }

    fn stored(&self, item: HashMap<String, AttributeValue>) -> StoredRow {
        let text = |value| match value {
            AttributeValue::S(text) | AttributeValue::N(text) => Some(text),
            _ => None,
        };
        let columns = item.into_iter().filter_map(|(name, value)| Some((name, text(value)?)));
        let mut columns: BTreeMap<String, String> = columns.collect();
        let attempt = columns.remove(ATTEMPT);
        StoredRow {
            team_id: columns.remove(&self.partition.name).unwrap_or_default(),
            run_id: columns.remove(&self.sort.name).unwrap_or_default(),
            attempt: attempt.and_then(|attempt| attempt.parse().ok()),
            columns,
        }
    }
}
