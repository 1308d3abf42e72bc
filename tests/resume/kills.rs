//! Runs with kills at random, compared with a run without.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use fastrand::Rng;
use futures::FutureExt;
use futures::future::{self, BoxFuture};
use leaderboard_api::LeaderboardVersion;
use leaderboard_aws::archive::Archive;
use leaderboard_pod::watch::Watch;
use leaderboard_protocol::files::{KEPT_CHECKPOINT, Member, Pair, Side, StatusFile};

use super::kubelet::{Kubelet, Name, SIMULATOR, all_done, members};
use super::process::say;
use super::results::{Results, next_route, of_the_drive, report, results};
use super::submission::{PAIRS, ROUTES_OF_PAIR, Submission};
use crate::ministack::server;

/// Runs of an ordinary test run.
const RUNS: u64 = 40;
const MOST_KILLS: u32 = 3;
/// No run takes so long, however busy the machine is.
const PATIENCE: Duration = Duration::from_mins(3);
const FORMATS: [LeaderboardVersion; 2] = [LeaderboardVersion::V2, LeaderboardVersion::V1];
const ASK_EVERY: Duration = Duration::from_millis(25);

/// The victim of a kill.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Kind {
    /// The agent's command alone.
    Agent,
    /// The agent's container, runner and all.
    AgentContainer,
    /// The simulator's server alone.
    Simulator,
    /// The simulator's container, runner and all.
    SimulatorContainer,
    Logcopy,
    /// The Pod with its volumes, at once.
    PodLost,
    /// The Pod with its volumes, with SIGTERM and time to end.
    PodEvicted,
    /// All containers at once; the volumes and the Pod stay, as after a restart of the node.
    Everything,
}

const KINDS: [Kind; 8] = [
    Kind::Agent,
    Kind::AgentContainer,
    Kind::Simulator,
    Kind::SimulatorContainer,
    Kind::Logcopy,
    Kind::PodLost,
    Kind::PodEvicted,
    Kind::Everything,
];

/// Victims that are left when all agents are done.
const LATE: [Kind; 5] = [
    Kind::SimulatorContainer,
    Kind::Logcopy,
    Kind::PodLost,
    Kind::PodEvicted,
    Kind::Everything,
];

/// When it is killed.
#[derive(Clone, Copy, Debug)]
enum Moment {
    /// So long after the kill before, or the start.
    After(Duration),
    /// So long after the last agent has reported that it is done: mostly before the results are stored.
    AllDone(Duration),
    /// Once S3 knows of so many routes.
    Stored(u32),
}

#[derive(Clone, Copy, Debug)]
struct Kill {
    kind: Kind,
    pair: Pair,
    moment: Moment,
}

impl Kill {
    /// `span`: the time in which it comes.
    fn random(random: &mut Rng, span: Duration) -> Self {
        let moment = match random.u8(..20) {
            0..13 => Moment::After(span.mul_f64(random.f64())),
            13..17 => Moment::AllDone(Duration::from_micros(random.u64(..40_000))),
            _ => Moment::Stored(random.u32(..20)),
        };
        let kinds = match moment {
            Moment::AllDone(_) => &LATE[..],
            _ => &KINDS[..],
        };
        Self {
            kind: kinds[random.usize(..kinds.len())],
            pair: Pair::new(random.u16(1..=PAIRS)).unwrap(),
            moment,
        }
    }

    fn of(&self, side: Side) -> Member {
        Member { side, pair: self.pair }
    }
}

/// Sums over all runs.
#[derive(Default)]
struct Tally {
    kills: BTreeMap<Kind, u32>,
    /// Kills that came when there was nothing to kill any more.
    missed: u32,
    /// Routes that were run again.
    repeated: u32,
    /// Kills between the last agent's `.done` and `logcopy.done`.
    in_between: u32,
    /// Routes on a lost volume that S3 did not have yet.
    unstored: u64,
}

/// One run under way.
struct Run<'a> {
    submission: &'a Submission,
    kubelet: Kubelet<'a>,
    /// How many routes each pair may have run again.
    allowed: [u64; PAIRS as usize],
    tally: &'a mut Tally,
}

impl Run<'_> {
    /// Runs it to its end; what went wrong otherwise.
    async fn finish(&mut self, kills: &[Kill]) -> Result<Results, String> {
        self.kubelet.make_pod();
        let mut kills = kills.iter();
        let mut next = kills.next();
        let mut moment = self.moment(next);
        loop {
            tokio::select! {
                (name, status) = self.kubelet.ended() => if self.kubelet.handle(name, status) {
                    break;
                },
                () = &mut moment => {
                    if let Some(kill) = next {
                        self.kill(kill).await?;
                    }
                    next = kills.next();
                    moment = self.moment(next);
                }
            }
        }
        self.tally.missed += u32::from(next.is_some()) + u32::try_from(kills.len()).unwrap();
        let status = self.kubelet.end_logcopy().await;
        if !status.success() {
            return Err(format!("logcopy ends with {status}"));
        }
        self.judge().await
    }

    /// Comes when the kill is due; never without one.
    fn moment(&self, kill: Option<&Kill>) -> BoxFuture<'static, ()> {
        let (archive, status) = (self.submission.archive.clone(), self.kubelet.places().status());
        match kill.map(|kill| kill.moment) {
            None => future::pending().boxed(),
            Some(Moment::After(time)) => tokio::time::sleep(time).boxed(),
            Some(Moment::AllDone(time)) => until_all_done(status).then(move |()| tokio::time::sleep(time)).boxed(),
            Some(Moment::Stored(routes)) => until_stored(archive, routes).boxed(),
        }
    }

    async fn kill(&mut self, kill: &Kill) -> Result<(), String> {
        let in_between = all_done(&self.kubelet.places().status()) && !self.kubelet.has(StatusFile::Stored);
        let hit = match kill.kind {
            Kind::Agent => self.kubelet.kill_command(kill.of(Side::Agent)),
            Kind::AgentContainer => self.kubelet.kill(Name::Of(kill.of(Side::Agent))).await,
            Kind::Simulator => self.kubelet.kill_command(kill.of(SIMULATOR)),
            Kind::SimulatorContainer => self.kubelet.kill(Name::Of(kill.of(SIMULATOR))).await,
            Kind::Logcopy => self.kubelet.kill(Name::Logcopy).await,
            Kind::PodLost | Kind::PodEvicted => {
                self.lose_pod(kill).await?;
                true
            }
            Kind::Everything => {
                self.kubelet.kill_all().await;
                self.kubelet.restart_pod();
                true
            }
        };
        if !hit {
            self.tally.missed += 1;
            return Ok(());
        }
        *self.tally.kills.entry(kill.kind).or_default() += 1;
        self.tally.in_between += u32::from(in_between);
        match kill.kind {
            Kind::Logcopy => {}
            Kind::PodLost | Kind::PodEvicted | Kind::Everything => self.allowed.iter_mut().for_each(|pair| *pair += 1),
            _ => self.allowed[usize::from(kill.pair.get()) - 1] += 1,
        }
        Ok(())
    }

    /// Ends the Pod and makes another one, which has only the files of S3. Finished routes that were not stored yet are run again, with the
    /// one that was under way. After an orderly end there are none.
    async fn lose_pod(&mut self, kill: &Kill) -> Result<(), String> {
        // Before logcopy runs no program stores the files that a restarted node has found on its volume.
        let orderly = kill.kind == Kind::PodEvicted && self.kubelet.runs(Name::Logcopy);
        if kill.kind == Kind::PodEvicted {
            self.kubelet.evict().await;
        } else {
            self.kubelet.kill_all().await;
        }
        for pair in 1..=PAIRS {
            let checkpoint = format!("agent/agent{pair}/agent_results.json");
            let kept = format!("containers-status/agent-{pair}/{KEPT_CHECKPOINT}");
            let on_disk = [&checkpoint, &kept].map(|path| std::fs::read(self.kubelet.path(path)).unwrap_or_default());
            let reached = on_disk.iter().filter_map(|bytes| next_route(bytes)).max().unwrap_or(0);
            let stored = self.submission.archive.get(&checkpoint, 1 << 26).await.unwrap();
            let stored = match &stored {
                Some(object) => next_route(&object.bytes).ok_or(format!("pair {pair}: S3 holds a torn checkpoint"))?,
                None => 0,
            };
            let lag = reached.saturating_sub(stored);
            if orderly && lag > 0 {
                return Err(format!("pair {pair}: an orderly end left {lag} routes unstored"));
            }
            if let (Moment::Stored(_), Some(report)) = (kill.moment, report(&self.submission.archive).await) {
                let reported = u64::from(report.workers[usize::from(pair) - 1].done);
                // A crash in its last route counts as a record and is repeated.
                if stored + 1 < reported {
                    return Err(format!("pair {pair}: {reported} routes reported, {stored} stored"));
                }
            }
            self.tally.unstored += lag;
            self.allowed[usize::from(pair) - 1] += lag;
        }
        self.kubelet.lose_volumes();
        self.kubelet.make_pod();
        Ok(())
    }

    async fn judge(&mut self) -> Result<Results, String> {
        let report = report(&self.submission.archive).await.ok_or("there is no report")?;
        if !(report.is_final && report.eligible && report.done == 20 && report.total == 20) {
            return Err(format!("it is not finished: {report:?}"));
        }
        if report.stopped.is_some() || report.refused.is_some() || !report.warnings.is_empty() {
            return Err(format!("it has no clean end: {report:?}"));
        }
        for (pair, (begun, allowed)) in self.kubelet.begun().iter().zip(self.allowed).enumerate() {
            let repeated = (begun.len() as u64).saturating_sub(ROUTES_OF_PAIR.into());
            self.tally.repeated += u32::try_from(repeated).unwrap();
            if repeated > allowed {
                let pair = pair + 1;
                return Err(format!(
                    "pair {pair} has run {repeated} routes again, {allowed} at most: {begun:?}"
                ));
            }
        }
        Ok(results(&self.submission.archive).await)
    }
}

async fn until_all_done(status: PathBuf) {
    let watch = Watch::new(|_| true).unwrap();
    loop {
        watch.add(status.parent().unwrap());
        watch.add(&status);
        for member in members() {
            watch.add(&status.join(member.to_string()));
        }
        if all_done(&status) {
            return;
        }
        // A folder may come between the two looks at it.
        let _ = tokio::time::timeout(Duration::from_secs(1), watch.changed()).await;
    }
}

/// S3 reports no changes, so it is asked.
async fn until_stored(archive: Archive, routes: u32) {
    while report(&archive).await.is_none_or(|report| report.done < routes) {
        tokio::time::sleep(ASK_EVERY).await;
    }
}

/// A number from the environment.
fn number(variable: &str) -> Option<u64> {
    std::env::var(variable).ok().map(|text| text.parse().unwrap())
}

/// The results of an undisturbed run, and how long it takes.
async fn undisturbed(bucket: &str, format: LeaderboardVersion, random: &mut Rng) -> (Results, Duration) {
    let began = Instant::now();
    let (results, _) = one(bucket, format, random, &[], &mut Tally::default()).await;
    (
        results.unwrap_or_else(|story| panic!("without a kill: {story}")),
        began.elapsed(),
    )
}

/// One run; its story where it goes wrong.
async fn one(
    bucket: &str,
    format: LeaderboardVersion,
    random: &mut Rng,
    kills: &[Kill],
    tally: &mut Tally,
) -> (Result<Results, String>, Duration) {
    let began = Instant::now();
    let mut submission = Submission::new(bucket, format, random).await;
    submission.route_ms = random.u32(10..30);
    let mut run = Run {
        submission: &submission,
        kubelet: Kubelet::new(&submission),
        allowed: [0; PAIRS as usize],
        tally,
    };
    let finished = tokio::time::timeout(PATIENCE, run.finish(kills)).await;
    let results = finished.unwrap_or_else(|_| Err("it does not end".to_owned()));
    let results = results.map_err(|why| format!("{why}\n{}", run.kubelet.story()));
    (results, began.elapsed())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn whatever_is_killed_whenever_the_score_stays_and_no_route_is_lost() {
    let runs = number("LEADERBOARD_KILL_RUNS").unwrap_or(RUNS);
    let first = number("LEADERBOARD_TEST_SEED").unwrap_or_else(|| fastrand::u64(..1 << 32));
    let bucket = server().await.bucket().await;
    let mut expected = Vec::new();
    for format in FORMATS {
        // The first run of all is slow: the programs are not in memory yet.
        undisturbed(&bucket, format, &mut Rng::with_seed(first)).await;
        expected.push(undisturbed(&bucket, format, &mut Rng::with_seed(first)).await);
    }
    assert_standard(&expected[0].0);
    say(&format!(
        "kills: {runs} runs from LEADERBOARD_TEST_SEED={first}; undisturbed: {:?}",
        expected[0].1
    ));
    let (mut tally, began) = (Tally::default(), Instant::now());
    for seed in first..first + runs {
        let mut random = Rng::with_seed(seed);
        // Every fourth run is one of Leaderboard 1.0.
        let version = usize::from(random.u8(..4) == 0);
        let (undisturbed, usual) = &mut expected[version];
        let number = random.u32(1..=MOST_KILLS);
        let kills: Vec<Kill> = (0..number)
            .map(|_| Kill::random(&mut random, *usual / number))
            .collect();
        let (results, took) = one(&bucket, FORMATS[version], &mut random, &kills, &mut tally).await;
        // A machine that was busy at first would have most kills come too late.
        *usual = took.min(*usual);
        if std::env::var_os("LEADERBOARD_KILL_STORY").is_some() {
            say(&format!("kills: {seed} took {took:?}: {kills:?}"));
        }
        let again =
            format!("LEADERBOARD_TEST_SEED={seed} LEADERBOARD_KILL_RUNS=1 repeats it, as far as time does: {kills:?}");
        let results = results.unwrap_or_else(|story| panic!("{again}\n{story}"));
        for (key, text) in &*undisturbed {
            let (found, expected) = (of_the_drive(key, &results[key]), of_the_drive(key, text));
            assert!(found == expected, "{again}\n{key} is\n{found}\nnot\n{expected}");
        }
    }
    tally.print(runs, began.elapsed());
}

/// The run without a kill has the score that a calculator gives.
fn assert_standard(results: &Results) {
    let expected: serde_json::Value =
        serde_json::from_str(include_str!("../../local/challenge/expected.json")).unwrap();
    let found: serde_json::Value = serde_json::from_str(&results["evalai/results.json"]).unwrap();
    assert_eq!(found[0]["accuracies"], expected["metrics"]);
}

impl Tally {
    fn print(&self, runs: u64, took: Duration) {
        let kills: u32 = self.kills.values().sum();
        say(&format!(
            "kills: {runs} runs in {took:?}, {kills} kills, {} more found nothing to kill",
            self.missed
        ));
        for (kind, count) in &self.kills {
            say(&format!("kills:   {kind:?} {count}"));
        }
        say(&format!(
            "kills:   {} of them between the last agent's .done and logcopy.done; {} routes run again; {} finished routes of \
             lost Pods were not stored yet",
            self.in_between, self.repeated, self.unstored
        ));
    }
}
