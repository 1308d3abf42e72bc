//! The content of a round's report. Pure.

use std::collections::BTreeMap;

use leaderboard_api::text::one_line;
use leaderboard_contract::report::{LONGEST_TEXT, MAX_BYTES, RefusedResults, Report, SCHEMA};
use leaderboard_contract::run::Run;
use leaderboard_evaluation::Gathered;
use leaderboard_evaluation::judge::Ending;
use leaderboard_evaluation::words;

/// Most warnings of the results that are reported.
const WARNINGS: usize = 50;

/// The report of a round; its number is the caller's.
pub fn describe(run: &Run, pod_uid: &str, gathered: &Gathered, ending: Option<&Ending>) -> Report {
    let merged = gathered.merged.as_deref();
    let (stopped, invalid, unusable) = match ending {
        Some(Ending::Stopped(stop)) => (Some(*stop), None, None),
        Some(Ending::Invalid(refused)) => (None, Some(refused.clone()), None),
        Some(Ending::Unusable(unusable)) => (None, None, Some(unusable)),
        Some(Ending::Complete) | None => (None, None, None),
    };
    let counts = invalid.is_none() && unusable.is_none() && gathered.is_complete();
    let total = gathered
        .workers
        .iter()
        .map(|worker| worker.total)
        .fold(0, u32::saturating_add);
    let warnings = merged.map_or(&[][..], |merged| &merged.warnings).iter();
    let warnings = warnings.chain(gathered.unusable().map(|unusable| &unusable.why));
    Report {
        schema: SCHEMA,
        submission_uid: run.uid.clone(),
        attempt: run.attempt,
        pod_uid: pod_uid.to_owned(),
        round: 0,
        done: merged.map_or(0, |merged| merged.done).min(total),
        total,
        unit: words(Some(&run.plan)).units.to_owned(),
        workers: gathered.workers.clone(),
        score: merged.and_then(|merged| merged.score.clone()),
        metrics: merged.map(|merged| merged.metrics.clone()).unwrap_or_default(),
        is_final: ending.is_some(),
        eligible: counts && merged.is_some_and(|merged| merged.eligible),
        outcome: merged.map(|merged| merged.outcome).unwrap_or_default(),
        stopped,
        refused: invalid.or_else(|| gathered.first_refused()).as_ref().map(shown),
        unusable: unusable.map(shown),
        warnings: warnings.take(WARNINGS).map(|warning| shorten(warning)).collect(),
        logs: None,
        results: gathered.texts.results.clone(),
        partial_results: gathered.texts.partial_results.clone().filter(|_| ending.is_none()),
        agents_fill_disk: false,
        files: gathered.digests(),
    }
}

/// Its JSON, without the long parts if it were larger than what is read.
pub(super) fn to_bytes(report: &Report) -> Vec<u8> {
    let bytes = serde_json::to_vec(report).unwrap_or_default();
    if bytes.len() <= MAX_BYTES {
        return bytes;
    }
    let short = Report {
        warnings: report.warnings.iter().take(1).cloned().collect(),
        files: BTreeMap::new(),
        ..report.clone()
    };
    serde_json::to_vec(&short).unwrap_or_default()
}

fn shown(results: &RefusedResults) -> RefusedResults {
    RefusedResults::new(results.worker, shorten(&results.why))
}

fn shorten(text: &str) -> String {
    one_line(text, LONGEST_TEXT)
}
