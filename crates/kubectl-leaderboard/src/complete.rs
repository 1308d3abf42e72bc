//! Completes a command line that is not finished. Pure; `main` asks the cluster for names.
//!
//! kubectl calls a program `kubectl_complete-leaderboard` with the words so far, and takes lines and a directive in cobra's form.

use clap::{Arg, ArgMatches, Command};

/// The program that kubectl calls.
pub const SCRIPT: &str = "\
#!/bin/sh
# kubectl runs this to complete `kubectl leaderboard`: put it on the PATH as kubectl_complete-leaderboard.
exec kubectl-leaderboard complete -- \"$@\"
";
/// cobra's directives: offer no files, or as usual.
pub const NO_FILES: &str = ":4";
pub const FILES: &str = ":0";

/// Candidates for a word.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Offer {
    Words(Vec<String>),
    /// Names of submissions.
    Submissions,
    /// Names of Leaderboards.
    Leaderboards,
    /// Names of files, which the shell knows.
    Files,
}

/// Candidates for the last word, which may be empty.
pub fn offer(command: &Command, words: &[String]) -> Offer {
    let (last, before) = words
        .split_last()
        .map_or(("", &[][..]), |(last, before)| (last.as_str(), before));
    let verb = parsed(command, words).and_then(|line| command.find_subcommand(line.subcommand_name()?));
    let within = verb.unwrap_or(command);
    if let Some(flag) = before
        .last()
        .and_then(|word| flag(command, within, word))
        .filter(|flag| flag.get_action().takes_values())
    {
        return value_of(flag, last);
    }
    if last.starts_with('-') {
        let globals = command
            .get_arguments()
            .filter(|flag| verb.is_some() && flag.is_global_set());
        let flags = within.get_arguments().chain(globals);
        let names = flags.filter_map(|flag| flag.get_long()).map(|name| format!("--{name}"));
        return Offer::Words(fitting(names, last));
    }
    match verb {
        None => {
            let verbs = command.get_subcommands().filter(|verb| !verb.is_hide_set());
            Offer::Words(fitting(verbs.map(|verb| verb.get_name().to_owned()), last))
        }
        Some(verb) if verb.get_positionals().next().is_none() => Offer::Words(Vec::new()),
        Some(verb) if ["import", "lint", "man"].contains(&verb.get_name()) => Offer::Files,
        Some(verb) if ["check", "pause", "scores", "unpause"].contains(&verb.get_name()) => Offer::Leaderboards,
        Some(_) => Offer::Submissions,
    }
}

/// The words that begin like the last one, sorted, each once.
pub fn fitting(words: impl IntoIterator<Item = String>, last: &str) -> Vec<String> {
    let mut words: Vec<String> = words.into_iter().filter(|word| word.starts_with(last)).collect();
    words.sort();
    words.dedup();
    words
}

/// The line before its last word, which may be half of anything. A required argument may be missing while it is typed.
pub fn parsed(command: &Command, words: &[String]) -> Option<ArgMatches> {
    let (_, before) = words.split_last()?;
    let line = std::iter::once("kubectl-leaderboard").chain(before.iter().map(String::as_str));
    command.clone().ignore_errors(true).try_get_matches_from(line).ok()
}

fn flag<'a>(command: &'a Command, within: &'a Command, word: &str) -> Option<&'a Arg> {
    let is_it = |flag: &&Arg| {
        let long = flag.get_long().map(|name| format!("--{name}"));
        let short = flag.get_short().map(|letter| format!("-{letter}"));
        [long, short].into_iter().flatten().any(|name| name == word)
    };
    within.get_arguments().chain(command.get_arguments()).find(is_it)
}

fn value_of(flag: &Arg, last: &str) -> Offer {
    match flag.get_long() {
        Some("leaderboard") => Offer::Leaderboards,
        Some("download" | "file" | "kubeconfig") => Offer::Files,
        _ => {
            let values = flag.get_possible_values();
            let names = values.iter().map(|value| value.get_name().to_owned());
            Offer::Words(fitting(names, last))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    #[test]
    fn verbs_flags_values_and_names_are_offered() {
        let words = |words: &[&str]| Offer::Words(words.iter().map(|word| (*word).to_owned()).collect());
        for (line, expected) in [
            (&["c"][..], words(&["cancel", "check", "completion"])),
            (&["-n", "carla", "sta"], words(&["status"])),
            (&["status", "--wat"], words(&["--watch"])),
            (&["status", "--name"], words(&["--namespace"])),
            (&["status", "-o", "j"], words(&["json"])),
            (&["status", "-n", ""], words(&[])),
            (&["status", "-w", ""], Offer::Submissions),
            (&["why", "sub"], Offer::Submissions),
            (&["check", ""], Offer::Leaderboards),
            (&["scores", ""], Offer::Leaderboards),
            (&["submit", "--leaderboard", ""], Offer::Leaderboards),
            (&["top", ""], words(&[])),
            (&["status", "--leaderboard", ""], Offer::Leaderboards),
            (&["pause", ""], Offer::Leaderboards),
            (&["status", "--state", "F"], words(&["Failed", "Finished"])),
            (&["import", ""], Offer::Files),
            (&["lint", "lead"], Offer::Files),
            (&["get", "sub"], Offer::Submissions),
            (&["get", "mine", "--download", ""], Offer::Files),
        ] {
            let line: Vec<String> = line.iter().map(|word| (*word).to_owned()).collect();
            assert_eq!(offer(&crate::Cli::command(), &line), expected, "{line:?}");
        }
    }

    #[test]
    fn the_command_line_is_sound() {
        crate::Cli::command().debug_assert();
    }
}
