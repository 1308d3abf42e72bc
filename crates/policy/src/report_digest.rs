//! A report reduced to what decisions and the table need: under 1.5 KB while the run goes on, whatever the report embeds.

use serde_json::{Map, Value};

use leaderboard_api::text::one_line;
use leaderboard_api::{Attempt, MAX_METRICS, MAX_NAME, Metric};
use leaderboard_contract::keys::{METADATA, STDOUT};
use leaderboard_contract::report::{ContentId, Logs, Outcome, RefusedResults, Report, ReportError, ReportWorker};
use leaderboard_contract::run::Stop;

/// Largest text that is passed on to EvalAI, in bytes.
pub const MAX_TEXT: u64 = 4 << 20;
/// Longest text of a report that is kept, in characters.
const LONGEST: usize = 500;
/// Most splits of a result that are kept.
const MAX_SPLITS: usize = 16;

/// The part of a report that is kept in memory. Its texts are read again when they are published.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ReportDigest {
    pub id: ContentId,
    pub attempt: Attempt,
    /// UID of the Pod that wrote it.
    pub pod_uid: String,
    pub done: u32,
    pub total: u32,
    pub unit: String,
    pub workers: Vec<ReportWorker>,
    pub score: Option<Metric>,
    /// The numbers that the status shows beside the score.
    pub metrics: Vec<Metric>,
    pub is_final: bool,
    pub eligible: bool,
    pub outcome: Outcome,
    pub stopped: Option<Stop>,
    /// Results that are refused for good.
    pub refused: Option<RefusedResults>,
    /// Results that the host's own evaluator has spoiled for good.
    pub unusable: Option<RefusedResults>,
    /// The first warning.
    pub warning: Option<String>,
    /// State of the run's lines in CloudWatch. None without a log group, and until it is known.
    pub logs: Option<Logs>,
    /// The agents' folders fill the volume of the logs.
    pub agents_fill_disk: bool,
    /// The metrics of a final report, for the table; empty before.
    pub splits: Box<[Split]>,
    /// Why EvalAI is not sent one of its texts.
    pub left_out: Option<Box<str>>,
}

/// The metrics of one split of a result.
#[derive(Clone, Debug, PartialEq)]
pub struct Split {
    /// Its codename.
    pub name: String,
    /// Numbers by their labels.
    pub accuracies: Map<String, Value>,
}

impl ReportDigest {
    /// Reads a report as hostile text. None: it is of another object.
    pub fn read(bytes: &[u8], uid: &str) -> Result<Option<Self>, ReportError> {
        let report = Report::parse(bytes)?;
        let is_of = report.submission_uid == uid;
        Ok(is_of.then(|| Self::of(&report, ContentId::of(bytes))))
    }

    /// True if the whole run is done, and nothing more comes.
    pub fn is_complete(&self) -> bool {
        self.is_final && self.done == self.total && self.total > 0
    }

    /// True if the report shows how a run came to its own end, with or without its Job. For a run that a person or its node stopped,
    /// only results that count show it. Another Job may go on, and stores no report of its own before its first round.
    pub fn is_verdict(&self) -> bool {
        let goes_on = matches!(self.stopped, Some(Stop::Interruption | Stop::Cancel));
        let is_spoiled = self.refused.is_some() || self.unusable.is_some();
        let is_decided = self.is_complete() || (self.is_final && is_spoiled);
        is_decided && (self.eligible || !goes_on)
    }

    pub fn of(report: &Report, id: ContentId) -> Self {
        let for_good = |fault: &Option<RefusedResults>| {
            let fault = fault.as_ref().filter(|_| report.is_final)?;
            Some(RefusedResults::new(fault.worker, cut(&fault.why)))
        };
        Self {
            id,
            attempt: report.attempt,
            pod_uid: cut(&report.pod_uid),
            done: report.done,
            total: report.total,
            unit: report.unit.clone(),
            workers: report.workers.clone(),
            score: report.score.clone(),
            metrics: report.metrics.clone(),
            is_final: report.is_final,
            eligible: report.eligible,
            outcome: report.outcome,
            stopped: report.stopped,
            refused: for_good(&report.refused),
            unusable: for_good(&report.unusable),
            warning: report.warnings.first().map(|warning| cut(warning)),
            logs: report.logs.as_ref().map(|logs| match logs {
                Logs::Sent => Logs::Sent,
                Logs::Refused(why) => Logs::Refused(cut(why)),
            }),
            agents_fill_disk: report.agents_fill_disk,
            splits: if report.is_final {
                splits(&report.results)
            } else {
                Box::default()
            },
            left_out: left_out(report).map(Into::into),
        }
    }
}

/// The numbers of EvalAI's text, as many as a result may have.
fn splits(results: &str) -> Box<[Split]> {
    let parsed: Vec<Value> = serde_json::from_str(results).unwrap_or_default();
    let is_kept = |(label, value): &(String, Value)| value.is_number() && label.chars().count() <= MAX_NAME;
    let split = |mut entry: Value| {
        let Value::Object(all) = entry.get_mut("accuracies")?.take() else {
            return None;
        };
        Some(Split {
            name: one_line(entry["split"].as_str().unwrap_or_default(), MAX_NAME),
            accuracies: all.into_iter().filter(is_kept).take(MAX_METRICS).collect(),
        })
    };
    parsed.into_iter().filter_map(split).take(MAX_SPLITS).collect()
}

/// A number of a report as the status has it.
pub fn clamp(number: u32) -> i32 {
    i32::try_from(number).unwrap_or(i32::MAX)
}

fn cut(text: &str) -> String {
    one_line(text, LONGEST)
}

#[cfg(test)]
impl From<&Report> for ReportDigest {
    fn from(report: &Report) -> Self {
        Self::of(report, ContentId::of(&serde_json::to_vec(report).unwrap()))
    }
}

/// Why a text is left out of what EvalAI is sent of a report, for people.
pub fn left_out(report: &Report) -> Option<String> {
    let files = [STDOUT, METADATA].map(|key| Some((key, report.files.get(key)?)));
    let (key, file) = files.into_iter().flatten().find(|(_, file)| file.size > MAX_TEXT)?;
    let (size, limit) = (file.size, MAX_TEXT >> 20);
    Some(format!(
        "{key} was left out: it has {size} bytes, and EvalAI is sent texts of up to {limit} MiB. It is in the bucket."
    ))
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    /// A report of a real size: 40 kB of results, two workers.
    fn report(is_final: bool) -> Vec<u8> {
        let worker = |id: u32| json!({"id": id, "done": 10, "total": 10, "crashes": 1, "state": "Running"});
        let accuracies = json!({"Driving score": 43.125, "other": "x".repeat(40_000)});
        json!({
            "schema": 1, "submissionUid": "u", "attempt": 1, "podUid": "0a86cbb5-8f3c-4a55-b5a1-9a4ff7a5c9a2", "round": 9,
            "done": 20, "total": 20, "unit": "routes", "workers": [worker(1), worker(2)],
            "score": {"name": "Driving score", "value": "43.13"},
            "metrics": [{"name": "Route completion", "value": "80.00"}, {"name": "Infraction penalty", "value": "0.515"}], "final": is_final, "eligible": is_final,
            "outcome": "Finished", "refused": {"why": "w".repeat(9_000)}, "warnings": vec!["v".repeat(9_000); 9],
            "results": json!([{"accuracies": accuracies}]).to_string(), "partialResults": "p".repeat(40_000),
            "files": {"evalai/stdout.txt": {"size": 9, "sha256": "0".repeat(64)}},
        })
        .to_string()
        .into_bytes()
    }

    fn size(digest: &ReportDigest) -> usize {
        let texts = [
            Some(&digest.pod_uid),
            digest.refused.as_ref().map(|refused| &refused.why),
            digest.warning.as_ref(),
        ];
        let workers = digest.workers.len() * size_of::<ReportWorker>();
        let metric = |metric: &Metric| size_of::<Metric>() + metric.name.capacity() + metric.value.capacity();
        let metrics: usize = digest.score.iter().chain(&digest.metrics).map(metric).sum();
        size_of::<ReportDigest>() + workers + metrics + texts.into_iter().flatten().map(String::capacity).sum::<usize>()
    }

    #[test]
    fn a_live_report_of_a_real_size_is_kept_in_less_than_one_and_a_half_kilobytes() {
        let bytes = report(false);
        assert!(bytes.len() > 80_000);
        let digest = ReportDigest::read(&bytes, "u").unwrap().unwrap();
        assert!(size(&digest) < 1536, "{} bytes", size(&digest));
        assert_eq!((digest.splits.len(), digest.refused), (0, None));
        let score = digest.score.map(|score| score.value);
        assert_eq!(
            (digest.done, digest.workers.len(), score.as_deref()),
            (20, 2, Some("43.13"))
        );
    }

    #[test]
    fn a_final_report_keeps_the_metrics_of_the_table_alone() {
        let digest = ReportDigest::read(&report(true), "u").unwrap().unwrap();
        let metrics = &digest.splits[0].accuracies;
        assert_eq!(serde_json::to_string(metrics).unwrap(), r#"{"Driving score":43.125}"#);
        assert_eq!(digest.refused.unwrap().why.chars().count(), LONGEST);
    }

    #[test]
    fn labels_of_all_splits_are_kept_whatever_they_are_and_no_more_than_a_result_may_have() {
        let many: Map<String, Value> = (0..40).map(|index| (format!("m{index:02}"), json!(index))).collect();
        let odd = json!({"accuracy": 0.5, "text": "0.5", "none": null, "long".repeat(20): 1});
        let text = |entries: Vec<Value>| Value::from(entries).to_string();
        let found = splits(&text(vec![
            json!({"split": "dev", "show_to_participant": true, "accuracies": odd}),
            json!({"split": "test", "accuracies": many}),
            json!({"split": "broken", "accuracies": []}),
        ]));
        let shown: Vec<(&str, usize)> = found
            .iter()
            .map(|split| (split.name.as_str(), split.accuracies.len()))
            .collect();
        assert_eq!(shown, [("dev", 1), ("test", MAX_METRICS)]);
        let entry = json!({"split": "s", "accuracies": {}});
        assert_eq!(splits(&text(vec![entry; 20])).len(), MAX_SPLITS);
        assert!(splits("torn").is_empty());
    }

    #[test]
    fn a_report_of_another_object_is_recognized() {
        assert_eq!(ReportDigest::read(&report(true), "v").unwrap(), None);
        assert!(
            ReportDigest::read(b"torn", "u")
                .unwrap_err()
                .to_string()
                .contains("not one of ours")
        );
    }
}
