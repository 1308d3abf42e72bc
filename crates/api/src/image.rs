//! References to container images, by the grammar that registries and the kubelet share (`distribution/reference`).
//!
//! Pure. A reference that is refused here can never be pulled. The image of one that is taken may still not exist.

/// Longest reference that a Submission may hold, in characters.
pub const LONGEST: usize = 512;
/// Longest repository, without its registry.
const LONGEST_REPOSITORY: usize = 255;
/// Longest tag.
const LONGEST_TAG: usize = 128;

/// The parts of a reference: `registry/repository:tag@digest`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ImageReference<'a> {
    /// Host and port; none is the default of the node.
    pub registry: Option<&'a str>,
    pub repository: &'a str,
    pub tag: Option<&'a str>,
    pub digest: Option<&'a str>,
}

/// Why a text is no reference to an image.
#[derive(thiserror::Error, Clone, Debug, PartialEq, Eq)]
pub enum NotAnImage {
    #[error("it is empty")]
    Empty,
    #[error("it has more than {LONGEST} characters")]
    TooLong,
    #[error("it has white space or characters that are not ASCII")]
    Characters,
    #[error("it is an image ID; use the name and tag that were pushed")]
    Id,
    #[error("{0} is not a registry host; write no https://")]
    Registry(String),
    #[error("the repository {0} has upper-case letters")]
    UpperCase(String),
    #[error("invalid repository name {0:?}")]
    Repository(String),
    #[error("invalid tag {0:?}")]
    Tag(String),
    #[error("invalid digest {0:?}")]
    Digest(String),
}

impl<'a> ImageReference<'a> {
    /// Reads a reference.
    pub fn parse(text: &'a str) -> Result<Self, NotAnImage> {
        if text.is_empty() {
            return Err(NotAnImage::Empty);
        }
        if text.chars().count() > LONGEST {
            return Err(NotAnImage::TooLong);
        }
        if !text.bytes().all(|byte| byte.is_ascii_graphic()) {
            return Err(NotAnImage::Characters);
        }
        if text.len() == 64 && text.bytes().all(is_hex) {
            return Err(NotAnImage::Id);
        }
        let (name, digest) = split(text, text.find('@'));
        // Before the last slash a colon belongs to the port.
        let last = name.rfind('/').map_or(0, |slash| slash + 1);
        let (name, tag) = split(name, name[last..].find(':').map(|colon| last + colon));
        let (registry, repository) = match name.split_once('/') {
            Some((first, rest)) if is_host(first) => (Some(first), rest),
            _ => (None, name),
        };
        let found = Self {
            registry,
            repository,
            tag,
            digest,
        };
        found.check().map(|()| found)
    }

    fn check(&self) -> Result<(), NotAnImage> {
        if let Some(registry) = self.registry.filter(|text| !is_registry(text)) {
            return Err(NotAnImage::Registry(registry.to_owned()));
        }
        if !is_repository(self.repository) {
            let name = self.repository.to_owned();
            let is_case = is_repository(&name.to_ascii_lowercase());
            return Err(if is_case {
                NotAnImage::UpperCase(name)
            } else {
                NotAnImage::Repository(name)
            });
        }
        if let Some(tag) = self.tag.filter(|text| !is_tag(text)) {
            return Err(NotAnImage::Tag(tag.to_owned()));
        }
        if let Some(digest) = self.digest.filter(|text| !is_digest(text)) {
            return Err(NotAnImage::Digest(digest.to_owned()));
        }
        Ok(())
    }
}

/// The text before a separator of one byte and the text after it.
fn split(text: &str, at: Option<usize>) -> (&str, Option<&str>) {
    at.map_or((text, None), |at| (&text[..at], Some(&text[at + 1..])))
}

/// True if the first component of a name is a registry. Otherwise it is part of the repository.
fn is_host(first: &str) -> bool {
    first.contains(['.', ':']) || first == "localhost" || first.bytes().any(|byte| byte.is_ascii_uppercase())
}

fn is_registry(text: &str) -> bool {
    let end = text.find(']').map_or(0, |bracket| bracket + 1);
    let (host, port) = split(text, text[end..].find(':').map(|colon| end + colon));
    let is_port = port.is_none_or(|port| !port.is_empty() && port.bytes().all(|byte| byte.is_ascii_digit()));
    let address = host.strip_prefix('[').and_then(|host| host.strip_suffix(']'));
    let is_label = |label: &str| {
        let is_inner = label.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'-');
        !label.is_empty() && is_inner && !label.starts_with('-') && !label.ends_with('-')
    };
    is_port
        && match address {
            Some(address) => {
                !address.is_empty()
                    && address
                        .bytes()
                        .all(|byte| is_hex(byte.to_ascii_lowercase()) || byte == b':')
            }
            None => host.split('.').all(is_label),
        }
}

fn is_repository(text: &str) -> bool {
    text.len() <= LONGEST_REPOSITORY && text.split('/').all(is_component)
}

/// Lower-case letters and digits, parted by a dot, one or two underscores, or any number of hyphens.
fn is_component(text: &str) -> bool {
    let is_word = |byte: u8| byte.is_ascii_lowercase() || byte.is_ascii_digit();
    let has_ends = text.bytes().next().is_some_and(is_word) && text.bytes().next_back().is_some_and(is_word);
    let separators = text.split(|c: char| c.is_ascii_lowercase() || c.is_ascii_digit());
    let is_separator = |text: &str| matches!(text, "" | "." | "_" | "__") || text.bytes().all(|byte| byte == b'-');
    has_ends && separators.into_iter().all(is_separator)
}

fn is_tag(text: &str) -> bool {
    let is_word = |byte: u8| byte.is_ascii_alphanumeric() || byte == b'_';
    let starts = text.bytes().next().is_some_and(is_word);
    starts && text.len() <= LONGEST_TAG && text.bytes().all(|byte| is_word(byte) || byte == b'.' || byte == b'-')
}

fn is_digest(text: &str) -> bool {
    let length = match text.split_once(':') {
        Some(("sha256", _)) => 64,
        Some(("sha384", _)) => 96,
        Some(("sha512", _)) => 128,
        _ => return false,
    };
    text.split_once(':')
        .is_some_and(|(_, hex)| hex.len() == length && hex.bytes().all(is_hex))
}

fn is_hex(byte: u8) -> bool {
    byte.is_ascii_digit() || (b'a'..=b'f').contains(&byte)
}

#[cfg(test)]
mod tests {
    use super::*;

    const SHA: &str = "sha256:0123456789abcdef0123456789abcdef0123456789abcdef0123456789abcdef";

    #[test]
    fn what_can_be_pulled_is_taken_apart() {
        let ecr = "123456789012.dkr.ecr.us-east-1.amazonaws.com";
        let pinned = format!("ghcr.io/a/b:1@{SHA}");
        let by_digest = format!("agent@{SHA}");
        let team = format!("{ecr}/carla-participant-team-7:0a1b2c3d-0000-4444-8888-1234567890ab");
        for (text, registry, repository, tag, digest) in [
            ("agent", None, "agent", None, None),
            ("agent:1", None, "agent", Some("1"), None),
            ("localhost:5000", None, "localhost", Some("5000"), None),
            ("localhost/agent", Some("localhost"), "agent", None, None),
            ("localhost:5000/a/b:x", Some("localhost:5000"), "a/b", Some("x"), None),
            ("team/agent:V1.2_x-y", None, "team/agent", Some("V1.2_x-y"), None),
            ("a/b__c.d-e---f/g_h", None, "a/b__c.d-e---f/g_h", None, None),
            ("Upper/case", Some("Upper"), "case", None, None),
            ("R.example/a", Some("R.example"), "a", None, None),
            ("127.0.0.1:5000/a", Some("127.0.0.1:5000"), "a", None, None),
            (
                "[2001:db8::1]:5000/a:1",
                Some("[2001:db8::1]:5000"),
                "a",
                Some("1"),
                None,
            ),
            ("[::1]/a", Some("[::1]"), "a", None, None),
            (&by_digest, None, "agent", None, Some(SHA)),
            (&pinned, Some("ghcr.io"), "a/b", Some("1"), Some(SHA)),
            (
                &team,
                Some(ecr),
                "carla-participant-team-7",
                Some("0a1b2c3d-0000-4444-8888-1234567890ab"),
                None,
            ),
        ] {
            let wanted = ImageReference {
                registry,
                repository,
                tag,
                digest,
            };
            assert_eq!(ImageReference::parse(text), Ok(wanted), "{text}");
        }
    }

    #[test]
    fn an_image_that_can_never_be_pulled_is_refused_with_the_reason() {
        use NotAnImage::{Characters, Digest, Empty, Id, Registry, Repository, Tag, TooLong, UpperCase};
        let text = str::to_owned;
        let long_tag = format!("agent:{}", "x".repeat(129));
        let long_name = "x".repeat(256);
        for (image, why) in [
            ("", Empty),
            (&"a/".repeat(257), TooLong),
            ("two words", Characters),
            ("agent:1\n", Characters),
            ("\u{2003}", Characters),
            ("ägent:1", Characters),
            (&SHA[7..], Id),
            ("team/Agent:1", UpperCase(text("team/Agent"))),
            ("r.example/Team/agent", UpperCase(text("Team/agent"))),
            ("Agent", UpperCase(text("Agent"))),
            ("r.example:x/agent", Registry(text("r.example:x"))),
            ("r..example/agent", Registry(text("r..example"))),
            ("-r.example/agent", Registry(text("-r.example"))),
            ("https://r.example/agent", Registry(text("https:"))),
            ("[::1/agent", Registry(text("[::1"))),
            ("/agent", Repository(text("/agent"))),
            ("team//agent", Repository(text("team//agent"))),
            ("team/agent/", Repository(text("team/agent/"))),
            ("a___b", Repository(text("a___b"))),
            ("a._b", Repository(text("a._b"))),
            ("-agent", Repository(text("-agent"))),
            ("agent!", Repository(text("agent!"))),
            (&long_name, Repository(long_name.clone())),
            ("agent:", Tag(text(""))),
            ("agent:-1", Tag(text("-1"))),
            ("agent:a:b", Tag(text("a:b"))),
            (&long_tag, Tag("x".repeat(129))),
            ("agent@", Digest(text(""))),
            ("agent@sha256:0123", Digest(text("sha256:0123"))),
            (
                "agent@md5:0123456789abcdef0123456789abcdef",
                Digest(text("md5:0123456789abcdef0123456789abcdef")),
            ),
        ] {
            assert_eq!(ImageReference::parse(image), Err(why), "{image}");
        }
        let upper = format!("agent@{}", SHA.to_ascii_uppercase());
        assert!(matches!(ImageReference::parse(&upper), Err(Digest(_))));
    }
}
