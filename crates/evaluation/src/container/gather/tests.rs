use std::fs;
use std::io;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use leaderboard_api::{EvaluationMode, PlannedEvaluation, WorkerState};
use leaderboard_contract::keys::result_path;
use leaderboard_contract::report::Outcome;
use leaderboard_evidence::Tree;
use leaderboard_protocol::files::{Mark, Side};
use nix::errno::Errno;
use nix::sys::stat::Mode;

use super::super::merge::NOTHING_YET;
use super::*;
use crate::fixtures::{container_run, put_result, put_status, result, run, run_of_mode};
use crate::judge::{Judge, Outside, Situation};
use crate::{Gathered, Results};

pub(super) struct Volume {
    folder: tempfile::TempDir,
    tree: Arc<Tree>,
    gatherer: Gatherer,
    judge: Judge,
    now: u64,
}

impl Volume {
    fn new() -> Self {
        Self::of_mode(EvaluationMode::Interactive)
    }

    fn of_mode(mode: EvaluationMode) -> Self {
        Self::of(&run_of_mode(mode))
    }

    pub(super) fn of(run: &Run) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let tree = Arc::new(Tree::open(folder.path()).unwrap());
        Self {
            gatherer: Gatherer::new(run, Arc::clone(&tree)).unwrap(),
            judge: Judge::default(),
            folder,
            tree,
            now: 0,
        }
    }

    pub(super) fn path(&self) -> &Path {
        self.folder.path()
    }

    fn result_path(&self, worker: u16) -> PathBuf {
        self.path().join(result_path(Pair::new(worker).unwrap()))
    }

    pub(super) fn done(&self, workers: &[u16]) {
        for worker in workers {
            put_status(self.path(), Side::Host(HOST), *worker, Mark::Done);
        }
    }

    pub(super) fn round(&mut self) -> (Gathered, Situation) {
        self.now += 10;
        let gathered = self.gatherer.round();
        let outside = Outside {
            stop: None,
            cancelled: false,
            activity: 0,
            now: Duration::from_secs(self.now),
        };
        let seen = self.judge.see(&gathered, outside);
        (gathered, seen)
    }
}

pub(super) fn text<'a>(gathered: &'a Gathered, key: &str) -> &'a str {
    std::str::from_utf8(&gathered.objects[key].bytes).unwrap()
}

fn unusable_of(gathered: &Gathered) -> Vec<&str> {
    gathered.unusable().map(|unusable| unusable.why.as_str()).collect()
}

#[test]
fn a_run_from_nothing_to_complete() {
    let mut volume = Volume::new();
    let (gathered, seen) = volume.round();
    assert!(gathered.merged.is_none() && seen.complete.is_none() && !seen.any_started);
    assert_eq!((text(&gathered, RESULTS), text(&gathered, STDOUT)), ("[]", NOTHING_YET));
    assert_eq!((gathered.workers[0].done, gathered.workers[0].total), (0, 0));

    put_status(volume.path(), Side::Host(HOST), 1, Mark::Start(0));
    put_result(volume.path(), 1, &result(3, 10, 0.25));
    let (gathered, seen) = volume.round();
    let worker = &gathered.workers[0];
    assert_eq!((worker.done, worker.total, worker.state), (3, 10, WorkerState::Running));
    assert_eq!(gathered.workers[1].state, WorkerState::Waiting);
    assert!(seen.any_started && seen.complete.is_none());
    let merged = gathered.merged.as_ref().unwrap();
    assert_eq!((merged.done, merged.outcome), (3, Outcome::Running));
    let list = r#"[{"split":"test","show_to_participant":true,"accuracies":{"accuracy":0.25}}]"#;
    assert_eq!(gathered.texts.partial_results.as_deref(), Some(list));
    assert_eq!(text(&gathered, "evaluators/1/result.json"), result(3, 10, 0.25));

    put_result(volume.path(), 1, &result(10, 10, 0.25));
    put_result(volume.path(), 2, &result(30, 30, 0.75));
    let (gathered, seen) = volume.round();
    assert_eq!((seen.complete, seen.all_done), (Some(Duration::ZERO), false));
    let merged = gathered.merged.as_ref().unwrap();
    assert_eq!(merged.score.as_ref().map(|score| score.value.as_str()), Some("0.625"));
    assert_eq!(
        (merged.done, merged.outcome, merged.eligible),
        (40, Outcome::Finished, true)
    );
    assert!(text(&gathered, RESULTS).contains("0.625"));
    assert_eq!(gathered.texts.partial_results, None);
    volume.done(&[1, 2]);
    let (gathered, seen) = volume.round();
    assert!(seen.all_done && gathered.is_complete() && seen.spoiled.is_none());
    assert_eq!(gathered.workers[1].state, WorkerState::Done);
    let stored: Vec<&str> = gathered.objects.keys().map(String::as_str).collect();
    assert_eq!(
        stored,
        [
            "evalai/results.json",
            "evalai/stdout.txt",
            "evaluators/1/result.json",
            "evaluators/2/result.json"
        ]
    );
}

/// An agent's word is none: it may end long before its evaluator knows the result.
#[test]
fn a_worker_is_done_when_its_evaluator_is() {
    let mut volume = Volume::new();
    put_result(volume.path(), 1, &result(3, 10, 0.5));
    for worker in [1, 2] {
        put_status(volume.path(), Side::Agent, worker, Mark::Done);
    }
    let (_, seen) = volume.round();
    assert!(!seen.all_done && seen.spoiled.is_none());
}

/// Marks of two agents and of both evaluators, one after the other, each with what the two workers are then.
#[test]
fn an_agent_counts_only_where_one_is() {
    use EvaluationMode::{Batch, Interactive, Predictions};
    use WorkerState::{Crashed, Done, Running, Waiting};
    let agent = |number, mark| (Side::Agent, number, mark);
    let evaluator = |number, mark| (Side::Host(HOST), number, mark);
    let steps = [
        (agent(2, Mark::Start(0)), [Running, Waiting, Waiting]),
        (agent(2, Mark::Crash(0)), [Crashed, Waiting, Waiting]),
        (evaluator(2, Mark::Start(0)), [Running, Running, Running]),
        (evaluator(2, Mark::Crash(0)), [Crashed, Crashed, Crashed]),
        (evaluator(2, Mark::Done), [Done, Done, Done]),
    ];
    for (index, mode) in [Interactive, Batch, Predictions].into_iter().enumerate() {
        let mut volume = Volume::of_mode(mode);
        for ((side, number, mark), states) in steps {
            put_status(volume.path(), side, number, mark);
            let (gathered, seen) = volume.round();
            assert_eq!(gathered.workers[1].state, states[index], "{mode:?} {side} {mark:?}");
            assert_eq!(gathered.workers[0].state, Waiting, "{mode:?} {side} {mark:?}");
            let agent_counts = mode == Interactive || side != Side::Agent;
            if mark == Mark::Start(0) {
                assert_eq!(seen.any_started, agent_counts, "{mode:?} {side}");
            }
        }
    }
}

#[test]
fn the_agent_that_runs_first_is_the_first_workers_until_it_is_done() {
    let mut volume = Volume::of_mode(EvaluationMode::Batch);
    for (side, mark, state, crashes) in [
        (Side::Agent, Mark::Start(0), WorkerState::Running, 0),
        (Side::Agent, Mark::Crash(0), WorkerState::Crashed, 1),
        (Side::Agent, Mark::Start(1), WorkerState::Running, 1),
        (Side::Agent, Mark::Done, WorkerState::Waiting, 1),
        (Side::Host(HOST), Mark::Start(0), WorkerState::Running, 1),
        (Side::Host(HOST), Mark::Crash(0), WorkerState::Crashed, 1),
        (Side::Host(HOST), Mark::Done, WorkerState::Done, 1),
    ] {
        put_status(volume.path(), side, 1, mark);
        let (gathered, seen) = volume.round();
        let worker = &gathered.workers[0];
        assert_eq!((worker.state, worker.crashes), (state, crashes), "{side} {mark:?}");
        assert!(!seen.all_done, "{side} {mark:?}: the second worker has done nothing");
    }
}

#[test]
fn what_cannot_be_used_leaves_the_last_good_one() {
    let mut volume = Volume::new();
    let good = result(3, 10, 0.5);
    put_result(volume.path(), 1, &good);
    volume.round();
    let several = r#"{"schema":1,"done":4,"total":10,"final":false,"splits":[{"name":"a","metrics":{}},{"name":"b","metrics":{}}]}"#;
    let large = good.clone() + &" ".repeat(MAX_BYTES);
    let no_score = result(10, 10, 0.5).replace("accuracy", "loss");
    for (bad, part) in [
        ("{\"schema\":1", "not the JSON of a result"),
        ("", "not the JSON of a result"),
        (several, "Set tracks[].container.score.split."),
        (&large, "more than the 1048576 that are read. Write a regular file."),
        (&no_score, "final without the metric accuracy of its split"),
    ] {
        put_result(volume.path(), 1, bad);
        let (gathered, seen) = volume.round();
        let [why] = unusable_of(&gathered)[..] else {
            panic!("{bad:.40}")
        };
        assert!(
            why.starts_with("evaluator 1: result.json can't be ") && why.contains(part),
            "{why}"
        );
        assert_eq!(
            (gathered.workers[0].done, gathered.first_refused(), seen.spoiled),
            (3, None, None)
        );
        assert_eq!(text(&gathered, "evaluators/1/result.json"), good);
    }
    fs::remove_file(volume.result_path(1)).unwrap();
    assert_eq!(volume.round().0.workers[0].done, 3);
    put_result(volume.path(), 1, &result(4, 10, 0.5));
    let (gathered, _) = volume.round();
    assert_eq!((gathered.workers[0].done, unusable_of(&gathered)), (4, vec![]));
}

#[test]
fn what_cannot_be_used_at_the_end_is_the_evaluators_fault() {
    for (last, part) in [
        (result(10, 10, 0.5).replace("0.5", "1e999"), "is no finite number"),
        (result(9, 10, 0.5), "evaluator 1 ended without a final result."),
        (
            result(9, 10, 0.5).replace("false", "true"),
            "final is true, but done is 9 and total is 10.",
        ),
    ] {
        let mut volume = Volume::new();
        put_result(volume.path(), 1, &result(5, 10, 0.5));
        put_result(volume.path(), 2, &result(5, 10, 0.5));
        volume.round();
        put_result(volume.path(), 1, &last);
        volume.done(&[1]);
        let (gathered, seen) = volume.round();
        let Some((Ending::Unusable(unusable), since)) = seen.spoiled else {
            panic!("{last}: {:?}", seen.spoiled)
        };
        assert!(unusable.why.contains(part), "{last}: {unusable}");
        assert_eq!(
            (unusable.worker, since, gathered.first_refused()),
            (Some(1), Duration::ZERO, None)
        );
    }
}

#[test]
fn one_refusal_refuses_all_and_is_the_participants() {
    let mut volume = Volume::new();
    put_result(volume.path(), 1, &result(10, 10, 0.5));
    put_result(volume.path(), 2, &result(4, 10, 0.5));
    volume.round();
    let refused = result(4, 10, 0.5).replacen('{', r#"{"refused":"The agent\nnever answered.","#, 1);
    put_result(volume.path(), 2, &refused);
    let (gathered, seen) = volume.round();
    let expected = RefusedResults::new(Some(2), "The agent never answered.");
    assert_eq!((gathered.first_refused(), seen.spoiled), (Some(expected.clone()), None));
    assert_eq!(
        text(&gathered, "evaluators/2/result.json"),
        result(4, 10, 0.5),
        "nothing is resumed from a refusal"
    );
    volume.done(&[2]);
    let (_, seen) = volume.round();
    assert_eq!(seen.spoiled, Some((Ending::Invalid(expected.clone()), Duration::ZERO)));
    // Also where another worker's evaluator is at fault.
    let mut volume = Volume::new();
    put_result(volume.path(), 1, "no result");
    put_result(volume.path(), 2, &refused);
    volume.done(&[1, 2]);
    let (_, seen) = volume.round();
    assert_eq!(seen.spoiled, Some((Ending::Invalid(expected), Duration::ZERO)));
}

#[test]
fn a_result_with_less_does_not_replace_the_one_before_unless_it_is_final() {
    let mut volume = Volume::new();
    for (text, done) in [
        (result(5, 10, 0.5), 5),
        (result(0, 10, 0.0), 5),
        (result(5, 10, 0.75), 5),
        (result(4, 4, 0.75), 4),
        (result(9, 10, 0.5), 4),
        (result(6, 6, 0.5), 6),
    ] {
        put_result(volume.path(), 1, &text);
        let (gathered, _) = volume.round();
        assert_eq!(
            (gathered.workers[0].done, gathered.first_refused()),
            (done, None),
            "{text}"
        );
        assert_eq!(unusable_of(&gathered), Vec::<&str>::new(), "{text}");
    }
}

#[test]
fn an_agents_use_of_what_it_may_not_use_counts_at_the_end() {
    let mut volume = Volume::new();
    put_result(volume.path(), 1, &result(10, 10, 0.5));
    put_result(
        volume.path(),
        2,
        &result(10, 10, 0.5).replacen('{', r#"{"eligible":false,"#, 1),
    );
    volume.done(&[1, 2]);
    let (gathered, seen) = volume.round();
    let merged = gathered.merged.as_ref().unwrap();
    assert_eq!((merged.outcome, merged.eligible), (Outcome::Rejected, false));
    assert!(gathered.is_complete() && seen.spoiled.is_none());
}

#[test]
fn results_that_do_not_fit_together_end_the_run_when_all_are_done() {
    let mut volume = Volume::new();
    put_result(volume.path(), 1, &result(10, 10, 0.5));
    let other = result(10, 10, 0.5).replacen(r#""accuracy":"#, r#""loss":1,"accuracy":"#, 1);
    put_result(volume.path(), 2, &other);
    volume.done(&[1]);
    let (gathered, seen) = volume.round();
    assert!(!gathered.is_complete() && seen.spoiled.is_none());
    volume.done(&[2]);
    let (gathered, seen) = volume.round();
    let Some((Ending::Unusable(unusable), _)) = seen.spoiled else {
        panic!("{:?}", seen.spoiled)
    };
    assert!(
        unusable
            .why
            .starts_with("evaluator 1 has no metric loss of the split test"),
        "{unusable}"
    );
    assert_eq!((unusable.worker, gathered.first_refused()), (Some(1), None));
}

/// A name, and how it is made.
type Place<'a> = (&'a str, &'a dyn Fn(&Path) -> io::Result<()>);

/// Each in place of the result: none is followed or read whole, and no open waits without an end.
#[test]
fn only_a_regular_file_of_few_bytes_is_read() {
    let outside = tempfile::NamedTempFile::new().unwrap();
    fs::write(outside.path(), result(10, 10, 1.0)).unwrap();
    let place: [Place<'_>; 5] = [
        ("link", &|path| symlink(outside.path(), path)),
        ("dangling link", &|path| symlink("nowhere", path)),
        ("pipe", &|path| Ok(nix::unistd::mkfifo(path, Mode::S_IRWXU)?)),
        ("folder", &|path| fs::create_dir(path)),
        ("10 GB with holes", &|path| fs::File::create(path)?.set_len(10 << 30)),
    ];
    for (name, make) in place {
        let mut volume = Volume::new();
        let path = volume.result_path(1);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        make(&path).unwrap();
        volume.done(&[1]);
        let (gathered, seen) = volume.round();
        assert_eq!(unusable_of(&gathered).len(), 1, "{name}");
        assert!(
            matches!(seen.spoiled, Some((Ending::Unusable(_), _))),
            "{name}: {:?}",
            seen.spoiled
        );
        assert!(gathered.merged.is_none(), "{name}");
    }
    // A whole folder of the volume as a link.
    let mut volume = Volume::new();
    fs::create_dir(volume.path().join("evaluators")).unwrap();
    symlink("/etc", volume.path().join("evaluators/1")).unwrap();
    assert!(volume.round().0.merged.is_none());
}

#[test]
fn a_file_that_grows_is_read_when_it_is_whole() {
    let mut volume = Volume::new();
    let good = result(3, 10, 0.5);
    let path = volume.result_path(1);
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    for end in 0..good.len() {
        fs::write(&path, &good[..end]).unwrap();
        let (gathered, seen) = volume.round();
        assert!(gathered.merged.is_none() && seen.spoiled.is_none(), "{end}");
    }
    fs::write(&path, &good).unwrap();
    assert_eq!(volume.round().0.workers[0].done, 3);
}

#[test]
fn a_result_that_the_node_cannot_read_is_tried_again_and_spoils_nothing() {
    for trouble in [Errno::EMFILE, Errno::ENFILE, Errno::EIO, Errno::ENOMEM] {
        let mut volume = Volume::new();
        put_result(volume.path(), 1, &result(10, 10, 0.5));
        put_result(volume.path(), 2, &result(9, 10, 0.5));
        volume.round();
        put_result(volume.path(), 2, &result(10, 10, 0.5));
        volume.done(&[1, 2]);
        *volume.tree.disk.lock().unwrap() = Some(trouble);
        for _ in 0..2 {
            let (gathered, seen) = volume.round();
            assert_eq!((unusable_of(&gathered), seen.spoiled), (vec![], None), "{trouble}");
            assert_eq!(gathered.workers[1].done, 9);
        }
        *volume.tree.disk.lock().unwrap() = None;
        assert!(volume.round().0.is_complete(), "{trouble}");
    }
}

#[test]
fn a_round_writes_nothing_to_the_volume() {
    let mut volume = Volume::new();
    put_result(volume.path(), 1, &result(10, 10, 0.5));
    let before = volume.tree.walk("evaluators", 100);
    volume.round();
    volume.gatherer.remove_others().unwrap();
    assert_eq!(volume.tree.walk("evaluators", 100), before);
    assert_eq!(fs::read_dir(volume.path()).unwrap().count(), 1);
}

#[test]
fn a_plan_that_does_not_hold_is_refused() {
    let refused = Evaluators::of(&run()).unwrap_err();
    assert!(
        refused.problem.ends_with("it is of another kind of evaluation"),
        "{refused}"
    );
    let long = "m".repeat(MAX_NAME + 1);
    for (workers, metric, problem) in [
        (0, "accuracy", "it has no worker"),
        (2, long.as_str(), "the name of its score has more than 64 characters"),
        (2, &long[1..], ""),
    ] {
        let mut run = container_run();
        let PlannedEvaluation::Container(container) = &mut run.plan.evaluation else {
            panic!("not of a container")
        };
        container.workers = workers;
        metric.clone_into(&mut container.score.metric);
        let refused = Evaluators::of(&run).err();
        assert_eq!(refused.is_some(), !problem.is_empty(), "{metric}");
        assert!(
            refused.is_none_or(|refused| refused.problem.ends_with(problem)),
            "{problem}"
        );
    }
}
