//! `rerun`: which of many submissions are resumed because the infrastructure failed them. Pure. What a host forgives is `requeue`.

use clap::Args;
use kube::ResourceExt;
use leaderboard_api::{FailureClass, Submission};

use crate::facts;
use crate::requeue::counted;
use crate::text::Frame;

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

/// Those whose last attempt the infrastructure ended, which costs no participant an attempt, by name. Checks are left out.
pub fn chosen<'a>(submissions: &'a [Submission], reason: Option<&str>) -> Vec<&'a Submission> {
    let is_chosen = |one: &&Submission| {
        let status = one.status.as_ref();
        let failure = status.and_then(|status| status.failure.as_ref());
        let is_hosts = failure.is_some_and(|failure| {
            failure.class == FailureClass::Infrastructure && reason.is_none_or(|reason| reason == failure.reason)
        });
        is_hosts && facts::has_ended(one) && one.metadata.deletion_timestamp.is_none() && !one.spec.check
    };
    let mut found: Vec<&Submission> = submissions.iter().filter(is_chosen).collect();
    found.sort_by_key(|one| one.name_any());
    found
}

/// What is shown where nothing is chosen of so many submissions.
pub fn none(number: usize, reason: Option<&str>, namespace: &str, frame: Frame) -> Vec<String> {
    let reason = reason
        .map(|reason| format!(" with the reason {reason}"))
        .unwrap_or_default();
    let mut page = frame.page();
    page.paragraph(&format!(
        "None of {} has failed because of the infrastructure{reason}. `kubectl leaderboard why -n {namespace}` lists what has failed; \
         `kubectl leaderboard requeue` takes what is charged, too.",
        counted(number)
    ));
    page.into_lines()
}
