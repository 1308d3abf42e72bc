//! What is asked of other systems in the background: a reconcile asks, and a later one finds the answer in memory.

use kube::Client;

use super::lookups::Lookups;
use crate::controller::objects::Wake;
use crate::controller::submissions::archive::ArchiveWorkers;
use crate::controller::submissions::foreign_runs::ForeignRuns;
use crate::controller::submissions::other_results::OtherResults;
use crate::observability::tasks::Tasks;
use crate::services::aws::Aws;
use leaderboard_api::Submission;

/// Who asks them, and what was answered.
pub struct Workers {
    pub archive: ArchiveWorkers,
    pub lookups: Lookups,
    pub foreign_runs: ForeignRuns,
    pub other_results: OtherResults,
}

impl Workers {
    /// Starts them. What `wake` makes is called for each submission that has its answer.
    pub fn start(aws: &Aws, client: &Client, tasks: &Tasks, wake: impl Fn() -> Wake<Submission>) -> Self {
        Self {
            archive: ArchiveWorkers::new(aws.clone(), client.clone(), tasks.clone(), wake()),
            lookups: Lookups::start(client.clone(), tasks, wake()),
            foreign_runs: ForeignRuns::start(aws, tasks, wake()),
            other_results: OtherResults::start(aws, tasks, wake()),
        }
    }

    /// Drops what is known for an object that is gone, or that needs nothing more.
    pub fn forget(&self, uid: &str) {
        self.archive.forget(uid);
        self.foreign_runs.forget(uid);
        self.other_results.forget(uid);
    }
}
