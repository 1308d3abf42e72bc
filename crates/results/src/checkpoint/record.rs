//! One route record: its JSON kept whole, and next to it, typed, what the statistics need. Built by the checkpoint reader
//! only, so anyone who holds a record holds numbers and counts.

use crate::json::{Object, Value};
use crate::names::{self, OFF_ROAD, SIMULATION_CRASHED, Score};
use crate::number::Number;
use crate::{Format, RecordName, RecordProblem};

/// No evaluator has ids or repetitions beyond this.
const MAX_ID: i64 = 1_000_000_000;

/// The three scores of a record, or their means or deviations over several.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Scores {
    pub(crate) route: Number,
    pub(crate) penalty: Number,
    pub(crate) composed: Number,
}

impl Scores {
    pub(crate) fn each(of: impl Fn(Score) -> Number) -> Self {
        Self {
            route: of(Score::Route),
            penalty: of(Score::Penalty),
            composed: of(Score::Composed),
        }
    }

    pub(crate) fn get(&self, score: Score) -> Number {
        match score {
            Score::Route => self.route,
            Score::Penalty => self.penalty,
            Score::Composed => self.composed,
        }
    }
}

/// Length in meters, durations in seconds, of a record or of several; -1 where nothing was measured.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Meta {
    pub(crate) length: Number,
    pub(crate) game: Number,
    pub(crate) system: Number,
}

impl Meta {
    pub(crate) const ZERO: Self = Self {
        length: Number::ZERO,
        game: Number::ZERO,
        system: Number::ZERO,
    };
}

/// A route record.
#[derive(Clone, Debug)]
pub(crate) struct Record {
    /// As it was read; unknown keys survive the merge.
    pub(crate) object: Object,
    pub(crate) name: RecordName,
    pub(crate) route_id: String,
    /// The number of the route, and of the repetition (0 in V1).
    pub(crate) key: (i64, i64),
    pub(crate) status: String,
    /// How many of each infraction, in the order of [`names::infractions`].
    pub(crate) counts: Vec<usize>,
    /// Meters off the road; only V2 uses it.
    pub(crate) off_road: f64,
    pub(crate) scores: Scores,
    pub(crate) meta: Meta,
}

type Problem = (RecordName, RecordProblem);

impl Record {
    /// True if its status says that the simulation crashed.
    pub(crate) fn names_crash(&self) -> bool {
        self.status.contains(SIMULATION_CRASHED)
    }

    /// `place`: where in the file, from 1.
    pub(crate) fn of(format: Format, place: usize, value: Value) -> Result<Self, Problem> {
        let unnamed = |problem| (RecordName::Place(place), problem);
        let Value::Object(object) = value else {
            return Err(unnamed(RecordProblem::NotAnObject));
        };
        let route_id = object.get("route_id").and_then(Value::as_str);
        let route_id = route_id.ok_or_else(|| unnamed(shape("route_id", "a text")))?;
        let repetition = format == Format::V2;
        let key = route_key(format, route_id);
        let key = key.ok_or_else(|| unnamed(RecordProblem::RouteId { repetition }))?;
        let name = name(format, place, route_id, key);
        let named = |problem| (name.clone(), problem);

        let status = status(format, &object).map_err(named)?.to_owned();
        let (counts, off_road) = infractions(format, &object).map_err(named)?;
        let scores = scores(&object).map_err(named)?;
        let meta = meta(format, &object).map_err(named)?;
        Ok(Self {
            route_id: route_id.to_owned(),
            key,
            status,
            counts,
            off_road,
            scores,
            meta,
            name,
            object,
        })
    }

    /// True if an agent was set up for it: its evaluator has named the sensors then.
    pub(crate) fn was_begun(&self) -> bool {
        let is_before = |what: &&str| self.status.contains(what);
        ![
            names::NOT_SET_UP,
            names::SENSORS_INVALID,
            names::SIMULATION_CRASHED,
            names::STARTED,
        ]
        .iter()
        .any(is_before)
    }
}

/// The numbers in `RouteScenario_<id>` (V1) and `RouteScenario_<id>_rep<k>` (V2), as leniently as the original finds them:
/// behind the first `_` and behind the last `_rep`.
fn route_key(format: Format, route_id: &str) -> Option<(i64, i64)> {
    let id = integer(route_id.split('_').nth(1)?)?;
    match format {
        Format::V1 => Some((id, 0)),
        Format::V2 => Some((id, integer(route_id.rsplit("_rep").next()?)?)),
    }
}

fn integer(text: &str) -> Option<i64> {
    text.trim().parse().ok().filter(|n| (-MAX_ID..=MAX_ID).contains(n))
}

fn name(format: Format, place: usize, route_id: &str, (id, repetition): (i64, i64)) -> RecordName {
    let (usual, repetition) = match format {
        Format::V1 => (format!("RouteScenario_{id}"), None),
        Format::V2 => (format!("RouteScenario_{id}_rep{repetition}"), Some(repetition)),
    };
    if usual == route_id {
        RecordName::Route { id, repetition }
    } else {
        RecordName::Place(place)
    }
}

fn shape(key: &'static str, wanted: &'static str) -> RecordProblem {
    RecordProblem::Shape { key, wanted }
}

fn status(format: Format, object: &Object) -> Result<&str, RecordProblem> {
    match object.get("status") {
        None if format == Format::V2 => Ok(names::STARTED),
        value => value.and_then(Value::as_str).ok_or(shape("status", "a text")),
    }
}

fn infractions(format: Format, object: &Object) -> Result<(Vec<usize>, f64), RecordProblem> {
    let known = names::infractions(format);
    let Some(value) = object.get("infractions") else {
        return Ok((vec![0; known.len()], 0.0));
    };
    let all = value.as_object().ok_or(shape("infractions", "an object"))?;
    let mut counts = Vec::with_capacity(known.len());
    for key in known {
        let messages = all.get(key).and_then(Value::as_list);
        counts.push(messages.ok_or(shape(key, "a list of messages"))?.len());
    }
    let off_road = match format {
        Format::V1 => 0.0,
        Format::V2 => off_road(all)?,
    };
    Ok((counts, off_road))
}

/// The ninth word of the first message is the distance in meters; later messages do not count.
fn off_road(infractions: &Object) -> Result<f64, RecordProblem> {
    let Some(first) = infractions
        .get(OFF_ROAD)
        .and_then(Value::as_list)
        .and_then(<[Value]>::first)
    else {
        return Ok(0.0);
    };
    first
        .as_str()
        .and_then(|message| message.split(' ').nth(8))
        .and_then(|word| word.trim().parse().ok())
        .ok_or(RecordProblem::OffRoadMessage)
}

fn scores(object: &Object) -> Result<Scores, RecordProblem> {
    let Some(value) = object.get("scores") else {
        return Ok(Scores::each(|_| Number::ZERO));
    };
    let all = value.as_object().ok_or(shape("scores", "an object"))?;
    Ok(Scores {
        route: number(all, Score::Route.key())?,
        penalty: number(all, Score::Penalty.key())?,
        composed: number(all, Score::Composed.key())?,
    })
}

fn meta(format: Format, object: &Object) -> Result<Meta, RecordProblem> {
    let Some(value) = object.get("meta") else {
        return match format {
            Format::V1 => Err(shape("meta", "an object")),
            Format::V2 => Ok(Meta::ZERO),
        };
    };
    let all = value.as_object().ok_or(shape("meta", "an object"))?;
    Ok(Meta {
        length: number(all, "route_length")?,
        game: number(all, "duration_game")?,
        system: number(all, "duration_system")?,
    })
}

fn number(object: &Object, key: &'static str) -> Result<Number, RecordProblem> {
    object.get(key).and_then(Number::of).ok_or(shape(key, "a number"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn route_ids_are_read_as_the_original_reads_them() {
        for (id, v1, v2) in [
            ("RouteScenario_7", Some((7, 0)), None),
            ("RouteScenario_7_rep2", Some((7, 0)), Some((7, 2))),
            ("x_-3_rep_rep4", Some((-3, 0)), Some((-3, 4))),
            ("RouteScenario_x1_rep0", None, None),
            ("RouteScenario", None, None),
            ("RouteScenario_7_rep", Some((7, 0)), None),
            ("RouteScenario_99999999999_rep0", None, None),
            ("", None, None),
        ] {
            assert_eq!(route_key(Format::V1, id), v1, "{id}");
            assert_eq!(route_key(Format::V2, id), v2, "{id}");
        }
    }

    #[test]
    fn only_usual_ids_are_repeated_in_messages() {
        assert_eq!(
            name(Format::V2, 3, "RouteScenario_7_rep0", (7, 0)).to_string(),
            "route RouteScenario_7_rep0"
        );
        assert_eq!(name(Format::V2, 3, "<b>_7_rep0", (7, 0)).to_string(), "record 3");
        assert_eq!(name(Format::V1, 1, "RouteScenario_07", (7, 0)).to_string(), "record 1");
    }
}
