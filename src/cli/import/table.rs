//! Makes Submissions from the rows of a table: reads the table with the person's AWS credentials, and writes to the API server with
//! the person's kubeconfig. Nothing else is written.

use std::process::ExitCode;

use jiff::Timestamp;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;
use kube::api::{ListParams, PostParams};
use kube::{Api, Client, ResourceExt};
use leaderboard_api::client_errors;
use leaderboard_api::text::{LONGEST_MESSAGE, one_line};
use leaderboard_api::{ImportedEnd, Leaderboard, Submission, SubmissionStatus};
use serde_json::{Value, json};

use super::plan::Document;
use super::rows::{self, Outcome};
use super::{Import, print, write_out};
use crate::cli::serve;
use crate::controller::writes::apply_status;
use crate::kubernetes::{CallError, call};
use crate::services::aws::Aws;
use crate::services::table::{Table, TableError};

/// Field manager of what this command creates.
const MANAGER: &str = "leaderboard-operator/import";

/// Why not all rows were imported. What was done is kept: the command can be repeated.
#[derive(thiserror::Error, Debug)]
pub(super) enum TableFailure {
    #[error("{0}")]
    Cluster(String),
    #[error(
        "no Leaderboard of the namespace {namespace} has the table {table}; apply the Leaderboards first, or choose another --namespace"
    )]
    NoLeaderboard { namespace: String, table: String },
    #[error("{0}")]
    Table(#[from] TableError),
    #[error("{name}: {why}; fix this and repeat the command, which leaves alone what is there")]
    Object { name: String, why: String },
    #[error("the Submissions cannot be printed: {0}")]
    Print(#[from] serde_saphyr::ser::Error),
    #[error("{0}")]
    Output(#[from] std::io::Error),
}

impl From<kube::Error> for TableFailure {
    fn from(error: kube::Error) -> Self {
        Self::Cluster(client_errors::kube(&error))
    }
}

/// What was done, by kind.
#[derive(Default)]
struct Counts {
    imported: usize,
    adopted: usize,
    there: usize,
    undecided: usize,
    refused: usize,
}

/// Imports all rows of a table. The exit code is 0 if the API server has refused none of them.
pub(super) async fn import(aws: &Aws, options: &Import, name: &str) -> Result<ExitCode, TableFailure> {
    let config = serve::cluster("import").await.map_err(TableFailure::Cluster)?;
    let client = Client::try_from(config)?;
    let boards = boards(&client, &options.namespace, name).await?;
    let table = table(aws, options, &boards, name).await?;
    let mut rows = table.rows().await?;
    rows.sort_by(|a, b| (&a.run_id, &a.team_id).cmp(&(&b.run_id, &b.team_id)));
    let mut counts = Counts::default();
    for row in &rows {
        match rows::outcome(row, &boards, name) {
            Outcome::Undecided(why) => {
                counts.undecided += 1;
                let (run, team) = (one_line(&row.run_id, 64), one_line(&row.team_id, 64));
                eprintln!("undecided: submission {run} of team {team}: {why}");
            }
            Outcome::Ended(ended) if options.dry_run => show(&ended.0, Some(&ended.1), &mut counts)?,
            Outcome::Adopted(submission) if options.dry_run => show(&submission, None, &mut counts)?,
            Outcome::Ended(ended) => make(&client, &ended.0, Some(ended.1), &mut counts).await?,
            Outcome::Adopted(submission) => make(&client, &submission, None, &mut counts).await?,
        }
    }
    eprintln!("{}", counts.line(rows.len(), options.dry_run));
    Ok(if counts.refused == 0 {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    })
}

impl Counts {
    fn line(&self, rows: usize, dry_run: bool) -> String {
        let Self {
            imported,
            adopted,
            there,
            undecided,
            refused,
        } = self;
        let make = if dry_run { "would make" } else { "made" };
        let go = if *adopted == 1 { "goes" } else { "go" };
        let refused = match refused {
            0 => String::new(),
            number => format!("; {number} refused by the API server: correct what it names and repeat the command"),
        };
        format!(
            "{rows} rows: {make} {imported} that have ended, {adopted} that {go} on; {there} were there already; {undecided} undecided{refused}"
        )
    }
}

/// The Leaderboards that name the table.
async fn boards(client: &Client, namespace: &str, table: &str) -> Result<Vec<Leaderboard>, TableFailure> {
    let api: Api<Leaderboard> = Api::namespaced(client.clone(), namespace);
    let mut found = api.list(&ListParams::default()).await?.items;
    found.retain(|board| board.spec.table.as_ref().is_some_and(|of| of.name == table));
    if found.is_empty() {
        let (namespace, table) = (namespace.to_owned(), table.to_owned());
        return Err(TableFailure::NoLeaderboard { namespace, table });
    }
    Ok(found)
}

/// The table as a Leaderboard names it, from where the person reaches it.
async fn table(aws: &Aws, options: &Import, boards: &[Leaderboard], name: &str) -> Result<Table, TableFailure> {
    let named = boards.iter().find_map(|board| board.spec.table.clone());
    let mut spec = named.unwrap_or_else(|| leaderboard_api::Table {
        name: name.to_owned(),
        region: None,
        endpoint: None,
        partition_key: None,
        sort_key: None,
    });
    spec.region = options.region.clone().or(spec.region);
    spec.endpoint = options.endpoint.clone().or(spec.endpoint);
    Ok(Table::describe(aws, &spec).await?)
}

/// Prints what would be made.
fn show(submission: &Submission, end: Option<&ImportedEnd>, counts: &mut Counts) -> Result<(), TableFailure> {
    let mut object = json!(submission);
    if let Some(end) = end {
        counts.imported += 1;
        object["status"] = json!(status(submission, end.clone()));
    } else {
        counts.adopted += 1;
    }
    without_nulls(&mut object);
    let document = Document {
        comment: None,
        object,
        notes: Vec::new(),
    };
    write_out(&format!("---\n{}", print::document(&document)?))?;
    Ok(())
}

fn without_nulls(value: &mut Value) {
    if let Value::Object(fields) = value {
        fields.retain(|_, field| !field.is_null());
        fields.values_mut().for_each(without_nulls);
    }
}

fn status(submission: &Submission, end: ImportedEnd) -> SubmissionStatus {
    let generation = submission.metadata.generation.unwrap_or(1);
    SubmissionStatus::of_imported(&submission.spec, end, generation, &Time(Timestamp::now()))
}

/// Makes a Submission with its status. One that the API server refuses is counted, and keeps no other waiting: a participant may have
/// written the row.
async fn make(
    client: &Client,
    submission: &Submission,
    end: Option<ImportedEnd>,
    counts: &mut Counts,
) -> Result<(), TableFailure> {
    let name = submission.name_any();
    match write(client, submission, end, counts).await {
        Err(error) if is_of_one_object(&error) => {
            counts.refused += 1;
            eprintln!("refused: {name}: {}", one_line(&error.to_string(), LONGEST_MESSAGE));
            Ok(())
        }
        written => written.map_err(|error| TableFailure::Object {
            name,
            why: error.to_string(),
        }),
    }
}

/// Whether the API server refuses this object: by its definition, a policy, a webhook or a quota. It may take the next one.
fn is_of_one_object(error: &CallError) -> bool {
    error
        .status()
        .is_some_and(|status| [400, 403, 422].contains(&status.code))
}

/// Makes a Submission, then its status. One that is there already is left as it is, unless only its status is missing.
async fn write(
    client: &Client,
    submission: &Submission,
    end: Option<ImportedEnd>,
    counts: &mut Counts,
) -> Result<(), CallError> {
    let (name, namespace) = (submission.name_any(), submission.namespace().unwrap_or_default());
    let api: Api<Submission> = Api::namespaced(client.clone(), &namespace);
    let described = format!("Submission {name}");
    let params = PostParams {
        field_manager: Some(MANAGER.to_owned()),
        ..PostParams::default()
    };
    let made = match call("the creation", &described, api.create(&params, submission)).await {
        Err(error) if error.is_conflict() => {
            let there = call("the read", &described, api.get(&name)).await?;
            if !there.awaits_import() {
                counts.there += 1;
                eprintln!("{name}: is there already, and left as it is");
                return Ok(());
            }
            there
        }
        other => other?,
    };
    let Some(end) = end else {
        counts.adopted += 1;
        eprintln!(
            "{name}: made; attempt {} goes on from what is stored",
            made.spec.attempt
        );
        return Ok(());
    };
    let status = status(&made, end);
    apply_status(client, &made, &status).await?;
    counts.imported += 1;
    let score = status.score.as_ref().map(|score| format!(", score {}", score.text));
    let state = status.state_of_conditions().as_str();
    eprintln!("{name}: imported as {state}{}", score.unwrap_or_default());
    Ok(())
}

#[cfg(test)]
mod tests {
    use kube::core::Status;

    use super::*;

    #[tokio::test]
    async fn only_a_refusal_of_one_object_lets_the_command_go_on() {
        for (code, expected) in [
            (400, true),
            (403, true),
            (422, true),
            (401, false),
            (404, false),
            (409, false),
            (429, false),
            (500, false),
            (503, false),
        ] {
            let status = Status::failure("No.", "Reason").with_code(code).boxed();
            let refused = async { Err::<(), _>(kube::Error::Api(status)) };
            let error = call("the status", "one", refused).await.unwrap_err();
            assert_eq!(is_of_one_object(&error), expected, "{code}");
        }
    }

    #[test]
    fn the_last_line_counts_what_was_refused() {
        let mut counts = Counts {
            imported: 1,
            ..Counts::default()
        };
        let line = "3 rows: made 1 that have ended, 0 that go on; 0 were there already; 0 undecided";
        assert_eq!(counts.line(3, false), line);
        counts.refused = 2;
        let refused = "; 2 refused by the API server: correct what it names and repeat the command";
        assert_eq!(counts.line(3, false), format!("{line}{refused}"));
    }
}
