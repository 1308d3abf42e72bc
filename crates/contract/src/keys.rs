//! Names below a run's prefix in S3, which are also paths below the root of the `logs` volume. Pure.
//!
//! Used by all programs of the Pod that read, store or count files.

use super::run::console;
use leaderboard_protocol::files::Pair;

/// Key of the merged file.
pub const MERGED: &str = "agent/agent_results.json";
/// Before the keys of EvalAI's texts.
pub const EVALAI: &str = "evalai/";
/// The text that participants read in EvalAI.
pub const STDOUT: &str = "evalai/stdout.txt";
/// The merged file under EvalAI's name.
pub const METADATA: &str = "evalai/metadata.json";
/// Before the key of a refused checkpoint: no agent can put a file of its own there.
pub const REFUSED: &str = "logcopy/refused/";

/// The log of logcopy, below the root of the `logs` volume.
pub const OWN_LOG: &str = "logcopy/logcopy.log";
/// The log of `workspace`.
pub const WORKSPACE_LOG: &str = "logcopy/workspace.log";
/// The output of the host's contents. The runner writes it.
pub const CONTENTS_LOG: &str = "contents/contents.log";

/// The folder of an agent, without a slash at its end.
pub fn agent_folder(pair: Pair) -> String {
    format!("agent/agent{pair}")
}

/// The checkpoint of a pair.
pub fn checkpoint_path(pair: Pair) -> String {
    format!("{}/agent_results.json", agent_folder(pair))
}

/// The output of a pair's agent.
pub fn agent_log(pair: Pair) -> String {
    format!("{}/leaderboard.log", agent_folder(pair))
}

/// The logs by which a run is judged: what each agent and each server has printed, and logcopy's own.
pub fn known_logs(pairs: usize) -> impl Iterator<Item = String> {
    let of_pairs = Pair::first(pairs).flat_map(|pair| [agent_log(pair), console(pair)]);
    of_pairs.chain([OWN_LOG.to_owned()])
}
