//! The knobs: delays, a dead queue, and requests that fail on purpose. Set by the control plane, read by `server` and
//! the handlers. Pure.

use std::time::Duration;

use serde::{Deserialize, Deserializer, Serialize, Serializer, de};

/// How a request fails.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Failure {
    /// This status, with the body EvalAI or the proxy in front of it has for it.
    Status(u16),
    /// EvalAI's page for an unhandled exception.
    Html500,
    /// No answer for as long as the client waits.
    Hang,
    /// The connection is closed without an answer.
    Close,
}

impl Serialize for Failure {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            Self::Status(status) => serializer.serialize_u16(*status),
            Self::Html500 => serializer.serialize_str("html500"),
            Self::Hang => serializer.serialize_str("hang"),
            Self::Close => serializer.serialize_str("close"),
        }
    }
}

impl<'de> Deserialize<'de> for Failure {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        #[derive(Deserialize)]
        #[serde(untagged)]
        enum Raw {
            Number(u16),
            Text(String),
        }
        match Raw::deserialize(deserializer)? {
            Raw::Number(status) if (100..=599).contains(&status) => Ok(Self::Status(status)),
            Raw::Text(text) if text == "html500" => Ok(Self::Html500),
            Raw::Text(text) if text == "hang" => Ok(Self::Hang),
            Raw::Text(text) if text == "close" => Ok(Self::Close),
            Raw::Text(text) if text == "429" => Ok(Self::Status(429)),
            _ => Err(de::Error::custom(
                "answer: a status from 100 to 599, or \"html500\", \"hang\", \"close\"",
            )),
        }
    }
}

/// Before or after the server has done what was asked.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum When {
    /// Nothing is done.
    #[default]
    Before,
    /// Everything is done, and the client gets no answer.
    After,
}

/// Requests that will fail.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Fault {
    /// Only requests of this method.
    #[serde(default)]
    pub method: Option<String>,
    /// Only requests whose path starts so.
    #[serde(default)]
    pub path_prefix: Option<String>,
    /// How they fail.
    pub answer: Failure,
    /// How many of them.
    #[serde(default = "once")]
    pub times: u32,
    /// Before or after the work is done.
    #[serde(default)]
    pub when: When,
}

impl Fault {
    fn hits(&self, method: &str, path: &str) -> bool {
        self.times > 0
            && self
                .method
                .as_ref()
                .is_none_or(|wanted| wanted.eq_ignore_ascii_case(method))
            && self
                .path_prefix
                .as_ref()
                .is_none_or(|prefix| path.starts_with(prefix.as_str()))
    }
}

/// All knobs. Unless a test sets others, the times are those of the real server.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Knobs {
    /// Before the reads of a PUT of results, in milliseconds; one PUT after the other.
    pub put_turn_ms: u64,
    /// Between the reads and the saves of a PUT of results, in milliseconds.
    pub put_delay_ms: u64,
    /// A PUT of final results waits between its reads and its saves until this is false again.
    pub put_held: bool,
    /// Between the reads and the saves of a PATCH of progress, in milliseconds.
    pub patch_delay_ms: u64,
    /// Between the read of a list and its answer, in milliseconds.
    pub list_delay_ms: u64,
    /// Further delay of the answer for each row of the list, in milliseconds.
    pub list_row_ms: u64,
    /// How long a connection without a request is kept open, in milliseconds.
    pub keep_alive_ms: u64,
    /// A request on a connection that has been idle for so many milliseconds finds it closed: there is no answer, and
    /// nothing is done. Absent: none does.
    pub close_reused_ms: Option<u64>,
    /// The queue does not answer.
    pub queue_down: bool,
    /// Requests per user and minute; 0 is no limit. Absent: as the program was started.
    pub throttle: Option<usize>,
    /// The next faults, in this order.
    pub fail_next: Vec<Fault>,
}

impl Default for Knobs {
    fn default() -> Self {
        Self {
            // More than one turn and less than two fit into the time between read and save. So of six results at once
            // two read before any was saved, one reads one row, and the others read two.
            put_turn_ms: 25,
            put_delay_ms: 40,
            put_held: false,
            patch_delay_ms: 40,
            list_delay_ms: 0,
            list_row_ms: 10,
            // The load balancer's in front of EvalAI.
            keep_alive_ms: 60_000,
            close_reused_ms: None,
            queue_down: false,
            throttle: None,
            fail_next: Vec::new(),
        }
    }
}

/// The longest delay.
const LONGEST_MS: u64 = 20_000;

impl Knobs {
    /// The knobs with what `change` names changed. `fail_next` is replaced, not added to.
    pub fn changed(&self, change: &serde_json::Map<String, serde_json::Value>) -> Result<Self, String> {
        let serde_json::Value::Object(mut all) = serde_json::json!(self) else {
            return Ok(self.clone());
        };
        all.extend(change.clone());
        let knobs: Self = serde_json::from_value(serde_json::Value::Object(all)).map_err(|error| error.to_string())?;
        let delays = [
            knobs.put_turn_ms,
            knobs.put_delay_ms,
            knobs.patch_delay_ms,
            knobs.list_delay_ms,
            knobs.list_row_ms,
        ];
        if delays.iter().any(|delay| *delay > LONGEST_MS) {
            return Err(format!("a delay is at most {LONGEST_MS} ms"));
        }
        Ok(knobs)
    }

    /// Takes the first fault that fits a request. `reused_after` is how long its connection was idle before.
    pub fn take(&mut self, method: &str, path: &str, reused_after: Option<Duration>) -> Option<Fault> {
        let closing = self.close_reused_ms.map(Duration::from_millis);
        if closing.is_some_and(|closing| reused_after.is_some_and(|idle| idle >= closing)) {
            return Some(Fault {
                method: None,
                path_prefix: None,
                answer: Failure::Close,
                times: 1,
                when: When::Before,
            });
        }
        let fault = self.fail_next.iter_mut().find(|fault| fault.hits(method, path))?;
        fault.times -= 1;
        let taken = fault.clone();
        self.fail_next.retain(|fault| fault.times > 0);
        Some(taken)
    }
}

fn once() -> u32 {
    1
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn set(change: &serde_json::Value) -> Result<Knobs, String> {
        Knobs::default().changed(change.as_object().unwrap())
    }

    #[test]
    fn faults_hit_what_they_name_as_often_as_they_should() {
        let faults = json!({"fail_next": [
            {"method": "PUT", "path_prefix": "/api/jobs/", "answer": 503, "times": 2},
            {"answer": "close", "when": "after"},
        ]});
        let mut knobs = set(&faults).unwrap();
        let mut hit = |method, path| knobs.take(method, path, None).map(|fault| (fault.answer, fault.when));
        assert_eq!(hit("PUT", "/api/jobs/x"), Some((Failure::Status(503), When::Before)));
        assert_eq!(hit("GET", "/api/jobs/x"), Some((Failure::Close, When::After)));
        assert_eq!(hit("GET", "/api/jobs/x"), None);
        assert_eq!(hit("PUT", "/api/jobs/x"), Some((Failure::Status(503), When::Before)));
        assert_eq!(hit("PUT", "/api/jobs/x"), None);
    }

    #[test]
    fn a_connection_that_was_idle_for_too_long_is_closed_under_its_request() {
        let mut knobs = set(&json!({"close_reused_ms": 2_000})).unwrap();
        let mut hit = |idle: Option<u64>| {
            let fault = knobs.take("PATCH", "/", idle.map(Duration::from_millis));
            fault.map(|fault| (fault.answer, fault.when))
        };
        assert_eq!(hit(None), None, "a new connection");
        assert_eq!(hit(Some(1_999)), None);
        assert_eq!(hit(Some(2_000)), Some((Failure::Close, When::Before)));
        assert_eq!(hit(Some(2_000)), Some((Failure::Close, When::Before)), "each time");
    }

    #[test]
    fn wrong_knobs_are_refused_with_a_reason() {
        for (change, reason) in [
            (json!({"put_delay_ms": 20_001}), "at most 20000"),
            (json!({"put_delay": 1}), "unknown field"),
            (json!({"fail_next": [{"answer": "explode"}]}), "html500"),
        ] {
            let error = set(&change).unwrap_err();
            assert!(error.contains(reason), "{change}: {error}");
        }
        assert_eq!(set(&json!({"list_delay_ms": 5})).unwrap().list_delay_ms, 5);
    }
}
