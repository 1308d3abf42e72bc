//! Words for people, as more than one room puts them. Pure, and knows nothing of what the words are about.

/// Somebody else's words as a sentence.
pub fn sentence(words: &str) -> String {
    let words = words.trim();
    if words.is_empty() || words.ends_with(['.', '!', '?', '…']) {
        words.to_owned()
    } else {
        format!("{words}.")
    }
}
