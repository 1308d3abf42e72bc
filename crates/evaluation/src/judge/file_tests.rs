//! Checkpoints of an evaluator that was started again, and checkpoints that the node can't read.

use std::sync::Arc;

use leaderboard_protocol::files::{Mark, Side};
use nix::errno::Errno;

use super::tests::seen_on_a_volume::{Volume, text};
use super::*;
use crate::Results;
use crate::carla::gather::Gatherer;
use crate::fixtures::{checkpoint, put_checkpoint, put_status, run, run_of};
use leaderboard_api::RouteSlice;
use leaderboard_contract::keys::MERGED;
use leaderboard_contract::report::Outcome;
use leaderboard_evidence::Tree;

/// The file as a real evaluator of V2 writes it when it is started once more on it.
fn started_once_more(text: &str) -> String {
    let sensors = r#""sensors":["carla_camera","carla_gnss"]"#;
    assert!(text.contains(sensors));
    text.replacen(sensors, r#""sensors":[]"#, 1)
}

#[test]
fn a_complete_run_stays_complete_when_all_its_evaluators_are_started_once_more() {
    let mut volume = Volume::new();
    let files = [checkpoint(0, 2, 2), checkpoint(2, 2, 2)];
    for (pair, file) in (1..).zip(&files) {
        put_checkpoint(volume.folder.path(), pair, file);
    }
    let (before, _) = volume.round();
    for (pair, file) in (1..).zip(&files) {
        put_checkpoint(volume.folder.path(), pair, &started_once_more(file));
    }
    let (after, seen) = volume.round();
    assert_eq!(after.objects, before.objects, "what is stored is what was complete");
    assert_eq!(after.merged.as_ref().unwrap().outcome, Outcome::Finished);
    assert_eq!(
        (seen.complete, after.first_refused()),
        (Some(Duration::from_secs(10)), None)
    );

    // A logcopy that has begun after that finds nothing else.
    let tree = Arc::new(Tree::open(volume.folder.path()).unwrap());
    let gathered = Gatherer::new(&run(), tree).unwrap().round();
    let merged = gathered.merged.as_ref().unwrap();
    assert_eq!((merged.eligible, merged.outcome), (true, Outcome::Finished));
    let original = r#""entry_status": "Invalid""#;
    assert!(
        text(&gathered, MERGED).contains(original),
        "as the original merges these files"
    );
}

#[test]
fn one_pair_whose_evaluator_died_before_its_global_record_stays_complete() {
    let run = run_of(vec![RouteSlice { first: 0, last: 1 }]);
    let mut volume = Volume::new();
    let tree = Arc::new(Tree::open(volume.folder.path()).unwrap());
    volume.gatherer = Gatherer::new(&run, tree).unwrap();
    let whole = checkpoint(0, 2, 2);
    let died = whole
        .replacen(r#"{"index":-1,"status":"Completed"}"#, "{}", 1)
        .replacen(r#""entry_status":"Finished""#, r#""entry_status":"Started""#, 1);
    let sequence = [
        (checkpoint(0, 1, 2), false, false),
        (died.clone(), true, false),
        (started_once_more(&died), true, false),
        (started_once_more(&whole), true, true),
    ];
    for (file, is_whole, is_complete) in sequence {
        put_checkpoint(volume.folder.path(), 1, &file);
        let (gathered, seen) = volume.round();
        let merged = gathered.merged.as_ref().unwrap();
        assert_eq!((seen.whole, seen.complete.is_some()), (is_whole, is_complete), "{file}");
        assert_eq!(merged.eligible, is_whole, "{file}");
    }
}

/// A logcopy that reads the files of one pair, one after the other.
fn read_in_turn(last_route: u32, files: &[String]) -> Gathered {
    let run = run_of(vec![RouteSlice {
        first: 0,
        last: last_route,
    }]);
    let mut volume = Volume::new();
    let tree = Arc::new(Tree::open(volume.folder.path()).unwrap());
    volume.gatherer = Gatherer::new(&run, tree).unwrap();
    let rounds = files.iter().map(|file| {
        put_checkpoint(volume.folder.path(), 1, file);
        volume.round().0
    });
    rounds.last().unwrap()
}

#[test]
fn a_check_of_one_route_stays_complete() {
    let files = [checkpoint(0, 0, 1), checkpoint(0, 1, 1)];
    let before = read_in_turn(0, &files);
    let after = read_in_turn(0, &[&files[..], &[started_once_more(&files[1])]].concat());
    assert_eq!((after.is_complete(), after.objects), (true, before.objects));
    assert!(after.merged.unwrap().eligible);
}

#[test]
fn a_resumed_pair_whose_rest_fails_before_its_set_up_counts() {
    let rest_failed = started_once_more(&checkpoint(0, 2, 2));
    let at = rest_failed.rfind(r#""status":"Completed""#).unwrap();
    let failed = r#""status":"Failed - Agent couldn't be set up""#;
    let rest_failed = rest_failed[..at].to_owned() + &rest_failed[at..].replacen(r#""status":"Completed""#, failed, 1);
    let restored = checkpoint(0, 1, 2);
    for before in [
        vec![restored.clone(), started_once_more(&restored)],
        vec![started_once_more(&restored)],
    ] {
        let gathered = read_in_turn(1, &[before, vec![rest_failed.clone()]].concat());
        let merged = gathered.merged.unwrap();
        assert_eq!(
            (merged.is_complete, merged.eligible, merged.outcome),
            (true, true, Outcome::Finished)
        );
    }
}

#[test]
fn an_agent_that_names_no_sensors_from_its_beginning_does_not_count() {
    let files = [checkpoint(0, 0, 2), checkpoint(0, 1, 2), checkpoint(0, 2, 2)].map(|file| started_once_more(&file));
    let merged = read_in_turn(1, &files).merged.unwrap();
    assert_eq!(
        (merged.is_complete, merged.eligible, merged.outcome),
        (true, false, Outcome::Invalid)
    );
}

#[test]
fn a_later_checkpoint_with_fewer_routes_does_not_replace_the_one_before() {
    let mut volume = Volume::new();
    put_checkpoint(volume.folder.path(), 1, &checkpoint(0, 2, 2));
    volume.round();
    for done in [0, 1] {
        put_checkpoint(volume.folder.path(), 1, &checkpoint(0, done, 2));
        let (gathered, _) = volume.round();
        assert_eq!((gathered.workers[0].done, gathered.first_refused()), (2, None));
        assert_eq!(text(&gathered, "agent/agent1/agent_results.json"), checkpoint(0, 2, 2));
    }
    // As many as before are the evaluator's newest word, whole.
    let other = checkpoint(0, 2, 2)
        .replacen("100.0", "90.0", 1)
        .replacen("100.0", "90.0", 1);
    put_checkpoint(volume.folder.path(), 1, &other);
    assert_eq!(text(&volume.round().0, "agent/agent1/agent_results.json"), other);
}

#[test]
fn a_checkpoint_that_the_node_cannot_read_is_tried_again_and_spoils_nothing() {
    for trouble in [Errno::EMFILE, Errno::ENFILE, Errno::EIO, Errno::ENOMEM] {
        let mut volume = Volume::new();
        let tree = Arc::new(Tree::open(volume.folder.path()).unwrap());
        volume.gatherer = Gatherer::new(&run(), Arc::clone(&tree)).unwrap();
        put_checkpoint(volume.folder.path(), 1, &checkpoint(0, 2, 2));
        put_checkpoint(volume.folder.path(), 2, &checkpoint(2, 1, 2));
        volume.round();
        put_checkpoint(volume.folder.path(), 2, &checkpoint(2, 2, 2));
        for pair in [1, 2] {
            put_status(volume.folder.path(), Side::Agent, pair, Mark::Done);
        }
        *tree.disk.lock().unwrap() = Some(trouble);
        for _ in 0..2 {
            let (gathered, seen) = volume.round();
            assert_eq!((gathered.first_refused(), seen.spoiled), (None, None), "{trouble}");
            assert_eq!(gathered.workers[1].done, 1);
        }
        *tree.disk.lock().unwrap() = None;
        assert!(volume.round().0.is_complete(), "{trouble}");
    }
}

#[test]
fn a_checkpoint_that_its_agent_has_shut_is_the_agents() {
    // A lease on the file, too: its holder can take one again and again.
    for trouble in [Errno::EACCES, Errno::EPERM, Errno::EAGAIN, Errno::ELOOP] {
        let mut volume = Volume::new();
        let tree = Arc::new(Tree::open(volume.folder.path()).unwrap());
        volume.gatherer = Gatherer::new(&run(), Arc::clone(&tree)).unwrap();
        put_status(volume.folder.path(), Side::Agent, 1, Mark::Done);
        *tree.disk.lock().unwrap() = Some(trouble);
        let (gathered, seen) = volume.round();
        let refused = gathered.first_refused().unwrap();
        assert!(
            refused.why.starts_with("pair 1: the checkpoint can't be read: "),
            "{refused}"
        );
        assert_eq!(
            seen.spoiled,
            Some((Ending::Invalid(refused), Duration::ZERO)),
            "{trouble}"
        );
    }
}
