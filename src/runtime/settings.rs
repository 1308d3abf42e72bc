//! Settings of the command line.

use crate::kubernetes::Namespaces;
use leaderboard_pod_spec::job::OwnImage;
use leaderboard_policy::allowed::Allowed;

/// Settings that come from the command line.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Image and environment that Pods get of the operator.
    pub own: OwnImage,
    /// Name of this installation, `<namespace>/<name>` of its Lease.
    pub operator: String,
    /// Which namespaces are served.
    pub namespaces: Namespaces,
    /// Nodes are watched, and Leases of other installations read wherever they are: rights of the whole cluster.
    pub has_cluster_rights: bool,
    /// Places that Leaderboards may name.
    pub allowed: Allowed,
    /// Reconciles at once.
    pub concurrency: u16,
}
