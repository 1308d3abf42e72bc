//! Families of metrics: one metric for each set of values of their labels.

use std::borrow::Cow;

use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::metrics::histogram::Histogram;
use prometheus_client::registry::{Metric, Registry};

type Labels<const N: usize> = [(&'static str, Cow<'static, str>); N];

/// One metric for each set of values of `N` labels.
#[derive(Debug)]
pub struct Labeled<const N: usize, M> {
    names: [&'static str; N],
    family: Family<Labels<N>, M, fn() -> M>,
}

pub type Counters<const N: usize> = Labeled<N, Counter>;
pub type Gauges<const N: usize> = Labeled<N, Gauge>;
pub type Timings<const N: usize> = Labeled<N, Histogram>;

impl<const N: usize, M: Clone> Labeled<N, M> {
    /// The metric with these values; it begins at zero.
    pub fn of<V: Into<Cow<'static, str>>>(&self, values: [V; N]) -> M {
        self.family.get_or_create_owned(&self.labels(values))
    }

    /// Shows the metric with these values no more.
    pub fn remove<V: Into<Cow<'static, str>>>(&self, values: [V; N]) {
        self.family.remove(&self.labels(values));
    }

    /// Shows none.
    pub fn clear(&self) {
        self.family.clear();
    }

    fn labels<V: Into<Cow<'static, str>>>(&self, values: [V; N]) -> Labels<N> {
        let mut names = self.names.into_iter();
        values.map(|value| (names.next().unwrap_or_default(), value.into()))
    }
}

/// Registers families by name, labels and meaning.
pub(super) struct Families<'a>(pub(super) &'a mut Registry);

impl Families<'_> {
    pub(super) fn counters<const N: usize>(
        &mut self,
        name: &str,
        labels: [&'static str; N],
        help: &str,
    ) -> Counters<N> {
        self.family(name, labels, help, Counter::default)
    }

    pub(super) fn gauges<const N: usize>(&mut self, name: &str, labels: [&'static str; N], help: &str) -> Gauges<N> {
        self.family(name, labels, help, Gauge::default)
    }

    /// Histograms from 1 ms to two minutes: a reconcile may take 90 s, a request to EvalAI about 65 s.
    pub(super) fn timings<const N: usize>(&mut self, name: &str, labels: [&'static str; N], help: &str) -> Timings<N> {
        self.family(name, labels, help, || {
            Histogram::new([
                0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0, 120.0,
            ])
        })
    }

    /// Histograms from 1 s to two days: a full leaderboard runs for many hours.
    pub(super) fn hours<const N: usize>(&mut self, name: &str, labels: [&'static str; N], help: &str) -> Timings<N> {
        self.family(name, labels, help, || {
            Histogram::new([
                1.0, 5.0, 15.0, 60.0, 300.0, 900.0, 1800.0, 3600.0, 7200.0, 14400.0, 28800.0, 57600.0, 86400.0,
                172_800.0,
            ])
        })
    }

    /// A histogram from 100 ms to a day, without labels.
    pub(super) fn days(&mut self, name: &str, help: &str) -> Histogram {
        let days = Histogram::new([0.1, 0.5, 1.0, 5.0, 15.0, 60.0, 300.0, 900.0, 3600.0, 14400.0, 86400.0]);
        self.0.register(name, help, days.clone());
        days
    }

    fn family<const N: usize, M>(
        &mut self,
        name: &str,
        names: [&'static str; N],
        help: &str,
        new: fn() -> M,
    ) -> Labeled<N, M>
    where
        Family<Labels<N>, M, fn() -> M>: Metric,
    {
        let family = Family::new_with_constructor(new);
        self.0.register(name, help, family.clone());
        Labeled { names, family }
    }
}
