//! What is asked of other systems in the background: a reconcile asks, and a later one finds the answer in memory.

use kube::Client;
use kube::runtime::reflector::ObjectRef;

use crate::ask::{self, Asker};
use crate::controller::objects::Wake;
use crate::controller::submissions::archive::ArchiveWorkers;
use crate::controller::submissions::questions::Row;
use crate::controller::submissions::rows;
use crate::services::aws::Aws;
use leaderboard_api::Submission;
use leaderboard_base::tasks::Tasks;

/// Who asks them, and what was answered.
pub struct Workers {
    pub archive: ArchiveWorkers,
    pub rows: Asker<Row>,
}

impl Workers {
    /// Starts them. What `wake` makes is called for each submission that has its answer.
    pub fn start(aws: &Aws, client: &Client, tasks: &Tasks, wake: impl Fn() -> Wake<Submission>) -> Self {
        Self {
            archive: ArchiveWorkers::new(aws.clone(), client.clone(), tasks.clone(), wake()),
            rows: rows::start(aws, tasks, by_key(wake())),
        }
    }

    /// Drops what is known for an object that is gone, or that needs nothing more.
    pub fn forget(&self, uid: &str) {
        self.archive.forget(uid);
        self.rows.forget(uid);
    }
}

/// Wakes a submission by its key.
fn by_key(wake: Wake<Submission>) -> ask::Wake {
    Box::new(move |key| wake(ObjectRef::new(&key.name).within(&key.namespace)))
}
