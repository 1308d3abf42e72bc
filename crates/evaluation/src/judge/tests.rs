use super::*;

const CANCEL: Duration = Duration::from_mins(2);

fn secs(seconds: u64) -> Duration {
    Duration::from_secs(seconds)
}

fn running() -> Situation {
    Situation {
        any_started: true,
        ..Situation::default()
    }
}

#[test]
fn complete_results_end_a_run_as_soon_as_the_agents_are_done_or_after_a_while() {
    let table = [
        (None, true, Step::GoOn),
        (Some(secs(0)), false, Step::GoOn),
        (Some(secs(29)), false, Step::GoOn),
        (Some(secs(30)), false, Step::Finish(Ending::Complete)),
        (Some(secs(0)), true, Step::Finish(Ending::Complete)),
    ];
    for (complete, all_done, expected) in table {
        let seen = Situation {
            whole: complete.is_some(),
            complete,
            all_done,
            ..running()
        };
        assert_eq!(decide(&seen, &Pace::default(), CANCEL), expected, "{seen:?}");
    }
}

#[test]
fn a_route_that_will_be_repeated_is_waited_for() {
    let crashed_in_the_last_route = Situation {
        whole: true,
        ..running()
    };
    assert_eq!(decide(&crashed_in_the_last_route, &Pace::default(), CANCEL), Step::GoOn);
    let retries_used_up = Situation {
        stop: Some(Stop::Retries),
        cancelled: Some(secs(5)),
        quiet: secs(5),
        ..crashed_in_the_last_route
    };
    let end = Step::Finish(Ending::Stopped(Stop::Retries));
    assert_eq!(decide(&retries_used_up, &Pace::default(), CANCEL), end);
}

#[test]
fn a_stop_cancels_first_and_ends_when_the_agents_are_still() {
    let end = Step::Finish(Ending::Stopped(Stop::Retries));
    let table = [
        (None, secs(100), Step::Cancel),
        (Some(secs(0)), secs(100), Step::GoOn),
        (Some(secs(4)), secs(4), Step::GoOn),
        (Some(secs(5)), secs(4), Step::GoOn),
        (Some(secs(5)), secs(5), end.clone()),
        (Some(secs(24)), secs(0), Step::GoOn),
        (Some(secs(25)), secs(0), end.clone()),
    ];
    for (cancelled, quiet, expected) in table {
        let seen = Situation {
            stop: Some(Stop::Retries),
            cancelled,
            quiet,
            ..running()
        };
        assert_eq!(decide(&seen, &Pace::default(), CANCEL), expected, "{seen:?}");
    }
}

#[test]
fn half_of_a_short_cancel_is_left_for_storing() {
    let seen = Situation {
        stop: Some(Stop::Cancel),
        cancelled: Some(secs(5)),
        ..running()
    };
    let step = decide(&seen, &Pace::default(), secs(10));
    assert_eq!(step, Step::Finish(Ending::Stopped(Stop::Cancel)));
}

#[test]
fn nothing_is_waited_for_when_nothing_has_begun() {
    let seen = Situation {
        stop: Some(Stop::Cancel),
        cancelled: Some(secs(0)),
        ..Situation::default()
    };
    assert_eq!(
        decide(&seen, &Pace::default(), CANCEL),
        Step::Finish(Ending::Stopped(Stop::Cancel))
    );
}

#[test]
fn a_pair_that_ended_badly_ends_the_run() {
    let ending = Ending::Invalid(RefusedResults::new(Some(2), "pair 2 ended"));
    let end = Step::Finish(ending.clone());
    let table = [
        (secs(4), None, false, Step::GoOn),
        (secs(5), None, false, Step::Cancel),
        (secs(5), None, true, end.clone()),
        (secs(15), Some(secs(10)), false, end.clone()),
    ];
    for (since, cancelled, all_done, expected) in table {
        let seen = Situation {
            spoiled: Some((ending.clone(), since)),
            cancelled,
            all_done,
            quiet: secs(10),
            ..running()
        };
        assert_eq!(decide(&seen, &Pace::default(), CANCEL), expected, "{seen:?}");
    }
}

pub(super) mod seen_on_a_volume {
    use std::fs;
    use std::sync::Arc;

    use leaderboard_protocol::files::{Host, Mark, Pair, Side};

    use super::super::*;
    use crate::Results;
    use crate::carla::gather::{Gatherer, results_plan};
    use crate::fixtures::{checkpoint, put_checkpoint, put_status, run, run_of};
    use leaderboard_api::{RouteSlice, WorkerState};
    use leaderboard_contract::keys::{EVALAI, MERGED, checkpoint_path};
    use leaderboard_contract::report::Outcome;
    use leaderboard_evidence::Tree;

    pub(crate) struct Volume {
        pub(crate) folder: tempfile::TempDir,
        pub(crate) gatherer: Gatherer,
        judge: Judge,
        now: u64,
    }

    impl Volume {
        pub(crate) fn new() -> Self {
            let folder = tempfile::tempdir().unwrap();
            let tree = Arc::new(Tree::open(folder.path()).unwrap());
            Self {
                gatherer: Gatherer::new(&run(), tree).unwrap(),
                judge: Judge::default(),
                folder,
                now: 0,
            }
        }

        pub(crate) fn round(&mut self) -> (Gathered, Situation) {
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

    pub(crate) fn text<'a>(gathered: &'a Gathered, key: &str) -> &'a str {
        std::str::from_utf8(&gathered.objects[key].bytes).unwrap()
    }

    #[test]
    fn a_run_from_nothing_to_complete() {
        let mut volume = Volume::new();
        let (gathered, seen) = volume.round();
        assert!(gathered.merged.is_none() && seen.complete.is_none() && !seen.any_started);
        assert!(text(&gathered, "evalai/stdout.txt").starts_with("Initializing"));
        assert!(!gathered.objects.contains_key(MERGED));

        put_status(volume.folder.path(), Side::Host(Host::Simulator), 1, Mark::Start(0));
        put_checkpoint(volume.folder.path(), 1, &checkpoint(0, 1, 2));
        let (gathered, seen) = volume.round();
        assert_eq!(
            (gathered.workers[0].done, gathered.workers[0].state),
            (1, WorkerState::Running)
        );
        assert_eq!(
            (gathered.workers[1].done, gathered.workers[1].state),
            (0, WorkerState::Waiting)
        );
        assert!(seen.any_started && seen.complete.is_none());
        assert!(text(&gathered, "evalai/stdout.txt").contains("Completed 1 out of the 4 routes"));

        put_checkpoint(volume.folder.path(), 1, &checkpoint(0, 2, 2));
        put_checkpoint(volume.folder.path(), 2, &checkpoint(2, 2, 2));
        let (gathered, seen) = volume.round();
        assert_eq!((seen.complete, seen.all_done), (Some(Duration::ZERO), false));
        let score = gathered.merged.as_ref().unwrap().score.clone();
        assert_eq!(score.unwrap().value, "100.00");
        assert_eq!(text(&gathered, "evalai/metadata.json"), text(&gathered, MERGED));
        assert!(gathered.digests().keys().all(|key| key.starts_with(EVALAI)));
        assert_eq!(gathered.digests().len(), 3);
        let (_, seen) = volume.round();
        assert_eq!(seen.complete, Some(Duration::from_secs(10)));
    }

    #[test]
    fn torn_and_lost_files_leave_the_last_good_one() {
        let mut volume = Volume::new();
        put_checkpoint(volume.folder.path(), 1, &checkpoint(0, 1, 2));
        volume.round();
        for text in ["", "{\"_checkpoint\": {", "null"] {
            put_checkpoint(volume.folder.path(), 1, text);
            let (gathered, _) = volume.round();
            assert_eq!(
                (gathered.workers[0].done, gathered.first_refused()),
                (1, None),
                "{text:?}"
            );
        }
        fs::remove_file(volume.folder.path().join("agent/agent1/agent_results.json")).unwrap();
        assert_eq!(volume.round().0.workers[0].done, 1);
    }

    #[test]
    fn what_is_stored_is_the_last_good_one_and_no_torn_file() {
        let mut volume = Volume::new();
        let good = checkpoint(0, 1, 2);
        put_checkpoint(volume.folder.path(), 1, &good);
        volume.round();
        put_checkpoint(volume.folder.path(), 1, &checkpoint(0, 2, 2)[..100]);
        let (gathered, _) = volume.round();
        assert_eq!(text(&gathered, "agent/agent1/agent_results.json"), good);
        let stored: Vec<&str> = gathered.objects.keys().map(String::as_str).collect();
        let expected = [
            "agent/agent1/agent_results.json",
            "agent/agent_results.json",
            "evalai/metadata.json",
            "evalai/results.json",
            "evalai/stdout.txt",
        ];
        assert_eq!(stored, expected);
    }

    #[test]
    fn a_logcopy_that_begins_while_a_checkpoint_is_written_takes_what_the_runner_kept() {
        let mut volume = Volume::new();
        let kept = volume.folder.path().join("containers-status/agent-1");
        fs::create_dir_all(&kept).unwrap();
        fs::write(kept.join("checkpoint.json"), checkpoint(0, 1, 2)).unwrap();
        put_checkpoint(volume.folder.path(), 1, "{\"_checkpoint\"");
        let (gathered, _) = volume.round();
        assert_eq!(gathered.workers[0].done, 1);
        assert!(gathered.objects.contains_key("agent/agent1/agent_results.json"));
        // The copy is never a step back.
        put_checkpoint(volume.folder.path(), 1, &checkpoint(0, 2, 2));
        assert_eq!(volume.round().0.workers[0].done, 2);
        put_checkpoint(volume.folder.path(), 1, "");
        fs::write(kept.join("checkpoint.json"), checkpoint(0, 1, 2) + " ").unwrap();
        assert_eq!(volume.round().0.workers[0].done, 2);
        put_checkpoint(volume.folder.path(), 1, &checkpoint(0, 2, 2));
        assert_eq!(volume.round().0.workers[0].done, 2);
    }

    #[test]
    fn what_the_runner_kept_counts_where_only_the_evaluators_own_count_is_further() {
        let mut volume = Volume::new();
        let kept = volume.folder.path().join("containers-status/agent-1");
        fs::create_dir_all(&kept).unwrap();
        let counted = checkpoint(0, 1, 2);
        let uncounted = counted.replacen("\"progress\":[1,2]", "\"progress\":[0,2]", 1);
        assert_ne!(uncounted, counted);
        put_checkpoint(volume.folder.path(), 1, &uncounted);
        let stored = |gathered: &Gathered| text(gathered, "agent/agent1/agent_results.json").to_owned();
        assert_eq!(stored(&volume.round().0), uncounted);
        put_checkpoint(volume.folder.path(), 1, "");
        fs::write(kept.join("checkpoint.json"), &counted).unwrap();
        assert_eq!(stored(&volume.round().0), counted);
    }

    #[test]
    fn a_crash_in_the_last_route_is_whole_and_not_complete() {
        let mut volume = Volume::new();
        put_checkpoint(volume.folder.path(), 1, &checkpoint(0, 2, 2));
        let crashed = checkpoint(2, 2, 2)
            .replacen(r#""index":-1,"status":"Completed""#, "", 1)
            .replacen(
                r#""status":"Completed""#,
                r#""status":"Failed - Simulation crashed""#,
                1,
            );
        put_checkpoint(volume.folder.path(), 2, &crashed);
        let (gathered, seen) = volume.round();
        assert_eq!(gathered.merged.as_ref().unwrap().outcome, Outcome::Crashed);
        assert!(!gathered.has_ended() && seen.whole && seen.complete.is_none());
        put_checkpoint(volume.folder.path(), 2, &checkpoint(2, 2, 2));
        let (gathered, seen) = volume.round();
        assert_eq!(
            (seen.complete, gathered.merged.unwrap().eligible),
            (Some(Duration::ZERO), true)
        );
    }

    #[test]
    fn a_crash_of_the_simulation_that_a_checkpoint_names_is_reported_of_its_pair() {
        let mut volume = Volume::new();
        put_checkpoint(volume.folder.path(), 1, &checkpoint(0, 2, 2));
        let named = checkpoint(2, 2, 2).replacen(
            r#""status":"Completed""#,
            r#""status":"Failed - Simulation crashed""#,
            2,
        );
        put_checkpoint(volume.folder.path(), 2, &named);
        let (gathered, _) = volume.round();
        let found: Vec<bool> = gathered.workers.iter().map(|pair| pair.names_crash).collect();
        assert_eq!(found, [false, true]);
    }

    #[test]
    fn a_round_writes_nothing_to_the_volume() {
        let mut volume = Volume::new();
        put_checkpoint(volume.folder.path(), 1, &checkpoint(0, 2, 2));
        let tree = Tree::open(volume.folder.path()).unwrap();
        let before = tree.walk("agent", 100);
        let (gathered, _) = volume.round();
        assert!(text(&gathered, "evalai/stdout.txt").starts_with("Here is a summary"));
        assert_eq!(tree.walk("agent", 100), before);
        assert_eq!(fs::read_dir(volume.folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn the_checkpoints_of_all_pairs_share_one_bound() {
        for pairs in [1_u32, 4, 16] {
            let slices = (0..pairs).map(|pair| RouteSlice {
                first: pair,
                last: pair,
            });
            let plan = results_plan(&run_of(slices.collect())).unwrap();
            let bytes: usize = (0..plan.pairs.len()).map(|pair| plan.limits_of(pair).bytes).sum();
            assert!(bytes <= 48 << 20, "{pairs} pairs may hold {bytes} bytes");
        }
    }

    #[test]
    fn a_checkpoint_beyond_its_pairs_share_is_not_even_read() {
        let mut volume = Volume::new();
        put_checkpoint(volume.folder.path(), 1, &checkpoint(0, 1, 2));
        volume.round();
        let limit = results_plan(&run()).unwrap().limits_of(0).bytes;
        put_checkpoint(volume.folder.path(), 1, &(checkpoint(0, 2, 2) + &" ".repeat(limit)));
        let (gathered, _) = volume.round();
        let why = gathered.first_refused().unwrap().why;
        assert!(why.contains(&format!("more than the {limit} that are read")), "{why}");
        assert_eq!(gathered.workers[0].done, 1);
        assert_eq!(
            gathered.objects["agent/agent1/agent_results.json"].bytes,
            checkpoint(0, 1, 2)
        );
    }

    #[test]
    fn a_complete_checkpoint_of_other_routes_does_not_make_a_pair_done() {
        let volume = Volume::new();
        let folder = volume.folder.path();
        put_checkpoint(folder, 1, &checkpoint(0, 2, 2));
        put_checkpoint(folder, 2, &checkpoint(1, 2, 2));
        volume.gatherer.remove_others().unwrap();
        let is_there = |pair: u16| folder.join(checkpoint_path(Pair::new(pair).unwrap())).exists();
        assert_eq!((is_there(1), is_there(2)), (true, false));
        // Every other refusal is a round's matter.
        put_checkpoint(folder, 2, &checkpoint(2, 2, 2).replace("100.0", "1000.0"));
        volume.gatherer.remove_others().unwrap();
        assert!(is_there(2));
    }

    #[test]
    fn a_refused_checkpoint_shows_why_and_spoils_the_run_when_its_agent_is_done() {
        let mut volume = Volume::new();
        put_checkpoint(volume.folder.path(), 2, &checkpoint(2, 1, 2));
        volume.round();
        put_checkpoint(volume.folder.path(), 2, &checkpoint(2, 2, 2).replace("100.0", "1000.0"));
        let (gathered, seen) = volume.round();
        let refused = gathered.first_refused().unwrap();
        let why = &refused.why;
        assert!(
            why.starts_with("pair 2, route RouteScenario_2_rep0: ") && why.contains("1000"),
            "{why}"
        );
        assert_eq!(refused.worker, Some(2));
        assert_eq!((gathered.workers[1].done, seen.spoiled), (1, None));
        put_status(volume.folder.path(), Side::Agent, 2, Mark::Done);
        let (_, seen) = volume.round();
        assert_eq!(seen.spoiled, Some((Ending::Invalid(refused.clone()), Duration::ZERO)));
        let (_, seen) = volume.round();
        assert_eq!(seen.spoiled, Some((Ending::Invalid(refused), Duration::from_secs(10))));
        put_checkpoint(volume.folder.path(), 2, &checkpoint(2, 2, 2));
        let (gathered, seen) = volume.round();
        assert_eq!((gathered.first_refused(), seen.spoiled), (None, None));
    }

    #[test]
    fn a_forged_done_ends_nothing_well() {
        let mut volume = Volume::new();
        put_checkpoint(volume.folder.path(), 1, &checkpoint(0, 1, 2));
        for pair in [1, 2] {
            put_status(volume.folder.path(), Side::Agent, pair, Mark::Done);
        }
        let (gathered, seen) = volume.round();
        assert!(!gathered.is_complete() && seen.all_done && seen.complete.is_none());
        let Some((Ending::Invalid(refused), _)) = seen.spoiled else {
            panic!("{:?}", seen.spoiled)
        };
        let why = &refused.why;
        assert_eq!(refused.worker, Some(1));
        assert!(why.starts_with("pair 1 ended with 1 of its 2 route runs."), "{why}");
    }

    #[test]
    fn a_link_in_place_of_the_checkpoint_is_refused() {
        let mut volume = Volume::new();
        let folder = volume.folder.path().join("agent/agent1");
        fs::create_dir_all(&folder).unwrap();
        std::os::unix::fs::symlink("/etc/passwd", folder.join("agent_results.json")).unwrap();
        let why = volume.round().0.first_refused().unwrap().why;
        assert!(why.contains("not a regular file"), "{why}");
    }

    #[test]
    fn crashes_count_by_the_side_that_had_more() {
        let mut volume = Volume::new();
        let folder = volume.folder.path().to_owned();
        for (side, mark) in [
            (Side::Host(Host::Simulator), Mark::Start(0)),
            (Side::Host(Host::Simulator), Mark::Crash(0)),
            (Side::Host(Host::Simulator), Mark::Crash(1)),
            (Side::Agent, Mark::Crash(0)),
        ] {
            put_status(&folder, side, 1, mark);
        }
        let pair = volume.round().0.workers[0].clone();
        assert_eq!((pair.crashes, pair.state), (2, WorkerState::Crashed));
    }

    #[test]
    fn a_plan_that_does_not_hold_is_refused() {
        let slice = |first, last| RouteSlice { first, last };
        for slices in [vec![], vec![slice(0, 2), slice(2, 3)], vec![slice(3, 0)]] {
            let run = run_of(slices);
            assert!(results_plan(&run).is_err(), "{:?}", run.plan);
        }
    }
}
