//! Many that run on: memory and rest with so many of them, how fast they are taken in, and a restart with all.

use std::time::{Duration, Instant};

use futures::future::try_join_all;
use serde::Deserialize;

use crate::api;
use crate::audit;
use crate::bench::{Bench, Outcome};
use crate::machine::{Used, memory};
use crate::player::Pods;
use crate::record::Figures;
use crate::world::{Setup, World};

/// Objects of a page, as in the operator's own lists.
const PAGE: u32 = 100;
/// Taken in at once while the number grows.
const BLOCK: usize = 250;
const BLOCK_CAP: Duration = Duration::from_mins(3);
/// After the last change, until the window of the rest begins.
const SETTLE: Duration = Duration::from_secs(15);
const REST: Duration = Duration::from_secs(30);
const ALL_CAP: Duration = Duration::from_mins(3);

/// Measures with each of these numbers of submissions, the smallest first.
pub async fn measure(bench: &Bench, sizes: &[usize]) -> Outcome<Figures> {
    let mut figures = Figures::default();
    // This program alone makes Pods: the Job controller would only share the cores.
    let setup = Setup {
        has_operator: true,
        pods: Some(Pods::Run),
        ..Setup::default()
    };
    let mut world = World::start(bench, &setup).await?;
    rest(bench, &world, &mut figures, 0).await?;
    let mut live = 0;
    for size in sizes {
        let size = bench.count(*size);
        while live < size {
            let next = (live + BLOCK).min(size);
            if !block(&world, &mut figures, live, next).await? {
                figures.note(format!(
                    "{next} do not run {} s after the last {BLOCK} were created",
                    BLOCK_CAP.as_secs()
                ));
                return Ok(figures);
            }
            live = next;
            world.check()?;
        }
        rest(bench, &world, &mut figures, live).await?;
    }
    restart(bench, &mut world, &mut figures, live).await?;
    Ok(figures)
}

/// Takes some more in; false if they do not all run in time.
async fn block(world: &World, figures: &mut Figures, from: usize, to: usize) -> Outcome<bool> {
    let began = world.burst(from..to).await?;
    let is_done = world
        .observed
        .until(BLOCK_CAP, |moments| moments.running.len() >= to)
        .await;
    let rate = (to - from) as f64 / began.elapsed().as_secs_f64();
    figures
        .series
        .entry("started/s by live".into())
        .or_default()
        .push((to as f64, rate));
    Ok(is_done)
}

/// Memory, CPU and requests while only the live reports change.
async fn rest(bench: &Bench, world: &World, figures: &mut Figures, live: usize) -> Outcome<()> {
    let Some(operator) = &world.operator else { return Ok(()) };
    tokio::time::sleep(SETTLE).await;
    let requests = || -> Outcome<f64> {
        let all = audit::requests(&audit::read(&world.servers.audit_log())?);
        Ok(all.values().sum::<usize>() as f64)
    };
    let (before, asked, s3, reconciles) = (
        world.used()?,
        requests()?,
        world.storage.requests(),
        operator.reconciles().await?,
    );
    tokio::time::sleep(REST).await;
    let after = world.used()?;
    let time = after.seconds_from(&before);
    let share = |used: f64| 100.0 * used / time;
    let used = after.since(&before);
    figures.add(&format!("CPU at rest, % of a core, {live} live"), share(used.operator));
    figures.add(
        &format!("API server CPU at rest, % of a core, {live} live"),
        share(used.apiserver),
    );
    figures.add(
        &format!("API requests/min at rest, {live} live"),
        (requests()? - asked) * 60.0 / time,
    );
    figures.add(
        &format!("S3 requests/s at rest, {live} live"),
        (world.storage.requests() - s3) as f64 / time,
    );
    figures.add(
        &format!("reconciles/min at rest, {live} live"),
        (operator.reconciles().await? - reconciles) * 60.0 / time,
    );
    figures.foreign(Used::foreign(&before, &after, bench.cores));
    resident(world, figures, &format!("{live} live"))
}

fn resident(world: &World, figures: &mut Figures, when: &str) -> Outcome<()> {
    let Some(operator) = &world.operator else { return Ok(()) };
    let (resident, anonymous) = memory(operator.pid()?)?;
    figures.add(&format!("RSS, MB, {when}"), resident);
    figures.add(&format!("RSS (anonymous), MB, {when}"), anonymous);
    Ok(())
}

/// Kills the operator and starts it with everything there.
async fn restart(bench: &Bench, world: &mut World, figures: &mut Figures, live: usize) -> Outcome<()> {
    if let Some(mut operator) = world.operator.take() {
        operator.kill().await?;
    }
    let began = Instant::now();
    let bytes = list_all(world).await?;
    figures.add("limit, LIST of everything, s", began.elapsed().as_secs_f64());
    figures.add("LIST of everything, MB", bytes as f64 / 1e6);
    let before = world.used()?;
    world.start_operator(bench).await?;
    figures.add("start to ready, s", world.ready);
    figures.ratio(
        "start to ready / limit",
        "start to ready, s",
        "limit, LIST of everything, s",
    );
    let Some(operator) = &world.operator else { return Ok(()) };
    let end = Instant::now() + ALL_CAP;
    while operator.reconciles().await? < live as f64 && Instant::now() < end {
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    figures.add("ready to all reconciled, s", operator.age() - world.ready);
    figures.add(
        "CPU from start until all are reconciled, s",
        world.used()?.since(&before).operator,
    );
    resident(world, figures, &format!("{live} live, all reconciled after a restart"))?;
    tokio::time::sleep(SETTLE).await;
    resident(world, figures, &format!("{live} live, after a restart"))
}

/// Reads every page of the kinds that the operator reads, all kinds at once; gives the bytes.
async fn list_all(world: &World) -> Outcome<usize> {
    let read = ["submissions", "jobs", "pods"].map(|kind| list(world, kind));
    Ok(try_join_all(read).await?.into_iter().sum())
}

async fn list(world: &World, kind: &str) -> Outcome<usize> {
    #[derive(Deserialize)]
    struct Page {
        metadata: Continue,
    }
    #[derive(Deserialize)]
    struct Continue {
        #[serde(rename = "continue", default)]
        next: String,
    }
    let (mut bytes, mut next) = (0, String::new());
    loop {
        let text = api::text(
            &world.client,
            &format!("{}?limit={PAGE}&continue={next}", api::path(kind)),
        )
        .await?;
        bytes += text.len();
        next = serde_json::from_str::<Page>(&text)?.metadata.next;
        if next.is_empty() {
            return Ok(bytes);
        }
    }
}
