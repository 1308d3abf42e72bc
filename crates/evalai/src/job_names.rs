//! The field `job_name` of a row: EvalAI appends each name that it is sent, and the submission's participant can write anything into it.
//!
//! Called by `row`. Pure. What is kept is bounded while it is read, so that no row takes more memory than its text.

use std::collections::VecDeque;
use std::fmt;

use serde::de::{Deserialize, Deserializer, IgnoredAny, MapAccess, SeqAccess, Visitor};

/// Names that are kept, the last ones.
const MOST: usize = 256;
/// Bytes of the longest that is kept: no name of Kubernetes is longer.
const LONGEST: usize = 253;

/// The last names, in lower case. Whatever is no list of texts has none.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct JobNames(VecDeque<String>);

impl From<JobNames> for Vec<String> {
    fn from(names: JobNames) -> Self {
        names.0.into()
    }
}

impl<'de> Deserialize<'de> for JobNames {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let names = match Part::deserialize(deserializer)? {
            Part::List(names) => names,
            Part::Name(_) | Part::Other => VecDeque::new(),
        };
        Ok(Self(names))
    }
}

/// A value, as far as it matters here.
enum Part {
    Name(String),
    List(VecDeque<String>),
    Other,
}

impl<'de> Deserialize<'de> for Part {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(AnyPart)
    }
}

struct AnyPart;

impl<'de> Visitor<'de> for AnyPart {
    type Value = Part;

    fn expecting(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str("any value")
    }

    fn visit_str<E>(self, text: &str) -> Result<Part, E> {
        let is_kept = text.len() <= LONGEST;
        Ok(if is_kept {
            Part::Name(text.to_lowercase())
        } else {
            Part::Other
        })
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<Part, A::Error> {
        let mut names = VecDeque::new();
        while let Some(part) = list.next_element()? {
            let Part::Name(name) = part else { continue };
            if names.len() == MOST {
                names.pop_front();
            }
            names.push_back(name);
        }
        Ok(Part::List(names))
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Part, A::Error> {
        while map.next_entry::<IgnoredAny, IgnoredAny>()?.is_some() {}
        Ok(Part::Other)
    }

    fn visit_unit<E>(self) -> Result<Part, E> {
        Ok(Part::Other)
    }

    fn visit_bool<E>(self, _: bool) -> Result<Part, E> {
        Ok(Part::Other)
    }

    fn visit_i64<E>(self, _: i64) -> Result<Part, E> {
        Ok(Part::Other)
    }

    fn visit_u64<E>(self, _: u64) -> Result<Part, E> {
        Ok(Part::Other)
    }

    fn visit_f64<E>(self, _: f64) -> Result<Part, E> {
        Ok(Part::Other)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Vec<String> {
        serde_json::from_str::<JobNames>(text).unwrap().into()
    }

    #[test]
    fn names_are_read_in_lower_case_and_whatever_else_stands_there_is_none() {
        assert_eq!(read(r#"["Submission-7-1", "b"]"#), ["submission-7-1", "b"]);
        assert_eq!(read(r#"[null, 1, -1, 0.5, true, {"a": ["b"]}, ["c"], "d"]"#), ["d"]);
        for odd in [r#""a""#, "null", "1", "-1", "0.5", "true", r#"{"a": ["b"]}"#, "[]"] {
            assert_eq!(read(odd), [""; 0], "{odd}");
        }
    }

    #[test]
    fn what_a_participant_fills_it_with_is_not_kept_and_hides_no_later_name() {
        let (many, long) = (r#""x","#.repeat(100_000), "y".repeat(1 << 20));
        let names = read(&format!(r#"[{many}"{long}","Submission-7-2"]"#));
        assert_eq!((names.len(), names.last().unwrap().as_str()), (MOST, "submission-7-2"));
        assert_eq!(names[0], "x");
    }
}
