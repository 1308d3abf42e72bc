//! Facts about a simulator's server that only the network shows, for `run`: that it is this container's own, that its ports are free, and
//! whether it hangs.

use std::time::{Duration, Instant};

use super::Runner;
use crate::decide::{Cause, Phase};
use crate::server::{self, Listener, Question};

/// No client of CARLA has so many connections; a process that opens all it may exhausts the server.
const MANY_CONNECTIONS: usize = 256;

impl Runner {
    /// True if it is this container's server that listens. Another container's listener is no readiness.
    pub(super) fn is_own_server(&mut self, port: u16) -> bool {
        let listener = server::listener(port);
        if listener == Listener::Foreign {
            self.note_taken(port);
        }
        listener == Listener::Own
    }

    fn note_taken(&mut self, port: u16) {
        if self.taken_port.replace(port).is_none() {
            self.say(&format!("a process of another container has port {port}"));
        }
    }

    /// Cause of a simulator's end that only the network shows, while its server may live.
    pub(super) fn of_the_server(&mut self, cause: Cause) -> Cause {
        let Some((port, answer)) = self.server() else {
            return cause;
        };
        match (self.phase, cause) {
            (Phase::Booting, Cause::ChildEnded | Cause::NotReady) => {
                if let Some(port) = server::foreign_listener(server::ports_of(port)) {
                    self.note_taken(port);
                }
                cause
            }
            (Phase::Running, Cause::ChildEnded) => {
                let connections = server::connections(port);
                if connections >= MANY_CONNECTIONS {
                    self.detail = Some(format!("{connections} connections to its port were open"));
                }
                cause
            }
            (Phase::Running, Cause::PeerCrashed) if self.is_server_silent(port, answer) => Cause::ServerSilent,
            _ => cause,
        }
    }

    /// Cause of a server's end where another container has one of its ports. Asked when its processes have ended: a port that
    /// cannot be taken then is another container's, however busy the node is.
    pub(super) fn of_its_ports(&mut self, cause: Cause) -> Cause {
        let Some((port, _)) = self.server() else { return cause };
        let has_failed = self.phase == Phase::Booting && matches!(cause, Cause::ChildEnded | Cause::NotReady);
        if !has_failed || !server::may_agents_run(&self.job.status) {
            return cause;
        }
        if let Some(port) = self.taken_port.or_else(|| server::held(server::ports_of(port))) {
            self.note_taken(port);
            self.detail = Some(format!(
                "another process of the Pod has port {port}, which the server needs"
            ));
            return Cause::PortTaken;
        }
        cause
    }

    /// True if the server hangs. One that ends while it is asked does not.
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
