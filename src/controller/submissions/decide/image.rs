//! Which images run: the Leaderboard's patterns decide before a Job is made, and the first agent that starts pins the digest.

use super::failure::charged;
use super::status::PlanBuilder;
use crate::controller::submissions::view::{ContainerView, PodView};
use leaderboard_api::{
    Failure, ImagePattern, ImageReference, LeaderboardSpec, PinnedImage, Repository, SubmissionStatus, image_pattern,
    names, reasons,
};

/// Why the Leaderboard does not allow the image.
pub(super) fn not_allowed(draft: &PlanBuilder<'_>, leaderboard: &LeaderboardSpec, image: &str) -> Option<Failure> {
    let reference = ImageReference::parse(image).ok().filter(|_| !draft.status.has_run())?;
    let repository = Repository::of(&reference);
    let own = leaderboard.host_images();
    let is_hosts = own
        .into_iter()
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

/// Takes the digest that the first agent runs, wherever its tag moves later.
pub(super) fn pin_digest(draft: &mut PlanBuilder<'_>, pod: &PodView) {
    if draft.status.image.is_none() {
        let first = digests(&draft.status, pod).first().map(|digest| (*digest).to_owned());
        draft.status.image = first.map(|digest| PinnedImage { digest });
    }
}

/// Agents of one Pod run different images: their tag moved between two pulls.
pub(super) fn changed(draft: &PlanBuilder<'_>) -> Option<Failure> {
    let found = digests(&draft.status, draft.view.pod.as_ref()?);
    let is_one = found.windows(2).all(|pair| pair[0] == pair[1]);
    let what = "The tag of the submitted image moved while the run started, so its agents would run different images.";
    (!is_one).then(|| charged(reasons::IMAGE_CHANGED, what))
}

/// The digests of the submitted image that a Pod's agents run. A node may show an image under the name of another repository that has
/// the same content; such a digest proves nothing of this repository.
fn digests<'a>(status: &SubmissionStatus, pod: &'a PodView) -> Vec<&'a str> {
    let submitted = status.plan.as_ref().map(|plan| ImageReference::parse(&plan.image));
    let Some(Ok(submitted)) = submitted else {
        return Vec::new();
    };
    let repository = Repository::of(&submitted);
    let digest = |agent: &'a ContainerView| {
        let image = ImageReference::parse(agent.image_id.as_deref()?).ok()?;
        let is_submitted = Repository::of(&image).is_same(&repository);
        image
            .digest
            .filter(|digest| is_submitted && digest.starts_with("sha256:"))
    };
    let agents = pod
        .containers
        .iter()
        .filter(|container| names::is_agent_container(&container.name));
    agents.filter_map(digest).collect()
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
