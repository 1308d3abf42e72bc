//! What is known of a Leaderboard's token, its places in AWS and its Pods, when each of them has to be looked at, and the look itself.
//!
//! `looks` calls the look; a reconcile asks only what is known and what is due.

use std::sync::Arc;
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use k8s_openapi::api::core::v1::Secret;
use kube::{Api, Client, ResourceExt};

use super::claims;
use super::places::{self, Readings};
use super::priority;
use super::reach::{AwsResource, Reach};
use super::tried_pods::{TriedPods, try_pods};
use crate::controller::leaderboards::token::TokenSource;
use crate::controller::leaderboards::view::Claims;
use crate::controller::objects::key_of;
use crate::controller::settings::Settings;
use crate::controller::stores::Stores;
use crate::kubernetes::call;
use crate::observability::metrics::leader::{self, Gauge};
use crate::pod::carla::results_format;
use crate::services::aws::Aws;
use crate::services::evalai::Target;
use crate::services::token::Token;
use leaderboard_api::{EvalaiMode, Leaderboard, Token as TokenPlace};
use leaderboard_results::metrics;

/// A token is looked at again after this long.
const AGAIN: SignedDuration = SignedDuration::from_mins(5);
/// A failed look is repeated sooner.
const SOON: SignedDuration = SignedDuration::from_secs(15);
/// A token that EvalAI refuses may be renewed at any moment, and runs wait for that.
const REFUSED: SignedDuration = SignedDuration::from_secs(6);

/// What a look uses.
#[derive(Clone, Copy)]
pub struct Uses<'a> {
    pub client: &'a Client,
    pub aws: &'a Aws,
    pub stores: &'a Stores,
    pub settings: &'a Settings,
}

/// What was last found.
#[derive(Clone, Default)]
pub(super) struct Probe {
    /// Of which spec; of another one everything is due.
    generation: Option<i64>,
    token: Option<FoundToken>,
    pub(super) reach: Reach,
    /// Messages of the queue, visible and in flight, and of its dead-letter queue.
    messages: Option<(u64, u64)>,
    dead_letters: Option<u64>,
    pods: TriedPods,
    priority: priority::Problems,
    priority_at: Option<Timestamp>,
    pub(super) claims: Claims,
    claims_at: Option<Timestamp>,
}

/// What a place had when it was last looked at.
#[derive(Clone)]
struct FoundToken {
    place: TokenPlace,
    at: Timestamp,
    token: Result<Arc<Token>, String>,
}

/// What a look has to ask; of an edited Leaderboard its Pods are tried too.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct Due {
    priority: bool,
    claims: bool,
    token: bool,
    places: Vec<(AwsResource, String)>,
}

impl Due {
    pub(super) fn is_nothing(&self) -> bool {
        *self == Self::default()
    }
}

impl Probe {
    /// Whether all of the Leaderboard as it is was looked at.
    pub(super) fn is_of(&self, leaderboard: &Leaderboard) -> bool {
        self.generation == Some(generation_of(leaderboard))
    }

    /// What has to be looked at now.
    pub(super) fn due(&self, leaderboard: &Leaderboard, is_token_refused: bool, now: Timestamp) -> Due {
        let is_edited = !self.is_of(leaderboard);
        let has_classes = !self.pods.classes.is_empty();
        let has_claims = self.claims != Claims::NotRequired;
        Due {
            priority: is_edited || has_classes && due(self.priority_at, self.priority.refused.is_none(), now),
            claims: is_edited || has_claims && due(self.claims_at, self.claims == Claims::InPlace, now),
            token: leaderboard.spec.evalai.is_some() && self.token_is_due(leaderboard, is_token_refused, now),
            places: places::due(leaderboard, &self.reach, now),
        }
    }

    fn token_is_due(&self, leaderboard: &Leaderboard, is_refused: bool, now: Timestamp) -> bool {
        let Some(found) = self.token_of(leaderboard) else {
            return true;
        };
        let wait = if is_refused && found.token.is_ok() {
            REFUSED
        } else {
            wait(found.token.is_ok())
        };
        has_passed(found.at, wait, now)
    }

    /// Looks at what is due.
    pub(super) async fn look(mut self, uses: Uses<'_>, leaderboard: &Leaderboard, due: Due, now: Timestamp) -> Self {
        let (client, aws) = (uses.client, uses.aws);
        let is_edited = !self.is_of(leaderboard);
        if is_edited {
            self.pods = try_pods(client, uses.settings, leaderboard).await;
        }
        if due.priority {
            self.priority = priority::look(client, &self.pods.classes).await;
            self.priority_at = Some(now);
        }
        if due.claims {
            self.claims = claims::keep(client, leaderboard).await;
            self.claims_at = Some(now);
            // Right after an edit a Job of the spec before may be on its way.
            if !is_edited
                && self.claims == Claims::InPlace
                && let Err(error) = claims::remove_others(client, leaderboard).await
            {
                tracing::warn!(leaderboard = %key_of(leaderboard), %error, "old ResourceClaimTemplates are not removed");
            }
        }
        // A bucket that hangs must not keep EvalAI waiting.
        let places = places::look(aws, leaderboard, &mut self.reach, due.places, now);
        let token = find_token(client, aws, leaderboard, due.token.then_some(now));
        let (readings, read) = tokio::join!(places, token);
        self.token = read.or(self.token);
        self.note_messages(leaderboard, &readings);
        self.generation = Some(generation_of(leaderboard));
        self
    }

    /// Keeps what SQS reported last of the queues that the Leaderboard still names.
    fn note_messages(&mut self, leaderboard: &Leaderboard, readings: &Readings) {
        let queue = leaderboard.spec.queue.as_ref();
        let read = readings.queue.as_ref();
        let messages = read.map(|read| (read.visible, read.in_flight)).or(self.messages);
        self.messages = messages.filter(|_| queue.is_some());
        let dead = readings.dead_letters.as_ref().map(|read| read.visible);
        let has_dead = queue.is_some_and(|queue| queue.dead_letter_url.is_some());
        self.dead_letters = dead.or(self.dead_letters).filter(|_| has_dead);
    }

    /// Shows in metrics what is known of the token and the queues.
    pub(super) fn show(&self, mut show: impl FnMut(&Gauge<1>, Option<i64>)) {
        let token = self.token.as_ref().and_then(|found| found.token.as_ref().ok());
        let ends = token.and_then(|token| token.expires());
        show(&leader::TOKEN_EXPIRY, ends.map(Timestamp::as_second));
        let (visible, in_flight) = self.messages.unzip();
        let messages = [
            (&leader::VISIBLE_MESSAGES, visible),
            (&leader::IN_FLIGHT_MESSAGES, in_flight),
            (&leader::DEAD_LETTERS, self.dead_letters),
        ];
        for (gauge, count) in messages {
            show(gauge, count.map(|count| i64::try_from(count).unwrap_or(i64::MAX)));
        }
    }

    /// The way to EvalAI, once there is a token.
    pub(super) fn target(&self, leaderboard: &Leaderboard) -> Option<Target> {
        let evalai = leaderboard.spec.evalai.as_ref()?;
        let token = self.token(leaderboard)?.as_ref().ok()?;
        let spec = &leaderboard.spec;
        let format = results_format(spec.leaderboard_version);
        let created = leaderboard.metadata.creation_timestamp.as_ref();
        Some(Target {
            leaderboard: key_of(leaderboard),
            api_server: evalai.server(),
            challenge: evalai.challenge,
            split: evalai.split.clone(),
            token: Arc::clone(token),
            requests_per_minute: evalai.requests_per_minute.unsigned_abs(),
            sweep: Duration::from_secs(evalai.sweep_seconds.unsigned_abs()),
            period: Duration::from_secs(spec.sync_period_seconds.unsigned_abs()),
            phases: spec.tracks.iter().filter_map(|t| t.phase).collect(),
            labels: metrics(format).iter().map(|m| m.name.to_owned()).collect(),
            inbox: evalai.queue.as_ref().map(|queue| queue.name.clone()),
            is_observed: evalai.mode == EvalaiMode::Observe,
            since: created.map(|time| time.0).unwrap_or_default(),
        })
    }

    /// Its token, or why there is none, once it was looked for.
    pub(super) fn token(&self, leaderboard: &Leaderboard) -> Option<&Result<Arc<Token>, String>> {
        self.token_of(leaderboard).map(|found| &found.token)
    }

    /// What was found where the Leaderboard names its token.
    fn token_of(&self, leaderboard: &Leaderboard) -> Option<&FoundToken> {
        let place = &leaderboard.spec.evalai.as_ref()?.token;
        self.token.as_ref().filter(|found| found.place == *place)
    }

    pub(super) fn invalid_pod(&self) -> Option<String> {
        self.pods.refused.clone().or_else(|| self.priority.refused.clone())
    }

    pub(super) fn pod_notes(&self) -> Vec<String> {
        self.pods.notes.iter().chain(&self.priority.notes).cloned().collect()
    }

    /// When something has to be tried again.
    pub(super) fn next(&self, leaderboard: &Leaderboard, is_token_refused: bool, now: Timestamp) -> Option<Timestamp> {
        let token = self.token_of(leaderboard);
        let missing = token.filter(|found| found.token.is_err()).map(|found| found.at);
        let refused = token.filter(|found| is_token_refused && found.token.is_ok());
        let refused = refused.and_then(|found| found.at.checked_add(REFUSED).ok());
        let priority = self.priority_at.filter(|_| self.priority.refused.is_some());
        let is_missing = matches!(self.claims, Claims::NotServed | Claims::Missing(_));
        let claims = self.claims_at.filter(|_| is_missing);
        let [missing, priority, claims] = [missing, priority, claims].map(|at| at?.checked_add(SOON).ok());
        [self.reach.next(now), missing, refused, claims, priority]
            .into_iter()
            .flatten()
            .min()
    }
}

fn generation_of(leaderboard: &Leaderboard) -> i64 {
    leaderboard.metadata.generation.unwrap_or_default()
}

fn due(at: Option<Timestamp>, good: bool, now: Timestamp) -> bool {
    at.is_none_or(|at| has_passed(at, wait(good), now))
}

fn wait(good: bool) -> SignedDuration {
    if good { AGAIN } else { SOON }
}

/// A clock that was set back makes it due as well.
fn has_passed(at: Timestamp, wait: SignedDuration, now: Timestamp) -> bool {
    now.duration_since(at) >= wait || now < at
}

async fn find_token(
    client: &Client,
    aws: &Aws,
    leaderboard: &Leaderboard,
    due: Option<Timestamp>,
) -> Option<FoundToken> {
    let (at, evalai) = due.zip(leaderboard.spec.evalai.as_ref())?;
    let place = evalai.token.clone();
    let token = read_token(client, aws, leaderboard, &place).await;
    Some(FoundToken { place, at, token })
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_token_counts_only_for_the_place_where_it_was_found() {
        let board = |secret: &str| {
            let spec = serde_json::json!({
                "evalai": {"apiServer": "https://e", "challenge": 1, "token": {"secretKeyRef": {"name": secret, "key": "k"}}},
                "tracks": [{"name": "sensors", "codename": "SENSORS", "phase": 1}], "leaderboardVersion": "V2",
                "contents": {"image": "c"}, "simulator": {"image": "s"}, "storage": {"bucket": "bbb"},
            });
            Leaderboard::new("one", serde_json::from_value(spec).unwrap())
        };
        let (old, new) = (board("old"), board("new"));
        let now = Timestamp::UNIX_EPOCH;
        let probe = Probe {
            generation: Some(generation_of(&old)),
            token: Some(FoundToken {
                place: old.spec.evalai.clone().unwrap().token,
                at: now,
                token: Ok(Arc::new(Token::parse("abc").unwrap())),
            }),
            ..Probe::default()
        };
        assert!(probe.target(&old).is_some() && !probe.due(&old, false, now).token);
        assert!(
            !probe.due(&old, true, now).token,
            "a refused one is not read again at once"
        );
        let later = now.checked_add(REFUSED).unwrap();
        assert!(probe.due(&old, true, later).token && !probe.due(&old, false, later).token);
        assert!(
            probe.next(&old, true, now) == Some(later),
            "it wakes its Leaderboard for that"
        );
        assert_eq!(probe.next(&old, false, now), None);
        assert!(probe.target(&new).is_none() && probe.due(&new, false, now).token);
    }
}
