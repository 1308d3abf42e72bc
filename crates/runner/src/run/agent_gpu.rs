//! GPU of an agent that is given one of its node by its number: only its own container shows whether it sees one. For `run`.
//!
//! No process of the agent's image runs before its host has announced its command for the first time. No other container can write
//! into its folder. So the host asks for the report of the agent's runner before that, believes it, and asks no more later.

use leaderboard_protocol::files::{Mark, StatusFile};
use leaderboard_runner::graphics;

use super::Runner;
use crate::decide::{AgentGpu, Cause, Phase};

impl Runner {
    /// An agent reports what it sees, before it does anything else.
    pub(super) fn report_gpu(&mut self) -> Result<(), Cause> {
        if self.part.is_host() || !self.job.agent_gpu {
            return Ok(());
        }
        let is_there = graphics::devices(&self.job.root) > 0;
        if !is_there {
            self.say(
                "the container sees no GPU (no /dev/nvidia0 or any other number), and its Leaderboard gives it one",
            );
        }
        self.write(&StatusFile::Gpu(self.me, is_there))
    }

    /// GPU of the agent, as its host has read it.
    pub(super) fn agent_gpu(&self) -> AgentGpu {
        let is_asked = !self.job.alone && self.part.is_host() && self.job.agent_gpu;
        if !is_asked || self.phase != Phase::Booting || self.has_announced() {
            return AgentGpu::NotAsked;
        }
        let reported = |is_there| StatusFile::Gpu(self.peer, is_there).exists(&self.job.status);
        if reported(false) {
            AgentGpu::Missing
        } else if reported(true) {
            AgentGpu::Seen
        } else {
            AgentGpu::Awaited
        }
    }

    /// True if the agent's command may have begun, in whatever round.
    fn has_announced(&self) -> bool {
        (0..=self.round).any(|round| StatusFile::Of(self.me, Mark::Start(round)).exists(&self.job.status))
    }
}
