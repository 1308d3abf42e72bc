//! The CARLA server's stand-in: a port that opens after a while, greets each connection, and can die in the middle of a
//! route. Called by `challenge-simulator`.

use std::{
    env,
    fs::{self, File, OpenOptions},
    io::{self, BufRead, BufReader, Write},
    net::{Ipv4Addr, TcpListener, TcpStream},
    path::{Path, PathBuf},
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
    thread,
    time::Duration,
};

use crate::knobs::{KnobError, Knobs, Known, Shape};

/// The version it greets with.
const VERSION: &str = "0.9.15";
const SAVED: &str = "/home/carla/CarlaUE4/Saved";

const KNOBS: &[Known] = &[
    ("crash", Shape::At),
    ("crash-loading", Shape::At),
    ("hang", Shape::PlainOrAt),
    ("never-ready", Shape::Plain),
    ("ignore-term", Shape::Plain),
];

/// Why the simulator did not start.
#[derive(Debug, thiserror::Error)]
pub enum SimulatorError {
    #[error("-carla-rpc-port={0} is not a port")]
    Port(String),
    #[error("SIM_START_MS={0} is not a number of milliseconds")]
    StartTime(String),
    #[error("SIM_KNOBS: {0}")]
    Knobs(#[from] KnobError),
    #[error("port {port} of 127.0.0.1 can't be opened: {source}")]
    Listen { port: u16, source: io::Error },
}

/// State that all connections of one simulator share.
struct World {
    knobs: Knobs,
    saved: PathBuf,
    /// Worlds loaded since this process started, over all connections.
    worlds: Mutex<usize>,
    /// Routes begun since then.
    routes: Mutex<usize>,
    /// The main loop hangs: no connection gets an answer any more.
    hangs: AtomicBool,
    log: Mutex<Option<File>>,
}

/// Runs until it is killed or a knob ends it. `arguments` are `CarlaUE4.sh`'s; those it does not know are ignored.
pub fn run(arguments: &[String]) -> Result<(), SimulatorError> {
    let port = port(arguments)?;
    let start = milliseconds(&env::var("SIM_START_MS").unwrap_or_else(|_| "300".to_owned()))?;
    let knobs = Knobs::parse(&env::var("SIM_KNOBS").unwrap_or_default(), KNOBS, port)?;
    let saved = PathBuf::from(env::var("CARLA_SAVED").unwrap_or_else(|_| SAVED.to_owned()));
    if knobs.has("ignore-term") {
        crate::faults::ignore_term();
    }
    let log = Mutex::new(open_log(&saved, port));
    let world = Arc::new(World {
        knobs,
        saved,
        worlds: Mutex::new(0),
        routes: Mutex::new(0),
        hangs: AtomicBool::new(false),
        log,
    });
    world.say(&format!(
        "4.26.2 CarlaUE4 {VERSION}, arguments: {}",
        arguments.join(" ")
    ));
    if world.knobs.has("never-ready") {
        forever();
    }
    thread::sleep(start);
    let listener =
        TcpListener::bind((Ipv4Addr::LOCALHOST, port)).map_err(|source| SimulatorError::Listen { port, source })?;
    // As CARLA's streaming server, which comes second.
    let behind = if port == 0 { 0 } else { port.saturating_add(1) };
    let _streaming = TcpListener::bind((Ipv4Addr::LOCALHOST, behind))
        .map_err(|source| SimulatorError::Listen { port: behind, source })?;
    let address = listener
        .local_addr()
        .map_err(|source| SimulatorError::Listen { port, source })?;
    world.say(&format!("listening on {address}"));
    if world.knobs.has("hang") {
        forever();
    }
    for stream in listener.incoming().flatten() {
        let world = Arc::clone(&world);
        thread::spawn(move || {
            if let Err(error) = world.converse(&stream) {
                world.say(&format!("a connection broke: {error}"));
            }
        });
    }
    Ok(())
}

impl World {
    fn converse(&self, mut stream: &TcpStream) -> io::Result<()> {
        if self.hangs.load(Ordering::Relaxed) {
            forever();
        }
        writeln!(stream, "carla {VERSION}")?;
        for line in BufReader::new(stream).lines() {
            let line = line?;
            if let Some(route) = line.strip_prefix("load ") {
                self.load();
                writeln!(stream, "ok {route}")?;
            } else if let Some(route) = line.strip_prefix("route ") {
                self.begin(route);
                writeln!(stream, "ok {route}")?;
            }
        }
        Ok(())
    }

    fn load(&self) {
        let number = one_more(&self.worlds);
        if self.knobs.fires("crash-loading", number, &self.saved) {
            self.crash();
        }
    }

    fn begin(&self, route: &str) {
        let number = one_more(&self.routes);
        self.say(&format!("route {route} begins, number {number} of this server"));
        if self.knobs.fires("crash", number, &self.saved) {
            self.crash();
        }
        if self.knobs.fires("hang", number, &self.saved) {
            self.hangs.store(true, Ordering::Relaxed);
            forever();
        }
    }

    fn crash(&self) -> ! {
        self.say("Signal 11 caught. Malloc Size=65538 LargeMemoryPoolOffset=65554");
        std::process::exit(1);
    }

    /// To standard output and, when there is one, to the log file; neither may end the simulator.
    fn say(&self, line: &str) {
        let _ = writeln!(io::stdout(), "{line}");
        if let Some(file) = self.log.lock().unwrap_or_else(PoisonError::into_inner).as_mut() {
            let _ = writeln!(file, "{line}");
        }
    }
}

fn one_more(counter: &Mutex<usize>) -> usize {
    let mut count = counter.lock().unwrap_or_else(PoisonError::into_inner);
    *count += 1;
    *count
}

/// All pairs' simulators share one folder, so the file carries the port.
fn open_log(saved: &Path, port: u16) -> Option<File> {
    let folder = saved.join("Logs");
    fs::create_dir_all(&folder).ok()?;
    OpenOptions::new()
        .create(true)
        .append(true)
        .open(folder.join(format!("CarlaUE4-{port}.log")))
        .ok()
}

fn port(arguments: &[String]) -> Result<u16, SimulatorError> {
    let text = arguments
        .iter()
        .find_map(|one| one.trim_start_matches('-').strip_prefix("carla-rpc-port="));
    text.map_or(Ok(2000), |text| {
        text.parse().map_err(|_| SimulatorError::Port(text.to_owned()))
    })
}

fn milliseconds(text: &str) -> Result<Duration, SimulatorError> {
    text.parse()
        .map(Duration::from_millis)
        .map_err(|_| SimulatorError::StartTime(text.to_owned()))
}

fn forever() -> ! {
    loop {
        thread::park();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_port_among_carlas_arguments() {
        let port_of = |line: &str| port(&line.split(' ').map(str::to_owned).collect::<Vec<_>>());
        assert_eq!(
            port_of("-vulkan -RenderOffScreen -nosound -carla-rpc-port=2100 -ini:[a]:b=0").unwrap(),
            2100
        );
        assert_eq!(port_of("-nosound").unwrap(), 2000);
        assert!(matches!(port_of("-carla-rpc-port=x"), Err(SimulatorError::Port(text)) if text == "x"));
    }
}
