use super::*;
use serde_json::json;

fn queue() -> QueueArn {
    QueueArn::of_url("https://sqs.us-west-2.amazonaws.com/123456789012/leaderboard", None).unwrap()
}

#[test]
fn a_queues_arn_follows_from_its_url() {
    for (url, region, arn) in [
        (
            "https://sqs.us-west-2.amazonaws.com/123456789012/leaderboard",
            Some("eu-west-1"),
            "arn:aws:sqs:us-west-2:123456789012:leaderboard",
        ),
        (
            "https://sqs.cn-north-1.amazonaws.com.cn/123456789012/q.fifo",
            None,
            "arn:aws-cn:sqs:cn-north-1:123456789012:q.fifo",
        ),
        (
            "https://sqs.us-gov-west-1.amazonaws.com/123456789012/q",
            None,
            "arn:aws-us-gov:sqs:us-gov-west-1:123456789012:q",
        ),
        (
            "http://127.0.0.1:4566/000000000000/q",
            Some("us-east-1"),
            "arn:aws:sqs:us-east-1:000000000000:q",
        ),
    ] {
        assert_eq!(QueueArn::of_url(url, region).unwrap().to_string(), arn);
    }
}

#[test]
fn what_is_no_url_of_a_queue_is_refused() {
    for url in [
        "",
        "leaderboard",
        "arn:aws:sqs:us-west-2:123456789012:leaderboard",
        "https://sqs.us-west-2.amazonaws.com/leaderboard",
        "https://sqs.us-west-2.amazonaws.com/123456789012/",
        "https://sqs.us-west-2.amazonaws.com/123456789012/a/b",
        "https://sqs.us-west-2.amazonaws.com/123456789012/a b",
        "https://sqs.us-west-2.amazonaws.com/12345/leaderboard",
    ] {
        assert!(
            matches!(QueueArn::of_url(url, Some("us-west-2")), Err(NotAQueue::Url(_))),
            "{url}"
        );
    }
    let local = QueueArn::of_url("http://127.0.0.1:4566/000000000000/q", None);
    assert!(matches!(local, Err(NotAQueue::Region(_))));
}

#[test]
fn only_the_pipes_of_this_very_queue_count() {
    let arn = queue().to_string();
    let body = json!({"NextToken": "more", "Pipes": [
        {"Name": "leaderboard", "Source": arn, "CurrentState": "RUNNING"},
        {"Name": "staging", "Source": format!("{arn}-staging"), "CurrentState": "RUNNING"},
        {"Source": arn},
    ]});
    let (found, next) = Kind::Pipes.page(&queue(), &body).unwrap();
    assert_eq!(found.len(), 1);
    assert_eq!(found[0].to_string(), "EventBridge Pipe leaderboard");
    assert_eq!(
        found[0].stop(),
        "aws pipes stop-pipe --name leaderboard --region us-west-2"
    );
    assert_eq!(next.as_deref(), Some("more"));
    assert_eq!(Kind::Pipes.page(&queue(), &json!({"Pipes": []})), Some((vec![], None)));
    assert_eq!(Kind::Pipes.page(&queue(), &json!({})), None);
}

#[test]
fn only_mappings_that_take_messages_count() {
    let arn = queue().to_string();
    let mapping = |state: &str| {
        json!({"UUID": state, "FunctionArn": "arn:aws:lambda:us-west-2:123456789012:function:preEKS", "State": state,
               "EventSourceArn": arn})
    };
    let states = [
        "Enabled",
        "Enabling",
        "Updating",
        "Creating",
        "Disabled",
        "Disabling",
        "Deleting",
    ];
    let body = json!({"EventSourceMappings": states.map(mapping)});
    let (found, next) = Kind::Lambda.page(&queue(), &body).unwrap();
    let stops: Vec<String> = found.iter().map(EventSource::stop).collect();
    assert_eq!(found[0].to_string(), "Lambda function preEKS");
    let stop = |id: &str| format!("aws lambda update-event-source-mapping --uuid {id} --no-enabled --region us-west-2");
    assert_eq!(stops, ["Enabled", "Enabling", "Updating", "Creating"].map(stop));
    assert_eq!(next, None);
}

#[test]
fn a_refusal_names_what_aws_has_answered() {
    let denied = json!({"Message": "User: x is not authorized to perform: pipes:ListPipes"});
    for (code, body, text) in [
        (
            Some("AccessDeniedException"),
            denied,
            "AccessDeniedException: User: x is not authorized to perform: pipes:ListPipes",
        ),
        (
            None,
            json!({"__type": "a.b#Throttled", "message": "slow"}),
            "Throttled: slow",
        ),
        (None, Value::Null, "HTTP 403"),
        (None, json!({"message": "a\n\u{1b}[31mb"}), "HTTP 403: a \u{fffd}[31mb"),
    ] {
        assert_eq!(refusal(403, code, &body), text);
    }
}

#[test]
fn a_query_holds_nothing_that_a_url_would_read_otherwise() {
    let first = Kind::Pipes.query(&queue(), None);
    let arn = "arn%3Aaws%3Asqs%3Aus-west-2%3A123456789012%3Aleaderboard";
    assert_eq!(first, format!("CurrentState=RUNNING&SourcePrefix={arn}"));
    let next = Kind::Lambda.query(&queue(), Some("a+b/c="));
    assert_eq!(next, format!("EventSourceArn={arn}&Marker=a%2Bb%2Fc%3D"));
}
