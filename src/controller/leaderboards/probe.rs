//! What is tried for a Leaderboard from time to time: its token, its places in AWS, its Pod.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use k8s_openapi::api::core::v1::Secret;
use kube::api::{ApiResource, DynamicObject, PostParams};
use kube::{Api, Client, ResourceExt};
use leaderboard_results::metrics;

use super::Uses;
use super::claims::{self, Claims};
use super::places::{self, Readings};
use super::pod_notes::{TrackPods, notes};
use super::priority::{self, Asked};
use super::queue_readers;
use super::reach::{Reach, Unreachable, capitalized};
use super::shared_queue::SharedQueue;
use crate::controller::objects::key_of;
use crate::controller::settings::Settings;
use crate::controller::submissions::job_spec::{self, JobInput};
use crate::controller::submissions::pod_overlay;
use crate::kubernetes::call;
use crate::observability::metrics::LimitsState;
use crate::pod::run::results_format;
use crate::services::ObjectKey;
use crate::services::aws::Aws;
use crate::services::evalai::{Hub, InboxTrouble, Labels, Target};
use crate::services::queue::Reading;
use crate::services::token::{Token, TokenSource};
use leaderboard_api::{Evalai, EvalaiMode, JobNumber, Leaderboard, Submission, Token as TokenPlace, Track, effective};

/// A token is looked at again after this long.
const AGAIN: SignedDuration = SignedDuration::from_mins(5);
/// A failed look is repeated sooner.
const SOON: SignedDuration = SignedDuration::from_secs(15);

/// What was last found.
#[derive(Clone, Default)]
pub(super) struct Probe {
    token: Option<Result<Arc<Token>, String>>,
    token_at: Option<Timestamp>,
    reach: Reach,
    /// Whether somebody else reads its queue.
    queue: Option<SharedQueue>,
    /// Messages of the queue, visible and in flight, and of its dead-letter queue.
    messages: Option<(u64, u64)>,
    dead_letters: Option<u64>,
    /// The way to EvalAI that follows.
    target: Option<Arc<Target>>,
    /// Generation whose Pods were tried, and what was found.
    pod: Option<(i64, TriedPods)>,
    priority: priority::Problems,
    priority_at: Option<Timestamp>,
    /// Generation whose claims were looked after, when, and how they stand.
    claims: Option<(i64, Timestamp, Claims)>,
}

/// What was found of a Leaderboard's Pods.
#[derive(Clone, Default)]
struct TriedPods {
    /// Why they would be refused.
    refused: Option<String>,
    /// What their host should know all the same.
    notes: Vec<String>,
    /// Their PriorityClasses.
    classes: BTreeMap<String, Asked>,
}

/// How a Leaderboard stands with EvalAI.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum EvalaiStanding {
    NotRequired,
    NoToken(String),
    TokenRefused(String),
    /// Its queue in EvalAI is not read.
    QueueUnread(InboxTrouble),
    /// Its phases or labels do not fit the challenge.
    Misfit(String),
    /// Not checked yet, or EvalAI does not answer.
    Unchecked(Option<String>),
    Fits {
        /// Something to be said although it works, such as a token that ends soon.
        note: Option<String>,
    },
}

impl Probe {
    /// Tries what is due.
    pub(super) async fn refresh(mut self, uses: Uses<'_>, leaderboard: &Leaderboard, now: Timestamp) -> Self {
        let client = uses.policies.client;
        let generation = leaderboard.metadata.generation.unwrap_or_default();
        if self.pod.as_ref().is_none_or(|(tried, _)| *tried != generation) {
            let tried = try_pods(client, uses.settings, leaderboard).await;
            self.pod = Some((generation, tried));
            self.priority_at = None;
        }
        self.refresh_priority(client, now).await;
        self.refresh_claims(client, leaderboard, generation, now).await;
        let reach = std::mem::take(&mut self.reach);
        // A bucket that hangs must not keep EvalAI waiting.
        let is_queue_due = self.queue.as_ref().is_some_and(|queue| queue.is_due(now));
        let places = places::look(uses.aws, leaderboard, reach, is_queue_due, now);
        let readings;
        ((self.reach, readings), ()) = tokio::join!(places, self.refresh_token(uses, leaderboard, now));
        self.note_messages(leaderboard, &readings);
        self.refresh_queue(uses, leaderboard, readings.queue, now).await;
        self
    }

    /// Keeps what SQS last said of the queues that the Leaderboard still names.
    fn note_messages(&mut self, leaderboard: &Leaderboard, readings: &Readings) {
        let queue = leaderboard.spec.queue.as_ref();
        let read = readings.queue.as_ref();
        let messages = read.map(|read| (read.visible, read.in_flight)).or(self.messages);
        self.messages = messages.filter(|_| queue.is_some());
        let dead = readings.dead_letters.as_ref().map(|read| read.visible);
        let has_dead = queue.is_some_and(|queue| queue.dead_letter_url.is_some());
        self.dead_letters = dead.or(self.dead_letters).filter(|_| has_dead);
    }

    /// For metrics.
    pub(super) fn limits(&self) -> LimitsState {
        let token = self.token.as_ref().and_then(|token| token.as_ref().ok());
        LimitsState {
            token_ends: token.and_then(|token| token.expires()),
            queue: self.messages,
            dead_letters: self.dead_letters,
            ..LimitsState::default()
        }
    }

    async fn refresh_priority(&mut self, client: &Client, now: Timestamp) {
        let classes = self.pod.as_ref().map(|(_, tried)| &tried.classes);
        let Some(classes) = classes.filter(|classes| !classes.is_empty()) else {
            self.priority = priority::Problems::default();
            return;
        };
        if due(self.priority_at, self.priority.refused.is_none(), now) {
            self.priority = priority::look(client, classes).await;
            self.priority_at = Some(now);
        }
    }

    async fn refresh_claims(&mut self, client: &Client, leaderboard: &Leaderboard, generation: i64, now: Timestamp) {
        let of_spec = self.claims.as_ref().filter(|(of, _, _)| *of == generation);
        let is_due = match of_spec {
            None => true,
            Some((_, _, Claims::NotRequired)) => false,
            Some((_, at, found)) => due(Some(*at), *found == Claims::InPlace, now),
        };
        if !is_due {
            return;
        }
        let is_known = of_spec.is_some();
        let found = claims::keep(client, leaderboard).await;
        if is_known
            && found == Claims::InPlace
            && let Err(error) = claims::remove_others(client, leaderboard).await
        {
            tracing::warn!(leaderboard = %key_of(leaderboard), %error, "old ResourceClaimTemplates are not removed");
        }
        self.claims = Some((generation, now, found));
    }

    async fn refresh_queue(
        &mut self,
        uses: Uses<'_>,
        leaderboard: &Leaderboard,
        reading: Option<Reading>,
        now: Timestamp,
    ) {
        let before = self.queue.take();
        let Some(queue) = &leaderboard.spec.queue else { return };
        let (client, stores) = (uses.policies.client, uses.policies.stores);
        let known = before.unwrap_or_else(|| SharedQueue::of_status(leaderboard));
        let mut known = known.of_queue(&queue.url);
        if queue_readers::is_on_purpose(stores, queue) {
            known = SharedQueue::default().of_queue(&queue.url);
        } else if let Some(reading) = reading {
            let sign = queue_readers::sign(client, stores, queue, &reading, now).await;
            known.take(&reading, sign, now);
        }
        self.queue = Some(known);
    }

    /// The note about another reader of its queue.
    pub(super) fn shared_queue(&self) -> Option<String> {
        self.queue.as_ref()?.message()
    }

    async fn refresh_token(&mut self, uses: Uses<'_>, leaderboard: &Leaderboard, now: Timestamp) {
        let Some(evalai) = &leaderboard.spec.evalai else { return };
        let refused = uses.external.hub.token_refused(&key_of(leaderboard)).is_some();
        let good = self.token.as_ref().is_some_and(Result::is_ok) && !refused;
        if due(self.token_at, good, now) {
            self.token = Some(read_token(uses.policies.client, uses.aws, leaderboard, &evalai.token).await);
            self.token_at = Some(now);
        }
        if let Some(Ok(token)) = &self.token {
            self.target = Some(serve(&uses.external.hub, leaderboard, evalai, token));
        }
    }

    /// How EvalAI is reached, once there is a token.
    pub(super) fn target(&self) -> Option<Arc<Target>> {
        self.target.clone()
    }

    pub(super) fn invalid_pod(&self) -> Option<String> {
        let of_pod = self.pod.as_ref().and_then(|(_, tried)| tried.refused.clone());
        of_pod.or_else(|| self.priority.refused.clone())
    }

    pub(super) fn pod_notes(&self) -> Vec<String> {
        let tried = self.pod.as_ref();
        let of_pods = tried.map(|(_, tried)| tried.notes.clone()).unwrap_or_default();
        of_pods.into_iter().chain(self.priority.notes.clone()).collect()
    }

    pub(super) fn claims(&self) -> Claims {
        let found = self.claims.as_ref();
        found.map(|(_, _, found)| found.clone()).unwrap_or_default()
    }

    pub(super) fn place_notes(&self, now: Timestamp) -> Vec<String> {
        self.reach.notes(now)
    }

    pub(super) fn unreachable(&self, now: Timestamp) -> Option<Unreachable> {
        self.reach.unreachable(now)
    }

    /// When something has to be tried again.
    pub(super) fn next(&self, now: Timestamp) -> Option<Timestamp> {
        let waits = self.token.as_ref().is_some_and(Result::is_err);
        let token = self.token_at.filter(|_| waits);
        let has_bad_class = self.priority.refused.is_some();
        let priority = self.priority_at.filter(|_| has_bad_class);
        let is_wrong = |claims: &Claims| matches!(claims, Claims::NotServed | Claims::Missing(_));
        let claims = self.claims.as_ref().filter(|(_, _, found)| is_wrong(found));
        let claims = claims.map(|(_, at, _)| *at);
        let [token, priority, claims] = [token, priority, claims].map(|at| at?.checked_add(SOON).ok());
        let queue = self.queue.as_ref().and_then(SharedQueue::next);
        [self.reach.next(now), token, claims, priority, queue]
            .into_iter()
            .flatten()
            .min()
    }

    pub(super) fn evalai_standing(
        &self,
        hub: &Hub,
        leaderboard: &Leaderboard,
        key: &ObjectKey,
        now: Timestamp,
    ) -> EvalaiStanding {
        if leaderboard.spec.evalai.is_none() {
            return EvalaiStanding::NotRequired;
        }
        let token = match &self.token {
            None => return EvalaiStanding::Unchecked(None),
            Some(Err(why)) => return EvalaiStanding::NoToken(why.clone()),
            Some(Ok(token)) => token,
        };
        if let Some(why) = hub.token_refused(key) {
            return EvalaiStanding::TokenRefused(why);
        }
        match hub.inbox_trouble(key) {
            Some(trouble) if trouble.is_refused => return EvalaiStanding::QueueUnread(trouble),
            Some(trouble) if hub.labels(key).0.is_none_or(|labels| labels.ok()) => {
                return EvalaiStanding::QueueUnread(trouble);
            }
            _ => {}
        }
        match hub.labels(key) {
            (None, why) => EvalaiStanding::Unchecked(why),
            (Some(labels), _) if !labels.ok() => {
                let problems: Vec<String> = labels.problems.iter().map(ToString::to_string).collect();
                EvalaiStanding::Misfit(problems.join("; "))
            }
            (Some(labels), _) => EvalaiStanding::Fits {
                note: note(&labels, ends_soon(token, now)),
            },
        }
    }
}

/// What is worth saying although results can be published: columns that stay empty, and a token that ends soon.
fn note(labels: &Labels, of_token: Option<String>) -> Option<String> {
    let of_labels = labels.problems.iter().map(|problem| capitalized(&problem.to_string()));
    let notes: Vec<String> = of_labels.chain(of_token).collect();
    (!notes.is_empty()).then(|| notes.join(" "))
}

fn ends_soon(token: &Token, now: Timestamp) -> Option<String> {
    token.ends_soon(now).then(|| {
        let when = token
            .expires()
            .map(|t| t.strftime("%Y-%m-%d").to_string())
            .unwrap_or_default();
        if token.expires().is_some_and(|end| end <= now) {
            return format!("EvalAI's token has ended on {when}; put a new one where evalai.token says.");
        }
        format!("EvalAI's token ends on {when}; put a new one where evalai.token says before.")
    })
}

fn due(at: Option<Timestamp>, good: bool, now: Timestamp) -> bool {
    let wait = if good { AGAIN } else { SOON };
    // A clock that was set back makes it due as well.
    at.is_none_or(|at| now.duration_since(at) >= wait || now < at)
}

async fn read_token(
    client: &Client,
    aws: &Aws,
    leaderboard: &Leaderboard,
    place: &TokenPlace,
) -> Result<Arc<Token>, String> {
    let source = match (&place.secret_key_ref, &place.secrets_manager) {
        (Some(key), _) => {
            let namespace = leaderboard.namespace().unwrap_or_default();
            let api: Api<Secret> = Api::namespaced(client.clone(), &namespace);
            let secret = call("reading the token", &key.name, api.get(&key.name))
                .await
                .map_err(|error| format!("Secret {} cannot be read: {}", key.name, error.cause()))?;
            let value = secret.data.as_ref().and_then(|d| d.get(&key.key));
            let value = value.ok_or_else(|| format!("Secret {} has no key {}", key.name, key.key))?;
            let text = String::from_utf8(value.0.clone())
                .map_err(|_| format!("key {} of Secret {} is not text", key.key, key.name))?;
            TokenSource::Literal(text)
        }
        (None, Some(entry)) => TokenSource::SecretsManager {
            id: entry.id.clone(),
            key: entry.key.clone(),
            region: entry.region.clone(),
            endpoint: entry.endpoint.clone(),
        },
        (None, None) => return Err("evalai.token names no place".into()),
    };
    source.read(aws).await.map(Arc::new).map_err(|e| e.to_string())
}

fn serve(hub: &Hub, leaderboard: &Leaderboard, evalai: &Evalai, token: &Arc<Token>) -> Arc<Target> {
    let format = results_format(leaderboard.spec.leaderboard_version);
    let target = Target {
        api_server: evalai.server(),
        challenge: evalai.challenge,
        split: evalai.split.clone(),
        token: Arc::clone(token),
        requests_per_minute: evalai.requests_per_minute.unsigned_abs(),
        sweep: Duration::from_secs(evalai.sweep_seconds.unsigned_abs()),
        period: Duration::from_secs(leaderboard.spec.sync_period_seconds.unsigned_abs()),
        phases: leaderboard.spec.tracks.iter().filter_map(|t| t.phase).collect(),
        labels: metrics(format).iter().map(|m| m.name.to_owned()).collect(),
        inbox: evalai.queue.as_ref().map(|queue| queue.name.clone()),
        is_observed: evalai.mode == EvalaiMode::Observe,
        since: leaderboard
            .metadata
            .creation_timestamp
            .as_ref()
            .map(|t| t.0)
            .unwrap_or_default(),
    };
    if let Err(error) = hub.serve(&key_of(leaderboard), &target) {
        tracing::error!(leaderboard = %leaderboard.name_any(), %error, "cannot create EvalAI client");
    }
    Arc::new(target)
}

/// Whether Pods of this Leaderboard would be refused, by our own rules or by the API server's dry run; and what is to be noted.
async fn try_pods(client: &Client, settings: &Settings, leaderboard: &Leaderboard) -> TriedPods {
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
    let mut templates = jobs.iter().map(|(_, job)| template(job));
    let unclear = templates.find_map(|template| job_spec::unclear(&leaderboard.spec, &template));
    TriedPods {
        notes: notes(&pods),
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
        number: JobNumber::first(1),
        settings,
        without_gpu: &[],
        addresses: None,
        now: Timestamp::now(),
    }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::services::evalai::Misfit;

    #[test]
    fn columns_that_stay_empty_and_a_token_that_ends_soon_are_said() {
        let labels = |problems| Labels {
            at: Timestamp::UNIX_EPOCH,
            problems,
            partial: vec![],
        };
        let ends = || Some("EvalAI's token ends on 2027-01-01.".to_owned());
        assert_eq!(note(&labels(vec![]), None), None);
        assert_eq!(note(&labels(vec![]), ends()), ends());
        let unsent = Misfit::Unsent {
            phase: 2,
            labels: vec!["Speed".into(), "Comfort".into()],
        };
        let said = note(&labels(vec![unsent]), ends()).unwrap();
        assert_eq!(
            said,
            "The leaderboard of phase 2 also has Speed, Comfort, which the operator never sends and which stay empty; remove them from its schema, or check spec.leaderboardVersion. EvalAI's token ends \
             on 2027-01-01."
        );
    }
}
