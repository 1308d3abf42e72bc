//! How the agents of a run stand to the containers of the host.

/// How the agents of a run stand to the containers of the host.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Agents {
    /// Each worker has one, beside the container of the host.
    Beside,
    /// There is one. It ends before the containers of the host start.
    First,
    /// There is none.
    Absent,
}
