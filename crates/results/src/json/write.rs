//! The writer: four blanks of indent, everything outside printable ASCII escaped, numbers as Python writes them. Called by
//! the merge and the renderers, which hand it borrowed trees, so that no record is copied.

use std::fmt::Write as _;

use super::{Limit, Text, Value};
use crate::number::{Number, push_number};

/// The largest text that is written, in bytes.
const MAX_OUTPUT: usize = 64 << 20;
/// Blanks for each level.
const INDENT: usize = 4;
/// Enough for the levels of a usual file in one piece.
const BLANKS: &str = "                                ";

/// The order in which the keys of an object are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum KeyOrder {
    /// As they came.
    AsGiven,
    /// By code point, in every object.
    Sorted,
}

/// A tree to write: new parts around borrowed values.
pub(crate) enum Node<'a> {
    Value(&'a Value),
    Number(Number),
    Str(&'a str),
    Text(&'a Text),
    Bool(bool),
    List(Vec<Node<'a>>),
    Object(Vec<(&'a [u8], Node<'a>)>),
}

impl<'a> Node<'a> {
    /// An object of known keys.
    pub(crate) fn object<const N: usize>(entries: [(&'a str, Self); N]) -> Self {
        Self::Object(entries.into_iter().map(|(key, node)| (key.as_bytes(), node)).collect())
    }

    /// A list of texts.
    pub(crate) fn texts<T: AsRef<str> + 'a>(texts: &'a [T]) -> Self {
        Self::List(texts.iter().map(|text| Self::Str(text.as_ref())).collect())
    }

    pub(crate) fn int(n: u32) -> Self {
        Self::Number(Number::Int(i128::from(n)))
    }
}

/// The text of a tree, without a final newline.
pub(crate) fn write(node: &Node<'_>, order: KeyOrder) -> Result<String, Limit> {
    let mut writer = Writer {
        out: String::new(),
        order,
    };
    writer.node(node, 0)?;
    Ok(writer.out)
}

struct Writer {
    out: String,
    order: KeyOrder,
}

type Written = Result<(), Limit>;

impl Writer {
    fn node(&mut self, node: &Node<'_>, depth: usize) -> Written {
        match node {
            Node::Value(value) => self.value(value, depth)?,
            Node::Number(number) => self.number(*number),
            Node::Str(text) => self.text(text.as_bytes()),
            Node::Text(text) => self.text(text.as_bytes()),
            Node::Bool(b) => self.out.push_str(if *b { "true" } else { "false" }),
            Node::List(items) => self.list(items, depth, Self::node)?,
            Node::Object(entries) => {
                let entries = entries.iter().map(|(key, node)| (*key, node));
                self.object(entries, depth, Self::node)?;
            }
        }
        Ok(())
    }

    fn value(&mut self, value: &Value, depth: usize) -> Written {
        match value {
            Value::Null => self.out.push_str("null"),
            Value::Bool(b) => self.out.push_str(if *b { "true" } else { "false" }),
            Value::Int(i) => self.number(Number::Int(*i)),
            Value::BigInt(digits) => self.out.push_str(digits),
            Value::Float(f) => self.number(Number::Float(*f)),
            Value::Text(text) => self.text(text.as_bytes()),
            Value::List(items) => self.list(items, depth, Self::value)?,
            Value::Object(object) => {
                let entries = object.iter().map(|(key, value)| (key.as_bytes(), value));
                self.object(entries, depth, Self::value)?;
            }
        }
        Ok(())
    }

    fn list<T>(&mut self, items: &[T], depth: usize, each: fn(&mut Self, &T, usize) -> Written) -> Written {
        if items.is_empty() {
            self.out.push_str("[]");
            return Ok(());
        }
        self.out.push('[');
        for (i, item) in items.iter().enumerate() {
            self.line(i > 0, depth.saturating_add(1))?;
            each(self, item, depth.saturating_add(1))?;
        }
        self.line(false, depth)?;
        self.out.push(']');
        Ok(())
    }

    fn object<'t, T: 't>(
        &mut self,
        entries: impl Iterator<Item = (&'t [u8], &'t T)> + Clone,
        depth: usize,
        each: fn(&mut Self, &T, usize) -> Written,
    ) -> Written {
        if self.order == KeyOrder::AsGiven || entries.clone().is_sorted_by_key(|(key, _)| key) {
            return self.entries(entries, depth, each);
        }
        let mut sorted: Vec<_> = entries.collect();
        sorted.sort_by_key(|(key, _)| *key);
        self.entries(sorted.into_iter(), depth, each)
    }

    fn entries<'t, T: 't>(
        &mut self,
        entries: impl Iterator<Item = (&'t [u8], &'t T)>,
        depth: usize,
        each: fn(&mut Self, &T, usize) -> Written,
    ) -> Written {
        self.out.push('{');
        let mut is_empty = true;
        for (key, value) in entries {
            self.line(!is_empty, depth.saturating_add(1))?;
            is_empty = false;
            self.text(key);
            self.out.push_str(": ");
            each(self, value, depth.saturating_add(1))?;
        }
        if !is_empty {
            self.line(false, depth)?;
        }
        self.out.push('}');
        Ok(())
    }

    fn line(&mut self, comma: bool, depth: usize) -> Written {
        if self.out.len() > MAX_OUTPUT {
            return Err(Limit::Output);
        }
        self.out.push_str(if comma { ",\n" } else { "\n" });
        let mut blanks = depth.saturating_mul(INDENT);
        while blanks > 0 {
            let some = BLANKS.get(..blanks).unwrap_or(BLANKS);
            self.out.push_str(some);
            blanks = blanks.saturating_sub(some.len());
        }
        Ok(())
    }

    fn number(&mut self, number: Number) {
        match number {
            Number::Float(f) if f.is_nan() => self.out.push_str("NaN"),
            Number::Float(f) if f.is_infinite() => self.out.push_str(if f > 0.0 { "Infinity" } else { "-Infinity" }),
            Number::Float(f) => push_number(&mut self.out, f),
            // Writing to a String does not fail.
            Number::Int(i) => drop(write!(self.out, "{i}")),
        }
    }

    fn text(&mut self, bytes: &[u8]) {
        self.out.push('"');
        let mut rest = bytes;
        loop {
            let is_special = |byte: &u8| !(b' '..=b'~').contains(byte) || *byte == b'"' || *byte == b'\\';
            let plain = rest.iter().position(is_special).unwrap_or(rest.len());
            let (plain, special) = rest.split_at(plain);
            self.out.push_str(std::str::from_utf8(plain).unwrap_or_default());
            let Some((code, after)) = next_code_point(special) else {
                break;
            };
            self.escaped(code);
            rest = after;
        }
        self.out.push('"');
    }

    fn escaped(&mut self, code: u32) {
        match code {
            0x22 => self.out.push_str("\\\""),
            0x5c => self.out.push_str("\\\\"),
            0x0a => self.out.push_str("\\n"),
            0x0d => self.out.push_str("\\r"),
            0x09 => self.out.push_str("\\t"),
            0x08 => self.out.push_str("\\b"),
            0x0c => self.out.push_str("\\f"),
            0x1_0000.. => {
                let beyond = code.saturating_sub(0x1_0000);
                self.unit(0xd800 | beyond >> 10);
                self.unit(0xdc00 | beyond & 0x3ff);
            }
            _ => self.unit(code),
        }
    }

    fn unit(&mut self, unit: u32) {
        self.out.push_str("\\u");
        for shift in [12, 8, 4, 0] {
            self.out.extend(char::from_digit(unit >> shift & 0xf, 16));
        }
    }
}

/// The first code point of a well-formed [`super::Text`], and what follows it.
fn next_code_point(bytes: &[u8]) -> Option<(u32, &[u8])> {
    let (&first, mut rest) = bytes.split_first()?;
    let (mut code, more) = match first {
        0..0x80 => (u32::from(first), 0),
        0x80..0xe0 => (u32::from(first & 0x1f), 1),
        0xe0..0xf0 => (u32::from(first & 0x0f), 2),
        _ => (u32::from(first & 0x07), 3),
    };
    for _ in 0..more {
        let (&byte, after) = rest.split_first()?;
        code = code << 6 | u32::from(byte & 0x3f);
        rest = after;
    }
    Some((code, rest))
}

#[cfg(test)]
mod tests {
    use super::super::{FileLimits, read};
    use super::*;

    fn again(text: &str, order: KeyOrder) -> String {
        write(
            &Node::Value(&read(text.as_bytes(), FileLimits::LARGEST).unwrap()),
            order,
        )
        .unwrap()
    }

    #[test]
    fn the_layout_is_pythons() {
        let text =
            "{\n    \"b\": [\n        1,\n        2.0\n    ],\n    \"a\": {},\n    \"c\": [],\n    \"d\": null\n}";
        assert_eq!(again(text, KeyOrder::AsGiven), text);
        assert!(again(text, KeyOrder::Sorted).starts_with("{\n    \"a\": {},\n    \"b\""));
    }

    #[test]
    fn texts_are_escaped_to_ascii() {
        let given = "\"caf\u{e9} \u{8f66} \u{1f697} \\\" \\\\ / \\n\\t\\u0001\u{7f}\"";
        let written = r#""caf\u00e9 \u8f66 \ud83d\ude97 \" \\ / \n\t\u0001\u007f""#;
        assert_eq!(again(given, KeyOrder::AsGiven), written);
    }

    #[test]
    fn odd_values_come_out_as_they_went_in() {
        let text =
            "[\n    NaN,\n    Infinity,\n    -Infinity,\n    1e-07,\n    \"\\ud800\",\n    \"\\udc00\\ud800\"\n]";
        assert_eq!(again(text, KeyOrder::AsGiven), text);
        let big = format!("-{}", "9".repeat(80));
        assert_eq!(again(&big, KeyOrder::AsGiven), big);
    }

    #[test]
    fn keys_are_sorted_by_code_point() {
        assert_eq!(
            again("{\"\u{1f697}\":1,\"\u{ff5e}\":2,\"z\":3}", KeyOrder::Sorted),
            "{\n    \"z\": 3,\n    \"\\uff5e\": 2,\n    \"\\ud83d\\ude97\": 1\n}"
        );
    }
}
