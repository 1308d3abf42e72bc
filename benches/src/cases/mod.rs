//! The cases, in the order in which they are run.

mod burst;
mod ended;
mod intake;
mod latency;
mod lifecycles;
mod live;
mod results;
mod storms;

use clap::ValueEnum;

use crate::bench::{Bench, Outcome};
use crate::machine::Used;
use crate::raw::Bodies;
use crate::record::Figures;

/// One case.
#[derive(ValueEnum, Clone, Copy, Debug, PartialEq, Eq)]
pub enum Case {
    /// 300 submissions at once, until each has its Job.
    #[value(name = "intake-300")]
    Intake300,
    /// 300 submissions at once, with `concurrency.total`.
    #[value(name = "intake-300-limited")]
    Intake300Limited,
    /// 1,000 at once.
    #[value(name = "intake-1000")]
    Intake1000,
    /// 200 whole lives at once, with Pods of 5 s.
    Lifecycles,
    /// Two submissions a second, each with a whole life.
    Latency,
    /// 1,000 whole lives at once.
    Burst,
    /// 1,000 whole lives at once, with a kill of the operator in the middle.
    BurstRestart,
    /// 1,000 and 5,000 live ones: memory, rest, restart.
    Live,
    /// 10,000 live ones, which half of the chart's limit of memory is to hold. Only where it is named, since it takes long.
    #[value(name = "live-10000")]
    Live10000,
    /// Whole lives next to many that have ended.
    Ended,
    /// `leaderboard-operator results`.
    Results,
    /// Jobs whose Pods a quota refuses.
    StormQuota,
    /// Jobs whose Pods an admission policy refuses.
    StormPolicy,
    /// Pods that no node accepts.
    StormNodes,
}

/// The named cases; without a name all but the longest.
pub fn chosen(named: &[Case]) -> Vec<Case> {
    let all = Case::value_variants().iter().copied();
    let is_chosen = |case: &Case| match named {
        [] => *case != Case::Live10000,
        named => named.contains(case),
    };
    all.filter(is_chosen).collect()
}

impl Case {
    pub fn name(self) -> &'static str {
        match self {
            Self::Intake300 => "intake-300",
            Self::Intake300Limited => "intake-300-limited",
            Self::Intake1000 => "intake-1000",
            Self::Lifecycles => "lifecycles",
            Self::Latency => "latency",
            Self::Burst => "burst",
            Self::BurstRestart => "burst-restart",
            Self::Live => "live",
            Self::Live10000 => "live-10000",
            Self::Ended => "ended",
            Self::Results => "results",
            Self::StormQuota => "storm-quota",
            Self::StormPolicy => "storm-policy",
            Self::StormNodes => "storm-nodes",
        }
    }

    pub async fn measure(self, bench: &Bench, bodies: &Bodies) -> Outcome<Figures> {
        match self {
            Self::Intake300 => intake::measure(bench, bodies, 300, 5, None).await,
            Self::Intake300Limited => intake::measure(bench, bodies, 300, 3, Some(10_000)).await,
            Self::Intake1000 => intake::measure(bench, bodies, 1_000, 3, None).await,
            Self::Lifecycles => lifecycles::measure(bench, bodies).await,
            Self::Latency => latency::measure(bench, bodies).await,
            Self::Burst => burst::measure(bench, bodies, false).await,
            Self::BurstRestart => burst::measure(bench, bodies, true).await,
            Self::Live if bench.quick => live::measure(bench, &[300, 1_000]).await,
            Self::Live => live::measure(bench, &[1_000, 5_000]).await,
            Self::Live10000 => live::measure(bench, &[10_000]).await,
            Self::Ended => ended::measure(bench, bodies).await,
            Self::Results => results::measure(bench),
            Self::StormQuota => storms::measure(bench, storms::Storm::Quota).await,
            Self::StormPolicy => storms::measure(bench, storms::Storm::Policy).await,
            Self::StormNodes => storms::measure(bench, storms::Storm::Nodes).await,
        }
    }
}

/// Milliseconds of CPU a submission, of the operator and of the API server, and others' share of the cores.
fn costs(figures: &mut Figures, bench: &Bench, side: &str, before: &Used, after: &Used, count: usize) {
    let used = after.since(before);
    let each = |seconds: f64| seconds * 1e3 / count as f64;
    if used.operator > 0.0 {
        figures.add("operator CPU, ms a submission", each(used.operator));
    }
    figures.add(
        &format!("API server CPU, ms a submission, {side}"),
        each(used.apiserver),
    );
    figures.foreign(Used::foreign(before, after, bench.cores));
}
