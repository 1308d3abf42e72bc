//! The ResourceClaimTemplate of a Leaderboard whose workers claim their GPU: applied, never edited, and deleted when no Job needs it.
//!
//! Called by `tried_pods`. The deletion of a Leaderboard also deletes a template that it no longer claims.

use std::collections::BTreeSet;

use k8s_openapi::api::batch::v1::Job;
use kube::api::{DeleteParams, DynamicObject, ListParams, Patch, PatchParams};
use kube::core::Status;
use kube::{Api, Client, ResourceExt};

use crate::kubernetes::{CallError, call};
use crate::runtime::objects::uid_of;
use leaderboard_api::text::sentence;
use leaderboard_api::{ClaimOf, GpuSource, Leaderboard, names};
use leaderboard_pod_spec::gpu_claims::{resource, source, template};
use leaderboard_policy::leaderboards::view::Claims;

/// Puts the template in place, or looks for the host's. Never fails: what is wrong is shown.
pub async fn keep(client: &Client, leaderboard: &Leaderboard) -> Claims {
    let GpuSource::Claim(claim) = source(&leaderboard.spec) else {
        return Claims::NotRequired;
    };
    let templates = templates(client, leaderboard);
    let wrong = match claim {
        ClaimOf::Template(name) => {
            let found = call("the ResourceClaimTemplate", name, templates.get(name)).await;
            found.err().map(|error| fault(&error, absent(name, &error)))
        }
        ClaimOf::Devices { .. } => {
            let Some(template) = template(leaderboard) else {
                return Claims::NotRequired;
            };
            let name = template.name_any();
            let params = PatchParams::apply(names::MANAGER_CHILDREN).force();
            let patch = Patch::Apply(&template);
            let applied = templates.patch(&name, &params, &patch);
            let applied = call("the ResourceClaimTemplate", &name, applied).await;
            applied.err().map(|error| fault(&error, not_applied(&name, &error)))
        }
    };
    wrong.unwrap_or(Claims::InPlace)
}

fn templates(client: &Client, leaderboard: &Leaderboard) -> Api<DynamicObject> {
    let namespace = leaderboard.namespace().unwrap_or_default();
    Api::namespaced_with(client.clone(), &namespace, &resource())
}

fn fault(error: &CallError, why: String) -> Claims {
    // An answer about an object names it; one about the path does not.
    let names_none = |status: &Status| status.details.as_ref().is_none_or(|details| details.name.is_empty());
    match error.status() {
        Some(status) if status.code == 404 && names_none(status) => Claims::NotServed,
        _ => Claims::Missing(why),
    }
}

fn absent(name: &str, error: &CallError) -> String {
    if error.is_gone() {
        format!(
            "There is no ResourceClaimTemplate {name} in this namespace, which gpu.claim.resourceClaimTemplateName names. Apply it, or \
             correct the name."
        )
    } else {
        format!(
            "The ResourceClaimTemplate {name} could not be read: {}",
            sentence(&error.cause())
        )
    }
}

fn not_applied(name: &str, error: &CallError) -> String {
    let cause = sentence(&error.cause());
    let step = match error.status().map(|status| status.code) {
        Some(403) => {
            "Give the operator's role list, get, create, patch and delete of resourceclaimtemplates in this namespace."
        }
        _ => "Correct gpu.claim if it is the cause.",
    };
    format!("The ResourceClaimTemplate {name} could not be applied: {cause} {step}")
}

/// Deletes the Leaderboard's other templates that no Job needs any more. A Pod that replaces a lost one claims by the template of its
/// Job, so that Jobs count, and not Pods. Not to be called right after an edit: a Job of the spec before may be on its way.
///
/// # Errors
/// If the API server refuses a list or a deletion.
pub async fn remove_others(client: &Client, leaderboard: &Leaderboard) -> Result<(), CallError> {
    let current = template(leaderboard).map(|template| template.name_any());
    let name = leaderboard.name_any();
    let of_leaderboard = format!(
        "{}={},{}={name}",
        names::LABEL_MANAGED_BY,
        names::OPERATOR,
        names::LABEL_LEADERBOARD
    );
    let params = ListParams::default().labels(&of_leaderboard);
    let templates = templates(client, leaderboard);
    let found = call("the ResourceClaimTemplates", &name, templates.list_metadata(&params)).await?;
    let uid = uid_of(leaderboard);
    let mut others = found.items;
    others.retain(|template| {
        let is_ours = template.owner_references().iter().any(|owner| owner.uid == uid);
        is_ours && Some(template.name_any()) != current
    });
    if others.is_empty() {
        return Ok(());
    }
    let jobs: Api<Job> = Api::namespaced(client.clone(), &leaderboard.namespace().unwrap_or_default());
    let jobs = call("the Jobs", &name, jobs.list(&params)).await?;
    let needed: BTreeSet<&str> = jobs
        .items
        .iter()
        .filter(|job| !has_ended(job))
        .flat_map(named)
        .collect();
    let old = others.iter().map(ResourceExt::name_any);
    for old in old.filter(|old| !needed.contains(old.as_str())) {
        let params = DeleteParams::default();
        let deleted = templates.delete(&old, &params);
        match call("deleting the ResourceClaimTemplate", &old, deleted).await {
            Err(error) if !error.is_gone() => return Err(error),
            _ => tracing::info!(
                leaderboard = name,
                template = old,
                "an old ResourceClaimTemplate is removed"
            ),
        }
    }
    Ok(())
}

fn has_ended(job: &Job) -> bool {
    let conditions = job
        .status
        .iter()
        .filter_map(|status| status.conditions.as_ref())
        .flatten();
    let mut ends = conditions.filter(|condition| ["Complete", "Failed"].contains(&condition.type_.as_str()));
    ends.any(|condition| condition.status == "True")
}

fn named(job: &Job) -> impl Iterator<Item = &str> {
    let pod = job.spec.as_ref().and_then(|spec| spec.template.spec.as_ref());
    let claims = pod.and_then(|pod| pod.resource_claims.as_ref()).into_iter().flatten();
    claims.filter_map(|claim| claim.resource_claim_template_name.as_deref())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refused(code: u16, message: &str, name: Option<&str>) -> CallError {
        let mut status = Status::failure(message, "NotFound").with_code(code);
        if let Some(name) = name {
            let details = serde_json::json!({ "name": name });
            status = status.with_details(serde_json::from_value(details).unwrap());
        }
        CallError::Refused {
            what: "the ResourceClaimTemplate",
            object: "t".into(),
            source: Box::new(kube::Error::Api(Box::new(status))),
        }
    }

    #[test]
    fn an_api_server_without_claims_is_no_missing_template() {
        let page = || refused(404, "404 page not found", None);
        let resource = || refused(404, "the server could not find the requested resource", Some(""));
        for error in [page(), resource()] {
            assert_eq!(fault(&error, absent("t", &error)), Claims::NotServed);
            assert_eq!(fault(&error, not_applied("t", &error)), Claims::NotServed);
        }
        let missing = refused(404, "resourceclaimtemplates.resource.k8s.io \"t\" not found", Some("t"));
        let why = absent("t", &missing);
        assert_eq!(fault(&missing, why.clone()), Claims::Missing(why.clone()));
        assert!(
            why.starts_with("There is no ResourceClaimTemplate t in this namespace"),
            "{why}"
        );
        let namespace = refused(404, "namespaces \"gone\" not found", Some("gone"));
        assert!(matches!(fault(&namespace, String::new()), Claims::Missing(_)));
        let forbidden = refused(403, "no", Some("t"));
        let why = not_applied("t", &forbidden);
        assert_eq!(fault(&forbidden, why.clone()), Claims::Missing(why.clone()));
        assert!(why.contains("Give the operator's role list, get"), "{why}");
    }

    #[test]
    fn jobs_that_have_not_ended_need_their_templates() {
        let job = |conditions: serde_json::Value| -> Job {
            let claims = serde_json::json!([{"name": "gpu-1", "resourceClaimTemplateName": "t"}]);
            let template = serde_json::json!({"spec": {"containers": [], "resourceClaims": claims}});
            serde_json::from_value(serde_json::json!({
                "metadata": {"name": "j"}, "spec": {"template": template}, "status": {"conditions": conditions},
            }))
            .unwrap()
        };
        let condition = |type_: &str, status: &str| serde_json::json!([{"type": type_, "status": status}]);
        for (conditions, ended) in [
            (serde_json::json!([]), false),
            (condition("Suspended", "True"), false),
            (condition("Failed", "False"), false),
            (condition("Failed", "True"), true),
            (condition("Complete", "True"), true),
        ] {
            let job = job(conditions.clone());
            assert_eq!(has_ended(&job), ended, "{conditions}");
            assert_eq!(named(&job).collect::<Vec<_>>(), ["t"]);
        }
    }
}
