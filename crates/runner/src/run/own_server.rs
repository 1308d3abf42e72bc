//! Facts about a host's command that only the network shows, for `run`: that it listens and is this container's own, that its ports are
//! free, and whether a simulator's server hangs.

use std::ops::RangeInclusive;
use std::time::{Duration, Instant};

use super::Runner;
use crate::decide::{Cause, Part, Phase};
use crate::report;
use crate::server::{self, Listener, Question};

/// No honest client has so many connections; a process that opens all it may exhausts the server.
const MANY_CONNECTIONS: usize = 256;

impl Runner {
    /// Ports that a host's command may take, the one that its agent knows first.
    fn ports(&self) -> Option<RangeInclusive<u16>> {
        let port = self.job.port?;
        let has_more = self.part == Part::Simulator;
        Some(if has_more { server::ports_of(port) } else { port..=port })
    }

    /// True if a host's command can be reached. One without a port cannot be late. Another container's listener is no readiness.
    pub(super) fn is_ready(&mut self) -> bool {
        let Some(ports) = self.ports() else { return true };
        let port = *ports.start();
        // An evaluator may take one connection and no more, and that is its agent's.
        if self.part == Part::Simulator && !server::answers(port) {
            return false;
        }
        match server::listener(port) {
            Listener::Own => true,
            Listener::Hidden => server::answers(port),
            Listener::Nobody => false,
            Listener::Foreign => {
                self.note_taken(port);
                false
            }
        }
    }

    fn note_taken(&mut self, port: u16) {
        if self.taken_port.replace(port).is_none() {
            self.say(&format!("a process of another container has port {port}"));
        }
    }

    /// Cause of a host's end that only the network shows, while its command may live.
    pub(super) fn of_the_server(&mut self, cause: Cause) -> Cause {
        let Some(ports) = self.ports() else { return cause };
        match (self.phase, cause) {
            (Phase::Booting, Cause::ChildEnded | Cause::NotReady) => {
                if let Some(port) = server::foreign_listener(ports) {
                    self.note_taken(port);
                }
                cause
            }
            (Phase::Running, Cause::ChildEnded) => {
                let connections = server::connections(*ports.start());
                if connections >= MANY_CONNECTIONS {
                    self.detail = Some(format!("{connections} connections to its port were open"));
                }
                cause
            }
            (Phase::Running, Cause::PeerCrashed) if self.is_server_silent() => Cause::ServerSilent,
            _ => cause,
        }
    }

    /// Cause of a server's end where another container has one of its ports. Asked when its processes have ended: a port that
    /// cannot be taken then is another container's, however busy the node is.
    pub(super) fn of_its_ports(&mut self, cause: Cause) -> Cause {
        let Some(ports) = self.ports() else { return cause };
        let has_failed = self.phase == Phase::Booting && matches!(cause, Cause::ChildEnded | Cause::NotReady);
        if !has_failed || !server::may_agents_run(&self.job.status, self.part.host()) {
            return cause;
        }
        if let Some(port) = self.taken_port.or_else(|| server::held(ports)) {
            self.note_taken(port);
            self.detail = Some(format!(
                "another process of the Pod has port {port}, which the {} needs",
                report::noun(self.part)
            ));
            return Cause::PortTaken;
        }
        cause
    }

    /// True if a simulator's server hangs. One that ends while it is asked does not.
    fn is_server_silent(&mut self) -> bool {
        let (Part::Simulator, Some(port)) = (self.part, self.job.port) else {
            return false;
        };
        let begin = Instant::now();
        let mut question = Question::ask(port);
        loop {
            let has_ended = self.group.is_none() || self.status().is_some();
            if has_ended || self.terminated || question.as_mut().is_ok_and(Question::is_answered) {
                return false;
            }
            if begin.elapsed() >= self.job.answer {
                return true;
            }
            self.wait(Duration::from_millis(20));
        }
    }
}
