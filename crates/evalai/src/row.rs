//! Submissions, phases and splits as EvalAI shows them, parsed at the edge.
//!
//! Called by `client`. Pure. Only an id and a status are required: a field that changes its form must not blind us to
//! a cancellation.

use std::fmt;

use jiff::Timestamp;
use serde::{Deserialize, Deserializer};
use serde_json::Value;
use serde_json::value::RawValue;

use super::job_names::last_names;
use leaderboard_api::evalai_status::Status;
use leaderboard_api::text::{LONGEST_NAME, one_line};
use leaderboard_api::{Attempt, ImageReference, Order, names};

/// A submission as EvalAI shows it to a host.
#[derive(Clone, Debug, PartialEq)]
pub struct Row {
    /// Its id.
    pub id: i64,
    /// Where it stands; [`Status::Deleted`] or [`Status::Ignored`] if it was deleted.
    pub status: Status,
    /// Id of its phase.
    pub phase: Option<i64>,
    /// Id of the team.
    pub team_id: Option<i64>,
    /// Name of the team.
    pub team_name: Option<String>,
    /// When it was submitted; a re-run keeps the time of the old row.
    pub submitted_at: Option<Timestamp>,
    /// When it was last re-run or resumed.
    pub resumed_at: Option<Timestamp>,
    /// When it last came to an end; a re-run keeps that of the old row.
    pub completed_at: Option<Timestamp>,
    /// Where the uploaded file is.
    pub input_file: Option<FileUrl>,
    /// The last of all `job_name` ever sent, in lower case.
    pub jobs: Vec<String>,
}

/// Where an uploaded file is. It may be presigned, so that anyone who has it can read the file: no `Debug` and no message shows it.
#[derive(Clone, PartialEq, Eq)]
pub struct FileUrl(String);

impl FileUrl {
    pub(crate) fn as_str(&self) -> &str {
        &self.0
    }
}

impl From<&str> for FileUrl {
    fn from(url: &str) -> Self {
        Self(url.to_owned())
    }
}

impl fmt::Debug for FileUrl {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str("FileUrl(…)")
    }
}

impl Row {
    /// The row of a submission that EvalAI does not have.
    pub fn missing(id: i64) -> Self {
        Self {
            id,
            status: Status::Missing,
            phase: None,
            team_id: None,
            team_name: None,
            submitted_at: None,
            resumed_at: None,
            completed_at: None,
            input_file: None,
            jobs: Vec::new(),
        }
    }

    /// When it last asked to be run.
    pub fn wanted_at(&self) -> Option<Timestamp> {
        self.resumed_at.or(self.submitted_at)
    }

    /// True if this Job was ever named to EvalAI.
    pub fn names(&self, job: &str) -> bool {
        let job = job.to_lowercase();
        self.jobs.contains(&job)
    }

    /// The highest attempt whose first Job it names as its own. A participant can edit the row, so a number that no Submission can have
    /// counts for nothing.
    pub fn last_attempt(&self) -> Option<Attempt> {
        let own = format!("{}-", names::submission(self.id));
        let numbers = self.jobs.iter().filter_map(|job| job.strip_prefix(&own)?.parse().ok());
        let attempts = numbers.map(Attempt);
        attempts
            .filter(|attempt| (Attempt::FIRST..Attempt::HIGHEST).contains(attempt))
            .max()
    }
}

impl<'de> Deserialize<'de> for Row {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        #[derive(Deserialize)]
        struct Raw {
            id: i64,
            status: String,
            #[serde(default)]
            ignore_submission: Value,
            #[serde(default)]
            challenge_phase: Value,
            #[serde(default)]
            participant_team: Value,
            #[serde(default)]
            participant_team_name: Value,
            #[serde(default)]
            submitted_at: Value,
            #[serde(default)]
            rerun_resumed_at: Value,
            #[serde(default)]
            completed_at: Value,
            #[serde(default)]
            input_file: Value,
            #[serde(default)]
            job_name: Box<RawValue>,
        }
        let raw = Raw::deserialize(deserializer)?;
        let text = |value: &Value| value.as_str().map(str::to_owned);
        let time = |value: &Value| value.as_str().and_then(|text| text.parse().ok());
        let ignored = raw.ignore_submission.as_bool() == Some(true);
        Ok(Self {
            id: raw.id,
            status: match Status::parse(&raw.status) {
                status if ignored && status.is_live() => Status::Deleted,
                _ if ignored => Status::Ignored,
                status => status,
            },
            phase: raw.challenge_phase.as_i64(),
            team_id: raw.participant_team.as_i64(),
            team_name: text(&raw.participant_team_name).map(|name| one_line(&name, LONGEST_NAME)),
            submitted_at: time(&raw.submitted_at),
            resumed_at: time(&raw.rerun_resumed_at),
            completed_at: time(&raw.completed_at),
            input_file: raw.input_file.as_str().map(FileUrl::from),
            jobs: last_names(&raw.job_name),
        })
    }
}

/// The settings of a challenge; the default is what EvalAI is taken to say where it says nothing.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(default)]
pub struct Challenge {
    /// EvalAI leaves the evaluation to the host.
    #[serde(rename = "remote_evaluation", deserialize_with = "is_not_false")]
    pub is_remote: bool,
    /// Participants submit images.
    #[serde(deserialize_with = "is_not_false")]
    pub is_docker_based: bool,
    /// An image writes predictions for a dataset that does not change.
    #[serde(rename = "is_static_dataset_code_upload", deserialize_with = "is_true")]
    pub is_static: bool,
}

impl Default for Challenge {
    fn default() -> Self {
        Self {
            is_remote: true,
            is_docker_based: true,
            is_static: false,
        }
    }
}

impl Challenge {
    /// True if its messages are of static code uploads.
    pub fn is_static_code_upload(self) -> bool {
        self.is_docker_based && self.is_static
    }
}

fn is_not_false<'de, D: Deserializer<'de>>(deserializer: D) -> Result<bool, D::Error> {
    Ok(Value::deserialize(deserializer)?.as_bool() != Some(false))
}

/// A phase of a challenge.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
pub struct Phase {
    /// Its id.
    pub id: i64,
    /// Its leaderboards show partial results.
    #[serde(
        default,
        rename = "is_partial_submission_evaluation_enabled",
        deserialize_with = "is_true"
    )]
    pub shows_partial: bool,
}

fn is_true<'de, D: Deserializer<'de>>(deserializer: D) -> Result<bool, D::Error> {
    Ok(Value::deserialize(deserializer)?.as_bool() == Some(true))
}

/// A leaderboard of a phase. The codename of its dataset split stands elsewhere.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
pub struct Split {
    /// Its own id.
    pub id: i64,
    /// Id of the phase.
    #[serde(rename = "challenge_phase")]
    pub phase: i64,
    /// Id of the dataset split.
    pub dataset_split: i64,
    /// The leaderboard's columns.
    #[serde(rename = "leaderboard_schema")]
    pub schema: Schema,
}

/// A leaderboard's columns.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
pub struct Schema {
    /// The metrics it knows.
    pub labels: Vec<String>,
    /// The metric that ranks.
    #[serde(default, deserialize_with = "any_text")]
    pub default_order_by: Option<String>,
    /// What it says of each metric.
    #[serde(default)]
    pub metadata: Value,
}

impl Schema {
    /// Whether it names a metric that ranks, and not in which order.
    pub fn leaves_order_open(&self) -> bool {
        let metric = self.default_order_by.as_deref();
        metric.is_some_and(|metric| self.order(metric).is_none())
    }

    /// The order of a metric, as EvalAI reads it: what it says of a metric is ascending unless `sort_ascending` is false. None where it says
    /// nothing, and the leaderboard's own order holds.
    pub fn order(&self, metric: &str) -> Option<Order> {
        let about = self.metadata.get(metric).filter(|about| !about.is_null())?;
        Some(match about.get("sort_ascending") {
            Some(Value::Bool(false)) => Order::Descending,
            _ => Order::Ascending,
        })
    }
}

fn any_text<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<String>, D::Error> {
    Ok(Value::deserialize(deserializer)?.as_str().map(str::to_owned))
}

/// A leaderboard's own settings.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
pub struct PhaseSplit {
    /// Whether the highest value leads, where the schema says nothing of the metric.
    #[serde(rename = "is_leaderboard_order_descending")]
    pub is_descending: bool,
}

/// A message of a challenge's queue, or that there is none.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
pub struct Received {
    /// Its text, as JSON.
    #[serde(default)]
    pub body: Value,
    /// Handle that deletes it.
    #[serde(default)]
    pub receipt_handle: Option<String>,
}

/// A dataset split.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
pub struct DatasetSplit {
    /// Its name in results.
    pub codename: String,
}

/// The image that an uploaded file names, or why there is none.
pub fn image(file: &[u8]) -> Result<String, String> {
    let parsed: Value = serde_json::from_slice(file).map_err(|_| "the uploaded file is no JSON".to_owned())?;
    let image = parsed.get("submitted_image_uri").and_then(Value::as_str);
    let image = image
        .ok_or_else(|| "the uploaded file has no submitted_image_uri".to_owned())?
        .trim();
    match ImageReference::parse(image) {
        Ok(_) => Ok(image.to_owned()),
        Err(why) => Err(format!(
            "submitted_image_uri in the uploaded file is not a valid image reference: {why}"
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn a_row_is_read() {
        let row: Row = serde_json::from_value(json!({
            "id": 7, "status": "queued", "ignore_submission": false, "challenge_phase": 1, "participant_team": 3,
            "participant_team_name": "team-a", "submitted_at": "2026-11-21T10:09:08.123456Z",
            "rerun_resumed_at": null, "input_file": "http://e/media/x.json", "job_name": ["Submission-7-1"], "is_public": true,
        }))
        .unwrap();
        assert_eq!(
            (row.id, row.status, row.phase, row.team_id),
            (7, Status::Queued, Some(1), Some(3))
        );
        assert_eq!(row.wanted_at(), row.submitted_at);
        assert!(row.names("submission-7-1") && row.names("SUBMISSION-7-1") && !row.names("submission-7-2"));
    }

    #[test]
    fn a_teams_name_is_one_harmless_line() {
        let row: Row = serde_json::from_value(json!({
            "id": 7, "status": "queued", "participant_team_name": "Team\u{1b}[2J\n\u{202e}Seven",
        }))
        .unwrap();
        assert_eq!(row.team_name.as_deref(), Some("Team\u{fffd}[2J \u{fffd}Seven"));
    }

    #[test]
    fn odd_fields_hide_no_status() {
        let row: Row = serde_json::from_value(json!({
            "id": 7, "status": "cancelled", "challenge_phase": "one", "submitted_at": "yesterday", "job_name": "x",
        }))
        .unwrap();
        assert_eq!(
            (row.status, row.phase, row.submitted_at, row.jobs.len()),
            (Status::Cancelled, None, None, 0)
        );
        assert!(serde_json::from_value::<Row>(json!({"id": 7})).is_err());
    }

    #[test]
    fn a_metric_is_ordered_as_evalai_reads_its_schema() {
        let of = |schema: Value| serde_json::from_value::<Schema>(schema).unwrap();
        let about = |about: Value| of(json!({"labels": ["A"], "default_order_by": "A", "metadata": {"A": about}}));
        for (said, expected) in [
            (json!({"sort_ascending": true}), Some(Order::Ascending)),
            (json!({"sort_ascending": false}), Some(Order::Descending)),
            (json!({"description": "x"}), Some(Order::Ascending)),
            (json!({"sort_ascending": null}), Some(Order::Ascending)),
            (json!({}), Some(Order::Ascending)),
            (json!(null), None),
        ] {
            assert_eq!(about(said.clone()).order("A"), expected, "{said}");
        }
        assert_eq!(about(json!({})).order("B"), None);
        for odd in [
            json!({"labels": []}),
            json!({"labels": [], "default_order_by": 7, "metadata": "x"}),
        ] {
            let schema = of(odd);
            assert_eq!((schema.default_order_by.clone(), schema.order("A")), (None, None));
        }
    }

    #[test]
    fn a_phase_shows_partial_results_only_where_it_is_set_to() {
        let of = |phase: Value| serde_json::from_value::<Phase>(phase).unwrap().shows_partial;
        let name = "is_partial_submission_evaluation_enabled";
        assert!(of(json!({"id": 1, name: true, "slug": "x"})));
        for odd in [json!(false), json!(null), json!("true"), json!(1)] {
            assert!(!of(json!({"id": 1, name: odd})));
        }
        assert!(!of(json!({"id": 1})));
    }

    #[test]
    fn a_challenge_is_evaluated_by_its_host_unless_evalai_denies_it() {
        for (settings, expected) in [
            (json!({"id": 1, "remote_evaluation": false}), false),
            (json!({"id": 1, "remote_evaluation": true}), true),
            (json!({"id": 1, "remote_evaluation": null}), true),
            (json!({"id": 1, "remote_evaluation": "false"}), true),
            (json!({"id": 1}), true),
        ] {
            let challenge: Challenge = serde_json::from_value(settings.clone()).unwrap();
            assert_eq!(challenge.is_remote, expected, "{settings}");
        }
    }

    #[test]
    fn a_challenge_has_static_code_uploads_only_where_it_takes_images() {
        let (images, is_static) = ("is_docker_based", "is_static_dataset_code_upload");
        for (settings, expected) in [
            (json!({}), false),
            (json!({images: true}), false),
            (json!({images: true, is_static: true}), true),
            (json!({is_static: true}), true),
            (json!({images: false, is_static: true}), false),
            (json!({images: true, is_static: "true"}), false),
        ] {
            let challenge: Challenge = serde_json::from_value(settings.clone()).unwrap();
            assert_eq!(challenge.is_static_code_upload(), expected, "{settings}");
        }
    }

    #[test]
    fn the_address_of_a_file_is_not_shown() {
        let url = "https://storage.example/x.csv?X-Amz-Signature=5ec2e7";
        let row: Row = serde_json::from_value(json!({"id": 7, "status": "queued", "input_file": url})).unwrap();
        let shown = format!("{row:?}");
        assert!(!shown.contains("5ec2e7") && !shown.contains("x.csv"), "{shown}");
        assert_eq!(row.input_file.unwrap().as_str(), url);
    }

    #[test]
    fn a_deleted_submission_is_recognized_by_whether_it_had_come_to_its_end() {
        for (status, deleted) in [
            ("submitted", Status::Deleted),
            ("running", Status::Deleted),
            ("partially_evaluated", Status::Deleted),
            ("finished", Status::Ignored),
            ("cancelled", Status::Ignored),
            ("evaluating", Status::Ignored),
        ] {
            let row = json!({"id": 7, "status": status, "ignore_submission": true});
            assert_eq!(serde_json::from_value::<Row>(row).unwrap().status, deleted, "{status}");
        }
    }

    #[test]
    fn an_uploaded_file_names_an_image_or_is_refused_with_the_reason() {
        let of = |value: Value| image(value.to_string().as_bytes());
        assert_eq!(
            of(json!({"submitted_image_uri": "registry.example/a:1"})),
            Ok("registry.example/a:1".into())
        );
        for (value, part) in [
            (json!({}), "no submitted_image_uri"),
            (json!({"submitted_image_uri": 1}), "no submitted_image_uri"),
            (
                json!({"submitted_image_uri": "two words"}),
                "not a valid image reference",
            ),
            (
                json!({"submitted_image_uri": ""}),
                "not a valid image reference: it is empty",
            ),
            (
                json!({"submitted_image_uri": "  "}),
                "not a valid image reference: it is empty",
            ),
            (json!({"submitted_image_uri": null}), "no submitted_image_uri"),
            (json!({"submitted_image_uri": {"a": 1}}), "no submitted_image_uri"),
            (json!({"submitted_image_uri": "x".repeat(513)}), "512 characters"),
            (json!({"submitted_image_uri": "team/Agent:1"}), "upper-case"),
            (json!({"submitted_image_uri": "ägent:1"}), "not ASCII"),
        ] {
            assert!(of(value).unwrap_err().contains(part));
        }
        assert!(image(b"<html>").unwrap_err().contains("no JSON"));
    }
}
