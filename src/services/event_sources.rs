//! Who else reads an SQS queue: EventBridge Pipes and Lambda functions that are switched on.
//!
//! Called by commands for people, with the person's own credentials. Two calls are all that is needed of the two services, so they are
//! signed here, and their SDKs are left out. Parsing is pure.

use std::fmt;
use std::time::{Duration, SystemTime};

use aws_credential_types::provider::ProvideCredentials;
use aws_sigv4::http_request::{SignableBody, SignableRequest, SigningSettings, sign};
use aws_sigv4::sign::v4::SigningParams;
use percent_encoding::{AsciiSet, NON_ALPHANUMERIC, utf8_percent_encode};
use serde_json::Value;

use super::aws::Aws;
use leaderboard_api::client_errors;
use leaderboard_api::text::{LONGEST_MESSAGE, one_line};

/// Time one call may take.
const CALL: Duration = Duration::from_secs(20);
/// Pages of one list: more event sources than any account may have.
const MOST_PAGES: usize = 50;
/// What a query leaves as it is.
const PLAIN: &AsciiSet = &NON_ALPHANUMERIC.remove(b'-').remove(b'_').remove(b'.').remove(b'~');
/// States in which a Lambda function's mapping takes no messages.
const IDLE: [&str; 3] = ["Disabled", "Disabling", "Deleting"];

/// An SQS queue by its ARN.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct QueueArn {
    partition: &'static str,
    region: String,
    account: String,
    name: String,
}

/// A text that is no URL of a queue.
#[derive(thiserror::Error, Clone, Debug, PartialEq, Eq)]
pub enum NotAQueue {
    #[error("{0} is no URL of a queue such as https://sqs.us-west-2.amazonaws.com/123456789012/leaderboard")]
    Url(String),
    #[error("the URL {0} names no region; give the queue's region")]
    Region(String),
}

impl QueueArn {
    /// From a queue's URL. One of AWS names its region; for any other it has to be given.
    pub fn of_url(url: &str, region: Option<&str>) -> Result<Self, NotAQueue> {
        let refused = || NotAQueue::Url(one_line(url, LONGEST_MESSAGE));
        let rest = url.strip_prefix("https://").or_else(|| url.strip_prefix("http://"));
        let mut parts = rest.ok_or_else(refused)?.split('/');
        let (Some(host), Some(account), Some(name), None) = (parts.next(), parts.next(), parts.next(), parts.next())
        else {
            return Err(refused());
        };
        let is_account = account.len() == 12 && account.bytes().all(|byte| byte.is_ascii_digit());
        let is_word = |byte: u8| byte.is_ascii_alphanumeric() || matches!(byte, b'-' | b'_' | b'.');
        if host.is_empty() || !is_account || name.is_empty() || !name.bytes().all(is_word) {
            return Err(refused());
        }
        let (own, partition) = place(host);
        let region = own.or(region).ok_or_else(|| NotAQueue::Region(url.to_owned()))?;
        Ok(Self {
            partition,
            region: region.to_owned(),
            account: account.to_owned(),
            name: name.to_owned(),
        })
    }

    /// Its region.
    pub fn region(&self) -> &str {
        &self.region
    }
}

impl fmt::Display for QueueArn {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "arn:{}:sqs:{}:{}:{}",
            self.partition, self.region, self.account, self.name
        )
    }
}

/// Region and partition of a host of SQS.
fn place(host: &str) -> (Option<&str>, &'static str) {
    let Some(rest) = host.strip_prefix("sqs.") else {
        return (None, "aws");
    };
    match rest.split_once('.') {
        Some((region, "amazonaws.com")) if region.starts_with("us-gov-") => (Some(region), "aws-us-gov"),
        Some((region, "amazonaws.com")) => (Some(region), "aws"),
        Some((region, "amazonaws.com.cn")) => (Some(region), "aws-cn"),
        _ => (None, "aws"),
    }
}

/// Something that takes messages out of a queue.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum EventSource {
    /// An EventBridge Pipe that runs.
    Pipe { name: String, region: String },
    /// A Lambda function's mapping that is not switched off.
    Lambda {
        id: String,
        function: String,
        region: String,
    },
}

impl EventSource {
    /// The command that stops it.
    pub fn stop(&self) -> String {
        match self {
            Self::Pipe { name, region } => format!("aws pipes stop-pipe --name {name} --region {region}"),
            Self::Lambda { id, region, .. } => {
                format!("aws lambda update-event-source-mapping --uuid {id} --no-enabled --region {region}")
            }
        }
    }
}

impl fmt::Display for EventSource {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Pipe { name, .. } => write!(f, "EventBridge Pipe {name}"),
            Self::Lambda { function, .. } => write!(f, "Lambda function {function}"),
        }
    }
}

/// A kind of event source.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    Pipes,
    Lambda,
}

impl Kind {
    /// Both.
    pub const ALL: [Self; 2] = [Self::Pipes, Self::Lambda];

    /// What its list holds.
    pub fn what(self) -> &'static str {
        match self {
            Self::Pipes => "EventBridge Pipes",
            Self::Lambda => "Lambda's event source mappings",
        }
    }

    /// The command that shows the same list.
    pub fn by_hand(self, queue: &QueueArn) -> String {
        let region = queue.region();
        match self {
            Self::Pipes => format!("aws pipes list-pipes --source-prefix {queue} --region {region}"),
            Self::Lambda => {
                format!("aws lambda list-event-source-mappings --event-source-arn {queue} --region {region}")
            }
        }
    }

    fn service(self) -> &'static str {
        match self {
            Self::Pipes => "pipes",
            Self::Lambda => "lambda",
        }
    }

    fn path(self) -> &'static str {
        match self {
            Self::Pipes => "/v1/pipes",
            Self::Lambda => "/2015-03-31/event-source-mappings/",
        }
    }

    fn query(self, queue: &QueueArn, next: Option<&str>) -> String {
        let encoded = |text: &str| utf8_percent_encode(text, PLAIN).to_string();
        let arn = encoded(&queue.to_string());
        let (first, marker) = match self {
            Self::Pipes => (format!("CurrentState=RUNNING&SourcePrefix={arn}"), "NextToken"),
            Self::Lambda => (format!("EventSourceArn={arn}"), "Marker"),
        };
        match next {
            Some(next) => format!("{first}&{marker}={}", encoded(next)),
            None => first,
        }
    }

    /// What one page of the list holds, and how the next is asked for.
    fn page(self, queue: &QueueArn, body: &Value) -> Option<(Vec<EventSource>, Option<String>)> {
        let (list, next) = match self {
            Self::Pipes => ("Pipes", "NextToken"),
            Self::Lambda => ("EventSourceMappings", "NextMarker"),
        };
        let items = body.get(list)?.as_array()?;
        let found = items.iter().filter_map(|item| self.item(queue, item)).collect();
        let next = body.get(next).and_then(Value::as_str).filter(|next| !next.is_empty());
        Some((found, next.map(str::to_owned)))
    }

    fn item(self, queue: &QueueArn, item: &Value) -> Option<EventSource> {
        let text = |key: &str| item.get(key).and_then(Value::as_str);
        let region = queue.region.clone();
        let arn = queue.to_string();
        match self {
            // The call takes a prefix, which another queue may begin with as well.
            Self::Pipes => (text("Source")? == arn).then_some(EventSource::Pipe {
                name: text("Name")?.to_owned(),
                region,
            }),
            Self::Lambda => {
                let is_ours = text("EventSourceArn")? == arn && !IDLE.contains(&text("State").unwrap_or_default());
                let function = text("FunctionArn")?;
                is_ours.then_some(EventSource::Lambda {
                    id: text("UUID")?.to_owned(),
                    function: function.rsplit(':').next().unwrap_or(function).to_owned(),
                    region,
                })
            }
        }
    }
}

/// A list that could not be read.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Unread {
    /// Which one.
    pub kind: Kind,
    /// What AWS has answered, or why it has not.
    pub why: String,
}

/// What is known of the readers of a queue.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Readers {
    /// Those that take its messages.
    pub found: Vec<EventSource>,
    /// What is not known.
    pub unread: Vec<Unread>,
}

/// Lists who takes the messages of a queue. `endpoint` stands in for both services.
pub async fn readers(aws: &Aws, queue: &QueueArn, endpoint: Option<&str>) -> Readers {
    let mut readers = Readers::default();
    for kind in Kind::ALL {
        match list(aws, kind, queue, endpoint).await {
            Ok(found) => readers.found.extend(found),
            Err(why) => readers.unread.push(Unread { kind, why }),
        }
    }
    readers
}

async fn list(aws: &Aws, kind: Kind, queue: &QueueArn, endpoint: Option<&str>) -> Result<Vec<EventSource>, String> {
    let _ = rustls::crypto::ring::default_provider().install_default();
    let http = reqwest::Client::builder()
        .redirect(reqwest::redirect::Policy::none())
        .timeout(CALL)
        .build()
        .map_err(|error| client_errors::chain(&error))?;
    let domain = if queue.partition == "aws-cn" {
        "amazonaws.com.cn"
    } else {
        "amazonaws.com"
    };
    let usual = || format!("https://{}.{}.{domain}", kind.service(), queue.region);
    let root = endpoint.map_or_else(usual, |endpoint| endpoint.trim_end_matches('/').to_owned());
    let (mut found, mut next) = (Vec::new(), None);
    for _ in 0..MOST_PAGES {
        let url = format!("{root}{}?{}", kind.path(), kind.query(queue, next.as_deref()));
        let body = get(aws, &http, kind, queue, &url).await?;
        let page = kind.page(queue, &body);
        let (items, more) = page.ok_or_else(|| "the answer holds no list".to_owned())?;
        found.extend(items);
        next = more;
        if next.is_none() {
            return Ok(found);
        }
    }
    Err(format!("the list has more than {MOST_PAGES} pages"))
}

async fn get(aws: &Aws, http: &reqwest::Client, kind: Kind, queue: &QueueArn, url: &str) -> Result<Value, String> {
    let running = aws.meter().begin(kind.service(), "List");
    let mut request = http.get(url);
    for (name, value) in signed(aws, kind, queue, url).await? {
        request = request.header(name, value);
    }
    let answer = request.send().await.map_err(|error| client_errors::chain(&error));
    running.end(if answer.as_ref().is_ok_and(|a| a.status().is_success()) {
        "ok"
    } else {
        "refused"
    });
    let answer = answer?;
    let status = answer.status();
    let code = answer
        .headers()
        .get("x-amzn-errortype")
        .and_then(|code| code.to_str().ok());
    let code = code.map(|code| code.split(':').next().unwrap_or(code).to_owned());
    let body: Value = answer.json().await.unwrap_or_default();
    if status.is_success() {
        Ok(body)
    } else {
        Err(refusal(status.as_u16(), code.as_deref(), &body))
    }
}

/// What AWS has answered, as a sentence.
fn refusal(status: u16, code: Option<&str>, body: &Value) -> String {
    let text = |key: &str| body.get(key).and_then(Value::as_str);
    let usual = format!("HTTP {status}");
    let code = code
        .or_else(|| text("__type"))
        .or_else(|| text("Code"))
        .unwrap_or(&usual);
    let code = code.rsplit('#').next().unwrap_or(code);
    let message = text("message").or_else(|| text("Message")).unwrap_or_default();
    one_line(format!("{code}: {message}").trim_end_matches(": "), LONGEST_MESSAGE)
}

/// The headers of a request without a body, its signature among them.
async fn signed(aws: &Aws, kind: Kind, queue: &QueueArn, url: &str) -> Result<Vec<(String, String)>, String> {
    let config = aws.config(Some(&queue.region));
    let none = || "no AWS credentials were found".to_owned();
    let provider = config.credentials_provider().ok_or_else(none)?;
    let identity = provider.provide_credentials().await.map_err(|_| none())?.into();
    let unsigned = || "the request could not be signed".to_owned();
    let params = SigningParams::builder()
        .identity(&identity)
        .region(&queue.region)
        .name(kind.service())
        .time(SystemTime::now())
        .settings(SigningSettings::default())
        .build();
    let params = params.map_err(|_| unsigned())?.into();
    let request = SignableRequest::new("GET", url, std::iter::empty(), SignableBody::Bytes(b""));
    let signed = request.and_then(|request| sign(request, &params));
    let (instructions, _) = signed.map_err(|_| unsigned())?.into_parts();
    let headers = instructions.headers();
    Ok(headers
        .map(|(name, value)| (name.to_owned(), value.to_owned()))
        .collect())
}

#[cfg(test)]
#[path = "event_sources_tests.rs"]
mod tests;
