//! Questions that programs ask of a plan and of a Leaderboard, for every kind of evaluation.
//!
//! Pure. Fields of one kind alone are read here, and in `evaluation`.

use k8s_openapi::api::core::v1::{EnvVar, ResourceRequirements, SecurityContext};

use super::agents::Agents;
use super::leaderboard_parts::Evaluation;
use super::{
    CarlaPlan, ContainerPlan, DataSource, LeaderboardSpec, PlannedEvaluation, RouteSlice, RunPlan, Track, effective,
};

impl RunPlan {
    /// How its agents stand to the containers of the host.
    pub fn agents(&self) -> Agents {
        self.container()
            .map_or(Agents::Beside, |container| container.mode.agents())
    }

    /// How many workers share the work.
    pub fn sharing(&self) -> usize {
        match &self.evaluation {
            PlannedEvaluation::Carla(carla) => carla.slices.len(),
            PlannedEvaluation::Container(container) => usize::try_from(container.workers).unwrap_or(1),
        }
    }

    /// The number of the worker whose command merges the results of all others, if there is one. It is the last, and has no agent.
    pub fn merger(&self) -> Option<usize> {
        self.container().and_then(ContainerPlan::merger)
    }

    /// How many workers there are, the one that merges among them.
    pub fn workers(&self) -> usize {
        self.merger().unwrap_or_else(|| self.sharing())
    }

    /// How agents stand to the container of the host of one worker, which counts from 1.
    pub fn agents_of(&self, worker: usize) -> Agents {
        if self.merger() == Some(worker) {
            Agents::Absent
        } else {
            self.agents()
        }
    }

    /// True if this worker has an agent. One that runs before all evaluators is the first worker's.
    pub fn has_agent(&self, worker: usize) -> bool {
        match self.agents_of(worker) {
            Agents::Beside => true,
            Agents::First => worker == 1,
            Agents::Absent => false,
        }
    }

    /// How many workers have an agent.
    pub fn agent_count(&self) -> usize {
        (1..=self.workers()).filter(|worker| self.has_agent(*worker)).count()
    }

    /// The plan of CARLA's evaluation, if it is one.
    pub fn carla(&self) -> Option<&CarlaPlan> {
        match &self.evaluation {
            PlannedEvaluation::Carla(carla) => Some(carla),
            PlannedEvaluation::Container(_) => None,
        }
    }

    /// The plan of an evaluation by a container of the host's, if it is one.
    pub fn container(&self) -> Option<&ContainerPlan> {
        match &self.evaluation {
            PlannedEvaluation::Carla(_) => None,
            PlannedEvaluation::Container(container) => Some(container),
        }
    }

    /// Units of work of one worker, which counts from 1; 0 if the plan has no such worker, and where the host's evaluator alone knows it.
    pub fn total_of(&self, worker: i32) -> i32 {
        let Some(carla) = self.carla() else {
            return 0;
        };
        let index = usize::try_from(worker).ok().and_then(|worker| worker.checked_sub(1));
        let slice = index.and_then(|index| carla.slices.get(index));
        let units = slice.and_then(|slice| i32::try_from(slice.routes()).ok()?.checked_mul(carla.repetitions));
        units.unwrap_or(0)
    }

    /// The plan of a check: one worker, and with CARLA the first route once.
    #[must_use]
    pub fn of_check(mut self) -> Self {
        match &mut self.evaluation {
            PlannedEvaluation::Carla(carla) => {
                let first = carla.slices.first().map_or(0, |slice| slice.first);
                carla.slices = vec![RouteSlice { first, last: first }];
                (carla.routes, carla.repetitions) = (1, 1);
            }
            PlannedEvaluation::Container(container) => container.workers = 1,
        }
        self
    }

    /// The plan with the images that the Leaderboard names now, but for the participant's.
    #[must_use]
    pub fn renewed(mut self, spec: &LeaderboardSpec) -> Self {
        match (&mut self.evaluation, &spec.evaluation) {
            (PlannedEvaluation::Carla(carla), Evaluation::Carla(now)) => {
                carla.contents_image = now.contents.image.as_str().into();
                carla.simulator_image = now.simulator.image.as_str().into();
            }
            (PlannedEvaluation::Container(container), Evaluation::Container(now)) => {
                container.image = now.image.as_str().into();
                container.input = now.mode.has_input().then(|| now.input_bounds());
            }
            // The kind of a Leaderboard is immutable.
            (PlannedEvaluation::Carla(_), Evaluation::Container(_))
            | (PlannedEvaluation::Container(_), Evaluation::Carla(_)) => {}
        }
        self
    }

    /// Gives back memory that its lists do not need.
    pub fn shrink_to_fit(&mut self) {
        if let PlannedEvaluation::Carla(carla) = &mut self.evaluation {
            carla.slices.shrink_to_fit();
        }
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
    /// Fields that the host writes of a container, with the overrides of a track. `None` for a part that its kind of evaluation has not.
    pub fn given<'a>(&'a self, track: Option<&Track>, part: Part) -> Option<Given<'a>> {
        let given = match (part, &self.evaluation) {
            (Part::Contents, Evaluation::Container(_)) => return None,
            (Part::Contents, Evaluation::Carla(carla)) => Given {
                path: "evaluation.carla.contents",
                env: &carla.contents.env,
                resources: carla.contents.resources.clone(),
                security: carla.contents.security_context.as_ref(),
            },
            (Part::Host, Evaluation::Carla(carla)) => Given {
                path: "evaluation.carla.simulator",
                env: &carla.simulator.env,
                resources: effective::resources(
                    track.and_then(|track| track.carla.simulator.as_ref()),
                    carla.simulator.resources.as_ref(),
                ),
                security: carla.simulator.security_context.as_ref(),
            },
            (Part::Host, Evaluation::Container(container)) => Given {
                path: "evaluation.container",
                env: &container.env,
                resources: effective::resources(
                    track.and_then(|track| track.container.as_ref()?.evaluator.as_ref()),
                    container.resources.as_ref(),
                ),
                security: container.security_context.as_ref(),
            },
            (Part::Agent, _) => Given {
                path: "agent",
                env: &self.agent.env,
                resources: effective::resources(
                    track.and_then(|track| track.agent.as_ref()),
                    self.agent.resources.as_ref(),
                ),
                security: self.agent.security_context.as_ref(),
            },
        };
        Some(given)
    }

    /// Images of the host, which no submission may name.
    pub fn host_images(&self) -> Vec<&str> {
        match &self.evaluation {
            Evaluation::Carla(carla) => vec![&carla.contents.image, &carla.simulator.image],
            Evaluation::Container(container) => {
                let data = [&container.dataset, &container.labels].into_iter().flatten();
                let of_data = data.filter_map(DataSource::image).map(|image| image.reference.as_str());
                of_data.chain([container.image.as_str()]).collect()
            }
        }
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
        let carla = plan.carla().unwrap();
        assert_eq!(carla.slices, [RouteSlice { first: 4, last: 4 }]);
        assert_eq!((carla.routes, carla.repetitions, plan.total_of(1)), (1, 1, 1));
    }

    #[test]
    fn the_worker_that_merges_comes_last_and_has_no_agent() {
        for (mode, merge, agents) in [
            ("Interactive", "Mean", vec![1, 2]),
            ("Interactive", "Command", vec![1, 2]),
            ("Batch", "Sum", vec![1]),
            ("Batch", "Command", vec![1]),
            ("Predictions", "Command", vec![]),
        ] {
            let container = json!({"mode": mode, "workers": 2, "merge": merge, "score": {"metric": "m"}, "image": "e"});
            let plan = json!({
                "runId": "7", "track": "t", "storage": {"s3": {"bucket": "b"}}, "image": "a:1", "container": container,
            });
            let plan: RunPlan = serde_json::from_value(plan).unwrap();
            let merger = (merge == "Command").then_some(3);
            assert_eq!((plan.sharing(), plan.merger()), (2, merger), "{mode} {merge}");
            assert_eq!(plan.workers(), merger.unwrap_or(2), "{mode} {merge}");
            let found: Vec<usize> = (1..=plan.workers()).filter(|worker| plan.has_agent(*worker)).collect();
            assert_eq!((found.len(), &found), (plan.agent_count(), &agents), "{mode} {merge}");
            assert_eq!(plan.of_check().merger(), merger.map(|_| 2), "{mode} {merge}");
        }
    }
}
