//! Questions that programs ask of a plan and of a Leaderboard, for every kind of evaluation.
//!
//! Pure. Fields of one kind alone are read here, and in `evaluation`.

use k8s_openapi::api::core::v1::{EnvVar, ResourceRequirements, SecurityContext};

use super::{CarlaPlan, LeaderboardSpec, RouteSlice, RunPlan, Track, effective};

impl RunPlan {
    /// How many workers share the work.
    pub fn workers(&self) -> usize {
        self.carla.slices.len()
    }

    /// Units of work of one worker, which counts from 1; 0 if the plan has no such worker.
    pub fn total_of(&self, worker: i32) -> i32 {
        let index = usize::try_from(worker).ok().and_then(|worker| worker.checked_sub(1));
        let slice = index.and_then(|index| self.carla.slices.get(index));
        let units = slice.and_then(|slice| i32::try_from(slice.routes()).ok()?.checked_mul(self.carla.repetitions));
        units.unwrap_or(0)
    }

    /// The plan of a check: the first unit of work, once, with one worker.
    #[must_use]
    pub fn of_check(self) -> Self {
        let first = self.carla.slices.first().map_or(0, |slice| slice.first);
        let carla = CarlaPlan {
            slices: vec![RouteSlice { first, last: first }],
            routes: 1,
            repetitions: 1,
            ..self.carla
        };
        Self { carla, ..self }
    }

    /// The plan with the images that the Leaderboard names now, but for the participant's.
    #[must_use]
    pub fn renewed(self, spec: &LeaderboardSpec) -> Self {
        let now = &spec.evaluation.carla;
        let carla = CarlaPlan {
            contents_image: now.contents.image.as_str().into(),
            simulator_image: now.simulator.image.as_str().into(),
            ..self.carla
        };
        Self { carla, ..self }
    }

    /// Gives back memory that its lists do not need.
    pub fn shrink_to_fit(&mut self) {
        self.carla.slices.shrink_to_fit();
    }
}

/// A container whose fields the host writes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// Fills the volumes with what the host keeps private.
    Contents,
    /// The container of a worker with the host's image.
    Host,
    /// The container of a worker with the participant's image.
    Agent,
}

/// Fields of a container that Kubernetes gets as the host writes them.
#[derive(Clone, Debug)]
pub struct Given<'a> {
    /// Where they stand below `spec`.
    pub path: &'static str,
    pub env: &'a [EnvVar],
    pub resources: Option<ResourceRequirements>,
    pub security: Option<&'a SecurityContext>,
}

impl LeaderboardSpec {
    /// The fields that the host writes for a container, with the overrides of a track.
    pub fn given<'a>(&'a self, track: Option<&Track>, part: Part) -> Given<'a> {
        let carla = &self.evaluation.carla;
        match part {
            Part::Contents => Given {
                path: "evaluation.carla.contents",
                env: &carla.contents.env,
                resources: carla.contents.resources.clone(),
                security: carla.contents.security_context.as_ref(),
            },
            Part::Host => Given {
                path: "evaluation.carla.simulator",
                env: &carla.simulator.env,
                resources: effective::resources(
                    track.and_then(|track| track.carla.simulator.as_ref()),
                    carla.simulator.resources.as_ref(),
                ),
                security: carla.simulator.security_context.as_ref(),
            },
            Part::Agent => Given {
                path: "agent",
                env: &self.agent.env,
                resources: effective::resources(
                    track.and_then(|track| track.agent.as_ref()),
                    self.agent.resources.as_ref(),
                ),
                security: self.agent.security_context.as_ref(),
            },
        }
    }

    /// Images of the host, contents first, then simulator. Neither may be submitted.
    pub fn host_images(&self) -> [&str; 2] {
        let carla = &self.evaluation.carla;
        [&carla.contents.image, &carla.simulator.image]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn a_check_does_the_first_unit_once() {
        let plan = json!({
            "runId": "check-lb-1", "track": "sensors", "storage": {"s3": {"bucket": "b"}}, "image": "a:1",
            "carla": {
                "version": "V1", "codename": "SENSORS", "slices": [{"first": 4, "last": 9}, {"first": 10, "last": 15}],
                "routes": 12, "repetitions": 5, "contentsImage": "c:1", "simulatorImage": "s:1",
            },
        });
        let plan: RunPlan = serde_json::from_value(plan).unwrap();
        assert_eq!([plan.total_of(0), plan.total_of(1), plan.total_of(3)], [0, 30, 0]);
        let plan = plan.of_check();
        assert_eq!(plan.carla.slices, [RouteSlice { first: 4, last: 4 }]);
        assert_eq!((plan.carla.routes, plan.carla.repetitions, plan.total_of(1)), (1, 1, 1));
    }
}
