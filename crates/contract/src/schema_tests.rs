//! Tests of the documents between the controller and its Pods, against the files of `golden/`: a run lasts days, and an upgrade of the
//! operator does not wait for it.
//!
//! `report`, `run`, the verdict of `workspace`, the list of `collect` and the owner's mark carry a number each. A field that an older
//! reader can do without changes no number. Anything else does; the number before is then read too, and keeps its file.

use serde::Serialize;
use serde_json::Value;

use crate::collected::{Collected, SCHEMA as COLLECTED_SCHEMA};
use crate::report::{OWNER_SCHEMA, Owner, Report, ReportError, SCHEMA as REPORT_SCHEMA};
use crate::run::{Run, SCHEMA as RUN_SCHEMA};
use crate::verdict::{NotAVerdict, VERDICT_SCHEMA, WorkspaceReason, WorkspaceVerdict};
use leaderboard_api::Attempt;

const REPORT_1: &str = include_str!("golden/report-1.json");
const REPORT_1_CONTAINER: &str = include_str!("golden/report-1-container.json");
const RUN_1: &str = include_str!("golden/run-1.json");
const RUN_1_CONTAINER: &str = include_str!("golden/run-1-container.json");
const RUN_1_PREDICTIONS: &str = include_str!("golden/run-1-predictions.json");
const COLLECTED_1: &str = include_str!("golden/collected-1.json");
const WORKSPACE_1: &str = include_str!("golden/workspace-1.json");
const OWNER_1: &str = include_str!("golden/owner-1.json");

/// A document that is read and written again is unchanged: it lost no field, and needs no new one.
fn assert_round_trip(golden: &str, read: &impl Serialize) {
    let golden: Value = serde_json::from_str(golden).unwrap();
    assert_eq!(serde_json::to_value(read).unwrap(), golden);
}

#[test]
fn each_version_of_the_report_is_read() {
    assert_eq!(REPORT_SCHEMA, 1, "a new version needs a golden file of its own");
    let report = Report::parse(REPORT_1.as_bytes()).unwrap();
    assert!(report.belongs_to("uid-1", Attempt(1)) && report.is_final);
    assert_round_trip(REPORT_1, &report);
    let newer = REPORT_1.replacen("\"schema\": 1", "\"schema\": 2", 1);
    assert_eq!(Report::parse(newer.as_bytes()), Err(ReportError::Schema(2)));
    let report = Report::parse(REPORT_1_CONTAINER.as_bytes()).unwrap();
    assert_eq!(report.unusable.as_ref().and_then(|unusable| unusable.worker), Some(2));
    assert_round_trip(REPORT_1_CONTAINER, &report);
}

#[test]
fn each_version_of_the_run_is_read() {
    assert_eq!(RUN_SCHEMA, 1, "a new version needs a golden file of its own");
    let run: Run = serde_json::from_str(RUN_1).unwrap();
    assert!(run.schema == RUN_SCHEMA && run.uid == "uid-1" && run.plan.carla().is_some());
    assert_round_trip(RUN_1, &run);
    let run: Run = serde_json::from_str(RUN_1_CONTAINER).unwrap();
    assert!(run.plan.container().is_some() && run.plan.workers() == 2);
    assert_round_trip(RUN_1_CONTAINER, &run);
    let run: Run = serde_json::from_str(RUN_1_PREDICTIONS).unwrap();
    assert!(run.plan.image.is_none() && run.input.as_ref().is_some_and(|input| input.size == 5));
    assert_round_trip(RUN_1_PREDICTIONS, &run);
}

#[test]
fn each_version_of_the_list_of_collect_is_read() {
    assert_eq!(COLLECTED_SCHEMA, 1, "a new version needs a golden file of its own");
    let list = Collected::parse(COLLECTED_1.as_bytes()).unwrap();
    assert_eq!((list.files.len(), list.bytes()), (2, 5));
    assert_round_trip(COLLECTED_1, &list);
    assert_eq!(Collected::parse(&list.to_json()), Some(list));
    let newer = COLLECTED_1.replacen("\"schema\": 1", "\"schema\": 2", 1);
    for unknown in [newer.as_str(), "{\"schema\": 1", "{}"] {
        assert_eq!(Collected::parse(unknown.as_bytes()), None, "{unknown}");
    }
}

#[test]
fn each_version_of_the_verdict_of_workspace_is_read() {
    assert_eq!(VERDICT_SCHEMA, 1, "a new version needs a golden file of its own");
    let verdict = WorkspaceVerdict::parse(WORKSPACE_1).unwrap();
    assert_eq!(verdict.reason, WorkspaceReason::NotEnforced);
    assert_round_trip(WORKSPACE_1, &verdict);
    let newer = WORKSPACE_1.replacen("\"schema\": 1", "\"schema\": 2", 1);
    let newer = newer.replacen("NotEnforced", "OfTomorrow", 1);
    let error = WorkspaceVerdict::parse(&newer).unwrap_err();
    assert_eq!(error, NotAVerdict::Schema(2));
    assert_eq!(
        error.to_string(),
        "the verdict of `workspace` has schema 2, and this operator reads 1"
    );
}

#[test]
fn each_version_of_the_owners_mark_is_read() {
    assert_eq!(OWNER_SCHEMA, 1, "a new version needs a golden file of its own");
    let owner = Owner::parse(OWNER_1.as_bytes()).unwrap();
    assert_eq!(owner, Owner::new("pod-1"));
    assert_round_trip(OWNER_1, &owner);
    assert_eq!(Owner::parse(&owner.to_json()), Some(owner));
    for unknown in ["{\"schema\": 2, \"owner\": \"pod-1\"}", "{\"schema\": 1", "{}"] {
        assert_eq!(Owner::parse(unknown.as_bytes()), None, "{unknown}");
    }
}
