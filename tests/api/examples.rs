//! The manifests in `examples/` and the files in `crds/`, as a person applies them.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Output;

use k8s_openapi::apimachinery::pkg::api::resource::Quantity;
use leaderboard_api::{GpuSource, Leaderboard, Submission, effective};

use crate::support::apiserver::{ApiServer, server};

type Quantities = BTreeMap<String, Quantity>;

fn folder(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(name)
}

fn manifests() -> Vec<PathBuf> {
    let mut files: Vec<PathBuf> = std::fs::read_dir(folder("examples"))
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|extension| extension == "yaml"))
        // Helm's, not kubectl's.
        .filter(|path| !path.to_string_lossy().ends_with("-values.yaml"))
        .collect();
    files.sort();
    files
}

fn apply(server: &ApiServer, namespace: &str, file: &Path, output: &str) -> Output {
    let mut command = server.kubectl();
    command.args(["apply", "--server-side", "--validate=strict", "--dry-run=server"]);
    // The examples for EKS are for the namespace that the roles of examples/aws trust.
    let namespace = match std::fs::read_to_string(file) {
        Ok(text) if text.contains("\n  namespace: leaderboard\n") => "leaderboard",
        _ => namespace,
    };
    command.args(["--namespace", namespace, "--output", output, "--filename"]);
    command.arg(file).output().unwrap()
}

#[tokio::test]
async fn every_example_is_accepted_without_a_warning() {
    let server = server().await;
    let namespace = server.namespace("examples").await;
    let made = server
        .kubectl()
        .args(["create", "namespace", "leaderboard"])
        .output()
        .unwrap();
    assert!(made.status.success(), "{made:?}");
    let files = manifests();
    assert!(files.len() >= 4, "{files:?}");
    for file in files {
        let output = apply(server, &namespace, &file, "name");
        let said = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{}: {said}", file.display());
        assert_eq!(said, "", "{}", file.display());
    }
}

#[tokio::test]
async fn the_committed_definitions_change_nothing() {
    let server = server().await;
    for file in ["crds/leaderboards.yaml", "crds/submissions.yaml"] {
        let output = apply(server, "default", &folder(file), "jsonpath={.metadata.generation}");
        let said = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{file}: {said}");
        assert_eq!(
            String::from_utf8_lossy(&output.stdout),
            "1",
            "{file} is not what is installed"
        );
    }
}

/// In a range of a VPC are the API server's private endpoints, and every other service that speaks HTTPS.
#[test]
fn no_example_lets_pods_reach_more_than_single_addresses() {
    let mut found = 0;
    for name in [
        "leaderboard-20.yaml",
        "leaderboard-10.yaml",
        "leaderboard-local.yaml",
        "demo/leaderboard.yaml",
    ] {
        let text = std::fs::read_to_string(folder("examples").join(name)).unwrap();
        let leaderboard: Leaderboard = serde_saphyr::from_str(&text).unwrap();
        for egress in &leaderboard.spec.network.egress {
            found += 1;
            let is_single = egress.cidr.ends_with("/32") || egress.cidr.ends_with("/128");
            assert!(is_single && !egress.ports.is_empty(), "{name}: {}", egress.cidr);
        }
    }
    assert!(found > 0);
}

#[test]
fn examples_run_what_their_comments_describe() {
    let read = |name: &str| std::fs::read_to_string(folder("examples").join(name)).unwrap();
    let leaderboard = |name: &str| -> Leaderboard { serde_saphyr::from_str(&read(name)).unwrap() };
    for (name, pairs, repetitions) in [
        ("leaderboard-20.yaml", 4, 1),
        ("leaderboard-10.yaml", 4, 5),
        ("leaderboard-local.yaml", 4, 1),
    ] {
        let spec = leaderboard(name).spec;
        for track in &spec.tracks {
            let shape = effective::shape(spec.evaluation.carla().unwrap(), track);
            assert_eq!(
                (shape.pairs, shape.routes, shape.repetitions),
                (pairs, 20, repetitions),
                "{name}"
            );
        }
    }
    let submission: Submission = serde_saphyr::from_str(&read("submission-local.yaml")).unwrap();
    let local = leaderboard("leaderboard-local.yaml");
    assert_eq!(Some(&submission.spec.leaderboard_name), local.metadata.name.as_ref());
    assert!(
        local
            .spec
            .tracks
            .iter()
            .any(|track| Some(&track.name) == submission.spec.track.as_ref())
    );
    // Manifests that lie in git would take back what the bridge and people changed since.
    for file in manifests() {
        let text = std::fs::read_to_string(&file).unwrap();
        assert!(
            !text.contains("attempt:") && !text.contains("cancel:"),
            "{}",
            file.display()
        );
    }
}

/// Cores and GiB of a quantity as the examples write it.
fn number(quantities: Option<&Quantities>, name: &str) -> f64 {
    let text = &quantities.unwrap()[name].0;
    text.trim_end_matches("Gi").parse().unwrap()
}

/// Room for Pods on a g5.12xlarge: 47.8 CPUs, some 180 GiB, and 4 GPUs that are shown as 8.
#[test]
fn a_run_of_the_examples_takes_the_gpus_of_one_node_and_fits_it() {
    for name in [
        "leaderboard-20.yaml",
        "leaderboard-10.yaml",
        "leaderboard-restricted.yaml",
    ] {
        let text = std::fs::read_to_string(folder("examples").join(name)).unwrap();
        let spec = serde_saphyr::from_str::<Leaderboard>(&text).unwrap().spec;
        let carla = spec.evaluation.carla().unwrap();
        let sides = [&carla.simulator.resources, &spec.agent.resources].map(|side| side.as_ref().unwrap());
        let sum = |what: &str| -> f64 { sides.iter().map(|side| number(side.requests.as_ref(), what)).sum() };
        let limit: f64 = sides.iter().map(|side| number(side.limits.as_ref(), "memory")).sum();
        let pairs = f64::from(carla.pairs);
        assert!(pairs * sum("cpu") + 1.0 <= 47.8, "{name}");
        assert!(pairs * sum("memory") < 170.0 && pairs * limit < 170.0, "{name}");
        assert!(pairs * sum("ephemeral-storage") < 100.0, "{name}");
        let gpu = spec.gpu.as_ref().unwrap();
        assert_eq!(
            (gpu.source(), 2 * carla.pairs),
            (GpuSource::PerContainer("nvidia.com/gpu"), 8)
        );
        for track in &spec.tracks {
            let mut keys = track
                .tolerations
                .iter()
                .filter_map(|toleration| toleration.key.as_deref());
            assert!(keys.any(|key| key == "nvidia.com/gpu"), "{name}");
        }
    }
}
