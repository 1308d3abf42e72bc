//! What a simulator draws with, as the controller asks for it and the runner reads it.

use std::fmt;
use std::str::FromStr;

use thiserror::Error;

/// Variable of a simulator: which of several GPUs is its pair's, from 0.
pub const INDEX: &str = "LEADERBOARD_GPU_INDEX";
/// What the runner puts in place of `$(NAME)` in a server's words, and gives it as a variable: the number of its graphics adapter.
pub const ADAPTER: &str = "LEADERBOARD_GRAPHICS_ADAPTER";

/// What a server draws with.
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
