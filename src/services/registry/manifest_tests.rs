//! Documents as registries give them, and as somebody writes them who wants to be taken for somebody else.

use serde_json::{Value, json};

use super::*;

fn digest(c: char) -> String {
    format!("sha256:{}", c.to_string().repeat(64))
}

fn descriptor(c: char, size: u64) -> Value {
    json!({"mediaType": "x", "digest": digest(c), "size": size})
}

fn manifest() -> Value {
    json!({"schemaVersion": 2, "config": descriptor('c', 10), "layers": [descriptor('1', 100), descriptor('2', 200)]})
}

fn read(value: &Value) -> Result<Document, Defect> {
    document(value.to_string().as_bytes())
}

fn of_platform(c: char, os: &str, architecture: &str) -> Value {
    let mut image = descriptor(c, 1);
    image["platform"] = json!({"os": os, "architecture": architecture});
    image
}

#[test]
fn a_manifest_gives_its_config_and_the_bytes_of_all_parts() {
    let config = Part {
        digest: digest('c'),
        bytes: 10,
    };
    assert_eq!(read(&manifest()), Ok(Document::Image { config, bytes: 310 }));
    let mut huge = manifest();
    huge["layers"] = json!([descriptor('1', u64::MAX), descriptor('2', u64::MAX)]);
    assert!(matches!(read(&huge), Ok(Document::Image { bytes: u64::MAX, .. })));
}

#[test]
fn an_index_gives_its_image_for_our_machines() {
    let index = |images: Value| read(&json!({"schemaVersion": 2, "manifests": images}));
    let found = |c: char| {
        let digest = digest(c);
        Ok(Document::Index(Some(Part { digest, bytes: 1 })))
    };
    let arm = of_platform('a', "linux", "arm64");
    let windows = of_platform('b', "windows", "amd64");
    let attestation = of_platform('d', "unknown", "unknown");
    let ours = of_platform('e', "linux", "amd64");
    assert_eq!(index(json!([arm, windows, attestation, ours])), found('e'));
    assert_eq!(index(json!([of_platform('f', "Linux", "x86_64")])), found('f'));
    assert_eq!(index(json!([descriptor('9', 1), ours])), found('e'));
    assert_eq!(
        index(json!([arm, descriptor('9', 1)])),
        found('9'),
        "its config will say"
    );
    assert_eq!(index(json!([arm, windows, attestation])), Ok(Document::Index(None)));
    assert_eq!(index(json!([])), Ok(Document::Index(None)));
    assert_eq!(index(Value::from(vec![arm; 257])), Err(IMAGES));
}

#[test]
fn what_engines_could_read_otherwise_is_refused() {
    let with = |name: &str, value: Value| {
        let mut changed = manifest();
        changed[name] = value;
        changed
    };
    for (value, defect) in [
        (json!([]), NOT_JSON),
        (json!({}), NO_MANIFEST),
        (json!({"schemaVersion": 1, "fsLayers": []}), NO_MANIFEST),
        (with("manifests", json!([])), TWO_KINDS),
        (with("Layers", json!([descriptor('3', 1)])), AMBIGUOUS),
        (with("layer\u{17f}", json!([])), AMBIGUOUS),
        (with("CONFIG", json!({})), AMBIGUOUS),
        (with("config", Value::Null), NO_MANIFEST),
        (with("config", json!("x")), BAD_FIELD),
        (with("layers", json!({})), BAD_FIELD),
        (with("layers", json!([1])), NOT_JSON),
        (with("layers", json!([{"digest": digest('1'), "size": -1}])), BAD_FIELD),
        (with("layers", json!([{"digest": digest('1'), "size": 1.5}])), BAD_FIELD),
        (with("layers", json!([{"digest": digest('1'), "size": "1"}])), BAD_FIELD),
        (with("layers", json!([{"digest": digest('1')}])), BAD_FIELD),
        (
            with("layers", json!([{"digest": "sha256:../../x", "size": 1}])),
            BAD_DIGEST,
        ),
        (with("layers", json!([{"digest": "md5:00", "size": 1}])), BAD_DIGEST),
        (with("layers", Value::from(vec![descriptor('1', 1); 513])), LAYERS),
    ] {
        assert_eq!(read(&value), Err(defect), "{value}");
    }
    let twice = manifest().to_string().replacen('{', "{\"layers\": [],", 1);
    assert_eq!(document(twice.as_bytes()), Err(AMBIGUOUS));
    let elsewhere = json!({"digest": digest('1'), "size": 1, "urls": ["http://10.0.0.5:8080/"]});
    assert_eq!(read(&with("layers", json!([elsewhere]))), Err(ELSEWHERE));
}

#[test]
fn bytes_that_are_no_document_are_refused_however_deep_they_are() {
    for body in [b"".as_slice(), b"{", b"null", b"\xff\xfe", b"{} {}", b"{\"a\": \xff}"] {
        assert_eq!(document(body), Err(NOT_JSON), "{body:?}");
    }
    let deep = format!("{{\"x\": {}{}}}", "[".repeat(100_000), "]".repeat(100_000));
    assert_eq!(
        document(deep.as_bytes()),
        Err(NO_MANIFEST),
        "what nobody asks for is skipped"
    );
    let deep = format!("{{\"layers\": {}{}}}", "[".repeat(100_000), "]".repeat(100_000));
    assert!(document(deep.as_bytes()).is_err());
}

#[test]
fn a_config_has_the_platform_and_the_volumes() {
    let read = |value: Value| config(value.to_string().as_bytes());
    let of = |run: Value| json!({"os": "linux", "architecture": "amd64", "config": run});
    for (value, is_linux_amd64, has_volumes) in [
        (of(json!({})), true, false),
        (of(Value::Null), true, false),
        (of(json!({"Volumes": null})), true, false),
        (of(json!({"Volumes": {}})), true, false),
        (of(json!({"Volumes": {"/data": {}}})), true, true),
        (of(json!({"Labels": {"a": "1", "A": "2"}})), true, false),
        (json!({"os": "linux", "architecture": "arm64"}), false, false),
        (json!({"os": "windows", "architecture": "amd64"}), false, false),
        (json!({}), false, false),
    ] {
        let wanted = Config {
            is_linux_amd64,
            has_volumes,
        };
        assert_eq!(read(value.clone()), Ok(wanted), "{value}");
    }
    assert_eq!(read(of(json!({"volumes": {"/data": {}}}))), Err(AMBIGUOUS));
    assert_eq!(read(of(json!({"Volumes": ["/data"]}))), Err(BAD_FIELD));
}
