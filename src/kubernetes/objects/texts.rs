//! Texts that many objects have in common, such as the names of namespaces, nodes and containers.

use std::collections::HashSet;

pub use leaderboard_api::SharedText as Text;
use serde::{Deserialize, Deserializer};

/// Texts that are kept at least, whether or not an object still has them.
const KEPT: usize = 256;
/// Bytes that are kept of a free text: more than any verdict of ours has, and than anybody is shown.
const LONGEST_TEXT: usize = 1024;

/// The texts of one cache, each once.
#[derive(Debug, Default)]
pub struct Texts {
    known: HashSet<Text>,
    /// More than this and than `KEPT`, and those that no object has any more are dropped.
    limit: usize,
}

impl Texts {
    /// Replaces a text by the one that is known already.
    pub fn share(&mut self, text: &mut Text) {
        if let Some(known) = self.known.get(text) {
            *text = known.clone();
            return;
        }
        if self.known.len() >= self.limit.max(KEPT) {
            self.known.retain(Text::has_copies);
            self.limit = self.known.len().saturating_mul(2);
        }
        self.known.insert(text.clone());
    }
}

/// Reads a text that may be long, as far as it is of use.
pub(super) fn cut<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<Box<str>>, D::Error> {
    let text = Option::<String>::deserialize(deserializer)?;
    Ok(text.map(|text| text[..text.floor_char_boundary(LONGEST_TEXT)].into()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_text_is_stored_once_while_an_object_has_it() {
        let mut texts = Texts::default();
        let (mut one, mut two) = (Text::from("node-1"), Text::from("node-1"));
        texts.share(&mut one);
        texts.share(&mut two);
        assert!(one.is_copy_of(&two));
        for number in 0..10_000 {
            texts.share(&mut Text::from(format!("node-{number}").as_str()));
        }
        assert!(texts.known.len() <= KEPT, "{}", texts.known.len());
        let mut again = Text::from("node-1");
        texts.share(&mut again);
        assert!(one.is_copy_of(&again), "still in use");
    }

    #[test]
    fn a_long_text_is_cut_between_two_characters() {
        let read = |text: &str| cut(&mut serde_json::Deserializer::from_str(text)).unwrap();
        let long = format!("\"{}ä\"", "x".repeat(LONGEST_TEXT - 1));
        assert_eq!(read(&long).unwrap().len(), LONGEST_TEXT - 1);
        assert_eq!(read("\"ä\\n\"").as_deref(), Some("ä\n"));
        assert_eq!(read("null"), None);
    }
}
