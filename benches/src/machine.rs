//! This machine and the processes under test by /proc: CPU time, memory, and the use of other processes meanwhile.

use std::fs;
use std::time::Instant;

use serde::{Deserialize, Serialize};

use crate::bench::Outcome;

/// Clock ticks a second in /proc; Linux has no other value on the machines that this runs on.
const TICKS: f64 = 100.0;

/// The machine of the figures.
#[derive(Serialize, Deserialize, Clone, Debug, Default, PartialEq)]
#[serde(rename_all = "camelCase")]
pub struct Machine {
    pub cores: usize,
    pub memory_gib: f64,
    pub processor: String,
    pub kernel: String,
}

impl Machine {
    pub fn read() -> Self {
        let line = |file: &str, key: &str| {
            let text = fs::read_to_string(file).unwrap_or_default();
            let found = text.lines().find_map(|line| line.strip_prefix(key).map(str::to_owned));
            found
                .unwrap_or_default()
                .trim_start_matches([' ', '\t', ':'])
                .to_owned()
        };
        let memory = line("/proc/meminfo", "MemTotal:");
        let kilobytes: f64 = memory
            .split(' ')
            .next()
            .and_then(|n| n.parse().ok())
            .unwrap_or_default();
        Self {
            cores: std::thread::available_parallelism().map_or(1, usize::from),
            memory_gib: (kilobytes / 1_048_576.0).round(),
            processor: line("/proc/cpuinfo", "model name"),
            kernel: line("/proc/sys/kernel/osrelease", ""),
        }
    }
}

/// CPU time used since their start, in seconds.
#[derive(Clone, Copy, Debug)]
pub struct Used {
    at: Instant,
    pub operator: f64,
    pub apiserver: f64,
    /// etcd, the Job controller and this program.
    pub others: f64,
    /// The whole machine.
    busy: f64,
}

impl Used {
    pub fn read(operator: Option<u32>, apiserver: u32, others: &[u32]) -> Outcome<Self> {
        let own = cpu(std::process::id())?;
        let others: f64 = others.iter().map(|pid| cpu(*pid).unwrap_or_default()).sum();
        Ok(Self {
            at: Instant::now(),
            operator: operator.map_or(Ok(0.0), cpu)?,
            apiserver: cpu(apiserver)?,
            others: own + others,
            busy: busy()?,
        })
    }

    /// The use between two moments. A process that was started again in between counts from its start.
    pub fn since(&self, before: &Self) -> Self {
        let less = |now: f64, before: f64| if now >= before { now - before } else { now };
        Self {
            at: self.at,
            operator: less(self.operator, before.operator),
            apiserver: less(self.apiserver, before.apiserver),
            others: less(self.others, before.others),
            busy: less(self.busy, before.busy),
        }
    }

    pub fn seconds_from(&self, before: &Self) -> f64 {
        self.at.duration_since(before.at).as_secs_f64()
    }

    /// Share of all cores that processes took which are no part of the measurement.
    pub fn foreign(before: &Self, after: &Self, cores: usize) -> f64 {
        let used = after.since(before);
        let whole = after.seconds_from(before) * cores as f64;
        let foreign = used.busy - used.operator - used.apiserver - used.others;
        if whole > 0.0 {
            (foreign / whole).clamp(0.0, 1.0)
        } else {
            0.0
        }
    }
}

/// Seconds of CPU of a process.
pub fn cpu(pid: u32) -> Outcome<f64> {
    let stat = fs::read_to_string(format!("/proc/{pid}/stat"))?;
    ticks(&stat).ok_or_else(|| format!("/proc/{pid}/stat has no times").into())
}

fn ticks(stat: &str) -> Option<f64> {
    let fields: Vec<&str> = stat.rsplit_once(')')?.1.split_ascii_whitespace().collect();
    let at = |field: usize| fields.get(field)?.parse::<f64>().ok();
    Some((at(11)? + at(12)?) / TICKS)
}

fn busy() -> Outcome<f64> {
    let stat = fs::read_to_string("/proc/stat")?;
    busy_of(&stat).ok_or_else(|| "/proc/stat has no times".into())
}

/// Everything but idle, waiting for disks, and what a guest took, which is in the other numbers.
fn busy_of(stat: &str) -> Option<f64> {
    let line = stat.lines().next()?.strip_prefix("cpu ")?;
    let fields: Vec<f64> = line
        .split_ascii_whitespace()
        .filter_map(|field| field.parse().ok())
        .collect();
    let working = [0, 1, 2, 5, 6, 7].map(|field| fields.get(field).copied().unwrap_or_default());
    Some(working.iter().sum::<f64>() / TICKS)
}

/// Resident memory of a process in MB: all, and what is no file's.
pub fn memory(pid: u32) -> Outcome<(f64, f64)> {
    let status = fs::read_to_string(format!("/proc/{pid}/status"))?;
    Ok((megabytes(&status, "VmRSS:"), megabytes(&status, "RssAnon:")))
}

fn megabytes(status: &str, key: &str) -> f64 {
    let line = status.lines().find_map(|line| line.strip_prefix(key));
    let number = line.and_then(|line| line.split_ascii_whitespace().next()?.parse::<f64>().ok());
    number.unwrap_or_default() / 1024.0
}

#[cfg(test)]
#[allow(clippy::float_cmp, reason = "the expected numbers are exact")]
mod tests {
    use super::*;

    #[test]
    fn the_name_of_a_program_may_hold_anything() {
        let stat = "42 (a) b (c) S 1 1 1 0 -1 0 0 0 0 0 150 50 9 9 20 0 1 0 5";
        assert_eq!(ticks(stat), Some(2.0));
        assert_eq!(ticks("42"), None);
    }

    #[test]
    fn idle_time_and_guests_are_not_busy() {
        assert_eq!(busy_of("cpu  100 20 30 9999 9999 4 5 6 7 8\ncpu0 1"), Some(1.65));
        assert_eq!(busy_of(""), None);
    }

    #[test]
    fn memory_is_given_in_megabytes() {
        let status = "Name:\tx\nVmRSS:\t    2048 kB\nRssAnon:\t  512 kB\n";
        assert_eq!((megabytes(status, "VmRSS:"), megabytes(status, "RssAnon:")), (2.0, 0.5));
    }

    #[test]
    fn this_process_is_in_proc() {
        assert!(memory(std::process::id()).unwrap().0 > 0.0);
        assert!(cpu(std::process::id()).is_ok());
        assert!(Machine::read().cores > 0);
    }
}
