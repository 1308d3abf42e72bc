//! Values that depend on more than one field: computed here and nowhere else, shown in status.
//!
//! Pure. Called by the controller (plans, Jobs) and by the commands that run without a cluster.

use k8s_openapi::api::core::v1::ResourceRequirements;

use super::leaderboard_parts::{Deadlines, Evaluation, S3Bucket, Track, TrackContainer};
use super::{
    Carla, CarlaPlan, ContainerEvaluation, ContainerPlan, LeaderboardSpec, LeaderboardVersion, PlannedEvaluation,
    RouteSlice, RunId, RunPlan, TrackEvaluator,
};

/// How many routes one track of the CARLA Leaderboard runs, and in how many pairs.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Shape {
    /// Number of simulator-agent pairs.
    pub pairs: usize,
    /// Number of routes, not counting repetitions.
    pub routes: usize,
    /// Number of repetitions of each route.
    pub repetitions: usize,
    /// ROUTES_SUBSET of each pair.
    pub slices: Vec<RouteSlice>,
}

/// Routes and pairs of a track of the CARLA Leaderboard.
pub fn shape(carla: &Carla, track: &Track) -> Shape {
    let own = &track.carla;
    let pairs = positive(own.pairs.unwrap_or(carla.pairs));
    let routes = positive(own.routes.unwrap_or(carla.routes));
    let usual = match carla.version {
        LeaderboardVersion::V1 => 5,
        LeaderboardVersion::V2 => 1,
    };
    let repetitions = positive(own.repetitions.or(carla.repetitions).unwrap_or(usual));
    let subsets = own.route_subsets.as_ref();
    let slices = subsets.map_or_else(
        || slices(routes, pairs),
        |subsets| subsets.iter().map(|subset| subset.0).collect(),
    );
    Shape {
        pairs: slices.len(),
        routes,
        repetitions,
        slices,
    }
}

/// Shares `routes` out over `pairs` as `ceil(k*R/N) .. ceil((k+1)*R/N)-1`; a pair without a route is left out,
/// because an empty ROUTES_SUBSET would run all of them.
pub fn slices(routes: usize, pairs: usize) -> Vec<RouteSlice> {
    (0..pairs)
        .map(|k| ((k * routes).div_ceil(pairs), ((k + 1) * routes).div_ceil(pairs)))
        .filter(|(first, end)| first < end)
        .filter_map(|(first, end)| {
            let (first, last) = (u32::try_from(first).ok()?, u32::try_from(end - 1).ok()?);
            Some(RouteSlice { first, last })
        })
        .collect()
}

/// Number of workers of a track that a container of the host's evaluates.
pub fn workers(container: &ContainerEvaluation, track: &Track) -> i32 {
    let own = track.container.as_ref().and_then(|own| own.workers);
    own.unwrap_or(container.workers).max(1)
}

/// The deadlines of a track's runs.
pub fn deadlines(spec: &LeaderboardSpec, track: Option<&Track>) -> Deadlines {
    let own = track.and_then(|track| track.deadlines).unwrap_or_default();
    Deadlines {
        pull_seconds: own.pull_seconds.unwrap_or(spec.deadlines.pull_seconds),
        start_seconds: own.start_seconds.unwrap_or(spec.deadlines.start_seconds),
        run_seconds: own.run_seconds.or(spec.deadlines.run_seconds),
        ..spec.deadlines
    }
}

/// Requests and limits of a track's simulators or agents: the track's own, else those of the Leaderboard.
pub fn resources(
    own: Option<&TrackContainer>,
    leaderboards: Option<&ResourceRequirements>,
) -> Option<ResourceRequirements> {
    own.and_then(|own| own.resources.as_ref()).or(leaderboards).cloned()
}

/// Key prefix of a run in its bucket, with the final slash.
pub fn key_prefix(bucket: &S3Bucket, run_id: &RunId) -> String {
    format!("{}{run_id}/", bucket.prefix.as_deref().unwrap_or_default())
}

/// Address of a run's results for people.
pub fn results_url(bucket: &S3Bucket, run_id: &RunId) -> String {
    format!(
        "s3://{}/{}{run_id}",
        bucket.bucket,
        bucket.prefix.as_deref().unwrap_or_default()
    )
}

/// The plan of a submission's first attempt. `image` is the participant's, if it is an image; `resume` means that stored results are taken up. `None` for a
/// track without the score that its kind of evaluation needs, which the API server refuses.
pub fn plan(
    spec: &LeaderboardSpec,
    track: &Track,
    run_id: RunId,
    image: Option<String>,
    resume: bool,
) -> Option<RunPlan> {
    let evaluation = match &spec.evaluation {
        Evaluation::Carla(carla) => PlannedEvaluation::Carla(carla_plan(carla, track)),
        Evaluation::Container(container) => {
            PlannedEvaluation::Container(container_plan(container, track, track.container.as_ref()?))
        }
    };
    Some(RunPlan {
        run_id,
        track: track.name.as_str().into(),
        phase: track.phase,
        storage: spec.storage.clone(),
        image,
        evaluation,
        resume,
        earlier_attempts: 0,
        submission_uid: None,
    })
}

fn carla_plan(carla: &Carla, track: &Track) -> CarlaPlan {
    let shape = shape(carla, track);
    CarlaPlan {
        version: carla.version,
        codename: track.carla.codename.as_ref().unwrap_or(&track.name).into(),
        slices: shape.slices,
        routes: i32::try_from(shape.routes).unwrap_or(i32::MAX),
        repetitions: i32::try_from(shape.repetitions).unwrap_or(i32::MAX),
        contents_image: carla.contents.image.as_str().into(),
        simulator_image: carla.simulator.image.as_str().into(),
    }
}

fn container_plan(container: &ContainerEvaluation, track: &Track, own: &TrackEvaluator) -> ContainerPlan {
    ContainerPlan {
        mode: container.mode,
        workers: workers(container, track),
        merge: container.merge,
        score: own.score.clone(),
        image: container.image.as_str().into(),
        input: container.mode.has_input().then(|| container.input_bounds()),
    }
}

fn positive(value: i32) -> usize {
    usize::try_from(value).unwrap_or(1).max(1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn twenty_routes_over_four_pairs_are_the_original_table() {
        let texts: Vec<String> = slices(20, 4).iter().map(RouteSlice::to_string).collect();
        assert_eq!(texts, ["0-4", "5-9", "10-14", "15-19"]);
    }

    #[test]
    fn slices_cover_every_route_once_for_any_numbers() {
        for routes in 1..60 {
            for pairs in 1..20 {
                let all: Vec<u32> = slices(routes, pairs)
                    .iter()
                    .flat_map(|slice| slice.first..=slice.last)
                    .collect();
                assert_eq!(
                    all,
                    (0..u32::try_from(routes).unwrap()).collect::<Vec<_>>(),
                    "{routes} over {pairs}"
                );
            }
        }
    }
}
