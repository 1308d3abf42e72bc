//! `leaderboard-operator import`: the entries of the original pipeline become manifests, and the rows of its table Submissions.
//!
//! `entries` parses, `plan` makes the objects and lays a person's `decisions` over them, `questions` has what is still open, `print`
//! writes: all pure. This file reads and writes. Standard output is YAML alone; what a person has to know is a comment of it and on
//! standard error.

mod collectors;
mod decisions;
mod entries;
mod options;
mod plan;
mod print;
mod questions;
mod rows;
#[cfg(test)]
#[path = "tests/samples.rs"]
mod samples;
mod table;
mod taint;

use std::io::{ErrorKind, Write as _};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::Args;
use jiff::Timestamp;

use self::collectors::Collectors;
use self::decisions::{DecisionError, Decisions};
use self::entries::{Board, EVALAI, EntryError, TRACKS, Texts};
use self::plan::PlanError;
use self::taint::Taint;
use crate::services::aws::Aws;
use crate::services::event_sources::{self, NotAQueue, QueueArn, Readers};
use crate::services::token::secret_text;

/// What the exit code means.
pub(super) const EXIT_CODES: &str = "Exit code 0: the manifests are printed, or the Submissions are made. 2: entries or arguments are \
    refused. 1: something can't be read or written, or the API server refuses a Submission, which keeps no other from being made.";

/// Print manifests from the original pipeline's entries in Secrets Manager, or make Submissions from the rows of its table.
#[derive(Args, Debug)]
#[allow(clippy::struct_excessive_bools, reason = "each is a flag of the command line")]
pub(super) struct Import {
    /// AWS region of the entries, or of the table. Default: AWS's own configuration.
    #[arg(long)]
    region: Option<String>,
    /// Endpoint in place of AWS's own, for stand-ins.
    #[arg(long)]
    endpoint: Option<String>,
    /// Read `evalai.json`, `evalai-tracks.json`, `leaderboard-10.json` and `leaderboard-20.json` of this folder in place of Secrets
    /// Manager.
    #[arg(long, value_name = "DIR", conflicts_with = "from_table")]
    from_files: Option<PathBuf>,
    /// A YAML file of what you have decided, laid over what is printed: parts of a Leaderboard's spec under `all`, `leaderboard-10` and
    /// `leaderboard-20`. Objects are laid over deep, lists as a whole, tracks by name, and null removes.
    #[arg(long, value_name = "FILE", conflicts_with = "from_table")]
    decisions: Option<PathBuf>,
    /// Id of the challenge in EvalAI, as in the address of its page. No entry holds it; --decisions may.
    #[arg(long, value_parser = clap::value_parser!(i64).range(1..), required_unless_present_any = ["from_table", "decisions"])]
    challenge: Option<i64>,
    /// Namespace of the objects.
    #[arg(long, default_value = "leaderboards")]
    namespace: String,
    /// URL of the SQS queue that EvalAI writes to.
    #[arg(long, conflicts_with = "from_table")]
    queue: Option<String>,
    /// AWS region of the queue, where its URL names none.
    #[arg(long, requires = "queue")]
    queue_region: Option<String>,
    /// URL of the queue for messages that cannot be used.
    #[arg(long, requires = "queue")]
    dead_letter: Option<String>,
    /// ServiceAccount of the Pods.
    #[arg(long, default_value = "submission-worker")]
    service_account: String,
    /// Role that the Pods assume.
    #[arg(long, value_name = "ARN")]
    role_arn: Option<String>,
    /// A range of addresses that the Pods may reach at port 443, such as 10.0.1.10/32. May be given several times.
    #[arg(long, value_name = "CIDR")]
    egress: Vec<String>,
    /// A taint of the GPU nodes, which every track is to tolerate, such as nvidia.com/gpu:NoSchedule. May be given several times.
    #[arg(long, value_name = "KEY[=VALUE]:EFFECT", conflicts_with = "from_table")]
    taint: Vec<Taint>,
    /// Print one of the two Leaderboards only.
    #[arg(long, value_enum)]
    only: Option<Board>,
    /// Each Leaderboard has a cluster and an operator of its own: they share the queue and EvalAI's requests.
    #[arg(long)]
    two_operators: bool,
    /// Make Submissions from the rows of this DynamoDB table, which the namespace's Leaderboards name. One that the API server refuses
    /// is reported, and the others are made.
    #[arg(long, value_name = "TABLE")]
    from_table: Option<String>,
    /// Print the Submissions of a table instead of making them.
    #[arg(long, requires = "from_table")]
    dry_run: bool,
}

/// Why nothing, or not all, was done.
#[derive(thiserror::Error, Debug)]
enum Failure {
    #[error("{}", .0.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n"))]
    Entries(Vec<EntryError>),
    #[error("{}", .0.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n"))]
    Decisions(Vec<DecisionError>),
    #[error("--queue: {0}")]
    Queue(#[from] NotAQueue),
    #[error("no AWS region is configured; give --region, that of the entries")]
    NoRegion,
    #[error("{0}")]
    Plan(#[from] PlanError),
    #[error("--decisions: {path}: {error}")]
    DecisionsFile { path: String, error: std::io::Error },
    #[error(
        "{path}: {error}; --from-files needs {EVALAI}.json, {TRACKS}.json and one file for each Leaderboard (--only takes one)"
    )]
    File { path: String, error: std::io::Error },
    #[error(
        "the entry {id} of Secrets Manager could not be read ({why}); check --region and secretsmanager:GetSecretValue, or leave \
         the other Leaderboard out with --only"
    )]
    Secret { id: &'static str, why: String },
    #[error("{0}")]
    Table(#[from] table::TableFailure),
    #[error("the manifests cannot be printed: {0}")]
    Print(#[from] serde_saphyr::ser::Error),
    #[error("{0}")]
    Output(#[from] std::io::Error),
}

impl Failure {
    fn exit_code(&self) -> ExitCode {
        match self {
            Self::Entries(_)
            | Self::Decisions(_)
            | Self::Queue(_)
            | Self::NoRegion
            | Self::Plan(PlanError::Decisions(_) | PlanError::NoChallenge) => ExitCode::from(2),
            _ => ExitCode::FAILURE,
        }
    }
}

impl Import {
    pub(super) fn run(self) -> ExitCode {
        // It fails only where a provider is installed already, which serves as well.
        let _ = rustls::crypto::ring::default_provider().install_default();
        let runtime = match tokio::runtime::Builder::new_current_thread().enable_all().build() {
            Ok(runtime) => runtime,
            Err(error) => {
                eprintln!("leaderboard-operator import: no thread can be started: {error}");
                return ExitCode::FAILURE;
            }
        };
        match runtime.block_on(Box::pin(self.import())) {
            Ok(code) => code,
            Err(failure) => {
                eprintln!("leaderboard-operator import: {failure}");
                failure.exit_code()
            }
        }
    }

    async fn import(&self) -> Result<ExitCode, Failure> {
        let aws = Aws::load("import").await;
        match &self.from_table {
            Some(table) => Ok(table::import(&aws, self, table).await?),
            None => self.manifests(&aws).await.map(|()| ExitCode::SUCCESS),
        }
    }

    async fn manifests(&self, aws: &Aws) -> Result<(), Failure> {
        let region = self.region.clone().or_else(|| aws.region()).ok_or(Failure::NoRegion)?;
        let boards = self.only.map_or(Board::ALL.to_vec(), |board| vec![board]);
        let texts = self.texts(aws, &region, &boards).await?;
        let entries = entries::parse(&texts, &boards).map_err(Failure::Entries)?;
        let decisions = self.decisions()?;
        let options = self.options(region)?;
        let mut import = plan::plan(&entries, &options, &decisions, Timestamp::now())?;
        let mut readers = Vec::new();
        for (url, region) in &import.queues {
            let queue = QueueArn::of_url(url, region.as_deref().or(Some(options.region.as_str())))?;
            let found = event_sources::readers(aws, &queue, self.endpoint.as_deref()).await;
            readers.extend(reader_lines(&queue, &found));
        }
        let collectors = self.collectors(&mut import).await;
        let found = [("Other readers of the queue", readers), ("Log collectors", collectors)];
        let text = print::yaml(&import, &self.heading(&options), &found)?;
        let [(_, readers), (_, collectors)] = &found;
        // What a person has to know goes before the manifests, and is not lost in a pipe.
        for (title, lines) in [
            ("other readers of the queue", readers),
            ("log collectors", collectors),
            ("not taken over", &import.dropped),
            ("to decide", &import.decide),
        ] {
            for line in lines {
                eprintln!("{title}: {line}");
            }
        }
        write_out(&text)?;
        Ok(())
    }

    /// What else would store the lines. Where nothing does, there is no question about it.
    async fn collectors(&self, import: &mut plan::Import) -> Vec<String> {
        if import.log_groups.is_empty() {
            return Vec::new();
        }
        let collectors: Collectors = collectors::ask().await;
        if collectors.is_nobody() {
            import.decide.retain(|question| question != questions::FLUENTD);
        }
        collectors.lines(&self.namespace, &import.log_groups)
    }

    fn options(&self, region: String) -> Result<options::Options, Failure> {
        let queue_region = self.queue_region.as_deref().or(Some(region.as_str()));
        let queue = self
            .queue
            .as_ref()
            .map(|url| QueueArn::of_url(url, queue_region).map(|arn| options::Queue { url: url.clone(), arn }));
        Ok(options::Options {
            queue: queue.transpose()?,
            namespace: self.namespace.clone(),
            service_account: self.service_account.clone(),
            role_arn: self.role_arn.clone(),
            region,
            endpoint: self.endpoint.clone(),
            challenge: self.challenge,
            dead_letter: self.dead_letter.clone(),
            egress: self.egress.clone(),
            taints: self.taint.clone(),
            two_operators: self.two_operators,
        })
    }

    fn decisions(&self) -> Result<Decisions, Failure> {
        let Some(path) = &self.decisions else {
            return Ok(Decisions::default());
        };
        let text = std::fs::read_to_string(path).map_err(|error| Failure::DecisionsFile {
            path: path.display().to_string(),
            error,
        })?;
        let name = path.file_name().unwrap_or(path.as_os_str());
        Decisions::parse(&name.to_string_lossy(), &text).map_err(Failure::Decisions)
    }

    fn heading(&self, options: &options::Options) -> String {
        let from = match &self.from_files {
            Some(_) => "files with the original pipeline's entries".to_owned(),
            None => format!(
                "the original pipeline's entries of Secrets Manager in {}",
                options.region
            ),
        };
        let decided = match self.decisions.as_ref().and_then(|path| path.file_name()) {
            Some(file) => format!(", with the decisions of {}", file.to_string_lossy()),
            None => String::new(),
        };
        format!("Made by `leaderboard-operator import` from {from}{decided}.")
    }

    /// The texts of the entries that are needed.
    async fn texts(&self, aws: &Aws, region: &str, boards: &[Board]) -> Result<Texts, Failure> {
        let mut texts = Texts::new();
        for entry in [EVALAI, TRACKS]
            .into_iter()
            .chain(boards.iter().map(|board| board.entry()))
        {
            let text = match &self.from_files {
                Some(folder) => file(&folder.join(format!("{entry}.json")))?,
                None => secret_text(aws, entry, Some(region), self.endpoint.as_deref())
                    .await
                    .map_err(|why| Failure::Secret { id: entry, why })?,
            };
            texts.insert(entry, text);
        }
        Ok(texts)
    }
}

fn file(path: &Path) -> Result<String, Failure> {
    std::fs::read_to_string(path).map_err(|error| Failure::File {
        path: path.display().to_string(),
        error,
    })
}

/// Writes to standard output. A closed pipe is ignored.
fn write_out(text: &str) -> std::io::Result<()> {
    match std::io::stdout().write_all(text.as_bytes()) {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => Err(error),
        _ => Ok(()),
    }
}

/// What is known of those who read the queue, as sentences.
fn reader_lines(queue: &QueueArn, readers: &Readers) -> Vec<String> {
    let found = readers.found.iter();
    let found = found.map(|source| {
        format!(
            "{source} reads {queue} and would take about half of the messages from the operator, at random; stop it before the \
             Leaderboards are applied: {}",
            source.stop()
        )
    });
    let unread = readers.unread.iter().map(|unread| {
        format!(
            "{} could not be listed: {}; check by hand: {}",
            unread.kind.what(),
            unread.why.trim_end_matches('.'),
            unread.kind.by_hand(queue)
        )
    });
    let mut lines: Vec<String> = found.chain(unread).collect();
    if lines.is_empty() {
        lines.push(format!(
            "none: no EventBridge Pipe runs on {queue}, and no Lambda function reads it"
        ));
    }
    lines
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::services::event_sources::{EventSource, Kind, Unread};

    #[test]
    fn each_reader_is_named_with_the_step_that_stops_it() {
        let queue = QueueArn::of_url("https://sqs.us-west-2.amazonaws.com/123456789012/leaderboard", None).unwrap();
        let pipe = EventSource::Pipe {
            name: "leaderboard".into(),
            region: "us-west-2".into(),
        };
        let unread = Unread {
            kind: Kind::Lambda,
            why: "AccessDeniedException: no".into(),
        };
        let readers = Readers {
            found: vec![pipe],
            unread: vec![unread],
        };
        let lines = reader_lines(&queue, &readers);
        assert_eq!(lines.len(), 2);
        assert!(
            lines[0].starts_with("EventBridge Pipe leaderboard reads arn:aws:sqs:us-west-2:123456789012:leaderboard ")
        );
        assert!(lines[0].ends_with(": aws pipes stop-pipe --name leaderboard --region us-west-2"));
        assert_eq!(
            lines[1],
            "Lambda's event source mappings could not be listed: AccessDeniedException: no; check by hand: aws lambda \
             list-event-source-mappings --event-source-arn arn:aws:sqs:us-west-2:123456789012:leaderboard --region us-west-2"
        );
        assert!(reader_lines(&queue, &Readers::default())[0].starts_with("none: "));
    }
}
