//! A pair that is to have a GPU, as real processes: what stops it, what is believed of it, and what the server gets.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on fails")]

mod support;

use std::fs;
use std::net::TcpStream;
use std::os::unix::fs::symlink;
use std::time::{Duration, Instant};

use leaderboard_protocol::files::{Mark, StatusFile};
use leaderboard_protocol::verdict::What;
use support::{AGENT, COMPLETE, Pod, SIMULATOR};

/// A Pod whose simulator sees these devices, and a root for it.
fn pod_with(devices: &[&str]) -> (Pod, String) {
    let pod = Pod::new();
    let root = pod.path("root");
    fs::create_dir_all(root.join("dev")).unwrap();
    for device in devices {
        symlink("/dev/null", root.join("dev").join(device)).unwrap();
    }
    let root = format!("--root={}", root.display());
    (pod, root)
}

#[test]
fn without_a_gpu_or_its_driver_no_server_is_started_and_nobody_is_waited_for() {
    let driver = "the node's NVIDIA driver has no Vulkan/OpenGL part (nvidia_icd.json)";
    let none = "the container sees no GPU";
    for (devices, needs, what, why) in [
        (&["nvidiactl"][..], "any", What::NoGpu, none),
        (&[], "vulkan", What::NoGpu, none),
        (&["nvidia0"], "vulkan", What::GraphicsDriverMissing, driver),
        (&["nvidia0"], "opengl", What::GraphicsDriverMissing, driver),
    ] {
        let (mut pod, root) = pod_with(devices);
        // A driver of the machine that runs the tests does not count.
        for name in [
            "LD_LIBRARY_PATH",
            "VK_DRIVER_FILES",
            "VK_ICD_FILENAMES",
            "VK_ADD_DRIVER_FILES",
            "XDG_DATA_DIRS",
        ] {
            pod.environment.push((name.into(), String::new()));
        }
        let started = pod.path("started").display().to_string();
        let mut simulator = pod.simulator_running(&["touch", &started], &[&root, &format!("--gpu={needs}")]);
        assert_eq!(simulator.code(), 69, "{}", simulator.stderr());
        assert!(!pod.path("started").exists());
        assert_eq!(pod.files(SIMULATOR), ["simulator-1.crash0"]);
        let verdict = simulator.verdict();
        assert_eq!((verdict.what, verdict.round, verdict.exit_code), (what, Some(0), None));
        assert!(verdict.why.starts_with(why), "{}", verdict.why);
    }
}

#[test]
fn a_server_gets_the_adapter_of_its_pair_and_no_screen_of_its_image() {
    let (mut pod, root) = pod_with(&["nvidia0", "nvidia1", "nvidia2"]);
    for (name, value) in [
        ("LEADERBOARD_GPU_INDEX", "2"),
        ("DISPLAY", ":0"),
        ("XAUTHORITY", "/x"),
        ("SDL", "dummy"),
    ] {
        pod.environment.push((name.into(), value.into()));
    }
    let (server, found) = (pod.path("server.py"), pod.path("found"));
    let script = format!(
        "echo \"$1 $LEADERBOARD_GRAPHICS_ADAPTER [${{DISPLAY-none}}] [${{XAUTHORITY-none}}] $SDL\" > {}; exec python3 {} {}",
        found.display(),
        server.display(),
        pod.port
    );
    let words = [
        "sh",
        "-c",
        &script,
        "sh",
        "r.GraphicsAdapter=$(LEADERBOARD_GRAPHICS_ADAPTER)",
    ];
    let mut simulator = pod.simulator_running(&words, &[&root, "--gpu=any", "--unset=DISPLAY,XAUTHORITY"]);
    pod.until(SIMULATOR, Mark::Start(0));
    assert_eq!(
        fs::read_to_string(found).unwrap(),
        "r.GraphicsAdapter=2 2 [none] [none] dummy\n"
    );
    pod.write(StatusFile::Cancel);
    pod.write(StatusFile::Stored);
    assert_eq!(simulator.code(), 0, "{}", simulator.stderr());
}

#[test]
fn a_simulator_without_a_gpu_of_the_leaderboard_checks_nothing_and_changes_no_word() {
    let pod = Pod::new();
    let (server, found) = (pod.path("server.py"), pod.path("found"));
    let script = format!(
        "echo \"$1 [${{LEADERBOARD_GRAPHICS_ADAPTER-none}}]\" > {}; exec python3 {} {}",
        found.display(),
        server.display(),
        pod.port
    );
    let words = ["sh", "-c", &script, "sh", "$(LEADERBOARD_GRAPHICS_ADAPTER)"];
    let mut simulator = pod.simulator_running(&words, &["--root=/nowhere"]);
    pod.until(SIMULATOR, Mark::Start(0));
    assert_eq!(
        fs::read_to_string(found).unwrap(),
        "$(LEADERBOARD_GRAPHICS_ADAPTER) [none]\n"
    );
    pod.write(StatusFile::Cancel);
    pod.write(StatusFile::Stored);
    assert_eq!(simulator.code(), 0, "{}", simulator.stderr());
}

const ASKS: &str = "--agent-gpu=true";
const REPORTS: &str = "--report-gpu=true";
/// Command of an agent, which leaves a mark that it ran.
const RUNS: &str = "touch \"$CHECKPOINT.ran\"; printf '%s' \"$RESULTS\" > \"$CHECKPOINT\"";

fn server_of(pod: &Pod) -> [String; 3] {
    let server = pod.path("server.py").display().to_string();
    ["python3".to_owned(), server, pod.port.to_string()]
}

fn simulator_that_asks(pod: &Pod) -> support::Container {
    let server = server_of(pod);
    pod.simulator_running(&server.each_ref().map(String::as_str), &[ASKS])
}

fn has_run(pod: &Pod) -> bool {
    pod.path("work/agent_results.json.ran").exists()
}

#[test]
fn an_agent_without_its_gpu_is_the_simulators_word_and_nothing_of_its_image_runs() {
    let (mut pod, root) = pod_with(&["nvidiactl"]);
    pod.environment.push(("RESULTS".into(), COMPLETE.into()));
    let mut simulator = simulator_that_asks(&pod);
    let _agent = pod.agent_running(&["sh", "-c", RUNS], &[&root, REPORTS]);
    assert_eq!(simulator.code(), 69, "{}", simulator.stderr());
    let verdict = simulator.verdict();
    assert_eq!((verdict.what, verdict.round), (What::NoGpu, Some(0)));
    assert!(
        verdict.why.starts_with("the agent's container sees no GPU"),
        "{}",
        verdict.why
    );
    assert_eq!(pod.files(SIMULATOR), ["simulator-1.crash0"]);
    // Restarted by the kubelet before the Job is ended, it comes to the same end.
    let mut again = simulator_that_asks(&pod);
    assert_eq!((again.code(), again.verdict().what), (69, What::NoGpu));
    assert!(!has_run(&pod));
}

#[test]
fn nothing_is_announced_before_the_agents_runner_has_seen_its_gpu() {
    let (mut pod, root) = pod_with(&["nvidia0"]);
    pod.environment.push(("RESULTS".into(), COMPLETE.into()));
    let mut simulator = simulator_that_asks(&pod);
    let begin = Instant::now();
    while TcpStream::connect(("127.0.0.1", pod.port)).is_err() {
        assert!(begin.elapsed() < support::LIMIT, "{}", simulator.stderr());
        std::thread::yield_now();
    }
    assert!(simulator.stays(Duration::from_secs(2)));
    assert_eq!(pod.files(SIMULATOR), [""; 0]);
    let mut agent = pod.agent_running(&["sh", "-c", RUNS], &[&root, REPORTS]);
    pod.until(SIMULATOR, Mark::Done);
    assert_eq!(agent.code(), 0, "{}", agent.stderr());
    assert!(has_run(&pod));
    assert_eq!(pod.files(AGENT), ["agent-1.done", "agent-1.gpu", "agent-1.start0"]);
    pod.write(StatusFile::Stored);
    assert_eq!(simulator.code(), 0, "{}", simulator.stderr());
}

/// Its folder is its own from then on. It could save itself the charge of every crash.
#[test]
fn what_an_agent_writes_of_its_gpu_once_it_has_begun_is_not_read() {
    let (pod, root) = pod_with(&["nvidia0"]);
    let mut simulator = simulator_that_asks(&pod);
    let forged = StatusFile::Gpu(AGENT, false).path(&pod.status());
    let script = format!("touch {}; exit 3", forged.display());
    let mut agent = pod.agent_running(&["sh", "-c", &script], &[&root, REPORTS]);
    assert_eq!((simulator.code(), agent.code()), (1, 1));
    assert!(forged.exists());
    assert_eq!(simulator.verdict().what, What::PeerCrashed);
    // Nor after a restart of both.
    let mut simulator = simulator_that_asks(&pod);
    pod.until(SIMULATOR, Mark::Start(1));
    let mut agent = pod.agent_running(&["sh", "-c", "exit 3"], &[&root, REPORTS]);
    assert_eq!((simulator.code(), agent.code()), (1, 1));
    assert_eq!(simulator.verdict().what, What::PeerCrashed);
}
