//! One submission with all that the page shows of it. Pure.

use leaderboard_api::{Condition, Evalai, State, Submission, SubmissionStatus};
use serde::Serialize;

use super::links;
use super::rows::{Cause, Number, Run, Waits, message, name, open};

/// Metrics of a run that are shown.
const METRICS: usize = 12;
/// Characters of the address of the results.
const ADDRESS: usize = 2048;

/// One submission.
#[derive(Serialize, Debug)]
#[serde(rename_all = "camelCase")]
pub(super) struct Detail {
    #[serde(flatten)]
    waits: Waits,
    state: &'static str,
    failure: Option<Cause>,
    #[serde(flatten)]
    run: Run,
    /// Bytes of the submitted file, if the submission is one.
    file: Option<i64>,
    score: Option<Number>,
    is_final: bool,
    metrics: Vec<Number>,
    conditions: Vec<Fact>,
    /// Where the end has not arrived yet.
    open: Vec<&'static str>,
    /// Address of the results, `s3://bucket/prefix/id`.
    results: Option<String>,
    evalai: Option<InEvalai>,
}

/// A condition.
#[derive(Serialize, Debug)]
#[serde(rename_all = "camelCase")]
struct Fact {
    #[serde(rename = "type")]
    type_: String,
    status: String,
    reason: String,
    message: String,
    since: i64,
}

/// The submission in EvalAI.
#[derive(Serialize, Debug)]
struct InEvalai {
    submission: i64,
    link: Option<String>,
}

impl Detail {
    /// `evalai` is the one of its Leaderboard.
    pub(super) fn of(submission: &Submission, evalai: Option<&Evalai>) -> Self {
        let none = SubmissionStatus::default();
        let status = submission.status.as_ref().unwrap_or(&none);
        let state = status.known_state().unwrap_or(State::Pending);
        let score = status.score.as_ref();
        let file = status.input.as_ref().or(submission.spec.input.as_ref());
        Self {
            waits: Waits::of(submission),
            state: state.as_str(),
            failure: status.failure.as_deref().map(Cause::of),
            run: Run::of(submission, status),
            file: file.map(|file| file.size),
            score: score.map(|score| Number::new(&score.name, &score.text)),
            is_final: score.is_some_and(|score| score.is_final),
            metrics: Number::first(&status.metrics, METRICS),
            conditions: status.conditions.iter().map(Fact::of).collect(),
            open: open(status),
            results: (status.results_url.as_deref()).map(|url| leaderboard_api::text::one_line(url, ADDRESS)),
            evalai: submission.spec.evalai.as_ref().map(|ids| InEvalai {
                submission: ids.submission,
                link: evalai.and_then(links::submissions),
            }),
        }
    }
}

impl Fact {
    fn of(condition: &Condition) -> Self {
        Self {
            type_: name(&condition.type_),
            status: name(&condition.status),
            reason: name(condition.reason.as_str()),
            message: message(&condition.message),
            since: condition.last_transition_time.0.as_second(),
        }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::page::samples_tests as samples;

    fn detail(submission: &Submission) -> serde_json::Value {
        serde_json::to_value(Detail::of(submission, None)).unwrap()
    }

    /// The browser's test opens these. `UPDATE_GOLDEN=1` writes them.
    #[test]
    fn the_details_of_a_full_evening() {
        let all: std::collections::BTreeMap<String, serde_json::Value> = samples::submissions()
            .iter()
            .chain(&samples::of_modes())
            .map(|one| {
                let evalai = samples::leaderboards()[0].spec.evalai.clone();
                let detail = serde_json::to_value(Detail::of(one, evalai.as_ref())).unwrap();
                (
                    format!("{}/{}", samples::NAMESPACE, one.metadata.name.clone().unwrap()),
                    detail,
                )
            })
            .collect();
        samples::golden("details.json", &all);
    }

    #[test]
    fn one_that_failed_says_what_to_do_and_where_it_is_missing() {
        let failure = ("NodeLost", "The node gpu-3 no longer reports; look at the node");
        let found = detail(&samples::failed("one", "a", "Infrastructure", failure, 10));
        assert_eq!(found["state"], "Failed");
        assert_eq!(found["failure"]["class"], "Infrastructure");
        assert_eq!(
            found["failure"]["message"],
            "The node gpu-3 no longer reports; look at the node."
        );
        assert_eq!(found["open"], json!(["EvalAI"]));
        assert_eq!(
            (&found["conditions"][1]["type"], &found["conditions"][1]["status"]),
            (&json!("Finished"), &json!("True"))
        );
    }

    #[test]
    fn a_file_stands_in_place_of_an_image_and_no_agent_is_named() {
        let [batch, predictions] = samples::of_modes().map(|one| detail(&one));
        assert_eq!((&batch["file"], &predictions["file"]), (&json!(null), &json!(12_800)));
        for word in ["agent", "route", "simulator", "pair"] {
            assert!(!predictions.to_string().contains(word), "{word}: {predictions}");
        }
    }

    #[test]
    fn one_without_a_status_waits() {
        let found = detail(&samples::submission("new", "carla-20", "a", &json!({})));
        assert_eq!((&found["state"], &found["reason"]), (&json!("Pending"), &json!(null)));
        assert_eq!((&found["results"], &found["score"]), (&json!(null), &json!(null)));
    }
}
