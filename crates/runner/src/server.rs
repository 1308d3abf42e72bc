//! A host's server, a simulator's or an evaluator's, as the network shows it: whose sockets have its ports, and whether it still answers. Called by `run`.
//!
//! All containers of a Pod share one network, so an agent can take the ports of any host. A listener counts only if its socket
//! belongs to a descendant of this process.

use std::collections::HashSet;
use std::fs::{self, File};
use std::io::{self, BufRead, BufReader, ErrorKind, Read, Write};
use std::net::{Ipv4Addr, SocketAddr, TcpListener, TcpStream};
use std::ops::RangeInclusive;
use std::path::Path;
use std::time::Duration;

use leaderboard_protocol::files as protocol;
use leaderboard_protocol::files::{Host, Mark, Pair, Side, StatusFile};

/// CARLA's RPC `get_episode_settings`, in MessagePack: its main loop has to answer it, and it changes nothing.
const REQUEST: &[u8] = b"\x94\x00\x00\xb4get_episode_settings\x90";
/// The kernel's tables of sockets.
const TABLES: [&str; 2] = ["/proc/self/net/tcp", "/proc/self/net/tcp6"];
/// The states there of a socket that listens, and of one of which nothing but its name is left.
const LISTEN: &str = "0A";
const TIME_WAIT: &str = "06";
/// Ports that a server may take from its own on: CARLA's streaming server has the next one. The agent's traffic manager has the one
/// behind these.
const PORTS: u16 = 10;

/// Listener on a port.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Listener {
    Nobody,
    /// A descendant of this process, or nothing speaks against it: the kernel hides a descendant's files.
    Own,
    /// A process of another container.
    Foreign,
    /// The kernel hides its tables.
    Hidden,
}

/// All ports that a simulator's server on this port may take.
pub(crate) fn ports_of(port: u16) -> RangeInclusive<u16> {
    port..=port.saturating_add(PORTS - 1)
}

/// Finds the listener on the port.
pub(crate) fn listener(port: u16) -> Listener {
    match sockets() {
        None => Listener::Hidden,
        Some(sockets) => of_port(port, &listening(sockets, port..=port)),
    }
}

/// The first of the ports on which a process of another container listens.
pub(crate) fn foreign_listener(mut ports: RangeInclusive<u16>) -> Option<u16> {
    let found = listening(sockets()?, ports.clone());
    ports.find(|port| of_port(*port, &found) == Listener::Foreign)
}

/// The first of the ports that cannot be taken. Once no process of this container is left, another one's has it, whether it listens there
/// or not: the kernel's tables do not show a socket that only has a name.
pub(crate) fn held(mut ports: RangeInclusive<u16>) -> Option<u16> {
    if !descendants().is_empty() {
        return None;
    }
    let is_held = |port: u16| {
        let taken = TcpListener::bind((Ipv4Addr::UNSPECIFIED, port));
        taken.is_err_and(|error| error.kind() == ErrorKind::AddrInUse)
    };
    ports.find(|port| is_held(*port))
}

/// How many ends of connections to the port other processes have.
pub(crate) fn connections(port: u16) -> usize {
    let is_end = |socket: &Socket| socket.remote_port == port && socket.state != TIME_WAIT;
    sockets().map_or(0, |sockets| sockets.filter(is_end).count())
}

/// The sockets that listen on one of the ports, with their ports.
fn listening(sockets: impl Iterator<Item = Socket>, ports: RangeInclusive<u16>) -> Vec<(u16, String)> {
    sockets
        .filter(|socket| socket.state == LISTEN && ports.contains(&socket.local_port))
        .map(|socket| (socket.local_port, socket.link))
        .collect()
}

fn of_port(port: u16, listening: &[(u16, String)]) -> Listener {
    let its = listening.iter().filter(|(of, _)| *of == port);
    let links: HashSet<&str> = its.map(|(_, link)| link.as_str()).collect();
    if links.is_empty() {
        Listener::Nobody
    } else if descendants().iter().any(|pid| holds(*pid, &links)) {
        Listener::Own
    } else {
        Listener::Foreign
    }
}

/// One line of the kernel's tables.
struct Socket {
    local_port: u16,
    remote_port: u16,
    state: String,
    /// Its name among a process's links to its files.
    link: String,
}

/// All sockets, one after the other: an agent can open so many that they should not be in memory at once. None where the kernel hides them.
fn sockets() -> Option<impl Iterator<Item = Socket>> {
    let tables: Vec<File> = TABLES.iter().filter_map(|path| File::open(path).ok()).collect();
    let lines = |table: File| BufReader::new(table).lines().map_while(Result::ok);
    let some = !tables.is_empty();
    some.then(|| tables.into_iter().flat_map(lines).filter_map(|line| socket(&line)))
}

/// The socket of a line; none of the heading.
fn socket(line: &str) -> Option<Socket> {
    let mut fields = line.split_whitespace();
    let (_, local_port) = fields.nth(1)?.rsplit_once(':')?;
    let (_, remote_port) = fields.next()?.rsplit_once(':')?;
    let port = |digits: &str| u16::from_str_radix(digits, 16).ok();
    Some(Socket {
        local_port: port(local_port)?,
        remote_port: port(remote_port)?,
        state: fields.next()?.to_owned(),
        link: format!("socket:[{}]", fields.nth(5)?),
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

/// True if a process has one of the sockets open. One whose files are hidden (it has changed its user) may have.
fn holds(pid: u32, sockets: &HashSet<&str>) -> bool {
    let entries = match fs::read_dir(Path::new("/proc").join(pid.to_string()).join("fd")) {
        Ok(entries) => entries,
        Err(error) => return error.kind() == ErrorKind::PermissionDenied,
    };
    let links = entries.flatten().filter_map(|entry| fs::read_link(entry.path()).ok());
    links
        .into_iter()
        .any(|link| link.to_str().is_some_and(|link| sockets.contains(link)))
}

/// True if an agent of this Pod may have begun: not before a host was ready. Until then a taken port is no agent's doing.
pub(crate) fn may_agents_run(status: &Path, host: Host) -> bool {
    let is_ready =
        |file: &StatusFile| matches!(file, StatusFile::Of(member, Mark::Start(_)) if member.side == Side::Host(host));
    protocol::present(status, Pair::MAX, host).iter().any(is_ready)
}

/// True if a server answers on the port.
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

    /// True if the server has reacted: a server of another protocol that closes the connection is alive, too.
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
        let all = || table.lines().filter_map(socket);
        let at = |ports| listening(all(), ports);
        assert_eq!(at(2000..=2000), [(2000, "socket:[4711]".to_owned())]);
        assert_eq!(at(2100..=2109), [(2100, "socket:[4713]".to_owned())]);
        assert!(at(2200..=2209).is_empty());
        assert_eq!(all().filter(|socket| socket.remote_port == 50_000).count(), 1);
    }

    #[test]
    fn the_ports_behind_a_servers_own_are_looked_at_and_the_traffic_managers_is_not() {
        assert_eq!(ports_of(2100), 2100..=2109);
        assert_eq!(ports_of(u16::MAX), u16::MAX..=u16::MAX);
    }

    #[test]
    fn connections_are_counted_by_the_port_that_they_lead_to() {
        let listener = TcpListener::bind(("127.0.0.1", 0)).unwrap();
        let port = listener.local_addr().unwrap().port();
        assert_eq!(connections(port), 0);
        let _ends: Vec<_> = (0..3)
            .map(|_| TcpStream::connect(("127.0.0.1", port)).unwrap())
            .collect();
        assert_eq!(connections(port), 3);
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
