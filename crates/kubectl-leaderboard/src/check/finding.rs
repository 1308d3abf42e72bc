//! What a check shows of one part of a Leaderboard.

/// A part of a Leaderboard, in the order of the table.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    Leaderboard,
    Evalai,
    Queue,
    Readers,
    Registry,
    Slot,
    Node,
    Images,
    Contents,
    Network,
    Simulator,
    Agent,
    Bucket,
    Route,
    Table,
    Logs,
    Collectors,
}

impl Part {
    pub(super) fn title(self) -> &'static str {
        match self {
            Self::Leaderboard => "Leaderboard",
            Self::Evalai => "EvalAI",
            Self::Queue => "Queue",
            Self::Readers => "Other readers",
            Self::Registry => "Registry",
            Self::Slot => "Slot",
            Self::Node => "Node",
            Self::Images => "Images",
            Self::Contents => "Contents",
            Self::Network => "Isolation",
            Self::Simulator => "Simulator",
            Self::Agent => "Agent",
            Self::Bucket => "Bucket",
            Self::Route => "Route",
            Self::Table => "Table",
            Self::Logs => "CloudWatch",
            Self::Collectors => "Log collectors",
        }
    }
}

/// How a part stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mark {
    Works,
    Broken,
    /// It works, and a host should know something of it.
    Note,
    /// This check cannot know.
    Open,
}

/// What was found of a part.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Finding {
    pub part: Part,
    pub mark: Mark,
    pub found: String,
    /// What to do next, in sentences.
    pub step: Option<String>,
    /// A command to be copied.
    pub commands: Vec<String>,
}

pub(super) fn finding_of(part: Part, mark: Mark, found: impl Into<String>) -> Finding {
    Finding {
        part,
        mark,
        found: found.into(),
        step: None,
        commands: Vec::new(),
    }
}
