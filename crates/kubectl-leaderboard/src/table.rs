//! Columns of text, as kubectl prints them. Pure.

use crate::text::clean;

/// Lines of a table with its head. Each cell is cleaned: many were written by strangers.
pub(super) fn table(head: &[&str], rows: &[Vec<String>]) -> Vec<String> {
    let head: Vec<String> = head.iter().map(|title| (*title).to_owned()).collect();
    let rows: Vec<Vec<String>> = rows
        .iter()
        .map(|row| row.iter().map(|cell| clean(cell)).collect())
        .collect();
    let widths: Vec<usize> = (0..head.len())
        .map(|column| {
            let cells = std::iter::once(&head).chain(&rows);
            let widths = cells.filter_map(|row| row.get(column)).map(|cell| cell.chars().count());
            widths.max().unwrap_or(0) + 2
        })
        .collect();
    std::iter::once(&head)
        .chain(&rows)
        .map(|row| {
            let cells = row.iter().zip(&widths).map(|(cell, width)| format!("{cell:<width$}"));
            cells.collect::<String>().trim_end().to_owned()
        })
        .collect()
}

/// `██████░░░░` for a part of a whole.
pub(super) fn bar(done: i32, total: i32, columns: usize) -> String {
    let (done, total) = (usize::try_from(done).unwrap_or(0), usize::try_from(total).unwrap_or(0));
    let filled = (done * columns).checked_div(total).unwrap_or(0).min(columns);
    format!("{}{}", "█".repeat(filled), "░".repeat(columns - filled))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_stand_below_their_heads_and_no_line_ends_with_white_space() {
        let rows = [
            vec!["a".to_owned(), String::new()],
            vec!["long-name".to_owned(), "x\u{1b}[2J".to_owned()],
        ];
        assert_eq!(
            table(&["NAME", "WHY"], &rows),
            ["NAME       WHY", "a", "long-name  x\u{fffd}[2J"]
        );
    }

    #[test]
    fn a_bar_is_full_only_at_the_end() {
        for (done, total, expected) in [
            (0, 20, "░░░░░░░░░░"),
            (12, 20, "██████░░░░"),
            (19, 20, "█████████░"),
            (20, 20, "██████████"),
            (0, 0, "░░░░░░░░░░"),
            (7, 5, "██████████"),
            (-1, 5, "░░░░░░░░░░"),
        ] {
            assert_eq!(bar(done, total, 10), expected, "{done}/{total}");
        }
    }
}
