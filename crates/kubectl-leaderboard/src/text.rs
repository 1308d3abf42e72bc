//! Lines of text: cleaned, wrapped, in rows with a label; and times as people write them.
//!
//! Called by every module that prints. Pure: the time is handed in.

use jiff::Timestamp;
use leaderboard_api::text::one_line;

/// Columns of a line. Only an address or a command that is to be copied may be longer.
pub(super) const WIDTH: usize = 100;
/// Columns of a label, and of what is below it.
const INDENT: usize = 13;

/// Lines that are being written.
#[derive(Default)]
pub(super) struct Page(Vec<String>);

impl Page {
    /// A paragraph.
    pub(super) fn paragraph(&mut self, text: &str) {
        self.0.extend(wrap(text, WIDTH));
    }

    /// An empty line, unless there is one.
    pub(super) fn gap(&mut self) {
        if self.0.last().is_some_and(|last| !last.is_empty()) {
            self.0.push(String::new());
        }
    }

    /// A label and a text; without a label, more text below the row before. No text, no row.
    pub(super) fn row(&mut self, label: &str, text: &str) {
        self.labelled(label, wrap(text, WIDTH - INDENT));
    }

    /// A label and what is to be copied, so it is not broken.
    pub(super) fn whole(&mut self, label: &str, text: &str) {
        self.labelled(label, vec![clean(text)]);
    }

    /// The lines.
    pub(super) fn into_lines(self) -> Vec<String> {
        self.0
    }

    fn labelled(&mut self, label: &str, lines: Vec<String>) {
        let mut label = if label.is_empty() {
            String::new()
        } else {
            format!("{label}:")
        };
        for line in lines {
            self.0.push(format!("{label:<INDENT$}{line}"));
            label.clear();
        }
    }
}

/// A text in lines of at most `width` columns.
pub(super) fn wrap(text: &str, width: usize) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for word in clean(text).split_whitespace() {
        let letters: Vec<char> = word.chars().collect();
        for piece in letters.chunks(width.max(1)) {
            match lines.last_mut() {
                Some(last) if last.chars().count() + 1 + piece.len() <= width => {
                    last.push(' ');
                    last.extend(piece);
                }
                _ => lines.push(piece.iter().collect()),
            }
        }
    }
    lines
}

/// A text of any length: much of what is printed was written by strangers.
pub(super) fn clean(text: &str) -> String {
    one_line(text, usize::MAX)
}

/// Joins what is not empty by spaces.
pub(super) fn join(parts: &[&str]) -> String {
    let parts: Vec<&str> = parts.iter().copied().filter(|part| !part.is_empty()).collect();
    parts.join(" ")
}

/// `2026-11-01 10:00:00 UTC (3 min ago)`.
pub(super) fn when(at: Timestamp, now: Timestamp) -> String {
    let seconds = now.duration_since(at).as_secs();
    let distance = span(seconds);
    let time = at.strftime("%Y-%m-%d %H:%M:%S UTC");
    if seconds >= 0 {
        format!("{time} ({distance} ago)")
    } else {
        format!("{time} (in {distance})")
    }
}

/// A length of time, rounded down to one unit.
pub(super) fn span(seconds: i64) -> String {
    match seconds.unsigned_abs() {
        s if s < 120 => format!("{s} s"),
        s if s < 120 * 60 => format!("{} min", s / 60),
        s if s < 48 * 3600 => format!("{} h", s / 3600),
        s => format!("{} days", s / 86_400),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_hang_below_their_label_and_stay_within_the_width() {
        let mut page = Page::default();
        page.row("Reason", &"word ".repeat(60));
        page.row("", &"x".repeat(250));
        page.row("Empty", " ");
        let lines = page.into_lines();
        assert!(lines[0].starts_with("Reason:      word "), "{}", lines[0]);
        assert!(lines[1].starts_with("             word"), "{}", lines[1]);
        assert!(lines.iter().all(|line| line.chars().count() <= WIDTH), "{lines:#?}");
        assert!(!lines.iter().any(|line| line.contains("Empty")));
        let letters: usize = lines.iter().map(|line| line.matches('x').count()).sum();
        assert_eq!(letters, 250, "nothing is lost");
    }

    #[test]
    fn what_is_to_be_copied_is_not_broken() {
        let mut page = Page::default();
        let address = format!("s3://bucket/{}", "a/".repeat(80));
        page.whole("Results", &address);
        let lines = page.into_lines();
        assert_eq!(lines, [format!("Results:     {address}")]);
    }

    #[test]
    fn what_is_printed_is_harmless() {
        let hostile = "Team\u{1b}[2J\u{202e}\u{9b}31m\r\nSeven";
        assert_eq!(wrap(hostile, 80), ["Team\u{fffd}[2J\u{fffd}\u{fffd}31m Seven"]);
        assert_eq!(clean(hostile), "Team\u{fffd}[2J\u{fffd}\u{fffd}31m Seven");
    }

    #[test]
    fn times_have_one_unit() {
        let at = |second: i64| Timestamp::from_second(1_793_527_200 + second).unwrap();
        assert_eq!(when(at(0), at(200)), "2026-11-01 10:00:00 UTC (3 min ago)");
        assert_eq!(when(at(12), at(0)), "2026-11-01 10:00:12 UTC (in 12 s)");
        for (seconds, expected) in [
            (0, "0 s"),
            (119, "119 s"),
            (120, "2 min"),
            (7_200, "2 h"),
            (4 * 86_400, "4 days"),
        ] {
            assert_eq!(span(seconds), expected);
        }
    }
}
