//! The log group that a Leaderboard wants kept, against the AWS stand-in.
#![cfg(test)]

use std::collections::HashMap;

use aws_sdk_cloudwatchlogs::types::LogGroup as Described;
use leaderboard_api::LogGroup;
use leaderboard_aws::fault::Fault;
use leaderboard_aws::log_groups::keep;
use serde_json::json;

use super::bridge::StandIn;
use crate::support::throttle::Throttle;

fn group(name: &str, endpoint: &str) -> LogGroup {
    serde_json::from_value(json!({
        "name": name, "endpoint": endpoint, "retentionDays": 30, "tags": {"team": "challenge"},
    }))
    .unwrap()
}

async fn described(stand_in: &StandIn, name: &str) -> Described {
    let logs = stand_in.aws.logs(None, Some(&stand_in.endpoint));
    let answer = logs
        .describe_log_groups()
        .log_group_name_prefix(name)
        .send()
        .await
        .unwrap();
    let mut groups = answer.log_groups.unwrap_or_default().into_iter();
    let found = groups.find(|group| group.log_group_name() == Some(name));
    found.unwrap_or_else(|| panic!("no log group {name}"))
}

/// Days that a group's lines are kept.
async fn days(stand_in: &StandIn, name: &str) -> Option<i32> {
    described(stand_in, name).await.retention_in_days()
}

#[tokio::test]
async fn a_missing_group_is_made_and_its_days_are_kept() {
    let stand_in = StandIn::start().await;
    let logs = stand_in.aws.logs(None, Some(&stand_in.endpoint));
    let name = stand_in.name("made");
    // Another group's name goes on where this one ends.
    logs.create_log_group()
        .log_group_name(format!("{name}-other"))
        .send()
        .await
        .unwrap();
    let wanted = group(&name, &stand_in.endpoint);
    keep(&stand_in.aws, &wanted, 30).await.unwrap();
    assert_eq!(days(&stand_in, &name).await, Some(30));
    let arn = described(&stand_in, &name).await.log_group_arn.unwrap();
    let tags = logs.list_tags_for_resource().resource_arn(arn).send().await.unwrap();
    let challenge = HashMap::from([("team".to_owned(), "challenge".to_owned())]);
    assert_eq!(tags.tags, Some(challenge));
    let put = logs.put_retention_policy().log_group_name(&name).retention_in_days(7);
    put.send().await.unwrap();
    keep(&stand_in.aws, &wanted, 30).await.unwrap();
    assert_eq!(days(&stand_in, &name).await, Some(30));
    assert_eq!(days(&stand_in, &format!("{name}-other")).await, None);
}

#[tokio::test]
async fn a_refusal_names_the_right_that_is_missing() {
    let stand_in = StandIn::start().await;
    for (code, fault, step) in [
        (
            "AccessDeniedException",
            Fault::Denied,
            "give the controller's AWS identity logs:DescribeLogGroups",
        ),
        ("ThrottlingException", Fault::Throttled, "it is retried"),
    ] {
        let refuses = Throttle::start(&stand_in.endpoint, code).await;
        refuses.refuse(1);
        let error = keep(&stand_in.aws, &group("any", refuses.endpoint()), 30)
            .await
            .unwrap_err();
        assert_eq!(error.fault, fault);
        assert!(error.to_string().contains(step), "{error}");
    }
}
