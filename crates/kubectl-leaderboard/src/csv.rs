//! Lines of comma-separated values (RFC 4180) that no spreadsheet takes for a formula. Pure.
//!
//! A cell may be a stranger's text, and a spreadsheet runs what begins like a formula. Such a cell begins with an apostrophe.

use crate::text::clean;

/// Characters with which a formula begins in a spreadsheet; the wide forms count in some languages.
const FORMULA: [char; 8] = ['=', '+', '-', '@', '＝', '＋', '－', '＠'];
/// Characters that end a cell in the spreadsheets of some countries.
const OTHER_SEPARATORS: [char; 2] = [';', '|'];

/// One line.
pub(super) fn line<'a>(cells: impl IntoIterator<Item = &'a str>) -> String {
    let cells: Vec<String> = cells.into_iter().map(cell).collect();
    cells.join(",")
}

fn cell(text: &str) -> String {
    let text = harmless(&clean(text));
    if text.contains([',', '"', ';', '|', '\'']) {
        format!("\"{}\"", text.replace('"', "\"\""))
    } else {
        text
    }
}

/// A text of which no part is a formula. A number is none, whatever its sign.
fn harmless(text: &str) -> String {
    if text.parse().is_ok_and(f64::is_finite) {
        return text.to_owned();
    }
    let mut harmless = String::with_capacity(text.len() + 1);
    let mut begins = true;
    for c in text.chars() {
        if begins && FORMULA.contains(&c) {
            harmless.push('\'');
        }
        // A quote that an other spreadsheet sees inside a cell may begin another one.
        begins = OTHER_SEPARATORS.contains(&c) || begins && (c == ' ' || c == '"');
        harmless.push(c);
    }
    harmless
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_separates_cells_or_lines_is_quoted() {
        for (cells, expected) in [
            (&["a", "", "1.50"][..], "a,,1.50"),
            (&["a,b", "c"], r#""a,b",c"#),
            (&[r#"the "best""#], r#""the ""best""""#),
            (&["two\r\nlines", "tab\there"], "two lines,tab here"),
            (&["チーム 自動運転"], "チーム 自動運転"),
            (&["\u{1b}[2J"], "\u{fffd}[2J"),
        ] {
            assert_eq!(line(cells.iter().copied()), expected);
        }
    }

    #[test]
    fn no_cell_is_a_formula_in_any_spreadsheet() {
        for (text, expected) in [
            ("=cmd()", r#""'=cmd()""#),
            ("+1+cmd|' /C calc'!A0", r#""'+1+cmd|' /C calc'!A0""#),
            ("-team", r#""'-team""#),
            ("@SUM(A1)", r#""'@SUM(A1)""#),
            ("  =cmd()", r#""'=cmd()""#),
            ("\t=cmd()", r#""'=cmd()""#),
            ("\"=cmd()", r#""""'=cmd()""#),
            ("a;=cmd()", r#""a;'=cmd()""#),
            ("a; \"=cmd()", r#""a; ""'=cmd()""#),
            ("a|@cmd", r#""a|'@cmd""#),
            ("＝cmd()", r#""'＝cmd()""#),
            ("a=b-c", "a=b-c"),
            ("-1.50", "-1.50"),
            ("+3", "+3"),
            ("-inf", r#""'-inf""#),
        ] {
            assert_eq!(line([text]), expected, "{text}");
        }
    }
}
