//! What registries report of submitted images: one question for each attempt, before its first Job.

use std::sync::Arc;
use std::time::Duration;

use k8s_openapi::api::core::v1::Secret;
use kube::{Api, Client};

use super::questions::{self, Observed, Questions};
use crate::controller::objects::Wake;
use crate::kubernetes::call;
use crate::observability::tasks::Tasks;
use crate::services::aws::Aws;
use crate::services::registry::{Credentials, Facts, Fault, Image, Registries};
use leaderboard_api::{Attempt, Submission};

/// What is asked of a registry.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Question {
    /// An attempt asks anew: its image may have been pushed since.
    pub attempt: Attempt,
    pub image: Image,
    /// Secrets of the Leaderboard's Pods with credentials of registries.
    pub secrets: Vec<String>,
}

impl questions::Question for Question {
    type Answer = Result<Facts, Fault>;
    /// Each answer is at most a few MiB.
    const AT_ONCE: usize = 4;
    /// A participant may choose a registry that takes all its time for each answer.
    const AT_ONCE_OF_A_SERVICE: usize = 3;
    /// One answer serves the whole attempt.
    const GOOD_FOR: Duration = Duration::MAX;

    fn attempt(&self) -> Attempt {
        self.attempt
    }

    fn shares_a_service(&self, other: &Self) -> bool {
        self.image.registry == other.image.registry
    }
}

/// The questions and their answers.
pub type Images = Questions<Question>;

/// What a registry has answered about the image.
pub type ObservedImage = Observed<Result<Facts, Fault>>;

impl Images {
    /// Starts the task that asks.
    pub fn start(aws: &Aws, client: Client, tasks: &Tasks, wake: Wake<Submission>) -> Self {
        let registries = Arc::new(Registries::new(aws));
        let ask = move |question: Question, namespace: String| {
            let (client, registries) = (client.clone(), Arc::clone(&registries));
            async move {
                let credentials = credentials(&client, &namespace, &question).await;
                registries.look_up(&question.image, credentials).await
            }
        };
        Self::answered_by(ask, "images", tasks, wake)
    }
}

/// The first of the Leaderboard's pull secrets that has credentials for the registry. One that cannot be read has none: the registry
/// then shows what it lets everybody read.
async fn credentials(client: &Client, namespace: &str, question: &Question) -> Option<Credentials> {
    let api: Api<Secret> = Api::namespaced(client.clone(), namespace);
    for name in &question.secrets {
        let secret = match call("reading the pull secret", name, api.get(name)).await {
            Ok(secret) => secret,
            Err(error) => {
                tracing::warn!(namespace, "{error}");
                continue;
            }
        };
        let data = secret.data.as_ref().and_then(|data| data.get(".dockerconfigjson"));
        let found = data.and_then(|data| Credentials::of_secret(&data.0, &question.image.registry));
        if found.is_some() {
            return found;
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use kube::runtime::reflector::ObjectRef;

    use super::super::questions::{KEPT, Shared};
    use super::*;
    use crate::observability::about::LogSpan;

    fn question(attempt: i64, reference: &str) -> Question {
        Question {
            attempt: Attempt(attempt),
            image: Image {
                registry: "r.example".into(),
                path: "a".into(),
                reference: reference.into(),
                may_be_local: false,
            },
            secrets: Vec::new(),
        }
    }

    fn by(name: &str) -> ObjectRef<Submission> {
        ObjectRef::new(name).within("one")
    }

    #[tokio::test(start_paused = true)]
    async fn a_question_is_asked_once_and_its_answer_stays_for_its_attempt() {
        let shared = Shared::default();
        let first = question(1, "one");
        shared.want("u".into(), by("s"), first.clone(), LogSpan::default());
        assert_eq!(shared.next(), Some(("u".into(), first.clone(), "one".into())));
        shared.want("u".into(), by("s"), first.clone(), LogSpan::default());
        assert_eq!(shared.next(), None, "it is under way");
        tokio::time::advance(Duration::from_secs(3)).await;
        assert_eq!(
            shared.observe("u", Attempt(1)),
            ObservedImage::Asked(Duration::from_secs(3))
        );
        assert_eq!(shared.done("u", &first, Err(Fault::NotFound)), Some(by("s")));
        assert_eq!(
            shared.observe("u", Attempt(1)),
            ObservedImage::Answered(Arc::new(Err(Fault::NotFound)))
        );
        assert_eq!(shared.observe("u", Attempt(2)), ObservedImage::NotAsked);
        shared.want("u".into(), by("s"), question(2, "one"), LogSpan::default());
        assert_eq!(
            shared.next().unwrap().1.attempt,
            Attempt(2),
            "it may have been pushed since"
        );
    }

    #[tokio::test(start_paused = true)]
    async fn the_answer_to_an_older_question_is_nobodys() {
        let shared = Shared::default();
        let (old, new) = (question(1, "one"), question(1, "other"));
        shared.want("u".into(), by("s"), old.clone(), LogSpan::default());
        shared.next();
        shared.want("u".into(), by("s"), new.clone(), LogSpan::default());
        assert_eq!(shared.done("u", &old, Err(Fault::NotFound)), None);
        assert_eq!(shared.observe("u", Attempt(1)), ObservedImage::Asked(Duration::ZERO));
        assert_eq!(shared.next().unwrap().1, new);
    }

    #[tokio::test(start_paused = true)]
    async fn who_asked_first_is_served_first_and_old_answers_go() {
        let shared = Shared::default();
        for uid in ["a", "b"] {
            shared.want(uid.into(), by(uid), question(1, uid), LogSpan::default());
            tokio::time::advance(Duration::from_secs(1)).await;
        }
        let (uid, question, _) = shared.next().unwrap();
        assert_eq!(uid, "a");
        shared.done(&uid, &question, Err(Fault::Denied));
        tokio::time::advance(KEPT).await;
        shared.want("c".into(), by("c"), super::tests::question(1, "c"), LogSpan::default());
        assert_eq!(shared.observe("a", Attempt(1)), ObservedImage::NotAsked);
        assert!(
            matches!(shared.observe("b", Attempt(1)), ObservedImage::Asked(_)),
            "it still waits"
        );
    }

    #[tokio::test(start_paused = true)]
    async fn a_registry_that_takes_its_time_leaves_a_place_to_the_others() {
        let shared = Shared::default();
        for uid in ["a", "b", "c", "d"] {
            shared.want(uid.into(), by(uid), question(1, uid), LogSpan::default());
        }
        tokio::time::advance(Duration::from_secs(1)).await;
        let mut other = question(1, "e");
        other.image.registry = "other.example".into();
        shared.want("e".into(), by("e"), other, LogSpan::default());
        let begun: Vec<_> = std::iter::from_fn(|| shared.next()).map(|(uid, ..)| uid).collect();
        assert_eq!((begun.len(), begun.last().map(String::as_str)), (4, Some("e")));
    }
}
