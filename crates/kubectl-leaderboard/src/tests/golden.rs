//! Files in `shown/` with what is printed. UPDATE_GOLDEN=1 writes them; read the difference then.

use std::fmt::Write as _;
use std::path::Path;

use super::now;
use crate::output::painted;
use crate::text::{Frame, columns};

/// Columns of the terminals.
pub(super) const WIDTHS: [usize; 2] = [80, 120];
/// Texts that people copy, and that no line may break.
const COPIED: [&str; 5] = ["s3://", "aws ", "https://", "kubectl ", "`kubectl "];

/// Compares what one command prints with its file: for a narrow and a wide terminal, without and with colours.
pub(super) fn assert_shown(name: &str, lines: impl Fn(Frame) -> Vec<String>) {
    let mut text = String::new();
    for width in WIDTHS {
        let lines = lines(Frame { now: now(), width });
        assert_fits(name, &lines, width);
        for (colours, line_of) in [("without", str::to_owned as fn(&str) -> String), ("with", painted)] {
            writeln!(text, "=== {width} columns, {colours} colours").unwrap();
            for line in &lines {
                writeln!(text, "{}", line_of(line)).unwrap();
            }
        }
    }
    assert_golden(name, &text);
}

/// Compares texts with their file.
pub(super) fn assert_texts(name: &str, texts: &[(&str, String)]) {
    let texts = texts.iter().map(|(what, text)| format!("=== {what}\n{text}\n"));
    assert_golden(name, &texts.collect::<String>());
}

/// No line is wider than the terminal, unless it is something to copy alone.
pub(super) fn assert_fits(name: &str, lines: &[String], width: usize) {
    for line in lines {
        assert!(
            !line.contains('\u{1b}'),
            "{name}: a line has colours of its own: {line:?}"
        );
        assert_eq!(line.trim_end(), line, "{name}: no line ends with white space");
        let text = line.trim_start();
        let text = text.split_once(":  ").map_or(text, |(_, text)| text.trim_start());
        let is_copied = COPIED.iter().any(|start| text.starts_with(start));
        assert!(is_copied || columns(line) <= width, "{name}, {width} columns: {line}");
    }
}

/// Compares a text with its file, which holds no escapes.
pub(crate) fn assert_golden(name: &str, text: &str) {
    // `local/lab owner` changes the address.
    let text = text.replace(env!("CARGO_PKG_REPOSITORY"), "https://REPOSITORY");
    let text = text.replace('\u{1b}', "␛");
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("src/tests/shown/{name}.txt"));
    if std::env::var_os("UPDATE_GOLDEN").is_some() {
        return std::fs::write(file, text).unwrap();
    }
    let known = std::fs::read_to_string(&file).unwrap_or_default();
    assert_eq!(
        text, known,
        "{name} is shown in another way; set UPDATE_GOLDEN=1 and read the difference"
    );
}
