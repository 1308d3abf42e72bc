//! Secrets Manager: the text of an entry.

use super::fault;
use crate::clients::Aws;
use crate::metered::Metered;

/// The text of an entry of Secrets Manager; an error shows what the service has answered.
pub async fn secret_text(aws: &Aws, id: &str, region: Option<&str>, endpoint: Option<&str>) -> Result<String, String> {
    let request = aws.secrets(region, endpoint).get_secret_value().secret_id(id).send();
    let answer = aws.meter().aws("secretsmanager", "GetSecretValue", request).await;
    let answer = answer.map_err(|error| fault::sentence(&error))?;
    Ok(answer.secret_string().unwrap_or_default().to_owned())
}
