//! Whole lives of 200 submissions at once next to 200 Jobs without an operator: the same Pods, the same Job controller.

use std::time::{Duration, Instant};

use super::costs;
use crate::audit;
use crate::bench::{Bench, Outcome};
use crate::names::WARM_NAME;
use crate::player::Pods;
use crate::raw::Bodies;
use crate::record::Figures;
use crate::stats::percentile;
use crate::world::{Setup, World};

const COUNT: usize = 200;
const PAIRS: usize = 5;
/// How long a Pod runs.
pub const POD: Duration = Duration::from_secs(5);
const CAP: Duration = Duration::from_mins(4);

/// A cluster in which submissions live their whole lives, warm.
pub async fn start(bench: &Bench, bodies: &Bodies, is_operator: bool) -> Outcome<World> {
    let setup = Setup {
        has_operator: is_operator,
        has_controllers: true,
        pods: Some(Pods::Last(POD)),
        ..Setup::default()
    };
    let world = World::start(bench, &setup).await?;
    world.warm(bodies).await?;
    Ok(world)
}

pub async fn measure(bench: &Bench, bodies: &Bodies) -> Outcome<Figures> {
    let count = bench.count(COUNT);
    let mut figures = Figures::default();
    for pair in 0..bench.pairs(PAIRS) {
        for is_operator in [pair % 2 == 1, pair % 2 == 0] {
            one(bench, bodies, &mut figures, count, is_operator).await?;
        }
    }
    figures.ratio("operator / limit", "operator, lifecycles/s", "limit, lifecycles/s");
    Ok(figures)
}

/// Number of the operator's writes about the measured submissions, by the audit log.
async fn writes(world: &World) -> Outcome<usize> {
    let all = audit::read_settled(&world.servers.audit_log()).await?;
    Ok(audit::writes(&all).measured.values().sum())
}

async fn one(bench: &Bench, bodies: &Bodies, figures: &mut Figures, count: usize, is_operator: bool) -> Outcome<()> {
    let mut world = start(bench, bodies, is_operator).await?;
    let (before, s3) = (world.used()?, world.storage.requests());
    let began = Instant::now();
    if is_operator {
        world.burst(0..count).await?;
    } else {
        let job = async |client: &kube::Client, name: String| bodies.job(client, &name).await;
        world.by_clients(0..count, job).await?;
    }
    let ends = |moments: &crate::observed::Moments| {
        let ends = if is_operator {
            &moments.finished
        } else {
            &moments.complete
        };
        let measured = ends.iter().filter(|(name, _)| *name != WARM_NAME);
        let times = measured.map(|(_, at)| at.duration_since(began).as_secs_f64());
        times.collect::<Vec<_>>()
    };
    let is_done = world.observed.until(CAP, |moments| ends(moments).len() >= count).await;
    world.check()?;
    let after = world.used()?;
    let side = if is_operator { "operator" } else { "limit" };
    costs(figures, bench, side, &before, &after, count);
    let times = ends(&world.observed.get());
    let span = if is_done {
        percentile(&times, 100.0).unwrap_or_default()
    } else {
        began.elapsed().as_secs_f64()
    };
    if !is_done {
        figures.note(format!("{side}: {} of {count} lives after {span:.0} s", times.len()));
    }
    figures.add(&format!("{side}, lifecycles/s"), times.len() as f64 / span.max(1e-9));
    if is_operator {
        let requests = world.storage.requests() - s3;
        figures.add("S3 requests a lifecycle", requests as f64 / count as f64);
        let writes = writes(&world).await?;
        figures.add("operator writes a lifecycle, all at once", writes as f64 / count as f64);
        let failed = world.observed.get().failed.values().next().cloned();
        if let Some(why) = failed {
            figures.note(format!("a submission has not finished: {why}"));
        }
    }
    Ok(())
}
