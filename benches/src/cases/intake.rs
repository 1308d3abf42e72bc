//! Many submissions at once, until each has its Job: three writes each, and no Pods.

use std::time::Duration;

use super::costs;
use crate::bench::{Bench, Outcome};
use crate::names::WARM_NAME;
use crate::raw::Bodies;
use crate::record::Figures;
use crate::world::{Setup, World};

/// A run that has not come to its end by then is rated by what it has done.
const CAP: Duration = Duration::from_mins(4);

pub async fn measure(
    bench: &Bench,
    bodies: &Bodies,
    full: usize,
    pairs: usize,
    total: Option<usize>,
) -> Outcome<Figures> {
    let count = bench.count(full);
    let mut figures = Figures::default();
    for pair in 0..bench.pairs(pairs) {
        // In turn, so that neither always meets the machine that the other has left.
        for is_operator in [pair % 2 == 1, pair % 2 == 0] {
            one(bench, bodies, &mut figures, count, is_operator, total).await?;
        }
    }
    figures.ratio("operator / limit", "operator, Jobs/s", "limit, Jobs/s");
    Ok(figures)
}

async fn one(
    bench: &Bench,
    bodies: &Bodies,
    figures: &mut Figures,
    count: usize,
    is_operator: bool,
    total: Option<usize>,
) -> Outcome<()> {
    let setup = Setup {
        has_operator: is_operator,
        total,
        ..Setup::default()
    };
    let mut world = World::start(bench, &setup).await?;
    world.warm(bodies).await?;
    let before = world.used()?;
    let began = if is_operator {
        world.burst(0..count).await?
    } else {
        let began = std::time::Instant::now();
        world
            .by_clients(0..count, async |client: &kube::Client, name: String| {
                bodies.submit(client, &name).await
            })
            .await?;
        began
    };
    let is_done = world.observed.until(CAP, |moments| moments.jobs.len() > count).await;
    world.check()?;
    let after = world.used()?;
    let side = if is_operator { "operator" } else { "limit" };
    costs(figures, bench, side, &before, &after, count);
    let times = to_jobs(&world, began);
    let span = if is_done {
        times.last().copied().unwrap_or_default()
    } else {
        began.elapsed().as_secs_f64()
    };
    if !is_done {
        figures.note(format!("{side}: {} of {count} Jobs after {:.0} s", times.len(), span));
    }
    figures.add(&format!("{side}, Jobs/s"), times.len() as f64 / span.max(1e-9));
    let created = crate::stats::percentile(&times, 50.0);
    figures.add(&format!("{side}, burst to Job, p50 s"), created);
    figures.add(
        &format!("{side}, burst to Job, p99 s"),
        crate::stats::percentile(&times, 99.0),
    );
    Ok(())
}

/// Seconds from the beginning to each Job, in order.
fn to_jobs(world: &World, began: std::time::Instant) -> Vec<f64> {
    let moments = world.observed.get();
    let measured = moments.jobs.iter().filter(|(name, _)| *name != WARM_NAME);
    let mut times: Vec<f64> = measured.map(|(_, at)| at.duration_since(began).as_secs_f64()).collect();
    times.sort_by(f64::total_cmp);
    times
}
