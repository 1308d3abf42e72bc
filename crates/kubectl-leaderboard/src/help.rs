//! Parts of each command's help besides its flags: examples, the place of the global options, and addresses of documents.

use clap::Command;

use leaderboard_api::DOCUMENTS;

/// Heading of the flags that every command takes.
pub const GLOBAL: &str = "Global options";
/// Examples of each command: its name, then indented lines.
const EXAMPLES: &str = include_str!("examples.txt");

/// The examples of a command.
pub(super) fn examples(command: &str) -> Option<&'static str> {
    let mut parts = EXAMPLES.split("\n\n").filter_map(|part| part.split_once('\n'));
    parts
        .find(|(name, _)| *name == command)
        .map(|(_, lines)| lines.trim_end())
}

/// The command line with all of it. A global option has its line in the help of the program, and none in that of a command.
pub fn dressed(mut command: Command) -> Command {
    command.build();
    command.mut_subcommands(|one| {
        let Some(examples) = examples(one.get_name()) else {
            return one;
        };
        let after = one.get_after_help().map(|text| format!("\n\n{text}"));
        let after = after.unwrap_or_default().replace("docs/", DOCUMENTS);
        let globals = "`kubectl leaderboard --help` lists the global options, such as -n NAMESPACE.";
        let one = one.mut_args(|flag| if flag.is_global_set() { flag.hide(true) } else { flag });
        one.after_help(format!("Examples:\n{examples}{after}\n\n{globals}"))
    })
}
