//! Reads the row of one submission: who has written it, and how it stands.

use std::collections::HashMap;

use aws_sdk_dynamodb::types::AttributeValue;

use super::{ATTEMPT, STATUS, Table, TableError, failed};
use crate::metered::Metered;

/// Column with the start of a run, `-` before it.
const START: &str = "start_time";
/// Column with the time of the submission.
const SUBMITTED: &str = "submitted_time";

/// Row of a submission.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ObservedRow {
    /// As it is stored: anyone who may write to the table may have put any text there.
    pub status: String,
    /// It has the column that only this operator writes.
    pub is_ours: bool,
    /// Since when, as it is stored: the start of the run, else the time of the submission.
    pub since: Option<String>,
}

impl Table {
    /// The row of a submission; none if there is none.
    pub async fn read(&self, team_id: &str, run_id: &str) -> Result<Option<ObservedRow>, TableError> {
        let request = self
            .client
            .get_item()
            .table_name(&self.name)
            .key(&self.partition.name, self.partition.value(&self.name, team_id, "team")?)
            .key(&self.sort.name, self.sort.value(&self.name, run_id, "submission")?)
            .consistent_read(true)
            .projection_expression("#attempt, #status, #start, #submitted")
            .expression_attribute_names("#attempt", ATTEMPT)
            .expression_attribute_names("#status", STATUS)
            .expression_attribute_names("#start", START)
            .expression_attribute_names("#submitted", SUBMITTED);
        let answer = self.meter.aws("dynamodb", "GetItem", request.send()).await;
        let output = answer.map_err(|error| failed(&self.name, "GetItem", &error))?;
        Ok(output.item.as_ref().map(row))
    }
}

fn row(item: &HashMap<String, AttributeValue>) -> ObservedRow {
    let text = |column: &str| item.get(column).and_then(|value| value.as_s().ok()).cloned();
    let time = |column: &str| text(column).filter(|text| !text.is_empty() && text != "-");
    ObservedRow {
        status: text(STATUS).unwrap_or_default(),
        is_ours: item.contains_key(ATTEMPT),
        since: time(START).or_else(|| time(SUBMITTED)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_row_shows_its_writer_its_status_and_since_when() {
        let item = |columns: &[(&str, &str)]| {
            let of = |(column, text): &(&str, &str)| ((*column).to_owned(), AttributeValue::S((*text).to_owned()));
            columns.iter().map(of).collect::<HashMap<_, _>>()
        };
        let submitted = row(&item(&[(STATUS, "SUBMITTED"), (START, "-"), (SUBMITTED, "monday")]));
        assert_eq!(
            (submitted.status.as_str(), submitted.since.as_deref()),
            ("SUBMITTED", Some("monday"))
        );
        assert!(!submitted.is_ours);
        let running = row(&item(&[(STATUS, "RUNNING"), (START, "tuesday"), (SUBMITTED, "monday")]));
        assert_eq!(running.since.as_deref(), Some("tuesday"));
        let mut ours = item(&[(STATUS, "RUNNING")]);
        ours.insert(ATTEMPT.to_owned(), AttributeValue::N("1".to_owned()));
        assert!(row(&ours).is_ours);
        assert_eq!(row(&HashMap::new()), ObservedRow::default());
    }
}
