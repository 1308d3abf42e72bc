//! Where the names lead that a Pod's own containers need and cannot look up (`network.dns: Pinned`). They are asked for before each Job:
//! a Pod keeps what it was given.

use std::net::IpAddr;
use std::time::Duration;

use futures::future::join_all;
use jiff::{SignedDuration, Timestamp};

use super::questions::{self, Observed, Questions};
use crate::controller::objects::Wake;
use crate::observability::tasks::Tasks;
use crate::services::endpoints::{self, ServiceAddress};
use crate::services::names::{self, Answer, GOOD_FOR, Names};
use leaderboard_api::ranges::{self, Range, is_no_service, is_public};
use leaderboard_api::text::one_line;
use leaderboard_api::{Attempt, Dns, Egress, LeaderboardSpec, LogGroup, Network, PolicySource, Storage, Submission};

/// An older answer is none: it may be of the run before. In line it is asked again more often.
const OLD: SignedDuration = SignedDuration::from_mins(10);
/// Most of a resolver's own words.
const LONGEST_WHY: usize = 200;

/// For which services a Pod needs addresses.
#[derive(Clone, Debug, PartialEq)]
pub struct Question {
    pub attempt: Attempt,
    pub storage: Storage,
    pub log_group: Option<LogGroup>,
    /// The Pod asks STS for its credentials.
    pub has_role: bool,
}

/// One service, and what was found of its name.
#[derive(Clone, Debug, PartialEq)]
pub struct Found {
    pub place: ServiceAddress,
    pub addresses: Answer,
}

/// An answer. An error shows which service has no endpoint.
#[derive(Clone, Debug, PartialEq)]
pub struct Looked {
    /// When it was asked for.
    pub at: Timestamp,
    pub question: Question,
    pub found: Result<Vec<Found>, String>,
}

impl Looked {
    /// Whether it answers this question, and is young enough for a Job.
    pub fn answers(&self, question: &Question, now: Timestamp) -> bool {
        self.question == *question && now.duration_since(self.at).abs() < OLD
    }
}

impl questions::Question for Question {
    type Answer = Looked;
    /// Each may leave a thread of the resolver waiting.
    const AT_ONCE: usize = 4;
    const GOOD_FOR: Duration = GOOD_FOR;

    fn attempt(&self) -> Attempt {
        self.attempt
    }
}

/// The questions and their answers.
pub type Addresses = Questions<Question>;

/// What is known of a submission's present attempt.
pub type ObservedAddresses = Observed<Looked>;

impl Addresses {
    /// Starts the task that looks up. `region` is the one that Pods are given.
    pub fn start(names: &Names, region: Option<String>, tasks: &Tasks, wake: Wake<Submission>) -> Self {
        let names = names.clone();
        let look_up = move |question: Question, _namespace| {
            let (names, region) = (names.clone(), region.clone());
            async move {
                let at = Timestamp::now();
                let found = find(&names, &question, region.as_deref()).await;
                Looked { at, question, found }
            }
        };
        Self::answered_by(look_up, "names", tasks, wake)
    }
}

/// What a Pod of this Leaderboard needs, with the storage of its run.
pub fn question(leaderboard: &LeaderboardSpec, storage: &Storage, attempt: Attempt) -> Question {
    Question {
        attempt,
        storage: storage.clone(),
        log_group: leaderboard.log_group.clone(),
        has_role: leaderboard.has_role(),
    }
}

async fn find(names: &Names, question: &Question, region: Option<&str>) -> Result<Vec<Found>, String> {
    // As in the Pod's environment: the operator's own region, else the bucket's.
    let region = region.or(question.storage.region.as_deref());
    let mut places = vec![endpoints::s3(&question.storage, region).await?];
    if question.has_role {
        places.push(endpoints::sts(&question.storage, region).await?);
    }
    if let Some(group) = &question.log_group {
        places.push(endpoints::logs(group, region).await?);
    }
    // An address needs no look-up.
    places.retain(|place| place.host.parse::<IpAddr>().is_err());
    let found = places.into_iter().map(|place| async move {
        let addresses = names.addresses(&place.host).await;
        Found { place, addresses }
    });
    Ok(join_all(found).await)
}

/// What a Pod is given of an answer; an error shows why a service has no address for it, and what to do.
pub fn usable(network: &Network, looked: &Looked) -> Result<names::Addresses, String> {
    let found = looked
        .found
        .as_ref()
        .map_err(|why| format!("{why}. Correct storage, logGroup or the region of the Leaderboard."))?;
    let of = |found: &Found| of_place(network, found).map(|addresses| (found.place.host.clone(), addresses));
    found.iter().map(of).collect()
}

/// What the Pods of a Leaderboard are given; none where they look names up themselves.
pub fn of_pod(observed: &ObservedAddresses, network: &Network) -> Option<names::Addresses> {
    match observed {
        Observed::Answered(looked) if network.dns == Dns::Pinned => usable(network, looked).ok(),
        _ => None,
    }
}

fn of_place(network: &Network, found: &Found) -> Result<Vec<IpAddr>, String> {
    let ServiceAddress { service, host, port } = &found.place;
    let all = found.addresses.as_ref().map_err(|why| {
        format!(
            "The address of {host} ({service}) is not known: {}. The operator's own Pod looks it up: correct the name, or let that Pod \
             resolve it.",
            one_line(why, LONGEST_WHY).trim_end_matches('.')
        )
    })?;
    let services: Vec<IpAddr> = all.iter().copied().filter(|address| !is_no_service(*address)).collect();
    if services.is_empty() {
        return Err(format!(
            "The name {host} ({service}) leads to an address of this machine, of many machines, or of a cloud's metadata, which no Pod is \
             given. Correct the name, or the DNS that the operator's own Pod asks."
        ));
    }
    let allowed: Vec<IpAddr> = services
        .iter()
        .copied()
        .filter(|address| allows(network, *address, *port))
        .collect();
    if allowed.is_empty() {
        return Err(not_allowed(&found.place, &services));
    }
    Ok(allowed)
}

/// Whether the policy of the Pods lets them reach an address.
fn allows(network: &Network, address: IpAddr, port: u16) -> bool {
    let has_port = |egress: &&Egress| egress.ports.is_empty() || egress.ports.contains(&port.into());
    let ranges = network
        .egress
        .iter()
        .filter(has_port)
        .map(|egress| egress.cidr.as_str());
    network.policy == PolicySource::External || ranges::allows(ranges, address)
}

/// Public addresses change from look-up to look-up, and each change would be a write.
fn not_allowed(place: &ServiceAddress, addresses: &[IpAddr]) -> String {
    let ServiceAddress { service, host, port } = place;
    let private = addresses.iter().find(|address| !is_public(**address));
    match private.and_then(|address| Range::alone(*address)) {
        Some(range) => format!(
            "The name {host} ({service}) leads to {} and {} other addresses, and network.egress allows none of them on port {port}. Add \
             those of the interface endpoint there.",
            range.text(),
            addresses.len().saturating_sub(1),
        ),
        None => format!(
            "The name {host} ({service}) has public addresses only, and network.egress allows none of them on port {port}. Public \
             addresses change: make an interface endpoint with private DNS, or use network.dns Cluster."
        ),
    }
}

#[cfg(test)]
#[path = "addresses_tests.rs"]
mod tests;
