//! The help of each command on a terminal of 80 columns.

use std::fmt::Write as _;

use clap::CommandFactory;

use super::golden::assert_golden;
use crate::Cli;
use crate::text::columns;

/// Columns of the terminal.
const NARROW: usize = 80;

#[test]
fn the_help_of_each_command_fits_a_narrow_terminal() {
    let mut command = Cli::command().term_width(NARROW);
    command.build();
    let mut text = format!("=== kubectl leaderboard --help\n{}", command.render_long_help());
    for one in command.get_subcommands_mut().filter(|one| !one.is_hide_set()) {
        let name = one.get_name().to_owned();
        if name != "help" {
            writeln!(
                text,
                "\n=== kubectl leaderboard {name} --help\n{}",
                one.render_long_help()
            )
            .unwrap();
        }
    }
    let text: Vec<&str> = text.lines().map(str::trim_end).collect();
    assert_golden("help", &format!("{}\n", text.join("\n")));
    // A command in an example is copied.
    let is_long = |line: &&&str| columns(line) > NARROW && !line.contains("~/");
    assert_eq!(text.iter().filter(is_long).collect::<Vec<_>>(), Vec::<&&str>::new());
}
