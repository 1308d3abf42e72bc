//! Worlds to decide in: a submission, what is seen of it, and a clock that only the test moves.

use std::sync::Arc;

use jiff::{SignedDuration, Timestamp};
use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;
use serde_json::json;

use super::{foreign, rules};
use crate::report_digest::ReportDigest;
use crate::submissions::blame::ends::is_crash;
use crate::submissions::{Action, EvalaiUpdate, Plan, decide, job_name};
use crate::view::{
    ContainerView, EndView, EvalaiEnd, EvalaiInfo, EvalaiView, JobEnd, JobView, NodeView, ObservedFence, ObservedJob,
    ObservedLog, ObservedReport, PodView, RecordView, ReportView, Requested, Stage, Standing, Turn, View,
};
use leaderboard_api::conditions;
use leaderboard_api::evalai_status::Status;
use leaderboard_api::{
    Attempt, Leaderboard, LeaderboardSpec, Metric, Reason, ReasonName, State, Submission, SubmissionStatus,
    WorkerState, names,
};
use leaderboard_contract::report::{Outcome, Report, ReportWorker};
use leaderboard_contract::run::Stop;
use leaderboard_contract::verdict::WorkspaceReason;
use leaderboard_protocol::verdict::{Verdict, What};

/// UID of every submission here.
pub const UID: &str = "uid-1";
/// When the clock begins.
const BEGIN: i64 = 1_767_225_600;

/// The moment this many seconds after the beginning.
pub fn at(second: i64) -> Timestamp {
    Timestamp::from_second(BEGIN + second).unwrap()
}

/// A Leaderboard with the defaults, two routes on two pairs; EvalAI's if `evalai`.
pub fn leaderboard(evalai: bool) -> Leaderboard {
    let mut spec = json!({
        "tracks": [{"name": "sensors"}],
        "evaluation": {"carla": {
            "version": "V2", "contents": {"image": "contents:1"}, "simulator": {"image": "simulator:1"},
            "pairs": 2, "routes": 4,
        }},
        // Any image; the tests of images set it otherwise.
        "agent": {"images": []},
        "storage": {"s3": {"bucket": "results"}}, "deadlines": {"runSeconds": 86400},
        "table": {"dynamoDB": {"name": "submissions"}},
    });
    if evalai {
        spec["tracks"][0]["phase"] = json!(7);
        spec["evalai"] = json!({
            "apiServer": "https://evalai.example", "challenge": 3,
            "token": {"secretKeyRef": {"name": "evalai", "key": "token"}},
        });
    }
    Leaderboard::new("carla", serde_json::from_value(spec).unwrap())
}

fn submission(evalai: bool) -> Submission {
    let spec = if evalai {
        json!({"leaderboardName": "carla", "image": "team/agent:1",
               "evalai": {"challenge": 3, "phase": 7, "submission": 77}})
    } else {
        json!({"leaderboardName": "carla", "image": "team/agent:1", "track": "sensors", "team": {"id": "t1"}})
    };
    let mut submission = Submission::new("sub", serde_json::from_value(spec).unwrap());
    submission.metadata.uid = Some(UID.into());
    submission.metadata.generation = Some(1);
    submission.metadata.creation_timestamp = Some(Time(at(0)));
    submission.metadata.finalizers = Some(vec![names::FINALIZER_SUBMISSION.into()]);
    submission
}

/// EvalAI's row of a submission that wants to run.
pub fn info() -> EvalaiInfo {
    EvalaiInfo {
        standing: Standing::Wanted,
        status: Status::Submitted,
        phase: Some(7),
        team_id: "42".into(),
        team_name: Some("Team".into()),
        submitted_at: Some(at(-60)),
        resumed_at: None,
        last_attempt: None,
        image: Some("ecr/agent:9".into()),
        image_problem: None,
    }
}

/// A world, and what the last reconcile in it wanted.
#[derive(Clone, Debug)]
pub struct World {
    pub view: View,
}

impl World {
    fn new(evalai: bool) -> Self {
        let known = EvalaiView {
            info: Some(info()),
            // Long enough that silence is shown.
            waited: std::time::Duration::from_secs(5),
            ..EvalaiView::default()
        };
        Self {
            view: View {
                now: at(0),
                submission: Arc::new(submission(evalai)),
                leaderboard: Some(Arc::new(leaderboard(evalai))),
                is_policy_in_place: true,
                // No other program runs it; the tests of foreign runs set it otherwise.
                row: foreign::free(1),
                turn: Turn::Go,
                node: NodeView::default(),
                // Whatever is asked for is there already; the tests of waiting set it otherwise.
                report: ReportView {
                    stage: Some(Stage::JobEnded),
                    ..ReportView::default()
                },
                requested: Requested {
                    fence: ObservedFence::Held,
                    log: ObservedLog::Kept,
                },
                evalai: evalai.then_some(known),
                record: Some(RecordView::default()),
                ..View::default()
            },
        }
    }

    /// A submission that only this cluster knows.
    pub fn local() -> Self {
        Self::new(false)
    }

    /// A submission of EvalAI's that wants to run.
    pub fn evalai() -> Self {
        Self::new(true)
    }

    /// The Job was requested and is there, without a Pod.
    pub fn with_job(self) -> Self {
        let mut world = self;
        world.pass();
        world.see_job();
        world
    }

    /// The Pod is on a node; nothing runs yet.
    pub fn with_pod(self) -> Self {
        let mut world = self.with_job();
        world.view.pod = Some(pod(0));
        world
    }

    /// Its agents run since second 10.
    pub fn running(self) -> Self {
        let mut world = self.with_pod();
        world.see_agents();
        world.go_to(10);
        world.pass();
        world
    }

    pub fn see_job(&mut self) {
        self.view.job = ObservedJob::Ours(JobView {
            name: job_name("sub", &self.status()),
            uid: "job-uid".into(),
            created: Some(self.view.now),
            started: None,
            suspension: None,
            end: None,
            deleting: false,
            failed_create: None,
        });
    }

    pub fn job(&mut self) -> &mut JobView {
        match &mut self.view.job {
            ObservedJob::Ours(job) => job,
            other => panic!("no Job of ours: {other:?}"),
        }
    }

    pub fn pod(&mut self) -> &mut PodView {
        self.view.pod.as_mut().unwrap()
    }

    /// All agents and simulators of the Pod run.
    pub fn see_agents(&mut self) {
        let pod = self.view.pod.as_mut().unwrap();
        pod.agent_started = Some(at(10));
        pod.logcopy_running = true;
        pod.containers = ["logcopy", "simulator-1", "simulator-2", "agent-1", "agent-2"]
            .map(running)
            .to_vec();
    }

    /// Puts one container in place of what the Pod has by its name. A simulator that runs follows its agent's crash, as its
    /// runner does.
    pub fn see(&mut self, container: ContainerView) {
        let simulator = container.name.replace("agent-", "simulator-");
        let follows = |c: &&ContainerView| c.name == simulator && c.name != container.name && c.running;
        let runs = self.pod().containers.iter().any(|c| follows(&c));
        let crash = container
            .last
            .as_ref()
            .filter(|end| !container.running && is_crash(end));
        if let Some(end) = crash.filter(|_| runs) {
            let at = end.at.map_or(0, |at| at.as_second() - BEGIN);
            self.see_alone(ended(&simulator, container.restarts, "peerCrashed", 1, at));
        }
        self.see_alone(container);
    }

    /// Puts the container in its place, without the reaction of its simulator.
    pub fn see_alone(&mut self, container: ContainerView) {
        let containers = &mut self.pod().containers;
        containers.retain(|c| c.name != container.name);
        containers.push(container);
    }

    /// The Job ended well and took its Pod along.
    pub fn complete(&mut self) {
        let now = self.view.now;
        self.job().end = Some(JobEnd::Complete { at: Some(now) });
        self.view.report.stored = ObservedReport::Absent;
    }

    /// Its report shows this.
    #[allow(clippy::needless_pass_by_value, reason = "the tests read better")]
    pub fn report(&mut self, report: Report) {
        self.view.report.stored = ObservedReport::Ours(Arc::new(ReportDigest::from(&report)));
    }

    pub fn status(&self) -> SubmissionStatus {
        self.view.submission.status.clone().unwrap_or_default()
    }

    pub fn submission(&mut self) -> &mut Submission {
        Arc::make_mut(&mut self.view.submission)
    }

    pub fn leaderboard(&mut self) -> &mut LeaderboardSpec {
        &mut Arc::make_mut(self.view.leaderboard.as_mut().unwrap()).spec
    }

    pub fn in_evalai(&mut self) -> &mut EvalaiView {
        self.view.evalai.get_or_insert_default()
    }

    pub fn published(&mut self) {
        self.in_evalai().end = Some(EvalaiEnd::Published { at: self.view.now });
    }

    pub fn recorded(&mut self) {
        self.view.record.get_or_insert_default().end_written = true;
    }

    /// The stored status does not say that a system has the end, and the system has no answer.
    pub fn forget(&mut self, system: &str) {
        conditions::remove(&mut self.submission().status.as_mut().unwrap().conditions, system);
        self.in_evalai().end = None;
        self.view.record = Some(RecordView::default());
    }

    pub fn delete(&mut self) {
        let now = self.view.now;
        self.submission().metadata.deletion_timestamp = Some(Time(now));
    }

    pub fn go_to(&mut self, second: i64) {
        self.view.now = at(second);
    }

    pub fn wait(&mut self, seconds: i64) {
        self.view.now = self.view.now.checked_add(SignedDuration::from_secs(seconds)).unwrap();
    }

    /// Nothing of its Job is left.
    pub fn job_gone(&mut self) {
        self.view.job = ObservedJob::Absent { refused: None };
        self.view.pod = None;
        if self.view.report.stored == ObservedReport::NotRead {
            self.view.report.stored = ObservedReport::Absent;
        }
    }

    /// The Job fails because of the infrastructure and is gone, and the next one is there.
    #[track_caller]
    pub fn gets_another_job(&mut self) {
        self.complete();
        self.pass_to(State::Pending, Reason::Replacing);
        self.job_gone();
        self.wait(10);
        self.pass_to(State::Pending, Reason::Preparing);
        self.see_job();
    }

    /// One reconcile: decides, checks the rules, and keeps the status.
    pub fn pass(&mut self) -> Plan {
        let plan = decide(&self.view);
        rules::check(&self.view, &plan);
        self.submission().status = Some(plan.status.clone());
        plan
    }

    /// One reconcile that has to show this state with this reason.
    #[track_caller]
    pub fn pass_to(&mut self, state: State, reason: Reason) -> Plan {
        let plan = self.pass();
        let shown = (plan.status.state, plan.status.present_reason());
        assert_eq!(shown, (Some(state), Some(reason.into())), "{:?}", plan.status.message);
        plan
    }
}

/// A Pod on a node, whose containers are not known yet.
pub fn pod(second: i64) -> PodView {
    PodView {
        name: "sub-1-x".into(),
        uid: "pod-uid".into(),
        node: Some("node-a".into()),
        scheduled: Some(at(second)),
        ..PodView::default()
    }
}

pub fn running(name: &str) -> ContainerView {
    ContainerView {
        name: name.into(),
        running: true,
        ..ContainerView::default()
    }
}

pub fn waiting(name: &str, reason: &str, message: &str) -> ContainerView {
    ContainerView {
        name: name.into(),
        waiting: Some((reason.into(), message.into())),
        ..ContainerView::default()
    }
}

/// A container that has ended after `restarts`, at this second, with this verdict of its runner, or, before the agents, with
/// this reason of its own. Each life of it had one round.
pub fn ended(name: &str, restarts: i32, what: &str, exit_code: i32, second: i64) -> ContainerView {
    let verdict = verdict(what, u32::try_from(restarts).unwrap());
    let own_reason: Option<WorkspaceReason> = serde_json::from_value(json!(what)).ok();
    ContainerView {
        name: name.into(),
        restarts,
        last: Some(EndView {
            reason: if exit_code == 0 { "Completed" } else { "Error" }.into(),
            exit_code,
            began: Some(at(second - 50)),
            at: Some(at(second)),
            own_reason,
            verdict,
            why: own_reason.map(|_| "It has found it so.".into()),
        }),
        ..ContainerView::default()
    }
}

/// A container that runs again after so many restarts; its last life ended like this.
pub fn restarted(name: &str, restarts: i32, what: &str, exit_code: i32, second: i64) -> ContainerView {
    ContainerView {
        restarts,
        running: true,
        ..ended(name, restarts - 1, what, exit_code, second)
    }
}

/// A verdict by its name; `incomplete` is a command that ended well by itself.
fn verdict(what: &str, round: u32) -> Option<Verdict> {
    if what == "incomplete" {
        return Some(Verdict {
            exit_code: Some(0),
            ..Verdict::new(What::Exited, round, "")
        });
    }
    let what = serde_json::from_value(json!(what)).ok()?;
    Some(Verdict::new(what, round, ""))
}

/// A report of the present Pod with this many of the four routes done.
pub fn report(done: u32) -> Report {
    let worker = |id: u32| ReportWorker {
        id,
        done: done.saturating_sub(2 * (id - 1)).min(2),
        total: 2,
        crashes: 0,
        state: WorkerState::Running,
        names_crash: false,
    };
    Report {
        schema: 1,
        submission_uid: UID.into(),
        attempt: Attempt(1),
        pod_uid: "pod-uid".into(),
        round: 1,
        done,
        total: 4,
        unit: "routes".into(),
        workers: vec![worker(1), worker(2)],
        merger: None,
        score: (done > 0).then(|| Metric::new("Driving score", 41.2, 2)),
        metrics: if done > 0 {
            vec![Metric::new("Route completion", 90.0, 2)]
        } else {
            Vec::new()
        },
        is_final: false,
        eligible: false,
        outcome: Outcome::Running,
        stopped: None,
        refused: None,
        unusable: None,
        warnings: Vec::new(),
        logs: None,
        results: "[]".into(),
        partial_results: None,
        agents_fill_disk: false,
        files: std::collections::BTreeMap::new(),
    }
}

/// The report of a run that is complete and counts.
pub fn final_report() -> Report {
    Report {
        is_final: true,
        eligible: true,
        outcome: Outcome::Finished,
        score: Some(Metric::new("Driving score", 43.129, 2)),
        ..report(4)
    }
}

pub fn evalai_updates(plan: &Plan) -> Vec<EvalaiUpdate> {
    let update_of = |action: &Action| match action {
        Action::UpdateEvalai(update) => Some(*update),
        _ => None,
    };
    plan.actions.iter().filter_map(update_of).collect()
}

pub fn has(plan: &Plan, matches: impl Fn(&Action) -> bool) -> bool {
    plan.actions.iter().any(matches)
}

pub fn creates(plan: &Plan) -> bool {
    plan.creates_job()
}

/// Status and reason of a condition.
pub fn condition(plan: &Plan, type_: &str) -> (String, ReasonName) {
    let found = conditions::get(&plan.status.conditions, type_);
    found.map_or_else(Default::default, |c| (c.status.to_string(), c.reason.clone()))
}

pub fn events(plan: &Plan) -> Vec<ReasonName> {
    plan.events.iter().map(|e| e.reason.clone()).collect()
}

/// The stop that the Pod is asked for.
pub fn annotated(plan: &Plan) -> Option<Stop> {
    plan.actions.iter().find_map(|a| match a {
        Action::StopPod { stop, .. } => Some(*stop),
        _ => None,
    })
}
