//! The graphics API and the adapter of a simulator, as the controller asks for them and the runner reads them.

use std::fmt;
use std::str::FromStr;

use thiserror::Error;

/// Variable of a simulator: which of several GPUs is its pair's, from 0.
pub const INDEX: &str = "LEADERBOARD_GPU_INDEX";
/// Variable with the number of a server's graphics adapter. The runner sets it, and replaces `$(NAME)` in the server's words with it.
pub const ADAPTER: &str = "LEADERBOARD_GRAPHICS_ADAPTER";

/// The graphics API that a server draws with.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Needs {
    /// Not known: only that there is a GPU counts.
    Any,
    Vulkan,
    OpenGl,
}

impl Needs {
    const NAMES: [(Self, &str); 3] = [(Self::Any, "any"), (Self::Vulkan, "vulkan"), (Self::OpenGl, "opengl")];
}

impl fmt::Display for Needs {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(
            Self::NAMES
                .iter()
                .find(|(known, _)| known == self)
                .map_or("", |(_, name)| name),
        )
    }
}

/// A text that names nothing to draw with.
#[derive(Debug, PartialEq, Eq, Error)]
#[error("what a server draws with is any, vulkan or opengl")]
pub struct NotANeed;

impl FromStr for Needs {
    type Err = NotANeed;

    fn from_str(text: &str) -> Result<Self, NotANeed> {
        let known = Self::NAMES.iter().find(|(_, name)| *name == text);
        known.map(|(needs, _)| *needs).ok_or(NotANeed)
    }
}
