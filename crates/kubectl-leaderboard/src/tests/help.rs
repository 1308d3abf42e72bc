//! The help of each command on a terminal of 80 columns.

use std::fmt::Write as _;

use clap::{CommandFactory, Parser};

use super::golden::assert_golden;
use crate::Cli;
use crate::help::{dressed, examples};
use crate::text::columns;

/// Columns of the terminal.
const NARROW: usize = 80;

#[test]
fn the_help_of_each_command_fits_a_narrow_terminal() {
    let mut command = dressed(Cli::command().term_width(NARROW));
    let mut text = format!("=== kubectl leaderboard --help\n{}", command.render_help());
    for one in command.get_subcommands_mut().filter(|one| !one.is_hide_set()) {
        let name = one.get_name().to_owned();
        if name != "help" {
            writeln!(text, "\n=== kubectl leaderboard {name} --help\n{}", one.render_help()).unwrap();
        }
    }
    let text: Vec<&str> = text.lines().map(str::trim_end).collect();
    assert_golden("help", &format!("{}\n", text.join("\n")));
    // Addresses that people copy stay in one line.
    let is_long = |line: &&&str| columns(line) > NARROW && !line.contains("https://");
    assert_eq!(text.iter().filter(is_long).collect::<Vec<_>>(), Vec::<&&str>::new());
}

#[test]
fn each_command_has_an_example_that_it_takes() {
    let command = Cli::command();
    let verbs = command.get_subcommands().filter(|one| !one.is_hide_set());
    for verb in verbs.map(clap::Command::get_name) {
        let lines = examples(verb).unwrap_or_else(|| panic!("{verb} has no example"));
        let lines = lines.replace("\\\n", " ").replace("'Team Seven'", "Team-Seven");
        let mut count = 0;
        for line in lines
            .lines()
            .filter_map(|line| Some(line.split_once("kubectl leaderboard ")?.1))
        {
            let words = line.split_whitespace().take_while(|word| *word != ">");
            let words: Vec<&str> = std::iter::once("kubectl-leaderboard").chain(words).collect();
            assert_eq!(words.get(1), Some(&verb), "{line}");
            Cli::try_parse_from(&words).unwrap_or_else(|error| panic!("{line}: {error}"));
            count += 1;
        }
        assert!(count > 0, "{verb}: {lines}");
    }
}
