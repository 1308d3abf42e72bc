//! How a command prints: as text for people, or as JSON or YAML for programs.
//!
//! Called by `main`. Pure but for `print`.

use std::io::{ErrorKind, IsTerminal as _, Write as _};
use std::sync::OnceLock;

use clap::{Args, ValueEnum};
use serde_json::Value;

/// Whether lines are coloured; set once at the start.
static COLOURS: OnceLock<bool> = OnceLock::new();

/// What a command prints.
#[derive(ValueEnum, Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Format {
    #[default]
    Text,
    /// More columns.
    Wide,
    Json,
    Yaml,
}

/// The flag `-o`.
#[derive(Args, Clone, Copy, Debug)]
pub struct Output {
    /// Output format.
    #[arg(short = 'o', long = "output", value_enum, default_value_t, value_name = "FORMAT")]
    pub format: Format,
}

/// When lines are coloured.
#[derive(ValueEnum, Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Colour {
    /// On a terminal, unless NO_COLOR is set.
    #[default]
    Auto,
    Always,
    Never,
}

impl Colour {
    /// Decides for this process.
    pub fn settle(self) {
        let is_wanted = match self {
            Self::Always => true,
            Self::Never => false,
            Self::Auto => std::io::stdout().is_terminal() && std::env::var_os("NO_COLOR").is_none_or(|v| v.is_empty()),
        };
        // Only the first call counts, and there is one.
        let _ = COLOURS.set(is_wanted);
    }
}

/// A value as text in a format for programs; none for the formats of people.
pub fn document(format: Format, value: &Value) -> Option<Vec<String>> {
    match format {
        Format::Text | Format::Wide => None,
        Format::Json => Some(vec![format!("{value:#}")]),
        Format::Yaml => {
            let mut lines = Vec::new();
            yaml(value, 0, &mut lines);
            Some(lines)
        }
    }
}

/// YAML in blocks. Strings are quoted as in JSON, which YAML reads alike.
fn yaml(value: &Value, indent: usize, lines: &mut Vec<String>) {
    let space = " ".repeat(indent);
    match value {
        Value::Object(fields) if !fields.is_empty() => {
            for (key, value) in fields {
                let key = Value::from(key.as_str());
                nested(&format!("{space}{key}:"), value, indent + 2, lines);
            }
        }
        Value::Array(items) if !items.is_empty() => {
            for item in items {
                nested(&format!("{space}-"), item, indent + 2, lines);
            }
        }
        scalar => lines.push(format!("{space}{scalar}")),
    }
}

fn nested(start: &str, value: &Value, indent: usize, lines: &mut Vec<String>) {
    let is_block = matches!(value, Value::Object(fields) if !fields.is_empty())
        || matches!(value, Value::Array(items) if !items.is_empty());
    if is_block {
        lines.push(start.to_owned());
        yaml(value, indent, lines);
    } else {
        lines.push(format!("{start} {value}"));
    }
}

/// Begins a screen anew: on a terminal in its first line, elsewhere below an empty line.
pub fn begin_screen() {
    let start = if std::io::stdout().is_terminal() {
        "\u{1b}[H\u{1b}[2J"
    } else {
        ""
    };
    print(&[start.to_owned()]);
}

/// Prints lines.
pub fn print(lines: &[String]) {
    let has_colours = COLOURS.get().copied().unwrap_or(false);
    let mut out = std::io::stdout().lock();
    for line in lines {
        let written = if has_colours {
            writeln!(out, "{}", painted(line))
        } else {
            writeln!(out, "{line}")
        };
        if let Err(error) = written {
            // Ignore a closed pipe.
            if error.kind() != ErrorKind::BrokenPipe {
                eprintln!("kubectl leaderboard: cannot write the output: {error}. Check where it is redirected to");
            }
            return;
        }
    }
}

const RED: &str = "\u{1b}[31m";
const GREEN: &str = "\u{1b}[32m";
const YELLOW: &str = "\u{1b}[33m";
const CYAN: &str = "\u{1b}[36m";
const DIM: &str = "\u{1b}[2m";
const PLAIN: &str = "\u{1b}[0m";

/// A line with colours: the mark at its start, and the first state in it.
fn painted(line: &str) -> String {
    let marks = [('✔', GREEN), ('✘', RED), ('!', YELLOW), ('–', DIM)];
    let first = line.chars().next();
    if let Some((mark, colour)) = marks.into_iter().find(|(mark, _)| first == Some(*mark)) {
        let rest = line.get(mark.len_utf8()..).unwrap_or_default();
        return format!("{colour}{mark}{PLAIN}{rest}");
    }
    let states = [
        ("Pending", YELLOW),
        ("Running", CYAN),
        ("Resumed", CYAN),
        ("Finished", GREEN),
        ("Failed", RED),
        ("Cancelled", DIM),
    ];
    let place = |state: &str| line.find(&format!(" {state} "));
    let found = states
        .into_iter()
        .filter_map(|(state, colour)| Some((place(state)?, state, colour)));
    match found.min_by_key(|(place, ..)| *place) {
        Some((place, state, colour)) => {
            let (before, after) = (&line[..=place], &line[place + 1 + state.len()..]);
            format!("{before}{colour}{state}{PLAIN}{after}")
        }
        None => line.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn documents_are_json_or_yaml_in_blocks() {
        let value = json!({"name": "a: b", "list": [1, {"x": null}, []], "empty": {}});
        assert_eq!(document(Format::Text, &value), None);
        let json = document(Format::Json, &value).unwrap().join("\n");
        assert_eq!(serde_json::from_str::<Value>(&json).unwrap(), value);
        let lines = document(Format::Yaml, &value).unwrap();
        assert_eq!(
            lines,
            [
                "\"empty\": {}",
                "\"list\":",
                "  - 1",
                "  -",
                "    \"x\": null",
                "  - []",
                "\"name\": \"a: b\"",
            ]
        );
    }

    #[test]
    fn marks_and_states_are_coloured_and_nothing_else() {
        for (line, expected) in [
            ("✔ Node  gpu-3", "\u{1b}[32m✔\u{1b}[0m Node  gpu-3"),
            ("✘ Node", "\u{1b}[31m✘\u{1b}[0m Node"),
            (
                "a  Failed   3 min  was Running before",
                "a  \u{1b}[31mFailed\u{1b}[0m   3 min  was Running before",
            ),
            ("Next: Nothing.", "Next: Nothing."),
        ] {
            assert_eq!(painted(line), expected);
        }
    }
}
