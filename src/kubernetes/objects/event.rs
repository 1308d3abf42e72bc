//! An event as it is read: what it reports, of which object, and when.

use jiff::Timestamp;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;
use kube::core::NamespaceResourceScope;
use serde::Deserialize;

use super::meta::Meta;
use super::texts::{Texts, cut};
use super::watchable;

/// Part of an event that is read.
#[derive(Deserialize, Clone, Debug, Default, PartialEq)]
#[serde(rename_all = "camelCase", default)]
pub struct Event {
    pub metadata: Meta,
    pub involved_object: Involved,
    pub reason: Option<Box<str>>,
    #[serde(deserialize_with = "cut")]
    pub message: Option<Box<str>>,
    source: Source,
    reporting_component: Option<Box<str>>,
    first_timestamp: Option<Time>,
    last_timestamp: Option<Time>,
    #[serde(rename = "eventTime")]
    time: Option<Time>,
    series: Option<Series>,
}

/// The object that an event is about.
#[derive(Deserialize, Clone, Debug, Default, PartialEq)]
#[serde(default)]
pub struct Involved {
    pub kind: Box<str>,
    pub namespace: Box<str>,
    pub name: Box<str>,
    pub uid: Box<str>,
}

#[derive(Deserialize, Clone, Debug, Default, PartialEq)]
#[serde(default)]
struct Source {
    component: Option<Box<str>>,
}

#[derive(Deserialize, Clone, Debug, Default, PartialEq)]
#[serde(rename_all = "camelCase", default)]
struct Series {
    last_observed_time: Option<Time>,
}

impl Event {
    /// The programs that it names as its source: the older field and the newer one.
    pub fn sources(&self) -> impl Iterator<Item = &str> {
        let names = [&self.source.component, &self.reporting_component];
        names.into_iter().flatten().map(AsRef::as_ref)
    }

    /// When it was last seen.
    pub fn at(&self) -> Option<Timestamp> {
        let repeated = self
            .series
            .as_ref()
            .and_then(|series| series.last_observed_time.as_ref());
        let times = [
            self.last_timestamp.as_ref(),
            self.first_timestamp.as_ref(),
            repeated,
            self.time.as_ref(),
        ];
        times.into_iter().flatten().next().map(|time| time.0)
    }

    fn share_texts(&mut self, texts: &mut Texts) {
        self.metadata.share_texts(texts);
    }
}

watchable!(Event, NamespaceResourceScope, "Event", "", "v1", "events");

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    #[test]
    fn an_event_has_the_time_that_its_writer_gives_it() {
        let at = |fields: Value| {
            let mut event = json!({"metadata": {"name": "e"}, "involvedObject": {"kind": "Job"}, "eventTime": null,
                "firstTimestamp": null, "lastTimestamp": null, "source": {}});
            event
                .as_object_mut()
                .unwrap()
                .extend(fields.as_object().unwrap().clone());
            let event: Event = serde_json::from_value(event).unwrap();
            event.at().map(|at| at.to_string())
        };
        let time = |second: u8| format!("2026-01-01T00:00:0{second}Z");
        for (fields, expected) in [
            (json!({}), None),
            (
                json!({"firstTimestamp": time(1), "lastTimestamp": time(2)}),
                Some(time(2)),
            ),
            (json!({"firstTimestamp": time(1)}), Some(time(1))),
            (json!({"eventTime": "2026-01-01T00:00:03.000000Z"}), Some(time(3))),
            (
                json!({"eventTime": time(3), "series": {"count": 2, "lastObservedTime": time(4)}}),
                Some(time(4)),
            ),
        ] {
            assert_eq!(at(fields.clone()), expected, "{fields}");
        }
    }
}
