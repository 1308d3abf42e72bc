//! The field `job_name` of a row: EvalAI appends each name that it is sent, and the submission's participant can write anything into it.
//!
//! Called by `row`. Pure. What is kept is bounded while it is read, so that no row takes more memory than its text.

use std::collections::VecDeque;
use std::fmt;

use serde::de::{Deserializer, SeqAccess, Visitor};
use serde_json::value::RawValue;

/// Names that are kept, the last ones.
const MOST: usize = 256;
/// Bytes of the longest that is kept: no name of Kubernetes is longer.
const LONGEST: usize = 253;

/// The last names of the field, in lower case. Whatever is no list of texts has none.
pub(super) fn last_names(field: &RawValue) -> Vec<String> {
    let mut reader = serde_json::Deserializer::from_str(field.get());
    reader.deserialize_seq(LastNames).map(Vec::from).unwrap_or_default()
}

fn name(part: &RawValue) -> Option<String> {
    let name: String = serde_json::from_str(part.get()).ok()?;
    (name.len() <= LONGEST).then(|| name.to_lowercase())
}

struct LastNames;

impl<'de> Visitor<'de> for LastNames {
    type Value = VecDeque<String>;

    fn expecting(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str("a list")
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<Self::Value, A::Error> {
        let mut names = VecDeque::new();
        while let Some(part) = list.next_element::<&RawValue>()? {
            let Some(name) = name(part) else { continue };
            if names.len() == MOST {
                names.pop_front();
            }
            names.push_back(name);
        }
        Ok(names)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Vec<String> {
        last_names(serde_json::from_str(text).unwrap())
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
