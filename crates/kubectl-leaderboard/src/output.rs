//! How a command prints: as text for people, or as JSON or YAML for programs.
//!
//! Called by `main`. Pure but for `print`.

use std::io::{ErrorKind, IsTerminal as _, Write as _};
use std::process::ExitCode;
use std::sync::{Mutex, OnceLock, PoisonError};

use clap::builder::{PossibleValuesParser, TypedValueParser};
use clap::{Args, ColorChoice, ValueEnum};
use leaderboard_api::text::is_harmful;
use serde_json::Value;

use super::table::{DONE, OPEN};
use super::text::{WIDTH, clean, hanging, join};

/// The narrowest and the widest page. A text in longer lines is hard to read.
const NARROWEST: usize = 60;
const WIDEST: usize = 120;

/// True if lines are coloured; set once at the start.
static COLOURS: OnceLock<bool> = OnceLock::new();

/// Output format of a command.
#[derive(ValueEnum, Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Format {
    #[default]
    Text,
    Wide,
    Json,
    Yaml,
    Csv,
}

/// The flag `-o`.
#[derive(Args, Clone, Copy, Debug)]
pub struct Output {
    /// Output format.
    #[arg(short = 'o', long = "output", value_name = "FORMAT", default_value = "text", value_parser = formats(["text", "json", "yaml"]))]
    pub format: Format,
}

/// Formats that a command has.
pub fn formats<const N: usize>(names: [&'static str; N]) -> impl TypedValueParser<Value = Format> {
    let parser = PossibleValuesParser::new(names);
    parser.map(|name| Format::from_str(&name, true).unwrap_or_default())
}

/// Decides for this process whether lines are coloured.
pub fn set_colours(wanted: ColorChoice) {
    let is_wanted = match wanted {
        ColorChoice::Always => true,
        ColorChoice::Never => false,
        ColorChoice::Auto => {
            std::io::stdout().is_terminal() && std::env::var_os("NO_COLOR").is_none_or(|v| v.is_empty())
        }
    };
    // Only the first call counts, and there is one.
    let _ = COLOURS.set(is_wanted);
}

/// A value as text in a format for programs; none for the formats of people.
pub fn document(format: Format, value: &Value) -> Option<Vec<String>> {
    match format {
        Format::Text | Format::Wide | Format::Csv => None,
        Format::Json => Some(vec![escaped(&format!("{value:#}"), |c| {
            let mut units = [0; 2];
            let units = c.encode_utf16(&mut units);
            let units: Vec<String> = units.iter().map(|unit| format!("\\u{unit:04x}")).collect();
            units.concat()
        })]),
        Format::Yaml => {
            let mut lines = Vec::new();
            yaml("", value, 0, &mut lines);
            // YAML has no pairs for what is beyond 16 bits.
            let escape = |c: char| format!("\\U{:08x}", u32::from(c));
            Some(lines.iter().map(|line| escaped(line, escape)).collect())
        }
    }
}

/// A document in which nothing commands a terminal or turns a text around: only texts of strangers hold such characters, and they stand in
/// quotes. Line breaks are the document's own.
fn escaped(document: &str, escape: impl Fn(char) -> String) -> String {
    let mut harmless = String::with_capacity(document.len());
    for c in document.chars() {
        if c != '\n' && is_harmful(c) {
            harmless.push_str(&escape(c));
        } else {
            harmless.push(c);
        }
    }
    harmless
}

/// YAML in blocks: what a line begins with, and its value. Strings are quoted as in JSON, which YAML reads alike.
fn yaml(start: &str, value: &Value, indent: usize, lines: &mut Vec<String>) {
    let inner: Vec<(String, &Value)> = match value {
        Value::Object(fields) => {
            let start = |key: &String| format!("{}:", Value::from(key.as_str()));
            fields.iter().map(|(key, value)| (start(key), value)).collect()
        }
        Value::Array(items) => items.iter().map(|item| ("-".to_owned(), item)).collect(),
        _ => Vec::new(),
    };
    if inner.is_empty() {
        lines.push(join(&[start, &value.to_string()]));
    } else if !start.is_empty() {
        lines.push(start.to_owned());
    }
    let space = " ".repeat(indent);
    for (start, value) in inner {
        yaml(&format!("{space}{start}"), value, indent + 2, lines);
    }
}

/// Columns of a page of text: those of the terminal, within reason.
pub fn width() -> usize {
    terminal().map_or(WIDTH, |(columns, _)| within_reason(columns))
}

fn within_reason(columns: usize) -> usize {
    columns.clamp(NARROWEST, WIDEST)
}

/// Columns and rows of the terminal, if it is written to.
fn terminal() -> Option<(usize, usize)> {
    let (columns, rows) = terminal_size::terminal_size_of(std::io::stdout())?;
    Some((columns.0.into(), rows.0.into()))
}

/// A screen that is drawn again and again.
#[derive(Debug, Default)]
pub struct Screen {
    is_drawn: bool,
}

impl Screen {
    /// True on a terminal, where lines can be drawn over, and ages grow as time passes.
    pub fn is_live() -> bool {
        terminal().is_some()
    }

    /// Shows these lines: on a terminal over those before, elsewhere below an empty line.
    pub fn draw(&mut self, lines: &[String]) {
        if let Some(size) = terminal() {
            let text = redrawn(lines, size, has_colours(), self.is_drawn);
            self.is_drawn = true;
            write_all(&text);
        } else {
            print(&[String::new()]);
            print(lines);
        }
    }
}

/// The text that draws lines over those before. It erases only the rest of each line and of the screen, so the screen never blinks.
fn redrawn(lines: &[String], (columns, rows): (usize, usize), is_coloured: bool, is_drawn: bool) -> String {
    let mut text = if is_drawn {
        HOME.to_owned()
    } else {
        format!("{CLEAR}{HOME}")
    };
    let mut left = rows.saturating_sub(1);
    for line in lines {
        let needed = crate::text::columns(line).div_ceil(columns.max(1)).max(1);
        if needed > left {
            break;
        }
        left -= needed;
        let line = if is_coloured { painted(line) } else { line.clone() };
        text.push_str(&line);
        text.push_str(END_OF_LINE);
    }
    text.push_str(REST);
    text
}

/// Prints lines.
pub fn print(lines: &[String]) {
    let is_coloured = has_colours();
    for line in lines {
        if is_coloured {
            write_all(&format!("{}\n", painted(line)));
        } else {
            write_all(&format!("{line}\n"));
        }
    }
}

/// Prints what a person should see and a program that reads the output should not: an error, or what has become of what is followed.
pub fn note(text: &str) {
    let columns = terminal_size::terminal_size_of(std::io::stderr()).map(|(columns, _)| columns.0.into());
    for line in noted(text, columns) {
        eprintln!("{line}");
    }
}

/// Prints a note, unless it is the one before: what is tried again and again fails in one way.
pub fn note_once(text: &str) {
    static LAST: Mutex<String> = Mutex::new(String::new());
    let mut last = LAST.lock().unwrap_or_else(PoisonError::into_inner);
    if *last != text {
        note(text);
        text.clone_into(&mut last);
    }
}

/// The exit code of a command that has come to its end.
pub fn code(is_well: bool) -> ExitCode {
    ExitCode::from(u8::from(!is_well))
}

/// The lines of a note: one, or on a terminal of so many columns as many as it needs.
pub(super) fn noted(text: &str, columns: Option<usize>) -> Vec<String> {
    let text = format!("kubectl leaderboard: {}", clean(text));
    let Some(columns) = columns else {
        return vec![text];
    };
    hanging(&text, within_reason(columns))
}

/// Texts of one line each, which only a terminal breaks: a program reads lines.
pub fn paragraphs(texts: &[String]) -> Vec<String> {
    let width = terminal().map(|(columns, _)| within_reason(columns));
    let lines = texts
        .iter()
        .map(|text| width.map_or_else(|| vec![clean(text)], |width| hanging(text, width)));
    lines.flatten().collect()
}

/// Prints a line of the stream of this number behind its label. Each stream has its colour.
pub fn print_labelled(stream: usize, label: &str, line: &str) {
    write_all(&format!("{}\n", labelled(stream, label, line, has_colours())));
}

pub(super) fn labelled(stream: usize, label: &str, line: &str, is_coloured: bool) -> String {
    let label = if is_coloured {
        let colour = STREAMS.get(stream % STREAMS.len()).copied().unwrap_or(PLAIN);
        format!("{colour}[{label}]{PLAIN}")
    } else {
        format!("[{label}]")
    };
    join(&[&label, line])
}

/// Asks a person at a terminal; none elsewhere, where no person could answer.
pub fn ask(question: &str) -> Option<bool> {
    if !std::io::stdin().is_terminal() || !std::io::stdout().is_terminal() {
        return None;
    }
    let mut out = std::io::stdout().lock();
    if write!(out, "{} [y/N] ", clean(question))
        .and_then(|()| out.flush())
        .is_err()
    {
        return Some(false);
    }
    let mut answer = String::new();
    let is_read = std::io::stdin().read_line(&mut answer).is_ok();
    Some(is_read && ["y", "yes"].contains(&answer.trim().to_lowercase().as_str()))
}

fn has_colours() -> bool {
    COLOURS.get().copied().unwrap_or(false)
}

fn write_all(text: &str) {
    let mut out = std::io::stdout().lock();
    let written = out.write_all(text.as_bytes()).and_then(|()| out.flush());
    // Ignore a closed pipe.
    if let Err(error) = written
        && error.kind() != ErrorKind::BrokenPipe
    {
        note(&format!(
            "cannot write the output: {error}. Check where it is redirected to"
        ));
    }
}

/// To the first line.
const HOME: &str = "\u{1b}[H";
/// Erases the whole screen.
const CLEAR: &str = "\u{1b}[2J";
/// Erases what a longer line has left, and goes to the next one.
const END_OF_LINE: &str = "\u{1b}[K\r\n";
/// Erases all lines below.
const REST: &str = "\u{1b}[J";

/// Colours of streams, one after the other.
const STREAMS: [&str; 6] = [
    "\u{1b}[36m",
    "\u{1b}[33m",
    "\u{1b}[32m",
    "\u{1b}[35m",
    "\u{1b}[34m",
    "\u{1b}[31m",
];
const RED: &str = "\u{1b}[31m";
const GREEN: &str = "\u{1b}[32m";
const YELLOW: &str = "\u{1b}[33m";
const CYAN: &str = "\u{1b}[36m";
const DIM: &str = "\u{1b}[2m";
const PLAIN: &str = "\u{1b}[0m";

/// A line with colours: the mark at its start, its progress bar, or the first state in it.
pub(super) fn painted(line: &str) -> String {
    let marks = [('✔', GREEN), ('✘', RED), ('!', YELLOW), ('–', DIM)];
    let first = line.chars().next();
    if let Some((mark, colour)) = marks.into_iter().find(|(mark, _)| first == Some(*mark)) {
        let rest = line.get(mark.len_utf8()..).unwrap_or_default();
        return format!("{colour}{mark}{PLAIN}{rest}");
    }
    if let Some(start) = line.find([DONE, OPEN]) {
        let (before, bar) = line.split_at(start);
        return format!("{before}{}", painted_bar(bar));
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

/// A bar, which has its own colour once it is whole, and what stands after it.
fn painted_bar(bar: &str) -> String {
    let rest = bar.trim_start_matches(DONE);
    let after = rest.trim_start_matches(OPEN);
    let (done, open) = (&bar[..bar.len() - rest.len()], &rest[..rest.len() - after.len()]);
    let colour = if open.is_empty() { GREEN } else { CYAN };
    let parts = [(colour, done), (DIM, open)]
        .into_iter()
        .filter(|(_, part)| !part.is_empty())
        .map(|(colour, part)| format!("{colour}{part}{PLAIN}"));
    parts.chain(std::iter::once(after.to_owned())).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn no_document_commands_a_terminal() {
        let hostile = "a\u{9b}31m\u{202e}b\u{7f}\u{e0041}\tc\n";
        let value = json!({ hostile: [hostile] });
        for (format, expected) in [
            (Format::Json, r"a\u009b31m\u202eb\u007f\udb40\udc41\tc\n"),
            (Format::Yaml, r"a\U0000009b31m\U0000202eb\U0000007f\U000e0041\tc\n"),
        ] {
            let text = document(format, &value).unwrap().join("\n");
            assert_eq!(text.matches(expected).count(), 2, "{text}");
            assert!(text.chars().all(|c| c == '\n' || !is_harmful(c)), "{text}");
        }
        let json = document(Format::Json, &value).unwrap().join("\n");
        assert_eq!(serde_json::from_str::<Value>(&json).unwrap(), value);
    }

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
    fn a_screen_is_drawn_over_the_one_before_without_being_erased() {
        let lines = |texts: &[&str]| texts.iter().map(|text| (*text).to_owned()).collect::<Vec<_>>();
        let first = redrawn(&lines(&["one", "two"]), (80, 24), false, false);
        assert_eq!(first, "\u{1b}[2J\u{1b}[Hone\u{1b}[K\r\ntwo\u{1b}[K\r\n\u{1b}[J");
        let again = redrawn(&lines(&["a Running b"]), (80, 24), true, true);
        assert_eq!(again, "\u{1b}[Ha \u{1b}[36mRunning\u{1b}[0m b\u{1b}[K\r\n\u{1b}[J");
        assert!(!again.contains(CLEAR));
        // The last row stays free: a line below it would scroll the first one away.
        let tall = redrawn(&lines(&["1", &"2".repeat(15), "3", "4"]), (10, 4), false, true);
        assert_eq!(
            tall,
            format!("{HOME}1{END_OF_LINE}{}{END_OF_LINE}{REST}", "2".repeat(15))
        );
    }

    #[test]
    fn marks_bars_and_states_are_coloured_and_nothing_else() {
        for (line, expected) in [
            ("✔ Node  gpu-3", "\u{1b}[32m✔\u{1b}[0m Node  gpu-3"),
            ("✘ Node", "\u{1b}[31m✘\u{1b}[0m Node"),
            (
                "a  Failed   3 min  was Running before",
                "a  \u{1b}[31mFailed\u{1b}[0m   3 min  was Running before",
            ),
            (
                "Worker 1:  ██░░ 1/2",
                "Worker 1:  \u{1b}[36m██\u{1b}[0m\u{1b}[2m░░\u{1b}[0m 1/2",
            ),
            ("Worker 2:  ██ 2/2", "Worker 2:  \u{1b}[32m██\u{1b}[0m 2/2"),
            ("Next: Nothing.", "Next: Nothing."),
        ] {
            assert_eq!(painted(line), expected);
        }
    }
}
