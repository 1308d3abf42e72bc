//! Which images may run: the Leaderboard's patterns, and what the registry reports of size, platform and volumes. Pins the digest.

use std::time::Duration;

use serde_json::Value;

use super::failure::{charged, infrastructure};
use super::plan::Action;
use super::plan_builder::PlanBuilder;
use crate::controller::submissions::images::Question;
use crate::controller::submissions::view::ObservedImage;
use crate::services::registry::{Facts, Fault, Image};
use leaderboard_api::conditions::{self, Truth};
use leaderboard_api::text::{one_line, sentence};
use leaderboard_api::{
    Failure, ImagePattern, ImageReference, LeaderboardSpec, PinnedImage, Repository, image_pattern, reasons,
};

/// When it is looked again, should an answer not come.
const RETRY: Duration = Duration::from_secs(30);
/// Most of a host's own words about a registry.
const LONGEST_WHY: usize = 200;

/// Whether the image may run.
pub(super) enum Step {
    /// It may, and this is shown of it where it was not checked.
    Go(Option<String>),
    Wait,
    Refuse(Failure),
}

/// Why the Leaderboard does not allow the image. No registry is needed for that.
pub(super) fn not_allowed(draft: &PlanBuilder<'_>, leaderboard: &LeaderboardSpec, image: &str) -> Option<Failure> {
    let reference = ImageReference::parse(image).ok().filter(|_| !draft.status.has_run())?;
    let repository = Repository::of(&reference);
    let own = [&leaderboard.contents.image, &leaderboard.simulator.image];
    let is_hosts = own
        .iter()
        .any(|own| ImageReference::parse(own).is_ok_and(|own| Repository::of(&own).is_same(&repository)));
    let team = draft.status.team.as_ref().and_then(|team| team.id.as_deref());
    let patterns = patterns(draft, leaderboard);
    let is_allowed = patterns
        .as_ref()
        .is_none_or(|all| all.iter().any(|p| p.allows(&repository, team)))
        || is_check_image(draft, leaderboard, &repository);
    if is_allowed && !is_hosts {
        return None;
    }
    let what = "The submitted image is not one that your team may submit to this leaderboard.";
    Some(charged(reasons::IMAGE_NOT_ALLOWED, what))
}

/// Whether a check runs what its Leaderboard names for that.
fn is_check_image(draft: &PlanBuilder<'_>, leaderboard: &LeaderboardSpec, repository: &Repository<'_>) -> bool {
    let named = leaderboard.check.as_ref().filter(|_| draft.spec().check);
    let named = named.and_then(|check| ImageReference::parse(&check.image).ok());
    named.is_some_and(|named| Repository::of(&named).is_same(repository))
}

/// What may be submitted; none: everything.
fn patterns(draft: &PlanBuilder<'_>, leaderboard: &LeaderboardSpec) -> Option<Vec<ImagePattern>> {
    match &leaderboard.agent.images {
        Some(images) if images.is_empty() => None,
        Some(images) => Some(images.clone()),
        None => {
            let of_evalai = || vec![ImagePattern(image_pattern::OF_EVALAI.to_owned())];
            draft.spec().evalai.is_some().then(of_evalai)
        }
    }
}

/// Whether the image may run by what its registry reports. The registry is asked once, before the first Job of an attempt.
pub(super) fn decide(draft: &mut PlanBuilder<'_>, leaderboard: &LeaderboardSpec, image: &str) -> Step {
    let known = draft
        .status
        .condition(conditions::ACCEPTED)
        .filter(|c| c.status == "True");
    if let Some(known) = known {
        let note = (known.reason == reasons::IMAGE_NOT_PINNED).then(|| known.message.to_string());
        return Step::Go(note);
    }
    let has_run = draft.status.image.is_some() || draft.status.has_run();
    let patterns = patterns(draft, leaderboard).filter(|_| !has_run);
    let (Some(patterns), Ok(reference)) = (patterns, ImageReference::parse(image)) else {
        return Step::Go(None);
    };
    let answer = match &draft.view.image {
        ObservedImage::Answered(answer) => answer.as_ref().clone(),
        ObservedImage::NotAsked => return ask(draft, leaderboard, &patterns, &reference, Duration::ZERO),
        ObservedImage::Asked(waited) => return ask(draft, leaderboard, &patterns, &reference, *waited),
    };
    match answer {
        Ok(facts) => found(draft, leaderboard, facts),
        Err(fault) => of_fault(fault),
    }
}

fn ask(
    draft: &mut PlanBuilder<'_>,
    leaderboard: &LeaderboardSpec,
    patterns: &[ImagePattern],
    reference: &ImageReference<'_>,
    waited: Duration,
) -> Step {
    let repository = Repository::of(reference);
    let named = reference.digest.or(reference.tag).unwrap_or("latest");
    let question = Question {
        attempt: draft.status.attempt.unwrap_or_default(),
        image: Image {
            registry: repository.registry.to_owned(),
            path: repository.path.clone().into_owned(),
            reference: named.to_owned(),
            may_be_local: patterns
                .iter()
                .any(|pattern| pattern.names_registry(repository.registry))
                || is_check_image(draft, leaderboard, &repository),
        },
        secrets: pull_secrets(leaderboard),
    };
    draft.act(Action::LookUpImage(question));
    if draft.waits_quietly(waited) {
        return Step::Wait;
    }
    draft.requeue_in(RETRY);
    let message = "The image's registry is asked for its digest and size.";
    draft.condition(conditions::ACCEPTED, Truth::Unknown, reasons::CHECKING_IMAGE, "");
    draft.show(reasons::CHECKING_IMAGE, message);
    Step::Wait
}

/// The Secrets that the Pods pull with, by the host's overrides.
fn pull_secrets(leaderboard: &LeaderboardSpec) -> Vec<String> {
    let overrides = leaderboard.pod_overrides.as_ref();
    let secrets = overrides.and_then(|pod| pod.pointer("/spec/imagePullSecrets")?.as_array());
    let name = |secret: &Value| secret.get("name")?.as_str().map(str::to_owned);
    secrets
        .map(|all| all.iter().filter_map(name).collect())
        .unwrap_or_default()
}

fn found(draft: &mut PlanBuilder<'_>, leaderboard: &LeaderboardSpec, facts: Facts) -> Step {
    let limit = &leaderboard.agent.image_size_limit;
    if facts.bytes > limit.bytes() {
        let what = format!(
            "The submitted image has {} MiB of compressed layers; {} MiB are allowed.",
            facts.bytes >> 20,
            limit.bytes() >> 20
        );
        return Step::Refuse(charged(reasons::IMAGE_TOO_LARGE, &what));
    }
    if facts.has_volumes {
        let what = "The submitted image declares volumes, which is not allowed.";
        return Step::Refuse(charged(reasons::IMAGE_VOLUMES, what));
    }
    draft.status.image = Some(PinnedImage { digest: facts.digest });
    Step::Go(None)
}

fn of_fault(fault: Fault) -> Step {
    let refused = |reason: &str, what: &str| Step::Refuse(charged(reason, what));
    match fault {
        Fault::NotFound => refused(reasons::IMAGE_NOT_FOUND, "The submitted image is not in its registry."),
        Fault::OtherPlatform => refused(reasons::IMAGE_PLATFORM, "The submitted image is not for linux/amd64."),
        Fault::NotAnImage(why) => {
            let what = format!("The submitted image cannot be used: {why}.");
            refused(reasons::IMAGE_INVALID, &what)
        }
        Fault::Denied => {
            let what = "The registry refuses the submitted image to the operator.";
            Step::Refuse(infrastructure(reasons::IMAGE_DENIED, what))
        }
        Fault::Unreachable(why) | Fault::Unusable(why) => {
            let why = sentence(&one_line(&why, LONGEST_WHY));
            Step::Go(Some(format!(
                "The image's registry could not be asked: {why} The image was not checked, and is run by its tag."
            )))
        }
    }
}

/// The image as the Pods of the submission pull it.
pub(crate) fn pinned(image: &str, pinned: Option<&PinnedImage>) -> String {
    let Some(pinned) = pinned else {
        return image.to_owned();
    };
    let name = image.split('@').next().unwrap_or(image);
    let tag = ImageReference::parse(image).ok().and_then(|reference| reference.tag);
    let name = tag
        .and_then(|tag| name.strip_suffix(tag)?.strip_suffix(':'))
        .unwrap_or(name);
    format!("{name}@{}", pinned.digest)
}
