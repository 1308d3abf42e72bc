//! Where a resumed evaluation of V2 goes on: the original's `validate_and_resume`. Called by `evaluator`. Pure.

use crate::checkpoint::{CRASHED, Checkpoint};

/// The index of the first route to run; none if the file is not taken up. The ids of the routes that are done must be those of
/// this evaluation, and the route in which the simulation crashed is repeated.
pub fn first_route(saved: &Checkpoint, ids: &[String]) -> Option<usize> {
    let &[done, total] = saved.routes.progress.as_slice() else {
        return None;
    };
    if total != ids.len() || ["", "Invalid"].contains(&saved.entry_status.as_str()) {
        return None;
    }
    let (mut checked, mut start) = (0, done);
    while checked < start {
        match (ids.get(checked), saved.routes.records.get(checked)) {
            (Some(id), Some(record)) if *id != record.route_id => return None,
            (Some(_), Some(_)) => checked += 1,
            // More progress than records: the original goes one route further back.
            _ => start = checked.saturating_sub(1),
        }
    }
    let repeats = usize::from(saved.entry_status == CRASHED);
    Some(start.saturating_sub(repeats))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        flags::Format,
        scenario::{Leg, Outcome},
    };

    /// A file with records of the routes 0 to `records` - 1.
    fn saved(entry_status: &str, progress: [usize; 2], records: usize) -> Checkpoint {
        let mut file = Checkpoint::new(Format::V2, progress[1]);
        entry_status.clone_into(&mut file.entry_status);
        file.routes.progress = progress.to_vec();
        let outcome: Outcome = serde_json::from_str(
            r#"{"status": "Perfect", "score_route": 100, "route_length": 1.0, "duration_game": 1.0, "duration_system": 1.0}"#,
        )
        .unwrap();
        let record = |index| {
            let route = format!("{index}");
            let repetition = 0;
            outcome.record(
                Format::V2,
                &Leg {
                    index,
                    route,
                    repetition,
                },
            )
        };
        file.routes.records = (0..records).map(record).collect();
        file
    }

    #[test]
    fn progress_status_and_ids_decide_where_it_goes_on() {
        let ids = |first: usize| {
            (first..first + 4)
                .map(|id| format!("RouteScenario_{id}_rep0"))
                .collect::<Vec<_>>()
        };
        for (file, first, expected) in [
            (saved("Started", [0, 4], 0), 0, Some(0)),
            (saved("Started", [2, 4], 2), 0, Some(2)),
            (saved("Crashed", [2, 4], 2), 0, Some(1)),
            (saved("Crashed", [0, 4], 0), 0, Some(0)),
            (saved("Started", [3, 4], 4), 0, Some(3)),
            (saved("Rejected", [2, 4], 2), 0, Some(2)),
            (saved("Finished", [4, 4], 4), 0, Some(4)),
            (saved("Started", [3, 4], 2), 0, Some(1)),
            (saved("Started", [1, 4], 0), 0, Some(0)),
            (saved("Invalid", [4, 4], 4), 0, None),
            (saved("", [2, 4], 2), 0, None),
            (saved("Started", [2, 5], 2), 0, None),
            (saved("Started", [2, 4], 2), 4, None),
            // Routes that are not done are not compared.
            (saved("Started", [0, 4], 2), 4, Some(0)),
        ] {
            let found = first_route(&file, &ids(first));
            assert_eq!(found, expected, "{} {:?}", file.entry_status, file.routes.progress);
        }
    }
}
