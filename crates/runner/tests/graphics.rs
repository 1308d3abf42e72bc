//! A simulator that is to have a GPU, as a real process: what stops it, and what its server gets.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on fails")]

mod support;

use std::fs;
use std::os::unix::fs::symlink;

use leaderboard_runner::protocol::{Mark, StatusFile};
use leaderboard_runner::verdict::What;
use support::{Pod, SIMULATOR};

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
