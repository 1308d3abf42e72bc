//! Attacks that nothing in a container can hold: what must be seen of the objects that do. The cluster's test looks at them.

/// The statement that an object must make.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Check {
    /// The NetworkPolicy that selects the Pod lets none of these addresses through, whatever else `network.egress` opens.
    NoWayTo(&'static [&'static str]),
    /// The NetworkPolicy that selects the Pod lets nothing in.
    NothingComesIn,
    /// The kubelet limits the processes of a Pod.
    PodPidsLimit,
}

/// One attack that the cluster holds.
#[derive(Debug, Clone, Copy)]
pub struct Object {
    pub attack: &'static str,
    /// The object that holds it, and what enforces that.
    pub by: &'static str,
    /// The finding of the test, and if the cluster of the test enforces it.
    pub shown: &'static str,
    pub check: Check,
}

const ENGINE: &str = "the Leaderboard's NetworkPolicy, where the cluster's network plugin enforces policies";

/// All of them.
pub const OBJECTS: &[Object] = &[
    Object {
        attack: "Ask the cloud's metadata service for the node's or the Pod's role",
        by: ENGINE,
        shown: "the policy has no way there; this cluster enforces none",
        check: Check::NoWayTo(&[
            "169.254.169.254",
            "169.254.170.2",
            "169.254.170.23",
            "fd00:ec2::254",
            "fd00:ec2::23",
            "fe80::1",
        ]),
    },
    Object {
        attack: "Be reached by, or wait for, the Pods of other submissions",
        by: ENGINE,
        shown: "the policy lets nothing in; this cluster enforces none",
        check: Check::NothingComesIn,
    },
    Object {
        attack: "Start processes until the node has none left",
        by: "the kubelet's `podPidsLimit`, one number for the whole Pod",
        shown: "the kubelet has a limit; not used up here",
        check: Check::PodPidsLimit,
    },
];
