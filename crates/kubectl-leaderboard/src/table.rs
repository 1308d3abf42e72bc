//! Columns of text, as kubectl prints them. Pure.

use crate::text::{clean, columns, cut, cut_start, padded};

/// Columns between two cells.
const GAP: usize = 2;
/// The fewest columns to which a cell is cut.
const LEAST: usize = 8;
/// Columns that are never cut, because people copy them or search for them.
const WHOLE: [&str; 5] = ["NAMESPACE", "NAME", "SUBMISSION", "STATE", "REASON"];
/// Columns that a narrow terminal may go without: `why`, `logs` and `-o wide` show them as well.
const SPARE: [&str; 5] = ["QUEUE", "CRASHES", "NODE", "SIMULATOR", "EVALUATOR"];
/// Columns that are cut at their start: the tags of an image's versions differ at the end.
const ENDS: [&str; 2] = ["SIMULATOR", "EVALUATOR"];
/// Characters of a bar: the part that is done, and the rest.
pub(super) const DONE: char = '█';
pub(super) const OPEN: char = '░';

/// Lines of a table with its head, at most `width` columns wide if cutting its widest cells is enough. Each cell is cleaned, because
/// participants wrote many of them.
pub(super) fn table(head: &[&str], rows: &[Vec<String>], width: usize) -> Vec<String> {
    let head: Vec<String> = head.iter().map(|title| (*title).to_owned()).collect();
    let rows: Vec<Vec<String>> = rows
        .iter()
        .map(|row| row.iter().map(|cell| clean(cell)).collect())
        .collect();
    let (head, rows) = narrowed(head, rows, width);
    let widths = widths(&head, &rows, width);
    std::iter::once(&head)
        .chain(&rows)
        .map(|row| {
            let cells = head.iter().zip(row).zip(&widths);
            let cells = cells.map(|((title, cell), width)| padded(&cell_of(title, cell, *width), width + GAP));
            cells.collect::<String>().trim_end().to_owned()
        })
        .collect()
}

/// A table that is too wide, without the columns in which no row has anything, and at last without those that other commands show.
fn narrowed(mut head: Vec<String>, mut rows: Vec<Vec<String>>, width: usize) -> (Vec<String>, Vec<Vec<String>>) {
    for only_empty in [true, false] {
        for column in (0..head.len()).rev() {
            let is_empty = rows.iter().all(|row| row.get(column).is_none_or(String::is_empty));
            let is_spare = head.get(column).is_some_and(|title| SPARE.contains(&title.as_str()));
            // Cutting comes before leaving out, but for what is empty.
            let wanted = if only_empty { usize::MAX } else { width };
            if (is_empty || is_spare && !only_empty) && total(&widths(&head, &rows, wanted)) > width {
                head.remove(column);
                for row in &mut rows {
                    row.remove(column);
                }
            }
        }
    }
    (head, rows)
}

/// Columns of a table whose cells are not cut.
pub(super) fn whole_width(head: &[String], rows: &[Vec<String>]) -> usize {
    total(&widths(head, rows, usize::MAX))
}

/// Columns of a line.
fn total(widths: &[usize]) -> usize {
    widths.iter().sum::<usize>() + GAP * widths.len().saturating_sub(1)
}

fn cell_of(title: &str, cell: &str, width: usize) -> String {
    if ENDS.contains(&title) {
        cut_start(cell, width)
    } else {
        cut(cell, width)
    }
}

/// The columns of each cell: the widest ones are made narrower until all fit.
fn widths(head: &[String], rows: &[Vec<String>], width: usize) -> Vec<usize> {
    let widest = |column: usize| {
        let cells = rows.iter().filter_map(|row| row.get(column));
        cells.map(|cell| columns(cell)).max().unwrap_or(0)
    };
    let mut widths: Vec<usize> = head
        .iter()
        .enumerate()
        .map(|(column, title)| widest(column).max(columns(title)))
        .collect();
    while total(&widths) > width {
        let can_shrink = |(title, width): &(&String, &mut usize)| {
            !WHOLE.contains(&title.as_str()) && **width > columns(title).max(LEAST)
        };
        let candidates = head.iter().zip(&mut widths).filter(can_shrink);
        match candidates.max_by_key(|(_, width)| **width) {
            Some((_, widest)) => *widest -= 1,
            None => break,
        }
    }
    widths
}

/// `██████░░░░` for a part of a whole.
pub(super) fn bar(done: i32, total: i32, columns: usize) -> String {
    let (done, total) = (usize::try_from(done).unwrap_or(0), usize::try_from(total).unwrap_or(0));
    let filled = (done * columns).checked_div(total).unwrap_or(0).min(columns);
    std::iter::repeat_n(DONE, filled)
        .chain(std::iter::repeat_n(OPEN, columns - filled))
        .collect()
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
            table(&["NAME", "WHY"], &rows, 80),
            ["NAME       WHY", "a", "long-name  x\u{fffd}[2J"]
        );
    }

    #[test]
    fn a_narrow_table_leaves_out_empty_columns_and_cuts_its_widest_cells_and_never_a_name() {
        let row = [
            "submission-4711",
            "",
            "Waits for its previous controller",
            "チーム自動運転",
        ];
        let rows = [row.map(str::to_owned).to_vec()];
        let head = ["NAME", "SCORE", "WHY", "TEAM"];
        assert!(table(&head, &rows, 100)[0].contains("SCORE"));
        assert_eq!(
            table(&head, &rows, 50),
            [
                "NAME             WHY                TEAM",
                "submission-4711  Waits for its pr…  チーム自動運転",
            ]
        );
        assert_eq!(
            table(&head, &rows, 10),
            ["NAME             WHY       TEAM", "submission-4711  Waits f…  チーム…"]
        );
        let rows = [["a", "WaitingForPreviousController"].map(str::to_owned).to_vec()];
        assert!(table(&["NAME", "REASON"], &rows, 10)[1].ends_with("WaitingForPreviousController"));
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
