//! Which files there are to store: those of the agents' and simulators' folders, as far as they are looked at, and the known
//! logs in any case. Reads names and stamps only.

use std::collections::BTreeMap;
use std::collections::hash_map::DefaultHasher;
use std::hash::{Hash, Hasher};

use super::Haste;
use leaderboard_contract::keys::{REFUSED, agent_folder, checkpoint_path, known_logs};
use leaderboard_evidence::{Stamp, Tree};
use leaderboard_protocol::files::Pair;

/// Entries read in one agent's folder.
const AGENT_ENTRIES: usize = 5_000;
/// Entries read in all agents' folders, and in the simulators': what is listed is in memory.
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
    /// A digest that changes when an agent writes something.
    pub activity: u64,
    /// Entries that are no files, or beyond the limits.
    pub left_out: usize,
    /// The agents' folders hold most of the volume, and enough to fill one.
    pub agents_fill_disk: bool,
}

impl Files {
    /// Finds the files that are there now.
    pub fn find(tree: &Tree, pairs: usize) -> Self {
        let mut found = Self::default();
        let each = ENTRIES.checked_div(pairs).unwrap_or(ENTRIES).min(AGENT_ENTRIES);
        for pair in Pair::first(pairs) {
            found.walk(tree, &agent_folder(pair), each);
        }
        // A flood of other names must not hide them.
        let logs = known_logs(pairs).filter_map(|path| Some((tree.file(&path).ok()??.1, path)));
        let logs: BTreeMap<String, Stamp> = logs.map(|(stamp, path)| (path, stamp)).collect();
        let of_agents = |(path, _): &(&String, &Stamp)| path.starts_with("agent/");
        found.files.extend(
            logs.iter()
                .filter(of_agents)
                .map(|(path, stamp)| (path.clone(), *stamp)),
        );
        let mut activity = DefaultHasher::new();
        found.files.hash(&mut activity);
        found.activity = activity.finish();
        found.walk(tree, "simulator", ENTRIES);
        found.files.extend(logs);
        let agents = found.bytes_below("agent/");
        found.agents_fill_disk = agents >= FILLING && agents > found.bytes_below("simulator/");
        found
    }

    /// A file with holes counts whole: an agent that makes one speaks against itself alone.
    fn bytes_below(&self, folder: &str) -> u64 {
        let sizes = self.files.iter().filter(|(path, _)| path.starts_with(folder));
        sizes.map(|(_, stamp)| stamp.size).fold(0, u64::saturating_add)
    }

    fn walk(&mut self, tree: &Tree, folder: &str, limit: usize) {
        let walk = tree.walk(folder, limit);
        self.files.extend(walk.files);
        self.left_out = self.left_out.saturating_add(walk.left_out);
    }

    /// Files to store, given why each pair's checkpoint is refused. A checkpoint is stored from memory, whole. One that
    /// is refused is kept as evidence under another name, so that nothing is resumed from it.
    pub fn wanted(&self, refused: &[Option<String>]) -> Vec<Wanted> {
        let of_pair: BTreeMap<String, bool> = Pair::first(refused.len())
            .zip(refused)
            .map(|(pair, refused)| (checkpoint_path(pair), refused.is_some()))
            .collect();
        let wanted = self.files.iter().filter_map(|(path, stamp)| {
            let wanted = Wanted::new(path, *stamp, Haste::Soon);
            match of_pair.get(path) {
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

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn a_flood_of_names_hides_no_known_log() {
        let folder = tempfile::tempdir().unwrap();
        let at = |path: &str| folder.path().join(path);
        for made in ["agent/agent1", "simulator", "logcopy"] {
            fs::create_dir_all(at(made)).unwrap();
        }
        for number in 0..AGENT_ENTRIES {
            fs::write(at(&format!("agent/agent1/{number}")), "").unwrap();
        }
        let logs: Vec<String> = known_logs(1).collect();
        for log in &logs {
            fs::write(at(log), "a line\n").unwrap();
        }
        let tree = Tree::open(folder.path()).unwrap();
        let found = Files::find(&tree, 1);
        assert!(logs.iter().all(|log| found.files.contains_key(log)));
        assert!(found.left_out > 0);
        let before = found.activity;
        fs::write(at(&logs[1]), "the server's line is no activity of an agent\n").unwrap();
        assert_eq!(Files::find(&tree, 1).activity, before);
        fs::write(at(&logs[0]), "another line\n").unwrap();
        assert_ne!(Files::find(&tree, 1).activity, before);
    }

    #[test]
    fn what_fills_the_volume_is_the_agents_only_if_their_folders_hold_more_than_the_simulators() {
        let holds = |agent: u64, simulator: u64| {
            let dir = tempfile::tempdir().unwrap();
            for (path, size) in [("agent/agent1/junk", agent), ("simulator/Saved.log", simulator)] {
                let path = dir.path().join(path);
                fs::create_dir_all(path.parent().unwrap()).unwrap();
                fs::File::create(path).unwrap().set_len(size).unwrap();
            }
            Files::find(&Tree::open(dir.path()).unwrap(), 1).agents_fill_disk
        };
        assert!(holds(FILLING, FILLING - 1));
        assert!(!holds(FILLING - 1, 0) && !holds(FILLING, FILLING) && !holds(FILLING, 2 * FILLING));
    }

    #[test]
    fn a_checkpoint_is_wanted_as_evidence_only() {
        let files = Pair::first(2).map(checkpoint_path).chain(["agent/agent1/x".to_owned()]);
        let found = Files {
            files: files.map(|path| (path, Stamp::default())).collect(),
            ..Files::default()
        };
        let wanted = found.wanted(&[None, Some("torn".to_owned())]);
        let keys: Vec<&str> = wanted.iter().map(|wanted| wanted.key.as_str()).collect();
        assert_eq!(
            keys,
            ["agent/agent1/x", "logcopy/refused/agent/agent2/agent_results.json"]
        );
    }
}
