//! The few pieces of Python that show through EvalAI's answers and files: `json.loads` with its NaN, `repr`, truth.
//! Used by `update` and `views`; pure.

use std::fmt::{self, Write as _};

use serde::de::{Deserialize, DeserializeOwned, Deserializer, IgnoredAny, MapAccess, Visitor};
use serde_json::Value;

/// Stands for a number that JSON cannot express (NaN, an infinity), which Python's `json.loads` reads and the server
/// refuses only later. The control characters keep it apart from any text a client can mean.
const NOT_FINITE: &str = "\u{1}\u{2}not finite\u{2}\u{1}";

/// Is it the stand-in for NaN or an infinity?
pub fn is_not_finite(value: &Value) -> bool {
    value.as_str() == Some(NOT_FINITE)
}

/// `json.loads`: JSON, and NaN, Infinity, -Infinity and numbers too large for a float besides. The error is Python's
/// text.
pub fn loads<T: DeserializeOwned>(text: &str) -> Result<T, String> {
    if text.trim().is_empty() {
        return Err("Expecting value: line 1 column 1 (char 0)".to_owned());
    }
    serde_json::from_str(&finite(text)).map_err(|error| json_error(text, &error))
}

/// Python's text for JSON that can't be read. The place is right, the reason one of two.
pub fn json_error(text: &str, error: &serde_json::Error) -> String {
    let (line, column) = (error.line().max(1), error.column().max(1));
    let char = offset(text, line, column);
    let extra = error.to_string().starts_with("trailing characters");
    let what = if extra { "Extra data" } else { "Expecting value" };
    format!("{what}: line {line} column {column} (char {char})")
}

/// Python's message when it gets something else than a string.
pub fn loads_type_error(value: &Value) -> String {
    format!(
        "the JSON object must be str, bytes or bytearray, not {}",
        type_name(value)
    )
}

fn offset(text: &str, line: usize, column: usize) -> usize {
    text.split_inclusive('\n')
        .take(line - 1)
        .map(|line| line.chars().count())
        .sum::<usize>()
        + column
        - 1
}

/// The text with every number that is not finite replaced by a string that stands for it.
fn finite(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    let mut rest = text;
    while let Some(first) = rest.chars().next() {
        let length = match first {
            '"' => string_length(rest),
            'N' | 'I' | '-' | '0'..='9' => word_length(rest),
            other => other.len_utf8(),
        };
        let (word, tail) = rest.split_at(length);
        let literal = matches!(word, "NaN" | "Infinity" | "-Infinity");
        let number = word
            .trim_start_matches('-')
            .starts_with(|char: char| char.is_ascii_digit());
        if literal || number && word.parse::<f64>().is_ok_and(f64::is_infinite) {
            out.push_str(&Value::from(NOT_FINITE).to_string());
        } else {
            out.push_str(word);
        }
        rest = tail;
    }
    out
}

fn string_length(text: &str) -> usize {
    let mut escaped = false;
    for (index, char) in text.char_indices().skip(1) {
        match char {
            _ if escaped => escaped = false,
            '\\' => escaped = true,
            '"' => return index + 1,
            _ => {}
        }
    }
    text.len()
}

fn word_length(text: &str) -> usize {
    text.find(|char: char| !(char.is_ascii_alphanumeric() || matches!(char, '+' | '-' | '.')))
        .unwrap_or(text.len())
}

/// Python's name of the value's type.
pub fn type_name(value: &Value) -> &'static str {
    match value {
        Value::Null => "NoneType",
        Value::Bool(_) => "bool",
        Value::Number(number) if number.is_f64() => "float",
        Value::Number(_) => "int",
        Value::String(_) if is_not_finite(value) => "float",
        Value::String(_) => "str",
        Value::Array(_) => "list",
        Value::Object(_) => "dict",
    }
}

/// `bool(value)`.
pub fn truthy(value: &Value) -> bool {
    match value {
        Value::Null => false,
        Value::Bool(value) => *value,
        Value::Number(number) => number.as_f64() != Some(0.0),
        Value::String(text) => !text.is_empty(),
        Value::Array(items) => !items.is_empty(),
        Value::Object(fields) => !fields.is_empty(),
    }
}

/// `str(value)`: a string as it is, everything else as `repr`.
pub fn str(value: &Value) -> String {
    match value {
        Value::String(text) => text.clone(),
        other => repr(other),
    }
}

/// `repr(value)`.
pub fn repr(value: &Value) -> String {
    match value {
        Value::Null => "None".to_owned(),
        Value::Bool(true) => "True".to_owned(),
        Value::Bool(false) => "False".to_owned(),
        Value::Number(number) => match number.as_f64() {
            Some(float) if number.is_f64() => repr_float(float),
            _ => number.to_string(),
        },
        Value::String(text) => repr_str(text),
        Value::Array(items) => format!("[{}]", items.iter().map(repr).collect::<Vec<_>>().join(", ")),
        Value::Object(fields) => repr_dict(fields.iter().map(|(key, value)| (key.as_str(), value))),
    }
}

/// `repr` of a dict, in the order of its items.
pub fn repr_dict<'a>(items: impl Iterator<Item = (&'a str, &'a Value)>) -> String {
    let items: Vec<_> = items
        .map(|(key, value)| format!("{}: {}", repr_str(key), repr(value)))
        .collect();
    format!("{{{}}}", items.join(", "))
}

/// An object's keys in the order they were sent: Python's dicts keep it, maps here do not.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct Keys(pub Vec<String>);

impl<'de> Deserialize<'de> for Keys {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Reader;
        impl<'de> Visitor<'de> for Reader {
            type Value = Keys;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("an object")
            }

            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Keys, A::Error> {
                let mut keys = Vec::new();
                while let Some((key, _)) = map.next_entry::<String, IgnoredAny>()? {
                    if !keys.contains(&key) {
                        keys.push(key);
                    }
                }
                Ok(Keys(keys))
            }
        }
        deserializer.deserialize_map(Reader)
    }
}

/// `repr` of a list of strings.
pub fn repr_list(items: &[&str]) -> String {
    format!(
        "[{}]",
        items.iter().map(|item| repr_str(item)).collect::<Vec<_>>().join(", ")
    )
}

/// `repr` of a list of pairs of a metric's name and its value's type.
pub fn repr_types(items: &[(&str, &Value)]) -> String {
    let pairs: Vec<_> = items
        .iter()
        .map(|(name, value)| format!("({}, <class '{}'>)", repr_str(name), type_name(value)))
        .collect();
    format!("[{}]", pairs.join(", "))
}

fn repr_str(text: &str) -> String {
    let quote = if text.contains('\'') && !text.contains('"') {
        '"'
    } else {
        '\''
    };
    let mut out = String::from(quote);
    for char in text.chars() {
        match char {
            '\\' => out.push_str("\\\\"),
            '\n' => out.push_str("\\n"),
            '\r' => out.push_str("\\r"),
            '\t' => out.push_str("\\t"),
            _ if char == quote => {
                out.push('\\');
                out.push(char);
            }
            _ if char.is_control() => {
                let _ = write!(out, "\\x{:02x}", u32::from(char));
            }
            _ => out.push(char),
        }
    }
    out.push(quote);
    out
}

fn repr_float(float: f64) -> String {
    let size = float.abs();
    if size != 0.0 && !(1e-4..1e16).contains(&size) {
        let text = format!("{float:e}");
        let (digits, exponent) = text.split_once('e').unwrap_or((&text, "0"));
        let (sign, exponent) = exponent
            .strip_prefix('-')
            .map_or(('+', exponent), |exponent| ('-', exponent));
        return format!("{digits}e{sign}{exponent:0>2}");
    }
    let text = float.to_string();
    if text.contains('.') { text } else { format!("{text}.0") }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn numbers_look_as_python_prints_them() {
        for (number, text) in [
            (json!(0), "0"),
            (json!(0.0), "0.0"),
            (json!(43.13), "43.13"),
            (json!(100.0), "100.0"),
            (json!(1e16), "1e+16"),
            (json!(1.5e-7), "1.5e-07"),
            (json!(-0.0001), "-0.0001"),
        ] {
            assert_eq!(repr(&number), text);
        }
    }

    #[test]
    fn values_look_as_python_prints_them() {
        assert_eq!(
            repr(&json!({"k": [1, null, true, "it's"]})),
            r#"{'k': [1, None, True, "it's"]}"#
        );
        assert_eq!(repr(&json!("a'b\"c\n\u{0}")), r#"'a\'b"c\n\x00'"#);
        assert_eq!(str(&json!("plain")), "plain");
        assert_eq!(
            repr_types(&[("Driving score", &json!("x"))]),
            "[('Driving score', <class 'str'>)]"
        );
        assert_eq!(repr_list(&["Bogus"]), "['Bogus']");
        assert_eq!(
            loads(r#"{"b": 1, "a": NaN, "b": 2}"#),
            Ok(Keys(vec!["b".to_owned(), "a".to_owned()]))
        );
    }

    #[test]
    fn loads_reads_what_json_has_no_word_for() {
        let value: Value =
            loads(r#"{"a": NaN, "b": -Infinity, "c": 1e999, "d": "NaN \" 1e999", "e": -1.5, "f": 12}"#).unwrap();
        for key in ["a", "b", "c"] {
            assert!(is_not_finite(&value[key]), "{key}");
        }
        assert_eq!(value["d"], "NaN \" 1e999");
        assert_eq!((&value["e"], &value["f"]), (&json!(-1.5), &json!(12)));
    }

    #[test]
    fn errors_are_pythons() {
        assert_eq!(
            loads::<Value>("").unwrap_err(),
            "Expecting value: line 1 column 1 (char 0)"
        );
        assert_eq!(
            loads::<Value>("nope").unwrap_err(),
            "Expecting value: line 1 column 2 (char 1)"
        );
        assert_eq!(
            loads::<Value>("[] 1").unwrap_err(),
            "Extra data: line 1 column 4 (char 3)"
        );
        assert_eq!(
            loads_type_error(&json!([1])),
            "the JSON object must be str, bytes or bytearray, not list"
        );
    }
}
