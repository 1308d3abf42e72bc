//! `lint`: manifests checked by the schemas and the CEL rules of this version's definitions, and results of evaluators by the reader of
//! them, without a cluster.
//!
//! `findings` is pure. It leaves out checks that need an API server: other objects, and the change of an existing one.

mod manifest;
mod schema;

#[cfg(test)]
mod tests;

use std::path::PathBuf;
use std::process::ExitCode;

use clap::Args;
use kube::CustomResourceExt;
use kube_cel::{ErrorKind, Validator};
use leaderboard_api::definitions::served;
use leaderboard_api::text::sentence;
use leaderboard_api::{GROUP, Leaderboard, Submission, VERSION, evaluator_result};
use serde_json::{Value, json};

use self::schema::Fault;
use crate::error::Error;
use crate::import::text_of;
use crate::near;
use crate::output::{code, paragraphs, print};
use crate::text::counted;

/// The manifests.
#[derive(Args, Debug)]
pub struct Lint {
    /// Files with Leaderboards and Submissions in YAML or JSON, each with any number of objects, or result.json of an evaluator; `-` is
    /// standard input.
    #[arg(required = true, value_name = "FILE")]
    files: Vec<PathBuf>,
}

/// The line of a fault, and a sentence about it.
type Finding = (u64, String);

/// Numbers of objects.
#[derive(Debug, Default, PartialEq, Eq)]
struct Checked {
    valid: usize,
    faulty: usize,
    /// Objects of other groups, which are not checked.
    others: usize,
}

/// Prints each fault with its file and line; the exit code shows whether there is one.
pub fn lint(wanted: &Lint) -> Result<ExitCode, Error> {
    let kinds = Kinds::new()?;
    let mut is_well = true;
    for path in &wanted.files {
        let shown = if path.as_os_str() == "-" {
            "standard input".to_owned()
        } else {
            path.display().to_string()
        };
        let (text, _) = text_of(path).map_err(|error| Error::Unread(shown.clone(), error))?;
        let (findings, checked) = kinds.findings(&text);
        // A pipe without an object has broken before this program.
        is_well &= findings.is_empty() && checked != Checked::default();
        print(&paragraphs(&lines(&shown, &findings, &checked)));
    }
    Ok(code(is_well))
}

/// Lines about one file: each fault, and a sentence about all objects.
fn lines(file: &str, findings: &[Finding], checked: &Checked) -> Vec<String> {
    let mut lines: Vec<String> = findings
        .iter()
        .map(|(line, text)| format!("{file}:{line}: {text}"))
        .collect();
    let objects = |number| counted(number, "object");
    let mut parts = Vec::new();
    match (checked.valid, checked.faulty, findings.len()) {
        (0, 0, 0) if checked.others == 0 => parts.push("no object".to_owned()),
        (0, 0, 0) => {}
        (valid, 0, 0) => parts.push(format!("{} valid", objects(valid))),
        (_, 0, _) => parts.push("not readable".to_owned()),
        (valid, faulty, faults) => parts.push(format!(
            "{} in {faulty} of {}",
            counted(faults, "fault"),
            objects(valid + faulty)
        )),
    }
    if checked.others > 0 {
        parts.push(format!("{} of other kinds not checked", objects(checked.others)));
    }
    lines.push(format!("{file}: {}.", parts.join(", ")));
    lines
}

/// The schemas of both kinds, and what evaluates their rules.
struct Kinds {
    schemas: [(&'static str, Value); 2],
    rules: Validator,
}

impl Kinds {
    fn new() -> Result<Self, Error> {
        let schema = |derived| {
            let mut definition = served(derived).map_err(|error| Error::Malformed(error.to_string()))?;
            Ok::<_, Error>(definition["spec"]["versions"][0]["schema"]["openAPIV3Schema"].take())
        };
        Ok(Self {
            schemas: [
                ("Leaderboard", schema(&Leaderboard::crd())?),
                ("Submission", schema(&Submission::crd())?),
            ],
            rules: Validator::new(),
        })
    }

    /// All faults of a file in the order of their lines.
    fn findings(&self, text: &str) -> (Vec<Finding>, Checked) {
        let mut checked = Checked::default();
        if is_result(text) {
            let fault = evaluator_result::parse(text.as_bytes()).err();
            (checked.valid, checked.faulty) = (fault.is_none().into(), fault.is_some().into());
            let findings = fault.map(|fault| (1, format!("this is no result of an evaluator: {fault}")));
            return (findings.into_iter().collect(), checked);
        }
        let nodes = match manifest::parse(text) {
            Ok(nodes) => nodes,
            Err((line, why)) => {
                return (vec![(line, format!("this is no YAML: {why}"))], checked);
            }
        };
        let mut findings = Vec::new();
        for node in nodes {
            let Some(faults) = self.faults(node.value()) else {
                checked.others += 1;
                continue;
            };
            if faults.is_empty() {
                checked.valid += 1;
            } else {
                checked.faulty += 1;
            }
            let located = |fault: Fault| (node.line_of(&fault.path), sentence(&fault.text));
            findings.extend(faults.into_iter().map(located));
        }
        findings.sort_by_key(|(line, _)| *line);
        (findings, checked)
    }

    /// The faults of an object; none of one that another program defines.
    fn faults(&self, mut object: Value) -> Option<Vec<Fault>> {
        let (group, version) = object["apiVersion"].as_str().unwrap_or_default().split_once('/')?;
        if group != GROUP {
            return None;
        }
        let fault = |path: &str, text: String| Some(vec![Fault::at(path, text)]);
        if version != VERSION {
            return fault(
                "apiVersion",
                format!("apiVersion is {group}/{version}. This program knows {GROUP}/{VERSION}"),
            );
        }
        let kind = object["kind"].as_str().unwrap_or_default().to_owned();
        let Some((_, schema)) = self.schemas.iter().find(|(known, _)| *known == kind) else {
            let known = self.schemas.each_ref().map(|(known, _)| (*known).to_owned());
            let near = near::names(&kind, &known);
            let next = near.first().map_or_else(|| known.join(" or "), Clone::clone);
            return fault("kind", format!("{GROUP} has no kind {kind:?}. Did you mean {next}?"));
        };
        let mut faults: Vec<Fault> = name_fault(&object["metadata"]).into_iter().collect();
        // The API server leaves out a status that comes with a manifest.
        let (mut spec, metadata) = (object["spec"].take(), named(object["metadata"].take()));
        if spec.is_null() {
            faults.push(Fault::at("", "spec is missing".to_owned()));
            return Some(faults);
        }
        schema::check(&schema["properties"]["spec"], &mut spec, "spec", &mut faults);
        let whole = json!({"apiVersion": object["apiVersion"], "kind": kind, "metadata": metadata, "spec": spec});
        faults.extend(self.broken_rules(schema, &whole, faults.is_empty()));
        Some(faults)
    }

    /// The rules that an object breaks. Where the schema has faults already, a rule that cannot be evaluated is no fault of its own.
    fn broken_rules(&self, schema: &Value, object: &Value, has_schema: bool) -> Vec<Fault> {
        let broken = self.rules.validate(schema, object, None).err();
        let broken = broken.into_iter().flat_map(kube_cel::ValidationErrors::into_vec);
        let broken = broken.filter(|one| has_schema || one.kind == ErrorKind::ValidationFailure);
        broken
            .map(|one| Fault {
                text: format!("{}: {}", one.field_path, one.message)
                    .trim_start_matches(": ")
                    .to_owned(),
                path: one.field_path,
            })
            .collect()
    }
}

/// Whether a text is meant as an evaluator's result: it has fields of one, and no kind.
fn is_result(text: &str) -> bool {
    let parsed: Value = serde_json::from_str(text).unwrap_or_default();
    let has = |field: &str| !parsed[field].is_null();
    !has("kind") && ["schema", "done", "splits"].into_iter().any(has)
}

/// Metadata with a name: the API server makes one of its start before it looks at the rules.
fn named(mut metadata: Value) -> Value {
    if metadata.is_object() && metadata["name"].is_null() {
        let start = metadata["generateName"].as_str().unwrap_or_default();
        metadata["name"] = json!(format!("{start}xxxxx"));
    }
    metadata
}

/// An object has a name that the API server takes, or the start of one.
fn name_fault(metadata: &Value) -> Option<Fault> {
    let (name, start) = (metadata["name"].as_str(), metadata["generateName"].as_str());
    let (field, name) = match (name, start) {
        (Some(name), _) => ("name", name),
        (None, Some(start)) => ("generateName", start.trim_end_matches('-')),
        (None, None) => {
            return Some(Fault::at("metadata", "metadata.name is missing".to_owned()));
        }
    };
    let is_plain = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || "-.".contains(c);
    let is_end = |c: char| !"-.".contains(c);
    let is_well = name.len() <= 253 && name.chars().all(is_plain) && name.starts_with(is_end) && name.ends_with(is_end);
    (!is_well).then(|| {
        let text = format!(
            "metadata.{field} is {name:?}. It must be of small letters, digits, - and ., and begin and end with a letter or a digit"
        );
        Fault::at(&format!("metadata.{field}"), text)
    })
}
