//! The threads that run all tasks of the process: read from tokio at each scrape.

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::registry::Registry;
use tokio::runtime::Handle;

use super::{FloatCounter, whole, zero};

#[derive(Debug)]
pub(super) struct Runtime {
    workers: Gauge,
    tasks: Gauge,
    queued: Gauge,
    busy: FloatCounter,
}

impl Runtime {
    pub(super) fn new(r: &mut Registry) -> Self {
        Self {
            workers: zero(r, "runtime_workers", "Threads that run tasks"),
            tasks: zero(r, "runtime_tasks", "Tasks that have not ended"),
            queued: zero(
                r,
                "runtime_queued_tasks",
                "Tasks that are ready to go on and that no thread has taken yet",
            ),
            busy: zero(
                r,
                "runtime_busy_seconds",
                "Time for which threads ran tasks, summed over all threads; as many seconds a second as there are threads means overload",
            ),
        }
    }

    /// Renews all of it. Outside of a runtime nothing is known.
    pub(super) fn read(&self) {
        let Ok(handle) = Handle::try_current() else { return };
        let now = handle.metrics();
        self.workers.set(whole(now.num_workers()));
        self.tasks.set(whole(now.num_alive_tasks()));
        self.queued.set(whole(now.global_queue_depth()));
        let busy: Duration = (0..now.num_workers())
            .map(|worker| now.worker_total_busy_duration(worker))
            .sum();
        let seconds: &AtomicU64 = self.busy.inner();
        seconds.store(busy.as_secs_f64().to_bits(), Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test(flavor = "multi_thread", worker_threads = 3)]
    async fn a_runtime_shows_its_threads_and_its_tasks() {
        let runtime = Runtime::new(&mut Registry::default());
        let waits = tokio::spawn(std::future::pending::<()>());
        runtime.read();
        assert_eq!((runtime.workers.get(), runtime.tasks.get() >= 1), (3, true));
        waits.abort();
    }
}
