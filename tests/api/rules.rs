//! Each rule of the definitions is refused by the API server where it should be, has a case that shows it, and is cheap.

use k8s_openapi::apiextensions_apiserver::pkg::apis::apiextensions::v1::CustomResourceDefinition;
use kube::api::{Api, Patch, PatchParams, PostParams};
use kube_cel::{ScopeContext, WarningKind, analyze_rule, compile_schema};
use leaderboard_operator::crds;
use serde_json::{Value, json};

use super::objects::{Kind, causes, create};
use super::rule_cases::{self, Case, Step};
use crate::support::apiserver::server;

const SCHEMA: &str = "/spec/versions/0/schema/openAPIV3Schema";
/// Each rule must cost less than the API server's limit of one rule divided by this.
const PART: usize = 10;

/// A rule and where it stands.
struct Rule {
    kind: &'static str,
    path: String,
    text: String,
    message: String,
    /// The schema it stands on.
    schema: Value,
}

fn rules() -> Vec<Rule> {
    let mut found = Vec::new();
    for definition in crds::definitions().unwrap() {
        let schema = definition.json().pointer(SCHEMA).unwrap();
        collect(definition.kind, "", schema, &mut found);
    }
    found
}

fn collect(kind: &'static str, path: &str, schema: &Value, found: &mut Vec<Rule>) {
    for rule in schema["x-kubernetes-validations"].as_array().into_iter().flatten() {
        found.push(Rule {
            kind,
            path: path.to_owned(),
            text: rule["rule"].as_str().unwrap().to_owned(),
            message: rule["message"].as_str().unwrap_or_default().to_owned(),
            schema: schema.clone(),
        });
    }
    for (name, inner) in schema["properties"].as_object().into_iter().flatten() {
        collect(kind, &format!("{path}.{name}"), inner, found);
    }
    for (key, mark) in [("items", "[]"), ("additionalProperties", "{}")] {
        if schema[key].is_object() {
            collect(kind, &format!("{path}{mark}"), &schema[key], found);
        }
    }
}

#[test]
fn every_rule_has_a_case_and_every_case_a_rule() {
    let (rules, cases) = (rules(), rule_cases::all());
    let of = |rule: &Rule, case: &Case| rule.kind == case.kind.name() && rule.message.contains(case.message);
    let bare: Vec<String> = rules
        .iter()
        .filter(|rule| !cases.iter().any(|case| of(rule, case)))
        .map(|rule| format!("{}{}: {}", rule.kind, rule.path, rule.text))
        .collect();
    assert!(
        bare.is_empty(),
        "rules without a case in tests/api/rule_cases.rs:\n{}",
        bare.join("\n")
    );
    for case in &cases {
        let meant = rules.iter().filter(|rule| of(rule, case)).count();
        assert_eq!(
            meant,
            1,
            "{meant} rules of a {} say {:?}",
            case.kind.name(),
            case.message
        );
    }
    println!("{} rules, {} cases", rules.len(), cases.len());
    assert!(rules.len() >= 40, "the walk found only {} rules", rules.len());
}

#[test]
fn every_rule_compiles_is_in_scope_and_is_estimated_below_a_tenth_of_the_limit() {
    for rule in rules() {
        let schema = compile_schema(&rule.schema);
        let place = format!("{}{}: {}", rule.kind, rule.path, rule.text);
        let errors: Vec<String> = schema
            .compilation_errors()
            .iter()
            .map(|error| format!("{error:?}"))
            .collect();
        assert!(errors.is_empty(), "{place}: {errors:?}");
        // The analysis' own limit is 1,000,000, a tenth of the API server's.
        for warning in analyze_rule(&rule.text, &schema, ScopeContext::CrdValidation) {
            let of_a_macro = warning.kind == WarningKind::WrongScope && macro_variables(&rule.text, &warning.message);
            assert!(of_a_macro, "{place}: {}", warning.message);
        }
    }
}

/// True for a false warning: the analysis takes the variable of `all(t, …)` for one without a value.
fn macro_variables(rule: &str, warning: &str) -> bool {
    let name = warning.split('\'').nth(1).unwrap_or_default();
    !name.is_empty() && rule.contains(&format!("({name}, "))
}

#[tokio::test]
async fn the_api_server_would_take_ten_times_the_cost_of_every_rule() {
    let api: Api<CustomResourceDefinition> = Api::all(server().await.client());
    for definition in crds::definitions().unwrap() {
        let tenfold = under_another_group(definition.json(), |schema| repeat_rules(schema, PART));
        dry_run(&api, tenfold)
            .await
            .unwrap_or_else(|error| panic!("{}: {:?}", definition.kind, causes(&error)));
    }
}

#[tokio::test]
async fn the_api_server_refuses_a_rule_that_walks_a_list_without_an_end() {
    let api: Api<CustomResourceDefinition> = Api::all(server().await.client());
    let [leaderboards, _] = crds::definitions().unwrap();
    let endless = under_another_group(leaderboards.json(), |schema| {
        let tracks = schema.pointer_mut("/properties/spec/properties/tracks").unwrap();
        tracks.as_object_mut().unwrap().remove("maxItems").unwrap();
    });
    let causes = causes(&dry_run(&api, endless).await.unwrap_err());
    assert!(
        causes.iter().any(|cause| cause.contains("estimated rule cost")),
        "{causes:?}"
    );
}

async fn dry_run(api: &Api<CustomResourceDefinition>, definition: Value) -> kube::Result<()> {
    let params = PostParams {
        dry_run: true,
        ..PostParams::default()
    };
    let definition = serde_json::from_value(definition).unwrap();
    api.create(&params, &definition).await.map(drop)
}

/// The definition under a group that is not served, as if it came new.
fn under_another_group(definition: &Value, change: impl FnOnce(&mut Value)) -> Value {
    let mut copy = definition.clone();
    let name = copy["spec"]["names"]["plural"].as_str().unwrap();
    copy["metadata"]["name"] = json!(format!("{name}.cost.example.org"));
    copy["spec"]["group"] = json!("cost.example.org");
    change(copy.pointer_mut(SCHEMA).unwrap());
    copy
}

fn repeat_rules(schema: &mut Value, times: usize) {
    match schema {
        Value::Object(object) => {
            if let Some(rules) = object.get_mut("x-kubernetes-validations").and_then(Value::as_array_mut) {
                for rule in rules {
                    let once = format!("({})", rule["rule"].as_str().unwrap());
                    rule["rule"] = json!(vec![once; times].join(" && "));
                }
            }
            object.values_mut().for_each(|inner| repeat_rules(inner, times));
        }
        Value::Array(list) => list.iter_mut().for_each(|inner| repeat_rules(inner, times)),
        _ => {}
    }
}

#[tokio::test]
async fn the_api_server_refuses_each_mistake_with_its_message_and_nothing_else() {
    let server = server().await;
    let (client, namespace) = (server.client(), server.namespace("rules").await);
    let mut wrong = Vec::new();
    for (number, case) in rule_cases::all().iter().enumerate() {
        let api = case.kind.api(&client, &namespace);
        // A name that a check may have, too.
        if let Err(why) = try_case(&api, case, &format!("check-case-{number}")).await {
            wrong.push(format!("{} {:?}: {why}", case.kind.name(), case.message));
        }
    }
    assert!(wrong.is_empty(), "{} cases:\n{}", wrong.len(), wrong.join("\n"));
}

async fn try_case(api: &Api<kube::core::DynamicObject>, case: &Case, name: &str) -> Result<(), String> {
    let show = |what: &str, error: &kube::Error| format!("{what}: {:?}", causes(error));
    match &case.step {
        Step::Create { good, bad } => {
            let object = case.kind.object(name, &[good]);
            create(api, object, true)
                .await
                .map_err(|error| show("the good one is refused", &error))?;
            let object = case.kind.object(name, &[good, bad]);
            refused(case, create(api, object, true).await.map(drop))
        }
        Step::Update {
            from,
            end: reason,
            bad,
            good,
        } => {
            let object = case.kind.object(name, &[from]);
            create(api, object, false)
                .await
                .map_err(|error| show("the first one is refused", &error))?;
            let params = PatchParams::default();
            if let Some(reason) = reason {
                let end = json!({"type": "Finished", "status": "True", "reason": reason, "message": "",
                                 "lastTransitionTime": "2026-01-01T00:00:00Z"});
                let truth = if *reason == "Finished" { "True" } else { "False" };
                let mut succeeded = end.clone();
                (succeeded["type"], succeeded["status"]) = (json!("Succeeded"), json!(truth));
                let status = Patch::Merge(json!({"status": {"conditions": [end, succeeded]}}));
                let set = api.patch_status(name, &params, &status).await;
                set.map_err(|error| show("the end is refused", &error))?;
            }
            refused(case, api.patch(name, &params, &Patch::Merge(bad)).await.map(drop))?;
            let allowed = api.patch(name, &params, &Patch::Merge(good)).await;
            allowed
                .map(drop)
                .map_err(|error| show("the good change is refused", &error))
        }
    }
}

fn refused(case: &Case, answer: kube::Result<()>) -> Result<(), String> {
    let Err(error) = answer else {
        return Err("the mistake is accepted".into());
    };
    let causes = causes(&error);
    match causes.as_slice() {
        [only] if only.contains(case.message) => Ok(()),
        other => Err(format!("refused for {other:?}")),
    }
}

#[test]
fn kinds_are_those_of_the_definitions() {
    let kinds: Vec<&str> = crds::definitions()
        .unwrap()
        .iter()
        .map(|definition| definition.kind)
        .collect();
    assert_eq!(kinds, [Kind::Leaderboard.name(), Kind::Submission.name()]);
}
