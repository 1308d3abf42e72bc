//! The process itself and the threads that run its tasks, read at each scrape.

use std::fmt;
use std::fs;
use std::time::Duration;

use jiff::Timestamp;
use prometheus_client::collector::Collector;
use prometheus_client::encoding::{DescriptorEncoder, NoLabelSet};
use prometheus_client::metrics::MetricType;
use tokio::runtime::{Handle, RuntimeMetrics};

use leaderboard_base::clock::Clock;

/// Linux shows times to programs in hundredths of a second, whatever its kernel counts in.
const TICKS_PER_SECOND: f64 = 100.0;

/// When the process began, as Unix time.
#[derive(Debug)]
pub(super) struct Process(f64);

impl Process {
    /// To be made at the start of the process, by whose own clock it counts: all that is shown here is the kernel's.
    pub(super) fn begins() -> Self {
        let now = Clock::system().now();
        Self(now.duration_since(Timestamp::UNIX_EPOCH).as_secs_f64())
    }
}

impl Collector for Process {
    fn encode(&self, encoder: DescriptorEncoder<'_>) -> fmt::Result {
        let file = |name| fs::read_to_string(format!("/proc/self/{name}")).unwrap_or_default();
        // The folder that is read is open as well.
        let open = fs::read_dir("/proc/self/fd").map(|files| files.count().saturating_sub(1));
        let mut to = Scrape(encoder);
        to.counter(
            "process_cpu_seconds",
            "User and system time of the process",
            cpu_seconds(&file("stat")),
        )?;
        to.gauge(
            "process_resident_memory_bytes",
            "Memory of the process that is resident",
            resident_bytes(&file("status")),
        )?;
        to.gauge(
            "process_open_fds",
            "File descriptors that are open",
            open.ok().and_then(number),
        )?;
        to.gauge(
            "process_max_fds",
            "File descriptors that may be open",
            most_files(&file("limits")),
        )?;
        to.gauge(
            "process_start_time_seconds",
            "Unix time at which the process began",
            Some(self.0),
        )?;
        of_runtime(&mut to)
    }
}

fn of_runtime(to: &mut Scrape<'_>) -> fmt::Result {
    let runtime = Handle::try_current().map(|handle| handle.metrics()).ok();
    let of_runtime = |read: fn(&RuntimeMetrics) -> usize| runtime.as_ref().map(read).and_then(number);
    to.gauge(
        "leaderboard_runtime_workers",
        "Threads that run tasks",
        of_runtime(RuntimeMetrics::num_workers),
    )?;
    to.gauge(
        "leaderboard_runtime_tasks",
        "Tasks that have not ended",
        of_runtime(RuntimeMetrics::num_alive_tasks),
    )?;
    to.gauge(
        "leaderboard_runtime_queued_tasks",
        "Tasks that are ready to go on and that no thread has taken yet",
        of_runtime(RuntimeMetrics::global_queue_depth),
    )?;
    to.counter(
            "leaderboard_runtime_busy_seconds",
            "Time for which threads ran tasks, summed over all threads; as many seconds a second as there are threads means overload",
            runtime.as_ref().map(busy_seconds),
        )
}

/// Takes samples without labels; a value that could not be read is left out.
struct Scrape<'a>(DescriptorEncoder<'a>);

impl Scrape<'_> {
    fn counter(&mut self, name: &str, help: &str, value: Option<f64>) -> fmt::Result {
        let Some(value) = value else { return Ok(()) };
        let mut metric = self.0.encode_descriptor(name, help, None, MetricType::Counter)?;
        metric.encode_counter::<NoLabelSet, _, u64>(&value, None)
    }

    fn gauge(&mut self, name: &str, help: &str, value: Option<f64>) -> fmt::Result {
        let Some(value) = value else { return Ok(()) };
        let mut metric = self.0.encode_descriptor(name, help, None, MetricType::Gauge)?;
        metric.encode_gauge(&value)
    }
}

fn number(count: usize) -> Option<f64> {
    u32::try_from(count).ok().map(f64::from)
}

fn busy_seconds(runtime: &RuntimeMetrics) -> f64 {
    let busy = (0..runtime.num_workers()).map(|worker| runtime.worker_total_busy_duration(worker));
    busy.sum::<Duration>().as_secs_f64()
}

/// User and system time, in seconds: the fields 14 and 15 of `stat`. The second field, a name, may hold anything up to its last bracket.
fn cpu_seconds(stat: &str) -> Option<f64> {
    let (_, fields) = stat.rsplit_once(')')?;
    let mut times = fields.split_whitespace().skip(11);
    let mut ticks = || times.next()?.parse::<f64>().ok();
    Some((ticks()? + ticks()?) / TICKS_PER_SECOND)
}

fn resident_bytes(status: &str) -> Option<f64> {
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"))?;
    let kilobytes = line.trim().strip_suffix("kB")?.trim().parse::<f64>().ok()?;
    Some(kilobytes * 1024.0)
}

/// None where there is no limit.
fn most_files(limits: &str) -> Option<f64> {
    let line = limits.lines().find_map(|line| line.strip_prefix("Max open files"))?;
    line.split_whitespace().next()?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_texts_of_proc_are_read() {
        let stat = "7 (a ) b) S 1 7 7 0 -1 4194560 900 0 0 0 150 25 0 0 20 0 9 0 1234 1 2";
        assert_eq!(cpu_seconds(stat), Some(1.75));
        assert_eq!(
            resident_bytes("VmHWM:\t  9 kB\nVmRSS:\t    12 kB\n"),
            Some(12.0 * 1024.0)
        );
        let limits =
            "Limit  Soft Limit  Hard Limit  Units\nMax open files            1024                 4096    files\n";
        assert_eq!(most_files(limits), Some(1024.0));
        for broken in [
            "",
            "7 (name",
            "7 (name) S 1",
            "VmRSS: many kB",
            "Max open files unlimited",
        ] {
            assert_eq!(
                (cpu_seconds(broken), resident_bytes(broken), most_files(broken)),
                (None, None, None),
                "{broken:?}"
            );
        }
    }
}
