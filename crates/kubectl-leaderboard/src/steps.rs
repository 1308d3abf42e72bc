//! What a reason means and what to do about it: the rows of docs/states.md, which the operator's tests hold against the
//! constants of `api::reasons`, so that there is one wording.
//!
//! Called by `why` and `board`. Pure.

const STATES: &str = include_str!("../../../docs/states.md");
/// The chapter with the table of logs.
const LOGS: &str = "## The log of a failure";

/// A row of docs/states.md.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Step {
    /// What the reason means.
    pub meaning: String,
    /// What to do next.
    pub next: String,
}

/// What is known of a reason.
pub(super) fn of(reason: &str) -> Option<Step> {
    let start = format!("| `{reason}` |");
    let row = STATES.lines().find_map(|line| line.strip_prefix(start.as_str()))?;
    let (meaning, next) = row.strip_suffix('|')?.split_once(" | ")?;
    Some(Step {
        meaning: plain(meaning),
        next: next_step(&plain(next)),
    })
}

/// What a reason means; nothing for one that this program does not know.
pub(super) fn meaning(reason: &str) -> String {
    of(reason).map(|step| step.meaning).unwrap_or_default()
}

/// Whose log explains a failure of this reason, if one does.
pub(super) fn log_of(reason: &str) -> Option<String> {
    let (_, chapter) = STATES.split_once(LOGS)?;
    let name = format!("`{reason}`");
    let rows = chapter.lines().take_while(|line| !line.starts_with("## "));
    let mut rows = rows.filter_map(|line| line.strip_prefix("| ")?.strip_suffix(" |")?.split_once(" | "));
    let (log, _) = rows.find(|(_, reasons)| reasons.contains(&name))?;
    Some(plain(log))
}

/// `None; if it lasts, …` reads as an answer.
fn next_step(words: &str) -> String {
    match words.strip_prefix("None") {
        Some(rest) => format!("Nothing{rest}"),
        None => words.to_owned(),
    }
}

/// Markdown as a terminal shows it: no backticks, and of a link its text.
fn plain(markdown: &str) -> String {
    let mut text = String::new();
    let mut rest = markdown.trim();
    while let Some((before, link)) = rest.split_once('[') {
        text.push_str(before);
        let Some((words, after)) = link.split_once("](") else {
            text.push('[');
            rest = link;
            continue;
        };
        text.push_str(words);
        rest = after.split_once(')').map_or("", |(_, after)| after);
    }
    text.push_str(rest);
    text.replace('`', "")
}

#[cfg(test)]
mod tests {
    use super::*;
    use leaderboard_api::reasons;

    const REASONS: &str = include_str!("../../api/src/reasons.rs");

    #[test]
    fn every_reason_has_a_meaning_and_a_next_step() {
        let lines = REASONS.lines().filter(|line| line.starts_with("pub const "));
        let reasons: Vec<&str> = lines.map(|line| line.split('"').nth(1).unwrap()).collect();
        assert!(reasons.len() > 50);
        for reason in reasons {
            let step = of(reason).unwrap_or_else(|| panic!("{reason} has no step"));
            for words in [&step.meaning, &step.next] {
                assert!(words.ends_with('.'), "{reason}: {words}");
                assert!(!words.contains(['`', '[', '|']), "{reason}: {words}");
            }
        }
        assert_eq!(of("NoSuchReason"), None);
    }

    #[test]
    fn markdown_and_none_read_as_words() {
        let step = of(reasons::PREPARING).unwrap();
        assert_eq!(
            step.next,
            "Nothing; if it lasts, look at the node that the message names."
        );
        let step = of(reasons::UNEXPLAINED_SCORES).unwrap();
        assert!(
            step.next
                .starts_with("Look at the checkpoint before you trust the score (results.md); verify: Refuse"),
            "{}",
            step.next
        );
        assert_eq!(plain("a [b"), "a [b");
    }

    #[test]
    fn the_log_of_a_failure_is_known_where_there_is_one() {
        for (reason, expected) in [
            (
                reasons::AGENT_CRASHED,
                Some("the agent's of failure.pair: the end of agent/agent<n>/leaderboard.log"),
            ),
            (reasons::START_DEADLINE, Some("that of contents, workspace or logcopy")),
            (reasons::RESULTS_NOT_STORED, Some("logcopy's")),
            (reasons::SIMULATION_CRASHED, Some("the simulator's of that pair")),
            (reasons::IMAGE_PULL, None),
            (reasons::NODE_LOST, None),
        ] {
            let found = log_of(reason);
            match (expected, &found) {
                (Some(words), Some(found)) => assert!(found.starts_with(words), "{reason}: {found}"),
                (expected, found) => assert_eq!(found.as_deref(), expected, "{reason}"),
            }
        }
    }
}
