//! The simulator's server as the network shows it: whose socket listens on its port, and whether it still answers. Called by
//! `run`.
//!
//! All containers of a Pod share one network, so an agent can listen on the port of any simulator. A listener counts only if
//! its socket belongs to a descendant of this process.

use std::collections::HashSet;
use std::fs;
use std::io::{self, ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::path::Path;
use std::time::Duration;

use leaderboard_runner::protocol::{self, Mark, Pair, Side, StatusFile};

/// CARLA's RPC `get_episode_settings`, in MessagePack: its main loop has to answer it, and it changes nothing.
const REQUEST: &[u8] = b"\x94\x00\x00\xb4get_episode_settings\x90";
/// The state of a listening socket in the kernel's tables.
const LISTEN: &str = "0A";

/// Who listens on a port.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Listener {
    Nobody,
    /// A descendant of this process, or nothing speaks against it: the kernel hides its tables, or a descendant's files.
    Own,
    /// A process of another container.
    Foreign,
}

/// Who listens on the port.
pub(crate) fn listener(port: u16) -> Listener {
    let tables = ["/proc/self/net/tcp", "/proc/self/net/tcp6"].map(|path| fs::read_to_string(path).ok());
    if tables.iter().all(Option::is_none) {
        return Listener::Own;
    }
    let sockets: HashSet<String> = tables
        .iter()
        .flatten()
        .flat_map(|table| listening(table, port))
        .collect();
    if sockets.is_empty() {
        return Listener::Nobody;
    }
    if descendants().iter().any(|pid| holds(*pid, &sockets)) {
        Listener::Own
    } else {
        Listener::Foreign
    }
}

/// The sockets that listen on the port, as a process's links to its files name them.
fn listening(table: &str, port: u16) -> impl Iterator<Item = String> {
    table.lines().skip(1).filter_map(move |line| {
        let mut fields = line.split_whitespace();
        let (_, local_port) = fields.nth(1)?.rsplit_once(':')?;
        let is_it = u16::from_str_radix(local_port, 16) == Ok(port) && fields.nth(1)? == LISTEN;
        let inode = fields.nth(5)?;
        is_it.then(|| format!("socket:[{inode}]"))
    })
}

/// All descendants that live. Orphans among them are this process's children, since it is their subreaper.
fn descendants() -> Vec<u32> {
    let entries = fs::read_dir("/proc").into_iter().flatten().flatten();
    let all: Vec<(u32, u32)> = entries
        .filter_map(|entry| entry.file_name().to_str()?.parse().ok())
        .filter_map(|pid| Some((pid, parent(pid)?)))
        .collect();
    let mut found = vec![std::process::id()];
    let mut next = 0;
    while let Some(&of) = found.get(next) {
        found.extend(all.iter().filter(|(_, parent)| *parent == of).map(|(pid, _)| *pid));
        next += 1;
    }
    found.split_off(1)
}

fn parent(pid: u32) -> Option<u32> {
    parent_of_living(&fs::read_to_string(format!("/proc/{pid}/stat")).ok()?)
}

/// The parent in a process's `stat`. None of one that has ended and is not reaped yet: it has no file open, and yet the kernel hides its
/// files from all but root, as those of one that might have the socket.
fn parent_of_living(stat: &str) -> Option<u32> {
    // The name stands in brackets and may hold any character.
    let (_, rest) = stat.rsplit_once(')')?;
    let mut fields = rest.split_whitespace();
    let state = fields.next()?;
    let parent = fields.next()?.parse().ok()?;
    (!matches!(state, "Z" | "X" | "x")).then_some(parent)
}

/// Whether a process has one of the sockets open. One whose files are hidden (it has changed its user) may have.
fn holds(pid: u32, sockets: &HashSet<String>) -> bool {
    let entries = match fs::read_dir(Path::new("/proc").join(pid.to_string()).join("fd")) {
        Ok(entries) => entries,
        Err(error) => return error.kind() == ErrorKind::PermissionDenied,
    };
    let links = entries.flatten().filter_map(|entry| fs::read_link(entry.path()).ok());
    links
        .into_iter()
        .any(|link| link.to_str().is_some_and(|link| sockets.contains(link)))
}

/// Whether an agent of this Pod may have begun: not before a simulator was ready. Until then a taken port is no agent's doing.
pub(crate) fn may_agents_run(status: &Path) -> bool {
    let is_ready =
        |file: &StatusFile| matches!(file, StatusFile::Of(member, Mark::Start(_)) if member.side == Side::Simulator);
    protocol::present(status, Pair::MAX).iter().any(is_ready)
}

/// Whether a server answers on the port.
pub(crate) fn answers(port: u16) -> bool {
    let address = address(port);
    let Ok(stream) = TcpStream::connect_timeout(&address, Duration::from_millis(100)) else {
        return false;
    };
    // A free port of the ephemeral range can be answered by our own end of the connection.
    stream.local_addr().is_ok_and(|own| own != address)
}

/// A request to the server, to see whether it still does its work.
#[derive(Debug)]
pub(crate) struct Question(TcpStream);

impl Question {
    /// Sends it.
    pub(crate) fn ask(port: u16) -> io::Result<Self> {
        let mut stream = TcpStream::connect_timeout(&address(port), Duration::from_secs(1))?;
        stream.set_nonblocking(true)?;
        stream.write_all(REQUEST)?;
        Ok(Self(stream))
    }

    /// Whether the server has reacted: a server of another protocol that closes the connection is alive, too.
    pub(crate) fn is_answered(&mut self) -> bool {
        let mut byte = [0];
        match self.0.read(&mut byte) {
            // A byte, or the end of the connection.
            Ok(0..) => true,
            Err(error) => !matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted),
        }
    }
}

fn address(port: u16) -> SocketAddr {
    SocketAddr::from(([127, 0, 0, 1], port))
}

#[cfg(test)]
mod tests {
    use std::net::TcpListener;

    use super::*;

    #[test]
    fn a_port_answers_only_while_a_server_listens() {
        let listener = TcpListener::bind(("127.0.0.1", 0)).unwrap();
        let port = listener.local_addr().unwrap().port();
        assert!(answers(port));
        drop(listener);
        assert!(!answers(port));
    }

    #[test]
    fn a_listener_of_no_descendant_is_foreign() {
        let socket = TcpListener::bind(("127.0.0.1", 0)).unwrap();
        let port = socket.local_addr().unwrap().port();
        // This process itself is none of its descendants.
        assert_eq!(listener(port), Listener::Foreign);
        drop(socket);
        assert_eq!(listener(port), Listener::Nobody);
    }

    #[test]
    fn a_process_that_has_ended_and_is_not_reaped_listens_nowhere() {
        assert_eq!(parent_of_living("7 (a) Z 3 7 7"), None);
        assert_eq!(parent_of_living("7 (a) X 3 7 7"), None);
        assert_eq!(parent_of_living("7 (Z) Z 1) S 3 7 7"), Some(3));
        assert_eq!(parent_of_living("7 (a) R 3 7 7"), Some(3));
    }

    #[test]
    fn the_kernels_table_is_read_by_port_and_state() {
        let table = "  sl  local_address rem_address   st tx_queue rx_queue tr tm->when retrnsmt   uid  timeout inode\n\
               0: 0100007F:07D0 00000000:0000 0A 00000000:00000000 00:00000000 00000000  1000        0 4711 1 0000000000000000 100 0 0 10 0\n\
               1: 0100007F:07D0 0100007F:C350 01 00000000:00000000 00:00000000 00000000  1000        0 4712 1 0000000000000000 20 4 30 10 -1\n\
               2: 00000000:0834 00000000:0000 0A 00000000:00000000 00:00000000 00000000  1000        0 4713 1 0000000000000000 100 0 0 10 0\n";
        let sockets = |port| listening(table, port).collect::<Vec<_>>();
        assert_eq!(sockets(2000), ["socket:[4711]"]);
        assert_eq!(sockets(2100), ["socket:[4713]"]);
        assert!(sockets(2200).is_empty());
    }

    #[test]
    fn only_a_server_that_reacts_has_answered() {
        let silent = TcpListener::bind(("127.0.0.1", 0)).unwrap();
        let mut question = Question::ask(silent.local_addr().unwrap().port()).unwrap();
        assert!(!question.is_answered(), "its connection waits to be accepted");
        let (stream, _) = silent.accept().unwrap();
        assert!(!question.is_answered());
        (&stream).write_all(b"\x94").unwrap();
        question.0.set_nonblocking(false).unwrap();
        assert!(question.is_answered());
        drop(stream);
        assert!(question.is_answered(), "it closed the connection");
    }
}
