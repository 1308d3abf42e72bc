//! `services::evalai` against the stand-in of EvalAI's server, over loopback.
//!
//! The stand-in holds the facts: the texts of its errors, writes that are read early and saved late, faults on purpose.

mod access;
mod cancels;
mod ends;
mod faults;
mod inputs;
mod load;
mod sweep;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use evalai_stand_in::faults::{Failure, Fault, When};
use evalai_stand_in::log::Entry;
use evalai_stand_in::model::{FileState, Status as Stored};
use evalai_stand_in::submissions::{NewSubmission, create};
use evalai_stand_in::{Config, Handle, Knobs};
use jiff::{SignedDuration, Timestamp};
use serde_json::{Map, json};
use tokio::net::TcpListener;
use tokio::sync::mpsc;
use tokio::time::Instant;

use leaderboard_api::Attempt;
use leaderboard_base::clock::Clock;
use leaderboard_base::meter::Meter;
use leaderboard_base::shutdown::Stop;
use leaderboard_base::spans::LogSpan;
use leaderboard_base::tasks::Tasks;
use leaderboard_contract::report::ContentId;
use leaderboard_evalai::token::Token;
use leaderboard_evalai::{
    Changed, DesiredUpdate, Ended, Hub, ImageAnswer, Key, Metrics, Misfit, Network, Options, Outcome, Outline,
    Patience, Payload, Progress, Publisher, Run, Status, StoredResult, Subject, SubmissionState, SweepRow, Target,
    Timeouts, Timing,
};

/// A stand-in, a hub that speaks to it, and what the controller would hold.
struct World {
    server: Handle,
    hub: Hub,
    target: Target,
    changed: mpsc::UnboundedReceiver<Changed>,
    sweep: mpsc::UnboundedReceiver<SweepRow>,
    leads: Arc<AtomicBool>,
}

fn timing() -> Timing {
    Timing {
        hold: Duration::from_millis(1500),
        lost: Duration::ZERO,
        missing: Duration::from_millis(100),
        ..Timing::default()
    }
}

fn timeouts() -> Timeouts {
    Timeouts {
        connect: Duration::from_secs(5),
        read: Duration::from_secs(2),
        write: Duration::from_secs(10),
    }
}

fn target(api_server: &str, token: &str) -> Target {
    let seed = evalai_stand_in::Seed::built_in().unwrap();
    Target {
        leaderboard: leaderboard(),
        api_server: api_server.to_owned(),
        challenge: 1,
        split: "leaderboard".into(),
        token: Arc::new(Token::parse(token).unwrap()),
        requests_per_minute: 6000,
        sweep: Duration::from_millis(200),
        period: Duration::from_millis(200),
        phases: [1, 2].into(),
        metrics: Metrics::Fixed(seed.challenges[0].phases[0].splits[0].schema.labels.clone().into()),
        inbox: None,
        is_observed: false,
        takes_files: false,
        since: Timestamp::now() - SignedDuration::from_hours(1),
    }
}

impl World {
    async fn new() -> Self {
        Self::with(timing(), timeouts()).await
    }

    async fn with(timing: Timing, timeouts: Timeouts) -> Self {
        Self::made(timing, timeouts, Instant::now()).await
    }

    async fn opened_at(not_before: Instant) -> Self {
        Self::made(timing(), timeouts(), not_before).await
    }

    async fn made(timing: Timing, timeouts: Timeouts, not_before: Instant) -> Self {
        let (config, _) = Config::in_memory().unwrap();
        let config = Config { throttle: 0, ..config };
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let server = evalai_stand_in::serve(config, vec![listener]);
        let (wake, changed) = mpsc::unbounded_channel();
        let (found, sweep) = mpsc::unbounded_channel();
        let leads = Arc::new(AtomicBool::new(true));
        let guard = leads.clone();
        let hub = Hub::new(Options {
            connect: Arc::new(Network::connect),
            clock: Clock::system(),
            write_guard: Arc::new(move || guard.load(Ordering::SeqCst)),
            payloads: Arc::new(|outline| Box::pin(async move { Ok(stored(&outline)) })),
            not_before,
            changed: wake,
            sweep: found,
            timing,
            timeouts,
            meter: Meter::default(),
            tasks: Tasks::new(Stop::new().1),
        });
        let target = target(&server.url(), "local-host-token");
        Self {
            server,
            hub,
            target,
            changed,
            sweep,
            leads,
        }
    }

    fn submit(&self) -> i64 {
        self.submit_with(FileState::Stored, Timestamp::now())
    }

    fn submit_with(&self, file: FileState, at: Timestamp) -> i64 {
        let input = json!({"submitted_image_uri": "registry.example/team-a:1"}).to_string();
        self.submit_file(input.into_bytes(), file, at)
    }

    fn submit_file(&self, input: Vec<u8>, file: FileState, at: Timestamp) -> i64 {
        let new = NewSubmission {
            team: 1,
            phase: 1,
            user: 11,
            input,
            fields: Map::new(),
        };
        let pk = self.server.with_state(|state| create(state, new, file, at));
        i64::try_from(pk).unwrap()
    }

    fn set(&self, pk: i64, status: Stored) {
        let pk = u64::try_from(pk).unwrap();
        self.server
            .with_state(|state| state.submissions.get_mut(&pk).unwrap().status = status);
    }

    fn delete(&self, pk: i64) {
        let pk = u64::try_from(pk).unwrap();
        self.server
            .with_state(|state| state.submissions.get_mut(&pk).unwrap().ignore_submission = true);
    }

    fn stored(&self, pk: i64) -> Stored {
        self.server.state().submissions[&u64::try_from(pk).unwrap()].status
    }

    fn rows(&self, pk: i64) -> usize {
        let pk = u64::try_from(pk).unwrap();
        self.server
            .state()
            .rows
            .values()
            .filter(|row| row.submission == pk)
            .count()
    }

    fn subject(&self, pk: i64) -> Subject {
        Subject {
            target: Arc::new(self.target.clone()),
            key: key(pk),
            pk,
            run: run(pk, 1),
        }
    }

    fn ask(&self, pk: i64, image: bool) {
        self.hub.ask(&self.subject(pk), image).unwrap();
    }

    fn live(&self, pk: i64) {
        let at = self.server.state().submissions[&u64::try_from(pk).unwrap()].submitted_at;
        self.hub.live(&self.subject(pk), at).unwrap();
    }

    fn update(&self, pk: i64, update: DesiredUpdate) {
        let publisher = Publisher::of(self.subject(pk)).unwrap();
        self.hub.update(&publisher, update).unwrap();
    }

    fn fail(&self, method: &str, part: &str, answer: Failure, when: When) {
        let fault = Fault {
            method: Some(method.into()),
            path_prefix: Some(part.into()),
            answer,
            times: 1,
            when,
        };
        self.server.set_knobs(Knobs {
            fail_next: vec![fault],
            ..Knobs::default()
        });
    }

    /// Waits until the view of a submission is as wanted.
    async fn until(&mut self, pk: i64, wanted: impl Fn(&SubmissionState) -> bool) -> SubmissionState {
        loop {
            if let Some(view) = self.hub.view(&key(pk)).filter(|view| wanted(view)) {
                return view;
            }
            let news = tokio::time::timeout(Duration::from_mins(1), self.changed.recv()).await;
            assert!(news.is_ok(), "nothing changes: {:?}", self.hub.view(&key(pk)));
        }
    }

    async fn ended(&mut self, pk: i64) -> Ended {
        self.until(pk, |view| view.end.is_some()).await.end.unwrap()
    }

    /// Requests the end of a finished one.
    fn finish(&self, pk: i64) {
        let results = results(&self.target, 43.0);
        self.update(pk, DesiredUpdate::Final(Outcome::Finished, results));
    }

    /// Waits until the server has a PUT, answered or not.
    async fn until_put(&self) {
        let server = &self.server;
        server
            .wait_until(|_, log| log.entries().any(|entry| entry.method == "PUT"))
            .await;
    }

    fn sent(&self, method: &str) -> Vec<Entry> {
        self.server
            .requests()
            .into_iter()
            .filter(|entry| entry.method == method)
            .collect()
    }

    /// Waits until EvalAI refuses the Leaderboard's token, and hands back why.
    async fn token_refused(&mut self) -> String {
        loop {
            if let Some(why) = self.hub.token_refused(&leaderboard()) {
                return why;
            }
            self.changed.recv().await.unwrap();
        }
    }
}

fn key(pk: i64) -> Key {
    Key {
        namespace: "carla".into(),
        name: format!("submission-{pk}"),
        uid: pk.to_string(),
    }
}

fn leaderboard() -> Key {
    Key {
        namespace: "carla".into(),
        name: "carla-2".into(),
        uid: "leaderboard".into(),
    }
}

fn run(pk: i64, attempt: i64) -> Run {
    Run {
        attempt: Attempt(attempt),
        job: format!("submission-{pk}-{attempt}"),
        by_hand: true,
        has_job: false,
        ended: None,
        log: LogSpan::default(),
    }
}

/// Results whose bucket holds this score for each label.
fn results(target: &Target, score: f64) -> Arc<Outline> {
    let Metrics::Fixed(labels) = &target.metrics else {
        panic!("the target of these tests names its labels")
    };
    let accuracies: BTreeMap<_, _> = labels.iter().map(|label| (label.clone(), score)).collect();
    let result = json!([{"split": "leaderboard", "show_to_participant": true, "accuracies": accuracies}]);
    Arc::new(Outline {
        phase: 1,
        stderr: String::new(),
        environment_log: "for hosts".into(),
        stored: Some(StoredResult {
            storage: serde_json::from_value(json!({"bucket": "b"})).unwrap(),
            prefix: result.to_string(),
            report: ContentId::default(),
            done: score.trunc().to_string().parse().unwrap(),
            so_far: false,
            patience: Patience::ENDLESS,
        }),
    })
}

/// The payload that this bucket gives out.
fn stored(outline: &Outline) -> Payload {
    let bare = Payload::bare(outline);
    Payload {
        result: outline
            .stored
            .as_ref()
            .map_or_else(|| bare.result.clone(), |stored| stored.prefix.clone()),
        stdout: "12/20 routes".into(),
        metadata: "{}".into(),
        ..bare
    }
}

#[tokio::test]
async fn a_submission_lives_through_all_of_it() {
    let mut world = World::new().await;
    let pk = world.submit();
    world.ask(pk, true);
    let view = world
        .until(pk, |view| view.answered == Some(Attempt(1)) && view.image.is_some())
        .await;
    let row = view.row.unwrap();
    assert_eq!(
        (row.status, row.team_id, row.team_name.as_deref()),
        (Status::Submitted, Some(1), Some("team-a"))
    );
    assert_eq!(
        (view.image, view.ended),
        (Some(ImageAnswer::Named("registry.example/team-a:1".into())), None)
    );
    world.live(pk);
    world.update(pk, DesiredUpdate::Queued);
    world.until(pk, |view| view.progress == Some(Progress::Queued)).await;
    world.update(pk, DesiredUpdate::Running);
    world.until(pk, |view| view.progress == Some(Progress::Running)).await;
    world.update(pk, DesiredUpdate::Partial(results(&world.target, 41.0)));
    world.until(pk, |view| view.partial_done.is_some()).await;
    assert_eq!(world.stored(pk), Stored::PartiallyEvaluated);
    world.finish(pk);
    assert!(matches!(
        world.ended(pk).await,
        Ended::Published {
            outcome: Outcome::Finished,
            ..
        }
    ));
    let state = world.server.state();
    let stored = &state.submissions[&u64::try_from(pk).unwrap()];
    assert_eq!((stored.status, world.rows(pk)), (Stored::Finished, 1));
    assert_eq!(stored.job_name, [format!("submission-{pk}-1")]);
    let text = |file: &Option<String>| String::from_utf8(state.files[file.as_ref().unwrap()].clone()).unwrap();
    assert_eq!(text(&stored.environment_log_file), "for hosts");
    assert_eq!(text(&stored.stdout_file), "12/20 routes");
    let score = state.rows.values().next().unwrap().result["Driving score"].as_f64();
    assert_eq!(score, Some(43.0));
    assert!(world.hub.drain().await);
}

#[tokio::test]
async fn a_submission_that_was_deleted_while_it_ran_is_noticed_and_cancelled() {
    let timing = Timing {
        refresh: Duration::from_millis(100),
        ..timing()
    };
    let mut world = World::with(timing, timeouts()).await;
    let pk = world.submit();
    world.live(pk);
    world.update(pk, DesiredUpdate::Partial(results(&world.target, 41.0)));
    world.until(pk, |view| view.partial_done.is_some()).await;
    world.delete(pk);
    let view = world.until(pk, |view| view.ended.is_some()).await;
    assert_eq!((view.ended, view.overtaken), (Some(Status::Deleted), true));
    assert_eq!(
        world.stored(pk),
        Stored::PartiallyEvaluated,
        "its deletion ended nothing"
    );
    world.update(
        pk,
        DesiredUpdate::Final(Outcome::Cancelled, results(&world.target, 41.0)),
    );
    assert!(matches!(world.ended(pk).await, Ended::Published { .. }));
    assert_eq!(world.stored(pk), Stored::Cancelled);
}

#[tokio::test]
async fn without_the_lease_nothing_is_written() {
    let mut world = World::new().await;
    world.leads.store(false, Ordering::SeqCst);
    let pk = world.submit();
    world.update(pk, DesiredUpdate::Final(Outcome::Failed, results(&world.target, 0.0)));
    world.ask(pk, false);
    world.until(pk, |view| view.answered == Some(Attempt(1))).await;
    assert_eq!(world.stored(pk), Stored::Submitted);
    world.leads.store(true, Ordering::SeqCst);
    assert!(matches!(world.ended(pk).await, Ended::Published { .. }));
    assert_eq!(world.sent("PUT").len(), 1);
}

#[tokio::test]
async fn a_leaderboard_is_compared_with_its_challenge() {
    let mut world = World::new().await;
    world.hub.serve(&leaderboard(), &world.target).unwrap();
    let labels = loop {
        if let Some(labels) = world.hub.labels(&leaderboard()).0 {
            break labels;
        }
        world.changed.recv().await.unwrap();
    };
    assert_eq!(labels.problems, []);
    let wrong = Target {
        phases: [1, 3].into(),
        metrics: Metrics::Fixed(["Driving score".to_owned(), "Bogus".to_owned()].into()),
        ..world.target.clone()
    };
    world.hub.serve(&leaderboard(), &wrong).unwrap();
    let labels = world.hub.labels(&leaderboard()).0.unwrap();
    assert!(
        labels.problems.contains(&Misfit::Phase { challenge: 1, phase: 3 }),
        "{labels:?}"
    );
    assert!(
        matches!(&labels.problems[0], Misfit::Unknown { phase: 1, labels } if *labels == ["Bogus"]),
        "{labels:?}"
    );
}
