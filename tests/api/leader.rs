//! Elections on a real API server: its conflicts, its resourceVersions, its idea of a valid Lease.

use std::time::Duration;

use k8s_openapi::api::coordination::v1::Lease;
use kube::api::{Patch, PatchParams, PostParams};
use kube::runtime::wait::await_condition;
use kube::{Api, Client, ResourceExt};
use leaderboard_api::Submission;
use leaderboard_base::shutdown::Stop;
use leaderboard_operator::kubernetes::Writer;
use leaderboard_operator::observability::Observability;
use leaderboard_operator::runtime::leader::{Identity, Leader, Leadership, Settings, Timing, start};
use leaderboard_operator::runtime::writes::apply_status;
use serde_json::json;
use tokio::sync::watch;
use tokio::time::{Instant, timeout};

use crate::support::apiserver::server;

/// Longer than anything here may take, also on a busy machine.
const LIMIT: Duration = Duration::from_mins(2);
const LEASE: &str = "operator";

struct Candidate {
    leader: Leader,
    identity: Identity,
    _stop: watch::Sender<bool>,
}

impl Candidate {
    fn start(client: &Client, namespace: &str) -> Self {
        let (sender, stop) = Stop::new();
        let identity = Identity::random("test");
        let timing = Timing {
            lease: Duration::from_secs(6),
            renew_deadline: Duration::from_secs(5),
            retry: Duration::from_millis(300),
            call: Duration::from_secs(3),
            ..Timing::default()
        };
        let settings = Settings {
            timing,
            ..Settings::new(namespace, LEASE, identity.clone())
        };
        let leader = start(client.clone(), settings, &Observability::new(stop));
        Self {
            leader,
            identity,
            _stop: sender,
        }
    }

    /// Its term, and whether it may write to EvalAI at once.
    async fn leads(&self) -> (i32, bool) {
        let mut leadership = self.leader.leadership();
        let found = timeout(LIMIT, leadership.wait_for(|now| !matches!(now, Leadership::Standby))).await;
        match found
            .expect("somebody leads in time")
            .expect("the election goes on")
            .clone()
        {
            Leadership::Leader { term } => {
                let not_before = self.leader.fence().evalai_not_before().expect("it leads");
                (term, not_before <= Instant::now())
            }
            other => panic!("{other:?}"),
        }
    }
}

async fn until(leases: &Api<Lease>, is: impl Fn(&Lease) -> bool + Clone + Send) -> Lease {
    let condition = |lease: Option<&Lease>| lease.is_some_and(&is);
    let found = timeout(LIMIT, await_condition(leases.clone(), LEASE, condition)).await;
    found.expect("in time").unwrap().expect("a Lease")
}

#[tokio::test]
async fn leaders_follow_one_another_in_order_and_after_a_crash() {
    let (client, namespace) = (server().await.client(), server().await.namespace("leader").await);
    let leases = Api::<Lease>::namespaced(client.clone(), &namespace);
    let first = Candidate::start(&client, &namespace);
    assert_eq!(first.leads().await, (1, true));
    let spec = leases.get(LEASE).await.unwrap().spec.unwrap();
    assert_eq!(spec.holder_identity.as_deref(), Some(first.identity.as_str()));
    assert_eq!(
        (spec.lease_duration_seconds, spec.lease_transitions),
        (Some(6), Some(1))
    );

    let second = Candidate::start(&client, &namespace);
    let fence = first.leader.fence();
    assert!(fence.may_write());
    first.leader.release().await;
    assert!(!fence.may_write());
    assert_eq!(second.leads().await, (2, true));

    drop(second);
    let third = Candidate::start(&client, &namespace);
    assert_eq!(third.leads().await, (3, false), "a crash leaves requests behind");
    let not_before = third.leader.fence().evalai_not_before().unwrap();
    assert!(not_before > Instant::now() + Duration::from_mins(1));
}

#[tokio::test]
async fn of_candidates_that_start_together_one_leads() {
    let (client, namespace) = (server().await.client(), server().await.namespace("leader").await);
    let leases = Api::<Lease>::namespaced(client.clone(), &namespace);
    let candidates: Vec<_> = (0..5).map(|_| Candidate::start(&client, &namespace)).collect();
    let lease = until(&leases, |lease| {
        lease.spec.as_ref().is_some_and(|spec| spec.holder_identity.is_some())
    })
    .await;
    let holder = lease.spec.unwrap().holder_identity.unwrap();
    let (leaders, others): (Vec<_>, Vec<_>) = candidates.iter().partition(|c| c.identity.as_str() == holder);
    assert_eq!(leaders[0].leads().await, (1, true));
    for other in others {
        assert_eq!(*other.leader.leadership().borrow(), Leadership::Standby);
        assert!(!other.leader.fence().may_write());
    }
}

#[tokio::test]
async fn a_leader_stays_one_while_others_edit_its_lease() {
    let (client, namespace) = (server().await.client(), server().await.namespace("leader").await);
    let leases = Api::<Lease>::namespaced(client.clone(), &namespace);
    let candidate = Candidate::start(&client, &namespace);
    candidate.leads().await;
    for number in 0..3 {
        let patch = json!({"metadata": {"annotations": {"edited": number.to_string()}}});
        let edited = leases
            .patch(LEASE, &PatchParams::default(), &Patch::Merge(patch))
            .await
            .unwrap();
        let before = edited.spec.unwrap().renew_time;
        let lease = until(&leases, |lease| {
            lease.spec.as_ref().is_some_and(|spec| spec.renew_time != before)
        })
        .await;
        assert_eq!(lease.metadata.annotations.unwrap()["edited"], number.to_string());
    }
    assert!(candidate.leader.fence().may_write());
    assert_eq!(candidate.leader.leadership().borrow().term(), Some(1));
}

#[tokio::test]
async fn a_leader_that_slept_writes_no_older_status() {
    let (client, namespace) = (server().await.client(), server().await.namespace("leader").await);
    let api = Api::<Submission>::namespaced(client.clone(), &namespace);
    let spec = json!({"leaderboardName": "lb", "track": "sensors", "image": "agent:1"});
    let object = Submission::new("one", serde_json::from_value(spec).unwrap());
    let made = api.create(&PostParams::default(), &object).await.unwrap();
    let says = |message: &str| json!({"attempt": 1, "message": message});
    let seen = made.resource_version();
    let leads = Writer::new(client.clone(), || true);
    let newer = apply_status(&leads, &made, seen.as_deref(), &says("newer"))
        .await
        .unwrap();
    let older = apply_status(&leads, &made, seen.as_deref(), &says("older")).await;
    assert!(older.unwrap_err().is_conflict());
    apply_status(&leads, &made, Some(&newer), &says("newest"))
        .await
        .unwrap();
    let lost = Writer::new(client, || false);
    let refused = apply_status(&lost, &made, None, &says("of a former leader"))
        .await
        .unwrap_err();
    assert!(refused.to_string().contains("no longer leads"), "{refused}");
    let status = api.get("one").await.unwrap().status.unwrap();
    assert_eq!(status.message.as_deref(), Some("newest"));
}
