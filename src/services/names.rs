//! Names of services that Pods cannot look up: looked up here for them, within a bound of time and number, and kept for a while. And the
//! other end of it, in the Pod: a way to AWS that knows these names and asks nobody.

use std::collections::{BTreeMap, HashMap};
use std::fmt;
use std::net::IpAddr;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use aws_smithy_runtime_api::client::dns::{DnsFuture, ResolveDns, ResolveDnsError};
use futures::FutureExt;
use futures::future::BoxFuture;
use tokio::time::{Instant, timeout};

use crate::lock::lock;

/// Time one look-up may take.
const LIMIT: Duration = Duration::from_secs(5);
/// An answer is good for so long, one that is no help too: many submissions ask for the same few names.
pub const GOOD_FOR: Duration = Duration::from_secs(30);
/// Most addresses of one name that are used.
pub const MOST: usize = 32;
/// Most names that are kept.
const MOST_KEPT: usize = 256;

/// Addresses by name, in small letters.
pub type Addresses = BTreeMap<String, Vec<IpAddr>>;

/// What a look-up has found; an error shows why there is nothing.
pub type Answer = Result<Vec<IpAddr>, String>;

type LookUp = dyn Fn(String) -> BoxFuture<'static, std::io::Result<Vec<IpAddr>>> + Send + Sync;

/// The look-ups of a program.
#[derive(Clone)]
pub struct Names(Arc<Shared>);

struct Shared {
    look_up: Box<LookUp>,
    known: Mutex<HashMap<String, (Instant, Answer)>>,
}

impl fmt::Debug for Names {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Names(…)")
    }
}

impl Default for Names {
    /// By what this machine resolves names with.
    fn default() -> Self {
        Self::by(|name| {
            let found = async move {
                Ok(tokio::net::lookup_host((name, 0))
                    .await?
                    .map(|found| found.ip())
                    .collect())
            };
            found.boxed()
        })
    }
}

impl Names {
    /// By another way than this machine's.
    pub fn by(
        look_up: impl Fn(String) -> BoxFuture<'static, std::io::Result<Vec<IpAddr>>> + Send + Sync + 'static,
    ) -> Self {
        Self(Arc::new(Shared {
            look_up: Box::new(look_up),
            known: Mutex::default(),
        }))
    }

    /// The addresses of a name, each once.
    pub async fn addresses(&self, name: &str) -> Answer {
        if let Some(known) = self.known(name) {
            return known;
        }
        let answer = match timeout(LIMIT, (self.0.look_up)(name.to_owned())).await {
            Err(_) => Err(format!("no answer within {} s", LIMIT.as_secs())),
            Ok(Err(error)) => Err(error.to_string()),
            Ok(Ok(found)) if found.is_empty() => Err("it has no address".to_owned()),
            Ok(Ok(found)) => Ok(some(found)),
        };
        let mut known = lock(&self.0.known);
        known.retain(|_, (since, _)| since.elapsed() < GOOD_FOR);
        if known.len() < MOST_KEPT {
            known.insert(name.to_owned(), (Instant::now(), answer.clone()));
        }
        answer
    }

    fn known(&self, name: &str) -> Option<Answer> {
        let known = lock(&self.0.known);
        let (since, answer) = known.get(name)?;
        (since.elapsed() < GOOD_FOR).then(|| answer.clone())
    }
}

/// The lowest ones, so that the same addresses in another order are the same answer.
fn some(mut found: Vec<IpAddr>) -> Vec<IpAddr> {
    found.sort_unstable();
    found.dedup();
    found.truncate(MOST);
    found
}

/// Knows what it was given, and asks nobody else.
#[derive(Clone, Debug)]
pub(super) struct Given(pub(super) Arc<Addresses>);

/// A name that was not given.
#[derive(thiserror::Error, Debug)]
#[error(
    "the operator gave this Pod no address of {0}: network.dns is Pinned, which serves storage.endpoint, logGroup.endpoint and AWS's own \
     names of S3, STS and CloudWatch Logs"
)]
struct NotGiven(String);

impl ResolveDns for Given {
    fn resolve_dns<'a>(&'a self, name: &'a str) -> DnsFuture<'a> {
        let found = self.0.get(&name.to_lowercase());
        DnsFuture::ready(match found {
            Some(addresses) => {
                // One that does not answer uses up the time of a try, and the next try begins with another.
                let mut addresses = addresses.clone();
                fastrand::shuffle(&mut addresses);
                Ok(addresses)
            }
            None => Err(ResolveDnsError::new(NotGiven(name.to_owned()))),
        })
    }
}

#[cfg(test)]
#[path = "names_tests.rs"]
mod tests;
