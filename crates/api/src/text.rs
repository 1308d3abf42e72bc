//! Texts for people: sentences, and texts of strangers made safe to show. Pure.
//!
//! A stranger writes the name of a team or an image, and much of what a registry, a kubelet or a container reports. Such a text
//! goes through [`one_line`] where it enters: from there on it can be shown on a terminal, in a log and on a page.

use std::error::Error;
use std::iter::successors;

/// Longest name of a team or of another thing that a stranger has named, in characters.
pub const LONGEST_NAME: usize = 256;
/// Longest message of another program that is shown, in characters.
pub const LONGEST_MESSAGE: usize = 600;

/// Ends a text of another program with a full stop.
pub fn sentence(text: &str) -> String {
    let text = text.trim();
    if text.is_empty() || text.ends_with(['.', '!', '?', '…']) {
        text.to_owned()
    } else {
        format!("{text}.")
    }
}

/// A text of a stranger as one line of at most so many characters. White space becomes one space each, and what a terminal or a
/// browser would obey becomes `U+FFFD`.
pub fn one_line(text: &str, longest: usize) -> String {
    let mut line = String::new();
    let mut length = 0;
    for word in text.split_whitespace() {
        let is_first = line.is_empty();
        for c in (!is_first).then_some(' ').into_iter().chain(word.chars()) {
            if length == longest {
                return shortened(line);
            }
            line.push(if is_harmful(c) { char::REPLACEMENT_CHARACTER } else { c });
            length += 1;
        }
    }
    line
}

/// Replaces the last character by an ellipsis.
fn shortened(mut line: String) -> String {
    line.pop();
    line.truncate(line.trim_end().len());
    line.push('…');
    line
}

/// Control characters, ESC and line breaks among them, and invisible characters: they end a line, command a terminal, or turn the
/// text around it. The joiners U+200C and U+200D are none of them: Persian, Hindi and emoji need them.
pub fn is_harmful(c: char) -> bool {
    c.is_control()
        || matches!(c,
            '\u{ad}' | '\u{61c}' | '\u{180e}'
            | '\u{200b}' | '\u{200e}'..='\u{200f}'
            | '\u{2028}'..='\u{202e}' | '\u{2060}'..='\u{206f}'
            | '\u{feff}' | '\u{fff9}'..='\u{fffb}' | '\u{e0000}'..='\u{e007f}')
}

/// An error and all that led to it.
pub fn causes<'a>(error: &'a (dyn Error + 'static)) -> impl Iterator<Item = &'a (dyn Error + 'static)> {
    successors(Some(error), |error| (*error).source())
}

/// An error and what caused it, joined by `: `. A cause whose text the error before already holds is left out.
pub fn chain(error: &(dyn Error + 'static)) -> String {
    let mut text = error.to_string();
    for cause in causes(error).skip(1) {
        let more = cause.to_string();
        if !text.contains(&more) {
            text.push_str(": ");
            text.push_str(&more);
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_text_becomes_one_sentence() {
        for (text, wanted) in [("no", "no."), (" no. ", "no."), ("cut …", "cut …"), ("", "")] {
            assert_eq!(sentence(text), wanted);
        }
    }

    #[test]
    fn a_strangers_text_is_one_harmless_line() {
        for (text, wanted) in [
            ("Team Seven", "Team Seven"),
            ("", ""),
            (" \t\n ", ""),
            ("  two \r\n\t words ", "two words"),
            ("Team\u{1b}[2J", "Team\u{fffd}[2J"),
            ("\u{1b}]0;owned\u{7}", "\u{fffd}]0;owned\u{fffd}"),
            ("C1\u{9b}31m", "C1\u{fffd}31m"),
            ("bell\u{8}\u{7f}\0", "bell\u{fffd}\u{fffd}\u{fffd}"),
            ("line\u{2028}paragraph\u{2029}end\u{85}", "line paragraph end"),
            ("\u{202e}neveS", "\u{fffd}neveS"),
            ("\u{2066}a\u{2069}\u{200f}\u{61c}", "\u{fffd}a\u{fffd}\u{fffd}\u{fffd}"),
            ("in\u{200b}vi\u{ad}si\u{feff}ble", "in\u{fffd}vi\u{fffd}si\u{fffd}ble"),
            ("tag\u{e0041}", "tag\u{fffd}"),
            ("Ünïcode 队 🚗", "Ünïcode 队 🚗"),
            ("می\u{200c}خواهم 👩\u{200d}💻", "می\u{200c}خواهم 👩\u{200d}💻"),
        ] {
            assert_eq!(one_line(text, 80), wanted, "{text:?}");
            assert!(!one_line(text, 80).chars().any(is_harmful), "{text:?}");
        }
    }

    #[test]
    fn what_is_cut_ends_with_an_ellipsis() {
        for (text, longest, wanted) in [
            ("one two", 7, "one two"),
            ("one two three", 8, "one two…"),
            ("one two three", 9, "one two…"),
            ("队队队队", 3, "队队…"),
            ("one", 0, "…"),
            ("", 0, ""),
        ] {
            assert_eq!(one_line(text, longest), wanted, "{text:?}");
        }
        let long = "x".repeat(1_000_000);
        assert_eq!(one_line(&long, LONGEST_NAME).chars().count(), LONGEST_NAME);
    }
}
