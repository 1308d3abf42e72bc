//! Whether a table would take a row: asked by an update whose condition never holds, so that nothing is written.

use aws_sdk_dynamodb::operation::update_item::UpdateItemError;

use super::{Row, Table, TableError, Written, failed};

/// No row fulfils it, so nothing is written; DynamoDB looks at the right to write before it looks at the condition.
const NEVER: &str = "attribute_exists(#attempt) AND attribute_not_exists(#attempt)";

impl Table {
    /// Asks whether a row would be taken, by an update whose condition never holds.
    pub(super) async fn try_write(&self, row: &Row) -> Result<Written, TableError> {
        let update = self.update(row)?.condition_expression(NEVER);
        let request = update.update_expression("SET #attempt = :attempt").send();
        match self.meter.aws("dynamodb", "UpdateItem", request).await {
            Ok(_) => Ok(Written::Stored),
            Err(error) => match error.as_service_error() {
                Some(UpdateItemError::ConditionalCheckFailedException(_)) => Ok(Written::Stored),
                _ => Err(failed(&self.name, "UpdateItem", &error)),
            },
        }
    }
}
