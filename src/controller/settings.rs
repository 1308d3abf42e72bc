//! What the command line sets.

use crate::allowed::Allowed;
use crate::kubernetes::Namespaces;

/// Settings that come from the command line.
#[derive(Clone, Debug)]
pub struct Settings {
    /// The operator's own image, which Pods use for `workspace` and `logcopy`.
    pub image: String,
    /// Pull policy of that image.
    pub image_pull_policy: Option<String>,
    /// AWS region of the operator, handed on to Pods.
    pub region: Option<String>,
    /// When S3 is sent checksums, as the operator's environment has it; handed on to Pods.
    pub checksums: Option<String>,
    /// Name of this installation, `<namespace>/<name>` of its Lease.
    pub operator: String,
    /// Which namespaces are served.
    pub namespaces: Namespaces,
    /// Nodes are watched, and Leases of other installations read wherever they are: rights of the whole cluster.
    pub has_cluster_rights: bool,
    /// What Leaderboards may name.
    pub allowed: Allowed,
    /// Reconciles at once.
    pub concurrency: u16,
}
