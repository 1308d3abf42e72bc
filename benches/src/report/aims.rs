//! The aims, and whether the lines reach them.

use std::fmt::Write as _;

use crate::record::Line;
use crate::stats::number;

/// Which side of the number is good.
enum Bound {
    AtMost(f64),
    AtLeast(f64),
}

use Bound::{AtLeast, AtMost};

/// One aim: what it is about, the case and the figure that show it.
struct Aim(&'static str, &'static str, &'static str, &'static str, Bound);

const AIMS: &[Aim] = &[
    Aim(
        "intake of 300 at once, part of the limit",
        "intake-300",
        "operator / limit",
        "",
        AtLeast(0.8),
    ),
    Aim(
        "the same with `concurrency.total`",
        "intake-300-limited",
        "operator / limit",
        "",
        AtLeast(0.8),
    ),
    Aim(
        "intake of 1,000 at once, part of the limit",
        "intake-1000",
        "operator / limit",
        "",
        AtLeast(0.8),
    ),
    Aim(
        "lifecycles, part of Jobs alone",
        "lifecycles",
        "operator / limit",
        "",
        AtLeast(0.75),
    ),
    Aim(
        "operator writes a lifecycle, events included",
        "latency",
        "operator writes a lifecycle",
        "",
        AtMost(6.0),
    ),
    Aim(
        "operator CPU a submission, intake",
        "intake-300",
        "operator CPU, ms a submission",
        "ms",
        AtMost(2.8),
    ),
    Aim(
        "operator CPU a submission, whole life at 2/s",
        "latency",
        "operator CPU, ms a submission",
        "ms",
        AtMost(8.0),
    ),
    Aim(
        "operator CPU a submission, 200 lives at once",
        "lifecycles",
        "operator CPU, ms a submission",
        "ms",
        AtMost(8.0),
    ),
    Aim(
        "created to Job at 2/s, p50, times the limit",
        "latency",
        "created to Job, operator / limit, p50",
        "",
        AtMost(1.4),
    ),
    Aim(
        "the same, p99",
        "latency",
        "created to Job, operator / limit, p99",
        "",
        AtMost(1.4),
    ),
    Aim(
        "last container's end to Finished at 2/s, p50",
        "latency",
        "end to Finished, p50 ms",
        "ms",
        AtMost(25.0),
    ),
    Aim(
        "the same, p99",
        "latency",
        "end to Finished, p99 ms",
        "ms",
        AtMost(60.0),
    ),
    Aim(
        "burst: end observed to PATCH received, p99",
        "burst",
        "end observed to PATCH received, p99 ms",
        "ms",
        AtMost(1_000.0),
    ),
    Aim(
        "burst with a restart: lost submissions",
        "burst-restart",
        "not finished",
        "",
        AtMost(0.0),
    ),
    Aim("RSS without submissions", "live", "RSS, MB, 0 live", "MB", AtMost(20.0)),
    Aim("RSS, 1,000 live", "live", "RSS, MB, 1000 live", "MB", AtMost(30.0)),
    Aim("RSS, 5,000 live", "live", "RSS, MB, 5000 live", "MB", AtMost(60.0)),
    Aim(
        "RSS, 5,000 live, after a restart",
        "live",
        "RSS, MB, 5000 live, after a restart",
        "MB",
        AtMost(80.0),
    ),
    Aim(
        "RSS, 10,000 live: half of the chart's limit",
        "live-10000",
        "RSS, MB, 10000 live",
        "MB",
        AtMost(134.0),
    ),
    Aim(
        "CPU at rest, 5,000 live",
        "live",
        "CPU at rest, % of a core, 5000 live",
        "%",
        AtMost(15.0),
    ),
    Aim(
        "start to ready, times a LIST of the same",
        "live",
        "start to ready / limit",
        "",
        AtMost(1.3),
    ),
    Aim(
        "ready until all are reconciled",
        "live",
        "ready to all reconciled, s",
        "s",
        AtMost(5.0),
    ),
    Aim(
        "operator CPU next to 5,000 ended, part of next to 500",
        "ended",
        "operator CPU, many / few ended",
        "",
        AtMost(1.1),
    ),
    Aim(
        "`results`, 4 files of 500 records",
        "results",
        "results, ms",
        "ms",
        AtMost(30.0),
    ),
    Aim(
        "1,000 Jobs against a quota: reasons right within 60 s",
        "storm-quota",
        "reasons right within 60 s, %",
        "%",
        AtLeast(100.0),
    ),
    Aim(
        "the same, an admission policy",
        "storm-policy",
        "reasons right within 60 s, %",
        "%",
        AtLeast(100.0),
    ),
    Aim(
        "the same, no node",
        "storm-nodes",
        "reasons right within 60 s, %",
        "%",
        AtLeast(100.0),
    ),
];

/// The table of all aims.
pub fn table(lines: &[Line]) -> String {
    let mut text = "| what | aim | measured | range | |\n|---|---:|---:|---:|---|\n".to_owned();
    for Aim(what, case, figure, unit, bound) in AIMS {
        let found = lines
            .iter()
            .find(|line| line.case == *case)
            .and_then(|line| line.figures.get(*figure));
        let (sign, aim) = match bound {
            AtMost(aim) => ("≤", *aim),
            AtLeast(aim) => ("≥", *aim),
        };
        let unit = if unit.is_empty() {
            String::new()
        } else {
            format!(" {unit}")
        };
        let Some(found) = found else {
            let _ = writeln!(text, "| {what} | {sign} {}{unit} | not measured | | |", number(aim));
            continue;
        };
        let range = if found.runs.len() > 1 {
            format!("{} to {}", number(found.low), number(found.high))
        } else {
            String::new()
        };
        let verdict = if bound.holds(found.median) {
            "reached"
        } else {
            "**falls short**"
        };
        let _ = writeln!(
            text,
            "| {what} | {sign} {}{unit} | {}{unit} | {range} | {verdict} |",
            number(aim),
            number(found.median)
        );
    }
    text
}

impl Bound {
    fn holds(&self, value: f64) -> bool {
        match self {
            AtMost(aim) => value <= *aim,
            AtLeast(aim) => value >= *aim,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::record::Figures;

    #[test]
    fn an_aim_is_reached_missed_or_not_measured() {
        let mut figures = Figures::default();
        figures.add("end to Finished, p50 ms", 20.0);
        figures.add("end to Finished, p99 ms", 61.0);
        let text = table(&[figures.into_line("latency")]);
        assert!(
            text.contains("Finished at 2/s, p50 | ≤ 25.0 ms | 20.0 ms |  | reached |"),
            "{text}"
        );
        assert!(
            text.contains("| the same, p99 | ≤ 60.0 ms | 61.0 ms |  | **falls short** |"),
            "{text}"
        );
        assert!(
            text.contains("| intake of 300 at once, part of the limit | ≥ 0.80 | not measured | | |"),
            "{text}"
        );
    }
}
