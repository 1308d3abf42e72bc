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
        merger: run.plan.merger().and_then(|merger| u32::try_from(merger).ok()),
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

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use leaderboard_contract::report::Outcome;
    use leaderboard_evaluation::fixtures::{container_run, put_result, result};
    use leaderboard_evaluation::of_plan;
    use leaderboard_evidence::Tree;

    use super::*;

    /// The report of a run whose evaluators have these results.
    fn report(results: &[String], ending: Option<&Ending>) -> Report {
        let folder = tempfile::tempdir().unwrap();
        for (worker, text) in (1..).zip(results) {
            put_result(folder.path(), worker, text);
        }
        let (run, tree) = (container_run(), Arc::new(Tree::open(folder.path()).unwrap()));
        let gathered = of_plan(&run.plan).results(&run, tree).unwrap().round();
        let report = describe(&run, "pod-1", &gathered, ending);
        assert_eq!(
            Report::parse(&to_bytes(&report)).as_ref(),
            Ok(&report),
            "the controller reads it"
        );
        report
    }

    #[test]
    fn results_that_an_evaluator_has_spoiled_are_a_warning_first_and_the_hosts_in_the_end() {
        let results = [result(3, 10, 0.5), "no result".to_owned()];
        let running = report(&results, None);
        let [warning] = &running.warnings[..] else {
            panic!("{:?}", running.warnings)
        };
        assert!(
            warning.starts_with("evaluator 2: result.json can't be used: "),
            "{warning}"
        );
        assert_eq!(
            (running.unusable, running.refused, running.unit.as_str()),
            (None, None, "units")
        );

        let unusable = RefusedResults::new(Some(2), warning.as_str());
        let ended = report(&results, Some(&Ending::Unusable(unusable.clone())));
        assert_eq!((ended.unusable, ended.refused), (Some(unusable), None));
        assert!(ended.is_final && !ended.eligible && ended.done < ended.total);
    }

    #[test]
    fn a_complete_run_of_evaluators_has_its_score() {
        let results = [result(1, 1, 0.5), result(3, 3, 1.0)];
        let ended = report(&results, Some(&Ending::Complete));
        assert_eq!((ended.done, ended.total, ended.outcome), (4, 4, Outcome::Finished));
        assert_eq!(ended.score.map(|score| score.value).as_deref(), Some("0.875"));
        assert!(ended.is_final && ended.eligible && ended.warnings.is_empty());
        assert_eq!(
            ended.results,
            r#"[{"split":"test","show_to_participant":true,"accuracies":{"accuracy":0.875}}]"#
        );
        assert_eq!(ended.files.len(), 2, "{:?}", ended.files);
    }
}
