//! The CustomResourceDefinitions, as they are installed and as they lie in `crds/`.
//!
//! Called by `leaderboard-operator crd` and by the tests. The definitions themselves are in `api`. Pure.

use k8s_openapi::apiextensions_apiserver::pkg::apis::apiextensions::v1::CustomResourceDefinition;
use kube::CustomResourceExt;
use serde_json::Value;

use leaderboard_api::definitions::served;
use leaderboard_api::{Leaderboard, Submission};

const HEADER: &str = "# Generated from crates/api by `make crds`.\n";

/// A definition that is none, or cannot be printed; a mistake in `crates/api`.
#[derive(thiserror::Error, Debug)]
#[error("the definition of {kind} cannot be made: {why}")]
pub struct CrdError {
    kind: &'static str,
    why: String,
}

fn failed(kind: &'static str, why: &impl ToString) -> CrdError {
    let why = why.to_string();
    CrdError { kind, why }
}

/// One definition and the file it lies in.
pub struct Definition {
    /// Its kind.
    pub kind: &'static str,
    /// Name of its file in `crds/`.
    pub file: &'static str,
    value: Value,
}

impl Definition {
    /// As the API server takes it.
    pub fn object(&self) -> Result<CustomResourceDefinition, CrdError> {
        serde_json::from_value(self.value.clone()).map_err(|error| failed(self.kind, &error))
    }

    /// As JSON.
    pub fn json(&self) -> &Value {
        &self.value
    }

    /// The text of its file.
    pub fn yaml(&self) -> Result<String, CrdError> {
        let text = serde_saphyr::to_string(&self.value).map_err(|error| failed(self.kind, &error))?;
        Ok(format!("{HEADER}{text}"))
    }
}

/// Both definitions.
pub fn definitions() -> Result<[Definition; 2], CrdError> {
    Ok([
        definition("Leaderboard", "leaderboards.yaml", &Leaderboard::crd())?,
        definition("Submission", "submissions.yaml", &Submission::crd())?,
    ])
}

/// Both definitions as one YAML stream, for `kubectl apply`.
pub fn all() -> Result<String, CrdError> {
    let documents = definitions()?;
    let documents: Result<Vec<String>, CrdError> = documents.iter().map(Definition::yaml).collect();
    Ok(documents?.join("---\n"))
}

fn definition(
    kind: &'static str,
    file: &'static str,
    derived: &CustomResourceDefinition,
) -> Result<Definition, CrdError> {
    let value = served(derived).map_err(|error| failed(kind, &error))?;
    Ok(Definition { kind, file, value })
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    /// `make crds` sets UPDATE_CRDS: the files are then written, not compared.
    #[test]
    fn crds_are_up_to_date() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("crds");
        for definition in definitions().unwrap() {
            if std::env::var_os("UPDATE_CRDS").is_some() {
                std::fs::create_dir_all(&folder).unwrap();
                std::fs::write(folder.join(definition.file), definition.yaml().unwrap()).unwrap();
            }
            let committed = std::fs::read_to_string(folder.join(definition.file)).unwrap_or_default();
            let generated = definition.yaml().unwrap();
            let differs = committed.lines().zip(generated.lines()).position(|(a, b)| a != b);
            assert!(
                committed == generated,
                "crds/{} differs from crates/api at line {}; run `make crds` and commit the result",
                definition.file,
                differs.map_or(committed.lines().count().min(generated.lines().count()), |at| at) + 1
            );
        }
    }

    /// Fields whose descriptions are Kubernetes' own.
    const OF_KUBERNETES: [&str; 8] = [
        "conditions",
        "env",
        "envFrom",
        "imagePullSecrets",
        "podOverrides",
        "resources",
        "securityContext",
        "tolerations",
    ];
    /// Words of which a description of an integer has one.
    const UNITS: [&str; 15] = [
        "seconds",
        "days",
        "minute",
        "number",
        "place",
        "attempt",
        "generation",
        "id ",
        "priority",
        "exit code",
        "unit",
        "order",
        "percent",
        "position",
        "port",
    ];

    #[test]
    fn each_description_is_a_sentence_with_its_unit() {
        let (mut read, mut faults) = (0, Vec::new());
        for definition in definitions().unwrap() {
            let root = definition.json().pointer("/spec/versions/0/schema/openAPIV3Schema");
            walk(definition.kind, root.unwrap(), &mut |path, schema| {
                let is_kubernetes = |name: &str| OF_KUBERNETES.contains(&name.trim_end_matches("[]"));
                let described = schema["description"].as_str();
                let Some(text) = described.filter(|_| !path.split('.').any(is_kubernetes)) else {
                    return;
                };
                read += 1;
                let begins = [
                    "What ", "Who ", "Whether ", "Of ", "How ", "Which ", "That ", "The same", "Those ",
                ];
                let lower = text.to_lowercase();
                let fault = if !text.starts_with(|first: char| first.is_uppercase() || first == '`') {
                    "has no capital"
                } else if !text.ends_with('.') {
                    "has no full stop"
                } else if begins.iter().any(|word| text.starts_with(word)) {
                    "begins with a pronoun"
                } else if ["crates/", "src/", "docs/", "::"]
                    .iter()
                    .any(|place| text.contains(place))
                {
                    "names a place in this repository"
                } else if schema["type"] == "integer" && !UNITS.iter().any(|unit| lower.contains(unit)) {
                    "names no unit"
                } else {
                    return;
                };
                faults.push(format!("{path} {fault}: {text}"));
            });
        }
        assert!(read > 200, "only {read} descriptions were read");
        assert!(faults.is_empty(), "{}", faults.join("\n"));
    }

    #[test]
    fn the_files_read_back_as_the_definitions() {
        for definition in definitions().unwrap() {
            let read: Value = serde_saphyr::from_str(&definition.yaml().unwrap()).unwrap();
            assert_eq!(&read, definition.json(), "{}", definition.file);
            assert_eq!(definition.object().unwrap().spec.names.kind, definition.kind);
        }
    }

    #[test]
    fn no_bound_has_a_point_and_the_status_has_no_rule() {
        for definition in definitions().unwrap() {
            let text = definition.yaml().unwrap();
            let pointed = text.lines().find(|line| {
                let line = line.trim();
                (line.starts_with("minimum:") || line.starts_with("maximum:")) && line.contains('.')
            });
            assert_eq!(pointed, None, "{}", definition.file);
            let status = definition
                .json()
                .pointer("/spec/versions/0/schema/openAPIV3Schema/properties/status")
                .unwrap();
            assert!(!status.to_string().contains("x-kubernetes-validations"));
        }
    }

    /// Calls `each` with the path of every schema below this one.
    fn walk(path: &str, schema: &Value, each: &mut impl FnMut(&str, &Value)) {
        each(path, schema);
        for (name, inner) in schema["properties"].as_object().into_iter().flatten() {
            walk(&format!("{path}.{name}"), inner, each);
        }
        for key in ["items", "additionalProperties"] {
            if schema[key].is_object() {
                walk(&format!("{path}[]"), &schema[key], each);
            }
        }
    }

    #[test]
    fn every_list_has_a_type_and_every_text_of_the_status_an_end() {
        let mut keyed = Vec::new();
        for definition in definitions().unwrap() {
            let root = definition.json().pointer("/spec/versions/0/schema/openAPIV3Schema");
            walk(definition.kind, root.unwrap(), &mut |path, schema| {
                let list_type = schema["x-kubernetes-list-type"].as_str();
                assert_eq!(schema["type"] == "array", list_type.is_some(), "{path}");
                if list_type == Some("map") {
                    keyed.push(path.to_owned());
                }
                let is_free = schema["type"] == "string" && schema["enum"].is_null() && schema["format"].is_null();
                assert!(
                    !(is_free && path.contains(".status.")) || schema["maxLength"].is_u64(),
                    "{path} has no maxLength"
                );
            });
        }
        for path in [
            "Leaderboard.spec.tracks",
            "Leaderboard.spec.agent.env",
            "Leaderboard.status.tracks",
        ] {
            assert!(keyed.iter().any(|found| found == path), "{path}: {keyed:?}");
        }
        for path in ["Submission.status.workers", "Submission.status.conditions"] {
            assert!(keyed.iter().any(|found| found == path), "{path}: {keyed:?}");
        }
    }
}
