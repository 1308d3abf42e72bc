//! Which images may be submitted: patterns of registries and repositories, with a place for the team.
//!
//! Pure. A pattern refuses every image that it does not name, so a spelling that is not understood here is never let in.

use std::borrow::Cow;

use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::{Deserialize, Serialize};

use super::image::ImageReference;

/// The repositories that EvalAI makes for participants, one for each team and challenge.
pub const OF_EVALAI: &str = "*.dkr.ecr.*.amazonaws.com/*-participant-team-{team}";
/// Where the id of the submission's team stands in a pattern.
const TEAM: &str = "{team}";
/// The registry of an image that names none, and the folder of its images that name none.
const DEFAULT_REGISTRY: &str = "docker.io";
const DEFAULT_FOLDER: &str = "library/";
/// Other names of that registry.
const ALIASES: [&str; 2] = ["index.docker.io", "registry-1.docker.io"];
const PATTERN: &str = r"^[a-z0-9*]([a-z0-9.*-]*[a-z0-9*])?(:[0-9]{1,5})?(/([a-z0-9._*-]|[{]team[}])+)+$";

/// One pattern, such as `registry.example/team-{team}/*`: a registry and a repository, without tag and digest. `*` stands for one
/// or more characters between two slashes, in the registry between two dots.
#[derive(Serialize, Deserialize, Clone, Debug, PartialEq, Eq)]
#[serde(transparent)]
pub struct ImagePattern(pub String);

impl JsonSchema for ImagePattern {
    fn schema_name() -> Cow<'static, str> {
        "ImagePattern".into()
    }

    fn inline_schema() -> bool {
        true
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        json_schema!({ "type": "string", "maxLength": 256, "pattern": PATTERN })
    }
}

/// A repository with its registry, in one spelling: two references of one image are compared by it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Repository<'a> {
    /// Host and port, as written; the usual one where none is.
    pub registry: &'a str,
    pub path: Cow<'a, str>,
}

impl<'a> Repository<'a> {
    /// Where an image is pulled from.
    pub fn of(image: &ImageReference<'a>) -> Self {
        let registry = image.registry.unwrap_or(DEFAULT_REGISTRY);
        let registry = if ALIASES.contains(&registry) {
            DEFAULT_REGISTRY
        } else {
            registry
        };
        let is_bare = registry == DEFAULT_REGISTRY && !image.repository.contains('/');
        let path = if is_bare {
            format!("{DEFAULT_FOLDER}{}", image.repository).into()
        } else {
            image.repository.into()
        };
        Self { registry, path }
    }

    /// True if both are one place. Capitals in the host and the default port `:443` make no difference.
    pub fn is_same(&self, other: &Self) -> bool {
        let host = |registry: &str| {
            let registry = registry.to_ascii_lowercase();
            registry.strip_suffix(":443").unwrap_or(&registry).to_owned()
        };
        self.path == other.path && host(self.registry) == host(other.registry)
    }
}

impl ImagePattern {
    /// True if the pattern lets in the images of this repository, for a team of this id.
    pub fn allows(&self, repository: &Repository<'_>, team: Option<&str>) -> bool {
        let Some((registry, path)) = self.0.split_once('/') else {
            return false;
        };
        has_registry(registry, repository.registry) && has_path(path, &repository.path, team)
    }
}

fn has_registry(pattern: &str, registry: &str) -> bool {
    let port = |text: &str| text.split_once(':').map(|(_, port)| port.to_owned());
    let host = |text: &str| text.split_once(':').map_or(text, |(host, _)| host).to_owned();
    port(pattern) == port(registry) && have_parts(&host(pattern), &host(registry), '.', None)
}

fn has_path(pattern: &str, path: &str, team: Option<&str>) -> bool {
    if pattern.contains(TEAM) && !team.is_some_and(is_id) {
        return false;
    }
    have_parts(pattern, path, '/', team)
}

/// An id that can be part of a repository's name without changing where its parts begin.
fn is_id(team: &str) -> bool {
    !team.is_empty() && team.bytes().all(|b| b.is_ascii_lowercase() || b.is_ascii_digit())
}

fn have_parts(pattern: &str, text: &str, separator: char, team: Option<&str>) -> bool {
    let (patterns, texts) = (pattern.split(separator), text.split(separator));
    patterns.clone().count() == texts.clone().count()
        && patterns.zip(texts).all(|(pattern, text)| {
            let pattern = team.map_or_else(|| pattern.to_owned(), |team| pattern.replace(TEAM, team));
            is_like(pattern.as_bytes(), text.as_bytes())
        })
}

/// True if a text matches a pattern in which `*` stands for at least one character. It takes no more steps than the product of
/// both lengths, because a participant wrote the text.
fn is_like(pattern: &[u8], text: &[u8]) -> bool {
    // Which beginnings of the pattern the text so far is like.
    let mut reached = vec![false; pattern.len() + 1];
    reached[0] = true;
    for byte in text {
        let mut next = vec![false; pattern.len() + 1];
        for (at, wanted) in pattern.iter().enumerate() {
            let is_met = *wanted == b'*' || wanted == byte;
            let stays = *wanted == b'*' && reached[at + 1];
            next[at + 1] = is_met && (reached[at] || stays);
        }
        reached = next;
    }
    reached[pattern.len()]
}

#[cfg(test)]
mod tests;
