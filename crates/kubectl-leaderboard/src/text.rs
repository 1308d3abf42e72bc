//! Lines of text: cleaned, wrapped, in rows with a label; and times as people write them.
//!
//! Called by every module that prints. Pure: the time is handed in.

use jiff::Timestamp;
use leaderboard_api::text::one_line;
use unicode_width::{UnicodeWidthChar as _, UnicodeWidthStr as _};

/// Columns of a line where no terminal has a number of its own. Only an address or a command that is to be copied may be longer.
pub(super) const WIDTH: usize = 100;
/// Columns of a label, and of what is below it.
const INDENT: usize = 13;

/// When something is shown, and in how many columns.
#[derive(Clone, Copy, Debug)]
pub struct Frame {
    pub now: Timestamp,
    pub width: usize,
}

impl Frame {
    /// A page of this width.
    pub(super) fn page(self) -> Page {
        Page {
            lines: Vec::new(),
            width: self.width,
        }
    }
}

/// Lines that are being written.
pub(super) struct Page {
    lines: Vec<String>,
    width: usize,
}

impl Page {
    /// A paragraph.
    pub(super) fn paragraph(&mut self, text: &str) {
        self.lines.extend(wrap(text, self.width));
    }

    /// An empty line, unless there is one.
    pub(super) fn gap(&mut self) {
        if self.lines.last().is_some_and(|last| !last.is_empty()) {
            self.lines.push(String::new());
        }
    }

    /// A label and a text; without a label, more text below the row before. No text, no row.
    pub(super) fn row(&mut self, label: &str, text: &str) {
        self.labelled(label, wrap(text, self.width.saturating_sub(INDENT)));
    }

    /// A label and what is to be copied, so it is not broken. No text, no row.
    pub(super) fn whole(&mut self, label: &str, text: &str) {
        self.labelled(label, Some(clean(text)).filter(|text| !text.is_empty()));
    }

    /// The lines.
    pub(super) fn into_lines(self) -> Vec<String> {
        self.lines
    }

    fn labelled(&mut self, label: &str, lines: impl IntoIterator<Item = String>) {
        let mut label = if label.is_empty() {
            String::new()
        } else {
            format!("{label}:")
        };
        for line in lines {
            self.lines.push(format!("{label:<INDENT$}{line}"));
            label.clear();
        }
    }
}

/// A text in lines of at most `width` columns. A command between backticks is not broken: one that is longer has a line of its own.
pub(super) fn wrap(text: &str, width: usize) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for word in words(&clean(text)) {
        let pieces = if word.contains(' ') {
            vec![word]
        } else {
            pieces(&word, width.max(2))
        };
        for piece in pieces {
            match lines.last_mut() {
                Some(last) if columns(last) + 1 + columns(&piece) <= width => {
                    last.push(' ');
                    last.push_str(&piece);
                }
                _ => lines.push(piece),
            }
        }
    }
    lines
}

/// A text whose further lines are indented.
pub(super) fn hanging(text: &str, width: usize) -> Vec<String> {
    const INDENT: &str = "  ";
    let lines = wrap(text, width.saturating_sub(INDENT.len())).into_iter().enumerate();
    let indented = |(number, line)| if number == 0 { line } else { format!("{INDENT}{line}") };
    lines.map(indented).collect()
}

/// The words of a text. A text in backticks is one word with the letters that touch it.
fn words(text: &str) -> Vec<String> {
    let is_balanced = text.matches('`').count().is_multiple_of(2);
    let mut words: Vec<String> = Vec::new();
    let mut is_open = false;
    for word in text.split_whitespace() {
        match words.last_mut().filter(|_| is_open) {
            Some(last) => {
                last.push(' ');
                last.push_str(word);
            }
            None => words.push(word.to_owned()),
        }
        is_open ^= is_balanced && !word.matches('`').count().is_multiple_of(2);
    }
    words
}

/// A word in pieces of at most `width` columns.
fn pieces(word: &str, width: usize) -> Vec<String> {
    let mut pieces = vec![String::new()];
    for letter in word.chars() {
        let used = pieces.last().map_or(0, |piece| columns(piece));
        if used > 0 && used + letter.width().unwrap_or(0) > width {
            pieces.push(String::new());
        }
        if let Some(piece) = pieces.last_mut() {
            piece.push(letter);
        }
    }
    pieces
}

/// Columns of a text on a terminal: letters of East Asia and most emoji take two.
pub(super) fn columns(text: &str) -> usize {
    text.width()
}

/// A text of at most so many columns.
pub(super) fn cut(text: &str, width: usize) -> String {
    if columns(text) <= width {
        return text.to_owned();
    }
    let mut kept = String::new();
    for letter in text.chars() {
        if columns(&kept) + letter.width().unwrap_or(0) + 1 > width {
            break;
        }
        kept.push(letter);
    }
    format!("{}…", kept.trim_end())
}

/// The end of a text, of at most so many columns.
pub(super) fn cut_start(text: &str, width: usize) -> String {
    let backwards = |text: &str| text.chars().rev().collect::<String>();
    backwards(&cut(&backwards(text), width))
}

/// A text with blanks up to so many columns.
pub(super) fn padded(text: &str, width: usize) -> String {
    format!("{text}{}", " ".repeat(width.saturating_sub(columns(text))))
}

/// A text of any length: much of what is printed was written by strangers.
pub(super) fn clean(text: &str) -> String {
    one_line(text, usize::MAX)
}

/// A line of a log, in which columns and indentation stay.
pub(super) fn log_line(line: &str) -> String {
    let line = line.trim_end().replace('\t', "    ");
    line.split(' ').map(clean).collect::<Vec<_>>().join(" ")
}

/// Joins what is not empty by spaces.
pub(super) fn join(parts: &[&str]) -> String {
    let parts: Vec<&str> = parts.iter().copied().filter(|part| !part.is_empty()).collect();
    parts.join(" ")
}

/// A number of things: `1 object`, `2 objects`.
pub(super) fn counted(number: usize, one: &str) -> String {
    format!("{number} {one}{}", if number == 1 { "" } else { "s" })
}

/// `2026-11-01 10:00:00 UTC (3m20s ago)`.
pub(super) fn when(at: Timestamp, now: Timestamp) -> String {
    let seconds = now.duration_since(at).as_secs();
    let distance = age(at, now);
    let time = at.strftime("%Y-%m-%d %H:%M:%S UTC");
    if seconds >= 0 {
        format!("{time} ({distance} ago)")
    } else {
        format!("{time} (in {distance})")
    }
}

/// How long ago something was.
pub(super) fn age(at: Timestamp, now: Timestamp) -> String {
    span(now.duration_since(at).as_secs())
}

/// A length of time as kubectl writes ages: `18s`, `2m5s`, `60m`, `3h20m`, `4d`.
pub(super) fn span(seconds: i64) -> String {
    const MINUTE: u64 = 60;
    const HOUR: u64 = 60 * MINUTE;
    const DAY: u64 = 24 * HOUR;
    let seconds = seconds.unsigned_abs();
    let two = |unit: u64, one: &str, part: u64, other: &str| match seconds % unit / part {
        0 => format!("{}{one}", seconds / unit),
        rest => format!("{}{one}{rest}{other}", seconds / unit),
    };
    match seconds {
        s if s < 2 * MINUTE => format!("{s}s"),
        s if s < 10 * MINUTE => two(MINUTE, "m", 1, "s"),
        s if s < 3 * HOUR => format!("{}m", s / MINUTE),
        s if s < 8 * HOUR => two(HOUR, "h", MINUTE, "m"),
        s if s < 2 * DAY => format!("{}h", s / HOUR),
        s if s < 8 * DAY => two(DAY, "d", HOUR, "h"),
        s => format!("{}d", s / DAY),
    }
}

/// A number of bytes as Kubernetes writes quantities: `512`, `12Ki`, `3Gi`, rounded down.
pub(super) fn size(bytes: u64) -> String {
    let units = ["", "Ki", "Mi", "Gi", "Ti"];
    let power = (0..units.len())
        .rev()
        .find(|power| bytes >> (10 * power) > 0)
        .unwrap_or(0);
    format!(
        "{}{}",
        bytes >> (10 * power),
        units.get(power).copied().unwrap_or_default()
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(width: usize) -> Frame {
        let now = Timestamp::UNIX_EPOCH;
        Frame { now, width }
    }

    #[test]
    fn wide_letters_take_two_columns() {
        assert_eq!(wrap("自動運転 隊", 8), ["自動運転", "隊"]);
        assert_eq!(wrap("自動運転隊", 4), ["自動", "運転", "隊"]);
        assert_eq!(cut("自動運転隊", 7), "自動運…");
        assert_eq!(cut("short", 5), "short");
        assert_eq!(cut_start("simulator:0.9.15-3", 10), "…:0.9.15-3");
        assert_eq!(cut_start("自動運転隊", 7), "…運転隊");
        assert_eq!(cut_start("short", 5), "short");
        assert_eq!(padded("隊", 4), "隊  ");
    }

    #[test]
    fn rows_hang_below_their_label_and_stay_within_the_width() {
        let mut page = frame(WIDTH).page();
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
        let mut page = frame(WIDTH).page();
        let address = format!("s3://bucket/{}", "a/".repeat(80));
        page.whole("Results", &address);
        let lines = page.into_lines();
        assert_eq!(lines, [format!("Results:     {address}")]);
    }

    #[test]
    fn a_command_in_a_text_is_not_broken() {
        let text = "There is more: `kubectl leaderboard why submission-42 -n carla`. Or `two` `of them` or 5` tall.";
        let command = "`kubectl leaderboard why submission-42 -n carla`.";
        for width in [20, 50] {
            let lines = wrap(&format!("{text}`"), width);
            assert!(lines.iter().any(|line| line == command), "{lines:#?}");
            assert_eq!(lines.join(" "), format!("{text}`"));
        }
        let lines = wrap(text, 50);
        assert!(
            lines.iter().all(|line| columns(line) <= 50),
            "one is not closed: {lines:#?}"
        );
    }

    #[test]
    fn what_is_printed_is_harmless() {
        let hostile = "Team\u{1b}[2J\u{202e}\u{9b}31m\r\nSeven";
        assert_eq!(wrap(hostile, 80), ["Team\u{fffd}[2J\u{fffd}\u{fffd}31m Seven"]);
        assert_eq!(clean(hostile), "Team\u{fffd}[2J\u{fffd}\u{fffd}31m Seven");
        assert_eq!(log_line("\tat  main\u{1b}[2J \r\n"), "    at  main\u{fffd}[2J");
    }

    #[test]
    fn ages_and_sizes_are_written_as_kubectl_writes_them() {
        let at = |second: i64| Timestamp::from_second(1_793_527_200 + second).unwrap();
        assert_eq!(when(at(0), at(200)), "2026-11-01 10:00:00 UTC (3m20s ago)");
        assert_eq!(when(at(12), at(0)), "2026-11-01 10:00:12 UTC (in 12s)");
        for (seconds, expected) in [
            (0, "0s"),
            (119, "119s"),
            (120, "2m"),
            (185, "3m5s"),
            (600, "10m"),
            (7_200, "120m"),
            (3 * 3600 + 1200, "3h20m"),
            (9 * 3600 + 1200, "9h"),
            (4 * 86_400, "4d"),
            (4 * 86_400 + 7200, "4d2h"),
            (9 * 86_400 + 7200, "9d"),
        ] {
            assert_eq!(span(seconds), expected);
        }
        for (bytes, expected) in [
            (0, "0"),
            (1023, "1023"),
            (1024, "1Ki"),
            (3 << 30, "3Gi"),
            (u64::MAX, "16777215Ti"),
        ] {
            assert_eq!(size(bytes), expected);
        }
    }
}
