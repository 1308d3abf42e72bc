//! The process itself, by the names that all programs use: read from `/proc` at each scrape.

use std::fs;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::registry::Registry;

use super::{FloatCounter, FloatGauge, unix_time, zero};

/// Linux shows times to programs in hundredths of a second, whatever its kernel counts in.
const TICK: Duration = Duration::from_millis(10);

#[derive(Debug)]
pub(super) struct Process {
    cpu: FloatCounter,
    memory: Gauge,
    open_files: Gauge,
    most_files: Gauge,
    start: FloatGauge,
}

impl Process {
    /// To be made at the start of the process.
    pub(super) fn new(r: &mut Registry) -> Self {
        let process = Self {
            cpu: zero(r, "cpu_seconds", "User and system time of the process"),
            memory: zero(r, "resident_memory_bytes", "Memory of the process that is resident"),
            open_files: zero(r, "open_fds", "File descriptors that are open"),
            most_files: zero(r, "max_fds", "File descriptors that may be open"),
            start: zero(r, "start_time_seconds", "Unix time at which the process began"),
        };
        process.start.set(unix_time());
        process
    }

    /// Renews what changes. What cannot be read keeps its value.
    pub(super) fn read(&self) {
        let file = |name| fs::read_to_string(format!("/proc/self/{name}")).ok();
        if let Some(used) = file("stat").as_deref().and_then(cpu_time) {
            let seconds: &AtomicU64 = self.cpu.inner();
            seconds.store(used.as_secs_f64().to_bits(), Ordering::Relaxed);
        }
        if let Some(bytes) = file("status").as_deref().and_then(resident_bytes) {
            self.memory.set(bytes);
        }
        if let Some(most) = file("limits").as_deref().and_then(most_files) {
            self.most_files.set(most);
        }
        if let Ok(files) = fs::read_dir("/proc/self/fd") {
            // The folder that is read is open as well.
            self.open_files.set(super::whole(files.count().saturating_sub(1)));
        }
    }
}

/// Of `stat`: the fields 14 and 15. The second, the program's name, may hold anything up to its last bracket.
fn cpu_time(stat: &str) -> Option<Duration> {
    let (_, fields) = stat.rsplit_once(')')?;
    let mut times = fields.split_whitespace().skip(11);
    let mut ticks = || times.next()?.parse::<u32>().ok();
    Some(TICK * ticks()?.checked_add(ticks()?)?)
}

fn resident_bytes(status: &str) -> Option<i64> {
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"))?;
    line.trim()
        .strip_suffix("kB")?
        .trim()
        .parse::<i64>()
        .ok()?
        .checked_mul(1024)
}

/// None where there is no limit.
fn most_files(limits: &str) -> Option<i64> {
    let line = limits.lines().find_map(|line| line.strip_prefix("Max open files"))?;
    line.split_whitespace().next()?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_texts_of_proc_are_read() {
        let stat = "7 (a ) b) S 1 7 7 0 -1 4194560 900 0 0 0 150 25 0 0 20 0 9 0 1234 1 2";
        assert_eq!(cpu_time(stat), Some(Duration::from_millis(1750)));
        assert_eq!(resident_bytes("VmHWM:\t  9 kB\nVmRSS:\t    12 kB\n"), Some(12 * 1024));
        let limits =
            "Limit  Soft Limit  Hard Limit  Units\nMax open files            1024                 4096    files\n";
        assert_eq!(most_files(limits), Some(1024));
        for broken in [
            "",
            "7 (name",
            "7 (name) S 1",
            "VmRSS: many kB",
            "Max open files unlimited",
        ] {
            assert_eq!(
                (cpu_time(broken), resident_bytes(broken), most_files(broken)),
                (None, None, None),
                "{broken:?}"
            );
        }
    }

    #[test]
    fn a_process_shows_its_memory_its_files_and_its_start() {
        let process = Process::new(&mut Registry::default());
        process.read();
        let before = process.open_files.get();
        assert!(process.memory.get() > 100 * 1024 && before > 0 && process.most_files.get() >= before);
        assert!(process.start.get() > 1e9 && process.start.get() <= unix_time());
    }
}
