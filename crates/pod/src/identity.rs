//! Identity of the Pod's own programs towards AWS: the keys in their environment, or a role assumed with the Pod's token and
//! narrowed to this run.
//!
//! Called by `workspace` and `logcopy` at their start. Knows no keys of objects.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::SystemTime;

use aws_credential_types::Credentials;
use aws_credential_types::credential_fn::provide_credentials_fn;
use aws_credential_types::provider::{SharedCredentialsProvider, error::CredentialsError};

use super::places::Setting;
use leaderboard_api::effective::key_prefix;
use leaderboard_aws::clients::Aws;
use leaderboard_contract::run::Run;

/// The way to AWS for a program of this Pod.
pub async fn aws(setting: &Setting, program: &str) -> Aws {
    for_run(Aws::load(program).await, setting)
}

/// This identity from a way to AWS that is there already.
pub fn for_run(base: Aws, setting: &Setting) -> Aws {
    let Some(role_arn) = &setting.role_arn else {
        return base;
    };
    let storage = &setting.run.plan.storage.s3;
    let identity = Arc::new(WebIdentity {
        // Never the bucket's endpoint: that one is S3's alone.
        sts: base.sts(storage.region.as_deref()),
        policy: session_policy(&setting.run, partition(role_arn)),
        role_arn: role_arn.clone(),
        session: session_name(&setting.run),
        token: setting.places.token.clone(),
    });
    let provider = provide_credentials_fn(move || Arc::clone(&identity).assume());
    let config = base.config(None).into_builder();
    Aws::from_config(
        config
            .credentials_provider(SharedCredentialsProvider::new(provider))
            .build(),
    )
}

/// Asks STS whenever the SDK's cache finds its credentials about to expire.
struct WebIdentity {
    sts: aws_sdk_sts::Client,
    policy: String,
    role_arn: String,
    session: String,
    token: PathBuf,
}

impl WebIdentity {
    async fn assume(self: Arc<Self>) -> Result<Credentials, CredentialsError> {
        // The kubelet renews the token, so it is read anew each time.
        let token = tokio::fs::read_to_string(&self.token).await;
        let token = token.map_err(CredentialsError::provider_error)?;
        let request = self.sts.assume_role_with_web_identity().role_arn(&self.role_arn);
        let request = request.role_session_name(&self.session).policy(&self.policy);
        let answer = request.web_identity_token(token.trim()).send().await;
        let given = answer.map_err(CredentialsError::provider_error)?.credentials;
        let given = given.ok_or_else(|| CredentialsError::unhandled("STS answered without credentials"))?;
        let expiry = SystemTime::try_from(*given.expiration()).map_err(CredentialsError::unhandled)?;
        Ok(Credentials::new(
            given.access_key_id(),
            given.secret_access_key(),
            Some(given.session_token().to_owned()),
            Some(expiry),
            "PodWebIdentity",
        ))
    }
}

/// `aws`, `aws-cn`, `aws-us-gov`: what the role is in, the bucket is in.
fn partition(arn: &str) -> &str {
    arn.split(':').nth(1).filter(|part| !part.is_empty()).unwrap_or("aws")
}

/// At most 64 characters; STS takes all that a run id has.
fn session_name(run: &Run) -> String {
    let id = run.plan.run_id.as_str().chars().take(50);
    format!("leaderboard-{}", id.collect::<String>())
}

/// Policy that leaves of the role's rights this run's objects and log streams.
fn session_policy(run: &Run, partition: &str) -> String {
    let bucket = format!("arn:{partition}:s3:::{}", run.plan.storage.s3.bucket);
    let prefix = key_prefix(&run.plan.storage.s3, &run.plan.run_id);
    let mut statements = vec![
        serde_json::json!({
            "Effect": "Allow",
            "Action": ["s3:GetObject", "s3:PutObject", "s3:DeleteObject", "s3:AbortMultipartUpload"],
            "Resource": format!("{bucket}/{prefix}*"),
        }),
        serde_json::json!({
            "Effect": "Allow",
            "Action": "s3:ListBucket",
            "Resource": bucket,
            "Condition": {"StringLike": {"s3:prefix": format!("{prefix}*")}},
        }),
        // S3 asks KMS with the caller's rights, and a bucket may have a key that the Leaderboard does not name.
        serde_json::json!({
            "Effect": "Allow",
            "Action": ["kms:Decrypt", "kms:GenerateDataKey"],
            "Resource": run.plan.storage.s3.kms_key_arn.as_deref().unwrap_or("*"),
            "Condition": {"StringLike": {"kms:ViaService": "s3.*"}},
        }),
    ];
    if let Some(group) = run.log_group() {
        statements.push(serde_json::json!({
            "Effect": "Allow",
            "Action": ["logs:CreateLogStream", "logs:PutLogEvents", "logs:GetLogEvents"],
            "Resource": format!("arn:{partition}:logs:*:*:log-group:{}:log-stream:{}/*", group.name, run.plan.run_id),
        }));
    }
    serde_json::json!({"Version": "2012-10-17", "Statement": statements}).to_string()
}

#[cfg(test)]
mod tests {

    use super::*;
    use leaderboard_evaluation::fixtures;

    #[test]
    fn the_session_reaches_this_run_alone() {
        let policy = session_policy(&fixtures::run(), partition("arn:aws-cn:iam::1:role/r"));
        assert!(
            policy.contains(r#""Resource":"arn:aws-cn:s3:::results/2026/77/*""#),
            "{policy}"
        );
        assert!(policy.contains(r#"{"s3:prefix":"2026/77/*"}"#), "{policy}");
        assert!(!policy.contains("logs:"));
        assert!(policy.len() < 2048, "STS takes 2048 characters");
    }

    #[test]
    fn the_session_may_use_the_key_of_its_objects_and_only_through_s3() {
        let key = "arn:aws:kms:us-east-1:123456789012:key/0a1b";
        let mut run = fixtures::run();
        for (named, resource) in [(None, "*"), (Some(key), key)] {
            run.plan.storage.s3.kms_key_arn = named.map(str::to_owned);
            let policy: serde_json::Value = serde_json::from_str(&session_policy(&run, "aws")).unwrap();
            let statement = &policy["Statement"][2];
            assert_eq!(
                statement["Action"],
                serde_json::json!(["kms:Decrypt", "kms:GenerateDataKey"])
            );
            assert_eq!(statement["Resource"], resource);
            assert_eq!(statement["Condition"]["StringLike"]["kms:ViaService"], "s3.*");
        }
    }

    #[test]
    fn a_log_group_adds_this_runs_streams() {
        let mut run = fixtures::run();
        let logs = serde_json::json!({"cloudWatch": {"name": "leaderboard-20"}});
        run.logs = serde_json::from_value(logs).unwrap();
        let policy = session_policy(&run, partition("nonsense"));
        assert!(
            policy.contains("arn:aws:logs:*:*:log-group:leaderboard-20:log-stream:77/*"),
            "{policy}"
        );
    }

    #[test]
    fn session_names_are_short_and_plain() {
        let mut run = fixtures::run();
        assert_eq!(session_name(&run), "leaderboard-77");
        run.plan.run_id = "x".repeat(128).parse().unwrap();
        assert_eq!(session_name(&run).len(), 62);
    }
}
