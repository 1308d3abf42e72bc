//! To which hosts the clients of AWS connect that a Pod has, by the SDK's own rules: with partitions, path-style buckets and all.

use aws_sdk_cloudwatchlogs::config::endpoint as logs_endpoint;
use aws_sdk_s3::config::endpoint as s3_endpoint;
use aws_sdk_sts::config::endpoint as sts_endpoint;
use reqwest::Url;

use crate::clients::USUAL_REGION;
use leaderboard_api::{LeaderboardSpec, LogGroup, S3Bucket};
use logs_endpoint::ResolveEndpoint as _;
use s3_endpoint::ResolveEndpoint as _;
use sts_endpoint::ResolveEndpoint as _;

/// The endpoint by a service's rules, or why there is none.
macro_rules! endpoint {
    ($module:ident, $params:expr) => {
        match $params.build() {
            Ok(params) => {
                let resolver = $module::DefaultResolver::new();
                let endpoint = resolver.resolve_endpoint(&params).await;
                endpoint
                    .map(|endpoint| endpoint.url().to_owned())
                    .map_err(|error| error.to_string())
            }
            Err(error) => Err(error.to_string()),
        }
    };
}

/// Hosts that `workspace` and `logcopy` of a Leaderboard's Pods connect to, in a Pod whose environment has this region: names in small letters,
/// or addresses.
pub async fn of_pods(spec: &LeaderboardSpec, region: Option<&str>) -> Result<Vec<String>, String> {
    let region = region.or(spec.storage.s3.region.as_deref());
    let mut hosts = vec![s3(&spec.storage.s3, region).await?];
    if spec.has_role() {
        hosts.push(sts(&spec.storage.s3, region).await?);
    }
    if let Some(group) = spec.log_group() {
        hosts.push(logs(group, region).await?);
    }
    Ok(hosts)
}

async fn s3(storage: &S3Bucket, region: Option<&str>) -> Result<String, String> {
    let params = s3_endpoint::Params::builder()
        .bucket(&storage.bucket)
        .region(storage.region.as_deref().or(region).unwrap_or(USUAL_REGION))
        .set_endpoint(storage.endpoint.clone())
        .force_path_style(storage.endpoint.is_some());
    host("S3", endpoint!(s3_endpoint, params))
}

async fn sts(storage: &S3Bucket, region: Option<&str>) -> Result<String, String> {
    let region = storage.region.as_deref().or(region).unwrap_or(USUAL_REGION);
    let params = sts_endpoint::Params::builder().region(region);
    host("STS", endpoint!(sts_endpoint, params))
}

async fn logs(group: &LogGroup, region: Option<&str>) -> Result<String, String> {
    let params = logs_endpoint::Params::builder()
        .region(group.region.as_deref().or(region).unwrap_or(USUAL_REGION))
        .set_endpoint(group.endpoint.clone());
    host("CloudWatch Logs", endpoint!(logs_endpoint, params))
}

fn host(service: &str, endpoint: Result<String, String>) -> Result<String, String> {
    let endpoint = endpoint.map_err(|why| format!("the endpoint of {service} is not known: {why}"))?;
    let unusable = || format!("the endpoint of {service} is no address of a server");
    let url = Url::parse(&endpoint).map_err(|_| unusable())?;
    let host = url.host_str().ok_or_else(unusable)?;
    Ok(host.trim_matches(['[', ']']).to_lowercase())
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn storage(more: &serde_json::Value) -> S3Bucket {
        let mut storage = json!({"bucket": "results"});
        for (key, value) in more.as_object().unwrap() {
            storage[key] = value.clone();
        }
        serde_json::from_value(storage).unwrap()
    }

    #[tokio::test]
    async fn a_bucket_is_where_the_client_of_s3_looks_for_it() {
        for (more, region, host) in [
            (json!({}), None, "results.s3.us-east-1.amazonaws.com"),
            (json!({}), Some("eu-west-1"), "results.s3.eu-west-1.amazonaws.com"),
            (
                json!({"region": "cn-north-1"}),
                Some("eu-west-1"),
                "results.s3.cn-north-1.amazonaws.com.cn",
            ),
            // A name with dots is no host of the certificate.
            (
                json!({"bucket": "results.2026", "region": "eu-west-1"}),
                None,
                "s3.eu-west-1.amazonaws.com",
            ),
            (
                json!({"endpoint": "https://Bucket.vpce-1.s3.eu-west-1.vpce.amazonaws.com"}),
                None,
                "bucket.vpce-1.s3.eu-west-1.vpce.amazonaws.com",
            ),
            (json!({"endpoint": "http://minio.storage:9000"}), None, "minio.storage"),
            (json!({"endpoint": "http://10.0.0.5"}), None, "10.0.0.5"),
            (json!({"endpoint": "https://[fd12::1]:8443"}), None, "fd12::1"),
        ] {
            assert_eq!(s3(&storage(&more), region).await.unwrap(), host, "{more}");
        }
        for more in [json!({"endpoint": "nonsense"}), json!({"region": "no region"})] {
            let error = s3(&storage(&more), None).await.unwrap_err();
            assert!(error.starts_with("the endpoint of S3 is "), "{error}");
        }
    }

    #[tokio::test]
    async fn tokens_and_logs_have_their_own_places() {
        let at = |region: &str| storage(&json!({"region": region}));
        let found = sts(&at("eu-west-1"), Some("us-west-2")).await.unwrap();
        assert_eq!(found, "sts.eu-west-1.amazonaws.com");
        let found = sts(&storage(&json!({})), Some("us-west-2")).await.unwrap();
        assert_eq!(found, "sts.us-west-2.amazonaws.com");
        let group = |more: serde_json::Value| -> LogGroup { serde_json::from_value(more).unwrap() };
        let named = group(json!({"name": "g", "region": "eu-west-1"}));
        let found = logs(&named, Some("us-west-2")).await.unwrap();
        assert_eq!(found, "logs.eu-west-1.amazonaws.com");
        let own = group(json!({"name": "g", "endpoint": "http://logs.internal:4566"}));
        assert_eq!(logs(&own, None).await.unwrap(), "logs.internal");
    }
}
