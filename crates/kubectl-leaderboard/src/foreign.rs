//! Endpoints that are not AWS's. A Leaderboard names them. The program `aws` signs its requests with the person's own credentials.
//! The session token is in each request, so the owner of such a server would get it.
//!
//! Called by what starts that program. Pure, but for the person's own variables.

use std::env;

use leaderboard_api::S3Bucket;

use crate::error::Error;

/// The ends of the names of AWS's own endpoints.
const OF_AWS: [&str; 4] = [
    ".amazonaws.com",
    ".amazonaws.com.cn",
    ".api.aws",
    ".api.amazonwebservices.com.cn",
];
/// Variables by which a person names the endpoint that the own program asks.
const OWN: [&str; 2] = ["AWS_ENDPOINT_URL", "AWS_ENDPOINT_URL_S3"];

/// Goes on only if the person trusts an endpoint that is not AWS's, by the flag `--endpoint` or by an answer.
pub fn confirm(
    name: &str,
    storage: Option<&S3Bucket>,
    trusted: Option<&str>,
    ask: impl FnOnce(&str) -> Option<bool>,
) -> Result<(), Error> {
    let own: Vec<String> = OWN.into_iter().filter_map(|name| env::var(name).ok()).collect();
    let named = storage.and_then(|storage| storage.endpoint.as_deref());
    let Some(endpoint) = named.filter(|named| is_foreign(named, &own) && trusted != Some(*named)) else {
        return Ok(());
    };
    let what = format!(
        "{name} has its results at {endpoint}, which is no endpoint of AWS: `aws` would send it a request that your credentials sign"
    );
    match ask(&format!("{what}. Do you trust that server?")) {
        Some(true) => Ok(()),
        Some(false) => Err(Error::Unfit(format!(
            "nothing was sent to {endpoint}. Nothing was read"
        ))),
        None => Err(Error::Unfit(format!(
            "{what}. If you trust that server, add --endpoint={endpoint}"
        ))),
    }
}

fn is_foreign(endpoint: &str, own: &[String]) -> bool {
    let same = |other: &String| other.trim_end_matches('/') == endpoint.trim_end_matches('/');
    !is_of_aws(endpoint) && !own.iter().any(same)
}

fn is_of_aws(endpoint: &str) -> bool {
    let Some(rest) = endpoint.strip_prefix("https://") else {
        return false;
    };
    let authority = rest.trim_end_matches('/');
    let host = authority.split(':').next().unwrap_or_default();
    // More than a name and a port could lead elsewhere.
    let is_plain = authority
        .chars()
        .all(|c| c.is_ascii_alphanumeric() || ".-:".contains(c));
    is_plain && OF_AWS.iter().any(|end| host.to_ascii_lowercase().ends_with(end))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_server_that_is_not_awss_gets_no_credentials_unless_a_person_trusts_it() {
        let storage = serde_json::json!({"bucket": "b", "endpoint": "https://minio.example"});
        let storage: S3Bucket = serde_json::from_value(storage).unwrap();
        let confirmed = |answer, trusted| confirm("mine", Some(&storage), trusted, |_| answer);
        assert!(confirmed(Some(true), None).is_ok() && confirmed(None, Some("https://minio.example")).is_ok());
        for (answer, expected) in [
            (Some(false), "nothing was sent to https://minio.example"),
            (None, "add --endpoint=https://minio.example"),
        ] {
            let why = confirmed(answer, Some("https://other.example"))
                .unwrap_err()
                .to_string();
            assert!(why.contains(expected), "{why}");
        }
    }

    #[test]
    fn an_endpoint_is_awss_by_its_name_or_the_persons_by_a_variable() {
        let own = ["http://10.77.0.1:4566/".to_owned()];
        for (endpoint, expected) in [
            ("https://s3.eu-west-1.amazonaws.com", false),
            ("https://bucket.vpce-0a1b-2c.s3.us-east-1.vpce.amazonaws.com/", false),
            ("https://s3.cn-north-1.amazonaws.com.cn:443", false),
            ("https://s3.dualstack.us-east-1.api.aws", false),
            ("http://10.77.0.1:4566", false),
            ("http://s3.eu-west-1.amazonaws.com", true),
            ("https://minio.example", true),
            ("https://amazonaws.com.evil.example", true),
            ("https://evilamazonaws.com", true),
            ("https://s3.amazonaws.com@evil.example", true),
            ("https://evil.example/s3.amazonaws.com", true),
            ("https://evil.example#.amazonaws.com", true),
            ("https://evil.example\\.amazonaws.com", true),
            ("http://10.77.0.1:4567", true),
        ] {
            assert_eq!(is_foreign(endpoint, &own), expected, "{endpoint}");
        }
    }
}
