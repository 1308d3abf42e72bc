//! Whether a Leaderboard's Pods would be taken, by our own rules and by a dry run of its first track's Job, before anybody submits. Called by `probe`.

use std::collections::BTreeMap;

use jiff::Timestamp;
use kube::api::{ApiResource, DynamicObject, PostParams};
use kube::{Api, Client, ResourceExt};

use super::pod_notes::{self, TrackPods, notes};
use super::priority::{self, Asked};
use crate::controller::settings::Settings;
use crate::controller::submissions::job_spec::{self, JobInput};
use crate::controller::submissions::pod_overlay;
use crate::kubernetes::call;
use crate::services::endpoints;
use leaderboard_api::{Dns, JobNumber, Leaderboard, Submission, Track, effective};

/// What was found of a Leaderboard's Pods.
#[derive(Clone, Default)]
pub(super) struct TriedPods {
    /// Why they would be refused.
    pub(super) refused: Option<String>,
    /// What their host should know all the same.
    pub(super) notes: Vec<String>,
    /// Their PriorityClasses.
    pub(super) classes: BTreeMap<String, Asked>,
}

/// Whether Pods of this Leaderboard would be refused, by our own rules or by the API server's dry run; and what is to be noted.
pub(super) async fn try_pods(client: &Client, settings: &Settings, leaderboard: &Leaderboard) -> TriedPods {
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
    let template = |job: &DynamicObject| job.data.pointer("/spec/template").cloned().unwrap_or_default();
    let pods = jobs.iter().map(|(track, job)| TrackPods {
        track: track.name.clone(),
        template: template(job),
    });
    let pods: Vec<TrackPods> = pods.collect();
    let hosts = match leaderboard.spec.network.dns {
        Dns::None => endpoints::of_pods(&leaderboard.spec, settings.own.region.as_deref()).await,
        Dns::Cluster => Ok(Vec::new()),
    };
    let mut templates = jobs.iter().map(|(_, job)| template(job));
    let unclear = templates.find_map(|template| job_spec::unclear(&leaderboard.spec, &template));
    TriedPods {
        notes: notes(&pods)
            .into_iter()
            .chain(pod_notes::unnamed(&pods, hosts))
            .collect(),
        classes: priority::asked(&leaderboard.spec.tracks, &pods),
        refused: match (unclear, jobs.first()) {
            (Some(unclear), _) => Some(unclear),
            (None, Some((_, job))) => refused_job(client, leaderboard, job).await,
            (None, None) => None,
        },
    }
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
    let spec = serde_json::json!({ "leaderboardName": leaderboard.name_any(), "track": track.name, "image": "example/agent:1" });
    let mut sample = Submission::new("sample", serde_json::from_value(spec).ok()?);
    sample.metadata.namespace = leaderboard.namespace();
    sample.metadata.uid = leaderboard.uid();
    let plan = effective::plan(
        &leaderboard.spec,
        track,
        sample.run_id(),
        "example/agent:1".into(),
        false,
    );
    Some(job_spec::build_object(&JobInput {
        submission: &sample,
        leaderboard,
        plan: &plan,
        number: JobNumber::default(),
        own: &settings.own,
        failed_nodes: &[],
        now: Timestamp::now(),
    }))
}
