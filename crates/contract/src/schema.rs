//! Which versions of the documents between the controller and its Pods are read: a run lasts days, and an upgrade of the operator
//! does not wait for it.
//!
//! `report`, `run`, the verdict of `workspace` and the owner's mark carry a number each. A field that an older reader can do without changes no number;
//! anything else does, and `golden/` keeps one file of each version that is read.

/// Whether a document of version `found` is read by a program that writes `own`: its own and the one before.
pub fn is_read(found: u32, own: u32) -> bool {
    found == own || found.checked_add(1) == Some(own)
}

#[cfg(test)]
mod tests {
    use serde::Serialize;
    use serde_json::Value;

    use super::*;
    use crate::report::{OWNER_SCHEMA, Owner, Report, ReportError, SCHEMA as REPORT_SCHEMA};
    use crate::run::{Run, SCHEMA as RUN_SCHEMA};
    use crate::verdict::{NotAVerdict, VERDICT_SCHEMA, WorkspaceReason, WorkspaceVerdict};
    use leaderboard_api::Attempt;

    const REPORT_1: &str = include_str!("golden/report-1.json");
    const RUN_1: &str = include_str!("golden/run-1.json");
    const WORKSPACE_0: &str = include_str!("golden/workspace-0.json");
    const WORKSPACE_1: &str = include_str!("golden/workspace-1.json");
    const OWNER_1: &str = include_str!("golden/owner-1.json");

    /// What is read from a document and written again is the document: nothing of it was lost, and nothing new is needed.
    fn assert_round_trip(golden: &str, read: &impl Serialize) {
        let golden: Value = serde_json::from_str(golden).unwrap();
        assert_eq!(serde_json::to_value(read).unwrap(), golden);
    }

    #[test]
    fn the_own_version_and_the_one_before_are_read() {
        for (found, own, expected) in [(1, 1, true), (1, 2, true), (1, 3, false), (2, 1, false), (0, 1, true)] {
            assert_eq!(is_read(found, own), expected, "{found} by {own}");
        }
        assert!(!is_read(u32::MAX, 0));
    }

    #[test]
    fn each_version_of_the_report_is_read() {
        assert_eq!(REPORT_SCHEMA, 1, "a new version needs a golden file of its own");
        let report = Report::parse(REPORT_1.as_bytes()).unwrap();
        assert!(report.belongs_to("uid-1", Attempt(1)) && report.is_final);
        assert_round_trip(REPORT_1, &report);
        let newer = REPORT_1.replacen("\"schema\": 1", "\"schema\": 2", 1);
        assert_eq!(Report::parse(newer.as_bytes()), Err(ReportError::Schema(2)));
    }

    #[test]
    fn each_version_of_the_run_is_read() {
        assert_eq!(RUN_SCHEMA, 1, "a new version needs a golden file of its own");
        let run: Run = serde_json::from_str(RUN_1).unwrap();
        assert!(is_read(run.schema, RUN_SCHEMA) && run.uid == "uid-1");
        assert_round_trip(RUN_1, &run);
    }

    #[test]
    fn each_version_of_the_verdict_of_workspace_is_read() {
        assert_eq!(VERDICT_SCHEMA, 1, "a new version needs a golden file of its own");
        let verdict = WorkspaceVerdict::parse(WORKSPACE_1).unwrap();
        assert_eq!(verdict.reason, WorkspaceReason::NotEnforced);
        assert_round_trip(WORKSPACE_1, &verdict);
        let old = WorkspaceVerdict::parse(WORKSPACE_0);
        assert_eq!(old, Ok(WorkspaceVerdict { schema: 0, ..verdict }));
        let newer = WORKSPACE_1.replacen("\"schema\": 1", "\"schema\": 2", 1);
        let newer = newer.replacen("NotEnforced", "OfTomorrow", 1);
        let error = WorkspaceVerdict::parse(&newer).unwrap_err();
        assert_eq!(error, NotAVerdict::Schema(2));
        assert_eq!(
            error.to_string(),
            "the verdict of `workspace` has schema 2, and 1 and the one before are read"
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
}
