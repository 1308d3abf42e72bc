//! What the command line sets.

/// Settings that come from the command line.
#[derive(Clone, Debug)]
pub struct Settings {
    /// The operator's own image, which Pods use for `workspace` and `logcopy`.
    pub image: String,
    /// Pull policy of that image.
    pub image_pull_policy: Option<String>,
    /// AWS region of the operator, handed on to Pods.
    pub region: Option<String>,
    /// Name of this installation, `<namespace>/<name>` of its Lease.
    pub operator: String,
    /// Only this namespace, or all.
    pub namespace: Option<String>,
    /// Reconciles at once.
    pub concurrency: u16,
}
