//! 1,000 submissions at once, each with a whole life; with a kill of the operator in the middle if asked for.

use std::collections::HashMap;
use std::path::Path;
use std::time::{Duration, Instant};

use jiff::Timestamp;

use super::costs;
use super::latency::{add_percentiles, to_finished};
use super::lifecycles;
use crate::audit;
use crate::bench::{Bench, Outcome};
use crate::machine::{cpu, memory};
use crate::names::WARM_NAME;
use crate::observed::Moments;
use crate::operator::Operator;
use crate::raw::Bodies;
use crate::record::Figures;
use crate::stats::percentile;
use crate::world::World;

const COUNT: usize = 1_000;
const QUICK_COUNT: usize = 200;
const CAP: Duration = Duration::from_mins(6);
const SAMPLE: Duration = Duration::from_secs(1);

pub async fn measure(bench: &Bench, bodies: &Bodies, has_restart: bool) -> Outcome<Figures> {
    let count = bench.count(if bench.quick { QUICK_COUNT } else { COUNT });
    let mut figures = Figures::default();
    let mut world = lifecycles::start(bench, bodies, true).await?;
    let before = world.used()?;
    let began = world.burst(0..count).await?;
    let mut killed = None;
    while world.observed.get().finished.len() <= count && began.elapsed() < CAP {
        tokio::time::sleep(SAMPLE).await;
        sample(&world, &mut figures, began);
        if has_restart && killed.is_none() && world.observed.get().finished.len() > count / 2 {
            killed = Some(Instant::now());
            restart(bench, &mut world, &mut figures, began).await?;
        }
        world.check()?;
    }
    let after = world.used()?;
    costs(&mut figures, bench, "operator", &before, &after, count);
    let moments = world.observed.get();
    let ends: Vec<f64> = since(&moments.finished, began);
    let missing = count - ends.len().min(count);
    figures.add("not finished", missing as f64);
    if missing > 0 {
        figures.note(format!(
            "{missing} of {count} have not finished after {:.0} s",
            began.elapsed().as_secs_f64()
        ));
    }
    figures.note(format!("{count} submissions at once"));
    let last = percentile(&ends, 100.0).unwrap_or_default();
    figures.add("lifecycles/s", ends.len() as f64 / last.max(1e-9));
    let jobs = since(&moments.jobs, began);
    figures.add("burst to Job, p50 s", percentile(&jobs, 50.0));
    figures.add("burst to Job, p99 s", percentile(&jobs, 99.0));
    add_percentiles(&mut figures, "end to Finished", &to_finished(&moments));
    let log = world.servers.audit_log();
    add_percentiles(
        &mut figures,
        "end observed to PATCH received",
        &to_patch(&moments, &log)?,
    );
    drop(moments);
    if let Some(killed) = killed {
        figures.add("kill to the next end, s", next_end(&world, killed));
        let requests = job_requests(&log)? as f64;
        figures.add("requests for a Job, a submission", requests / (count + 1) as f64);
    }
    Ok(figures)
}

fn job_requests(log: &Path) -> Outcome<usize> {
    let all = audit::read(log)?;
    let jobs = all
        .iter()
        .filter(|entry| entry.verb == "create" && entry.resource() == "jobs");
    Ok(jobs.count())
}

/// Kills the operator and starts it again at once, as the kubelet would.
async fn restart(bench: &Bench, world: &mut World, figures: &mut Figures, began: Instant) -> Outcome<()> {
    if let Some(mut operator) = world.operator.take() {
        operator.kill().await?;
    }
    let at = began.elapsed().as_secs_f64();
    figures.series.insert("restart".into(), vec![(at, 0.0)]);
    world.start_operator(bench).await?;
    figures.add("restart to ready, s", world.ready);
    Ok(())
}

fn sample(world: &World, figures: &mut Figures, began: Instant) {
    let at = began.elapsed().as_secs_f64();
    let moments = world.observed.get();
    let counts = [
        ("Jobs", moments.jobs.len()),
        ("running", moments.running.len()),
        ("finished", moments.finished.len()),
    ];
    for (name, count) in counts {
        figures.series.entry(name.into()).or_default().push((at, count as f64));
    }
    let pid = world
        .operator
        .as_ref()
        .and_then(|operator: &Operator| operator.pid().ok());
    let Some(pid) = pid else { return };
    if let (Ok((resident, _)), Ok(cpu)) = (memory(pid), cpu(pid)) {
        figures.series.entry("RSS, MB".into()).or_default().push((at, resident));
        figures.series.entry("CPU, s".into()).or_default().push((at, cpu));
    }
}

fn since(times: &HashMap<String, Instant>, began: Instant) -> Vec<f64> {
    let measured = times.iter().filter(|(name, _)| *name != WARM_NAME);
    measured
        .map(|(_, at)| at.saturating_duration_since(began).as_secs_f64())
        .collect()
}

/// Milliseconds from this program's own event of the last container's end to the operator's last PATCH of the status, as the API server
/// received it. The API server's own part of the time is not in it.
fn to_patch(moments: &Moments, log: &std::path::Path) -> Outcome<Vec<f64>> {
    let mut last: HashMap<String, Timestamp> = HashMap::new();
    for entry in audit::read(log)? {
        if entry.is_write() && entry.resource() == "submissions/status" {
            last.insert(entry.name().to_owned(), entry.received);
        }
    }
    let measured = moments
        .ended
        .iter()
        .filter(|(name, _)| moments.finished.contains_key(*name) && *name != WARM_NAME);
    let millis = |from: &Timestamp, to: &Timestamp| (to.duration_since(*from).as_secs_f64() * 1e3).max(0.0);
    Ok(measured
        .filter_map(|(name, (_, ended))| Some(millis(ended, last.get(name)?)))
        .collect())
}

fn next_end(world: &World, killed: Instant) -> Option<f64> {
    let moments = world.observed.get();
    let after = moments
        .finished
        .values()
        .filter_map(|at| at.checked_duration_since(killed));
    after.min().map(|gap| gap.as_secs_f64())
}
