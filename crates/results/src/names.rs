//! The fixed names of both formats: infractions, metrics, statuses, sensors. Tables only; everything that writes or
//! judges a name takes it from here.

use crate::Format;

/// Infractions of V1.
const V1_INFRACTIONS: [&str; 9] = [
    "collisions_pedestrian",
    "collisions_vehicle",
    "collisions_layout",
    "red_light",
    "stop_infraction",
    "outside_route_lanes",
    "route_dev",
    "route_timeout",
    "vehicle_blocked",
];

/// Infractions of V2, in the order the file has them.
const V2_INFRACTIONS: [&str; 12] = [
    "collisions_layout",
    "collisions_pedestrian",
    "collisions_vehicle",
    "red_light",
    "stop_infraction",
    OFF_ROAD,
    "min_speed_infractions",
    "yield_emergency_vehicle_infractions",
    "scenario_timeouts",
    "route_dev",
    "vehicle_blocked",
    "route_timeout",
];

/// The one infraction whose messages carry a length.
pub(crate) const OFF_ROAD: &str = "outside_route_lanes";
/// The one infraction that can raise a score as well.
pub(crate) const MIN_SPEED: &str = "min_speed_infractions";

/// The infraction names of a format, in file order.
pub(crate) fn infractions(format: Format) -> &'static [&'static str] {
    match format {
        Format::V1 => &V1_INFRACTIONS,
        Format::V2 => &V2_INFRACTIONS,
    }
}

/// One of the three scores of a route.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Score {
    /// Driving score, 0 to 100.
    Composed,
    /// Route completion, 0 to 100 percent.
    Route,
    /// Infraction penalty, a factor.
    Penalty,
}

impl Score {
    /// All three, in the order the global record has them.
    pub(crate) const ALL: [Self; 3] = [Self::Composed, Self::Route, Self::Penalty];

    /// The key in a checkpoint.
    pub fn key(self) -> &'static str {
        match self {
            Self::Composed => "score_composed",
            Self::Route => "score_route",
            Self::Penalty => "score_penalty",
        }
    }
}

/// Where in the global record a metric comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Source {
    /// A mean score.
    Score(Score),
    /// An infraction, by its key.
    Infraction(&'static str),
}

/// One number of a finished run, under each of its names.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Metric {
    /// The exact text in EvalAI's result and on its leaderboard.
    pub name: &'static str,
    /// The column of the submissions table.
    pub column: &'static str,
    /// The text in the `labels` of a checkpoint.
    pub label: &'static str,
    /// Where in the global record it comes from.
    pub source: Source,
}

const fn metric(name: &'static str, column: &'static str, label: &'static str, source: Source) -> Metric {
    Metric {
        name,
        column,
        label,
        source,
    }
}

/// A metric whose label is its name.
const fn same(name: &'static str, column: &'static str, source: Source) -> Metric {
    metric(name, column, name, source)
}

/// In the order of EvalAI's files; V1 has the first twelve.
const METRICS: [Metric; 15] = {
    use Source::{Infraction as I, Score as S};
    [
        metric(
            "Driving score",
            "driving_score",
            "Avg. driving score",
            S(Score::Composed),
        ),
        metric(
            "Route completion",
            "route_completion",
            "Avg. route completion",
            S(Score::Route),
        ),
        metric(
            "Infraction penalty",
            "infraction_penalty",
            "Avg. infraction penalty",
            S(Score::Penalty),
        ),
        metric(
            "Collisions pedestrians",
            "collisions_pedestrians",
            "Collisions with pedestrians",
            I("collisions_pedestrian"),
        ),
        metric(
            "Collisions vehicles",
            "collisions_vehicles",
            "Collisions with vehicles",
            I("collisions_vehicle"),
        ),
        metric(
            "Collisions layout",
            "collisions_layout",
            "Collisions with layout",
            I("collisions_layout"),
        ),
        metric(
            "Red light infractions",
            "red_light_infractions",
            "Red lights infractions",
            I("red_light"),
        ),
        same("Stop sign infractions", "stop_sign_infractions", I("stop_infraction")),
        same("Off-road infractions", "off_road_infractions", I(OFF_ROAD)),
        same("Route deviations", "route_deviations", I("route_dev")),
        same("Route timeouts", "route_timeouts", I("route_timeout")),
        same("Agent blocked", "agent_blocked", I("vehicle_blocked")),
        metric(
            "Yield emergency vehicle infractions",
            "yield_emergency_vehicle_infractions",
            "Yield emergency vehicles infractions",
            I("yield_emergency_vehicle_infractions"),
        ),
        same("Scenario timeouts", "scenario_timeouts", I("scenario_timeouts")),
        same("Min speed infractions", "min_speed_infractions", I(MIN_SPEED)),
    ]
};

/// The metrics of a format, in the order of EvalAI's files: 12 in V1, 15 in V2.
pub fn metrics(format: Format) -> &'static [Metric] {
    match format {
        Format::V1 => METRICS.split_at(12).0,
        Format::V2 => &METRICS,
    }
}

/// The entry status of a file whose last route ended with a crashed simulator.
pub(crate) const CRASHED: &str = "Crashed";
/// The entry status of an evaluator that came to its end with results that count.
pub(crate) const FINISHED: &str = "Finished";
/// The entry status of a file that contradicts itself. An evaluator of V2 does not resume from it.
pub(crate) const INVALID: &str = "Invalid";
/// The entry status of a run whose agent asked for sensors it may not have.
pub(crate) const REJECTED: &str = "Rejected";
/// Part of the status of a route with a crashed simulator.
pub(crate) const SIMULATION_CRASHED: &str = "Simulation crashed";
/// Part of the status of a route with forbidden sensors.
pub(crate) const SENSORS_INVALID: &str = "Agent's sensors were invalid";
/// Part of the status of a route whose agent could not be set up.
pub(crate) const NOT_SET_UP: &str = "Agent couldn't be set up";
/// The status of a record that was never computed.
pub(crate) const STARTED: &str = "Started";
/// The status of a route whose end was reached, with infractions in V2.
pub(crate) const COMPLETED: &str = "Completed";
/// The status of a route driven without any infraction.
pub(crate) const PERFECT: &str = "Perfect";
/// The status, or the part of one, of a route whose end was not reached.
pub(crate) const FAILED: &str = "Failed";

const FAILURES: [&str; 8] = [
    "Failed",
    "Failed - Agent timed out",
    "Failed - Agent deviated from the route",
    "Failed - Agent got blocked",
    "Failed - Agent couldn't be set up",
    "Failed - Agent crashed",
    "Failed - Agent's sensors were invalid",
    "Failed - Simulation crashed",
];

/// True if an evaluator of this format writes the status. V2 judges an unfinished record itself, V1 can't, so only V2
/// knows `Started`.
pub(crate) fn is_known_status(format: Format, status: &str) -> bool {
    match status {
        COMPLETED => true,
        PERFECT | STARTED => format == Format::V2,
        _ => FAILURES.contains(&status),
    }
}

/// A sensor's name on EvalAI, or `None` for one that is not known.
pub(crate) fn sensor_name(icon: &str) -> Option<&'static str> {
    Some(match icon {
        "carla_camera" => "RGB Camera",
        "carla_lidar" => "LIDAR",
        "carla_radar" => "Radar",
        "carla_gnss" => "GNSS",
        "carla_imu" => "IMU",
        "carla_opendrive_map" => "OpenDrive Map",
        "carla_speedometer" => "Speedometer",
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_follow_from_the_names() {
        for metric in metrics(Format::V2) {
            assert_eq!(metric.column, metric.name.to_lowercase().replace([' ', '-'], "_"));
        }
        assert_eq!(metrics(Format::V1).len(), 12);
        assert_eq!(
            metrics(Format::V1).last().map(|metric| metric.name),
            Some("Agent blocked")
        );
    }

    #[test]
    fn every_metric_of_a_format_has_an_infraction_of_that_format() {
        for format in [Format::V1, Format::V2] {
            for metric in metrics(format) {
                if let Source::Infraction(key) = metric.source {
                    assert!(infractions(format).contains(&key), "{key}");
                }
            }
        }
    }

    #[test]
    fn statuses_belong_to_a_format() {
        assert!(is_known_status(Format::V2, "Perfect"));
        assert!(!is_known_status(Format::V1, "Perfect"));
        assert!(!is_known_status(Format::V1, "Started"));
        assert!(is_known_status(Format::V1, "Failed - Agent crashed"));
        assert!(!is_known_status(Format::V2, "Failed - <script>"));
    }
}
