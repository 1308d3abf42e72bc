//! What a registry has under the name of an image: its digest, its size, and what its config has. One question before the first Job.
//!
//! Called by `controller::submissions::images`. Knows registries' HTTP API and no policy. Names and documents are a participant's:
//! every answer is bounded and checked against its digest, addresses are checked hop by hop (`address`), and nothing that a registry
//! says in words of its own is passed on.

mod address;
mod auth;
mod ecr;
mod manifest;

use std::collections::HashMap;
use std::sync::{Mutex, OnceLock};
use std::time::Duration;

use reqwest::header::{ACCEPT, AUTHORIZATION, LOCATION, WWW_AUTHENTICATE};
use reqwest::{Response, StatusCode, Url};
use sha2::{Digest, Sha256};
use tokio::time::{Instant, timeout};

use super::aws::Aws;
use super::public::{self, Reach};
use crate::lock::lock;
use auth::Challenge;
pub use auth::Credentials;
use ecr::Ecr;
use manifest::{Document, LARGEST, Part};

/// How long a connection is waited for.
const CONNECT: Duration = Duration::from_secs(3);
/// How long one answer is waited for.
const REQUEST: Duration = Duration::from_secs(5);
/// How long all of a look-up may take.
const LOOK_UP: Duration = Duration::from_secs(15);
/// A registry that does not answer is not asked again for so long: a thousand submissions must not wait for it one by one.
const LEFT_ALONE: Duration = Duration::from_mins(1);
/// Most registries that are remembered as such: participants may choose the host.
const MOST_LEFT_ALONE: usize = 256;
/// Most redirects of one request.
const MOST_HOPS: usize = 4;
/// Largest answer with a token.
const LARGEST_TOKEN: usize = 64 << 10;
const MANIFESTS: &str = "application/vnd.oci.image.index.v1+json, application/vnd.oci.image.manifest.v1+json, \
     application/vnd.docker.distribution.manifest.list.v2+json, application/vnd.docker.distribution.manifest.v2+json";
const BLOBS: &str = "*/*";
const TOO_LARGE: &str = "its answer is larger than is read";

/// Which image is looked up.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Image {
    /// Host and port.
    pub registry: String,
    /// The repository, as the registry calls it.
    pub path: String,
    /// A digest or a tag.
    pub reference: String,
    /// The registry was named letter by letter by the host, so that it may be on this machine, without TLS.
    pub may_be_local: bool,
}

/// What a registry has reported of an image.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Facts {
    /// Of the manifest for linux/amd64.
    pub digest: String,
    /// Sum of its parts as they are stored.
    pub bytes: u64,
    pub has_volumes: bool,
}

/// Why it has reported nothing.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Fault {
    /// It has no such image.
    NotFound,
    /// It refuses the operator's credentials.
    Denied,
    /// It has the image for other machines only.
    OtherPlatform,
    /// What it has is no image, and why, in words of ours.
    NotAnImage(&'static str),
    /// It does not answer, and why, for hosts.
    Unreachable(String),
    /// It answers, and nothing that helps, and why, for hosts.
    Unusable(String),
}

impl Fault {
    /// One word for metrics.
    fn label(&self) -> &'static str {
        match self {
            Self::NotFound => "missing",
            Self::Denied => "denied",
            Self::OtherPlatform => "platform",
            Self::NotAnImage(_) => "malformed",
            Self::Unreachable(_) => "unreachable",
            Self::Unusable(_) => "unusable",
        }
    }
}

/// The way to all registries.
pub struct Registries {
    /// Made for the first image: each has a copy of the machine's certificates.
    clients: OnceLock<Result<Clients, String>>,
    aws: Aws,
    left_alone: Mutex<HashMap<String, (Instant, String)>>,
}

struct Clients {
    registry: reqwest::Client,
    public: reqwest::Client,
    ecr: Ecr,
}

impl Registries {
    pub fn new(aws: &Aws) -> Self {
        Self {
            clients: OnceLock::new(),
            aws: aws.clone(),
            left_alone: Mutex::default(),
        }
    }

    /// Asks for an image, with these credentials where its registry is not Amazon's.
    pub async fn look_up(&self, image: &Image, credentials: Option<Credentials>) -> Result<Facts, Fault> {
        let running = self.aws.meter().begin("registry", "look_up");
        let answer = if let Some(why) = self.known_silence(&image.registry) {
            Err(Fault::Unreachable(why))
        } else {
            let asked = timeout(LOOK_UP, self.ask(image, credentials)).await;
            asked.unwrap_or_else(|_| Err(Fault::Unreachable("it did not answer in time".into())))
        };
        if let Err(Fault::Unreachable(why)) = &answer {
            self.leave_alone(&image.registry, why);
        }
        running.end(answer.as_ref().map_or_else(Fault::label, |_| "ok"));
        answer
    }

    fn known_silence(&self, registry: &str) -> Option<String> {
        let known = lock(&self.left_alone);
        let (since, why) = known.get(registry)?;
        (since.elapsed() < LEFT_ALONE).then(|| why.clone())
    }

    fn leave_alone(&self, registry: &str, why: &str) {
        let mut known = lock(&self.left_alone);
        known.retain(|_, (since, _)| since.elapsed() < LEFT_ALONE);
        if known.len() < MOST_LEFT_ALONE {
            known
                .entry(registry.to_owned())
                .or_insert_with(|| (Instant::now(), why.to_owned()));
        }
    }

    async fn ask(&self, image: &Image, credentials: Option<Credentials>) -> Result<Facts, Fault> {
        let make = || Clients::new(&self.aws).map_err(|error| format!("no HTTP client could be made: {error}"));
        let clients = self.clients.get_or_init(make).as_ref();
        let clients = clients.map_err(|why| Fault::Unreachable(why.clone()))?;
        let is_ecrs = credentials.is_none() && clients.ecr.is_ecr(&image.registry);
        let answer = Session::new(clients, image, credentials).await?.facts().await;
        // A password may end early, with the role that fetched it for example.
        if is_ecrs && answer == Err(Fault::Denied) && clients.ecr.refused(&image.registry) {
            return Session::new(clients, image, None).await?.facts().await;
        }
        answer
    }
}

impl Clients {
    fn new(aws: &Aws) -> Result<Self, reqwest::Error> {
        // A program that has installed one already keeps it.
        let _ = rustls::crypto::ring::default_provider().install_default();
        let client = |reach: Reach| {
            reach
                .limit_without_proxy(reqwest::Client::builder())
                .connect_timeout(CONNECT)
                .timeout(REQUEST)
                .pool_max_idle_per_host(0)
                .user_agent(concat!("leaderboard-operator/", env!("CARGO_PKG_VERSION")))
                .build()
        };
        let registry = client(address::REGISTRY)?;
        Ok(Self {
            public: client(Reach::default())?,
            ecr: Ecr::new(aws.clone(), registry.clone()),
            registry,
        })
    }
}

/// One look-up.
struct Session<'a> {
    clients: &'a Clients,
    image: &'a Image,
    base: Url,
    /// The registry is on this machine, where it speaks plain HTTP.
    is_local: bool,
    credentials: Option<Credentials>,
    authorization: Mutex<Option<String>>,
}

impl<'a> Session<'a> {
    async fn new(clients: &'a Clients, image: &'a Image, credentials: Option<Credentials>) -> Result<Self, Fault> {
        let host = match image.registry.as_str() {
            "docker.io" => "registry-1.docker.io",
            host => host,
        };
        let parse = |scheme: &str| Url::parse(&format!("{scheme}://{host}/v2/{}/", image.path)).map_err(|_| strange());
        let url = parse("https")?;
        let is_local = image.may_be_local && address::ip(&url).is_some_and(|ip| ip.is_loopback());
        let is_ecr = clients.ecr.is_ecr(&image.registry);
        let credentials = match credentials {
            None if is_ecr => Some(
                clients
                    .ecr
                    .credentials(&image.registry)
                    .await
                    .map_err(Fault::Unreachable)?,
            ),
            given => given,
        };
        let authorization = credentials.as_ref().filter(|_| is_ecr).map(Credentials::header);
        Ok(Self {
            clients,
            image,
            base: if is_local { parse("http")? } else { url },
            is_local,
            credentials,
            authorization: Mutex::new(authorization),
        })
    }

    async fn facts(&self) -> Result<Facts, Fault> {
        let body = self
            .get(&format!("manifests/{}", self.image.reference), MANIFESTS)
            .await?;
        let named = Some(self.image.reference.as_str()).filter(|name| name.contains(':'));
        if named.is_some_and(|digest| !manifest::is_sha256(digest)) {
            return Err(Fault::NotAnImage("its digest is not a sha256 digest"));
        }
        let digest = checked(&body, named)?;
        match manifest::document(&body).map_err(Fault::NotAnImage)? {
            Document::Image { config, bytes } => self.of_image(digest, &config, bytes).await,
            Document::Index(None) => Err(Fault::OtherPlatform),
            Document::Index(Some(part)) => {
                let body = self.part("manifests", &part, MANIFESTS).await?;
                match manifest::document(&body).map_err(Fault::NotAnImage)? {
                    Document::Image { config, bytes } => self.of_image(part.digest, &config, bytes).await,
                    Document::Index(_) => Err(Fault::NotAnImage("its index holds another index")),
                }
            }
        }
    }

    async fn of_image(&self, digest: String, config: &Part, bytes: u64) -> Result<Facts, Fault> {
        let body = self.part("blobs", config, BLOBS).await?;
        let config = manifest::config(&body).map_err(Fault::NotAnImage)?;
        if !config.is_linux_amd64 {
            return Err(Fault::OtherPlatform);
        }
        Ok(Facts {
            digest,
            bytes,
            has_volumes: config.has_volumes,
        })
    }

    /// A part of the image, which the registry has if its manifest is there.
    async fn part(&self, kind: &str, part: &Part, accept: &'static str) -> Result<Vec<u8>, Fault> {
        if part.bytes > LARGEST as u64 {
            return Err(too_large());
        }
        let body = self.get(&format!("{kind}/{}", part.digest), accept).await;
        let body = body.map_err(|fault| match fault {
            Fault::NotFound => Fault::NotAnImage("the registry does not have all of its parts"),
            other => other,
        })?;
        checked(&body, Some(&part.digest))?;
        Ok(body)
    }

    /// Reads what is below the repository, along its redirects.
    async fn get(&self, path: &str, accept: &'static str) -> Result<Vec<u8>, Fault> {
        let mut url = self.base.join(path).map_err(|_| strange())?;
        let mut is_asked = false;
        for hop in 0..MOST_HOPS {
            let answer = self.send(&url, accept, hop == 0).await?;
            match answer.status() {
                status if status.is_success() => return document(answer).await,
                StatusCode::UNAUTHORIZED if hop == 0 && !is_asked => {
                    is_asked = true;
                    self.authorize(&answer).await?;
                    let answer = self.send(&url, accept, true).await?;
                    if answer.status().is_success() {
                        return document(answer).await;
                    }
                    url = self.next(&url, &answer, hop)?;
                }
                _ => url = self.next(&url, &answer, hop)?,
            }
        }
        Err(Fault::Unusable("it redirects too often".into()))
    }

    /// Where a redirect leads; any other answer is none that helps.
    fn next(&self, url: &Url, answer: &Response, hop: usize) -> Result<Url, Fault> {
        let status = answer.status();
        let location = answer.headers().get(LOCATION).and_then(|value| value.to_str().ok());
        match location.filter(|_| status.is_redirection()) {
            Some(location) => url.join(location).map_err(|_| strange()),
            None => Err(self.refusal(status, hop)),
        }
    }

    fn refusal(&self, status: StatusCode, hop: usize) -> Fault {
        let is_refused = matches!(status, StatusCode::UNAUTHORIZED | StatusCode::FORBIDDEN);
        match status {
            StatusCode::NOT_FOUND if hop == 0 => Fault::NotFound,
            // Without credentials of ours nothing is known of those of the nodes.
            _ if is_refused && hop == 0 && self.credentials.is_some() => Fault::Denied,
            _ if is_refused && hop == 0 => {
                Fault::Unusable("it asks for credentials, and the operator has none for it".into())
            }
            StatusCode::TOO_MANY_REQUESTS => Fault::Unreachable(answered(status)),
            status if status.is_server_error() => Fault::Unreachable(answered(status)),
            status => Fault::Unusable(answered(status)),
        }
    }

    /// Sends one request to where it may go. Credentials go to the registry itself alone.
    async fn send(&self, url: &Url, accept: &'static str, is_first: bool) -> Result<Response, Fault> {
        let client = self.way_to(url)?;
        let mut request = client.get(url.clone()).header(ACCEPT, accept);
        if is_first && let Some(authorization) = self.authorization() {
            request = request.header(AUTHORIZATION, authorization);
        }
        request.send().await.map_err(unanswered)
    }

    fn authorization(&self) -> Option<String> {
        let known = lock(&self.authorization);
        known.clone()
    }

    /// The client that may go to an address.
    fn way_to(&self, url: &Url) -> Result<&'a reqwest::Client, Fault> {
        let is_registry = url.origin() == self.base.origin();
        if is_registry && self.is_local {
            return Ok(&self.clients.registry);
        }
        let (reach, client) = if is_registry {
            (address::REGISTRY, &self.clients.registry)
        } else {
            (Reach::default(), &self.clients.public)
        };
        // A resolver is never asked for what is an address already.
        if url.scheme() != "https" || reach.check(url).is_err() || !url.username().is_empty() {
            return Err(Fault::Unusable(
                "it leads to an address that no look-up may go to".into(),
            ));
        }
        Ok(client)
    }

    /// Does what a registry asks for before it answers.
    async fn authorize(&self, answer: &Response) -> Result<(), Fault> {
        let header = answer
            .headers()
            .get(WWW_AUTHENTICATE)
            .and_then(|value| value.to_str().ok());
        let asked = header.and_then(auth::challenge);
        let header = match (asked, &self.credentials) {
            (Some(Challenge::Basic), Some(credentials)) => credentials.header(),
            (Some(Challenge::Bearer { realm, service }), _) => {
                format!("Bearer {}", self.token(&realm, service.as_deref()).await?)
            }
            _ => return Err(self.refusal(answer.status(), 0)),
        };
        *lock(&self.authorization) = Some(header);
        Ok(())
    }

    async fn token(&self, realm: &str, service: Option<&str>) -> Result<String, Fault> {
        let mut url = Url::parse(realm).map_err(|_| strange())?;
        let client = self.way_to(&url)?;
        url.query_pairs_mut()
            .extend_pairs(service.map(|service| ("service", service)))
            .append_pair("scope", &format!("repository:{}:pull", self.image.path));
        let mut request = client.get(url);
        if let Some(credentials) = &self.credentials {
            request = request.header(AUTHORIZATION, credentials.header());
        }
        let answer = request.send().await.map_err(unanswered)?;
        if !answer.status().is_success() {
            return Err(match self.refusal(answer.status(), 0) {
                Fault::NotFound => strange(),
                fault => fault,
            });
        }
        let body = body(answer, LARGEST_TOKEN).await;
        let body = body.map_err(|why| Fault::Unusable(why.into()))?;
        auth::token(&body).ok_or_else(strange)
    }
}

/// A manifest or config, which participants write: a larger one is theirs.
async fn document(answer: Response) -> Result<Vec<u8>, Fault> {
    if answer.content_length().is_some_and(|length| length > LARGEST as u64) {
        return Err(too_large());
    }
    body(answer, LARGEST).await.map_err(|why| match why {
        TOO_LARGE => too_large(),
        why => Fault::Unusable(why.into()),
    })
}

/// Reads an answer of at most so many bytes.
async fn body(mut answer: Response, largest: usize) -> Result<Vec<u8>, &'static str> {
    let mut body = Vec::new();
    while let Some(chunk) = answer.chunk().await.map_err(|_| "its answer broke off")? {
        if body.len() + chunk.len() > largest {
            return Err(TOO_LARGE);
        }
        body.extend_from_slice(&chunk);
    }
    Ok(body)
}

/// The digest of what was read, which has to be the one that was asked for. Another one is the registry's fault, or its network's.
fn checked(body: &[u8], wanted: Option<&str>) -> Result<String, Fault> {
    let digest = format!("sha256:{}", hex::encode(Sha256::digest(body)));
    if wanted.is_some_and(|wanted| wanted != digest) {
        return Err(Fault::Unusable("its answer is not what its digest says".into()));
    }
    Ok(digest)
}

fn answered(status: StatusCode) -> String {
    format!("it answered {}", status.as_u16())
}

fn too_large() -> Fault {
    Fault::NotAnImage("its manifest or config is larger than 2 MiB")
}

fn strange() -> Fault {
    Fault::Unusable("it answered what no registry answers".into())
}

fn unanswered(error: reqwest::Error) -> Fault {
    let error = error.without_url();
    Fault::Unreachable(match () {
        () if error.is_timeout() => "it did not answer in time".into(),
        // Where a name leads in the host's network is not for those who choose the name.
        () if public::cause(&error).is_some() => "its address is one that no look-up may go to".into(),
        () => format!("no connection ({})", leaderboard_api::client_errors::chain(&error)),
    })
}

#[cfg(test)]
mod tests;
