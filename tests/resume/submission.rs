//! One submission: its plan, its prefix, its ports, and the command of each of its containers.

use std::fs;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use std::sync::atomic::{AtomicU32, Ordering};

use leaderboard_api::{CarlaPlan, LeaderboardVersion, PlannedEvaluation, Verify};
use leaderboard_aws::archive::Archive;
use leaderboard_contract::run::{ENV_POD_UID, ENV_RUN, Run};
use leaderboard_evaluation::fixtures;
use leaderboard_pod::places::Places;
use leaderboard_protocol::files::{KEPT_CHECKPOINT, Member, Side};
use tokio::process::Command;

use crate::ministack::{self, server};

pub const PAIRS: u16 = 4;
pub const ROUTES_OF_PAIR: u16 = 5;
/// logcopy looks every 50 ms and gives up waiting after a twentieth of its times.
pub const FASTER: u32 = 20;
/// Below what the kernel gives away by itself, so that a simulator that comes back finds its port free.
const PORTS: std::ops::Range<u16> = 12_000..28_000;
const PORT_STEP: u16 = 20;

/// The programs under test.
pub struct Programs {
    pub operator: PathBuf,
    pub runner: PathBuf,
    agent: PathBuf,
    simulator: PathBuf,
}

pub fn programs() -> &'static Programs {
    static PROGRAMS: OnceLock<Programs> = OnceLock::new();
    PROGRAMS.get_or_init(|| {
        let operator = PathBuf::from(env!("CARGO_BIN_EXE_leaderboard-operator"));
        let beside = |name: &str| {
            let path = operator.with_file_name(name);
            assert!(path.is_file(), "{} is missing: run `make build`", path.display());
            path
        };
        Programs {
            runner: beside("leaderboard-runner"),
            agent: beside("challenge-agent"),
            simulator: beside("challenge-simulator"),
            operator: operator.clone(),
        }
    })
}

/// The submission of one run, and the settings of its programs.
pub struct Submission {
    pub archive: Archive,
    pub run: Run,
    pub route_ms: u32,
    /// Real routes take minutes. These take as long as the runner needs to keep a copy, however busy the machine is.
    pub route_waits_for_copy: bool,
    /// Knobs of the simulators.
    pub simulator_knobs: String,
    /// Knobs of the agents; `{pair}` is the number of each.
    pub agent_knobs: String,
    ports: Vec<u16>,
}

impl Submission {
    /// A prefix and ports of its own, on an endpoint of S3.
    pub async fn on(endpoint: &str, bucket: &str, format: LeaderboardVersion, random: &mut fastrand::Rng) -> Self {
        static NUMBER: AtomicU32 = AtomicU32::new(1);
        let id = format!("run-{}", NUMBER.fetch_add(1, Ordering::Relaxed));
        let aws = ministack::aws(&server().await.endpoint()).await;
        let s3 = aws.s3(None, Some(&server().await.endpoint()));
        Self {
            archive: Archive::new(s3, bucket, format!("runs/{id}/")),
            run: run(endpoint, bucket, &id, format),
            route_ms: 20,
            route_waits_for_copy: true,
            simulator_knobs: String::new(),
            agent_knobs: String::new(),
            ports: free_ports(random),
        }
    }

    pub async fn new(bucket: &str, format: LeaderboardVersion, random: &mut fastrand::Rng) -> Self {
        Self::on(&server().await.endpoint(), bucket, format, random).await
    }

    /// `workspace` or `logcopy` of the Pod below `root`.
    pub fn own(&self, name: &str, root: &Path, pod_uid: &str) -> Command {
        let mut command = Command::new(&programs().operator);
        command
            .arg(name)
            .arg(format!("--root={}", root.display()))
            .arg(format!("--faster={FASTER}"))
            .env(ENV_RUN, serde_json::to_string(&self.run).unwrap())
            .env(ENV_POD_UID, pod_uid)
            .env("AWS_ACCESS_KEY_ID", "test")
            .env("AWS_SECRET_ACCESS_KEY", "test")
            .env("AWS_REGION", "us-east-1")
            .env("AWS_EC2_METADATA_DISABLED", "true")
            .env_remove("RUST_LOG");
        command
    }

    /// A simulator or an agent behind its runner.
    pub fn member(&self, member: Member, root: &Path) -> Command {
        let places = Places::below(root);
        let mut command = Command::new(places.runner_for_all());
        command
            .args([member.side.name(), &format!("--pair={}", member.pair)])
            .arg(format!("--status={}", places.status().display()))
            .args(["--grace-seconds=5", "--ready-seconds=60", "--peer-seconds=60"])
            .arg(format!("--termination-log={}/{member}.termination", root.display()))
            .env_remove("RESUME")
            .env_remove("CHALLENGE_FORMAT");
        match member.side {
            Side::Host(_) => self.simulator(&mut command, member, &places),
            Side::Agent => self.agent(&mut command, member, &places),
        }
        command
    }

    fn port(&self, member: Member) -> u16 {
        self.ports[usize::from(member.pair.get()) - 1]
    }

    /// The file that an agent with the knob `hang@ROUTE:once` leaves, below the logs.
    pub fn hang_marker(&self, agent: Member, route: u32) -> String {
        format!("agent/agent{}/.hang-{route}-{}.happened", agent.pair, self.port(agent))
    }

    fn simulator(&self, command: &mut Command, member: Member, places: &Places) {
        let port = self.port(member);
        command
            .args([format!("--port={port}"), "--flush-seconds=60".to_owned()])
            .arg("--")
            .arg(&programs().simulator)
            .arg(format!("-carla-rpc-port={port}"))
            .env("SIM_START_MS", "0")
            .env("SIM_KNOBS", &self.simulator_knobs)
            .env("CARLA_SAVED", places.logs.join("simulator"));
    }

    fn agent(&self, command: &mut Command, member: Member, places: &Places) {
        let work = places.logs.join(format!("agent/agent{}", member.pair));
        let checkpoint = work.join("agent_results.json");
        let path = ["CARLA/PythonAPI/carla", "scenario_runner", "leaderboard"].map(contents);
        let path = std::env::join_paths(path).unwrap();
        let plan = self.run.plan.carla().unwrap();
        let slice = &plan.slices[usize::from(member.pair.get()) - 1];
        // No route needs the file's content.
        let team_agent = contents("leaderboard/README.md");
        command
            .arg(format!("--work={}", work.display()))
            .arg(format!("--checkpoint={}", checkpoint.display()))
            .args(["--idle-seconds=60", "--python-path", path.to_str().unwrap()])
            .arg(format!(
                "--route-runs={}",
                slice.routes() * u32::try_from(plan.repetitions).unwrap()
            ))
            .arg("--")
            .arg(&programs().agent)
            .arg("-u")
            .arg(contents("leaderboard/leaderboard/leaderboard_evaluator.py"))
            .arg(format!("--port={}", self.port(member)))
            .arg(format!("--agent={}", team_agent.display()))
            .args(["--agent-config=", "--track=SENSORS", "--record=/nowhere", "--debug=0"])
            .arg(format!(
                "--routes={}",
                contents("leaderboard/data/routes_testing.xml").display()
            ))
            .args([format!("--routes-subset={slice}"), "--repetitions=1".to_owned()])
            .arg("--resume=$(RESUME)")
            .arg(format!("--checkpoint={}", checkpoint.display()))
            .env("ROUTE_MS", self.route_ms.to_string())
            .env(
                "AGENT_KNOBS",
                self.agent_knobs.replace("{pair}", &member.pair.to_string()),
            );
        if self.route_waits_for_copy {
            let copy = places.status().join(member.to_string()).join(KEPT_CHECKPOINT);
            command.env("ROUTE_COPY", copy);
        }
        match plan.version {
            LeaderboardVersion::V1 => {
                let scenarios = contents("leaderboard/data/all_towns_traffic_scenarios_private.json");
                command.arg(format!("--scenarios={}", scenarios.display()));
            }
            LeaderboardVersion::V2 => {
                command.arg(format!(
                    "--debug-checkpoint={}",
                    work.join("live_results.txt").display()
                ));
            }
        }
    }
}

fn contents(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("local/challenge/contents")
        .join(path)
}

/// Makes the volumes of a Pod as the kubelet does before the first container.
pub fn make_volumes(root: &Path) {
    let places = Places::below(root);
    for folder in [&places.logs, &places.tools, &places.podinfo] {
        fs::create_dir_all(folder).unwrap();
    }
    fs::create_dir_all(root.join("dev")).unwrap();
    fs::create_dir_all(places.runner.parent().unwrap()).unwrap();
    std::os::unix::fs::symlink(&programs().runner, &places.runner).unwrap();
    fs::write(places.stop(), "").unwrap();
}

/// The plan of CARLA's evaluation.
pub fn carla(run: &mut Run) -> &mut CarlaPlan {
    match &mut run.plan.evaluation {
        PlannedEvaluation::Carla(carla) => carla,
        PlannedEvaluation::Container(_) => panic!("it is not CARLA's"),
    }
}

fn run(endpoint: &str, bucket: &str, id: &str, format: LeaderboardVersion) -> Run {
    let mut run = Run {
        submission: id.to_owned(),
        uid: format!("uid of {id}"),
        verify: Verify::Refuse,
        // The smallest pause between two rounds is what is left.
        period_seconds: 0,
        ..fixtures::run()
    };
    run.plan.run_id = id.parse().unwrap();
    let carla = carla(&mut run);
    (carla.version, carla.slices, carla.routes) = (format, leaderboard_api::effective::slices(20, 4), 20);
    let s3 = &mut run.plan.storage.s3;
    (s3.bucket, s3.prefix) = (bucket.to_owned(), Some("runs/".to_owned()));
    s3.endpoint = Some(endpoint.to_owned());
    run
}

fn free_ports(random: &mut fastrand::Rng) -> Vec<u16> {
    let mut ports = Vec::new();
    while ports.len() < usize::from(PAIRS) {
        // A simulator has ports behind its own.
        let port = random.u16(PORTS).next_multiple_of(PORT_STEP);
        if !ports.contains(&port) && TcpListener::bind(("127.0.0.1", port)).is_ok() {
            ports.push(port);
        }
    }
    ports
}
