//! A real etcd and kube-apiserver on free loopback ports, with the operator's CRDs installed: one for the whole test program.
//!
//! No controller runs beside them: a Job stays as it was created, and a deleted namespace stays Terminating. Each test takes
//! a namespace of its own. They end with the test program, also when it is killed: see `watchdog`.

use std::fmt::Write as _;
use std::fs::{self, File};
use std::io;
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

use k8s_openapi::api::core::v1::Namespace;
use k8s_openapi::apiextensions_apiserver::pkg::apis::apiextensions::v1::CustomResourceDefinition;
use kube::api::{Api, ObjectMeta, PostParams};
use kube::runtime::wait::{await_condition, conditions::is_crd_established};
use kube::{Client, Config};
use serde_json::json;
use tokio::sync::OnceCell;

use super::tools;
use control_plane::{apiserver_arguments, etcd_arguments, free_ports, kubeconfig, probe};

#[path = "control_plane.rs"]
mod control_plane;

const PROGRAMS: [&str; 3] = ["etcd", "kube-apiserver", "kubectl"];
const HOW_TO_RUN: &str = "run these tests with `make test`, or set KUBEBUILDER_ASSETS to a folder that holds them";
/// An idle machine needs 4 s.
const START_LIMIT: Duration = Duration::from_mins(3);
/// A starting API server reports nothing when it is ready: it is asked this often.
const POLL: Duration = Duration::from_millis(50);
/// A free port can be taken by somebody else before the server has it.
const TRIES: usize = 3;

/// The user that the tests are.
const ADMIN: &str = "admin";
/// Users with all rights whose requests the audit log has, each for one test that counts them.
const COUNTED: u32 = 64;

/// A request of a counted user.
#[derive(Debug, Clone, serde::Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Request {
    user: User,
    pub verb: String,
    /// When it came in.
    #[serde(rename = "requestReceivedTimestamp")]
    pub received: jiff::Timestamp,
    /// When it was answered.
    #[serde(rename = "stageTimestamp")]
    pub answered: jiff::Timestamp,
    object_ref: Option<ObjectRef>,
}

#[derive(Debug, Clone, serde::Deserialize)]
struct User {
    username: String,
}

#[derive(Debug, Clone, serde::Deserialize)]
struct ObjectRef {
    resource: String,
    subresource: Option<String>,
}

impl Request {
    /// Resource of the request, with the subresource behind a slash.
    pub fn resource(&self) -> String {
        let Some(object) = &self.object_ref else {
            return String::new();
        };
        let part = object.subresource.as_ref().map(|part| format!("/{part}"));
        format!("{}{}", object.resource, part.unwrap_or_default())
    }
}

/// The running API server.
pub struct ApiServer {
    folder: PathBuf,
    programs: PathBuf,
    config: Config,
    _lifeline: ChildStdin,
}

/// The API server of this test program, started by the first call.
pub async fn server() -> &'static ApiServer {
    // A failure is kept too: the other tests would only wait for the same one.
    static SERVER: OnceCell<Result<ApiServer, String>> = OnceCell::const_new();
    match SERVER.get_or_init(start).await {
        Ok(server) => server,
        Err(why) => panic!("no API server to test against: {why}"),
    }
}

impl ApiServer {
    /// A client with all rights. It belongs to the runtime of the test that calls this: don't share it between tests.
    pub fn client(&self) -> Client {
        Client::try_from(self.config.clone()).unwrap()
    }

    /// How it is reached with all rights, for clients of one's own kind.
    pub fn config(&self) -> Config {
        self.config.clone()
    }

    /// Configuration of a user that no other client is, and the user's name for [`ApiServer::requests`].
    pub fn counted(&self) -> (Config, String) {
        static NUMBER: AtomicU32 = AtomicU32::new(0);
        let number = NUMBER.fetch_add(1, Ordering::Relaxed);
        assert!(number < COUNTED, "there are only {COUNTED} counted users");
        let user = format!("counted-{number}");
        let mut config = self.config();
        config.auth_info.token = Some(user.clone().into());
        (config, user)
    }

    /// The requests of a counted user that were answered, oldest first. Watches are in it once they have ended.
    pub fn requests(&self, user: &str) -> Vec<Request> {
        let log = fs::read_to_string(self.folder.join("audit.log")).unwrap_or_default();
        // Some tests ask many times a second, and the log has all other counted users too.
        let own = format!("\"username\":\"{user}\"");
        // The last line may be half written.
        let all = log
            .lines()
            .filter(|line| line.contains(&own))
            .filter_map(|line| serde_json::from_str::<Request>(line).ok());
        all.filter(|request| request.user.username == user).collect()
    }

    /// A new namespace, `<name>-<number>`.
    pub async fn namespace(&self, name: &str) -> String {
        static NUMBER: AtomicU32 = AtomicU32::new(1);
        let name = format!("{name}-{}", NUMBER.fetch_add(1, Ordering::Relaxed));
        let namespace = Namespace {
            metadata: ObjectMeta {
                name: Some(name.clone()),
                ..ObjectMeta::default()
            },
            ..Namespace::default()
        };
        let api = Api::all(self.client());
        api.create(&PostParams::default(), &namespace).await.unwrap();
        name
    }

    /// The file that programs reach it by, with all rights.
    pub fn kubeconfig(&self) -> PathBuf {
        kubeconfig(&self.folder, ADMIN)
    }

    /// A kubectl that speaks to this server and keeps nothing in the user's home.
    pub fn kubectl(&self) -> Command {
        let mut command = Command::new(self.programs.join("kubectl"));
        command
            .env("KUBECONFIG", kubeconfig(&self.folder, ADMIN))
            .env("KUBECACHEDIR", self.folder.join("kubectl"))
            .stdin(Stdio::null());
        command
    }
}

async fn start() -> Result<ApiServer, String> {
    let programs = programs()?;
    let mut failures = String::new();
    for number in 1..=TRIES {
        match start_once(&programs, number).await {
            Ok(server) => {
                install(&server).await?;
                return Ok(server);
            }
            Err(why) => _ = write!(failures, "\n{why}"),
        }
    }
    Err(format!("{TRIES} starts failed:{failures}"))
}

/// Where etcd, kube-apiserver and kubectl are: controller-runtime's variable, else the lab's cache.
fn programs() -> Result<PathBuf, String> {
    let folder = if let Some(folder) = std::env::var_os("KUBEBUILDER_ASSETS") {
        PathBuf::from(folder)
    } else {
        tools::of_lab(&PROGRAMS).map_err(|error| format!("{error}; {HOW_TO_RUN}"))?
    };
    match PROGRAMS.iter().find(|program| !folder.join(program).is_file()) {
        None => Ok(folder),
        Some(missing) => Err(format!("{} has no {missing}; {HOW_TO_RUN}", folder.display())),
    }
}

/// Ends its processes and removes its folder when dropped, so that a failed start leaves nothing.
struct Attempt {
    folder: PathBuf,
    children: Vec<(&'static str, Child)>,
    watchdog: Option<Child>,
}

impl Drop for Attempt {
    fn drop(&mut self) {
        // The watchdog first: once a process is waited for, its id may be another's.
        for child in self
            .watchdog
            .iter_mut()
            .chain(self.children.iter_mut().map(|(_, child)| child))
        {
            _ = child.kill();
            _ = child.wait();
        }
        _ = fs::remove_dir_all(&self.folder);
    }
}

impl Attempt {
    fn spawn(&mut self, programs: &Path, program: &'static str, arguments: &[String]) -> Result<(), String> {
        let child = log(&self.folder, program).and_then(|log| {
            Command::new(programs.join(program))
                .args(arguments)
                .stdin(Stdio::null())
                .stdout(log.try_clone()?)
                .stderr(log)
                .spawn()
        });
        let child = child.map_err(|error| format!("{program} does not start: {error}"))?;
        self.children.push((program, child));
        Ok(())
    }

    /// Last line of a program that ended too early; None if all run.
    fn ended(&mut self) -> Option<String> {
        self.children.iter_mut().find_map(|(program, child)| {
            let status = child.try_wait().ok().flatten()?;
            let log = fs::read_to_string(self.folder.join(format!("{program}.log"))).unwrap_or_default();
            let last = log.lines().last().unwrap_or("(nothing)").to_owned();
            Some(format!("{program} ended ({status}) and said last: {last}"))
        })
    }
}

async fn start_once(programs: &Path, number: usize) -> Result<ApiServer, String> {
    let folder = std::env::temp_dir().join(format!("leaderboard-apiserver-{}-{number}", std::process::id()));
    let mut attempt = Attempt {
        folder: folder.clone(),
        children: Vec::new(),
        watchdog: None,
    };
    let [client_port, peer_port, port] = free_ports().map_err(|error| format!("no free port: {error}"))?;
    prepare(&folder)?;
    attempt.spawn(programs, "etcd", &etcd_arguments(&folder, client_port, peer_port))?;
    attempt.spawn(
        programs,
        "kube-apiserver",
        &apiserver_arguments(&folder, client_port, port),
    )?;
    let watchdog = watchdog(&attempt).map_err(|error| format!("sh does not start: {error}"))?;
    let lifeline = attempt
        .watchdog
        .insert(watchdog)
        .stdin
        .take()
        .ok_or("the watchdog has no pipe")?;
    let config = ready(&mut attempt, port).await?;
    // From here on the watchdog alone ends the processes and removes the folder.
    std::mem::forget(attempt);
    Ok(ApiServer {
        folder,
        programs: programs.to_owned(),
        config,
        _lifeline: lifeline,
    })
}

/// Ends the servers when this process is gone. Statics are never dropped, and a killed process drops no value. But the kernel always
/// closes the pipe that the watchdog reads.
fn watchdog(attempt: &Attempt) -> io::Result<Child> {
    const SCRIPT: &str = r#"trap '' INT TERM HUP
        folder=$1; shift
        read -r _
        kill -KILL "$@" 2>/dev/null
        for _ in 1 2 3 4 5; do rm -rf "$folder" && break; sleep 1; done"#;
    Command::new("sh")
        .args(["-c", SCRIPT, "watchdog"])
        .arg(&attempt.folder)
        .args(attempt.children.iter().map(|(_, child)| child.id().to_string()))
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
}

fn log(folder: &Path, program: &str) -> io::Result<File> {
    File::create(folder.join(format!("{program}.log")))
}

/// The folder, its users, and which of their requests are logged.
fn prepare(folder: &Path) -> Result<(), String> {
    _ = fs::remove_dir_all(folder);
    let made = fs::DirBuilder::new().mode(0o700).create(folder);
    made.map_err(|error| format!("{} cannot be made: {error}", folder.display()))?;
    let counted: Vec<String> = (0..COUNTED).map(|number| format!("counted-{number}")).collect();
    let rules = json!([{"level": "Metadata", "users": counted}, {"level": "None"}]);
    control_plane::prepare(folder, counted.iter().map(String::as_str).chain([ADMIN]), &rules)
}

/// Waits until the server answers `/readyz`.
async fn ready(attempt: &mut Attempt, port: u16) -> Result<Config, String> {
    let end = Instant::now() + START_LIMIT;
    let mut last = "no certificate".to_owned();
    while Instant::now() < end {
        if let Some(why) = attempt.ended() {
            return Err(why);
        }
        match probe(&attempt.folder, port, &[ADMIN]).await {
            Ok(config) => return Ok(config),
            Err(why) => last = why,
        }
        tokio::time::sleep(POLL).await;
    }
    Err(format!("not ready after {} s: {last}", START_LIMIT.as_secs()))
}

/// Installs the CRDs and waits until they are served.
async fn install(server: &ApiServer) -> Result<(), String> {
    let api: Api<CustomResourceDefinition> = Api::all(server.client());
    let definitions = leaderboard_operator::crds::definitions().map_err(|error| error.to_string())?;
    for definition in definitions {
        let object = definition.object().map_err(|error| error.to_string())?;
        let refused = |error: kube::Error| format!("the API server refuses {}: {error}", definition.file);
        let created = api.create(&PostParams::default(), &object).await.map_err(refused)?;
        let name = created.metadata.name.unwrap_or_default();
        let established = await_condition(api.clone(), &name, is_crd_established());
        let established = tokio::time::timeout(Duration::from_mins(1), established).await;
        let established = established.map_err(|_| format!("{name} is not served after a minute"))?;
        established.map_err(|error| format!("{name}: {error}"))?;
    }
    Ok(())
}
