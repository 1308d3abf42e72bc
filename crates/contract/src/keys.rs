//! Names below a run's prefix in S3, which are also paths below the root of the `logs` volume. Pure.
//!
//! Used by all programs of the Pod that read, store or count files.

use leaderboard_protocol::files::{Host, Pair};

/// Key of the merged file.
pub const MERGED: &str = "agent/agent_results.json";
/// Before the keys of EvalAI's texts.
pub const EVALAI: &str = "evalai/";
/// The metrics as EvalAI gets them.
pub const RESULTS: &str = "evalai/results.json";
/// The text that participants read in EvalAI.
pub const STDOUT: &str = "evalai/stdout.txt";
/// The merged file under EvalAI's name.
pub const METADATA: &str = "evalai/metadata.json";
/// Before the key of refused results: no container of a worker can put a file of its own there.
pub const REFUSED: &str = "logcopy/refused/";

/// The log of logcopy, below the root of the `logs` volume.
pub const OWN_LOG: &str = "logcopy/logcopy.log";
/// The log of `workspace`.
pub const WORKSPACE_LOG: &str = "logcopy/workspace.log";
/// The log of `collect`.
pub const COLLECT_LOG: &str = "logcopy/collect.log";
/// The output of the host's contents. The runner writes it.
pub const CONTENTS_LOG: &str = "contents/contents.log";

/// Before the keys of the agents' files.
pub const AGENTS: &str = "agent/";
/// Before the keys of the simulators' files.
pub const SIMULATORS: &str = "simulator/";
/// Before the keys of the evaluators' files; the number of the worker follows.
pub const EVALUATORS: &str = "evaluators/";
/// Name of the file in an evaluator's folder with its result.
pub const RESULT_FILE: &str = leaderboard_protocol::files::RESULT;

/// Where an agent of the mode Batch leaves its files, below the root of the `logs` volume. Nothing of it is stored.
pub const SUBMISSION_FOLDER: &str = "submission";
/// Before the keys of what the evaluators find at `/input`.
pub const INPUT: &str = "input/";
/// The submitted file of the mode Predictions.
pub const INPUT_FILE: &str = "input/file";
/// The list of what `collect` has copied.
pub const COLLECTED: &str = "logcopy/collected.json";

/// The folder of an agent, without a slash at its end.
pub fn agent_folder(pair: Pair) -> String {
    format!("{AGENTS}agent{pair}")
}

/// The checkpoint of a pair.
pub fn checkpoint_path(pair: Pair) -> String {
    format!("{}/agent_results.json", agent_folder(pair))
}

/// The folder of the host's container of a pair, without a slash at its end. The simulators share one.
pub fn host_folder(host: Host, pair: Pair) -> String {
    match host {
        Host::Simulator => SIMULATORS.trim_end_matches('/').to_owned(),
        Host::Evaluator => format!("{EVALUATORS}{pair}"),
    }
}

/// Name of the file in that folder with what the container has printed.
pub fn host_log_name(host: Host, pair: Pair) -> String {
    match host {
        Host::Simulator => format!("console-{pair}.log"),
        Host::Evaluator => "console.log".to_owned(),
    }
}

/// The log of the host's container of a pair.
pub fn host_log(host: Host, pair: Pair) -> String {
    format!("{}/{}", host_folder(host, pair), host_log_name(host, pair))
}

/// The result that the evaluator of a pair writes.
pub fn result_path(pair: Pair) -> String {
    format!("{}/{RESULT_FILE}", host_folder(Host::Evaluator, pair))
}

/// The results of a pair: its agent's checkpoint, or its evaluator's result.
pub fn results_path(host: Host, pair: Pair) -> String {
    match host {
        Host::Simulator => checkpoint_path(pair),
        Host::Evaluator => result_path(pair),
    }
}

/// The output of a pair's agent.
pub fn agent_log(pair: Pair) -> String {
    format!("{}/leaderboard.log", agent_folder(pair))
}

/// The logs by which a run is judged: what each agent and each container of the host has printed, and logcopy's own.
pub fn known_logs(pairs: usize, host: Host) -> impl Iterator<Item = String> {
    let of_pairs = Pair::first(pairs).flat_map(move |pair| [agent_log(pair), host_log(host, pair)]);
    of_pairs.chain([OWN_LOG.to_owned()])
}
