use serde_json::{Value, json};

use super::*;

fn whole() -> Value {
    json!({
        "schema": 1, "done": 3, "total": 10, "final": false, "eligible": true,
        "splits": [{"name": "test", "metrics": {"accuracy": 0.5}}],
        "refused": null, "message": "one line",
    })
}

/// The document with another value of a field; `null` removes it.
fn with(field: &str, value: Value) -> Value {
    let mut document = whole();
    match value {
        Value::Null => document.as_object_mut().unwrap().remove(field),
        value => document.as_object_mut().unwrap().insert(field.to_owned(), value),
    };
    document
}

fn read(document: &Value) -> Result<ResultFile, ResultError> {
    parse(document.to_string().as_bytes())
}

fn splits(many: usize, metrics: usize) -> Value {
    let metrics: serde_json::Map<String, Value> = (0..metrics).map(|m| (m.to_string(), 1.into())).collect();
    (0..many)
        .map(|n| json!({"name": format!("s{n}"), "metrics": metrics}))
        .collect()
}

/// What holds of every document that is read, whatever was written.
fn assert_within_bounds(result: &ResultFile) {
    assert!(result.done <= result.total && result.total <= MAX_UNITS);
    assert!(!result.is_final || result.refused.is_some() || (result.done == result.total && result.total > 0));
    assert!(result.splits.len() <= MAX_SPLITS);
    let texts = result.refused.iter().chain(&result.message);
    assert!(
        texts
            .into_iter()
            .all(|text| !text.contains('\n') && text.chars().count() <= MAX_TEXT)
    );
    for split in &result.splits {
        assert!(split.metrics.len() <= MAX_METRICS);
        for (name, number) in &split.metrics {
            assert!((1..=MAX_NAME).contains(&name.chars().count()));
            assert!(number.value().is_finite() && number.text().len() <= MAX_NUMBER);
            assert_eq!(number.text().parse(), Ok(number.value()), "{number:?}");
        }
    }
}

#[test]
fn a_whole_document_and_the_smallest_one() {
    let result = read(&whole()).unwrap();
    assert_eq!(
        (result.done, result.total, result.is_final, result.eligible),
        (3, 10, false, true)
    );
    assert_eq!(result.split("test").unwrap().metric("accuracy").unwrap().text(), "0.5");
    assert_eq!((result.refused, result.message.as_deref()), (None, Some("one line")));
    let smallest =
        json!({"schema": 1, "done": 0, "total": 0, "final": false, "splits": [], "else": {"is": ["ignored"]}});
    let result = read(&smallest).unwrap();
    assert!(result.eligible && result.splits.is_empty() && result.refused.is_none() && result.message.is_none());
}

#[test]
fn each_good_document_is_read_and_within_its_bounds() {
    for good in [
        with("done", 10.into()),
        with("total", MAX_UNITS.into()),
        with("eligible", false.into()),
        with("splits", splits(MAX_SPLITS, MAX_METRICS)),
        with(
            "splits",
            json!([{"name": "n".repeat(MAX_NAME), "metrics": {"m".repeat(MAX_NAME): -1e300}}]),
        ),
        with("splits", json!([{"name": "ü b", "metrics": {}}])),
        with("refused", "r\n".repeat(5000).into()),
        with("message", "m".repeat(5000).into()),
        json!({"schema": 1, "done": 2, "total": 2, "final": true, "splits": []}),
        json!({"schema": 1, "done": 1, "total": 2, "final": true, "splits": [], "refused": "no"}),
    ] {
        assert_within_bounds(&read(&good).unwrap_or_else(|error| panic!("{good}: {error}")));
    }
}

#[test]
fn each_bad_document_says_what_is_wrong_and_what_to_do() {
    let metric = |metrics: Value| with("splits", json!([{"name": "test", "metrics": metrics}]));
    for (bad, part) in [
        (with("schema", Value::Null), "missing field `schema`"),
        (with("schema", 2.into()), "its schema is 2, and this operator reads 1"),
        (with("schema", "1".into()), "not the JSON of a result"),
        (with("done", Value::Null), "missing field `done`"),
        (with("total", Value::Null), "missing field `total`"),
        (with("final", Value::Null), "missing field `final`"),
        (with("splits", Value::Null), "missing field `splits`"),
        (with("done", 11.into()), "done is 11, more than total, which is 10"),
        (with("done", (-1).into()), "not the JSON of a result"),
        (with("done", 1.5.into()), "not the JSON of a result"),
        (with("total", (u64::from(MAX_UNITS) + 1).into()), "total is 1000000001"),
        (with("total", u64::MAX.into()), "total is 18446744073709551615"),
        (
            with("final", true.into()),
            "final is true, but done is 3 and total is 10",
        ),
        (with("final", 1.into()), "not the JSON of a result"),
        (with("eligible", "no".into()), "not the JSON of a result"),
        (with("refused", true.into()), "not the JSON of a result"),
        (with("message", json!(["a"])), "not the JSON of a result"),
        (with("splits", json!({})), "not the JSON of a result"),
        (with("splits", splits(17, 1)), "it has 17 splits, more than 16"),
        (
            with("splits", splits(1, 33)),
            "the split s0 has 33 metrics, more than 32",
        ),
        (with("splits", json!([{"name": "a"}])), "missing field `metrics`"),
        (with("splits", json!([{"name": "", "metrics": {}}])), "\"\" is no name"),
        (with("splits", json!([{"name": " ", "metrics": {}}])), "\"\" is no name"),
        (
            with("splits", json!([{"name": "a\nb", "metrics": {}}])),
            "\"a b\" is no name",
        ),
        (
            with("splits", json!([{"name": "\u{202e}", "metrics": {}}])),
            "is no name",
        ),
        (
            with("splits", json!([{"name": "x".repeat(65), "metrics": {}}])),
            "is no name",
        ),
        (
            with(
                "splits",
                json!([{"name": "a", "metrics": {}}, {"name": "a", "metrics": {}}]),
            ),
            "two splits have the name a",
        ),
        (metric(json!({"": 1})), "is no name"),
        (
            metric(json!({"a": "1"})),
            "the metric a of the split test is no finite number",
        ),
        (metric(json!({"a": null})), "is no finite number"),
        (metric(json!({"a": true})), "is no finite number"),
        (metric(json!({"a": [1]})), "is no finite number"),
        (metric(json!([1])), "expected an object of numbers"),
        (json!([]), "not the JSON of a result"),
        (json!(null), "not the JSON of a result"),
    ] {
        let error = read(&bad).unwrap_err().to_string();
        assert!(error.contains(part) && error.ends_with('.'), "{bad}: {error}");
    }
}

#[test]
fn texts_that_are_no_json_of_serde_are_refused_too() {
    let of_metrics = |metrics: &str| {
        format!(r#"{{"schema":1,"done":0,"total":1,"final":false,"splits":[{{"name":"s","metrics":{metrics}}}]}}"#)
    };
    let deep = "[".repeat(500_000);
    for (text, part) in [
        (String::new(), "not the JSON"),
        ("{\"schema\":1,".to_owned(), "not the JSON"),
        ("{\"schema\":1,\"schema\":1}".to_owned(), "duplicate field `schema`"),
        (
            whole().to_string().replacen("\"done\"", "\"done\":1,\"done\"", 1),
            "duplicate field `done`",
        ),
        (whole().to_string() + "x", "trailing characters"),
        (of_metrics(r#"{"a":NaN}"#), "not the JSON"),
        (of_metrics(r#"{"a":Infinity}"#), "not the JSON"),
        (of_metrics(r#"{"a":-Infinity}"#), "not the JSON"),
        (of_metrics(r#"{"a":1e999}"#), "is no finite number"),
        (of_metrics(r#"{"a":-1e999}"#), "is no finite number"),
        (of_metrics(r#"{"a":1,"a":2}"#), "two metrics with the name a"),
        (of_metrics(r#"{"a":1,"\u0061":2}"#), "two metrics with the name a"),
        (of_metrics(&format!(r#"{{"a":{deep}"#)), "not the JSON"),
        (of_metrics(&deep), "not the JSON"),
        (deep.clone(), "not the JSON"),
        (" ".repeat(MAX_BYTES + 1), "1048577 bytes"),
    ] {
        let error = parse(text.as_bytes()).unwrap_err().to_string();
        let shown: String = text.chars().take(100).collect();
        assert!(error.contains(part), "{shown}: {error}");
        assert!(error.chars().count() < 2 * MAX_TEXT, "{shown}");
    }
    let error = parse(b"{\"schema\":1,\"\xff\":1}").unwrap_err();
    assert!(matches!(error, ResultError::Malformed(_)), "{error}");
    assert!(parse(&vec![b' '; MAX_BYTES]).is_err());
}

/// Beyond any stack if each level took some of it.
#[test]
fn a_deep_field_that_nothing_reads_is_ignored() {
    let (open, close) = ("[".repeat(400_000), "]".repeat(400_000));
    let text = whole()
        .to_string()
        .replacen('{', &format!("{{\"deep\":{open}{close},"), 1);
    assert_eq!(parse(text.as_bytes()), read(&whole()));
}

#[test]
fn digits_stay_as_they_were_written() {
    let long = format!("0.{}", "3".repeat(100));
    for (text, shown) in [
        ("0.50", "0.50"),
        ("3", "3"),
        ("-0.0", "-0.0"),
        ("1E2", "1E2"),
        ("0.1234567890123456789012345678", "0.1234567890123456789012345678"),
        (&long, "0.3333333333333333"),
        ("100000000000000000000000000000000000", "1e35"),
    ] {
        let number = Number::read(text).unwrap();
        assert_eq!(number.text(), shown);
        assert_eq!(Ok(number.value()), shown.parse());
    }
    assert_eq!(
        ["inf", "nan", "-inf", "\"1\"", "1e400", ""].map(Number::read),
        [const { None }; 6]
    );
}

#[test]
fn a_refusal_without_a_text_gets_one() {
    for (text, shown) in [
        ("", REFUSED),
        (" \n ", REFUSED),
        ("No image\nfound.", "No image found."),
    ] {
        let refused = read(&with("refused", text.into())).unwrap().refused;
        assert_eq!(refused.as_deref(), Some(shown));
    }
}

#[test]
fn a_final_result_has_the_score() {
    let of = |split: Option<&str>| ScoreMetric {
        split: split.map(str::to_owned),
        metric: "accuracy".into(),
        order: crate::Order::Descending,
    };
    let result = |is_final: bool, names: &[&str], metric: &str| {
        let splits: Vec<Value> = names
            .iter()
            .map(|name| json!({"name": name, "metrics": {metric: 1}}))
            .collect();
        let done = if is_final { 10 } else { 3 };
        let mut document = with("splits", splits.into());
        document["final"] = is_final.into();
        document["done"] = done.into();
        read(&document).unwrap()
    };
    let several = "Set tracks[].container.score.split.";
    let missing = "correct tracks[].container.score.";
    for (is_final, names, metric, split, part) in [
        (true, &["a"][..], "accuracy", None, None),
        (true, &["a"], "accuracy", Some("a"), None),
        (true, &["a", "b"], "accuracy", Some("b"), None),
        (true, &["a", "b"], "accuracy", None, Some(several)),
        (false, &["a", "b"], "accuracy", None, Some(several)),
        (true, &["a"], "accuracy", Some("b"), Some(missing)),
        (true, &["a"], "loss", None, Some(missing)),
        (true, &[], "loss", None, Some(missing)),
        (false, &["a"], "loss", None, None),
        (false, &[], "loss", Some("a"), None),
    ] {
        let checked = result(is_final, names, metric).check_score(&of(split));
        let error = checked.err().map(|error| error.to_string());
        let fits = error
            .as_deref()
            .zip(part)
            .is_some_and(|(error, part)| error.ends_with(part));
        assert!(
            fits || (error.is_none() && part.is_none()),
            "{is_final} {names:?} {metric} {split:?}: {error:?}"
        );
    }
}

/// Cuts, flips and repeats of a document: whatever is read is within the bounds.
#[test]
fn no_damage_leads_beyond_the_bounds() {
    let good = with(
        "splits",
        json!([{"name": "a", "metrics": {"x": 1.5e3, "y": -2}}, {"name": "b", "metrics": {}}]),
    )
    .to_string();
    let bytes = good.as_bytes();
    let mut read = 0;
    for at in 0..bytes.len() {
        for new in *b"0919-eE.\"{}[],:tnx \xff" {
            let mut damaged = bytes.to_vec();
            damaged[at] = new;
            let mut longer = bytes.to_vec();
            longer.insert(at, new);
            for result in [parse(&damaged), parse(&longer), parse(&bytes[..at])]
                .into_iter()
                .flatten()
            {
                read += 1;
                assert_within_bounds(&result);
            }
        }
    }
    assert!(read > 100, "{read} of the damaged documents can be read");
}

/// The schema for hosts has the fields and the bounds of this reader.
#[test]
fn the_schema_for_hosts_says_the_same() {
    let schema: Value = serde_json::from_str(include_str!("../../../../docs/evaluator-result.schema.json")).unwrap();
    let at = |pointer: &str| schema.pointer(pointer).unwrap_or(&Value::Null);
    let required: Vec<&str> = at("/required")
        .as_array()
        .unwrap()
        .iter()
        .filter_map(Value::as_str)
        .collect();
    assert_eq!(required, ["schema", "done", "total", "final", "splits"]);
    let documented: BTreeSet<&String> = at("/properties").as_object().unwrap().keys().collect();
    let document = whole();
    assert_eq!(documented, document.as_object().unwrap().keys().collect());
    let split = "/properties/splits/items/properties";
    for (pointer, bound) in [
        ("/properties/schema/const".to_owned(), SCHEMA),
        ("/properties/done/maximum".to_owned(), MAX_UNITS.into()),
        ("/properties/total/maximum".to_owned(), MAX_UNITS.into()),
        ("/properties/splits/maxItems".to_owned(), MAX_SPLITS as u64),
        (format!("{split}/name/minLength"), 1),
        (format!("{split}/name/maxLength"), MAX_NAME as u64),
        (format!("{split}/metrics/maxProperties"), MAX_METRICS as u64),
        (format!("{split}/metrics/propertyNames/minLength"), 1),
        (format!("{split}/metrics/propertyNames/maxLength"), MAX_NAME as u64),
        ("/properties/refused/maxLength".to_owned(), MAX_TEXT as u64),
        ("/properties/message/maxLength".to_owned(), MAX_TEXT as u64),
    ] {
        assert_eq!(at(&pointer).as_u64(), Some(bound), "{pointer}");
    }
    for field in at("/properties").as_object().unwrap().values() {
        assert!(
            field["description"].as_str().is_some_and(|text| text.ends_with('.')),
            "{field}"
        );
    }
    let examples = at("/examples").as_array().unwrap();
    assert!(!examples.is_empty() && examples.iter().all(|example| self::read(example).is_ok()));
    // An optional field that is left out, and one that is required.
    for field in documented {
        let is_read = self::read(&with(field, Value::Null)).is_ok();
        assert_eq!(is_read, !required.contains(&field.as_str()), "{field}");
    }
}
