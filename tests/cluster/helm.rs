//! The quickstart as docs/quickstart.md has it, with the real Helm. Then every step of a release while a submission runs: no work is lost,
//! and none is done twice.

use std::process::Stdio;
use std::time::{Duration, Instant};

use k8s_openapi::api::batch::v1::Job;
use k8s_openapi::api::core::v1::{Namespace, Service};
use kube::ResourceExt;
use kube::api::{Api, Patch, PatchParams};
use leaderboard_api::Submission;
use serde_json::{Value, json};
use tokio::io::AsyncWriteExt as _;
use tokio::process::Command;

use super::containers::GUESSES;
use super::expected::assert_finished;
use crate::scene::{LABEL, Scene, done, names, say, scenario};

const ROOT: &str = env!("CARGO_MANIFEST_DIR");
const MANIFEST: &str = include_str!("../../examples/quickstart.yaml");
const GAME: &str = include_str!("../../examples/quickstart-game.yaml");
/// Where a release publishes its images.
const PUBLISHED: &str = "ghcr.io/OWNER/";
/// As in the tests of rights: the Lease has this name.
const RELEASE: &str = "operator";
/// A route's time while the release changes: five of them outlive an upgrade, a roll back and an end.
const SLOW: &str = "8000";
/// For a step of Helm, and for the end of a run.
const LIMIT: Duration = Duration::from_mins(4);

#[tokio::test]
async fn the_quickstart_gives_a_score_and_no_step_of_a_release_loses_a_submission() {
    scenario("release", async |scene: &Scene| {
        let quickstart = Quickstart::install(scene).await;
        quickstart.first_score().await;
        quickstart.survives_every_step().await;
        quickstart.remove().await;
    })
    .await;
}

struct Quickstart<'a> {
    scene: &'a Scene,
    http: reqwest::Client,
    /// Address of EvalAI's stand-in.
    evalai: String,
    agent: String,
    begun: Instant,
}

impl<'a> Quickstart<'a> {
    /// Chart and manifest, in the scene's namespace.
    async fn install(scene: &'a Scene) -> Self {
        // Here, as nowhere else in the tests, service accounts work.
        let open = Patch::Merge(json!({"metadata": {"labels": {LABEL: null}}}));
        let namespaces: Api<Namespace> = Api::all(scene.client.clone());
        let params = PatchParams::default();
        namespaces.patch(&scene.namespace, &params, &open).await.unwrap();
        // The manifest brings its own.
        for secret in ["aws", "evalai"] {
            run(&kubectl(scene, &["delete", "secret", secret]), "").await;
        }
        let mut quickstart = Self {
            scene,
            http: reqwest::Client::builder().no_proxy().build().unwrap(),
            evalai: String::new(),
            agent: pinned(&format!("{PUBLISHED}challenge/agent:{}", env!("CARGO_PKG_VERSION"))),
            begun: Instant::now(),
        };
        quickstart.upgrade(&[]).await;
        quickstart.say("the chart is installed");
        let manifest = quickstart.manifest().await;
        run(&kubectl(scene, &["apply", "--filename=-"]), &manifest).await;
        scene.ready("leaderboard-20").await;
        quickstart.say("its Leaderboard is Ready");
        quickstart
    }

    /// The manifest with the lab's images in place of the published ones. The lab's cluster has no DNS, so that the addresses of the two
    /// Services stand in for their names.
    async fn manifest(&mut self) -> String {
        let is_service = |text: &&str| text.contains("\nkind: Service\n");
        let services: Vec<_> = MANIFEST.split("\n---\n").filter(is_service).collect();
        run(
            &kubectl(self.scene, &["apply", "--filename=-"]),
            &services.join("\n---\n"),
        )
        .await;
        let mut manifest = MANIFEST.to_owned();
        for name in ["aws", "evalai"] {
            let service = self.scene.api::<Service>().get(name).await.unwrap();
            let address = service.spec.unwrap().cluster_ip.unwrap();
            manifest = manifest.replace(&format!("http://{name}:"), &format!("http://{address}:"));
            self.evalai = format!("http://{address}:8000");
        }
        of_lab(&manifest)
    }

    /// `helm upgrade --install` of the chart in this tree, with the quickstart's values and more of them.
    async fn upgrade(&self, more: &[&str]) {
        let (chart, values) = (
            format!("{ROOT}/charts/leaderboard-operator"),
            format!("--values={ROOT}/examples/quickstart-values.yaml"),
        );
        let (image, digest) = self.scene.lab.image.split_once('@').unwrap();
        let (repository, tag) = image.rsplit_once(':').unwrap();
        let set = format!(
            "--set=image.repository={repository},image.tag={tag},image.digest={digest},fullnameOverride={RELEASE},\
             namespaces[0]={}",
            self.scene.namespace
        );
        // The definitions are in the cluster already, by another hand.
        let known = ["--take-ownership", "--force-conflicts"];
        let mut arguments = vec!["upgrade", RELEASE, &chart, "--install", &values, &set];
        arguments.extend(known.iter().chain(more));
        self.helm(&arguments).await;
    }

    async fn helm(&self, arguments: &[&str]) -> String {
        let namespace = format!("--namespace={}", self.scene.namespace);
        run(&[&["helm"], arguments, &[&namespace]].concat(), "").await
    }

    fn say(&self, what: &str) {
        say(&format!(
            "release: {what} after {:.0} s",
            self.begun.elapsed().as_secs_f64()
        ));
    }

    /// A participant pushes, as the page says.
    async fn submit(&self) {
        let exec = [
            "exec",
            "deployment/evalai",
            "--",
            "evalai-stand-in",
            "submit",
            &self.agent,
        ];
        run(&kubectl(self.scene, &exec), "").await;
    }

    /// `helm test`, the game, and a submission from EvalAI's message to its score.
    async fn first_score(&self) {
        let tested = self.helm(&["test", RELEASE, "--timeout=120s"]).await;
        assert!(tested.contains("Succeeded"), "{tested}");
        self.say("helm test has passed");
        run(&kubectl(self.scene, &["apply", "--filename=-"]), &of_lab(GAME)).await;
        let game = self.scene.settled("game-1", LIMIT).await;
        let score = game.status.and_then(|status| status.score).map(|score| score.text);
        assert_eq!(score.as_deref(), Some(GUESSES));
        self.say("the first score is there");
        self.submit().await;
        self.scene
            .wait::<Submission>("submission-1", "it is there", LIMIT, |found| found.is_some())
            .await;
        assert_finished(&self.scene.settled("submission-1", LIMIT).await);
        let board = run(
            &kubectl(
                self.scene,
                &["exec", "deployment/evalai", "--", "evalai-stand-in", "leaderboard"],
            ),
            "",
        )
        .await;
        assert!(board.contains("69.41"), "{board}");
        self.say("a score is on EvalAI's leaderboard");
    }

    /// Upgrade, roll back, uninstall and install while one runs.
    async fn survives_every_step(&self) {
        let scene = self.scene;
        let slow = json!({"spec": {"agent": {"env": [{"name": "ROUTE_MS", "value": SLOW}]}}});
        scene
            .api::<leaderboard_api::Leaderboard>()
            .patch("leaderboard-20", &PatchParams::default(), &Patch::Merge(slow))
            .await
            .unwrap();
        self.submit().await;
        let name = "submission-2";
        scene
            .wait::<Submission>(name, "it is there", LIMIT, |found| found.is_some())
            .await;
        let before = scene
            .submission(name, "a route is done", LIMIT, |s: &Submission| done(s) >= 1)
            .await;
        let pod = scene.pod(name).await;

        self.upgrade(&["--set=log.level=debug", "--wait"]).await;
        self.say("upgraded");
        self.helm(&["rollback", RELEASE, "1", "--wait", "--force-conflicts"])
            .await;
        self.say("rolled back");
        self.helm(&["uninstall", RELEASE, "--wait"]).await;
        self.say("uninstalled");
        let job = scene.api::<Job>().get(&format!("{name}-1")).await.unwrap();
        let status = job.status.unwrap();
        assert_eq!(
            status.failed.unwrap_or_default(),
            0,
            "the run goes on without the operator"
        );
        let kept: Submission = scene.api().get(name).await.unwrap();
        assert_eq!(kept.uid(), before.uid(), "the definitions stay, and every submission");
        assert!(kept.metadata.deletion_timestamp.is_none());

        self.upgrade(&["--wait"]).await;
        self.say("installed again");
        let settled = scene.settled(name, LIMIT).await;
        assert_finished(&settled);
        assert_eq!(settled.uid(), before.uid());
        assert_eq!(scene.pod(name).await.uid(), pod.uid(), "another Pod has run it");
        assert_eq!(scene.jobs().await, ["game-1-1", "submission-1-1", "submission-2-1"]);
        assert_eq!(
            names(&scene.all::<Submission>().await),
            ["game-1", "submission-1", "submission-2"]
        );
        self.assert_published_once(2).await;
        self.say("the second submission has ended");
    }

    /// As the page says, but for what the scene itself removes.
    async fn remove(&self) {
        run(
            &kubectl(
                self.scene,
                &["delete", "submissions,leaderboards", "--all", "--timeout=60s"],
            ),
            "",
        )
        .await;
        self.helm(&["uninstall", RELEASE, "--wait"]).await;
    }

    /// EvalAI has one row of a submission, and was sent its final result once.
    async fn assert_published_once(&self, pk: u64) {
        let rows = self.ask("state").await["rows"].clone();
        let rows = rows.as_object().unwrap().values();
        assert_eq!(rows.filter(|row| row["submission"] == pk).count(), 1);
        let puts = self.ask("requests?method=PUT").await;
        let finals = puts.as_array().unwrap().iter().filter(|entry| {
            let status = entry["body"]["submission_status"].as_str().unwrap_or_default();
            entry["body"]["submission"].to_string().trim_matches('"') == pk.to_string()
                && status.eq_ignore_ascii_case("finished")
        });
        assert_eq!(finals.count(), 1, "{puts}");
    }

    async fn ask(&self, what: &str) -> Value {
        let url = format!("{}/_stand-in/{what}", self.evalai);
        self.http.get(url).send().await.unwrap().json().await.unwrap()
    }
}

/// A manifest with the lab's images in place of the published ones.
fn of_lab(manifest: &str) -> String {
    let lines = manifest.lines().map(|line| match line.split_once("image: ") {
        Some((before, image)) => format!("{before}image: {}\n", pinned(image)),
        None => format!("{line}\n"),
    });
    lines.collect()
}

/// A published image as the lab has made it, with its digest.
fn pinned(published: &str) -> String {
    let image = published.strip_prefix(PUBLISHED);
    let image = image.unwrap_or_else(|| panic!("{published} is not below {PUBLISHED}"));
    let made = std::env::var("LEADERBOARD_QUICKSTART_IMAGES").expect("`local/lab test` sets it");
    let found = made.split_whitespace().find(|one| one.contains(&format!("/{image}@")));
    found
        .unwrap_or_else(|| panic!("the lab has made no {image}: {made}"))
        .to_owned()
}

fn kubectl<'a>(scene: &'a Scene, arguments: &[&'a str]) -> Vec<&'a str> {
    [&["kubectl", "--namespace", &scene.namespace], arguments].concat()
}

/// Runs a program; its output, or a panic with what it printed.
async fn run(command: &[&str], given: &str) -> String {
    let mut started = Command::new(command[0]);
    started
        .args(&command[1..])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped());
    let mut child = started
        .spawn()
        .unwrap_or_else(|error| panic!("{}: {error}; run through `make test`", command[0]));
    child.stdin.take().unwrap().write_all(given.as_bytes()).await.unwrap();
    let done = child.wait_with_output().await.unwrap();
    let (output, errors) = (
        String::from_utf8_lossy(&done.stdout),
        String::from_utf8_lossy(&done.stderr),
    );
    assert!(done.status.success(), "{} failed: {errors} {output}", command.join(" "));
    output.into_owned()
}
