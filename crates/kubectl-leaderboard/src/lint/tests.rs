//! Faults with their lines, and the keywords of the schemas.

use std::collections::BTreeSet;

use serde_json::{Value, json};

use super::{Kinds, manifest, schema};

/// Keywords that `schema::check` and the rules judge, and those that say nothing about one object.
const KNOWN: [&str; 23] = [
    "additionalProperties",
    "default",
    "description",
    "enum",
    "format",
    "items",
    "maxItems",
    "maxLength",
    "maxProperties",
    "maximum",
    "minItems",
    "minLength",
    "minimum",
    "nullable",
    "oneOf",
    "pattern",
    "properties",
    "required",
    "title",
    "type",
    "x-kubernetes-int-or-string",
    "x-kubernetes-list-map-keys",
    "x-kubernetes-list-type",
];

fn keywords(schema: &Value, found: &mut BTreeSet<String>) {
    let fields = schema.as_object().unwrap();
    found.extend(fields.keys().cloned());
    for inner in schema["properties"]
        .as_object()
        .into_iter()
        .flat_map(|all| all.values())
    {
        keywords(inner, found);
    }
    for key in ["items", "additionalProperties"] {
        if schema[key].is_object() {
            keywords(&schema[key], found);
        }
    }
}

#[test]
fn no_schema_has_a_keyword_that_is_not_judged() {
    let mut found = BTreeSet::new();
    for (_, schema) in &Kinds::new().unwrap().schemas {
        keywords(schema, &mut found);
    }
    let known = KNOWN
        .into_iter()
        .chain(["x-kubernetes-validations", "x-kubernetes-preserve-unknown-fields"]);
    let known: BTreeSet<String> = known.map(str::to_owned).collect();
    assert!(found.is_subset(&known), "{:?}", found.difference(&known));
}

/// A schema with each keyword that is judged.
fn judged() -> Value {
    json!({
        "type": "object", "required": ["name"], "properties": {
            "name": {"type": "string", "minLength": 1, "maxLength": 3, "pattern": "^[a-z]*$"},
            "size": {"x-kubernetes-int-or-string": true},
            "number": {"type": "integer", "minimum": 1, "maximum": 9, "default": 1},
            "ratio": {"type": "number"},
            "is": {"type": "boolean", "nullable": true},
            "time": {"type": "string", "format": "date-time"},
            "list": {"type": "array", "minItems": 1, "maxItems": 2, "items": {"type": "string"}},
            "keyed": {"type": "array", "items": {"type": "object", "properties": {"name": {"type": "string"}}},
                      "x-kubernetes-list-type": "map", "x-kubernetes-list-map-keys": ["name"]},
            "map": {"type": "object", "additionalProperties": {"type": "string"}, "maxProperties": 1},
            "free": {"type": "object", "x-kubernetes-preserve-unknown-fields": true},
            "union": {"type": "object", "properties": {"a": {"type": "string"}, "b": {"type": "string"}},
                      "oneOf": [{"required": ["a"]}, {"required": ["b"]}]},
        },
    })
}

/// The faults of an object with this value in a field.
fn faults(field: &str, value: Value) -> String {
    let mut object = json!({"name": "a"});
    object[field] = value;
    let mut faults = Vec::new();
    schema::check(&judged(), &mut object, "spec", &mut faults);
    let texts: Vec<String> = faults.into_iter().map(|fault| fault.text).collect();
    texts.join("; ")
}

#[test]
fn a_value_within_its_keywords_has_no_fault_and_a_null_may_stand_for_a_default() {
    for (field, value) in [
        ("size", json!("1Gi")),
        ("size", json!(1)),
        ("number", json!(null)),
        ("is", json!(null)),
        ("ratio", json!(0.5)),
        ("time", json!("2026-11-01T10:00:00Z")),
        ("map", json!({"a": "b"})),
        ("free", json!({"a": [1, {"b": null}]})),
        ("union", json!({"b": "x"})),
    ] {
        assert_eq!(faults(field, value), "", "{field}");
    }
}

#[test]
fn each_keyword_finds_its_fault() {
    for (field, value, expected) in [
        (
            "name",
            json!(""),
            "spec.name is \"\". It must have at least 1 character",
        ),
        (
            "name",
            json!("abcd"),
            "spec.name is \"abcd\". It must have at most 3 characters",
        ),
        ("name", json!("A"), "spec.name is \"A\". It must match ^[a-z]*$"),
        ("name", json!(null), "spec.name must be a text, and is null"),
        (
            "size",
            json!(1.5),
            "spec.size must be a whole number or a text, and is 1.5",
        ),
        ("number", json!(0), "spec.number is 0. It must be at least 1"),
        ("number", json!(10), "spec.number is 10. It must be at most 9"),
        ("is", json!("yes"), "spec.is must be true or false, and is \"yes\""),
        (
            "time",
            json!("now"),
            "spec.time is \"now\". It must be a time such as 2026-11-01T10:00:00Z",
        ),
        ("list", json!([]), "spec.list has 0 items. It must have at least 1"),
        ("list", json!(["a", 7]), "spec.list[1] must be a text, and is 7"),
        (
            "keyed",
            json!([{"name": "a"}, {"name": "a"}]),
            "spec.keyed[1] has the name of another item: a",
        ),
        (
            "map",
            json!({"a": "b", "c": "d"}),
            "spec.map has 2 entries. It must have at most 1",
        ),
        ("union", json!({}), "spec.union has none of a and b. It must have one"),
        (
            "union",
            json!({"a": "x", "b": "y"}),
            "spec.union has a and b. It may have one of them",
        ),
        ("nmae", json!("a"), "there is no field spec.nmae. Did you mean name?"),
    ] {
        assert_eq!(faults(field, value), expected);
    }
}

/// What a manifest of an evaluator says of its mode, its data and its files is held to the schema and to the rules in CEL.
#[test]
fn a_leaderboard_of_each_mode_is_judged_by_schema_and_rules() {
    let of = |mode: &str, more: &str, agent: &str| {
        format!(
            "apiVersion: leaderboard.carla.org/v1alpha1\nkind: Leaderboard\nmetadata: {{name: digits}}\nspec:\n  \
             tracks: [{{name: test, container: {{score: {{metric: accuracy}}}}}}]\n  storage: {{s3: {{bucket: results}}}}\n  \
             {agent}evaluation:\n    container: {{mode: {mode}, image: 'e:1', command: [evaluate]{more}}}\n"
        )
    };
    let kinds = Kinds::new().unwrap();
    let (agent, data) = (
        "agent: {command: [play]}\n  ",
        ", labels: {image: {reference: 'labels:1'}}",
    );
    for (text, expected) in [
        (of("Batch", data, agent), None),
        (of("Predictions", ", input: {maxBytes: 1Mi, maxFiles: 1}", ""), None),
        (of("Batch", "", ""), Some("agent.command is missing")),
        (
            of("Predictions", ", port: 7000", ""),
            Some("container.port is for Interactive"),
        ),
        (
            of("Interactive", ", input: {}", agent),
            Some("container.input is for Batch"),
        ),
        (
            of("Predictions", ", input: {maxBytes: 200Gi}", ""),
            Some("must be 100Gi or less"),
        ),
        (
            of("Batch", ", dataset: {}", agent),
            Some("container.dataset has none of"),
        ),
        (of("Files", "", agent), Some("mode is \"Files\"")),
    ] {
        let (findings, _) = kinds.findings(&text);
        let found: Vec<&str> = findings.iter().map(|(_, text)| text.as_str()).collect();
        match expected {
            None => assert_eq!(found, Vec::<&str>::new(), "{text}"),
            Some(expected) => assert!(found.iter().any(|found| found.contains(expected)), "{found:?}\n{text}"),
        }
    }
}

#[test]
fn a_value_has_its_line_through_documents_lists_and_aliases() {
    let text = "a: 1\n---\n# none\n---\nspec:\n  tracks:\n    - name: x\n    - &one\n      name: \"y\"\n  flow: {b: [1,\n    2]}\n";
    let nodes = manifest::parse(text).unwrap();
    let last = nodes.last().unwrap();
    for (path, line) in [
        ("", 5),
        ("spec", 5),
        ("spec.tracks[0]", 7),
        ("spec.tracks[1].name", 9),
        ("spec.flow.b[1]", 11),
        ("spec.missing.deeper", 5),
    ] {
        assert_eq!(last.line_of(path), line, "{path}");
    }
    let list = "kind: List\nitems:\n  - a: 1\n  - a: 2\n";
    let items = manifest::parse(list).unwrap();
    assert_eq!(items.iter().map(|item| item.line_of("a")).collect::<Vec<_>>(), [3, 4]);
    let (line, why) = manifest::parse("a: 1\na: 2\n").unwrap_err();
    assert!(line == 2 && why.contains("duplicate"), "{line}: {why}");
}
