//! Everything around one run of a case: fresh servers, one Leaderboard, played Pods, and the operator where the case has it.

use std::sync::Arc;
use std::time::Duration;

use futures::future::try_join_all;
use kube::Client;
use serde_json::json;
use tokio::task::JoinHandle;

use crate::api::{self, Condition, Slim};
use crate::bench::{Bench, Outcome};
use crate::machine::Used;
use crate::names::{LEADERBOARD, WARM_NAME};
use crate::observed::Observed;
use crate::operator::Operator;
use crate::player::{NODE, Player, Pods};
use crate::raw::{Bodies, create_submission, name};
use crate::servers::{Audit, Servers};
use crate::storage::{BUCKET, PAIRS, ROUTES, Storage};

/// Clients of a burst.
const CLIENTS: usize = 16;
const WARM_LIMIT: Duration = Duration::from_mins(2);

/// The parts of a run.
#[derive(Clone, Debug)]
pub struct Setup {
    pub audit: Audit,
    pub has_operator: bool,
    pub has_controllers: bool,
    pub pods: Option<Pods>,
    /// `concurrency.total`.
    pub total: Option<usize>,
}

impl Default for Setup {
    fn default() -> Self {
        Self {
            audit: Audit::Metadata,
            has_operator: false,
            has_controllers: false,
            pods: None,
            total: None,
        }
    }
}

/// A running one. Everything in it ends when it is dropped.
pub struct World {
    pub client: Client,
    pub observed: Observed,
    pub storage: Arc<Storage>,
    pub operator: Option<Operator>,
    /// Seconds from the operator's start until it was ready.
    pub ready: f64,
    player: Option<Player>,
    watches: Vec<JoinHandle<()>>,
    pub servers: Servers,
}

impl Drop for World {
    fn drop(&mut self) {
        for watch in &self.watches {
            watch.abort();
        }
    }
}

impl World {
    pub async fn start(bench: &Bench, setup: &Setup) -> Outcome<Self> {
        let servers = Servers::start(&bench.tools, setup.audit, setup.has_controllers).await?;
        let client = servers.client()?;
        let storage = Arc::new(Storage::start().await?);
        prepare(&client, setup, &storage.url).await?;
        let observed = Observed::default();
        let watches = observed.follow(&client);
        let player = setup
            .pods
            .map(|pods| Player::start(&client, &storage, &observed, pods, !setup.has_controllers));
        let mut world = Self {
            client,
            observed,
            storage,
            operator: None,
            ready: 0.0,
            player,
            watches,
            servers,
        };
        if setup.has_operator {
            world.start_operator(bench).await?;
        }
        Ok(world)
    }

    /// Starts the operator, again if it was killed, and waits until it is ready.
    pub async fn start_operator(&mut self, bench: &Bench) -> Outcome<()> {
        let mut operator = Operator::start(&bench.operator, &self.servers)?;
        self.ready = operator.ready().await?;
        self.operator = Some(operator);
        Ok(())
    }

    /// One submission before the measured ones: connections, caches and watches are there afterwards.
    pub async fn warm(&self, bodies: &Bodies) -> Outcome<()> {
        let name = WARM_NAME;
        let has_ends = self.player.as_ref().is_some_and(|player| !player.is_endless());
        if self.operator.is_some() {
            create_submission(&self.client, name).await?;
        } else {
            bodies.submit(&self.client, name).await?;
        }
        let is_raw = self.operator.is_none();
        let warm = self.observed.until(WARM_LIMIT, |moments| match (has_ends, is_raw) {
            (false, _) => moments.jobs.contains_key(name),
            (true, true) => moments.complete.contains_key(name),
            (true, false) => moments.finished.contains_key(name),
        });
        if warm.await {
            return Ok(());
        }
        let reasons = format!("{:?}", self.observed.get().reasons.get(name));
        Err(format!(
            "the first submission does not come to its end within {} s: {reasons}",
            WARM_LIMIT.as_secs()
        )
        .into())
    }

    pub fn used(&self) -> Outcome<Used> {
        let operator = self.operator.as_ref().map(Operator::pid).transpose()?;
        Used::read(operator, self.servers.apiserver()?, &self.servers.others())
    }

    /// An error as soon as a process has ended that should not.
    pub fn check(&mut self) -> Outcome<()> {
        let ended = self
            .servers
            .ended()
            .or_else(|| self.operator.as_mut().and_then(Operator::ended));
        ended.map_or(Ok(()), |why| Err(why.into()))
    }

    /// Creates submissions as fast as 16 clients can; gives the moment of the first request.
    pub async fn burst(&self, numbers: std::ops::Range<usize>) -> Outcome<std::time::Instant> {
        let began = std::time::Instant::now();
        self.by_clients(numbers, async |client: &Client, name: String| {
            create_submission(client, &name).await.map(|_| ())
        })
        .await?;
        Ok(began)
    }

    /// Shares numbers out among 16 clients, which work at once.
    pub async fn by_clients<F>(&self, numbers: std::ops::Range<usize>, work: F) -> Outcome<()>
    where
        F: AsyncFn(&Client, String) -> Outcome<()>,
    {
        let next = std::sync::atomic::AtomicUsize::new(numbers.start);
        let clients = (0..CLIENTS).map(|_| async {
            loop {
                let number = next.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
                if number >= numbers.end {
                    return Outcome::Ok(());
                }
                work(&self.client, name(number)).await?;
            }
        });
        try_join_all(clients).await?;
        Ok(())
    }
}

/// Makes the objects that exist before the first submission.
async fn prepare(client: &Client, setup: &Setup, storage: &str) -> Outcome<()> {
    for definition in leaderboard_operator::crds::definitions()? {
        let path = "/apis/apiextensions.k8s.io/v1/customresourcedefinitions";
        let body = serde_json::to_vec(definition.json())?;
        let made = api::create(client, path, body).await?;
        established(client, &format!("{path}/{}", made.name)).await?;
    }
    let namespace = json!({"apiVersion": "v1", "kind": "Namespace", "metadata": {"name": api::NAMESPACE}});
    api::create(client, "/api/v1/namespaces", namespace.to_string().into_bytes()).await?;
    let node = json!({
        "apiVersion": "v1", "kind": "Node", "metadata": {"name": NODE},
        "status": {"conditions": [{"type": "Ready", "status": "True", "reason": "KubeletReady"}]},
    });
    api::create(client, "/api/v1/nodes", node.to_string().into_bytes()).await?;
    let mut spec = json!({
        "tracks": [{"name": "sensors"}],
        "evaluation": {"carla": {
            "version": "V2", "contents": {"image": "registry.example/contents:1"},
            "simulator": {"image": "registry.example/simulator:1"}, "pairs": PAIRS, "routes": ROUTES,
        }},
        "storage": {"s3": {"bucket": BUCKET, "endpoint": storage}},
    });
    if setup.pods != Some(Pods::Wait) {
        // No scheduler runs.
        spec["podOverrides"] = json!({"spec": {"nodeName": NODE}});
    }
    if let Some(total) = setup.total {
        spec["concurrency"] = json!({"total": total});
    }
    let leaderboard = json!({
        "apiVersion": "leaderboard.carla.org/v1alpha1", "kind": "Leaderboard", "metadata": {"name": LEADERBOARD},
        "spec": spec,
    });
    api::create(client, &api::path("leaderboards"), leaderboard.to_string().into_bytes()).await?;
    Ok(())
}

/// Waits until a definition is served.
async fn established(client: &Client, path: &str) -> Outcome<()> {
    #[derive(serde::Deserialize, Clone)]
    struct Status {
        // The API server writes null for none.
        conditions: Option<Vec<Condition>>,
    }
    let served = async {
        loop {
            let found: Slim<Status> = api::get(client, path).await?;
            let conditions = found.status.and_then(|status| status.conditions).unwrap_or_default();
            if conditions.iter().any(|c| c.kind == "Established" && c.status == "True") {
                return Outcome::Ok(());
            }
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    };
    tokio::time::timeout(Duration::from_mins(1), served).await?
}
