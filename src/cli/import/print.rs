//! Prints an import as YAML: comments, then one document for each object. Pure.

use leaderboard_api::text::one_line;
use serde::ser::{Serialize, SerializeMap, SerializeSeq, Serializer};
use serde_json::Value;

use super::plan::{Document, Import};

/// Characters of a line of comment.
const WIDTH: usize = 118;
/// Keys that come first, in this order; the others follow by name.
const ORDER: [&str; 24] = [
    "apiVersion",
    "kind",
    "metadata",
    "name",
    "codename",
    "phase",
    "evalai",
    "queue",
    "leaderboardVersion",
    "pairs",
    "routes",
    "repetitions",
    "tracks",
    "image",
    "contents",
    "gpu",
    "simulator",
    "agent",
    "storage",
    "table",
    "logGroup",
    "podIdentity",
    "network",
    "url",
];

/// The whole output. `found` is what was found of AWS and the cluster, each with its title.
pub(super) fn yaml(
    import: &Import,
    heading: &str,
    found: &[(&str, Vec<String>)],
) -> Result<String, serde_saphyr::ser::Error> {
    let mut text = comment(heading, "");
    let found = found.iter().map(|(title, lines)| (*title, lines));
    let own = [
        ("Not taken over", &import.dropped),
        ("What a person must still decide", &import.decide),
    ];
    for (title, lines) in found.chain(own) {
        if !lines.is_empty() {
            text += "#\n";
            text += &comment(&format!("{title}:"), "");
        }
        for line in lines {
            text += &item(line);
        }
    }
    text += "#\n# Values of the operator's chart for these objects:\n";
    for line in serde_saphyr::to_string(&Ordered(&import.values))?.lines() {
        text.extend(["#   ", line, "\n"]);
    }
    for document in &import.documents {
        text += "---\n";
        text += &self::document(document)?;
    }
    Ok(text)
}

/// One object with its comments.
pub(super) fn document(document: &Document) -> Result<String, serde_saphyr::ser::Error> {
    let mut text = document
        .comment
        .as_deref()
        .map(|line| comment(line, ""))
        .unwrap_or_default();
    let mut in_spec = false;
    for line in serde_saphyr::to_string(&Ordered(&document.object))?.lines() {
        in_spec |= line == "spec:";
        let key = line.strip_prefix("  ").and_then(|line| line.split_once(':'));
        if let (true, Some((key, _))) = (in_spec, key) {
            let notes = document.notes.iter().filter(|(of, _)| of == key);
            text.extend(notes.map(|(_, note)| comment(note, "  ")));
        }
        text += line;
        text.push('\n');
    }
    Ok(text)
}

fn item(text: &str) -> String {
    let lines = wrapped(text, WIDTH - 4);
    let marks = std::iter::once("# - ").chain(std::iter::repeat("#   "));
    lines
        .iter()
        .zip(marks)
        .flat_map(|(line, mark)| [mark, line, "\n"])
        .collect()
}

fn comment(text: &str, indent: &str) -> String {
    let lines = wrapped(text, WIDTH - indent.len() - 2);
    lines.iter().flat_map(|line| [indent, "# ", line, "\n"]).collect()
}

/// The words of a text in lines. A line break of the text is a blank: it would end the comment. Nothing commands a terminal.
fn wrapped(text: &str, width: usize) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for word in one_line(text, usize::MAX).split(' ').filter(|word| !word.is_empty()) {
        match lines.last_mut() {
            Some(line) if line.chars().count() + word.chars().count() < width => {
                line.push(' ');
                line.push_str(word);
            }
            _ => lines.push(word.to_owned()),
        }
    }
    lines
}

/// A value whose keys come in the order in which people write them.
struct Ordered<'a>(&'a Value);

impl Serialize for Ordered<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self.0 {
            Value::Object(fields) => {
                let rank = |key: &str| ORDER.iter().position(|first| *first == key).unwrap_or(ORDER.len());
                let mut fields: Vec<_> = fields.iter().collect();
                fields.sort_by_key(|(key, _)| rank(key));
                let mut map = serializer.serialize_map(Some(fields.len()))?;
                for (key, value) in fields {
                    map.serialize_entry(key, &Ordered(value))?;
                }
                map.end()
            }
            Value::Array(items) => {
                let mut list = serializer.serialize_seq(Some(items.len()))?;
                for item in items {
                    list.serialize_element(&Ordered(item))?;
                }
                list.end()
            }
            scalar => scalar.serialize(serializer),
        }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn printed(comment: &str, team: &str) -> String {
        let object = json!({"kind": "Submission", "spec": {"team": {"name": team}, "track": "sensors"}});
        let notes = vec![("team".to_owned(), format!("note {comment}"))];
        document(&Document {
            comment: Some(comment.to_owned()),
            object,
            notes,
        })
        .unwrap()
    }

    /// What YAML 1.1, which kubectl reads, takes for a boolean, a number or nothing.
    const WORDS: [&str; 20] = [
        "y",
        "yes",
        "No",
        "on",
        "OFF",
        "true",
        "~",
        "null",
        "1",
        "0x1F",
        "0o7",
        "017",
        "1_000",
        "1e3",
        ".inf",
        "12:30:00",
        "2026-11-20",
        "=",
        "<<",
        "",
    ];

    /// What stands for more than itself in YAML.
    const MARKS: [&str; 23] = [
        "a: b",
        "- a",
        "# a",
        "a #b",
        "---",
        "...",
        "&a",
        "*a",
        "!!binary a",
        "{a: b}",
        "[a",
        "|",
        "> a",
        "'",
        "\"",
        "%a",
        "@a",
        "`a",
        "? a",
        ": a",
        "a:",
        "a\\nb",
        "x, y",
    ];

    #[test]
    fn a_text_of_a_row_is_one_value_and_stays_a_text_for_kubectl_too() {
        for text in WORDS.into_iter().chain(MARKS) {
            let yaml = printed("plain", text);
            let read: Value = serde_saphyr::from_str(&yaml).unwrap();
            assert_eq!(
                read["spec"],
                json!({"team": {"name": text}, "track": "sensors"}),
                "{yaml}"
            );
            let value = yaml
                .lines()
                .find_map(|line| line.trim().strip_prefix("name: "))
                .unwrap();
            assert!(!WORDS.contains(&value), "{value} is no text in YAML 1.1");
        }
    }

    #[test]
    fn no_comment_ends_early_or_commands_a_terminal() {
        for hostile in [
            "a\nkind: Secret",
            "a\r\nb",
            "a\u{85}b",
            "a\u{2028}b",
            "a\u{1b}[2Jb",
            "a\u{202e}b",
            "a\u{7}b",
        ] {
            let yaml = printed(hostile, "seven");
            let read: Value = serde_saphyr::from_str(&yaml).unwrap();
            assert_eq!(read["kind"], json!("Submission"), "{yaml}");
            let is_odd = |c: char| c != '\n' && (c.is_control() || "\u{85}\u{2028}\u{2029}\u{202e}".contains(c));
            assert!(!yaml.contains(is_odd), "{yaml:?}");
        }
    }
}
