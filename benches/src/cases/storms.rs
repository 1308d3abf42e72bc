//! Jobs that get no Pod, or Pods that get no node, all at once. The case counts the operator's requests to the API server meanwhile, and
//! the time until each submission shows the reason.

use std::time::Duration;

use http::Method;
use kube::Client;
use leaderboard_api::Reason;
use serde_json::json;

use crate::api::{self, JSON, MERGE};
use crate::audit;
use crate::bench::{Bench, Outcome};
use crate::machine::Used;
use crate::names::WARM_NAME;
use crate::player::Pods;
use crate::record::Figures;
use crate::world::{Setup, World};

const COUNT: usize = 1_000;
const QUICK_COUNT: usize = 200;
/// A reason counts that is there so soon after the Job.
const IN_TIME: Duration = Duration::from_mins(1);
const CAP: Duration = Duration::from_mins(3);
const REST: Duration = Duration::from_secs(30);

/// The obstacle that holds the Pods back.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Storm {
    Quota,
    /// An admission policy, which refuses as a webhook does and needs no server of its own.
    Policy,
    Nodes,
}

pub async fn measure(bench: &Bench, storm: Storm) -> Outcome<Figures> {
    let count = bench.count(if bench.quick { QUICK_COUNT } else { COUNT });
    let mut figures = Figures::default();
    let setup = Setup {
        has_operator: true,
        has_controllers: true,
        pods: Some(Pods::Wait),
        ..Setup::default()
    };
    let mut world = World::start(bench, &setup).await?;
    storm.begin(&world.client).await?;
    let expected = storm.reason();
    let before = world.used()?;
    let began = world.burst(0..count).await?;
    let has_jobs = world.observed.until(CAP, |moments| moments.jobs.len() >= count).await;
    let shown = |moments: &crate::observed::Moments| {
        let right = moments
            .reasons
            .iter()
            .filter(|(name, (reason, _))| reason == expected && *name != WARM_NAME);
        right.count()
    };
    let left =
        (IN_TIME + Duration::from_secs(30)).saturating_sub(began.elapsed().saturating_sub(last_job(&world, began)));
    world.observed.until(left, |moments| shown(moments) >= count).await;
    world.check()?;
    let in_time = in_time(&world.observed.get(), expected);
    figures.add("reasons right within 60 s, %", 100.0 * in_time as f64 / count as f64);
    figures.note(format!("{count} Jobs; the reason is {expected}"));
    if !has_jobs {
        figures.note(format!(
            "{} Jobs after {:.0} s",
            world.observed.get().jobs.len(),
            began.elapsed().as_secs_f64()
        ));
    }
    let middle = world.used()?;
    super::costs(
        &mut figures,
        bench,
        "until the reasons are there",
        &before,
        &middle,
        count,
    );
    rest(bench, &world, &mut figures).await?;
    Ok(figures)
}

/// Submissions that show the right reason soon after their Job.
fn in_time(moments: &crate::observed::Moments, expected: &str) -> usize {
    let right = moments.reasons.iter().filter(|(_, (reason, _))| reason == expected);
    let in_time = right.filter(|(name, (_, at))| {
        let job = moments.jobs.get(*name);
        job.is_some_and(|job| at.saturating_duration_since(*job) <= IN_TIME)
    });
    in_time.count()
}

/// From the first request until the last Job.
fn last_job(world: &World, began: std::time::Instant) -> Duration {
    let moments = world.observed.get();
    let times = moments.jobs.values().map(|at| at.saturating_duration_since(began));
    times.max().unwrap_or_default()
}

async fn rest(bench: &Bench, world: &World, figures: &mut Figures) -> Outcome<()> {
    let count = || -> Outcome<f64> {
        let requests = audit::requests(&audit::read(&world.servers.audit_log())?);
        Ok(requests.values().sum::<usize>() as f64)
    };
    let (before, known) = (world.used()?, count()?);
    tokio::time::sleep(REST).await;
    let after = world.used()?;
    let (used, time) = (after.since(&before), after.seconds_from(&before));
    figures.add("API requests/min while they wait", (count()? - known) * 60.0 / time);
    figures.add(
        "operator CPU while they wait, % of a core",
        100.0 * used.operator / time,
    );
    figures.add(
        "API server CPU while they wait, % of a core",
        100.0 * used.apiserver / time,
    );
    figures.foreign(Used::foreign(&before, &after, bench.cores));
    Ok(())
}

impl Storm {
    fn reason(self) -> &'static str {
        let reason = match self {
            Self::Quota => Reason::QuotaExceeded,
            Self::Policy => Reason::PodRefused,
            Self::Nodes => Reason::Unschedulable,
        };
        reason.as_str()
    }

    async fn begin(self, client: &Client) -> Outcome<()> {
        match self {
            Self::Quota => quota(client).await,
            Self::Policy => policy(client).await,
            Self::Nodes => Ok(()),
        }
    }
}

/// A quota that is used up. No controller fills in its status.
async fn quota(client: &Client) -> Outcome<()> {
    let path = api::path("resourcequotas");
    let hard = json!({"pods": "0"});
    let quota = json!({
        "apiVersion": "v1", "kind": "ResourceQuota", "metadata": {"name": "used-up"}, "spec": {"hard": hard},
    });
    api::create(client, &path, quota.to_string().into_bytes()).await?;
    let status = json!({"status": {"hard": hard, "used": {"pods": "0"}}}).to_string();
    api::send(
        client,
        Method::PATCH,
        &format!("{path}/used-up/status"),
        MERGE,
        status.into_bytes(),
    )
    .await?;
    Ok(())
}

async fn policy(client: &Client) -> Outcome<()> {
    let group = "/apis/admissionregistration.k8s.io/v1";
    let rule = json!({"apiGroups": [""], "apiVersions": ["v1"], "operations": ["CREATE"], "resources": ["pods"]});
    let policy = json!({
        "apiVersion": "admissionregistration.k8s.io/v1", "kind": "ValidatingAdmissionPolicy",
        "metadata": {"name": "no-pods"},
        "spec": {
            "matchConstraints": {"resourceRules": [rule]},
            "validations": [{"expression": "false", "message": "images of this registry are not allowed"}],
        },
    });
    let binding = json!({
        "apiVersion": "admissionregistration.k8s.io/v1", "kind": "ValidatingAdmissionPolicyBinding",
        "metadata": {"name": "no-pods"}, "spec": {"policyName": "no-pods", "validationActions": ["Deny"]},
    });
    for (kind, object) in [
        ("validatingadmissionpolicies", policy),
        ("validatingadmissionpolicybindings", binding),
    ] {
        let path = format!("{group}/{kind}");
        api::send(client, Method::POST, &path, JSON, object.to_string().into_bytes()).await?;
    }
    // A binding takes a moment until it is enforced: a Pod that is refused shows that it is.
    let probe = json!({
        "apiVersion": "v1", "kind": "Pod", "metadata": {"generateName": "probe-"},
        "spec": {"containers": [{"name": "probe", "image": "registry.example/probe:1"}]},
    });
    let path = format!("{}?dryRun=All", api::path("pods"));
    for _ in 0..200 {
        if api::create(client, &path, probe.to_string().into_bytes())
            .await
            .is_err()
        {
            return Ok(());
        }
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    Err("the admission policy is not enforced after 20 s".into())
}
