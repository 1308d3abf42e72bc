//! A text that takes up a place in a budget of memory for as long as anybody holds it. Made by the controller's archive, sent by
//! EvalAI's client; neither copies it.

use std::any::Any;
use std::fmt;
use std::hash::{Hash, Hasher};
use std::ops::Deref;
use std::sync::Arc;

/// What a text takes up; dropped, it is free again.
pub type HeldMemory = Arc<dyn Any + Send + Sync>;

/// A shared text, with its place if it has one. Compared and shown by its content.
#[derive(Clone, Default)]
pub struct HeldText {
    text: Arc<str>,
    place: Option<HeldMemory>,
}

impl HeldText {
    /// A text that holds its place.
    pub fn new(text: String, place: HeldMemory) -> Self {
        Self {
            text: text.into(),
            place: Some(place),
        }
    }
}

impl From<&str> for HeldText {
    fn from(text: &str) -> Self {
        Self {
            text: text.into(),
            place: None,
        }
    }
}

impl Deref for HeldText {
    type Target = str;

    fn deref(&self) -> &str {
        &self.text
    }
}

impl PartialEq for HeldText {
    fn eq(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.text, &other.text) || self.text == other.text
    }
}

impl Eq for HeldText {}

impl Hash for HeldText {
    fn hash<H: Hasher>(&self, state: &mut H) {
        self.text.hash(state);
    }
}

impl fmt::Debug for HeldText {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let held = if self.place.is_some() { ", held" } else { "" };
        write!(f, "{} bytes{held}", self.text.len())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_place_is_free_again_with_the_last_copy_of_its_text() {
        let place: Arc<()> = Arc::new(());
        let one = HeldText::new("text".to_owned(), Arc::clone(&place) as HeldMemory);
        let other = one.clone();
        assert_eq!((&one, one.len()), (&HeldText::from("text"), 4));
        assert_eq!(format!("{one:?}"), "4 bytes, held");
        drop(one);
        assert_eq!(Arc::strong_count(&place), 2);
        drop(other);
        assert_eq!(Arc::strong_count(&place), 1);
    }
}
