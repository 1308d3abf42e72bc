//! Trial of a table's rights: an update whose condition never holds, so that nothing is written.

use aws_sdk_dynamodb::operation::update_item::UpdateItemError;

use super::{Row, Table, TableError, failed};
use crate::metered::Metered;

/// No row fulfils it, so nothing is written; DynamoDB looks at the right to write before it looks at the condition.
const NEVER: &str = "attribute_exists(#attempt) AND attribute_not_exists(#attempt)";

impl Table {
    /// Asks whether the operator may write rows.
    pub async fn try_write(&self) -> Result<(), TableError> {
        // The keys fit strings and numbers, and belong to no team or submission: EvalAI counts both from 1.
        let row = Row {
            team_id: "0".to_owned(),
            run_id: "0".to_owned(),
            ..Row::default()
        };
        let update = self.update(&row)?.condition_expression(NEVER);
        let request = update.update_expression("SET #attempt = :attempt").send();
        match self.meter.aws("dynamodb", "UpdateItem", request).await {
            Ok(_) => Ok(()),
            Err(error) => match error.as_service_error() {
                Some(UpdateItemError::ConditionalCheckFailedException(_)) => Ok(()),
                _ => Err(failed(&self.name, "UpdateItem", &error)),
            },
        }
    }
}
