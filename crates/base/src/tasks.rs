//! The tasks that a process lives by: one that ends or panics before the stop ends the process, which names it.
//!
//! Tasks are started here, by every part; the program's `run` waits for [`Tasks::failed`] next to its work. A process that
//! continues without one of its tasks is alive and does half of its work; the kubelet starts a new one.

use std::any::Any;
use std::fmt;
use std::future::Future;
use std::panic::AssertUnwindSafe;

use futures::FutureExt;
use tokio::sync::watch;
use tokio::task::JoinHandle;

use super::shutdown::Stop;

/// A task that the process can't do without has ended.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("task {task} {why}; the process exits, so that the kubelet restarts it")]
pub struct TaskFailed {
    pub task: String,
    pub why: String,
}

/// Starts tasks and notices their ends. Clones are the same.
#[derive(Clone)]
pub struct Tasks {
    stop: Stop,
    failed: watch::Sender<Option<TaskFailed>>,
    /// So that a test can end a task of a name.
    #[cfg(any(test, feature = "fixtures"))]
    running: std::sync::Arc<std::sync::Mutex<Vec<(String, tokio::task::AbortHandle)>>>,
}

impl Tasks {
    /// None yet; after `stop` tasks may end.
    pub fn new(stop: Stop) -> Self {
        Self {
            stop,
            failed: watch::Sender::new(None),
            #[cfg(any(test, feature = "fixtures"))]
            running: std::sync::Arc::default(),
        }
    }

    /// Starts a task that stays until the stop. Its handle gives `None` if it panicked.
    pub fn stay<T: Send + 'static>(
        &self,
        name: impl Into<String>,
        work: impl Future<Output = T> + Send + 'static,
    ) -> JoinHandle<Option<T>> {
        self.start(name.into(), true, work)
    }

    /// Starts a task that the stop ends.
    pub fn until_stop(&self, name: &'static str, work: impl Future<Output = ()> + Send + 'static) {
        let stop = self.stop.clone();
        self.stay(name, async move {
            tokio::select! { biased; () = stop.wait() => {}, () = work => {} }
        });
    }

    /// Starts a task that may end at any time: it has come to its end, or reports in another way why it did not. Only a panic
    /// of it ends the process.
    pub fn may_end<T: Send + 'static>(
        &self,
        name: impl Into<String>,
        work: impl Future<Output = T> + Send + 'static,
    ) -> JoinHandle<Option<T>> {
        self.start(name.into(), false, work)
    }

    /// Returns when a task has failed before the stop.
    pub async fn failed(&self) -> TaskFailed {
        let mut failed = self.failed.subscribe();
        let found = failed
            .wait_for(Option::is_some)
            .await
            .ok()
            .and_then(|found| found.clone());
        match found {
            Some(failed) => failed,
            // The sender lives as long as this.
            None => std::future::pending().await,
        }
    }

    fn start<T: Send + 'static>(
        &self,
        name: String,
        stays: bool,
        work: impl Future<Output = T> + Send + 'static,
    ) -> JoinHandle<Option<T>> {
        let guard = Guard {
            tasks: self.clone(),
            name,
            may_end: false,
        };
        #[cfg(any(test, feature = "fixtures"))]
        let name = guard.name.clone();
        let task = tokio::spawn(watched(guard, stays, work));
        #[cfg(any(test, feature = "fixtures"))]
        self.lock().push((name, task.abort_handle()));
        task
    }

    /// The first failure is the one that is reported: others may follow from it.
    fn fail(&self, task: &str, why: String) {
        let failed = TaskFailed {
            task: task.to_owned(),
            why,
        };
        self.failed.send_if_modified(|known| {
            let is_first = known.is_none();
            if is_first {
                *known = Some(failed);
            }
            is_first
        });
    }
}

#[cfg(any(test, feature = "fixtures"))]
#[allow(clippy::unwrap_used, clippy::panic)]
impl Tasks {
    fn lock(&self) -> std::sync::MutexGuard<'_, Vec<(String, tokio::task::AbortHandle)>> {
        self.running.lock().unwrap()
    }

    /// The names of all that were started and run.
    pub fn names(&self) -> Vec<String> {
        let running = self.lock();
        let live = running.iter().filter(|(_, task)| !task.is_finished());
        live.map(|(name, _)| name.clone()).collect()
    }

    /// Ends a task from outside.
    pub fn end(&self, name: &str) {
        let running = self.lock();
        let found = running
            .iter()
            .find(|(known, task)| known == name && !task.is_finished());
        found.unwrap_or_else(|| panic!("no task {name} runs")).1.abort();
    }
}

impl fmt::Debug for Tasks {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Tasks").finish_non_exhaustive()
    }
}

/// Dropped when the task's future is: at its end, also one from outside.
struct Guard {
    tasks: Tasks,
    name: String,
    may_end: bool,
}

impl Drop for Guard {
    fn drop(&mut self) {
        if !self.may_end && !self.tasks.stop.is_set() {
            self.tasks.fail(&self.name, "has ended".to_owned());
        }
    }
}

async fn watched<T>(mut guard: Guard, stays: bool, work: impl Future<Output = T>) -> Option<T> {
    match AssertUnwindSafe(work).catch_unwind().await {
        Ok(value) => {
            guard.may_end = !stays;
            Some(value)
        }
        Err(panic) => {
            let why = format!("has panicked: {}", panic_message(panic.as_ref()));
            tracing::error!(task = guard.name, why, "a task has failed");
            guard.may_end = true;
            if !guard.tasks.stop.is_set() {
                guard.tasks.fail(&guard.name, why);
            }
            None
        }
    }
}

/// The message of a panic, or `without a message`.
pub fn panic_message(panic: &(dyn Any + Send)) -> &str {
    let text = panic.downcast_ref::<&str>().copied();
    text.or_else(|| panic.downcast_ref::<String>().map(String::as_str))
        .unwrap_or("without a message")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_task_that_panics_is_named_with_its_message() {
        let (_sender, stop) = Stop::new();
        let tasks = Tasks::new(stop);
        tasks.stay("counts", std::future::pending::<()>());
        let sweep = tasks.may_end("sweep", async { panic!("row {} is odd", 7) });
        let failed = tasks.failed().await;
        assert_eq!(
            failed.to_string(),
            "task sweep has panicked: row 7 is odd; the process exits, so that the kubelet restarts it"
        );
        assert_eq!(sweep.await.unwrap(), None::<()>);
    }

    #[tokio::test]
    async fn a_task_that_ends_before_the_stop_is_named() {
        let (_sender, stop) = Stop::new();
        let tasks = Tasks::new(stop);
        assert_eq!(tasks.may_end("permissions", async { 1 }).await.unwrap(), Some(1));
        tasks.stay("watch of pods", async {});
        assert_eq!(tasks.failed().await.task, "watch of pods");
    }

    #[tokio::test]
    async fn a_task_that_is_ended_from_outside_is_named() {
        let (_sender, stop) = Stop::new();
        let tasks = Tasks::new(stop);
        tasks.may_end("lease", std::future::pending::<()>());
        assert_eq!(tasks.names(), ["lease"]);
        tasks.end("lease");
        assert_eq!(
            tasks.failed().await.to_string().split(';').next(),
            Some("task lease has ended")
        );
    }

    #[tokio::test]
    async fn after_the_stop_tasks_may_end_as_they_like() {
        let (sender, stop) = Stop::new();
        let tasks = Tasks::new(stop.clone());
        let waits = tasks.stay("counts", async move { stop.wait().await });
        sender.send(true).unwrap();
        waits.await.unwrap();
        let panics = tasks.stay("drain", async { panic!("too late to matter") });
        assert_eq!(panics.await.unwrap(), None::<()>);
        assert!(tasks.failed().now_or_never().is_none());
    }
}
