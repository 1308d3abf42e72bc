//! Whether a table would take a row: asked by an update whose condition never holds, so that nothing is written.

use aws_sdk_dynamodb::error::SdkError;
use aws_sdk_dynamodb::operation::update_item::UpdateItemError;
use aws_sdk_dynamodb::types::AttributeValue;

use super::{ATTEMPT, Row, Table, TableError, Written, failed};

/// No row fulfils it, so nothing is written; DynamoDB looks at the right to write before it looks at the condition.
const NEVER: &str = "attribute_exists(#attempt) AND attribute_not_exists(#attempt)";

impl Table {
    /// Asks whether a row would be taken, by an update whose condition never holds.
    pub(super) async fn try_write(&self, row: &Row) -> Result<Written, TableError> {
        let request = self
            .client
            .update_item()
            .table_name(&self.name)
            .key(
                &self.partition.name,
                self.key_value(&self.partition, &row.team_id, "team")?,
            )
            .key(&self.sort.name, self.key_value(&self.sort, &row.run_id, "submission")?)
            .condition_expression(NEVER)
            .update_expression("SET #attempt = :attempt")
            .expression_attribute_names("#attempt", ATTEMPT)
            .expression_attribute_values(":attempt", AttributeValue::N(row.attempt.to_string()))
            .send();
        let answer = self.meter.aws("dynamodb", "UpdateItem", request).await;
        match answer.as_ref().map_err(SdkError::as_service_error) {
            Ok(_) | Err(Some(UpdateItemError::ConditionalCheckFailedException(_))) => Ok(Written::Stored),
            Err(_) => answer
                .map(|_| Written::Stored)
                .map_err(|error| failed(&self.name, "UpdateItem", &error)),
        }
    }
}
