//! Faults of an object by the schema of its kind, as the API server finds them. Pure. The rules in CEL are `kube_cel`'s.

use jiff::Timestamp;
use regex::Regex;
use serde_json::{Map, Value};

use crate::near;
use crate::text::counted;

/// A fault, with the path of the value that has it.
#[derive(Debug, PartialEq, Eq)]
pub struct Fault {
    pub path: String,
    pub text: String,
}

impl Fault {
    pub fn at(path: &str, text: String) -> Self {
        let path = path.to_owned();
        Self { path, text }
    }
}

/// All faults of a value. A null that stands for a default is taken out, as the API server does.
pub fn check(schema: &Value, value: &mut Value, path: &str, faults: &mut Vec<Fault>) {
    let mut found = Vec::new();
    if value.is_null() && schema["nullable"] == true {
        return;
    }
    let (type_, has_type) = type_of(schema);
    if !has_type(value) {
        found.push(format!("{path} must be {type_}, and is {}", shown(value)));
    } else if let Some(list) = schema["enum"].as_array().filter(|list| !list.contains(value)) {
        let known: Vec<String> = list.iter().map(shown).collect();
        found.push(format!("{path} is {}. It must be {}", shown(value), known.join(" or ")));
    } else {
        match value {
            Value::Object(fields) => object(schema, fields, path, faults),
            Value::Array(items) => {
                faults.extend(list(schema, items, path));
                for (index, item) in items.iter_mut().enumerate() {
                    check(&schema["items"], item, &format!("{path}[{index}]"), faults);
                }
            }
            Value::String(text) => {
                found.extend(string(schema, text).map(|why| format!("{path} is {value}. It must {why}")));
            }
            Value::Number(number) => {
                let number = number.as_f64().unwrap_or_default();
                let below = schema["minimum"].as_f64().filter(|least| number < *least);
                let above = schema["maximum"].as_f64().filter(|most| number > *most);
                found.extend(below.map(|least| format!("{path} is {value}. It must be at least {least}")));
                found.extend(above.map(|most| format!("{path} is {value}. It must be at most {most}")));
            }
            Value::Null | Value::Bool(_) => {}
        }
    }
    faults.extend(found.into_iter().map(|text| Fault::at(path, text)));
}

/// The type that a schema asks for, in words, and whether a value has it.
fn type_of(schema: &Value) -> (&'static str, fn(&Value) -> bool) {
    if schema["x-kubernetes-int-or-string"] == true {
        return ("a whole number or a text", |value| value.is_string() || is_whole(value));
    }
    match schema["type"].as_str() {
        Some("object") => ("a mapping", Value::is_object),
        Some("array") => ("a list", Value::is_array),
        Some("string") => ("a text", Value::is_string),
        Some("boolean") => ("true or false", Value::is_boolean),
        Some("integer") => ("a whole number", is_whole),
        Some("number") => ("a number", Value::is_number),
        _ => ("anything", |_| true),
    }
}

fn is_whole(value: &Value) -> bool {
    value.is_i64() || value.is_u64()
}

/// A value in few words.
fn shown(value: &Value) -> String {
    match value {
        Value::Object(_) => "a mapping".to_owned(),
        Value::Array(_) => "a list".to_owned(),
        scalar => scalar.to_string(),
    }
}

fn object(schema: &Value, fields: &mut Map<String, Value>, path: &str, faults: &mut Vec<Fault>) {
    let nothing = Map::new();
    let known = schema["properties"].as_object().unwrap_or(&nothing);
    let at = |name: &str| join(path, name);
    let is_default = |name: &String, value: &Value| {
        let schema = known.get(name).filter(|_| value.is_null());
        schema.is_some_and(|schema| schema["nullable"] != true && !schema["default"].is_null())
    };
    fields.retain(|name, value| !is_default(name, value));
    let required = schema["required"]
        .as_array()
        .into_iter()
        .flatten()
        .filter_map(Value::as_str);
    for name in required.filter(|name| !fields.contains_key(*name)) {
        faults.push(Fault::at(path, format!("{} is missing", at(name))));
    }
    faults.extend(union(schema, fields, path));
    let count = fields.len();
    if let Some((least, bound)) = bound(schema, ["minProperties", "maxProperties"], count) {
        let text = format!("{path} has {count} entries. It must have {least} {bound}");
        faults.push(Fault::at(path, text));
    }
    let names: Vec<String> = known.keys().cloned().collect();
    for (name, value) in fields.iter_mut() {
        let more = &schema["additionalProperties"];
        if let Some(schema) = known.get(name) {
            check(schema, value, &at(name), faults);
        } else if more.is_object() {
            check(more, value, &at(name), faults);
        } else if more != true && schema["x-kubernetes-preserve-unknown-fields"] != true {
            let near = near::names(name, &names);
            let next = near.first().map(|near| format!(". Did you mean {near}?"));
            let text = format!("there is no field {}{}", at(name), next.unwrap_or_default());
            faults.push(Fault::at(&at(name), text));
        }
    }
}

/// A fault of a union: exactly one of its members is set.
fn union(schema: &Value, fields: &Map<String, Value>, path: &str) -> Option<Fault> {
    let members = schema["oneOf"].as_array()?.iter();
    let members: Vec<&str> = members.filter_map(|one| one["required"][0].as_str()).collect();
    let set: Vec<&str> = members
        .iter()
        .copied()
        .filter(|name| fields.contains_key(*name))
        .collect();
    let text = match set.as_slice() {
        [_] => return None,
        [] => format!("{path} has none of {}. It must have one", members.join(" and ")),
        _ => format!("{path} has {}. It may have one of them", set.join(" and ")),
    };
    Some(Fault::at(path, text))
}

/// The bound that a number does not keep.
fn bound(schema: &Value, [least, most]: [&str; 2], number: usize) -> Option<(&'static str, usize)> {
    let of = |key: &str| usize::try_from(schema[key].as_u64()?).ok();
    let least = of(least).filter(|least| number < *least);
    let most = of(most).filter(|most| number > *most);
    least
        .map(|least| ("at least", least))
        .or(most.map(|most| ("at most", most)))
}

/// A fault of a list itself: its length, or two items with one key.
fn list(schema: &Value, items: &[Value], path: &str) -> Option<Fault> {
    let length = items.len();
    if let Some((least, bound)) = bound(schema, ["minItems", "maxItems"], length) {
        let text = format!("{path} has {length} items. It must have {least} {bound}");
        return Some(Fault::at(path, text));
    }
    let keys = schema["x-kubernetes-list-map-keys"].as_array()?;
    let key_of = |item: &Value| {
        keys.iter()
            .map(|key| item[key.as_str()?].as_str().map(str::to_owned))
            .collect::<Vec<_>>()
    };
    let keyed: Vec<_> = items.iter().map(key_of).collect();
    let mut twice = keyed.iter().enumerate();
    let (index, key) = twice.find(|(index, key)| keyed.iter().take(*index).any(|one| one == *key))?;
    let key: Vec<&str> = key.iter().flatten().map(String::as_str).collect();
    let path = format!("{path}[{index}]");
    let text = format!("{path} has the name of another item: {}", key.join(", "));
    Some(Fault { path, text })
}

/// The first rule of the schema that a text breaks, as the words after "must". None if it keeps all.
fn string(schema: &Value, text: &str) -> Option<String> {
    if let Some((least, bound)) = bound(schema, ["minLength", "maxLength"], text.chars().count()) {
        return Some(format!("have {least} {}", counted(bound, "character")));
    }
    if schema["format"] == "date-time" && text.parse::<Timestamp>().is_err() {
        return Some("be a time such as 2026-11-01T10:00:00Z".to_owned());
    }
    let pattern = schema["pattern"].as_str()?;
    let is_match = Regex::new(pattern).is_ok_and(|pattern| pattern.is_match(text));
    (!is_match).then(|| format!("match {pattern}"))
}

fn join(path: &str, name: &str) -> String {
    if path.is_empty() {
        name.to_owned()
    } else {
        format!("{path}.{name}")
    }
}
