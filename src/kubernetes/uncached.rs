//! A watch without a cache: each object that is there, was added or changed is handed to a function, and nothing of it is kept.

use futures::StreamExt;
use kube::Api;
use kube::runtime::watcher::{Config, Event};

use super::item::{Item, Watchable};
use super::source;
use super::watch::PAGE;
use crate::observability::Observability;
use leaderboard_api::client_errors;

/// Hands on what is there and what comes, until the process stops. `name` is of the task, and of the watch in `/livez`. It holds up no
/// readiness: what is missing without it is for its reader to report.
pub fn spawn_uncached<K: Watchable>(
    name: &'static str,
    apis: Vec<Api<Item<K>>>,
    config: Config,
    telemetry: &Observability,
    mut take: impl FnMut(K) + Send + 'static,
) {
    let metrics = telemetry.metrics.watch(&K::kind(&()), &telemetry.clock);
    let of_namespace = |api: &Api<Item<K>>| match api.namespace() {
        Some(namespace) => telemetry.liveness.watch(&format!("{name} in {namespace}")),
        None => telemetry.liveness.watch(name),
    };
    let probes: Vec<_> = apis.iter().map(of_namespace).collect();
    let mut events = source::all(apis, &config.page_size(PAGE));
    // No API's events have an end; if one's end all the same, this task ends, and with it the process.
    telemetry.tasks.until_stop(name, async move {
        while let Some((source, event)) = events.next().await {
            let probe = &probes[source];
            match event {
                Ok(Event::Init) => probe.listing(),
                Ok(Event::InitDone) => probe.listed(),
                Ok(Event::Delete(_)) => probe.running(),
                Ok(Event::InitApply(item) | Event::Apply(item)) => {
                    metrics.event();
                    match item.object {
                        Ok(object) => take(object),
                        Err(malformed) => malformed.log(&K::kind(&())),
                    }
                }
                // Without news a watch stays where it was, until the server has forgotten that.
                Err(error) if source::is_forgotten(&error) => probe.running(),
                Err(error) => {
                    metrics.errors.inc();
                    source::report(probe, &error);
                    let cause = client_errors::watch(&error);
                    tracing::warn!(watch = name, error = cause, "a watch has failed and is retried");
                }
            }
        }
    });
}
