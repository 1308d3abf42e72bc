//! The questions about a Leaderboard's token, its places in AWS and its Pods. A reconcile asks and finds the answers in memory; an answer
//! that is news wakes it.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use k8s_openapi::api::core::v1::Secret;
use kube::{Api, Client};

use super::places;
use super::pod_findings::TriedPods;
use super::reach::{AwsResource, Place, Reach};
use super::token::of_entry;
use super::tried_pods::{self, Pods};
use crate::ask::{Asked, Asker, Wake};
use crate::kubernetes::call;
use crate::metrics::leader::{self, Gauge};
use crate::runtime::objects::key_of;
use crate::runtime::settings::Settings;
use leaderboard_api::{EvalaiMode, Leaderboard, LeaderboardSpec, Token as TokenPlace, Track};
use leaderboard_aws::clients::Aws;
use leaderboard_base::spans::LogSpan;
use leaderboard_base::tasks::Tasks;
use leaderboard_evalai::token::Token;
use leaderboard_evalai::{Metrics, Target};
use leaderboard_policy::ask::{Ask, Failure, Lookup, Service};

/// A token is looked at again after this long.
const AGAIN: Duration = Duration::from_mins(5);
/// A failed look is repeated sooner.
const SOON: Duration = Duration::from_secs(15);
/// A token that EvalAI refuses may be renewed at any moment, and runs wait for that.
const REFUSED: Duration = Duration::from_secs(6);

/// Asks for a Leaderboard's token.
#[derive(Clone, Debug, PartialEq)]
pub struct TokenQuestion {
    place: TokenPlace,
    /// EvalAI refuses the token that is used now.
    is_refused: bool,
}

impl Ask for TokenQuestion {
    type Answer = Arc<Token>;
    const AT_ONCE: usize = 16;
    const AT_ONCE_OF_A_SERVICE: usize = 8;
    const LONGEST: Duration = Duration::from_secs(30);

    fn service(&self) -> Service {
        let entry = self.place.secrets_manager.as_ref();
        entry.map_or_else(Service::api_server, Service::secret)
    }

    fn again(&self, result: &Result<Arc<Token>, Failure>, _failures: u32, _waited: Duration) -> Option<Duration> {
        Some(match result {
            Ok(_) if self.is_refused => REFUSED,
            Ok(_) => AGAIN,
            Err(_) => SOON,
        })
    }
}

/// Asks for all that Leaderboards name.
pub struct Asks {
    token: Asker<TokenQuestion>,
    pods: Asker<Pods>,
    places: BTreeMap<AwsResource, Asker<Place>>,
}

impl Asks {
    /// Starts the tasks. Each task calls its own result of `wake` with each Leaderboard that has news.
    pub fn start(client: &Client, aws: &Aws, settings: &Settings, tasks: &Tasks, wake: impl Fn() -> Wake) -> Self {
        let places = AwsResource::ALL.into_iter().map(|(resource, task)| {
            let asker = Asker::start(task, tasks, wake(), aws.clone(), places::ask);
            (resource, asker)
        });
        let (secrets, trying) = ((client.clone(), aws.clone()), (client.clone(), settings.clone()));
        Self {
            token: Asker::start("ask tokens", tasks, wake(), secrets, read_token),
            pods: Asker::start("try Pods", tasks, wake(), trying, tried_pods::try_pods),
            places: places.collect(),
        }
    }

    /// Asks for all that a Leaderboard names.
    pub(super) fn ask(&self, leaderboard: &Arc<Leaderboard>, is_token_refused: bool) -> Looked {
        let (key, log) = (key_of(leaderboard.as_ref()), LogSpan::default);
        if let Some(evalai) = &leaderboard.spec.evalai {
            let question = TokenQuestion {
                place: evalai.token.clone(),
                is_refused: is_token_refused,
            };
            self.token.want(&key, question, log());
        }
        self.pods.want(&key, Pods(Arc::clone(leaderboard)), log());
        for place in places::named(leaderboard) {
            if let Some(asker) = self.places.get(&place.resource) {
                asker.want(&key, place, log());
            }
        }
        self.known(leaderboard)
    }

    /// All that is known of a Leaderboard.
    pub(super) fn known(&self, leaderboard: &Arc<Leaderboard>) -> Looked {
        let uid = key_of(leaderboard.as_ref()).uid;
        let named = places::named(leaderboard).into_iter();
        let known = |place: Place| {
            let lookup = self.places.get(&place.resource)?.get(&uid);
            Some((place, lookup))
        };
        Looked {
            token: self.token.get(&uid),
            pods: self.pods.get(&uid),
            reach: Reach(named.filter_map(known).collect()),
        }
    }

    /// Drops what is known of a Leaderboard that is gone.
    pub fn forget(&self, uid: &str) {
        self.token.forget(uid);
        self.pods.forget(uid);
        self.places.values().for_each(|asker| asker.forget(uid));
    }
}

/// The answers about all that a Leaderboard names.
#[derive(Debug, Default)]
pub(super) struct Looked {
    token: Lookup<TokenQuestion>,
    pods: Lookup<Pods>,
    pub(super) reach: Reach,
}

impl Looked {
    /// The longest wait for an answer about the Leaderboard as it is; None: there are all.
    pub(super) fn waits(&self) -> Option<Duration> {
        let places = self.reach.0.iter().filter_map(|(_, lookup)| unanswered(lookup));
        let others = [unanswered(&self.token), unanswered(&self.pods)];
        places.chain(others.into_iter().flatten()).max()
    }

    /// Shows in metrics what is known of the token and the queues.
    pub(super) fn show(&self, leaderboard: &Leaderboard, mut show: impl FnMut(&Gauge<1>, Option<i64>)) {
        let token = self.token(leaderboard).and_then(|token| token.as_ref().ok());
        let ends = token.and_then(|token| token.expires());
        show(&leader::TOKEN_EXPIRY, ends.map(Timestamp::as_second));
        let (visible, in_flight) = self.reach.messages(AwsResource::Queue).unzip();
        let dead = self.reach.messages(AwsResource::DeadLetterQueue);
        let messages = [
            (&leader::VISIBLE_MESSAGES, visible),
            (&leader::IN_FLIGHT_MESSAGES, in_flight),
            (&leader::DEAD_LETTERS, dead.map(|(visible, _)| visible)),
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
            metrics: metrics(spec),
            inbox: spec.evalai_queue().map(|queue| queue.name.clone()),
            is_observed: evalai.mode == EvalaiMode::Observe,
            takes_files: spec.evaluation.takes_files(),
            since: created.map(|time| time.0).unwrap_or_default(),
        })
    }

    /// The token, or why there is none, where the Leaderboard names it now.
    pub(super) fn token(&self, leaderboard: &Leaderboard) -> Option<&Result<Arc<Token>, Failure>> {
        let place = &leaderboard.spec.evalai.as_ref()?.token;
        let found = self
            .token
            .last
            .as_ref()
            .filter(|found| found.question.place == *place)?;
        Some(&found.result)
    }

    /// The findings about its Pods.
    pub(super) fn pods(&self) -> TriedPods {
        let found = self.pods.known().and_then(|found| found.result.as_ref().as_ref().ok());
        found.cloned().unwrap_or_default()
    }
}

/// What of its results a Leaderboard publishes: where its kind of evaluation knows no metrics, those that EvalAI lists.
fn metrics(spec: &LeaderboardSpec) -> Metrics {
    let columns = leaderboard_evaluation::of(spec).columns();
    if columns.is_empty() {
        let split = |track: &Track| Some((track.phase?, track.container.as_ref()?.score.split.clone()));
        let splits: BTreeMap<_, _> = spec.tracks.iter().filter_map(split).collect();
        return Metrics::Listed(Arc::new(splits));
    }
    Metrics::Fixed(columns.into_iter().map(|column| column.label.to_owned()).collect())
}

/// Time that a question has waited for its first answer.
fn unanswered<Q: Ask>(lookup: &Lookup<Q>) -> Option<Duration> {
    let asked = lookup.asked.as_ref().filter(|asked| lookup.answer_to(asked).is_none());
    asked.and(lookup.waited)
}

async fn read_token(
    (client, aws): (Client, Aws),
    Asked { about, question, .. }: Asked<TokenQuestion>,
) -> Result<Arc<Token>, Failure> {
    let read = token_of(&client, &aws, &about.namespace, &question.place).await;
    read.map(Arc::new).map_err(|why| Failure { is_refused: true, why })
}

async fn token_of(client: &Client, aws: &Aws, namespace: &str, place: &TokenPlace) -> Result<Token, String> {
    let token = match (&place.secret_key_ref, &place.secrets_manager) {
        (Some(key), _) => {
            let api: Api<Secret> = Api::namespaced(client.clone(), namespace);
            let secret = call("reading the token", &key.name, api.get(&key.name))
                .await
                .map_err(|error| format!("Secret {} cannot be read: {}", key.name, error.cause()))?;
            let value = secret.data.as_ref().and_then(|d| d.get(&key.key));
            let value = value.ok_or_else(|| format!("Secret {} has no key {}", key.name, key.key))?;
            let text = String::from_utf8(value.0.clone())
                .map_err(|_| format!("key {} of Secret {} is not text", key.key, key.name))?;
            Token::parse(&text)
        }
        (None, Some(entry)) => of_entry(aws, entry).await,
        (None, None) => return Err("evalai.token names no place".into()),
    };
    token.map_err(|error| error.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;
    use leaderboard_policy::ask::Answered;

    #[test]
    fn a_token_counts_only_for_the_place_where_it_was_found() {
        let board = |secret: &str| {
            let spec = serde_json::json!({
                "evalai": {"apiServer": "https://e", "challenge": 1, "token": {"secretKeyRef": {"name": secret, "key": "k"}}},
                "tracks": [{"name": "sensors", "phase": 1}],
                "evaluation": {"carla": {
                    "version": "V2", "contents": {"image": "c"}, "simulator": {"image": "s"},
                }}, "storage": {"s3": {"bucket": "bbb"}},
            });
            Leaderboard::new("one", serde_json::from_value(spec).unwrap())
        };
        let (old, new) = (board("old"), board("new"));
        let token = Ok(Arc::new(Token::parse("abc").unwrap()));
        let question = |is_refused| TokenQuestion {
            place: old.spec.evalai.clone().unwrap().token,
            is_refused,
        };
        let again = |is_refused| question(is_refused).again(&token, 0, Duration::ZERO);
        assert_eq!((again(false), again(true)), (Some(AGAIN), Some(REFUSED)));
        let last = Answered {
            question: question(false),
            sent_ago: Duration::ZERO,
            result: Arc::new(token.clone()),
        };
        let looked = Looked {
            token: Lookup {
                asked: Some(question(true)),
                last: Some(last),
                ..Lookup::default()
            },
            ..Looked::default()
        };
        assert!(looked.target(&old).is_some(), "also while it is read again");
        assert!(looked.target(&new).is_none());
    }
}
