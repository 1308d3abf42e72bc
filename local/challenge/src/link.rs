//! The agent's connection to its simulator. Called by `evaluator`; `simulator` speaks the other side: a greeting line
//! for each connection, then `ok <id>` for each `load <id>` and each `route <id>`.

use std::{
    io::{self, BufRead, BufReader, ErrorKind, Read, Write},
    net::{Ipv4Addr, SocketAddr, TcpStream},
    thread,
    time::{Duration, Instant},
};

/// How long the agent tries to reach its simulator.
const PATIENCE: Duration = Duration::from_secs(5);
const PAUSE: Duration = Duration::from_millis(100);
const TICK: Duration = Duration::from_secs(1);

/// The simulator could not be reached in time.
#[derive(Debug, thiserror::Error)]
#[error(
    "time-out of {}ms while waiting for the simulator, make sure the simulator is ready and connected to 127.0.0.1:{port}",
    PATIENCE.as_millis()
)]
pub struct NoSimulator {
    port: u16,
}

/// The simulator went away.
#[derive(Debug)]
pub struct Gone;

/// A connection that has been greeted.
#[derive(Debug)]
pub struct Link {
    stream: BufReader<TcpStream>,
}

impl Link {
    /// Connects to the simulator of this port, trying again for a few seconds.
    pub fn connect(port: u16) -> Result<Self, NoSimulator> {
        let start = Instant::now();
        loop {
            let left = PATIENCE.saturating_sub(start.elapsed());
            if left.is_zero() {
                return Err(NoSimulator { port });
            }
            match greeted(port, left) {
                Ok(link) => return Ok(link),
                Err(_) => thread::sleep(PAUSE.min(left)),
            }
        }
    }

    /// Loads the world of a route; returns when the simulator has it, however long that takes.
    pub fn load(&mut self, route: &str) -> Result<(), Gone> {
        self.ask(&format!("load {route}\n"))
    }

    /// Begins a route; returns when the simulator has taken it up, however long that takes.
    pub fn begin(&mut self, route: &str) -> Result<(), Gone> {
        self.ask(&format!("route {route}\n"))
    }

    fn ask(&mut self, line: &str) -> Result<(), Gone> {
        self.stream.get_ref().set_read_timeout(None).map_err(|_| Gone)?;
        self.stream.get_mut().write_all(line.as_bytes()).map_err(|_| Gone)?;
        let mut answer = String::new();
        match self.stream.read_line(&mut answer) {
            Ok(length) if length > 0 => Ok(()),
            _ => Err(Gone),
        }
    }

    /// Drives for `time`, calling `tick` once a second.
    pub fn drive(&mut self, time: Duration, mut tick: impl FnMut(Duration)) -> Result<(), Gone> {
        let start = Instant::now();
        loop {
            let left = time.saturating_sub(start.elapsed());
            if left.is_zero() {
                return Ok(());
            }
            self.stream
                .get_ref()
                .set_read_timeout(Some(left.min(TICK)))
                .map_err(|_| Gone)?;
            match self.stream.read(&mut [0; 64]) {
                Ok(0) => return Err(Gone),
                Err(error) if !patient(error.kind()) => return Err(Gone),
                Ok(_) | Err(_) => tick(start.elapsed()),
            }
        }
    }
}

fn patient(kind: ErrorKind) -> bool {
    matches!(
        kind,
        ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted
    )
}

fn greeted(port: u16, left: Duration) -> io::Result<Link> {
    let stream = TcpStream::connect_timeout(&SocketAddr::from((Ipv4Addr::LOCALHOST, port)), left)?;
    stream.set_read_timeout(Some(left))?;
    let mut stream = BufReader::new(stream);
    let mut greeting = String::new();
    stream.read_line(&mut greeting)?;
    if greeting.starts_with("carla ") {
        Ok(Link { stream })
    } else {
        Err(ErrorKind::InvalidData.into())
    }
}
