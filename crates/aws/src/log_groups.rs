//! Log groups that a Leaderboard wants kept: made if they are missing, with the days that their lines are kept.
//!
//! Called by the controller's checks of a Leaderboard, and only where `logs.cloudWatch.retentionDays` is set. The Pods write streams
//! into the group and have no right to make one.

use aws_sdk_cloudwatchlogs::Client;
use aws_sdk_cloudwatchlogs::config::http::HttpResponse;
use aws_sdk_cloudwatchlogs::error::{ProvideErrorMetadata, SdkError};
use aws_sdk_cloudwatchlogs::types::LogGroup as Described;

use super::fault::{self, Fault};
use crate::clients::Aws;
use crate::metered::Metered;
use leaderboard_api::LogGroup;
use leaderboard_base::meter::Meter;

/// Why a log group is not as the Leaderboard wants it.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("log group {name}: {action} failed: {text}; {}", self.next_step())]
pub struct LogGroupError {
    /// Its name.
    pub name: String,
    /// Operation of CloudWatch Logs.
    pub action: &'static str,
    /// Kind of failure.
    pub fault: Fault,
    /// Its message.
    pub text: String,
}

impl LogGroupError {
    fn next_step(&self) -> String {
        match self.fault {
            Fault::Denied => format!(
                "give the controller's AWS identity logs:{}, or make the group yourself and leave logs.cloudWatch.retentionDays out",
                self.action
            ),
            Fault::Refused | Fault::Missing => {
                "check logs.cloudWatch.name, logs.cloudWatch.tags, logs.cloudWatch.region and logs.cloudWatch.endpoint"
                    .to_owned()
            }
            Fault::Throttled | Fault::Unavailable | Fault::Conflict => {
                "it is retried; check logs.cloudWatch.endpoint and the network if this stays".to_owned()
            }
        }
    }
}

/// Makes the group if it is missing, and sets the days that its lines are kept if they differ. Safe twice.
pub async fn keep(aws: &Aws, group: &LogGroup, days: i32) -> Result<(), LogGroupError> {
    let groups = Groups {
        client: aws.logs(group.region.as_deref(), group.endpoint.as_deref()),
        meter: aws.meter(),
        group,
    };
    let found = groups.find().await?;
    if found.is_none() {
        groups.make().await?;
    }
    if found.and_then(|found| found.retention_in_days) != Some(days) {
        groups.set_days(days).await?;
    }
    Ok(())
}

struct Groups<'a> {
    client: Client,
    meter: &'a Meter,
    group: &'a LogGroup,
}

impl Groups<'_> {
    async fn find(&self) -> Result<Option<Described>, LogGroupError> {
        const ACTION: &str = "DescribeLogGroups";
        let name = &self.group.name;
        // Groups come in the order of their names, so one that is called like the prefix comes first.
        let request = self.client.describe_log_groups().log_group_name_prefix(name).limit(1);
        let answer = self.meter.aws("logs", ACTION, request.send()).await;
        let found = answer.map_err(|error| self.failed(ACTION, &error))?.log_groups;
        let mut found = found.unwrap_or_default().into_iter();
        Ok(found.find(|group| group.log_group_name.as_ref() == Some(name)))
    }

    async fn make(&self) -> Result<(), LogGroupError> {
        const ACTION: &str = "CreateLogGroup";
        let tags = (!self.group.tags.is_empty()).then(|| self.group.tags.clone().into_iter().collect());
        let request = self.client.create_log_group().log_group_name(&self.group.name);
        match self.meter.aws("logs", ACTION, request.set_tags(tags).send()).await {
            Err(error) if error.code() != Some("ResourceAlreadyExistsException") => Err(self.failed(ACTION, &error)),
            _ => Ok(()),
        }
    }

    async fn set_days(&self, days: i32) -> Result<(), LogGroupError> {
        const ACTION: &str = "PutRetentionPolicy";
        let request = self.client.put_retention_policy().log_group_name(&self.group.name);
        let answer = self
            .meter
            .aws("logs", ACTION, request.retention_in_days(days).send())
            .await;
        answer.map(|_| ()).map_err(|error| self.failed(ACTION, &error))
    }

    fn failed<E>(&self, action: &'static str, error: &SdkError<E, HttpResponse>) -> LogGroupError
    where
        E: ProvideErrorMetadata + std::error::Error + 'static,
    {
        LogGroupError {
            name: self.group.name.clone(),
            action,
            fault: fault::of(error),
            text: fault::sentence(error),
        }
    }
}
