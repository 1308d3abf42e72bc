//! Who else reads the queue: an EventBridge Pipe or a Lambda function takes messages at random from the operator.
//!
//! Asked with the person's own `aws` program and credentials, if there is one; otherwise its commands are the step to do.

use std::time::Duration;

use leaderboard_api::Queue;
use serde_json::Value;
use tokio::process::Command;

use super::finding::{Finding, Mark, Part, finding_of};
use crate::foreign;
use crate::text::clean;

/// How long one command may take.
const LIMIT: Duration = Duration::from_secs(20);

/// What is known of other readers of the queue.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Readers {
    /// There is no queue.
    NoQueue,
    /// It was not found out, and why; with the commands that do.
    Unknown {
        why: String,
        commands: Vec<String>,
    },
    Nobody,
    /// What each is, and the command that stops it.
    Found(Vec<Reader>),
}

/// Something that takes messages from the queue.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Reader {
    pub what: String,
    pub stop: String,
}

/// Where the queue is, as flags of `aws`.
fn place(queue: &Queue) -> Vec<String> {
    let flag = |name: &str, value: Option<&String>| value.map(|value| [name.to_owned(), value.clone()]);
    let flags = [
        flag("--region", queue.region.as_ref()),
        flag("--endpoint-url", queue.endpoint.as_ref()),
    ];
    flags.into_iter().flatten().flatten().collect()
}

fn words(start: &[&str], queue: &Queue) -> Vec<String> {
    start
        .iter()
        .map(|word| (*word).to_owned())
        .chain(place(queue))
        .collect()
}

fn arn_command(queue: &Queue) -> Vec<String> {
    let start = [
        "sqs",
        "get-queue-attributes",
        "--queue-url",
        &queue.url,
        "--attribute-names",
        "QueueArn",
        "--output",
        "json",
    ];
    words(&start, queue)
}

fn pipes_command(queue: &Queue, arn: &str) -> Vec<String> {
    let start = [
        "pipes",
        "list-pipes",
        "--source-prefix",
        arn,
        "--current-state",
        "RUNNING",
        "--output",
        "json",
    ];
    words(&start, queue)
}

fn mappings_command(queue: &Queue, arn: &str) -> Vec<String> {
    let start = [
        "lambda",
        "list-event-source-mappings",
        "--event-source-arn",
        arn,
        "--output",
        "json",
    ];
    words(&start, queue)
}

/// Asks, as far as the person's own program can.
pub async fn ask(queue: Option<&Queue>) -> Readers {
    let Some(queue) = queue else { return Readers::NoQueue };
    match try_ask(queue).await {
        Ok(found) if found.is_empty() => Readers::Nobody,
        Ok(found) => Readers::Found(found),
        Err(why) => Readers::Unknown {
            why,
            commands: by_hand(queue),
        },
    }
}

async fn try_ask(queue: &Queue) -> Result<Vec<Reader>, String> {
    if let Some(endpoint) = foreign::endpoint(queue.endpoint.as_ref()) {
        return Err(format!(
            "{endpoint} is no endpoint of AWS, and aws would send it requests that your credentials sign"
        ));
    }
    let attributes = run(&arn_command(queue)).await?;
    let arn = attributes.pointer("/Attributes/QueueArn").and_then(Value::as_str);
    let arn = arn.ok_or("aws sqs named no ARN of the queue")?.to_owned();
    let mut found = pipes(&run(&pipes_command(queue, &arn)).await?, &arn);
    found.extend(mappings(&run(&mappings_command(queue, &arn)).await?, &arn));
    Ok(found)
}

async fn run(arguments: &[String]) -> Result<Value, String> {
    let what = arguments.iter().take(2).cloned().collect::<Vec<_>>().join(" ");
    let mut command = Command::new("aws");
    command
        .args(arguments)
        .stdin(std::process::Stdio::null())
        .kill_on_drop(true);
    let output = match tokio::time::timeout(LIMIT, command.output()).await {
        Err(_) => return Err(format!("aws {what} did not answer within {} s", LIMIT.as_secs())),
        Ok(Err(error)) if error.kind() == std::io::ErrorKind::NotFound => {
            return Err("the program aws is not on the PATH".to_owned());
        }
        Ok(Err(error)) => return Err(format!("aws cannot be run: {error}")),
        Ok(Ok(output)) => output,
    };
    if !output.status.success() {
        let stderr = String::from_utf8_lossy(&output.stderr);
        let last = stderr.lines().rfind(|line| !line.trim().is_empty()).unwrap_or_default();
        return Err(clean(&format!("aws {what} failed: {last}")));
    }
    serde_json::from_slice(&output.stdout).map_err(|_| format!("aws {what} printed no JSON"))
}

/// The Pipes of this very queue that run, in the answer of `aws pipes list-pipes`, which has those of all queues whose names begin alike.
fn pipes(answer: &Value, arn: &str) -> Vec<Reader> {
    let all = answer["Pipes"].as_array().map(Vec::as_slice).unwrap_or_default();
    let of_queue = all
        .iter()
        .filter(|pipe| pipe["Source"].as_str().is_none_or(|source| source == arn));
    let names = of_queue.filter_map(|pipe| pipe["Name"].as_str()).map(clean);
    names
        .map(|name| Reader {
            what: format!("EventBridge Pipe {name}"),
            stop: format!("aws pipes stop-pipe --name {name}{}", region(arn)),
        })
        .collect()
}

/// The functions that read the queue, in the answer of `aws lambda list-event-source-mappings`.
fn mappings(answer: &Value, arn: &str) -> Vec<Reader> {
    let all = answer["EventSourceMappings"]
        .as_array()
        .map(Vec::as_slice)
        .unwrap_or_default();
    let is_on = |mapping: &&Value| {
        mapping["State"]
            .as_str()
            .is_none_or(|state| !["Disabled", "Deleting"].contains(&state))
    };
    let text = |mapping: &Value, key: &str| clean(mapping[key].as_str().unwrap_or("?"));
    all.iter()
        .filter(is_on)
        .map(|mapping| Reader {
            what: format!("Lambda function {}", text(mapping, "FunctionArn")),
            stop: format!(
                "aws lambda update-event-source-mapping --no-enabled --uuid {}{}",
                text(mapping, "UUID"),
                region(arn)
            ),
        })
        .collect()
}

/// The flag with the region of a queue, as its ARN names it: a Pipe and a mapping are where their queue is.
fn region(arn: &str) -> String {
    let region = arn.split(':').nth(3).filter(|region| !region.is_empty());
    region.map_or_else(String::new, |region| format!(" --region {}", clean(region)))
}

/// The same commands, for a person. The ARN is the answer of the first one.
fn by_hand(queue: &Queue) -> Vec<String> {
    let commands = [
        arn_command(queue),
        pipes_command(queue, "ARN"),
        mappings_command(queue, "ARN"),
    ];
    commands
        .iter()
        .map(|words| format!("aws {}", words.join(" ")))
        .collect()
}

impl Readers {
    /// The line of the table about them. Others may read the queue on purpose, so this is never a failure.
    pub(super) fn finding(&self) -> Finding {
        match self {
            Self::NoQueue => finding_of(Part::Readers, Mark::Open, "there is no queue"),
            Self::Nobody => finding_of(
                Part::Readers,
                Mark::Works,
                "no running Pipe and no Lambda function reads the queue",
            ),
            Self::Unknown { why, commands } => Finding {
                step: Some("Look for another reader of the queue; both answers should be empty:".to_owned()),
                commands: commands.clone(),
                ..finding_of(Part::Readers, Mark::Open, format!("not known: {why}"))
            },
            Self::Found(readers) => {
                let names: Vec<&str> = readers.iter().map(|reader| reader.what.as_str()).collect();
                Finding {
                    step: Some("Stop it, or it takes a part of the messages:".to_owned()),
                    commands: readers.iter().map(|reader| reader.stop.clone()).collect(),
                    ..finding_of(
                        Part::Readers,
                        Mark::Note,
                        format!("{} also reads the queue", names.join(", ")),
                    )
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn queue() -> Queue {
        let queue = json!({"url": "https://sqs.eu-west-1.amazonaws.com/1/carla", "region": "eu-west-1"});
        serde_json::from_value(queue).unwrap()
    }

    #[test]
    fn the_commands_name_the_queue_and_its_region() {
        assert_eq!(
            by_hand(&queue()),
            [
                "aws sqs get-queue-attributes --queue-url https://sqs.eu-west-1.amazonaws.com/1/carla --attribute-names QueueArn \
                 --output json --region eu-west-1",
                "aws pipes list-pipes --source-prefix ARN --current-state RUNNING --output json --region eu-west-1",
                "aws lambda list-event-source-mappings --event-source-arn ARN --output json --region eu-west-1",
            ]
        );
    }

    #[test]
    fn only_what_is_on_is_a_reader() {
        let arn = "arn:aws:sqs:eu-west-1:1:carla";
        let pipe = |name: &str, queue: &str| json!({"Name": name, "Source": queue, "CurrentState": "RUNNING"});
        let of_dead_letters = pipe("of-dead-letters", "arn:aws:sqs:eu-west-1:1:carla-dead");
        let answer = json!({"Pipes": [of_dead_letters, pipe("old-pipeline", arn), {"Arn": "x"}]});
        assert_eq!(
            pipes(&answer, arn),
            [Reader {
                what: "EventBridge Pipe old-pipeline".into(),
                stop: "aws pipes stop-pipe --name old-pipeline --region eu-west-1".into()
            }]
        );
        assert_eq!(pipes(&json!({}), arn), []);
        let mapping = |state: &str| json!({"UUID": state, "FunctionArn": "arn:f", "State": state});
        let answer = json!({"EventSourceMappings": [mapping("Enabled"), mapping("Disabled"), mapping("Creating")]});
        let found: Vec<String> = mappings(&answer, arn).into_iter().map(|reader| reader.stop).collect();
        assert_eq!(
            found,
            ["Enabled", "Creating"].map(|id| format!(
                "aws lambda update-event-source-mapping --no-enabled --uuid {id} --region eu-west-1"
            ))
        );
        assert_eq!(region("?"), "", "a stand-in may name no ARN");
    }

    #[test]
    fn another_reader_is_a_note_and_never_a_failure() {
        let reader = Reader {
            what: "EventBridge Pipe old".into(),
            stop: "aws pipes stop-pipe --name old".into(),
        };
        let unknown = Readers::Unknown {
            why: "the program aws is not on the PATH".into(),
            commands: by_hand(&queue()),
        };
        for (readers, mark, commands) in [
            (Readers::Nobody, Mark::Works, 0),
            (Readers::Found(vec![reader]), Mark::Note, 1),
            (unknown, Mark::Open, 3),
        ] {
            let finding = readers.finding();
            assert_eq!((finding.mark, finding.commands.len()), (mark, commands), "{finding:?}");
        }
    }
}
