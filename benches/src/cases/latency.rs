//! Two submissions a second, each with a whole life, next to a client that writes status and Job in series at the same pace.

use std::time::{Duration, Instant};

use super::costs;
use super::lifecycles;
use crate::audit;
use crate::bench::{Bench, Outcome};
use crate::names::WARM_NAME;
use crate::observed::Moments;
use crate::raw::{Bodies, create_submission, name};
use crate::record::Figures;
use crate::stats::percentile;
use crate::world::World;

const COUNT: usize = 120;
const QUICK_COUNT: usize = 40;
const PAUSE: Duration = Duration::from_millis(500);
const CAP: Duration = Duration::from_mins(2);

pub async fn measure(bench: &Bench, bodies: &Bodies) -> Outcome<Figures> {
    let count = bench.count(if bench.quick { QUICK_COUNT } else { COUNT });
    let mut figures = Figures::default();
    for is_operator in [false, true] {
        one(bench, bodies, &mut figures, count, is_operator).await?;
    }
    for part in ["p50", "p99"] {
        let side = |side: &str| format!("{side}, created to Job, {part} ms");
        figures.ratio(
            &format!("created to Job, operator / limit, {part}"),
            &side("operator"),
            &side("limit"),
        );
    }
    Ok(figures)
}

async fn one(bench: &Bench, bodies: &Bodies, figures: &mut Figures, count: usize, is_operator: bool) -> Outcome<()> {
    let mut world = lifecycles::start(bench, bodies, is_operator).await?;
    let (before, s3) = (world.used()?, world.storage.requests());
    let known = if is_operator { reconciles(&world).await? } else { 0.0 };
    let mut clock = tokio::time::interval(PAUSE);
    for number in 0..count {
        clock.tick().await;
        let name = name(number);
        let uid = create_submission(&world.client, &name).await?.uid;
        world
            .observed
            .note(|moments| moments.created.insert(name.clone(), Instant::now()));
        if !is_operator {
            bodies.accept(&world.client, &name, &uid).await?;
        }
    }
    let ends = |moments: &Moments| {
        if is_operator {
            moments.finished.len()
        } else {
            moments.complete.len()
        }
    };
    if !world.observed.until(CAP, |moments| ends(moments) > count).await {
        figures.note(format!(
            "{} of {count} have not come to their end",
            count + 1 - ends(&world.observed.get())
        ));
    }
    world.check()?;
    let after = world.used()?;
    let side = if is_operator { "operator" } else { "limit" };
    costs(figures, bench, side, &before, &after, count);
    add_percentiles(
        figures,
        &format!("{side}, created to Job"),
        &to_job(&world.observed.get()),
    );
    if is_operator {
        add_percentiles(figures, "end to Finished", &to_finished(&world.observed.get()));
        figures.add(
            "reconciles a lifecycle",
            (reconciles(&world).await? - known) / count as f64,
        );
        let requests = world.storage.requests() - s3;
        figures.add("S3 requests a lifecycle", requests as f64 / count as f64);
        add_writes(figures, &world, count).await?;
    }
    Ok(())
}

/// Adds the operator's writes, by the audit log.
async fn add_writes(figures: &mut Figures, world: &World, count: usize) -> Outcome<()> {
    let all = audit::read_settled(&world.servers.audit_log()).await?;
    let each = |requests: usize| requests as f64 / count as f64;
    let writes = audit::writes(&all);
    figures.add("operator writes a lifecycle", each(writes.measured.values().sum()));
    let measured = writes.measured.into_iter();
    figures.counts = measured
        .map(|(name, writes)| (format!("{name}, a lifecycle"), each(writes)))
        .collect();
    let apart = [
        ("writes about the first submission, which is not measured", writes.first),
        ("writes for the Leaderboard alone, in the whole run", writes.leaderboard),
    ];
    figures
        .counts
        .extend(apart.map(|(name, writes)| (name.to_owned(), writes as f64)));
    Ok(())
}

async fn reconciles(world: &World) -> Outcome<f64> {
    match &world.operator {
        Some(operator) => operator.reconciles().await,
        None => Ok(0.0),
    }
}

/// Milliseconds from the answer to the create until the Job was observed.
pub fn to_job(moments: &Moments) -> Vec<f64> {
    let job = |name: &String, created: &Instant| Some(millis(*created, *moments.jobs.get(name)?));
    moments
        .created
        .iter()
        .filter_map(|(name, created)| job(name, created))
        .collect()
}

/// Milliseconds from the commit of the last container's end until `Finished` was observed.
pub fn to_finished(moments: &Moments) -> Vec<f64> {
    let measured = moments.ended.iter().filter(|(name, _)| *name != WARM_NAME);
    measured
        .filter_map(|(name, (ended, _))| Some(millis(*ended, *moments.finished.get(name)?)))
        .collect()
}

fn millis(from: Instant, to: Instant) -> f64 {
    to.saturating_duration_since(from).as_secs_f64() * 1e3
}

pub fn add_percentiles(figures: &mut Figures, what: &str, millis: &[f64]) {
    for (name, percent) in [("p50", 50.0), ("p99", 99.0)] {
        figures.add(&format!("{what}, {name} ms"), percentile(millis, percent));
    }
}
