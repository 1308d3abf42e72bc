//! What the operator last saw of a Submission. Written by the controller's leader alone; read by people and the bridge.
//!
//! `state` is for people: it is computed from the conditions and never read back.

use std::fmt;
use std::str::FromStr;

use k8s_openapi::apimachinery::pkg::apis::meta::v1::{Condition, Time};
use kube::KubeSchema;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::leaderboard_parts::{LeaderboardVersion, Storage};
use super::submission::Team;
use super::text::{LONGEST_NAME, one_line};

/// Characters of a message in a status.
pub const MAX_MESSAGE: usize = 4096;

/// Where a submission stands, for people.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum State {
    Pending,
    Running,
    /// Running, with what an earlier attempt had stored.
    Resumed,
    Finished,
    Failed,
    Cancelled,
}

impl State {
    /// True for states that only a higher attempt leaves.
    pub fn is_terminal(self) -> bool {
        matches!(self, Self::Finished | Self::Failed | Self::Cancelled)
    }

    /// The text of the STATE column.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Pending => "Pending",
            Self::Running => "Running",
            Self::Resumed => "Resumed",
            Self::Finished => "Finished",
            Self::Failed => "Failed",
            Self::Cancelled => "Cancelled",
        }
    }
}

/// What the operator last observed of a Submission.
#[derive(Serialize, Deserialize, KubeSchema, Clone, Debug, Default, PartialEq)]
#[serde(rename_all = "camelCase")]
pub struct SubmissionStatus {
    /// For people, computed from the conditions.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub state: Option<State>,
    /// Generation of the spec that this status speaks of.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub observed_generation: Option<i64>,
    /// Attempt that this status speaks of.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub attempt: Option<i64>,
    /// Jobs of this attempt that infrastructure failures ended.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub retry: i32,
    /// Times the Job of this attempt had to be created again after somebody deleted it.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub recreated: i32,
    /// When the next Job of this attempt is made, after an infrastructure failure.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub next_retry_time: Option<Time>,
    /// Why it stands there, one of `api::reasons`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = 64))]
    pub reason: Option<String>,
    /// The same as a sentence.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = MAX_MESSAGE))]
    pub message: Option<String>,
    /// What holds the submission up at present, and since when.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub blocked_since: Option<BlockedSince>,
    /// Who submitted.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub team: Option<TeamStatus>,
    /// Name of the track.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = 32))]
    pub track: Option<String>,
    /// What is run, pinned at acceptance.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub plan: Option<RunPlan>,
    /// Routes that are done.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub progress: Option<Progress>,
    /// Each simulator-agent pair.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[x_kube(merge_strategy = ListMerge::Map(vec!["id".into()]))]
    #[schemars(length(max = 64))]
    pub pairs: Vec<PairStatus>,
    /// Mean scores over the routes that are done.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub score: Option<Score>,
    /// Place in line.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub waiting: Option<Waiting>,
    /// When what happened.
    #[serde(default, skip_serializing_if = "Times::is_empty")]
    pub times: Times,
    /// How long the run took, for people, such as `1h25m`; only once it has ended. `times` has it exactly.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = 32))]
    pub duration: Option<String>,
    /// Name of the present Job.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = 253))]
    pub job_name: Option<String>,
    /// Node of the present Pod.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = 253))]
    pub node_name: Option<String>,
    /// The submission that this one re-runs: EvalAI made a new row for it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rerun_of: Option<Rerun>,
    /// The submission that re-runs this one: EvalAI has cancelled this one's result. State, score and the table's row stay.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rerun_as: Option<Rerun>,
    /// Where the results are, `s3://bucket/prefix/id`.
    #[serde(rename = "resultsURL", default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = 2048))]
    pub results_url: Option<String>,
    /// What went wrong.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub failure: Option<Failure>,
    /// `Accepted`, `Running`, `Archived`, `Recorded`, `Published`, `Stalled`, `Finished`.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[schemars(schema_with = "super::conditions::schema")]
    pub conditions: Vec<Condition>,
}

impl SubmissionStatus {
    /// Cuts texts to what the definition allows: parts of them are a stranger's, and the API server refuses a status whose
    /// text is too long.
    pub fn fit(&mut self) {
        let failure = self.failure.iter_mut();
        let of_failure = failure.flat_map(|failure| {
            let others = [failure.next_step.as_mut(), failure.participant_message.as_mut()];
            others.into_iter().flatten().chain([&mut failure.message])
        });
        let of_conditions = self.conditions.iter_mut().map(|condition| &mut condition.message);
        for text in self.message.iter_mut().chain(of_failure).chain(of_conditions) {
            cut(text, MAX_MESSAGE);
        }
    }
}

fn cut(text: &mut String, longest: usize) {
    if let Some((end, _)) = text.char_indices().nth(longest) {
        text.truncate(end);
    }
}

/// What a run consists of, pinned when the submission is first accepted, so that an edited Leaderboard leaves it alone.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq)]
#[serde(rename_all = "camelCase")]
pub struct RunPlan {
    /// Run id: S3 prefix, sort key, log streams.
    #[schemars(length(max = 128))]
    pub run_id: String,
    /// Which Leaderboard it is of: chooses the format of the checkpoints, flags and defaults.
    pub leaderboard_version: LeaderboardVersion,
    /// Name of the track.
    #[schemars(length(max = 32))]
    pub track: String,
    /// CHALLENGE_TRACK_CODENAME.
    #[schemars(length(max = 64))]
    pub codename: String,
    /// EvalAI phase.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub phase: Option<i64>,
    /// Routes of each pair; their number is the number of pairs.
    #[schemars(length(max = 16))]
    pub slices: Vec<RouteSlice>,
    /// Routes, not counting repetitions.
    pub routes: i32,
    /// Repetitions of each route.
    pub repetitions: i32,
    /// Where the results go.
    pub storage: Storage,
    /// The participant's image.
    #[schemars(length(max = 1024))]
    pub image: String,
    /// Image of the contents, renewed by each attempt.
    #[schemars(length(max = 512))]
    pub contents_image: String,
    /// Image of the simulator, renewed by each attempt.
    #[schemars(length(max = 512))]
    pub simulator_image: String,
    /// True if the stored results of an earlier run are taken up.
    #[serde(default)]
    pub resume: bool,
}

/// Consecutive routes of one pair.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Copy, Debug, PartialEq, Eq)]
pub struct RouteSlice {
    /// The first one, counted from 0.
    #[schemars(range(min = 0, max = 99_999))]
    pub first: u32,
    /// The last one.
    #[schemars(range(min = 0, max = 99_999))]
    pub last: u32,
}

impl RouteSlice {
    /// How many routes it has.
    pub fn routes(self) -> u32 {
        self.last.saturating_sub(self.first).saturating_add(1)
    }
}

/// As the evaluator's `ROUTES_SUBSET` takes it: `5-9`.
impl fmt::Display for RouteSlice {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "{}-{}", self.first, self.last)
    }
}

/// A text that is not a [`RouteSlice`].
#[derive(thiserror::Error, Clone, Debug, PartialEq, Eq)]
#[error("{0:?} is not a range of routes; write first-last, for example 5-9")]
pub struct NotASlice(String);

impl FromStr for RouteSlice {
    type Err = NotASlice;

    fn from_str(text: &str) -> Result<Self, NotASlice> {
        let slice = text.split_once('-').and_then(|(first, last)| {
            Some(Self {
                first: first.parse().ok()?,
                last: last.parse().ok()?,
            })
        });
        slice
            .filter(|slice| slice.first <= slice.last)
            .ok_or_else(|| NotASlice(text.into()))
    }
}

/// Mean scores over the routes that are done, as decimal numbers.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq, Eq)]
#[serde(rename_all = "camelCase")]
pub struct Score {
    /// Driving score, 0 to 100.
    #[schemars(length(max = 32))]
    pub driving: String,
    /// Route completion in percent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = 32))]
    pub route_completion: Option<String>,
    /// Infraction penalty, 0 to 1: the factor that is left.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = 32))]
    pub infraction_penalty: Option<String>,
    /// Whether all routes are done. Until then the scores are those of the routes so far.
    #[serde(rename = "final")]
    pub is_final: bool,
    /// The driving score for people: `~41.20` over the routes so far, `43.13` when final.
    #[schemars(length(max = 33))]
    pub text: String,
}

impl Score {
    /// From the driving score, and the other two where they are known.
    pub fn new(driving: f64, route_completion: Option<f64>, infraction_penalty: Option<f64>, is_final: bool) -> Self {
        let driving = format!("{driving:.2}");
        Self {
            text: text_of(&driving, is_final),
            route_completion: route_completion.map(|percent| format!("{percent:.2}")),
            infraction_penalty: infraction_penalty.map(|factor| format!("{factor:.3}")),
            driving,
            is_final,
        }
    }

    /// The same as the score of a run that goes on.
    #[must_use]
    pub fn so_far(self) -> Self {
        Self {
            text: text_of(&self.driving, false),
            is_final: false,
            ..self
        }
    }
}

fn text_of(driving: &str, is_final: bool) -> String {
    let mark = if is_final { "" } else { "~" };
    format!("{mark}{driving}")
}

/// What holds a submission up, and since when.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq, Eq)]
pub struct BlockedSince {
    /// One of `api::reasons`.
    #[schemars(length(max = 64))]
    pub reason: String,
    /// Since when it has been the same reason.
    pub time: Time,
}

/// Who submitted, as it is shown.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, Default, PartialEq, Eq)]
#[serde(rename_all = "camelCase")]
pub struct TeamStatus {
    /// Id in EvalAI, in decimal; any text for a local submission.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = 128))]
    pub id: Option<String>,
    /// Name for people.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = 256))]
    pub name: Option<String>,
    /// The name, or else the id, in at most 24 characters: kubectl cuts no column.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = 24))]
    pub display_name: Option<String>,
}

impl From<Team> for TeamStatus {
    fn from(team: Team) -> Self {
        let shown = team.name.as_ref().or(team.id.as_ref());
        Self {
            display_name: shown.map(|name| one_line(name, 24)),
            id: team.id.map(|id| one_line(&id, 128)),
            name: team.name.map(|name| one_line(&name, LONGEST_NAME)),
        }
    }
}

/// The other submission of a re-run.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq, Eq)]
#[serde(rename_all = "camelCase")]
pub struct Rerun {
    /// Its name, in the same namespace.
    #[schemars(length(max = 253))]
    pub submission_name: String,
    /// When EvalAI made the new row.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub time: Option<Time>,
}

/// Routes that are done, over all pairs and repetitions.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq, Eq)]
pub struct Progress {
    pub done: i32,
    pub total: i32,
    /// `12/20`.
    #[schemars(length(max = 32))]
    pub text: String,
}

impl Progress {
    /// Progress with its text.
    pub fn new(done: i32, total: i32) -> Self {
        Self {
            done,
            total,
            text: format!("{done}/{total}"),
        }
    }
}

/// What a pair does.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum PairState {
    /// Its agent has not begun.
    #[default]
    Waiting,
    Running,
    Done,
    /// Its agent or its simulator ended too early and is started again.
    Crashed,
    /// A state that this operator does not know, from a Pod of another version.
    #[serde(other)]
    Unknown,
}

/// One simulator-agent pair.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq)]
pub struct PairStatus {
    /// From 1.
    pub id: i32,
    /// Routes done.
    pub done: i32,
    /// Routes of its slice, times repetitions.
    pub total: i32,
    /// Crashes so far.
    pub crashes: i32,
    /// What it does.
    pub state: PairState,
    /// How its last container ended.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub last: Option<LastEnd>,
}

/// What ended a round of a pair.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Copy, Debug, PartialEq, Eq)]
pub enum EndReason {
    /// The agent's command ended by itself.
    Exited,
    Killed,
    /// The agent's runner was killed, too.
    SilentDeath,
    /// The agent's command ended well, without complete results.
    Incomplete,
    /// The agent printed nothing for too long.
    Idle,
    OutOfMemory,
    /// The agent's command is missing in the image or not for this machine.
    CannotStart,
    /// The kubelet could not start the agent's container.
    StartError,
    /// The agent's verdict blames a simulator that has not failed.
    BlamesSimulator,
    /// The simulator followed its agent, whose own end is not known.
    Unseen,
    /// Another container of the Pod listened on the simulator's port.
    PortTaken,
    SimulatorCrashed,
    SimulatorNotReady,
    SimulatorSilent,
    /// The kubelet could not start the simulator's container.
    SimulatorNotStarted,
    /// An end that this operator does not know, of another version.
    #[serde(other)]
    Unknown,
}

impl fmt::Display for EndReason {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "{self:?}")
    }
}

/// How a container ended.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq)]
#[serde(rename_all = "camelCase")]
pub struct LastEnd {
    /// What ended it.
    pub reason: EndReason,
    /// Exit code of the process.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub exit_code: Option<i32>,
    /// When.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub time: Option<Time>,
}

/// Place in line.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq, Eq)]
#[serde(rename_all = "camelCase")]
pub struct Waiting {
    /// From 1.
    pub position: i32,
    /// Seconds until it starts, at the least; absent until runs of this track have ended, and while the Leaderboard is paused.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub eta_min_seconds: Option<i64>,
    /// The same, at the most.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub eta_max_seconds: Option<i64>,
    /// For people: `3rd, 20-35 min`.
    #[schemars(length(max = 64))]
    pub text: String,
}

impl Waiting {
    /// A place and how long it may take.
    pub fn new(position: i32, eta: Option<Eta>) -> Self {
        let ending = match (position % 10, position % 100) {
            (1, 1 | 21..) => "st",
            (2, 2 | 22..) => "nd",
            (3, 3 | 23..) => "rd",
            _ => "th",
        };
        let eta_text = eta.map(|eta| format!(", {eta}")).unwrap_or_default();
        Self {
            position,
            eta_min_seconds: eta.map(|eta| eta.min_seconds),
            eta_max_seconds: eta.map(|eta| eta.max_seconds),
            text: format!("{position}{ending}{eta_text}"),
        }
    }

    /// How long it may take.
    pub fn eta(&self) -> Option<Eta> {
        Some(Eta {
            min_seconds: self.eta_min_seconds?,
            max_seconds: self.eta_max_seconds?,
        })
    }
}

/// How long a wait may take, no finer than an estimate can be: whole steps of the unit that people read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Eta {
    /// At the least.
    pub min_seconds: i64,
    /// At the most.
    pub max_seconds: i64,
}

const MINUTE: i64 = 60;
const HOUR: i64 = 60 * MINUTE;
const DAY: i64 = 24 * HOUR;

impl Eta {
    /// Rounds both to what is shown.
    pub fn between(min_seconds: i64, max_seconds: i64) -> Self {
        let step = match max_seconds {
            ..=600 => MINUTE,
            601..=5_400 => 5 * MINUTE,
            5_401..=172_800 => HOUR,
            _ => DAY,
        };
        Self {
            min_seconds: min_seconds.max(0) / step * step,
            max_seconds: (max_seconds.max(1) + step - 1) / step * step,
        }
    }
}

/// `20-35 min`.
impl fmt::Display for Eta {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (unit, word) = match self.max_seconds {
            ..=5_400 => (MINUTE, "min"),
            5_401..=172_800 => (HOUR, "h"),
            _ => (DAY, "d"),
        };
        write!(out, "{}-{} {word}", self.min_seconds / unit, self.max_seconds / unit)
    }
}

/// When what happened; from the timestamps of messages, Pods and Jobs.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, Default, PartialEq)]
pub struct Times {
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub submitted: Option<Time>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub accepted: Option<Time>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scheduled: Option<Time>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub started: Option<Time>,
    /// When it was told to stop.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stopping: Option<Time>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub finished: Option<Time>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub published: Option<Time>,
}

impl Times {
    fn is_empty(&self) -> bool {
        *self == Self::default()
    }
}

/// Whose failure it is.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum FailureClass {
    Participant,
    Infrastructure,
}

/// What went wrong.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq, Eq)]
#[serde(rename_all = "camelCase")]
pub struct Failure {
    pub class: FailureClass,
    /// One of `api::reasons`.
    #[schemars(length(max = 64))]
    pub reason: String,
    /// A sentence with the next step, for the challenge's hosts.
    #[schemars(length(max = MAX_MESSAGE))]
    pub message: String,
    /// The next step alone.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = MAX_MESSAGE))]
    pub next_step: Option<String>,
    /// What the participant reads of it in EvalAI; absent where that is `message`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = MAX_MESSAGE))]
    pub participant_message: Option<String>,
    /// Whether it should cost the participant an attempt.
    pub charged: bool,
    /// The pair that it happened in, from 1; absent if it concerns the whole run.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pair: Option<i32>,
}

#[allow(clippy::trivially_copy_pass_by_ref, reason = "the signature is serde's")]
fn is_zero(value: &i32) -> bool {
    *value == 0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_place_in_line_reads_as_people_say_it() {
        let texts = [1, 2, 3, 4, 11, 12, 13, 21, 22, 101, 111, 123].map(|position| Waiting::new(position, None).text);
        let expected = [
            "1st", "2nd", "3rd", "4th", "11th", "12th", "13th", "21st", "22nd", "101st", "111th", "123rd",
        ];
        assert_eq!(texts, expected);
        let waiting = Waiting::new(3, Some(Eta::between(1201, 2000)));
        assert_eq!(waiting.text, "3rd, 20-35 min");
        assert_eq!(
            (waiting.eta_min_seconds, waiting.eta_max_seconds),
            (Some(1200), Some(2100))
        );
        assert_eq!(waiting.eta(), Some(Eta::between(1200, 2100)));
    }

    #[test]
    fn a_score_shows_whether_it_is_final() {
        let score = Score::new(43.129, Some(80.0), Some(0.5151), true);
        assert_eq!((score.text.as_str(), score.driving.as_str()), ("43.13", "43.13"));
        assert_eq!(score.route_completion.as_deref(), Some("80.00"));
        assert_eq!(score.infraction_penalty.as_deref(), Some("0.515"));
        let again = score.so_far();
        assert_eq!((again.text.as_str(), again.is_final), ("~43.13", false));
    }

    #[test]
    fn a_teams_name_is_cut_for_its_column() {
        let shown = |name: &str| {
            let name = Some(name.to_owned());
            TeamStatus::from(Team { id: None, name }).display_name.unwrap()
        };
        assert_eq!(shown("Team Seven"), "Team Seven");
        assert_eq!(shown(&"é".repeat(24)), "é".repeat(24));
        assert_eq!(shown(&"é".repeat(25)), format!("{}…", "é".repeat(23)));
    }

    #[test]
    fn a_state_of_another_version_is_unknown() {
        assert_eq!(
            serde_json::from_str::<PairState>("\"Running\"").unwrap(),
            PairState::Running
        );
        assert_eq!(
            serde_json::from_str::<PairState>("\"Dreaming\"").unwrap(),
            PairState::Unknown
        );
    }

    #[test]
    fn texts_of_strangers_are_cut_to_what_the_definition_allows() {
        let long = "é".repeat(MAX_MESSAGE + 1);
        let mut status = SubmissionStatus {
            message: Some(long.clone()),
            ..SubmissionStatus::default()
        };
        status.fit();
        assert_eq!(status.message.unwrap().chars().count(), MAX_MESSAGE);
    }
}
