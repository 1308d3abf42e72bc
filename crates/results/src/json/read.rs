//! The reader: bytes to a value, within limits that hold whatever the bytes are. One recursive descent, depth counted.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::limits::{FileLimits, Limit};
use super::{Object, Text, Value};

const MAX_DEPTH: usize = 64;
const MAX_TEXT: usize = 1 << 20;
const MAX_NUMBER: usize = 4096;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ReadError {
    /// Empty, half-written or something else altogether.
    NotJson,
    NotUtf8,
    Limit(Limit),
}

/// Reads one value. A file that ends inside a multi-byte character is half-written, so not JSON.
pub(crate) fn read(bytes: &[u8], limits: FileLimits) -> Result<Value, ReadError> {
    if bytes.len() > limits.bytes {
        return Err(ReadError::Limit(Limit::Size(limits.bytes)));
    }
    if let Err(error) = std::str::from_utf8(bytes) {
        return Err(if error.error_len().is_none() {
            ReadError::NotJson
        } else {
            ReadError::NotUtf8
        });
    }
    let shared = bytes.into();
    let mut reader = Reader {
        bytes: &shared,
        at: 0,
        values: limits.values,
        limits,
        items: Vec::new(),
        entries: Vec::new(),
    };
    reader.space();
    let value = reader.value(0)?;
    reader.space();
    if reader.at == bytes.len() {
        Ok(value)
    } else {
        Err(ReadError::NotJson)
    }
}

struct Reader<'a> {
    /// All texts share them.
    bytes: &'a Arc<[u8]>,
    at: usize,
    /// How many more there may be.
    values: usize,
    limits: FileLimits,
    /// Items of the lists and objects around this place so far: each list is allocated once, when its length is known.
    items: Vec<Value>,
    entries: Vec<(Text, Value)>,
}

type Read<T> = Result<T, ReadError>;

impl<'a> Reader<'a> {
    fn peek(&self) -> Option<u8> {
        self.bytes.get(self.at).copied()
    }

    /// Steps over bytes that are there, so never beyond the end.
    fn step(&mut self, bytes: usize) {
        self.at = self.at.saturating_add(bytes);
    }

    fn next(&mut self) -> Read<u8> {
        let byte = self.peek().ok_or(ReadError::NotJson)?;
        self.step(1);
        Ok(byte)
    }

    /// Steps over the token if it is next.
    fn take(&mut self, token: &[u8]) -> bool {
        let here = self.bytes.get(self.at..).is_some_and(|rest| rest.starts_with(token));
        if here {
            self.step(token.len());
        }
        here
    }

    fn space(&mut self) {
        while matches!(self.peek(), Some(b' ' | b'\t' | b'\n' | b'\r')) {
            self.step(1);
        }
    }

    fn value(&mut self, depth: usize) -> Read<Value> {
        let too_many = ReadError::Limit(Limit::Values(self.limits.values));
        self.values = self.values.checked_sub(1).ok_or(too_many)?;
        if depth > MAX_DEPTH {
            return Err(ReadError::Limit(Limit::Depth));
        }
        match self.peek().ok_or(ReadError::NotJson)? {
            b'{' => self.object(depth),
            b'[' => self.list(depth),
            b'"' => {
                self.step(1);
                self.text().map(Value::Text)
            }
            b'-' | b'0'..=b'9' => self.number(),
            _ => self.word(),
        }
    }

    fn word(&mut self) -> Read<Value> {
        for (token, value) in [
            ("null", Value::Null),
            ("true", Value::Bool(true)),
            ("false", Value::Bool(false)),
            ("NaN", Value::Float(f64::NAN)),
            ("Infinity", Value::Float(f64::INFINITY)),
        ] {
            if self.take(token.as_bytes()) {
                return Ok(value);
            }
        }
        Err(ReadError::NotJson)
    }

    fn list(&mut self, depth: usize) -> Read<Value> {
        self.step(1);
        let first = self.items.len();
        self.space();
        if self.take(b"]") {
            return Ok(Value::List(Vec::new()));
        }
        loop {
            self.space();
            let item = self.value(depth.saturating_add(1))?;
            self.items.push(item);
            self.space();
            match self.next()? {
                b',' => {}
                b']' => return Ok(Value::List(self.items.drain(first..).collect())),
                _ => return Err(ReadError::NotJson),
            }
        }
    }

    fn object(&mut self, depth: usize) -> Read<Value> {
        self.step(1);
        let first = self.entries.len();
        self.space();
        if self.take(b"}") {
            return Ok(Value::Object(Object::default()));
        }
        loop {
            self.space();
            if !self.take(b"\"") {
                return Err(ReadError::NotJson);
            }
            let key = self.text()?;
            self.space();
            if !self.take(b":") {
                return Err(ReadError::NotJson);
            }
            self.space();
            let value = self.value(depth.saturating_add(1))?;
            self.entries.push((key, value));
            self.space();
            match self.next()? {
                b',' => {}
                b'}' => {
                    let entries = self.entries.drain(first..).collect();
                    return Ok(Value::Object(Object(without_repeats(entries))));
                }
                _ => return Err(ReadError::NotJson),
            }
        }
    }

    /// The rest of a text whose opening quote was read. Most have no escapes, and stay where they are.
    fn text(&mut self) -> Read<Text> {
        let start = self.at;
        let plain = self.plain()?;
        let end = self.at;
        if self.take(b"\"") {
            return Text::part(self.bytes, start..end).ok_or(ReadError::Limit(Limit::Text));
        }
        let mut text = plain.to_vec();
        loop {
            match self.next()? {
                b'"' => {
                    let length = text.len();
                    return Text::part(&text.into(), 0..length).ok_or(ReadError::Limit(Limit::Text));
                }
                b'\\' => self.escape(&mut text)?,
                _ => return Err(ReadError::NotJson),
            }
            text.extend_from_slice(self.plain()?);
            if text.len() > MAX_TEXT {
                return Err(ReadError::Limit(Limit::Text));
            }
        }
    }

    /// Characters up to a quote, an escape or a control character.
    fn plain(&mut self) -> Read<&'a [u8]> {
        let rest = self.bytes.get(self.at..).unwrap_or_default();
        let is_end = |byte: &u8| *byte < 0x20 || *byte == b'"' || *byte == b'\\';
        let length = rest.iter().position(is_end).unwrap_or(rest.len());
        if length > MAX_TEXT {
            return Err(ReadError::Limit(Limit::Text));
        }
        self.step(length);
        Ok(rest.get(..length).unwrap_or_default())
    }

    fn escape(&mut self, text: &mut Vec<u8>) -> Read<()> {
        text.push(match self.next()? {
            byte @ (b'"' | b'\\' | b'/') => byte,
            b'b' => 0x08,
            b'f' => 0x0c,
            b'n' => b'\n',
            b'r' => b'\r',
            b't' => b'\t',
            b'u' => {
                let code = self.code_point()?;
                push_code_point(text, code);
                return Ok(());
            }
            _ => return Err(ReadError::NotJson),
        });
        Ok(())
    }

    /// The code point of `\uXXXX`, with a following low half when this is a high one.
    fn code_point(&mut self) -> Read<u32> {
        let unit = self.hex4()?;
        if !(0xd800..0xdc00).contains(&unit) {
            return Ok(unit);
        }
        let after = self.at;
        if self.take(b"\\u")
            && let Ok(low @ 0xdc00..=0xdfff) = self.hex4()
        {
            return Ok(u32::saturating_add(0x1_0000, (unit & 0x3ff) << 10 | low & 0x3ff));
        }
        self.at = after;
        Ok(unit)
    }

    fn hex4(&mut self) -> Read<u32> {
        let mut code = 0;
        for _ in 0..4 {
            let digit = char::from(self.next()?).to_digit(16).ok_or(ReadError::NotJson)?;
            code = code << 4 | digit;
        }
        Ok(code)
    }

    fn number(&mut self) -> Read<Value> {
        let from = self.at;
        let negative = self.take(b"-");
        if negative && self.take(b"Infinity") {
            return Ok(Value::Float(f64::NEG_INFINITY));
        }
        if !self.take(b"0") {
            self.digits()?;
        }
        let mut is_float = self.take(b".");
        if is_float {
            self.digits()?;
        }
        if self.take(b"e") || self.take(b"E") {
            is_float = true;
            let _sign = self.take(b"+") || self.take(b"-");
            self.digits()?;
        }
        if self.at.saturating_sub(from) > MAX_NUMBER {
            return Err(ReadError::Limit(Limit::Number));
        }
        let text = self
            .bytes
            .get(from..self.at)
            .and_then(|b| std::str::from_utf8(b).ok())
            .unwrap_or_default();
        if is_float {
            return text.parse().map(Value::Float).map_err(|_| ReadError::NotJson);
        }
        Ok(text.parse().map_or_else(|_| Value::BigInt(text.into()), Value::Int))
    }

    /// One digit or more.
    fn digits(&mut self) -> Read<()> {
        let from = self.at;
        while self.peek().is_some_and(|byte| byte.is_ascii_digit()) {
            self.step(1);
        }
        if self.at == from {
            Err(ReadError::NotJson)
        } else {
            Ok(())
        }
    }
}

fn push_code_point(text: &mut Vec<u8>, code: u32) {
    if let Some(c) = char::from_u32(code) {
        text.extend_from_slice(c.encode_utf8(&mut [0; 4]).as_bytes());
        return;
    }
    let [.., high, low] = code.to_be_bytes();
    text.extend_from_slice(&[0xed, 0x80 | (high & 0x0f) << 2 | low >> 6, 0x80 | low & 0x3f]);
}

/// Up to so many keys, each is compared with each.
const FEW_KEYS: usize = 24;

fn has_repeats(entries: &[(Text, Value)]) -> bool {
    let mut rest = entries;
    while let Some(((key, _), others)) = rest.split_first() {
        if others.iter().any(|(other, _)| other == key) {
            return true;
        }
        rest = others;
    }
    false
}

/// A repeated key keeps its first place and gets its last value. In a tree of keys, since these are a stranger's choice.
fn without_repeats(entries: Vec<(Text, Value)>) -> Vec<(Text, Value)> {
    if entries.len() <= FEW_KEYS && !has_repeats(&entries) {
        return entries;
    }
    let mut places = BTreeMap::new();
    let mut kept: Vec<(Text, Value)> = Vec::with_capacity(entries.len());
    for (key, value) in entries {
        let place = *places.entry(key.clone()).or_insert(kept.len());
        match kept.get_mut(place) {
            Some((_, first)) => *first = value,
            None => kept.push((key, value)),
        }
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(bytes: &[u8]) -> Result<Value, ReadError> {
        super::read(bytes, FileLimits::LARGEST)
    }

    fn ok(text: &str) -> Value {
        read(text.as_bytes()).unwrap()
    }

    #[test]
    fn numbers_keep_their_kind() {
        assert_eq!(ok("0"), Value::Int(0));
        assert_eq!(ok("-0"), Value::Int(0));
        assert_eq!(ok("-0.0"), Value::Float(-0.0));
        assert_eq!(ok("1E2"), Value::Float(100.0));
        assert_eq!(ok("1e999"), Value::Float(f64::INFINITY));
        assert_eq!(ok("-Infinity"), Value::Float(f64::NEG_INFINITY));
        assert!(matches!(ok("NaN"), Value::Float(f) if f.is_nan()));
        let big = "1".repeat(60);
        assert_eq!(ok(&big), Value::BigInt(big.clone().into()));
    }

    #[test]
    fn what_python_does_not_read_is_not_json() {
        for text in [
            "",
            " ",
            "{",
            "[1",
            "[1,]",
            "{\"a\":1,}",
            "{a:1}",
            "01",
            "1.",
            ".5",
            "+1",
            "1e",
            "-",
            "--1",
            "-NaN",
            "nan",
            "\"\u{1}\"",
            "\"\\x\"",
            "\"\\u12\"",
            "\"a",
            "1 2",
            "\u{feff}{}",
            "tru",
            "[1 2]",
            "{\"a\" 1}",
            "'a'",
        ] {
            assert_eq!(read(text.as_bytes()), Err(ReadError::NotJson), "{text:?}");
        }
    }

    #[test]
    fn escapes_and_surrogates() {
        assert_eq!(ok(r#""\u00e9\ud83d\ude97\/\"\b""#).as_str(), Some("é🚗/\"\u{8}"));
        for lone in [r#""\ud83d""#, r#""\ude97\ud83d""#, r#""\ud83dx""#, r#""\ud83d\u0041""#] {
            assert!(matches!(ok(lone), Value::Text(_)), "{lone}");
            assert_eq!(ok(lone).as_str(), None, "{lone}");
        }
    }

    #[test]
    fn the_last_of_repeated_keys_wins_in_the_first_place() {
        assert_eq!(ok(r#"{"a":1,"b":2,"a":3,"c":4,"a":5}"#), ok(r#"{"a":5,"b":2,"c":4}"#));
        assert_ne!(ok(r#"{"a":1,"b":2}"#), ok(r#"{"b":2,"a":1}"#));
        let many = |last: &str| (0..40).map(|i| format!("\"k{i}\":{i}")).collect::<Vec<_>>().join(",") + last;
        let [given, wanted] = [format!("{{{}}}", many(",\"k0\":9")), format!("{{{}}}", many(""))];
        assert_eq!(ok(&given), ok(&wanted.replacen(":0", ":9", 1)));
    }

    #[test]
    fn limits_hold() {
        let nested = |n| format!("{}{}", "[".repeat(n), "]".repeat(n));
        assert!(read(nested(64).as_bytes()).is_ok());
        assert_eq!(read(nested(66).as_bytes()), Err(ReadError::Limit(Limit::Depth)));
        assert_eq!(
            read("[".repeat(1_000_000).as_bytes()),
            Err(ReadError::Limit(Limit::Depth))
        );
        let long = format!("\"{}\"", "x".repeat(MAX_TEXT + 1));
        assert_eq!(read(long.as_bytes()), Err(ReadError::Limit(Limit::Text)));
        let many = format!("[{}1]", "1,".repeat(FileLimits::LARGEST.values));
        assert_eq!(read(many.as_bytes()), Err(ReadError::Limit(Limit::Values(500_000))));
        assert_eq!(read("1".repeat(5000).as_bytes()), Err(ReadError::Limit(Limit::Number)));
        let large = vec![b' '; FileLimits::LARGEST.bytes + 1];
        assert_eq!(read(&large), Err(ReadError::Limit(Limit::Size(64 << 20))));
        let few = FileLimits { bytes: 5, values: 3 };
        assert!(super::read(b"[1,2]", few).is_ok());
        assert_eq!(super::read(b"[1,22]", few), Err(ReadError::Limit(Limit::Size(5))));
        let few = FileLimits { bytes: 9, ..few };
        assert_eq!(super::read(b"[1,2,3]", few), Err(ReadError::Limit(Limit::Values(3))));
    }

    #[test]
    fn a_cut_character_is_half_written_and_a_wrong_one_is_refused() {
        assert_eq!(read(&[b'"', 0xc3]), Err(ReadError::NotJson));
        assert_eq!(read(&[b'"', 0xff, b'"']), Err(ReadError::NotUtf8));
    }
}
