//! EvalAI of one test: the stand-in, served by the test's own process. Pods don't speak to it, so it listens on loopback.

use std::sync::Arc;
use std::time::Duration;

use evalai_stand_in::faults::{Failure, Fault, When};
use evalai_stand_in::log::Entry;
use evalai_stand_in::model::{DatasetSplit, LeaderboardRow, Phase, Status, Submission};
use evalai_stand_in::sqs::SqsQueues;
use evalai_stand_in::{Config, Handle, Knobs, Seed};
use serde_json::{Value, json};
use tokio::net::TcpListener;
use tokio::time::timeout;

use super::scene::Scene;

/// The host's token, which the operator has.
pub const HOST_TOKEN: &str = "local-host-token";
/// Another host's, with a throttle of its own.
const PERSON: &str = "local-organizer-token";
/// Alice of team a, whose submissions the tests push.
pub const PARTICIPANT: &str = "local-team-a-token";
/// Id of the first phase that [`Evalai::start_wide`] adds.
pub const FIRST_PHASE: u64 = 101;
/// Between the parts of an upload; no uploaded file has it.
const BOUNDARY: &str = "part-of-an-upload";
/// A connection without a request for so long is idle.
const IDLE_MS: u64 = 100;
/// Requests a minute that EvalAI lets a token make.
pub const REQUESTS_PER_MINUTE: usize = 60;

/// A running stand-in.
pub struct Evalai {
    pub handle: Handle,
    /// Where it is reached.
    pub url: String,
    http: reqwest::Client,
}

impl Evalai {
    /// Starts one whose messages go to the scene's queue.
    pub async fn start(scene: &Scene) -> Self {
        Self::serve(scene, Seed::built_in().unwrap(), REQUESTS_PER_MINUTE).await
    }

    /// Starts one with so many phases more in challenge 1, from [`FIRST_PHASE`] on, that serves everybody at once.
    pub async fn start_wide(scene: &Scene, phases: u64) -> Self {
        Self::serve(scene, Self::wide_seed(phases), 0).await
    }

    fn wide_seed(phases: u64) -> Seed {
        let mut seed = Seed::built_in().unwrap();
        let model = seed.challenges[0].phases[0].clone();
        for id in FIRST_PHASE..FIRST_PHASE + phases {
            let mut phase = model.clone();
            phase.id = id;
            phase.name = format!("Phase {id}");
            phase.codename.clone_from(&phase.name);
            phase.splits[0].id = id;
            phase.splits[0].leaderboard = id;
            seed.challenges[0].phases.push(phase);
        }
        seed
    }

    /// Starts one as [`Evalai::start_wide`] does, with one phase more, whose submissions have keys from `first` on.
    pub async fn start_from(scene: &Scene, first: u64) -> Self {
        let mut seed = Self::wide_seed(1);
        seed.first_submission = first;
        Self::serve(scene, seed, 0).await
    }

    /// Starts one whose challenge 1 has the four phases of the original: 1 and 2 of Leaderboard 2.0, 3 and 4 of 1.0. It serves
    /// everybody at once.
    pub async fn start_as_the_original(scene: &Scene) -> Self {
        let mut seed = Seed::built_in().unwrap();
        let phases = std::mem::take(&mut seed.challenges[1].phases);
        seed.challenges[0].phases.extend(phases);
        Self::serve(scene, seed, 0).await
    }

    /// Starts one with the phase [`FIRST_PHASE`], which shows partial results and has one split with these labels, of which the first
    /// ranks, lowest first.
    pub async fn start_for(scene: &Scene, split: &str, labels: &[&str]) -> Self {
        let mut seed = Self::wide_seed(1);
        let phase = seed.challenges[0].phases.last_mut().unwrap();
        show(phase, split, labels);
        phase.splits[0].is_leaderboard_order_descending = false;
        Self::serve(scene, seed, REQUESTS_PER_MINUTE).await
    }

    /// Starts one whose challenge 1 evaluates files: those that images leave, or uploaded ones. Its phase [`FIRST_PHASE`] has one split
    /// `test` with the label `accuracy`. It serves everybody at once.
    pub async fn start_for_files(scene: &Scene, of_images: bool) -> Self {
        let mut seed = Self::wide_seed(1);
        let challenge = &mut seed.challenges[0];
        challenge.is_docker_based = of_images;
        challenge.is_static_dataset_code_upload = of_images;
        show(challenge.phases.last_mut().unwrap(), "test", &["accuracy"]);
        Self::serve(scene, seed, 0).await
    }

    async fn serve(scene: &Scene, mut seed: Seed, throttle: usize) -> Self {
        seed.set_queue(&scene.cloud.queue);
        let config = Config {
            seed,
            throttle,
            queues: Arc::new(SqsQueues::new(&scene.cloud.endpoint)),
        };
        let listener = TcpListener::bind(("127.0.0.1", 0)).await.unwrap();
        let handle = evalai_stand_in::serve(config, vec![listener]);
        Self {
            url: handle.url(),
            handle,
            http: reqwest::Client::builder().no_proxy().build().unwrap(),
        }
    }

    /// How slowly results are saved.
    pub fn set_put_delay(&self, delay: Duration) {
        self.handle.set_knobs(Knobs {
            put_delay_ms: u64::try_from(delay.as_millis()).unwrap(),
            ..Knobs::default()
        });
    }

    /// From now on EvalAI works on final results until [`Evalai::release_puts`].
    pub fn hold_puts(&self) {
        self.handle.set_knobs(Knobs {
            put_held: true,
            ..Knobs::default()
        });
    }

    /// Lets EvalAI save the final results that it works on.
    pub fn release_puts(&self) {
        self.handle.set_knobs(Knobs::default());
    }

    /// A connection that was idle is closed in the very moment in which it is used again.
    pub fn close_idle_connections(&self) {
        self.handle.set_knobs(Knobs {
            close_reused_ms: Some(IDLE_MS),
            ..Knobs::default()
        });
    }

    /// The next requests to save final results fail so.
    pub fn fail_finals(&self, answer: Failure, times: u32) {
        self.handle.set_knobs(Knobs {
            fail_next: vec![Fault {
                method: Some("PUT".to_owned()),
                path_prefix: Some("/api/jobs/challenge/1/update_submission/".to_owned()),
                answer,
                times,
                when: When::Before,
            }],
            ..Knobs::default()
        });
    }

    async fn call(&self, method: reqwest::Method, path: &str, body: &Value) -> Value {
        self.call_as(PERSON, method, path, body).await
    }

    async fn call_as(&self, token: &str, method: reqwest::Method, path: &str, body: &Value) -> Value {
        let request = self.http.request(method, format!("{}{path}", self.url));
        answer(path, request.bearer_auth(token).json(body)).await
    }

    /// Team a pushes an image to a phase of challenge 1; hands back the submission's key.
    pub async fn submit(&self, image: &str, phase: u64) -> u64 {
        let body = json!({"team": "team-a", "phase": phase, "image": image});
        let answer = self.call(reqwest::Method::POST, "/_stand-in/submit", &body).await;
        answer["submission"].as_u64().unwrap()
    }

    /// Alice uploads a file to a phase of challenge 1, as its web page does; hands back the submission's key.
    pub async fn upload(&self, content: &[u8], phase: u64) -> u64 {
        let path = format!("/api/jobs/challenge/1/challenge_phase/{phase}/submission/");
        let head = format!(
            "--{BOUNDARY}\r\nContent-Disposition: form-data; name=\"input_file\"; filename=\"predictions.csv\"\r\n\r\n"
        );
        let end = format!("\r\n--{BOUNDARY}--\r\n");
        let request = self.http.post(format!("{}{path}", self.url)).bearer_auth(PARTICIPANT);
        let request = request.header("Content-Type", format!("multipart/form-data; boundary={BOUNDARY}"));
        let request = request.body([head.as_bytes(), content, end.as_bytes()].concat());
        answer(&path, request).await["id"].as_u64().unwrap()
    }

    /// Cancels as the web page does: no message is sent.
    pub async fn cancel(&self, pk: u64) {
        self.set_status(pk, Status::Cancelled).await;
    }

    /// Gives it a status by hand, as the web page can.
    pub async fn set_status(&self, pk: u64, status: Status) {
        let path = format!("/api/jobs/challenges/1/submissions/{pk}/update_submission_meta/");
        self.call(reqwest::Method::PATCH, &path, &json!({"status": status.as_str()}))
            .await;
    }

    /// Deletes a submission as its participant does. No message is sent.
    pub async fn delete(&self, pk: u64) {
        let path = format!("/api/jobs/submission/{pk}");
        self.call_as(PARTICIPANT, reqwest::Method::DELETE, &path, &Value::Null)
            .await;
    }

    /// Writes fields of a submission's row as somebody may.
    pub async fn edit_as(&self, token: &str, pk: u64, fields: &Value) {
        let path = format!("/api/jobs/challenges/1/submissions/{pk}/update_submission_meta/");
        self.call_as(token, reqwest::Method::PATCH, &path, fields).await;
    }

    /// Resumes as the web page does.
    pub async fn resume(&self, pk: u64) {
        self.call(
            reqwest::Method::POST,
            &format!("/api/jobs/submissions/{pk}/resume/"),
            &json!({}),
        )
        .await;
    }

    /// Its row.
    pub fn submission(&self, pk: u64) -> Submission {
        self.handle.state().submissions[&pk].clone()
    }

    /// The leaderboard's rows of a submission. Two of them are EvalAI's end of the world.
    pub fn rows(&self, pk: u64) -> Vec<LeaderboardRow> {
        let rows = self.handle.state().rows.into_values();
        rows.filter(|row| row.submission == pk).collect()
    }

    /// The public leaderboard of a phase: its entries, best first.
    pub async fn leaderboard(&self, phase: u64) -> Vec<Value> {
        let path = format!("/api/jobs/challenge_phase_split/{phase}/leaderboard/");
        let board = self.call(reqwest::Method::GET, &path, &Value::Null).await;
        board["results"].as_array().unwrap().clone()
    }

    /// The text of a file that a submission's row names.
    pub fn file(&self, path: Option<&String>) -> String {
        let file = path.and_then(|path| self.handle.state().files.get(path).cloned());
        String::from_utf8(file.unwrap_or_default()).unwrap()
    }

    /// The operator's requests, oldest first.
    pub fn requests(&self) -> Vec<Entry> {
        let all = self.handle.requests().into_iter();
        all.filter(|entry| entry.token.as_deref() == Some(HOST_TOKEN)).collect()
    }

    /// How many PATCHes or PUTs of the operator have this status.
    pub fn updates(&self, method: &str, status: &str) -> usize {
        self.requests()
            .iter()
            .filter(|entry| is_update(entry, method, status))
            .count()
    }

    /// Waits until a submission has this status.
    pub async fn await_status(&self, pk: u64, status: Status, limit: Duration) {
        let reached = self
            .handle
            .wait_until(|state, _| state.submissions[&pk].status == status);
        if timeout(limit, reached).await.is_err() {
            let found = self.submission(pk).status.as_str();
            panic!(
                "EvalAI says {found} of submission {pk} after {} s, not {}",
                limit.as_secs(),
                status.as_str()
            );
        }
    }

    /// Waits until a PUT of finished results is being worked on that is younger than the request `after`; hands back its id.
    pub async fn await_final_put(&self, after: u64, limit: Duration) -> u64 {
        let mut found = 0;
        let seen = self.handle.wait_until(|_, log| {
            let open = |entry: &&Entry| entry.id > after && entry.answered.is_none();
            let put = log
                .entries()
                .filter(open)
                .find(|entry| is_update(entry, "PUT", "FINISHED"));
            found = put.map_or(0, |entry| entry.id);
            found > 0
        });
        let seen = timeout(limit, seen).await;
        seen.unwrap_or_else(|_| panic!("no result is put within {} s", limit.as_secs()));
        found
    }

    /// Waits until EvalAI has done what a request asked for, whether or not its client is still there.
    pub async fn await_answer(&self, id: u64, limit: Duration) {
        let answered = self.handle.wait_until(|_, log| {
            let mut entries = log.entries();
            entries.any(|entry| entry.id == id && entry.answered.is_some())
        });
        let answered = timeout(limit, answered).await;
        answered.unwrap_or_else(|_| panic!("EvalAI still works on request {id} after {} s", limit.as_secs()));
    }
}

/// The phase shows partial results, and has one split with these labels, of which the first ranks.
fn show(phase: &mut Phase, split: &str, labels: &[&str]) {
    phase.is_partial_submission_evaluation_enabled = true;
    let board = &mut phase.splits[0];
    board.dataset_split = DatasetSplit {
        id: FIRST_PHASE,
        name: split.to_owned(),
        codename: split.to_owned(),
    };
    board.schema.labels = labels.iter().map(|&label| label.to_owned()).collect();
    labels[0].clone_into(&mut board.schema.default_order_by);
}

/// The answer to a request that succeeds.
async fn answer(path: &str, request: reqwest::RequestBuilder) -> Value {
    let answer = request.send().await.unwrap();
    let (status, text) = (answer.status(), answer.text().await.unwrap());
    assert!(status.is_success(), "{path}: {status} {text}");
    serde_json::from_str(&text).unwrap()
}

fn is_update(entry: &Entry, method: &str, status: &str) -> bool {
    let said = entry.body.get("submission_status").and_then(Value::as_str);
    entry.method == method && said.is_some_and(|said| said.eq_ignore_ascii_case(status))
}
