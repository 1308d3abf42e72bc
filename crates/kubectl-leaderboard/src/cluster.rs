//! The API server: found as kubectl finds it, and the few requests that the plugin sends. It never reads a Secret.
//!
//! Called by `main`; decides nothing.

use std::collections::BTreeMap;
use std::fmt::Debug;
use std::future::Future;
use std::path::PathBuf;
use std::time::Duration;

use clap::Args;
use clap::builder::PossibleValuesParser;
use futures::{Stream, StreamExt, TryFutureExt, TryStreamExt};
use k8s_openapi::api::core::v1::Pod;
use k8s_openapi::api::events::v1::Event;
use kube::api::{DeleteParams, ListParams, LogParams, PartialObjectMeta, Patch, PatchParams, PostParams};
use kube::config::{KubeConfigOptions, Kubeconfig, KubeconfigError};
use kube::core::NamespaceResourceScope;
use kube::runtime::WatchStreamExt;
use kube::runtime::watcher::{self, watch_object};
use kube::{Api, Client, Config, Resource, ResourceExt};
use serde::de::DeserializeOwned;
use serde_json::Value;

use super::board::Observed;
use super::error::{Error, no_leaderboards, of_kubeconfig, of_log};
use super::help::GLOBAL;
use super::{facts, lines, near};
use leaderboard_api::names::LABEL_SUBMISSION;
use leaderboard_api::standings::track_of;
use leaderboard_api::{Leaderboard, State, Submission};

/// Field manager of what people change.
const MANAGER: &str = "kubectl-leaderboard";
/// Objects of one answer, as kubectl asks for them.
const PAGE: u32 = 500;
/// Longest time one request may take.
const LIMIT: Duration = Duration::from_secs(30);

/// Which cluster and namespace: the same flags as kubectl's.
#[derive(Args, Debug, Default)]
pub struct Target {
    /// Kubeconfig file [default: $KUBECONFIG, else ~/.kube/config].
    #[arg(long, global = true, value_name = "FILE", help_heading = GLOBAL)]
    kubeconfig: Option<PathBuf>,
    /// Context of the kubeconfig [default: the current one].
    #[arg(long, global = true, help_heading = GLOBAL)]
    context: Option<String>,
    /// Namespace [default: the context's].
    #[arg(short, long, global = true, help_heading = GLOBAL)]
    pub namespace: Option<String>,
}

/// Which submissions of which namespaces.
#[derive(Args, Clone, Debug, Default)]
pub struct Scope {
    /// All namespaces.
    #[arg(short = 'A', long)]
    pub all_namespaces: bool,
    /// Only objects with these labels, such as `leaderboard.carla.org/phase=7`.
    #[arg(short = 'l', long, value_name = "LABELS")]
    pub selector: Option<String>,
    /// Only these states, such as Pending,Failed.
    #[arg(long, value_name = "STATES", value_delimiter = ',', ignore_case = true, value_parser = PossibleValuesParser::new(STATES), hide_possible_values = true)]
    pub state: Vec<String>,
    #[command(flatten)]
    pub filter: Filter,
}

/// All states of a submission.
const STATES: [&str; 6] = ["Pending", "Running", "Resumed", "Finished", "Failed", "Cancelled"];

/// Limits a list of submissions to a Leaderboard, a track and a team.
#[derive(Args, Clone, Debug, Default, PartialEq)]
pub struct Filter {
    /// Only this Leaderboard.
    #[arg(long, value_name = "NAME")]
    pub leaderboard: Option<String>,
    /// Only this track.
    #[arg(long, value_name = "NAME")]
    pub track: Option<String>,
    /// Only this team, by its id or its name.
    #[arg(long, value_name = "TEAM")]
    pub team: Option<String>,
}

impl Filter {
    fn takes(&self, one: &Submission) -> bool {
        let is =
            |wanted: &Option<String>, known: Option<&str>| wanted.as_deref().is_none_or(|wanted| known == Some(wanted));
        let (given, accepted) = (one.spec.team.as_ref(), facts::status(one).team.as_ref());
        let ids = [
            given.and_then(|team| team.id.as_ref()),
            accepted.and_then(|team| team.id.as_ref()),
        ];
        let is_team = |wanted: &String| {
            let has_name = one.team_name().is_some_and(|name| name.eq_ignore_ascii_case(wanted));
            has_name || ids.contains(&Some(wanted))
        };
        is(&self.leaderboard, Some(&one.spec.leaderboard_name))
            && is(&self.track, track_of(one))
            && self.team.as_ref().is_none_or(is_team)
    }
}

impl Scope {
    /// True if the state and the filter take a submission; a new one counts as Pending.
    fn takes(&self, one: &Submission) -> bool {
        let state = facts::status(one).known_state().unwrap_or(State::Pending);
        let is_state = |wanted: &String| wanted.eq_ignore_ascii_case(state.as_str());
        (self.state.is_empty() || self.state.iter().any(is_state)) && self.filter.takes(one)
    }

    /// The limits in words, such as `the Leaderboard a and the team b`; None without limits.
    pub fn words(&self) -> Option<String> {
        let (filter, states) = (&self.filter, self.state.join(" or "));
        let parts = [
            ("the labels", self.selector.as_deref()),
            ("the state", Some(states.as_str()).filter(|states| !states.is_empty())),
            ("the Leaderboard", filter.leaderboard.as_deref()),
            ("the track", filter.track.as_deref()),
            ("the team", filter.team.as_deref()),
        ];
        let parts = parts
            .into_iter()
            .filter_map(|(what, value)| Some(format!("{what} {}", value?)));
        Some(parts.collect::<Vec<_>>().join(" and ")).filter(|text| !text.is_empty())
    }
}

/// A kind of objects in namespaces.
pub trait Kind: Resource<Scope = NamespaceResourceScope, DynamicType = ()> + Clone + DeserializeOwned + Debug {}

impl<K: Resource<Scope = NamespaceResourceScope, DynamicType = ()> + Clone + DeserializeOwned + Debug> Kind for K {}

/// A namespace of a cluster.
pub struct Cluster {
    pub(super) client: Client,
    /// Its name.
    pub namespace: String,
    /// Where the API server is, for errors.
    pub(super) server: String,
}

/// The answer to a request for the Leaderboard of a submission.
pub enum Fetched {
    Found(Box<Leaderboard>),
    Missing,
    Forbidden,
}

impl Fetched {
    /// Borrows the answer.
    pub fn observed(&self) -> Observed<'_> {
        match self {
            Self::Found(leaderboard) => Observed::Found(leaderboard),
            Self::Missing => Observed::Missing,
            Self::Forbidden => Observed::Forbidden,
        }
    }
}

impl Cluster {
    /// Finds the cluster as kubectl does.
    pub async fn connect(target: Target) -> Result<Self, Error> {
        let config = config(&target).await?;
        let namespace = target.namespace.unwrap_or_else(|| config.default_namespace.clone());
        let server = config.cluster_url.to_string().trim_end_matches('/').to_owned();
        Ok(Self {
            client: Client::try_from(config)?,
            namespace,
            server,
        })
    }

    /// A submission by its name.
    pub async fn submission(&self, name: &str) -> Result<Submission, Error> {
        match self.in_time(self.api().get_opt(name)).await?? {
            Some(found) => Ok(found),
            None => Err(self.unknown::<Submission>("submission", name).await?),
        }
    }

    /// All submissions of a scope.
    pub async fn submissions(&self, scope: &Scope) -> Result<Vec<Submission>, Error> {
        let mut found: Vec<Submission> = list(self, &self.api_of(scope), labels(scope.selector.as_deref())).await?;
        found.retain(|one| scope.takes(one));
        Ok(found)
    }

    /// Namespaces with submissions, and how many; none if this person may not list them.
    pub async fn elsewhere(&self) -> Vec<(String, usize)> {
        let api: Api<PartialObjectMeta<Submission>> = Api::all(self.client.clone());
        let all = list(self, &api, ListParams::default()).await.unwrap_or_default();
        let mut counts: BTreeMap<String, usize> = BTreeMap::new();
        for one in all {
            *counts.entry(one.namespace().unwrap_or_default()).or_default() += 1;
        }
        counts.into_iter().collect()
    }

    /// All Pods that the operator has made.
    pub async fn pods(&self) -> Result<Vec<Pod>, Error> {
        list(self, &self.api::<Pod>(), labels(Some(LABEL_SUBMISSION))).await
    }

    /// All events.
    pub async fn events(&self) -> Result<Vec<Event>, Error> {
        list(self, &self.api::<Event>(), ListParams::default()).await
    }

    /// The newest Pod of a submission.
    pub async fn pod(&self, submission: &str) -> Result<Option<Pod>, Error> {
        let selector = format!("{LABEL_SUBMISSION}={submission}");
        let pods = list(self, &self.api::<Pod>(), labels(Some(&selector))).await?;
        Ok(pods
            .into_iter()
            .max_by_key(|pod| pod.creation_timestamp().map(|time| time.0)))
    }

    /// The Pods of a submission, each time one of them changes.
    pub fn pod_changes(&self, submission: &str) -> impl Stream<Item = Result<Pod, watcher::Error>> + use<> {
        let config = watcher::Config::default().labels(&format!("{LABEL_SUBMISSION}={submission}"));
        watcher::watcher(self.api::<Pod>(), config)
            .default_backoff()
            .applied_objects()
            .boxed()
    }

    /// The log of a container so far, line by line.
    pub async fn log(
        &self,
        pod: &str,
        container: &str,
    ) -> Result<impl Stream<Item = std::io::Result<String>> + use<>, Error> {
        let api = self.api::<Pod>();
        let opened = self
            .in_time(api.log_stream(pod, &of_container(container, false)))
            .await?;
        Ok(lines::of(opened.map_err(of_log)?).boxed())
    }

    /// The log of a container from its beginning until it ends. One that prints nothing may not be answered before it does.
    pub fn followed_log(&self, pod: &str, container: &str) -> impl Stream<Item = Result<String, Error>> + use<> {
        let (api, pod, params) = (self.api::<Pod>(), pod.to_owned(), of_container(container, true));
        let opened = async move {
            let reader = api.log_stream(&pod, &params).await.map_err(of_log)?;
            Ok(lines::of(reader).map_err(|error| Error::Api(error.to_string())))
        };
        opened.try_flatten_stream()
    }

    /// A Leaderboard by its name.
    pub async fn leaderboard(&self, name: &str) -> Result<Fetched, Error> {
        match self.in_time(self.api::<Leaderboard>().get_opt(name)).await? {
            Ok(Some(found)) => Ok(Fetched::Found(Box::new(found))),
            Ok(None) => Ok(Fetched::Missing),
            Err(kube::Error::Api(status)) if status.is_forbidden() => Ok(Fetched::Forbidden),
            Err(error) => Err(error.into()),
        }
    }

    /// A Leaderboard that a command cannot do without.
    pub async fn known_leaderboard(&self, name: &str) -> Result<Leaderboard, Error> {
        match self.leaderboard(name).await? {
            Fetched::Found(found) => Ok(*found),
            Fetched::Missing => Err(self.unknown::<Leaderboard>("Leaderboard", name).await?),
            Fetched::Forbidden => Err(no_leaderboards()),
        }
    }

    /// All Leaderboards of a scope; none if this person has no right to read them.
    pub async fn leaderboards(&self, scope: &Scope) -> Result<Option<Vec<Leaderboard>>, Error> {
        match list::<Leaderboard>(self, &self.api_of(scope), ListParams::default()).await {
            Ok(mut found) => {
                let wanted = scope.filter.leaderboard.as_ref();
                found.retain(|board| wanted.is_none_or(|wanted| board.name_any() == *wanted));
                Ok(Some(found))
            }
            Err(Error::Forbidden(_)) => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// Changes an object by a merge patch. The caller judges the API server's answer.
    pub async fn patch<K: Kind>(&self, name: &str, patch: &Value) -> Result<kube::Result<K>, Error> {
        let params = PatchParams::apply(MANAGER);
        let api = self.api::<K>();
        self.in_time(api.patch(name, &params, &Patch::Merge(patch))).await
    }

    /// Creates a submission. A trial creates none: the API server checks it, and answers as if it had.
    pub async fn create(&self, submission: &Value, is_trial: bool) -> Result<Submission, Error> {
        let object = serde_json::from_value(submission.clone()).map_err(|error| Error::Malformed(error.to_string()))?;
        let params = PostParams {
            dry_run: is_trial,
            field_manager: Some(MANAGER.to_owned()),
        };
        Ok(self
            .in_time(self.api::<Submission>().create(&params, &object))
            .await??)
    }

    /// Deletes a submission. One that is gone is no error.
    pub async fn delete(&self, name: &str) -> Result<(), Error> {
        let api = self.api::<Submission>();
        match self.in_time(api.delete(name, &DeleteParams::default())).await? {
            Err(kube::Error::Api(status)) if status.is_not_found() => Ok(()),
            answer => Ok(answer.map(|_| ())?),
        }
    }

    /// A submission each time it changes; none once it is gone.
    pub fn changes(&self, name: &str) -> impl Stream<Item = Result<Option<Submission>, watcher::Error>> + use<> {
        watch_object(self.api::<Submission>(), name).default_backoff().boxed()
    }

    fn api_of<K: Kind>(&self, scope: &Scope) -> Api<K> {
        if scope.all_namespaces {
            Api::all(self.client.clone())
        } else {
            self.api()
        }
    }

    fn api<K: Kind>(&self) -> Api<K> {
        Api::namespaced(self.client.clone(), &self.namespace)
    }

    /// The error for a name that the namespace does not have, with where else to look.
    pub async fn unknown<K: Kind>(&self, kind: &'static str, name: &str) -> Result<Error, Error> {
        let (here, anywhere): (Api<PartialObjectMeta<K>>, _) = (self.api(), Api::all(self.client.clone()));
        let known: Vec<String> = match list(self, &here, ListParams::default()).await {
            Ok(found) => found.iter().map(ResourceExt::name_any).collect(),
            // The right to read an object by its name does not include the right to list them.
            Err(Error::Forbidden(_)) => Vec::new(),
            Err(error) => return Err(error),
        };
        let named = ListParams::default().fields(&format!("metadata.name={name}"));
        let found: Vec<PartialObjectMeta<K>> = list(self, &anywhere, named).await.unwrap_or_default();
        let elsewhere: Vec<String> = found.iter().filter_map(ResourceExt::namespace).collect();
        Ok(Error::Unknown {
            kind,
            name: name.to_owned(),
            namespace: self.namespace.clone(),
            next: near::next(&K::plural(&()), name, &self.namespace, &known, &elsewhere),
        })
    }

    async fn in_time<T>(&self, request: impl Future<Output = T>) -> Result<T, Error> {
        let answer = tokio::time::timeout(LIMIT, request).await;
        answer.map_err(|_| Error::Unreachable {
            server: None,
            why: format!("no answer within {} s", LIMIT.as_secs()),
        })
    }
}

fn of_container(container: &str, follow: bool) -> LogParams {
    LogParams {
        container: Some(container.to_owned()),
        follow,
        ..LogParams::default()
    }
}

async fn config(target: &Target) -> Result<Config, Error> {
    let options = KubeConfigOptions {
        context: target.context.clone(),
        ..KubeConfigOptions::default()
    };
    let failed = |error: KubeconfigError| of_kubeconfig(&error);
    if let Some(path) = &target.kubeconfig {
        let file = Kubeconfig::read_from(path).map_err(failed)?;
        return Config::from_custom_kubeconfig(file, &options).await.map_err(failed);
    }
    // A context is part of a kubeconfig; without one the account of a Pod may serve.
    if target.context.is_some() {
        return Config::from_kubeconfig(&options).await.map_err(failed);
    }
    Config::infer().await.map_err(|error| of_kubeconfig(&error))
}

fn labels(selector: Option<&str>) -> ListParams {
    selector.map_or_else(ListParams::default, |selector| ListParams::default().labels(selector))
}

/// All objects of a kind, in pages.
async fn list<K: Kind>(cluster: &Cluster, api: &Api<K>, params: ListParams) -> Result<Vec<K>, Error> {
    let mut found = Vec::new();
    let mut params = params.limit(PAGE);
    loop {
        let page = cluster.in_time(api.list(&params)).await??;
        found.extend(page.items);
        match page.metadata.continue_.filter(|token| !token.is_empty()) {
            Some(token) => params = params.continue_token(&token),
            None => return Ok(found),
        }
    }
}
