//! A check of a Leaderboard: one route with one pair and an image of the host's own, of which no other system keeps anything.
//!
//! A check is a Submission with `spec.check`, which `kubectl leaderboard check` creates. The
//! Leaderboard remembers how the last one ended. Pure.

use jiff::Timestamp;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::submission_status::State;
use super::{Submission, conditions, reasons};

/// What the name of a check begins with: its prefix in the bucket can never be a team's.
pub const NAME_PREFIX: &str = "check-";

/// What `kubectl leaderboard check` runs.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq, Eq)]
pub struct CheckImage {
    /// The image of an agent of the host's own, which drives one route. `agent.images` need not allow it.
    #[schemars(length(min = 1, max = 512), regex(pattern = r"^[a-z0-9][!-~]*$"))]
    pub image: String,
}

/// How a check came out.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Copy, Debug, PartialEq, Eq)]
pub enum CheckResult {
    Passed,
    Failed,
}

/// The check of a Leaderboard that ended last.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq, Eq)]
#[serde(rename_all = "camelCase")]
pub struct LastCheck {
    /// When it ended.
    pub time: Time,
    pub result: CheckResult,
    /// Why: the reason of the run's end, else the one for which the Leaderboard was not Ready then.
    #[schemars(length(max = 64))]
    pub reason: String,
    /// Generation of the spec that it ran with.
    pub leaderboard_generation: i64,
    /// Name of its Submission.
    #[schemars(length(max = 253))]
    pub submission_name: String,
}

/// The end of a check, as its Submission shows it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CheckEnd {
    pub time: Timestamp,
    /// Name of its Submission.
    pub name: String,
    /// Why it ended so.
    pub reason: String,
    /// Whether its route has finished with results that count, and the table would take them.
    pub has_finished: bool,
    /// Generation of the Leaderboard that it ran with; none if it was never accepted.
    pub generation: Option<i64>,
}

impl Submission {
    /// The end of a check that has nothing left to do.
    pub fn check_end(&self) -> Option<CheckEnd> {
        let status = self.status.as_ref().filter(|_| self.spec.check)?;
        let is_finished = status.has_ended();
        let recorded = status.condition(conditions::RECORDED)?;
        if !is_finished || recorded.reason == reasons::WAITING {
            return None;
        }
        let is_refused = recorded.reason == reasons::REFUSED;
        let has_result = status.state_of_conditions() == State::Finished;
        let logged = status.condition(conditions::LOGGED);
        let is_unlogged = logged.is_some_and(|logged| logged.status == "False");
        let reason = match (has_result, is_refused, is_unlogged) {
            (true, true, _) => reasons::TABLE_UNREACHABLE,
            (true, false, true) => reasons::LOGS_REFUSED,
            _ => status.reason.as_deref().unwrap_or_default(),
        };
        Some(CheckEnd {
            time: status.times.finished.as_ref()?.0,
            name: self.metadata.name.clone().unwrap_or_default(),
            reason: reason.to_owned(),
            has_finished: has_result && !is_refused && !is_unlogged,
            generation: status.checked_generation,
        })
    }
}

impl CheckEnd {
    /// What the Leaderboard notes of it. `fault`: for what the Leaderboard is not Ready at its end; `generation`: its present one.
    pub fn noted(&self, fault: Option<&str>, generation: i64) -> LastCheck {
        let (result, reason) = match fault {
            _ if !self.has_finished => (CheckResult::Failed, self.reason.as_str()),
            Some(fault) => (CheckResult::Failed, fault),
            None => (CheckResult::Passed, self.reason.as_str()),
        };
        LastCheck {
            time: Time(self.time),
            result,
            reason: reason.to_owned(),
            leaderboard_generation: self.generation.unwrap_or(generation),
            submission_name: self.name.clone(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::{Value, json};

    fn condition(type_: &str, status: &str, reason: &str) -> Value {
        json!({"type": type_, "status": status, "reason": reason, "message": "", "lastTransitionTime": "2026-11-01T10:00:00Z"})
    }

    fn check(conditions: &[Value]) -> Submission {
        let spec = json!({"leaderboardName": "lb", "image": "i", "track": "sensors", "check": true});
        let mut submission = Submission::new("check-lb-1", serde_json::from_value(spec).unwrap());
        let status = json!({"attempt": 1, "reason": "Finished", "checkedGeneration": 3, "conditions": conditions,
                            "times": {"finished": "2026-11-01T10:00:00Z"}});
        submission.status = serde_json::from_value(status).unwrap();
        submission
    }

    #[test]
    fn only_a_check_with_nothing_left_to_do_has_an_end() {
        let finished = condition("Finished", "True", "Finished");
        let recorded = |reason| condition("Recorded", "False", reason);
        let cases = [
            (vec![], None),
            (vec![finished.clone()], None),
            (vec![finished.clone(), recorded("Waiting")], None),
            (
                vec![finished.clone(), recorded("NotRequired")],
                Some((true, "Finished")),
            ),
            (
                vec![finished.clone(), recorded("Refused")],
                Some((false, "TableUnreachable")),
            ),
            (
                vec![
                    finished.clone(),
                    recorded("NotRequired"),
                    condition("Logged", "True", "LogsSent"),
                ],
                Some((true, "Finished")),
            ),
            (
                vec![
                    finished.clone(),
                    recorded("NotRequired"),
                    condition("Logged", "False", "LogsRefused"),
                ],
                Some((false, "LogsRefused")),
            ),
            (
                vec![condition("Finished", "True", "ImagePull"), recorded("NotRequired")],
                Some((false, "Finished")),
            ),
        ];
        for (conditions, expected) in cases {
            let end = check(&conditions).check_end();
            let found = end.as_ref().map(|end| (end.has_finished, end.reason.as_str()));
            assert_eq!(found, expected, "{conditions:?}");
        }
        let mut team = check(&[finished, recorded("NotRequired")]);
        team.spec.check = false;
        assert_eq!(team.check_end(), None);
    }

    #[test]
    fn a_leaderboard_that_is_not_ready_fails_the_check_of_a_good_run() {
        let conditions = [
            condition("Finished", "True", "Finished"),
            condition("Recorded", "False", "NotRequired"),
        ];
        let end = check(&conditions).check_end().unwrap();
        let noted = |end: &CheckEnd, fault| {
            let noted = end.noted(fault, 5);
            (noted.result, noted.reason, noted.leaderboard_generation)
        };
        assert_eq!(noted(&end, None), (CheckResult::Passed, "Finished".into(), 3));
        let fault = Some("TokenRefused");
        assert_eq!(noted(&end, fault), (CheckResult::Failed, "TokenRefused".into(), 3));
        let unaccepted = CheckEnd {
            generation: None,
            has_finished: false,
            reason: "ImagePull".into(),
            ..end
        };
        assert_eq!(noted(&unaccepted, fault), (CheckResult::Failed, "ImagePull".into(), 5));
    }
}
