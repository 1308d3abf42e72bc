//! The gain of more controllers and more clusters, simulated with the measured rates. Leaderboards of unequal size are distributed by a
//! hash of their names, first to clusters, then to the controllers of each. Pure.

use std::fmt::Write as _;

use crate::bench::Outcome;
use crate::record::Line;
use crate::stats::number;

/// Leaderboards, the k-th with 1/k of the largest one's submissions.
const LEADERBOARDS: usize = 16;
/// Submissions of the last hour before a deadline, of 100,000 in all.
const BURST: f64 = 10_000.0;
const ALL: f64 = 100_000.0;
const SHARDS: [usize; 4] = [1, 2, 4, 8];
const CLUSTERS: [usize; 3] = [1, 2, 4];
const DAY: u32 = 86_400;

/// The measured rates.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Rates {
    /// Jobs a second that one API server takes.
    apiserver: f64,
    /// Jobs a second that one controller makes when it has the API server to itself.
    controller: f64,
    /// MB of a controller without submissions.
    idle: f64,
    /// MB more with each live submission.
    each: f64,
    /// Seconds from start to ready with each live submission.
    ready: f64,
}

/// The result of a distribution.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Outlook {
    /// Part of all submissions that the largest controller has.
    largest: f64,
    /// Seconds until the last of the burst has its Job.
    seconds: f64,
    megabytes: f64,
    ready: f64,
}

/// The table of docs/performance.md.
pub fn table(lines: &[Line]) -> Outcome<String> {
    let Some(rates) = rates(lines) else {
        return Ok("Not simulated: the cases intake-1000 and live were not measured.\n".into());
    };
    let mut text = format!(
        "One API server takes {} Jobs/s, one controller makes {}; it has {} MB idle and {} KB more with each live \
         submission. {BURST} submissions arrive at once for {LEADERBOARDS} Leaderboards.\n\n\
         | clusters | controllers in each | part of the largest | last Job after | its memory, all live | its start to ready |\n\
         |---:|---:|---:|---:|---:|---:|\n",
        number(rates.apiserver),
        number(rates.controller),
        number(rates.idle),
        number(rates.each * 1e3),
    );
    for clusters in CLUSTERS {
        for shards in SHARDS {
            let outlook = simulate(rates, clusters, shards);
            writeln!(
                text,
                "| {clusters} | {shards} | {:.0} % | {:.0} s | {:.0} MB | {} s |",
                100.0 * outlook.largest,
                outlook.seconds,
                outlook.megabytes,
                number(outlook.ready),
            )?;
        }
    }
    let each = lines.iter().find(|line| line.case == "live").and_then(listed);
    if let Some(each) = each {
        writeln!(
            text,
            "\nA live submission, with its Job and its Pod, has {} KB as the API server sends it: {} GB for {ALL} of them.",
            number(each * 1e3),
            number(each * ALL / 1e3)
        )?;
    }
    Ok(text)
}

/// MB of the list of everything, for each live submission.
fn listed(line: &Line) -> Option<f64> {
    let (live, _) = memory(line).last().copied()?;
    Some(line.median("LIST of everything, MB")? / live)
}

/// Memory by number of live submissions, the smallest number first.
fn memory(line: &Line) -> Vec<(f64, f64)> {
    let figures = line.figures.iter().filter_map(|(name, summary)| {
        let live = name.strip_prefix("RSS, MB, ")?.strip_suffix(" live")?;
        Some((live.parse().ok()?, summary.median))
    });
    let mut points: Vec<(f64, f64)> = figures.collect();
    points.sort_by(|a, b| a.0.total_cmp(&b.0));
    points
}

fn rates(lines: &[Line]) -> Option<Rates> {
    let case = |name: &str| lines.iter().find(|line| line.case == name);
    let (intake, live) = (case("intake-1000")?, case("live")?);
    let points = memory(live);
    let ((few, idle), (many, full)) = (*points.first()?, *points.last()?);
    Some(Rates {
        apiserver: intake.median("limit, Jobs/s")?,
        controller: intake.median("operator, Jobs/s")?,
        idle,
        each: (full - idle).max(0.0) / (many - few).max(1.0),
        ready: live.median("start to ready, s")? / many.max(1.0),
    })
}

fn simulate(rates: Rates, clusters: usize, shards: usize) -> Outlook {
    let mut backlog = vec![vec![0.0; shards]; clusters];
    let whole: f64 = (1..=LEADERBOARDS).map(|rank| 1.0 / rank as f64).sum();
    for rank in 1..=LEADERBOARDS {
        let name = format!("leaderboard-{rank}");
        let (cluster, shard) = (owner(&name, "cluster", clusters), owner(&name, "shard", shards));
        backlog[cluster][shard] += BURST / rank as f64 / whole;
    }
    let largest = backlog.iter().flatten().fold(0.0, |most: f64, part| most.max(*part));
    let mut seconds = 0;
    while seconds < DAY && backlog.iter().flatten().any(|left| *left > 0.0) {
        seconds += 1;
        for cluster in &mut backlog {
            serve(cluster, rates);
        }
    }
    Outlook {
        largest: largest / BURST,
        seconds: f64::from(seconds),
        megabytes: rates.idle + rates.each * largest,
        ready: rates.ready * largest,
    }
}

/// One second of a cluster: its controllers share the API server, and none is faster than alone.
fn serve(backlog: &mut [f64], rates: Rates) {
    let mut left = rates.apiserver;
    let mut waiting = backlog.iter().filter(|left| **left > 0.0).count();
    let mut order: Vec<usize> = (0..backlog.len()).collect();
    // A controller with little to do leaves the rest of its share to the others.
    order.sort_by(|a, b| backlog[*a].total_cmp(&backlog[*b]));
    for shard in order {
        if backlog[shard] <= 0.0 {
            continue;
        }
        let done = backlog[shard].min(rates.controller).min(left / waiting as f64);
        backlog[shard] -= done;
        if backlog[shard] < 1e-9 {
            backlog[shard] = 0.0;
        }
        left -= done;
        waiting -= 1;
    }
}

/// The one of `count` with the highest hash, so that few Leaderboards move when there is one more.
fn owner(name: &str, kind: &str, count: usize) -> usize {
    let score = |number: usize| hash(&format!("{kind}-{number}/{name}"));
    (0..count).max_by_key(|number| score(*number)).unwrap_or_default()
}

/// FNV-1a, with its bits mixed once more: names differ in their last characters only.
fn hash(text: &str) -> u64 {
    let folded = text.bytes().fold(0xcbf2_9ce4_8422_2325_u64, |hash, byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3)
    });
    (folded ^ (folded >> 29)).wrapping_mul(0xbf58_476d_1ce4_e5b9)
}

#[cfg(test)]
#[allow(clippy::float_cmp, reason = "the expected numbers are exact")]
mod tests {
    use super::*;

    const RATES: Rates = Rates {
        apiserver: 100.0,
        controller: 50.0,
        idle: 20.0,
        each: 0.01,
        ready: 0.001,
    };

    #[test]
    fn one_controller_takes_its_own_time() {
        let outlook = simulate(RATES, 1, 1);
        assert_eq!(outlook.seconds, 200.0);
        for (found, expected) in [
            (outlook.largest, 1.0),
            (outlook.megabytes, 120.0),
            (outlook.ready, 10.0),
        ] {
            assert!((found - expected).abs() < 1e-6, "{outlook:?}");
        }
    }

    #[test]
    fn more_controllers_reach_the_limit_of_the_api_server_and_no_more() {
        for shards in [2, 4, 8] {
            let outlook = simulate(RATES, 1, shards);
            assert!((100.0..200.0).contains(&outlook.seconds), "{shards}: {outlook:?}");
        }
        assert!(simulate(RATES, 4, 1).seconds < simulate(RATES, 1, 8).seconds);
    }

    #[test]
    fn what_one_leaves_goes_to_the_others() {
        let mut backlog = [10.0, 500.0, 0.0];
        serve(
            &mut backlog,
            Rates {
                controller: 80.0,
                ..RATES
            },
        );
        assert_eq!(backlog, [0.0, 420.0, 0.0]);
    }

    #[test]
    fn a_leaderboard_stays_or_moves_to_the_new_one() {
        for rank in 0..100 {
            let name = format!("leaderboard-{rank}");
            let (before, after) = (owner(&name, "shard", 4), owner(&name, "shard", 5));
            assert!(after == before || after == 4, "{name}");
        }
    }
}
