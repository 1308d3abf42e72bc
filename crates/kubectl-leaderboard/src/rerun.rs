//! `rerun`: which of many submissions are resumed because the infrastructure failed them. Pure. What a host forgives is `requeue`.

use clap::Args;
use kube::ResourceExt;
use leaderboard_api::{FailureClass, Submission};

use crate::facts;

/// Which submissions.
#[derive(Args, Debug)]
pub struct Rerun {
    /// Labels of the submissions, such as `leaderboard.carla.org/phase=7`.
    #[arg(short = 'l', long, value_name = "LABELS", required_unless_present = "all")]
    pub selector: Option<String>,
    /// Every submission of the namespace.
    #[arg(long, conflicts_with = "selector")]
    pub all: bool,
    /// Only those that failed for this reason, such as SimulationCrashed.
    #[arg(long)]
    pub reason: Option<String>,
    /// Only print which ones.
    #[arg(long)]
    pub dry_run: bool,
}

/// The names of those whose last attempt the infrastructure ended, which costs no participant an attempt. Checks are left out.
pub fn chosen(submissions: &[Submission], reason: Option<&str>) -> Vec<String> {
    let is_chosen = |one: &&Submission| {
        let status = one.status.as_ref();
        let failure = status.and_then(|status| status.failure.as_ref());
        let is_hosts = failure.is_some_and(|failure| {
            let is_uncharged = failure.class == FailureClass::Infrastructure && !failure.charged;
            is_uncharged && reason.is_none_or(|reason| reason == failure.reason)
        });
        is_hosts && facts::has_ended(one) && one.metadata.deletion_timestamp.is_none() && !one.spec.check
    };
    let mut names: Vec<String> = submissions
        .iter()
        .filter(is_chosen)
        .map(ResourceExt::name_any)
        .collect();
    names.sort();
    names
}
