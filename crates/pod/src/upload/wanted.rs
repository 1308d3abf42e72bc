//! Which files there are to store: those of the workers' folders, as far as they are looked at, what the evaluators read once it is
//! listed, and the known logs in any case. Reads names and stamps only.

use std::collections::BTreeMap;
use std::collections::hash_map::DefaultHasher;
use std::hash::{Hash, Hasher};

use super::Haste;
use crate::collect;
use leaderboard_contract::keys::{
    AGENTS, COLLECTED, EVALUATORS, INPUT, REFUSED, SIMULATORS, SUBMISSION_FOLDER, agent_folder, host_folder,
    known_logs, results_path,
};
use leaderboard_evaluation::judge::Ending;
use leaderboard_evidence::{Stamp, Tree, Walk};
use leaderboard_protocol::files::{Host, Pair};

/// Entries read in one agent's folder, and in one evaluator's.
const WORKER_ENTRIES: usize = 5_000;
/// Entries read in all agents' folders, and in those of the host's containers: what is listed is in memory.
const ENTRIES: usize = 20_000;
/// Less than that fills no volume.
const FILLING: u64 = 512 << 20;

/// A file that is to be stored.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Wanted {
    /// Its key below the run's prefix.
    pub key: String,
    /// Its path below the volume's root.
    pub path: String,
    /// As it was found.
    pub stamp: Stamp,
    /// How soon.
    pub haste: Haste,
}

impl Wanted {
    /// A file whose key is its path.
    pub fn new(path: &str, stamp: Stamp, haste: Haste) -> Self {
        Self {
            key: path.to_owned(),
            path: path.to_owned(),
            stamp,
            haste,
        }
    }
}

/// The files of the containers.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Files {
    /// By path below the volume's root.
    pub files: BTreeMap<String, Stamp>,
    /// A digest that changes when an agent or an evaluator writes something.
    pub activity: u64,
    /// Entries that are no files, or beyond the limits.
    pub left_out: usize,
    /// The agents' folders hold most of the volume, and enough to fill one.
    pub agents_fill_disk: bool,
}

impl Files {
    /// Finds the files that are there now.
    pub fn find(tree: &Tree, pairs: usize, host: Host) -> Self {
        let mut found = Self::default();
        let each = ENTRIES.checked_div(pairs).unwrap_or(ENTRIES).min(WORKER_ENTRIES);
        let mut hides = false;
        for pair in Pair::first(pairs) {
            hides |= found.walk(tree, &agent_folder(pair), each);
        }
        let hosts = match host {
            // All have one folder.
            Host::Simulator => (1, ENTRIES),
            Host::Evaluator => (pairs, each),
        };
        for pair in Pair::first(hosts.0) {
            found.walk(tree, &host_folder(host, pair), hosts.1);
        }
        // A flood of other names must not hide them.
        let logs = known_logs(pairs, host).filter_map(|path| Some((tree.file(&path).ok()??.1, path)));
        found.files.extend(logs.map(|(stamp, path)| (path, stamp)));
        let mut activity = DefaultHasher::new();
        found
            .below(&[AGENTS, EVALUATORS])
            .for_each(|file| file.hash(&mut activity));
        found.activity = activity.finish();
        // Without the list they are not all there. A submitted file has none: it is in the bucket.
        if let Ok(Some((_, stamp))) = tree.file(COLLECTED) {
            // What is copied is within its bounds, for which the volume has room.
            found.agents_fill_disk = found.is_mostly_agents(&Walk::default(), hides);
            found.walk(tree, INPUT.trim_end_matches('/'), collect::ENTRIES);
            found.files.insert(COLLECTED.to_owned(), stamp);
        } else {
            let left = tree.walk(SUBMISSION_FOLDER, collect::ENTRIES);
            found.agents_fill_disk = found.is_mostly_agents(&left, hides);
        }
        found
    }

    /// True if the agents hold most of the volume, with what is left for `collect`, and enough to fill one. What they hide from a walk
    /// counts as that much.
    fn is_mostly_agents(&self, left: &Walk, hides: bool) -> bool {
        let bytes = |folder| bytes_of(self.below(&[folder]));
        // A file with holes counts whole: an agent that makes one speaks against itself alone.
        let agents = bytes(AGENTS).saturating_add(bytes_of(left.files.iter()));
        let is_most = agents > bytes(SIMULATORS).max(bytes(EVALUATORS));
        hides || left.hides || (agents >= FILLING && is_most)
    }

    fn below<'a>(&'a self, folders: &'a [&str]) -> impl Iterator<Item = (&'a String, &'a Stamp)> {
        let is_below = |path: &str| folders.iter().any(|folder| path.starts_with(folder));
        self.files.iter().filter(move |(path, _)| is_below(path))
    }

    /// Returns whether files can be hidden there.
    fn walk(&mut self, tree: &Tree, folder: &str, limit: usize) -> bool {
        let walk = tree.walk(folder, limit);
        self.files.extend(walk.files);
        self.left_out = self.left_out.saturating_add(walk.left_out);
        walk.hides
    }

    /// Takes out the files to store, given why each worker's results are refused. Results are stored from memory, whole. Those that are
    /// refused are kept as evidence under another name, so that nothing is resumed from them.
    pub fn wanted(&mut self, refused: &[Option<Ending>], host: Host) -> Vec<Wanted> {
        let of_pair: BTreeMap<String, bool> = Pair::first(refused.len())
            .zip(refused)
            .map(|(pair, refused)| (results_path(host, pair), refused.is_some()))
            .collect();
        let files = std::mem::take(&mut self.files).into_iter();
        let wanted = files.filter_map(|(path, stamp)| {
            let wanted = Wanted::new(&path, stamp, Haste::Soon);
            match of_pair.get(&path) {
                None => Some(wanted),
                Some(true) => Some(Wanted {
                    key: format!("{REFUSED}{path}"),
                    ..wanted
                }),
                Some(false) => None,
            }
        });
        wanted.collect()
    }
}

fn bytes_of<'a>(files: impl Iterator<Item = (&'a String, &'a Stamp)>) -> u64 {
    files.map(|(_, stamp)| stamp.size).fold(0, u64::saturating_add)
}

#[cfg(test)]
mod tests {
    use std::fs;

    use leaderboard_contract::report::RefusedResults;

    use super::*;

    #[test]
    fn a_flood_of_names_hides_no_known_log() {
        let folder = tempfile::tempdir().unwrap();
        let at = |path: &str| folder.path().join(path);
        for made in ["agent/agent1", "simulator", "logcopy"] {
            fs::create_dir_all(at(made)).unwrap();
        }
        for number in 0..WORKER_ENTRIES {
            fs::write(at(&format!("agent/agent1/{number}")), "").unwrap();
        }
        let logs: Vec<String> = known_logs(1, Host::Simulator).collect();
        for log in &logs {
            fs::write(at(log), "a line\n").unwrap();
        }
        let tree = Tree::open(folder.path()).unwrap();
        let found = Files::find(&tree, 1, Host::Simulator);
        assert!(logs.iter().all(|log| found.files.contains_key(log)));
        assert!(found.left_out > 0);
        let before = found.activity;
        fs::write(at(&logs[1]), "the server's line is no activity of an agent\n").unwrap();
        assert_eq!(Files::find(&tree, 1, Host::Simulator).activity, before);
        fs::write(at(&logs[0]), "another line\n").unwrap();
        assert_ne!(Files::find(&tree, 1, Host::Simulator).activity, before);
    }

    #[test]
    fn each_evaluators_folder_is_looked_at_and_its_writing_is_activity() {
        let folder = tempfile::tempdir().unwrap();
        let put = |path: &str, text: &str| {
            let path = folder.path().join(path);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text).unwrap();
        };
        for path in [
            "evaluators/1/result.json",
            "evaluators/2/a/b",
            "evaluators/3/x",
            "simulator/x",
        ] {
            put(path, "{}");
        }
        let tree = Tree::open(folder.path()).unwrap();
        let found = Files::find(&tree, 2, Host::Evaluator);
        let paths: Vec<&String> = found.files.keys().collect();
        assert_eq!(
            paths,
            ["evaluators/1/result.json", "evaluators/2/a/b"],
            "and of no other run"
        );
        put("evaluators/2/a/b", "more");
        assert_ne!(Files::find(&tree, 2, Host::Evaluator).activity, found.activity);
        for number in 0..WORKER_ENTRIES {
            put(&format!("evaluators/1/{number}"), "");
        }
        put("evaluators/1/console.log", "a line\n");
        let flooded = Files::find(&tree, 2, Host::Evaluator);
        assert!(flooded.left_out > 0 && flooded.files.contains_key("evaluators/1/console.log"));
        assert!(flooded.files.contains_key("evaluators/2/a/b"));
    }

    #[test]
    fn what_fills_the_volume_is_the_agents_only_if_their_folders_hold_more_than_the_hosts() {
        let holds = |agent: u64, of_host: u64, host: Host| {
            let dir = tempfile::tempdir().unwrap();
            let saved = host_folder(host, Pair::new(1).unwrap()) + "/saved";
            for (path, size) in [("agent/agent1/junk", agent), (&saved, of_host)] {
                let path = dir.path().join(path);
                fs::create_dir_all(path.parent().unwrap()).unwrap();
                fs::File::create(path).unwrap().set_len(size).unwrap();
            }
            Files::find(&Tree::open(dir.path()).unwrap(), 1, host).agents_fill_disk
        };
        for host in [Host::Simulator, Host::Evaluator] {
            assert!(holds(FILLING, FILLING - 1, host));
            assert!(
                !holds(FILLING - 1, 0, host) && !holds(FILLING, FILLING, host) && !holds(FILLING, 2 * FILLING, host)
            );
        }
    }

    #[test]
    fn what_an_agent_hides_from_a_walk_fills_the_volume() {
        let deep = vec!["d"; 17].join("/");
        for (path, fills) in [
            (format!("agent/agent1/{deep}"), true),
            (format!("submission/{deep}"), true),
            ("agent/agent1/a\nb".to_owned(), true),
            ("agent/agent1/d".to_owned(), false),
            (format!("evaluators/1/{deep}"), false),
        ] {
            let dir = tempfile::tempdir().unwrap();
            fs::create_dir_all(dir.path().join("agent/agent1")).unwrap();
            std::os::unix::fs::symlink("/etc", dir.path().join("agent/agent1/link")).unwrap();
            fs::create_dir_all(dir.path().join(&path)).unwrap();
            let found = Files::find(&Tree::open(dir.path()).unwrap(), 1, Host::Evaluator);
            assert_eq!(found.agents_fill_disk, fills, "{path:?}");
        }
    }

    #[test]
    fn what_an_agent_leaves_fills_the_volume_as_its_own_and_is_stored_only_as_it_is_listed() {
        let dir = tempfile::tempdir().unwrap();
        for (path, size) in [("submission/a", FILLING), ("input/a", 5), ("evaluators/1/saved", 9)] {
            let path = dir.path().join(path);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::File::create(path).unwrap().set_len(size).unwrap();
        }
        let tree = Tree::open(dir.path()).unwrap();
        let found = || Files::find(&tree, 1, Host::Evaluator);
        let keys = |found: &Files| -> Vec<String> {
            let wanted = found.clone().wanted(&[None], Host::Evaluator);
            wanted.into_iter().map(|wanted| wanted.key).collect()
        };
        let before = found();
        assert!(before.agents_fill_disk);
        assert_eq!(keys(&before), ["evaluators/1/saved"]);
        fs::create_dir(dir.path().join("logcopy")).unwrap();
        fs::write(dir.path().join(COLLECTED), "{}").unwrap();
        assert_eq!(keys(&found()), ["evaluators/1/saved", "input/a", COLLECTED]);
        assert!(!found().agents_fill_disk, "what is copied is within its bounds");
        assert_eq!(found().activity, before.activity);
    }

    #[test]
    fn results_are_wanted_as_evidence_only() {
        for (host, evidence) in [
            (Host::Simulator, "logcopy/refused/agent/agent2/agent_results.json"),
            (Host::Evaluator, "logcopy/refused/evaluators/2/result.json"),
        ] {
            let files = Pair::first(2).map(|pair| results_path(host, pair));
            let files = files.chain(["agent/agent1/x".to_owned()]);
            let mut found = Files {
                files: files.map(|path| (path, Stamp::default())).collect(),
                ..Files::default()
            };
            let refused = Ending::Invalid(RefusedResults::new(Some(2), "torn"));
            let wanted = found.wanted(&[None, Some(refused)], host);
            let keys: Vec<&str> = wanted.iter().map(|wanted| wanted.key.as_str()).collect();
            assert_eq!(keys, ["agent/agent1/x", evidence]);
        }
    }
}
