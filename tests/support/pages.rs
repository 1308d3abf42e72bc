//! The lines of README.md and docs/ that start a program, for tests that give them to the program's own parser.
//!
//! `local/labkit/docruns.py` types all lines into a shell; it cannot read the words of these programs.

use std::path::{Path, PathBuf};

/// A line that starts the program, or the name of one of its commands in prose, which may leave words out.
pub struct Line {
    pub place: String,
    pub is_prose: bool,
    /// Without those of the program itself.
    pub words: Vec<String>,
}

/// Every line of the repository's pages that starts with the words of a program.
pub fn lines(root: &Path, program: &str) -> Vec<Line> {
    let mut files = vec![root.join("README.md")];
    add_pages(&root.join("docs"), &mut files);
    files.sort();
    files.iter().flat_map(|file| of_page(root, file, program)).collect()
}

fn add_pages(folder: &Path, files: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            add_pages(&path, files);
        } else if path.extension().is_some_and(|extension| extension == "md") {
            files.push(path);
        }
    }
}

fn of_page(root: &Path, file: &Path, program: &str) -> Vec<Line> {
    let text = std::fs::read_to_string(file).unwrap();
    let place = file.strip_prefix(root).unwrap().display().to_string();
    let mut found = Vec::new();
    // Between fences every other part is code.
    for (number, part) in text.split("```").enumerate() {
        let (is_prose, lines) = if number % 2 == 0 {
            let spans: Vec<_> = part.split('`').skip(1).step_by(2).map(ToOwned::to_owned).collect();
            (true, spans)
        } else if part.starts_with("sh\n") {
            (
                false,
                part.replace("\\\n", " ").lines().map(ToOwned::to_owned).collect(),
            )
        } else {
            continue;
        };
        for line in lines {
            let words = words(&line);
            if let Some(rest) = words.join(" ").strip_prefix(program)
                && (rest.is_empty() || rest.starts_with(' '))
            {
                let words = words.into_iter().skip(program.split(' ').count()).collect();
                found.push(Line {
                    place: place.clone(),
                    is_prose,
                    words,
                });
            }
        }
    }
    found
}

/// A line's words as a shell makes them, up to where another program begins.
fn words(line: &str) -> Vec<String> {
    let (mut words, mut word, mut quote) = (Vec::new(), None::<String>, None);
    for letter in line.chars() {
        match (quote, letter) {
            (Some(open), _) if open == letter => quote = None,
            (None, '\'' | '"') => {
                quote = Some(letter);
                word.get_or_insert_default();
            }
            (None, '|' | '>' | ';' | '#' | '&') if word.is_none() => break,
            (None, _) if letter.is_whitespace() => words.extend(word.take()),
            _ => word.get_or_insert_default().push(letter),
        }
    }
    words.extend(word);
    words
}
