//! The API server: found as kubectl finds it, and the few requests that the plugin sends. It never reads a Secret.
//!
//! Called by `main`; decides nothing.

use std::future::Future;
use std::path::PathBuf;
use std::time::Duration;

use clap::Args;
use futures::{Stream, StreamExt};
use kube::api::{ListParams, PartialObjectMeta, Patch, PatchParams};
use kube::config::{KubeConfigOptions, Kubeconfig, KubeconfigError};
use kube::runtime::WatchStreamExt;
use kube::runtime::watcher::{self, watch_object};
use kube::{Api, Client, Config, ResourceExt};
use serde::de::DeserializeOwned;
use serde_json::Value;

use super::board::Observed;
use super::error::{Error, of_kubeconfig};
use super::near;
use leaderboard_api::{Leaderboard, Submission};

/// Field manager of what people change.
const MANAGER: &str = "kubectl-leaderboard";
/// Objects of one answer, as kubectl asks for them.
const PAGE: u32 = 500;
/// Longest time one request may take.
const LIMIT: Duration = Duration::from_secs(30);

/// Which cluster and namespace: the same flags as kubectl's.
#[derive(Args, Debug)]
pub struct Target {
    /// Kubeconfig file [default: $KUBECONFIG, else ~/.kube/config].
    #[arg(long, global = true, value_name = "FILE")]
    kubeconfig: Option<PathBuf>,
    /// Context of the kubeconfig [default: the current one].
    #[arg(long, global = true)]
    context: Option<String>,
    /// Namespace [default: the context's].
    #[arg(short, long, global = true)]
    namespace: Option<String>,
}

/// A namespace of a cluster.
pub struct Cluster {
    client: Client,
    /// Its name.
    pub namespace: String,
}

/// The answer to a request for the Leaderboard of a submission.
pub enum Fetched {
    Found(Box<Leaderboard>),
    Missing,
    Forbidden,
}

impl Fetched {
    /// The same by reference.
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
        Ok(Self {
            client: Client::try_from(config)?,
            namespace,
        })
    }

    /// A submission by its name.
    pub async fn submission(&self, name: &str) -> Result<Submission, Error> {
        match self.in_time(self.api().get_opt(name)).await?? {
            Some(found) => Ok(found),
            None => Err(self.unknown(name).await?),
        }
    }

    /// All submissions.
    pub async fn submissions(&self) -> Result<Vec<Submission>, Error> {
        list(self, &self.api()).await
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

    /// All Leaderboards; none if this person has no right to read them.
    pub async fn leaderboards(&self) -> Result<Option<Vec<Leaderboard>>, Error> {
        match list(self, &self.api()).await {
            Ok(found) => Ok(Some(found)),
            Err(Error::Forbidden(_)) => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// Changes a submission by a merge patch. The caller judges the API server's answer.
    pub async fn patch(&self, name: &str, patch: &Value) -> Result<kube::Result<Submission>, Error> {
        let params = PatchParams {
            field_manager: Some(MANAGER.to_owned()),
            ..PatchParams::default()
        };
        let api = self.api::<Submission>();
        self.in_time(api.patch(name, &params, &Patch::Merge(patch))).await
    }

    /// A submission each time it changes; none once it is gone.
    pub fn changes(&self, name: &str) -> impl Stream<Item = Result<Option<Submission>, watcher::Error>> + use<> {
        watch_object(self.api::<Submission>(), name).default_backoff().boxed()
    }

    fn api<K>(&self) -> Api<K>
    where
        K: kube::Resource<Scope = kube::core::NamespaceResourceScope>,
        K::DynamicType: Default,
    {
        Api::namespaced(self.client.clone(), &self.namespace)
    }

    /// The error for an unknown name, with the names that the person may have meant.
    async fn unknown(&self, name: &str) -> Result<Error, Error> {
        let all = list(self, &self.api::<PartialObjectMeta<Submission>>()).await;
        let known: Vec<String> = match all {
            Ok(found) => found.iter().map(ResourceExt::name_any).collect(),
            // The right to read an object by its name does not include the right to list them.
            Err(Error::Forbidden(_)) => Vec::new(),
            Err(error) => return Err(error),
        };
        let near = near::names(name, &known);
        let namespace = self.namespace.clone();
        let next = if near.is_empty() {
            format!("`kubectl get submissions -n {namespace}` lists all; use -n for another namespace")
        } else {
            format!("Did you mean {}?", near.join(", "))
        };
        Ok(Error::Unknown {
            name: name.to_owned(),
            namespace,
            next,
        })
    }

    async fn in_time<T>(&self, request: impl Future<Output = T>) -> Result<T, Error> {
        let answer = tokio::time::timeout(LIMIT, request).await;
        answer.map_err(|_| Error::Silent(LIMIT.as_secs()))
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

/// All objects of a kind, in pages.
async fn list<K>(cluster: &Cluster, api: &Api<K>) -> Result<Vec<K>, Error>
where
    K: Clone + DeserializeOwned + std::fmt::Debug,
{
    let mut found = Vec::new();
    let mut params = ListParams::default().limit(PAGE);
    loop {
        let page = cluster.in_time(api.list(&params)).await??;
        found.extend(page.items);
        match page.metadata.continue_.filter(|token| !token.is_empty()) {
            Some(token) => params = params.continue_token(&token),
            None => return Ok(found),
        }
    }
}
