//! What only the network shows of a simulator's server, for `run`: whether it is this container's own, and whether it hangs.

use std::time::{Duration, Instant};

use super::Runner;
use crate::decide::{Cause, Phase};
use crate::server::{self, Listener, Question};

impl Runner {
    /// Whether it is this container's server that listens. Another container's listener is no readiness.
    pub(super) fn is_own_server(&mut self, port: u16) -> bool {
        let listener = server::listener(port);
        if listener == Listener::Foreign && !self.is_port_taken {
            self.is_port_taken = true;
            self.say(&format!("a process of another container listens on port {port}"));
        }
        listener == Listener::Own
    }

    /// What only the network shows of the end of a simulator: that its port is taken, or that its server hangs.
    pub(super) fn of_the_server(&mut self, cause: Cause) -> Cause {
        let Some((port, answer)) = self.server() else {
            return cause;
        };
        match (self.phase, cause) {
            (Phase::Booting, Cause::ChildEnded | Cause::NotReady) => {
                self.is_own_server(port);
                if self.is_port_taken && server::may_agents_run(&self.job.status) {
                    Cause::PortTaken
                } else {
                    cause
                }
            }
            (Phase::Running, Cause::PeerCrashed) if self.is_server_silent(port, answer) => Cause::ServerSilent,
            _ => cause,
        }
    }

    /// Whether the server hangs. One that ends while it is asked does not.
    fn is_server_silent(&mut self, port: u16, answer: Duration) -> bool {
        let begin = Instant::now();
        let mut question = Question::ask(port);
        loop {
            let has_ended = self.group.as_ref().is_none_or(|group| group.status().is_some());
            if has_ended || self.terminated || question.as_mut().is_ok_and(Question::is_answered) {
                return false;
            }
            if begin.elapsed() >= answer {
                return true;
            }
            self.wait(Duration::from_millis(20));
        }
    }
}
