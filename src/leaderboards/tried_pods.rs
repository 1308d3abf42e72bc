//! Tries whether a Leaderboard's Pods would be taken, by our own rules and by a dry run of its first track's Job, before anybody submits.
//! Also keeps the template of their claims.

use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use kube::api::{ApiResource, DynamicObject, PostParams};
use kube::{Api, Client, ResourceExt};

use super::claims;
use super::data_claims;
use super::pod_findings::TriedPods;
use super::priority;
use crate::ask::Asked;
use crate::kubernetes::call;
use crate::runtime::objects::key_of;
use crate::runtime::settings::Settings;
use leaderboard_api::{Dns, JobNumber, Leaderboard, Submission, Track, effective};
use leaderboard_aws::endpoints;
use leaderboard_pod_spec::job as job_spec;
use leaderboard_pod_spec::job::JobInput;
use leaderboard_pod_spec::notes as pod_notes;
use leaderboard_pod_spec::notes::{TrackPods, notes};
use leaderboard_pod_spec::overlay as pod_overlay;
use leaderboard_policy::ask::{Ask, Failure, Service};
use leaderboard_policy::leaderboards::view::Claims;

/// Classes and templates that are as they should be are looked at again after this long.
const AGAIN: Duration = Duration::from_mins(5);
/// A fault may be corrected at any moment.
const SOON: Duration = Duration::from_secs(15);

/// Asks for the Pods of a Leaderboard. An edit of the Leaderboard asks anew.
#[derive(Clone, Debug)]
pub(super) struct Pods(pub(super) Arc<Leaderboard>);

impl PartialEq for Pods {
    fn eq(&self, other: &Self) -> bool {
        self.0.metadata.generation == other.0.metadata.generation
    }
}

impl Ask for Pods {
    type Answer = TriedPods;
    const AT_ONCE: usize = 16;
    const AT_ONCE_OF_A_SERVICE: usize = 16;
    const LONGEST: Duration = Duration::from_mins(2);

    fn service(&self) -> Service {
        Service::api_server()
    }

    fn again(&self, result: &Result<TriedPods, Failure>, _failures: u32, _waited: Duration) -> Option<Duration> {
        match result {
            Ok(pods) if pods.refused.is_none() && pods.claims.is_good() => {
                let may_change = pods.may_change || !data_claims::named(&self.0).is_empty();
                may_change.then_some(AGAIN)
            }
            Ok(_) | Err(_) => Some(SOON),
        }
    }
}

/// Tries whether Pods of this Leaderboard would be refused, and what is to be noted. Puts the template of their claims in place.
pub(super) async fn try_pods((client, settings): (Client, Settings), asked: Asked<Pods>) -> Result<TriedPods, Failure> {
    let leaderboard = asked.question.0.as_ref();
    let tried = try_templates(&client, &settings, leaderboard).await;
    let claims = claims::keep(&client, leaderboard).await;
    // Right after an edit a Job of the spec before may be on its way.
    let is_edited = asked.last.as_ref().is_none_or(|last| last.question != asked.question);
    if !is_edited
        && claims == Claims::InPlace
        && let Err(error) = claims::remove_others(&client, leaderboard).await
    {
        tracing::warn!(leaderboard = %key_of(leaderboard), %error, "old ResourceClaimTemplates are not removed");
    }
    Ok(TriedPods {
        may_change: tried.may_change || claims != Claims::NotRequired,
        claims,
        ..tried
    })
}

/// The verdict of our own rules and of the API server on its Pods.
async fn try_templates(client: &Client, settings: &Settings, leaderboard: &Leaderboard) -> TriedPods {
    if let Err(error) = pod_overlay::validate(&leaderboard.spec) {
        return TriedPods {
            refused: Some(error.to_string()),
            ..TriedPods::default()
        };
    }
    let tracks = leaderboard.spec.tracks.iter();
    let jobs: Vec<(&Track, DynamicObject)> = tracks
        .filter_map(|track| Some((track, sample_job(settings, leaderboard, track)?)))
        .collect();
    let pods_of = |(track, job): &(&Track, DynamicObject)| TrackPods {
        track: track.name.clone(),
        template: job.data.pointer("/spec/template").cloned().unwrap_or_default(),
    };
    let pods: Vec<TrackPods> = jobs.iter().map(pods_of).collect();
    let hosts = match leaderboard.spec.network.dns {
        Dns::None => endpoints::of_pods(&leaderboard.spec, settings.own.region.as_deref()).await,
        Dns::Cluster => Ok(Vec::new()),
    };
    let unclear = (pods.iter()).find_map(|pods| job_spec::unclear(&leaderboard.spec, &pods.template));
    let refused = match (unclear, jobs.first()) {
        (Some(unclear), _) => Some(unclear),
        (None, Some((_, job))) => refused_job(client, leaderboard, job).await,
        (None, None) => None,
    };
    let asked = priority::asked(&leaderboard.spec.tracks, &pods);
    let notes = notes(&pods).into_iter().chain(pod_notes::unnamed(&pods, hosts));
    let mut tried = TriedPods {
        refused,
        notes: notes.chain(pod_notes::unused(&leaderboard.spec)).collect(),
        claims: Claims::default(),
        may_change: !asked.is_empty(),
    };
    priority::look(client, &asked, &mut tried).await;
    data_claims::look(client, leaderboard, &mut tried).await;
    tried
}

async fn refused_job(client: &Client, leaderboard: &Leaderboard, job: &DynamicObject) -> Option<String> {
    let namespace = leaderboard.namespace().unwrap_or_default();
    let resource = ApiResource::erase::<k8s_openapi::api::batch::v1::Job>(&());
    let api: Api<DynamicObject> = Api::namespaced_with(client.clone(), &namespace, &resource);
    let params = PostParams {
        dry_run: true,
        ..PostParams::default()
    };
    let error = call(
        "a dry run of the Job",
        &leaderboard.name_any(),
        api.create(&params, job),
    )
    .await
    .err()?;
    let status = error.status().filter(|status| [400, 422].contains(&status.code))?;
    Some(status.message.clone())
}

fn sample_job(settings: &Settings, leaderboard: &Leaderboard, track: &Track) -> Option<DynamicObject> {
    let image = (!leaderboard.spec.evaluation.takes_files()).then_some("example/agent:1");
    let spec = serde_json::json!({ "leaderboardName": leaderboard.name_any(), "track": track.name, "image": image });
    let mut sample = Submission::new("sample", serde_json::from_value(spec).ok()?);
    sample.metadata.namespace = leaderboard.namespace();
    sample.metadata.uid = leaderboard.uid();
    let image = image.map(str::to_owned);
    let plan = effective::plan(&leaderboard.spec, track, sample.run_id(), image, false)?;
    Some(job_spec::build_object(&JobInput {
        submission: &sample,
        leaderboard,
        plan: &plan,
        number: JobNumber::default(),
        input: None,
        own: &settings.own,
        failed_nodes: &[],
        // How old a measurement of the isolation is changes nothing that a Job is refused for.
        now: Timestamp::UNIX_EPOCH,
    }))
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn what_depends_on_other_objects_is_looked_at_again() {
        let claim = json!({"persistentVolumeClaim": {"claimName": "d"}});
        let image = json!({"image": {"reference": "data:1"}});
        let good = TriedPods::default;
        let changing = || TriedPods {
            may_change: true,
            ..good()
        };
        let refused = || TriedPods {
            refused: Some("no".to_owned()),
            ..good()
        };
        for (dataset, pods, expected) in [
            (&image, good(), None),
            (&image, changing(), Some(AGAIN)),
            (&image, refused(), Some(SOON)),
            (&claim, good(), Some(AGAIN)),
            (&claim, refused(), Some(SOON)),
        ] {
            let evaluation =
                json!({"container": {"mode": "Batch", "image": "e", "command": ["e"], "dataset": dataset}});
            let mut board = crate::fixtures::leaderboard("board", "http://127.0.0.1:1");
            board.spec.evaluation = serde_json::from_value(evaluation).unwrap();
            let again = Pods(Arc::new(board)).again(&Ok(pods), 0, Duration::ZERO);
            assert_eq!(again, expected, "{dataset}");
        }
    }
}
