//! The kind `Submission`: one participant's image or file on one track, small enough to be written by hand.
//!
//! Owns the spec and its rules; the status is in `submission_status`. `ingest` creates and bumps it, people apply it.

use kube::{CustomResource, KubeSchema};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::attempt::Attempt;
use super::submission_status::SubmissionStatus;
use super::submitted_file::SubmittedFile;
use super::team::{Team, TeamStatus};

/// One participant's image or file on one track of a Leaderboard.
#[derive(CustomResource, KubeSchema, Serialize, Deserialize, Clone, Debug, Default, PartialEq)]
#[kube(
    group = "leaderboard.carla.org",
    version = "v1alpha1",
    kind = "Submission",
    plural = "submissions",
    shortname = "lbsub",
    category = "challenges",
    namespaced,
    status = "SubmissionStatus",
    doc = "One participant's image or file on one track of a Leaderboard.",
    derive = "PartialEq",
    derive = "Default",
    selectable = ".spec.leaderboardName",
    selectable = ".spec.evalai.submission",
    selectable = ".status.state",
    validation = Rule::new("size(self.metadata.name) <= 52").message("metadata.name may have at most 52 characters: Jobs and Pods add the attempt to it"),
    validation = Rule::new("!has(self.spec.check) || !self.spec.check || self.metadata.name.startsWith('check-')").message("the name of a check begins with check-: its results then have a prefix that is no submission's"),
    validation = Rule::new("!self.metadata.name.contains('.')").message("metadata.name may not contain a dot: it becomes the name of a Job and a label"),
    validation = Rule::new("!has(oldSelf.status) || !has(oldSelf.status.conditions) || !oldSelf.status.conditions.exists(c, c.type == 'Succeeded' && c.status == 'True') || self.spec.attempt == oldSelf.spec.attempt").message("a finished submission is not resumed; submit it again"),
    printcolumn = r#"{"name":"Team","type":"string","jsonPath":".status.team.displayName"}"#,
    printcolumn = r#"{"name":"Track","type":"string","jsonPath":".status.track"}"#,
    printcolumn = r#"{"name":"State","type":"string","jsonPath":".status.state"}"#,
    printcolumn = r#"{"name":"Reason","type":"string","jsonPath":".status.reason"}"#,
    printcolumn = r#"{"name":"Progress","type":"string","jsonPath":".status.progress.text"}"#,
    printcolumn = r#"{"name":"Score","type":"string","jsonPath":".status.score.text"}"#,
    printcolumn = r#"{"name":"Queue","type":"string","jsonPath":".status.waiting.text"}"#,
    printcolumn = r#"{"name":"Age","type":"date","jsonPath":".metadata.creationTimestamp"}"#,
    printcolumn = r#"{"name":"Leaderboard","type":"string","jsonPath":".spec.leaderboardName","priority":1}"#,
    printcolumn = r#"{"name":"Attempt","type":"integer","jsonPath":".status.attempt","priority":1}"#,
    printcolumn = r#"{"name":"Failure","type":"string","jsonPath":".status.failure.class","priority":1}"#,
    printcolumn = r#"{"name":"Published","type":"string","jsonPath":".status.conditions[?(@.type==\"Published\")].reason","priority":1}"#,
    printcolumn = r#"{"name":"Duration","type":"string","jsonPath":".status.duration","priority":1}"#,
    printcolumn = r#"{"name":"Node","type":"string","jsonPath":".status.nodeName","priority":1}"#,
    printcolumn = r#"{"name":"Results","type":"string","jsonPath":".status.resultsURL","priority":1}"#
)]
#[serde(rename_all = "camelCase")]
#[x_kube(
    validation = Rule::new("self.leaderboardName == oldSelf.leaderboardName").message("leaderboardName is immutable; apply a new Submission"),
    validation = Rule::new("has(self.image) == has(oldSelf.image) && (!has(self.image) || self.image == oldSelf.image)").message("image is immutable; apply a new Submission"),
    validation = Rule::new("has(self.evalai) == has(oldSelf.evalai) && (!has(self.evalai) || self.evalai == oldSelf.evalai)").message("evalai is immutable; apply a new Submission"),
    validation = Rule::new("has(self.track) == has(oldSelf.track) && (!has(self.track) || self.track == oldSelf.track)").message("track is immutable; apply a new Submission"),
    validation = Rule::new("(has(self.check) && self.check) == (has(oldSelf.check) && oldSelf.check)").message("check is immutable; run another check"),
    validation = Rule::new("!has(self.check) || !self.check || !(has(self.evalai) || has(self.team))").message("a check has neither evalai nor team: it is published and recorded nowhere"),
    validation = Rule::new("has(self.evalai) != has(self.track)").message("a Submission has either evalai (its phase names the track) or a track, not both and not neither"),
    validation = Rule::new("has(self.input) == has(oldSelf.input) && (!has(self.input) || self.input == oldSelf.input)").message("input is immutable; apply a new Submission"),
    validation = Rule::new("has(self.evalai) || has(self.image) || has(self.input)").message("a Submission without evalai needs an image or an input"),
    validation = Rule::new("!has(self.input) || !(has(self.image) || has(self.evalai))").message("a Submission has one of image, input and evalai's own file: leave input out beside image or evalai"),
    validation = Rule::new("self.attempt >= oldSelf.attempt").message("attempt may only grow"),
    validation = Rule::new("self.attempt == oldSelf.attempt || !self.cancel").message("to resume, set cancel to false together with the higher attempt"),
    validation = Rule::new("!oldSelf.cancel || self.cancel || self.attempt > oldSelf.attempt").message("a cancel is undone only by a higher attempt: set cancel to false and raise attempt in one patch")
)]
pub struct SubmissionSpec {
    /// Name of the Leaderboard in the same namespace.
    #[schemars(length(min = 1, max = 52))]
    pub leaderboard_name: String,
    /// The participant's image; asked from EvalAI when absent. A Leaderboard of the mode Predictions takes files and no image.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(min = 1, max = 512), regex(pattern = r"^[a-z0-9][!-~]*$"))]
    pub image: Option<String>,
    /// The participant's file, for a Leaderboard of the mode Predictions. It lies in the bucket, below the run's prefix at `input/file`;
    /// `submit --file` of the plugin puts it there.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub input: Option<SubmittedFile>,
    /// Identity of the submission in EvalAI.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub evalai: Option<EvalaiRef>,
    /// Name of the track, for a submission that is not EvalAI's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(min = 1, max = 32))]
    pub track: Option<String>,
    /// A check of the Leaderboard: it does the first unit of work with one worker, goes first in line, starts while the Leaderboard is
    /// paused, and is published and recorded nowhere. Its name begins with `check-`.
    #[serde(default, skip_serializing_if = "is_false")]
    pub check: bool,
    /// Team that submitted; asked from EvalAI when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub team: Option<Team>,
    /// Priority within a team; a higher number goes first.
    #[serde(default)]
    #[schemars(range(min = -1000, max = 1000))]
    pub priority: i32,
    /// Number of the attempt; a higher one runs it again from what is stored, and a live run stores its results and stops first. Manifests in git leave it out.
    #[serde(default)]
    #[schemars(range(min = 1, max = 9999))]
    pub attempt: Attempt,
    /// Stops the present attempt and keeps its results; manifests in git leave it out.
    #[serde(default)]
    pub cancel: bool,
}

impl Submission {
    /// Id of the team as it was accepted, else as it was submitted; the name where there is no id.
    pub fn team(&self) -> Option<&str> {
        let accepted = self.status.as_ref().and_then(|status| status.team.as_ref());
        let accepted = accepted.and_then(|team| team.id.as_deref().or(team.name.as_deref()));
        let given = self.spec.team.as_ref();
        accepted.or_else(|| given.and_then(|team| team.id.as_deref().or(team.name.as_deref())))
    }

    /// Name of the team, else its id.
    pub fn team_name(&self) -> Option<String> {
        let given = self.spec.team.clone().map(TeamStatus::from);
        let accepted = self.status.as_ref().and_then(|status| status.team.as_ref());
        let team = accepted.or(given.as_ref())?;
        team.name.clone().or_else(|| team.id.clone())
    }
}

/// A submission's ids in EvalAI.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct EvalaiRef {
    /// Id of the challenge.
    #[schemars(range(min = 1))]
    pub challenge: i64,
    /// Id of the phase.
    #[schemars(range(min = 1))]
    pub phase: i64,
    /// Id of the submission.
    #[schemars(range(min = 1))]
    pub submission: i64,
}

#[allow(clippy::trivially_copy_pass_by_ref, reason = "the signature is serde's")]
fn is_false(value: &bool) -> bool {
    !*value
}
