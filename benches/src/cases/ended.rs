//! Whole lives next to 500 and next to 5,000 submissions that have ended: what one costs must not grow with the others.

use std::time::Duration;

use http::Method;
use serde_json::{Value, json};

use super::costs;
use super::latency::{add_percentiles, to_job};
use super::lifecycles::POD;
use crate::api::{self, MERGE};
use crate::bench::{Bench, Outcome};
use crate::names::WARM_NAME;
use crate::player::Pods;
use crate::raw::{Bodies, create_submission, name};
use crate::record::Figures;
use crate::world::{Setup, World};

const SIZES: [usize; 2] = [500, 5_000];
const QUICK_SIZES: [usize; 2] = [50, 500];
const COUNT: usize = 150;
const QUICK_COUNT: usize = 50;
/// Number of the first that has ended.
const FIRST: usize = 20_000;
const PAUSE: Duration = Duration::from_millis(200);
const CAP: Duration = Duration::from_mins(5);
/// A slow API server completes ten Jobs a second.
const MADE_CAP: Duration = Duration::from_mins(15);
/// After the start, until everything that was there has been reconciled.
const SETTLE: Duration = Duration::from_secs(10);

pub async fn measure(bench: &Bench, bodies: &Bodies) -> Outcome<Figures> {
    let mut figures = Figures::default();
    let sizes = if bench.quick { QUICK_SIZES } else { SIZES };
    let mut costs = Vec::new();
    for size in sizes {
        costs.push(one(bench, bodies, &mut figures, bench.count(size)).await?);
    }
    if let [few, many] = costs[..] {
        figures.add("operator CPU, many / few ended", many / few.max(1e-9));
    }
    Ok(figures)
}

/// Milliseconds of the operator's CPU a submission.
async fn one(bench: &Bench, bodies: &Bodies, figures: &mut Figures, ended: usize) -> Outcome<f64> {
    let setup = Setup {
        has_operator: true,
        pods: Some(Pods::Last(POD)),
        ..Setup::default()
    };
    let mut world = World::start(bench, &setup).await?;
    world.warm(bodies).await?;
    let sample: Value = api::get(&world.client, &format!("{}/{WARM_NAME}", api::path("submissions"))).await?;
    if let Some(mut operator) = world.operator.take() {
        operator.kill().await?;
    }
    make_ended(&world, bodies, &sample, ended).await?;
    world.start_operator(bench).await?;
    tokio::time::sleep(SETTLE).await;
    let count = bench.count(if bench.quick { QUICK_COUNT } else { COUNT });
    let before = world.used()?;
    let mut clock = tokio::time::interval(PAUSE);
    for number in 0..count {
        clock.tick().await;
        create_submission(&world.client, &name(number)).await?;
        world
            .observed
            .note(|moments| moments.created.insert(name(number), std::time::Instant::now()));
    }
    let is_done = world.observed.until(CAP, |moments| {
        (0..count).all(|n| moments.finished.contains_key(&name(n)))
    });
    if !is_done.await {
        figures.note(format!("not all of {count} have finished next to {ended}"));
    }
    world.check()?;
    let after = world.used()?;
    costs(figures, bench, &format!("{ended} ended"), &before, &after, count);
    let cost = after.since(&before).operator * 1e3 / count as f64;
    figures.add(&format!("operator CPU, ms a submission, {ended} ended"), cost);
    add_percentiles(
        figures,
        &format!("created to Job, {ended} ended"),
        &to_job(&world.observed.get()),
    );
    Ok(cost)
}

/// Copies of one that has finished, each with its Job and its Pod.
async fn make_ended(world: &World, bodies: &Bodies, sample: &Value, count: usize) -> Outcome<()> {
    let uid = sample["metadata"]["uid"].as_str().unwrap_or_default().to_owned();
    let text = json!({"status": sample["status"]}).to_string();
    let make = async |client: &kube::Client, name: String| {
        let own = create_submission(client, &name).await?.uid;
        let status = text.replace(&uid, &own).replace(WARM_NAME, &name);
        let path = format!("{}/{name}/status", api::path("submissions"));
        api::send(client, Method::PATCH, &path, MERGE, status.into_bytes()).await?;
        bodies.job_of(client, &name, &own).await
    };
    world.by_clients(FIRST..FIRST + count, make).await?;
    let is_done = world.observed.until(MADE_CAP, |moments| {
        let ended = moments
            .complete
            .keys()
            .filter(|name| **name >= self::name(FIRST) && *name != WARM_NAME);
        ended.count() >= count
    });
    if is_done.await {
        Ok(())
    } else {
        Err(format!("{count} ended ones cannot be made").into())
    }
}
