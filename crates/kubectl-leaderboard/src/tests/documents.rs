//! Every line of the documents that starts the plugin is one that it takes.

use std::path::Path;

use clap::Parser;
use clap::error::ErrorKind;

use crate::Cli;

#[path = "../../../../tests/support/pages.rs"]
mod support;

#[test]
fn the_plugin_takes_every_line_of_the_documents() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let lines = support::lines(&root, "kubectl leaderboard");
    assert!(lines.len() > 50, "{}", lines.len());
    for line in lines {
        let words = std::iter::once("kubectl-leaderboard").chain(line.words.iter().map(String::as_str));
        let Err(error) = Cli::try_parse_from(words) else {
            continue;
        };
        let is_name = matches!(
            error.kind(),
            ErrorKind::MissingRequiredArgument | ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand
        );
        // The shell puts a value in.
        let is_variable = error.kind() == ErrorKind::ValueValidation && error.to_string().contains("'$");
        let is_right = error.kind() == ErrorKind::DisplayHelp || is_variable || line.is_prose && is_name;
        assert!(is_right, "{}: {:?}: {error}", line.place, line.words);
    }
}
