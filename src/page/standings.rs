//! The ranking of one track: the best result of each team. Pure.

use kube::ResourceExt;
use leaderboard_api::{Leaderboard, Order, Standing, TrackStatus};
use serde::Serialize;

use super::rows::name;

/// Metrics of a result that are shown beside its score.
const METRICS: usize = 3;

/// The standings of one track.
#[derive(Serialize, Clone, Debug, PartialEq, Eq)]
pub(super) struct Table {
    namespace: String,
    leaderboard: String,
    track: String,
    /// Name of the metric that ranks; None before the first result.
    metric: Option<String>,
    /// A lower score is better.
    ascending: bool,
    /// Names of further metrics: those of the leader's result.
    metrics: Vec<String>,
    rows: Vec<Row>,
}

/// The best result of one team.
#[derive(Serialize, Clone, Debug, PartialEq, Eq)]
struct Row {
    rank: i32,
    /// None for a result without a team.
    team: Option<String>,
    /// Name of the submission.
    name: String,
    score: String,
    /// Values of the table's metrics, in their order; none where the result lacks one.
    values: Vec<Option<String>>,
    /// When it finished, in seconds since 1970.
    finished: Option<i64>,
}

/// One table for each track, in the order of the spec.
pub(super) fn tables(leaderboard: &Leaderboard) -> Vec<Table> {
    let status = leaderboard.status.as_ref();
    let tracks = leaderboard.spec.tracks.iter();
    let of = |name: &str| status.and_then(|status| status.tracks.iter().find(|track| track.name == name));
    tracks
        .map(|track| table(leaderboard, &track.name, of(&track.name)))
        .collect()
}

fn table(leaderboard: &Leaderboard, track: &str, status: Option<&TrackStatus>) -> Table {
    let ranking = status.and_then(|status| status.ranking.as_ref());
    let rows = status.map_or(&[][..], |status| &status.standings);
    let of_leader = rows.first().map_or(&[][..], |leader| &leader.metrics);
    let metrics: Vec<&str> = of_leader
        .iter()
        .take(METRICS)
        .map(|metric| metric.name.as_str())
        .collect();
    Table {
        namespace: leaderboard.namespace().unwrap_or_default(),
        leaderboard: leaderboard.name_any(),
        track: name(track),
        metric: ranking.map(|ranking| name(&ranking.metric)),
        ascending: ranking.is_some_and(|ranking| ranking.order == Order::Ascending),
        metrics: metrics.iter().map(|metric| name(metric)).collect(),
        rows: rows.iter().map(|row| Row::of(row, &metrics)).collect(),
    }
}

impl Row {
    fn of(standing: &Standing, metrics: &[&str]) -> Self {
        let value = |of: &&str| {
            standing
                .metrics
                .iter()
                .find(|metric| metric.name == *of)
                .map(|metric| name(&metric.value))
        };
        let has_team = !standing.team.is_empty();
        Self {
            rank: standing.rank,
            team: has_team.then(|| name(&standing.team)),
            name: name(&standing.submission),
            score: name(&standing.score.text),
            values: metrics.iter().map(value).collect(),
            finished: standing.finished_at.as_ref().map(|time| time.0.as_second()),
        }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::page::samples_tests as samples;

    #[test]
    fn each_track_has_a_table_in_the_order_of_the_spec() {
        let boards = samples::leaderboards();
        let busy = tables(&boards[0]);
        let tracks: Vec<_> = busy
            .iter()
            .map(|table| (table.track.as_str(), table.rows.len()))
            .collect();
        assert_eq!(tracks, [("sensors", 7), ("map", 3)]);
        let found = serde_json::to_value(&busy[0]).unwrap();
        assert_eq!(
            (&found["metric"], &found["ascending"]),
            (&json!("Driving score"), &json!(false))
        );
        let first = &found["rows"][0];
        assert_eq!((&first["rank"], &first["team"]), (&json!(1), &json!("Autobahn Labs")));
        assert_eq!(
            (&first["score"], &first["values"]),
            (&json!("68.05"), &json!(["94.21", "0.72"]))
        );
        assert_eq!(found["metrics"], json!(["Route completion", "Infraction penalty"]));
    }

    #[test]
    fn a_track_without_results_has_an_empty_table() {
        let new = samples::leaderboard("new", &json!({}), &json!({}));
        let found = tables(&new);
        assert_eq!((found.len(), found[0].rows.len(), &found[0].metric), (2, 0, &None));
    }

    #[test]
    fn a_lower_number_leads_where_the_ranking_is_ascending() {
        let status = json!({"tracks": [{
            "name": "sensors", "carla": {"pairs": 1, "routes": 1, "repetitions": 1},
            "ranking": {"metric": "Collisions", "order": "Ascending"},
            "standings": [{"rank": 1, "submission": "one", "score": {"name": "Collisions", "value": "3", "text": "3"}}],
        }]});
        let found = tables(&samples::leaderboard("new", &json!({}), &status));
        assert!(found[0].ascending);
        assert_eq!((&found[0].rows[0].team, found[0].rows[0].name.as_str()), (&None, "one"));
    }
}
