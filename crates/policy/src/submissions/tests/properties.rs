//! Any mix of observations, in any order: the rules hold at every step.

use std::sync::Arc;
use std::time::Duration;

use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;
use proptest::prelude::*;
use proptest::sample::select;

use super::builders::*;
use super::container::of_mode;
use super::predictions;
use crate::submissions::job_name;
use crate::view::{
    EvalaiEnd, EvalaiView, JobEnd, JobView, ObservedFence, ObservedJob, ObservedLog, ObservedNode, ObservedReport,
    PodView, Stage, Standing, Suspension, Turn,
};
use leaderboard_api::evalai_status::Status;
use leaderboard_contract::report::{Outcome, RefusedResults, Report};
use leaderboard_contract::run::Stop;

/// One change of the world, after which there is a reconcile.
#[derive(Clone, Debug)]
enum Change {
    Time(i64),
    Job(JobCase),
    Pod(Option<Box<PodView>>),
    Node(ObservedNode, Option<&'static str>),
    Report(ObservedReport),
    Answers {
        stage: Option<Stage>,
        waited: Duration,
        fence: ObservedFence,
        log: ObservedLog,
    },
    Evalai(Box<EvalaiView>),
    Recorded(bool),
    Turn(Turn),
    Leaderboard {
        present: bool,
        infrastructure: i32,
        schedule_seconds: Option<i64>,
    },
    Cancel,
    Resume,
    Delete,
    StatusLost,
}

/// The Job that a reconcile sees in place of the present attempt's.
#[derive(Clone, Debug)]
enum JobCase {
    Absent,
    Created,
    Foreign,
    Present {
        end: Option<JobEnd>,
        deleting: bool,
        refused: bool,
        suspended: bool,
    },
    Earlier,
}

fn job() -> impl Strategy<Value = JobCase> {
    let words = |reason: &str| JobEnd::Failed {
        at: Some(at(50)),
        reason: reason.into(),
        message: "no".into(),
    };
    let ends = vec![
        None,
        None,
        Some(JobEnd::Complete { at: Some(at(50)) }),
        Some(JobEnd::Complete { at: None }),
        Some(words("BackoffLimitExceeded")),
        Some(words("DeadlineExceeded")),
    ];
    let present = (select(ends), any::<bool>(), any::<bool>(), prop::bool::weighted(0.2));
    prop_oneof![
        2 => Just(JobCase::Absent),
        1 => Just(JobCase::Created),
        1 => Just(JobCase::Foreign),
        1 => Just(JobCase::Earlier),
        8 => present.prop_map(|(end, deleting, refused, suspended)| {
            JobCase::Present { end, deleting: deleting && refused, refused, suspended }
        }),
    ]
}

fn container() -> impl Strategy<Value = crate::view::ContainerView> {
    let names = [
        "contents",
        "workspace",
        "logcopy",
        "simulator-1",
        "agent-1",
        "agent-2",
        "collect",
        "evaluator-1",
        "sidecar",
        "agent-x",
    ];
    let words = [
        "",
        "exited",
        "idle",
        "peerCrashed",
        "notReady",
        "cannotStart",
        "stopped",
        "PrefixInUse",
        "InputMissing",
        "InputRefused",
        "finished",
    ];
    let reasons = ["Error", "OOMKilled", "StartError", "Completed"];
    let waits = [
        "",
        "ErrImagePull",
        "CrashLoopBackOff",
        "CreateContainerConfigError",
        "RunContainerError",
        "InvalidImageName",
        "Odd",
    ];
    let shape = (
        select(names.to_vec()),
        0..6,
        select(words.to_vec()),
        select(reasons.to_vec()),
        select(waits.to_vec()),
        0..3,
        -90i64..90,
    );
    (shape, any::<bool>()).prop_map(|((name, restarts, what, reason, wait, code, second), running)| {
        let mut container = ended(name, restarts, what, code, second);
        container.running = running;
        container.waiting = (!running && !wait.is_empty()).then(|| (wait.into(), "it says why".into()));
        container.last.as_mut().unwrap().reason = reason.into();
        if restarts == 0 && running {
            container.last = None;
        }
        container
    })
}

fn pod_view() -> impl Strategy<Value = PodView> {
    let evicted = |words: &str| Some(("Evicted".to_owned(), words.to_owned()));
    let ends = vec![
        None,
        None,
        None,
        evicted("Pod ephemeral local storage usage exceeds 1Gi"),
        evicted("Container agent-1 exceeded its local ephemeral storage limit \"1Gi\". "),
        Some(("UnexpectedAdmissionError".to_owned(), "Allocate failed".to_owned())),
        evicted("memory"),
    ];
    let times = (
        select(vec![None, Some(at(0)), Some(at(40))]),
        select(vec![None, Some(at(10))]),
        any::<bool>(),
    );
    let outcome = (
        select(vec![None, None, Some(at(30)), Some(at(900))]),
        select(ends),
        any::<bool>(),
        select(vec![None, None, Some(at(400))]),
        select(vec![
            None,
            None,
            None,
            Some("EvictionByEvictionAPI"),
            Some("TerminationByKubelet"),
        ]),
    );
    let stop = select(vec![None, Some(Stop::Cancel), Some(Stop::Retries)]);
    let containers = prop::collection::vec(container(), 0..5);
    let uid = select(vec!["pod-uid", "pod-2"]);
    (times, outcome, stop, containers, uid).prop_map(|(times, outcome, stop, containers, uid)| {
        let (scheduled, agent_started, logcopy_running) = times;
        let (delete_by, ended_by_node, unschedulable, run_ended, disruption) = outcome;
        PodView {
            uid: uid.into(),
            scheduled,
            agent_started,
            logcopy_running,
            run_ended,
            delete_by,
            deleted: delete_by.map(|by| by.min(at(300))),
            ended_by_node,
            disruption: disruption.map(str::to_owned),
            unschedulable: (unschedulable && scheduled.is_none()).then(|| "no node".into()),
            stop,
            containers,
            ..pod(0)
        }
    })
}

fn observed_report() -> impl Strategy<Value = ObservedReport> {
    let outcome = select(vec![
        Outcome::Finished,
        Outcome::Rejected,
        Outcome::Crashed,
        Outcome::Invalid,
    ]);
    let flags = (any::<bool>(), any::<bool>(), any::<bool>(), 0u32..6);
    let ours = (0u32..=4, flags, outcome).prop_map(|(done, (is_final, eligible, is_refused, crashes), outcome)| {
        let mut told = Report {
            is_final,
            eligible: eligible && is_final,
            outcome,
            refused: is_refused.then(|| RefusedResults::new(None, "nonsense")),
            ..report(done)
        };
        told.workers[0].crashes = crashes;
        ObservedReport::Ours(Arc::new((&told).into()))
    });
    prop_oneof![
        1 => Just(ObservedReport::NotRead),
        1 => Just(ObservedReport::Absent),
        1 => Just(ObservedReport::Foreign),
        1 => select(vec!["a", "b"]).prop_map(|why| ObservedReport::Unreadable(why.into())),
        5 => ours,
    ]
}

/// The answers of the bucket's worker, and for how long it has been asked.
fn answers() -> impl Strategy<Value = Change> {
    let waited = || select([0, 5, 15, 59, 60].map(Duration::from_secs).to_vec());
    let stage = select(vec![
        None,
        Some(Stage::Live),
        Some(Stage::RunEnded),
        Some(Stage::JobEnded),
    ]);
    let fence = waited().prop_flat_map(|waited| {
        select(vec![
            ObservedFence::NotRequested,
            ObservedFence::Pending(waited),
            ObservedFence::Failed(waited),
            ObservedFence::Held,
        ])
    });
    let log = waited().prop_flat_map(|waited| {
        select(vec![
            ObservedLog::NotRequested,
            ObservedLog::Pending(waited),
            ObservedLog::Kept,
            ObservedLog::None,
            ObservedLog::GivenUp,
        ])
    });
    (stage, waited(), fence, log).prop_map(|(stage, waited, fence, log)| Change::Answers {
        stage,
        waited,
        fence,
        log,
    })
}

fn evalai_view() -> impl Strategy<Value = EvalaiView> {
    let told = |standing| Some(crate::view::EvalaiInfo { standing, ..info() });
    let infos = vec![
        None,
        told(Standing::Wanted),
        told(Standing::Wanted),
        told(Standing::Resumed),
        told(Standing::Ended),
        Some(crate::view::EvalaiInfo {
            phase: Some(9),
            ..info()
        }),
    ];
    let ends = vec![
        None,
        None,
        Some(EvalaiEnd::Published { at: at(60) }),
        Some(EvalaiEnd::Ended(Status::Cancelled)),
        Some(EvalaiEnd::Refused { message: "no".into() }),
    ];
    let why = select(vec![(None, None), (Some("away".to_owned()), Some("away".to_owned()))]);
    let partials = select(vec![None, Some(1), Some(2)]);
    let cancels = select(
        vec![(false, false); 18]
            .into_iter()
            .chain([(true, false), (true, true)])
            .collect::<Vec<_>>(),
    );
    (select(infos), cancels, select(ends), why, partials).prop_map(
        |(info, (cancelled, overtaken), end, (error, unread), partial_done)| EvalaiView {
            waited: Duration::from_secs(5),
            info,
            cancelled,
            cancelled_as_of: cancelled.then(|| at(900)),
            overtaken,
            end,
            unread,
            partial_done,
            error,
            ..EvalaiView::default()
        },
    )
}

fn change() -> impl Strategy<Value = Change> {
    let turns = vec![
        Turn::NotInLine,
        Turn::Go,
        Turn::Wait { position: 2, eta: None },
        Turn::Paused { position: 1 },
    ];
    let nodes = vec![
        ObservedNode::Unknown,
        ObservedNode::Reports,
        ObservedNode::Silent { since: at(20) },
        ObservedNode::Silent { since: at(60_000) },
        ObservedNode::Gone,
    ];
    let leaderboard = (prop::bool::weighted(0.8), 0..3, select(vec![None, None, Some(300_i64)]));
    prop_oneof![
        6 => select(vec![1i64, 20, 130, 2000, 90_000, -500, -200_000]).prop_map(Change::Time),
        8 => job().prop_map(Change::Job),
        6 => prop::option::weighted(0.9, pod_view().prop_map(Box::new)).prop_map(Change::Pod),
        3 => (select(nodes), select(vec![None, None, Some("karpenter.sh/disrupted")])).prop_map(|(node, leaving)| Change::Node(node, leaving)),
        5 => observed_report().prop_map(Change::Report),
        4 => answers(),
        3 => evalai_view().prop_map(Box::new).prop_map(Change::Evalai),
        1 => any::<bool>().prop_map(Change::Recorded),
        2 => select(turns).prop_map(Change::Turn),
        1 => leaderboard.prop_map(|(present, infrastructure, schedule_seconds)| {
            Change::Leaderboard { present, infrastructure, schedule_seconds }
        }),
        1 => Just(Change::Cancel),
        4 => Just(Change::Resume),
        1 => Just(Change::Delete),
        1 => Just(Change::StatusLost),
    ]
}

fn set_job(world: &mut World, case: JobCase) {
    let name = match &case {
        JobCase::Earlier => "sub-1-r9".to_owned(),
        _ => job_name("sub", &world.status()),
    };
    let ours = |end, deleting, refused: bool, suspended: bool| {
        ObservedJob::Ours(JobView {
            name: name.clone(),
            uid: "job-uid".into(),
            created: Some(at(0)),
            started: (!suspended).then(|| at(5)),
            suspension: suspended.then(|| {
                Box::new(Suspension {
                    since: Some(at(20)),
                    queue: refused.then(|| "gpus".into()),
                })
            }),
            end,
            deleting,
            failed_create: refused.then(|| "exceeded quota".into()),
        })
    };
    world.view.job = match case {
        JobCase::Absent => ObservedJob::Absent { refused: None },
        JobCase::Created => ObservedJob::Created,
        JobCase::Foreign => ObservedJob::Foreign,
        JobCase::Earlier => ours(None, false, false, false),
        JobCase::Present {
            end,
            deleting,
            refused,
            suspended,
        } => ours(end, deleting, refused, suspended),
    };
}

fn apply(world: &mut World, change: Change) {
    let is_evalais = world.view.submission.spec.evalai.is_some();
    match change {
        Change::Time(seconds) => world.wait(seconds),
        Change::Job(case) => set_job(world, case),
        Change::Pod(pod) => world.view.pod = pod.map(|pod| *pod),
        Change::Node(node, leaving) => {
            (world.view.node.state, world.view.node.leaving) = (node, leaving.map(str::to_owned));
        }
        Change::Report(report) => world.view.report.stored = report,
        Change::Answers {
            stage,
            waited,
            fence,
            log,
        } => {
            world.view.report.stage = stage;
            world.view.report.waited = waited;
            world.view.requested.fence = fence;
            world.view.requested.log = log;
        }
        Change::Evalai(view) => world.view.evalai = is_evalais.then_some(*view),
        Change::Recorded(end) => world.view.record.get_or_insert_default().end_written = end,
        Change::Turn(turn) => world.view.turn = turn,
        Change::Leaderboard {
            present,
            infrastructure,
            schedule_seconds,
        } => {
            let mut found = leaderboard(is_evalais);
            found.spec.retries.infrastructure = infrastructure;
            found.spec.deadlines.schedule_seconds = schedule_seconds;
            world.view.leaderboard = present.then(|| Arc::new(found));
        }
        Change::Cancel => world.submission().spec.cancel = true,
        Change::Resume => {
            let spec = &mut world.submission().spec;
            spec.attempt = spec.attempt.next();
            spec.cancel = false;
        }
        Change::Delete => world.submission().metadata.deletion_timestamp = Some(Time(world.view.now)),
        Change::StatusLost => world.submission().status = None,
    }
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

    /// `World::pass` checks the rules.
    #[test]
    fn the_rules_hold_in_any_world(kind in 0..4, changes in prop::collection::vec(change(), 1..40)) {
        let mut world = match kind {
            0 => World::evalai(),
            1 => World::local(),
            2 => of_mode("Batch"),
            _ => predictions::local(),
        };
        world.pass();
        for change in changes {
            apply(&mut world, change);
            world.pass();
        }
    }

    /// Once cancelled, a world that obeys (deleted things go) comes to an end.
    #[test]
    fn a_cancel_always_ends(changes in prop::collection::vec(change(), 1..25)) {
        let mut world = World::local();
        world.pass();
        for change in changes {
            apply(&mut world, change);
            world.pass();
        }
        world.submission().spec.cancel = true;
        // Its worker is never answered.
        world.view.report.stage = None;
        for _ in 0..12 {
            world.view.report.waited += Duration::from_mins(5);
            world.view.requested.fence = ObservedFence::Failed(world.view.report.waited);
            if world.view.report.stored == ObservedReport::NotRead {
                world.view.report.stored = ObservedReport::Absent;
            }
            let plan = world.pass();
            if has(&plan, |a| matches!(a, crate::submissions::Action::DeleteJob { .. })) || is_going(&world) {
                world.job_gone();
            }
            if matches!(world.view.job, ObservedJob::Created | ObservedJob::Foreign) || is_earlier(&world) {
                world.job_gone();
            }
            world.wait(300);
            if plan.status.state.is_some_and(leaderboard_api::State::is_terminal) {
                return Ok(());
            }
        }
        prop_assert!(false, "still {:?}", world.status());
    }
}

fn is_going(world: &World) -> bool {
    matches!(&world.view.job, ObservedJob::Ours(job) if job.deleting)
}

fn is_earlier(world: &World) -> bool {
    matches!(&world.view.job, ObservedJob::Ours(job) if job.name != job_name("sub", &world.status()))
}
