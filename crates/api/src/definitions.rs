//! The CustomResourceDefinition of a kind as an API server takes it: the derived one with numbers and lists as people and servers read them.
//!
//! Called by the operator, which installs them, and by the plugin, which checks manifests by them. Pure.

use k8s_openapi::apiextensions_apiserver::pkg::apis::apiextensions::v1::CustomResourceDefinition;
use serde_json::Value;

/// The definition that is installed, as JSON, of the one that `kube` derives.
pub fn served(derived: &CustomResourceDefinition) -> serde_json::Result<Value> {
    let mut value = serde_json::to_value(derived)?;
    each(&mut value, &|value: &mut Value| {
        whole_number(value);
        whole_list(value);
        null_is_default(value);
    });
    if let Some(versions) = value.pointer_mut("/spec/versions").and_then(Value::as_array_mut) {
        for status in versions
            .iter_mut()
            .filter_map(|version| version.pointer_mut("/schema/openAPIV3Schema/properties/status"))
        {
            each(status, &without_rules);
        }
    }
    Ok(value)
}

/// Changes a value, then all that is in it.
fn each(value: &mut Value, change: &impl Fn(&mut Value)) {
    change(value);
    match value {
        Value::Array(list) => list.iter_mut().for_each(|inner| each(inner, change)),
        Value::Object(object) => object.values_mut().for_each(|inner| each(inner, change)),
        _ => {}
    }
}

/// The status is the operator's own: a rule there could only keep it from telling what it saw.
fn without_rules(value: &mut Value) {
    if let Some(object) = value.as_object_mut() {
        object.remove("x-kubernetes-validations");
    }
}

/// Lists without a key are replaced as a whole by who applies them. The types show which ones have a key.
fn whole_list(value: &mut Value) {
    if value["type"] == "array" && value["x-kubernetes-list-type"].is_null() {
        value["x-kubernetes-list-type"] = "atomic".into();
    }
}

/// A null of a field with a default is as good as none: the API server keeps a null where it is allowed. `kube` allows one in each
/// quantity.
fn null_is_default(value: &mut Value) {
    if value["x-kubernetes-int-or-string"] == true
        && !value["default"].is_null()
        && let Some(object) = value.as_object_mut()
    {
        object.remove("nullable");
    }
}

/// Writes `1.0` as `1`: bounds are kept as floating-point numbers, but people read them.
fn whole_number(value: &mut Value) {
    let Some(float) = value.as_f64().filter(|_| value.is_f64()) else {
        return;
    };
    let whole: Option<i64> = format!("{float:.0}").parse().ok();
    #[allow(clippy::cast_precision_loss, reason = "compared with the number it came from")]
    if let Some(whole) = whole.filter(|whole| value.as_f64() == Some(*whole as f64)) {
        *value = whole.into();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn whole_numbers_lose_their_point_and_others_keep_it() {
        let mut value = serde_json::json!({"a": [1.0, -3.0, 0.5], "b": {"c": 1e30, "d": 7, "e": "1.0"}});
        each(&mut value, &whole_number);
        assert_eq!(
            value,
            serde_json::json!({"a": [1, -3, 0.5], "b": {"c": 1e30, "d": 7, "e": "1.0"}})
        );
    }
}
