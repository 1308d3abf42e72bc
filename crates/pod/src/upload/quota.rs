//! How much of a run is stored: bytes and objects at once, requests and bytes a day. Pure.
//!
//! An agent costs itself nothing when it fills its folder, also with sparse or empty files. So its own files get a part of the
//! limits only, and the logs by which a run is judged keep room that nothing else can use.

use std::collections::BTreeMap;

use super::Decision;
use crate::daily::Spent;
use leaderboard_aws::archive::PART;
use leaderboard_contract::keys::{
    AGENTS, COLLECTED, EVALAI, EVALUATORS, INPUT, MERGED, REFUSED, SIMULATORS, known_logs, results_path,
};
use leaderboard_contract::run::STATUS_FOLDER;
use leaderboard_protocol::files::{Host, Pair};

/// Objects for the files of the host's containers and the agents' own: of the 20,000 of a run, the others are results, status files and
/// known logs.
const FILES: u64 = 15_500;
/// Objects of those for the agents' files.
const AGENT_FILES: u64 = 10_000;
/// Bytes that an object counts at least: an empty one costs a request, an entry in each list, and memory here.
pub const LEAST: u64 = 4 << 10;
/// Bytes that the server copies with one request of an append.
const COPIED: u64 = 1 << 30;

/// Kind of a key, in the order in which files are sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Kind {
    /// Checkpoints, results and status files: stored from memory, and bounded there.
    Result,
    /// A known log; see [`known_logs`].
    Log,
    /// What the evaluators read, and its list: bounded where it is copied, and sent once.
    Input,
    /// Another file of the host's containers or of logcopy.
    Host,
    /// Another file of an agent, or its refused checkpoint.
    Agent,
}

/// Why a file is not stored.
#[derive(thiserror::Error, Clone, Copy, Debug, PartialEq, Eq)]
pub enum Limit {
    /// Bytes of the run.
    #[error(
        "storage.s3.sizeLimit is reached: of it, {0} bytes are for all but the known logs. Raise it, or have the host's \
         containers and the agent write less"
    )]
    Bytes(u64),
    /// Bytes of the agents' own files.
    #[error(
        "the agents' own files have reached their half of storage.s3.sizeLimit, {0} bytes. Raise it, or have the agent \
         write less"
    )]
    AgentBytes(u64),
    /// Objects of the run.
    #[error(
        "a run's limit of objects is reached: {0} for files of the host's containers and of agents. Have them write fewer \
         files"
    )]
    Objects(u64),
    /// Objects of the agents' own files.
    #[error("the agents' own files have reached the limit of {0} objects. Have the agent write fewer files")]
    AgentObjects(u64),
}

/// The limits of one run.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Quota {
    /// Bytes: `storage.s3.sizeLimit`.
    pub bytes: u64,
    /// Allowance of one known log for a day.
    pub log_a_day: Spent,
    /// Allowance of the agents' own files together for a day, and of the other files of the host's containers.
    pub files_a_day: Spent,
    /// Bytes that each known log keeps for itself: together a quarter of the limit.
    log_share: u64,
    /// Keys of the known logs and of the workers' results.
    known: BTreeMap<String, Kind>,
}

impl Quota {
    /// For a run of so many pairs that may store so many bytes.
    pub fn new(bytes: u64, pairs: usize, host: Host) -> Self {
        let at_least = |bytes: u64, gibibytes: u64| bytes.max(gibibytes << 30);
        let logs: Vec<String> = known_logs(pairs, host).collect();
        let log_share = (bytes / 4).checked_div(logs.len() as u64).unwrap_or(0);
        // Beside an evaluator an agent's file of that name is its own.
        let merged = (host == Host::Simulator).then(|| MERGED.to_owned());
        let results = Pair::first(pairs).map(|pair| results_path(host, pair)).chain(merged);
        let logs = logs.into_iter().map(|key| (key, Kind::Log));
        Self {
            bytes,
            // A growing log costs four requests a minute.
            log_a_day: Spent {
                requests: 10_000,
                bytes: at_least(bytes, 8),
            },
            files_a_day: Spent {
                requests: 50_000,
                bytes: at_least(bytes.saturating_mul(4), 16),
            },
            log_share,
            known: logs.chain(results.map(|key| (key, Kind::Result))).collect(),
        }
    }

    /// Kind of a key.
    pub fn kind(&self, key: &str) -> Kind {
        if let Some(kind) = self.known.get(key) {
            return *kind;
        }
        if key.starts_with(INPUT) || key == COLLECTED {
            return Kind::Input;
        }
        let is_result = key.starts_with(EVALAI)
            || key
                .strip_prefix(STATUS_FOLDER)
                .is_some_and(|rest| rest.starts_with('/'));
        let is_hosts = [SIMULATORS, EVALUATORS, "logcopy/"]
            .iter()
            .any(|folder| key.starts_with(folder));
        match key.strip_prefix(REFUSED) {
            _ if is_result => Kind::Result,
            Some(refused) if refused.starts_with(EVALUATORS) => Kind::Host,
            None if is_hosts => Kind::Host,
            _ => Kind::Agent,
        }
    }

    /// Purse of a key, and its allowance for a day.
    pub fn purse<'a>(&self, key: &'a str) -> (&'a str, Spent) {
        match self.kind(key) {
            Kind::Result | Kind::Log => (key, self.log_a_day),
            Kind::Input => ("input", Spent::ENDLESS),
            Kind::Host => ("hosts", self.files_a_day),
            Kind::Agent => ("agents", self.files_a_day),
        }
    }

    /// Ledger of what is stored already.
    pub fn ledger<'a>(&'a self, stored: impl Iterator<Item = (&'a str, u64)>) -> Ledger<'a> {
        let mut ledger = Ledger {
            quota: self,
            bytes: 0,
            agent_bytes: 0,
            objects: 0,
            agent_objects: 0,
        };
        for (key, size) in stored {
            ledger.take(key, None, size);
        }
        ledger
    }

    /// Bytes for everything but the known logs' shares.
    fn common(&self) -> u64 {
        self.bytes.saturating_sub(self.bytes / 4)
    }

    /// Bytes of a key that count against what is common.
    fn weight(&self, kind: Kind, size: u64) -> u64 {
        let counted = size.max(LEAST);
        match kind {
            Kind::Log => counted.saturating_sub(self.log_share),
            Kind::Input => 0,
            Kind::Result | Kind::Host | Kind::Agent => counted,
        }
    }
}

/// True if a stranger's container writes it.
fn is_agents(kind: Kind, key: &str) -> bool {
    kind == Kind::Agent || (kind == Kind::Log && key.starts_with(AGENTS))
}

/// Sums that count at present.
#[derive(Clone, Debug)]
pub struct Ledger<'a> {
    quota: &'a Quota,
    bytes: u64,
    agent_bytes: u64,
    objects: u64,
    agent_objects: u64,
}

impl Ledger<'_> {
    /// How many bytes of a file may be stored, of which `before` are. All or none, but for a known log: of that one at least
    /// what it keeps for itself.
    pub fn admit(&self, key: &str, before: Option<u64>, size: u64) -> Result<u64, Limit> {
        let quota = self.quota;
        let kind = quota.kind(key);
        let weight = quota.weight(kind, size);
        let weight_before = before.map_or(0, |before| quota.weight(kind, before));
        if matches!(kind, Kind::Result | Kind::Input) || (before.is_some() && weight <= weight_before) {
            return Ok(size);
        }
        let room = |limit: u64, used: u64| limit.saturating_sub(used.saturating_sub(weight_before));
        let common = room(quota.common(), self.bytes);
        let agents = room(quota.bytes / 2, self.agent_bytes);
        let (room, limit) = if is_agents(kind, key) && agents <= common {
            (agents, Limit::AgentBytes(quota.bytes / 2))
        } else {
            (common, Limit::Bytes(quota.common()))
        };
        if kind == Kind::Log {
            return Ok(size.min(quota.log_share.saturating_add(room)));
        }
        if weight > room {
            return Err(limit);
        }
        match before {
            None if kind == Kind::Agent && self.agent_objects >= AGENT_FILES => Err(Limit::AgentObjects(AGENT_FILES)),
            None if self.objects >= FILES => Err(Limit::Objects(FILES)),
            _ => Ok(size),
        }
    }

    /// Takes in that a file with `before` bytes has `size` now.
    pub fn take(&mut self, key: &str, before: Option<u64>, size: u64) {
        let kind = self.quota.kind(key);
        let weight = self.quota.weight(kind, size);
        let weight_before = before.map_or(0, |before| self.quota.weight(kind, before));
        let changed = |sum: u64| sum.saturating_sub(weight_before).saturating_add(weight);
        self.bytes = changed(self.bytes);
        if is_agents(kind, key) {
            self.agent_bytes = changed(self.agent_bytes);
        }
        let new = u64::from(before.is_none());
        // The others have objects of their own, and are bounded where they are made.
        if matches!(kind, Kind::Host | Kind::Agent) {
            self.objects = self.objects.saturating_add(new);
        }
        if kind == Kind::Agent {
            self.agent_objects = self.agent_objects.saturating_add(new);
        }
    }
}

/// Cost of sending a file of `size` bytes.
pub fn cost(decision: Decision, size: u64) -> Spent {
    match decision {
        Decision::Keep => Spent::default(),
        Decision::PutWhole if size <= PART => Spent {
            requests: 1,
            bytes: size,
        },
        Decision::PutWhole => Spent {
            requests: size.div_ceil(PART).saturating_add(2),
            bytes: size,
        },
        Decision::Append { from } => {
            let bytes = size.saturating_sub(from);
            let requests = bytes.div_ceil(PART).saturating_add(from.div_ceil(COPIED));
            Spent {
                requests: requests.saturating_add(2),
                bytes,
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MIB: u64 = 1 << 20;

    /// Two pairs and 100 MiB: 25 for the known logs, 5 for each; 75 for the rest, of which the agents have 50.
    fn quota() -> Quota {
        Quota::new(100 * MIB, 2, Host::Simulator)
    }

    #[test]
    fn each_key_has_its_kind() {
        let table = [
            ("agent/agent_results.json", Kind::Result),
            ("agent/agent2/agent_results.json", Kind::Result),
            ("evalai/metadata.json", Kind::Result),
            ("containers-status/agent-1.done", Kind::Result),
            ("agent/agent2/leaderboard.log", Kind::Log),
            ("simulator/console-1.log", Kind::Log),
            ("logcopy/logcopy.log", Kind::Log),
            ("simulator/Logs/CarlaUE4.log", Kind::Host),
            ("simulator/console-3.log", Kind::Host),
            ("agent/agent3/leaderboard.log", Kind::Agent),
            ("agent/agent1/x/agent_results.json", Kind::Agent),
            ("agent/agent1/leaderboard.log.1", Kind::Agent),
            ("logcopy/refused/agent/agent1/agent_results.json", Kind::Agent),
            ("containers-status-x/y", Kind::Agent),
            ("input/a/agent_results.json", Kind::Input),
            ("logcopy/collected.json", Kind::Input),
            ("inputs/a", Kind::Agent),
            ("submission/a", Kind::Agent),
        ];
        for (key, kind) in table {
            assert_eq!(quota().kind(key), kind, "{key}");
        }
        let quota = Quota::new(100 * MIB, 2, Host::Evaluator);
        for (key, kind) in [
            ("evaluators/2/result.json", Kind::Result),
            ("evaluators/2/console.log", Kind::Log),
            ("evaluators/3/console.log", Kind::Host),
            ("evaluators/2/games.json", Kind::Host),
            ("evaluators/2/x/result.json", Kind::Host),
            ("evaluators/02/result.json", Kind::Host),
            ("evaluators/result.json", Kind::Host),
            ("logcopy/refused/evaluators/2/result.json", Kind::Host),
            ("agent/agent2/leaderboard.log", Kind::Log),
            ("agent/agent1/agent_results.json", Kind::Agent),
            ("simulator/console-1.log", Kind::Host),
        ] {
            assert_eq!(quota.kind(key), kind, "{key}");
        }
        let ledger = quota.ledger(std::iter::empty());
        let of_agent = ledger.admit("agent/agent1/agent_results.json", None, 18 << 30);
        assert_eq!(of_agent, Err(Limit::AgentBytes(50 * MIB)));
    }

    #[test]
    fn the_agents_files_get_half_and_the_simulators_files_what_is_left() {
        let quota = quota();
        let mut ledger = quota.ledger(std::iter::empty());
        assert_eq!(ledger.admit("agent/agent1/a", None, 50 * MIB), Ok(50 * MIB));
        ledger.take("agent/agent1/a", None, 50 * MIB);
        let full = Err(Limit::AgentBytes(50 * MIB));
        assert_eq!(
            ledger.admit("agent/agent2/b", None, 0),
            full,
            "an empty file counts as well"
        );
        assert_eq!(ledger.admit("agent/agent1/a", Some(50 * MIB), 50 * MIB + 1), full);
        assert_eq!(ledger.admit("agent/agent1/a", Some(50 * MIB), 9), Ok(9));
        assert_eq!(ledger.admit("simulator/a", None, 25 * MIB), Ok(25 * MIB));
        ledger.take("simulator/a", None, 25 * MIB);
        assert_eq!(ledger.admit("simulator/b", None, 1), Err(Limit::Bytes(75 * MIB)));
        for result in ["evalai/metadata.json", "containers-status/agent-1.done"] {
            assert_eq!(ledger.admit(result, None, 30 * MIB), Ok(30 * MIB), "{result}");
        }
    }

    #[test]
    fn each_known_log_keeps_its_share_and_gets_no_more_than_there_is() {
        let quota = quota();
        let files = [("agent/agent1/a", 50 * MIB), ("simulator/a", 25 * MIB)];
        let mut ledger = quota.ledger(files.into_iter());
        for log in known_logs(2, Host::Simulator) {
            assert_eq!(ledger.admit(&log, None, 4 << 40), Ok(5 * MIB), "{log}");
            ledger.take(&log, None, 5 * MIB);
        }
        assert_eq!(ledger.admit("simulator/a", Some(25 * MIB), 20 * MIB), Ok(20 * MIB));
        ledger.take("simulator/a", Some(25 * MIB), 20 * MIB);
        // Room of the simulators is none for an agent's log, but for a server's.
        assert_eq!(
            ledger.admit("agent/agent2/leaderboard.log", Some(5 * MIB), 6 * MIB),
            Ok(5 * MIB)
        );
        assert_eq!(
            ledger.admit("simulator/console-1.log", Some(5 * MIB), 4 << 40),
            Ok(10 * MIB)
        );
    }

    #[test]
    fn empty_files_end_at_a_number_of_objects() {
        let quota = Quota::new(1 << 40, 16, Host::Simulator);
        let names: Vec<String> = (0..10_000).map(|number| format!("agent/agent1/{number}")).collect();
        let mut ledger = quota.ledger(names.iter().map(|name| (name.as_str(), 0)));
        let full = Err(Limit::AgentObjects(10_000));
        assert_eq!(ledger.admit("agent/agent2/one-more", None, 0), full);
        assert_eq!(
            ledger.admit("agent/agent1/0", Some(0), 5),
            Ok(5),
            "what is there may change"
        );
        for number in 0..5_500 {
            let key = format!("simulator/{number}");
            assert_eq!(ledger.admit(&key, None, 0), Ok(0));
            ledger.take(&key, None, 0);
        }
        assert_eq!(ledger.admit("simulator/one-more", None, 0), Err(Limit::Objects(15_500)));
        assert_eq!(ledger.admit("simulator/console-16.log", None, 7), Ok(7));
    }

    #[test]
    fn what_the_evaluators_read_takes_nothing_of_the_limits() {
        let quota = quota();
        let mut ledger = quota.ledger([("agent/agent1/a", 50 * MIB), ("simulator/a", 25 * MIB)].into_iter());
        assert_eq!(ledger.admit("input/a", None, 1 << 40), Ok(1 << 40), "all is full");
        ledger.take("input/a", None, 1 << 40);
        assert_eq!(ledger.admit("agent/agent1/a", Some(50 * MIB), MIB), Ok(MIB));
        ledger.take("agent/agent1/a", Some(50 * MIB), MIB);
        assert_eq!(ledger.admit("agent/agent1/b", None, 49 * MIB), Ok(49 * MIB));
        let whole = cost(Decision::PutWhole, 100 << 30);
        assert!(whole.fits(quota.purse("input/a").1), "on one day");
    }

    #[test]
    fn each_way_of_sending_has_its_cost() {
        let cost = |decision, size| {
            let Spent { requests, bytes } = cost(decision, size);
            (requests, bytes)
        };
        assert_eq!(cost(Decision::Keep, 9), (0, 0));
        assert_eq!(cost(Decision::PutWhole, PART), (1, PART));
        assert_eq!(cost(Decision::PutWhole, PART + 1), (4, PART + 1));
        assert_eq!(cost(Decision::Append { from: 2 * COPIED }, 2 * COPIED + 5), (5, 5));
    }

    #[test]
    fn each_known_log_has_a_purse_of_its_own() {
        let quota = quota();
        assert_eq!(quota.purse("simulator/console-1.log").0, "simulator/console-1.log");
        assert_eq!(quota.purse("simulator/x").0, "hosts");
        assert_eq!(quota.purse("agent/agent2/x").0, "agents");
        assert_eq!(quota.purse("agent/agent2/x").1.requests, 50_000);
    }
}
