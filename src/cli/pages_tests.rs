//! Every line of the documents that starts the operator's program is one that it takes.

use std::path::Path;

use clap::Parser;
use clap::error::ErrorKind;

use super::Cli;

#[path = "../../tests/support/pages.rs"]
mod support;

#[test]
fn the_program_takes_every_line_of_the_documents() {
    let lines = support::lines(Path::new(env!("CARGO_MANIFEST_DIR")), "leaderboard-operator");
    assert!(lines.len() > 10, "{}", lines.len());
    for line in lines {
        // The reader replaces `…` by a value.
        let words = line.words.iter().map(String::as_str).filter(|word| *word != "…");
        let Err(error) = Cli::try_parse_from(std::iter::once("leaderboard-operator").chain(words)) else {
            continue;
        };
        let is_name = matches!(
            error.kind(),
            ErrorKind::MissingRequiredArgument
                | ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand
                | ErrorKind::InvalidValue
        );
        let is_answer = matches!(error.kind(), ErrorKind::DisplayHelp | ErrorKind::DisplayVersion);
        assert!(
            is_answer || line.is_prose && is_name,
            "{}: {:?}: {error}",
            line.place,
            line.words
        );
    }
}
