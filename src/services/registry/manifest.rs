//! What a registry stores of an image: an index of platforms, a manifest, a config. Pure.
//!
//! Participants write these documents. A container engine reads them after us, with another reader: a key that is there twice, or
//! in another case, could mean one thing here and another there, so such a document is refused.

use serde::Deserialize;
use serde::de::{Deserializer, MapAccess, Visitor};
use serde_json::value::RawValue;

/// Largest manifest or config that is read, in bytes. Those of images with a hundred layers have some 100 kB.
pub(super) const LARGEST: usize = 2 << 20;
/// Most layers of an image. Engines end at some 128.
const MOST_LAYERS: usize = 512;
/// Most images of an index.
const MOST_IMAGES: usize = 256;

/// Why a document describes no image that could run, in words of ours alone.
pub(super) type Defect = &'static str;

const NOT_JSON: Defect = "its manifest or config is not a JSON object";
const AMBIGUOUS: Defect = "a key of its manifest or config is there twice, or in another case";
const BAD_FIELD: Defect = "a field of its manifest or config has another form than registries give it";
const BAD_DIGEST: Defect = "one of its parts has no sha256 digest";
const NO_MANIFEST: Defect = "its manifest names no config and layers";
const TWO_KINDS: Defect = "its manifest is an index and an image at once";
const LAYERS: Defect = "it has more than 512 layers";
const IMAGES: Defect = "its index has more than 256 images";
const ELSEWHERE: Defect = "a part of it would be fetched from another address than the registry";

/// One part of an image: a blob, or a manifest of an index.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Part {
    pub(super) digest: String,
    pub(super) bytes: u64,
}

/// What is stored under the name of an image.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Document {
    /// The manifest for linux/amd64, if there is one.
    Index(Option<Part>),
    /// An image with its config, and the bytes of all its parts.
    Image { config: Part, bytes: u64 },
}

/// What a config has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Config {
    pub(super) is_linux_amd64: bool,
    pub(super) has_volumes: bool,
}

/// Reads an index or a manifest.
pub(super) fn document(body: &[u8]) -> Result<Document, Defect> {
    let object = Object::of(body)?;
    let images = object.list("manifests")?;
    let (config, layers) = (object.object("config")?, object.list("layers")?);
    match (images, config, layers) {
        (Some(images), None, None) => Ok(Document::Index(for_linux_amd64(&images)?)),
        (None, Some(config), Some(layers)) => image(&config, &layers),
        (Some(_), _, _) => Err(TWO_KINDS),
        (None, ..) => Err(NO_MANIFEST),
    }
}

/// Reads a config.
pub(super) fn config(body: &[u8]) -> Result<Config, Defect> {
    let object = Object::of(body)?;
    let run = object.object("config")?;
    let volumes = run.map(|run| run.object("Volumes")).transpose()?.flatten();
    Ok(Config {
        is_linux_amd64: is_linux_amd64(&object)? == Some(true),
        has_volumes: volumes.is_some_and(|volumes| !volumes.0.is_empty()),
    })
}

fn image(config: &Object<'_>, layers: &[&RawValue]) -> Result<Document, Defect> {
    if layers.len() > MOST_LAYERS {
        return Err(LAYERS);
    }
    let config = part(config)?;
    let mut bytes = config.bytes;
    for layer in layers {
        let layer = part(&Object::of(layer.get().as_bytes())?)?;
        bytes = bytes.saturating_add(layer.bytes);
    }
    Ok(Document::Image { config, bytes })
}

/// The first image of an index for our machines; else the first of unknown platform, whose config will show it.
fn for_linux_amd64(images: &[&RawValue]) -> Result<Option<Part>, Defect> {
    if images.len() > MOST_IMAGES {
        return Err(IMAGES);
    }
    let mut of_unknown = None;
    for image in images {
        let image = Object::of(image.get().as_bytes())?;
        let platform = image.object("platform")?;
        match platform.as_ref().map(is_linux_amd64).transpose()?.flatten() {
            Some(true) => return part(&image).map(Some),
            None if of_unknown.is_none() => of_unknown = Some(part(&image)?),
            _ => {}
        }
    }
    Ok(of_unknown)
}

/// None: it does not have one.
fn is_linux_amd64(object: &Object<'_>) -> Result<Option<bool>, Defect> {
    let (Some(os), Some(architecture)) = (object.text("os")?, object.text("architecture")?) else {
        return Ok(None);
    };
    let is_amd64 = ["amd64", "x86_64", "x86-64"].contains(&architecture.to_ascii_lowercase().as_str());
    Ok(Some(is_amd64 && os.eq_ignore_ascii_case("linux")))
}

fn part(object: &Object<'_>) -> Result<Part, Defect> {
    // An engine on the node would fetch it from there first, whatever address that is.
    if object.list("urls")?.is_some_and(|urls| !urls.is_empty()) {
        return Err(ELSEWHERE);
    }
    let digest = object.text("digest")?.ok_or(BAD_FIELD)?;
    let bytes = object.number("size")?.ok_or(BAD_FIELD)?;
    if is_sha256(&digest) {
        Ok(Part { digest, bytes })
    } else {
        Err(BAD_DIGEST)
    }
}

/// Whether a digest is one that is computed here.
pub(super) fn is_sha256(digest: &str) -> bool {
    let hex = digest.strip_prefix("sha256:").unwrap_or_default();
    hex.len() == 64 && hex.bytes().all(|b| b.is_ascii_digit() || (b'a'..=b'f').contains(&b))
}

/// A JSON object with all its keys, also those that are there twice. Values stay text until they are asked for, so what a stranger
/// nests in them takes neither stack nor memory.
struct Object<'a>(Vec<(String, &'a RawValue)>);

impl<'de> Deserialize<'de> for Object<'de> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Pairs;
        impl<'de> Visitor<'de> for Pairs {
            type Value = Object<'de>;

            fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str("an object")
            }

            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Object<'de>, A::Error> {
                let mut pairs = Vec::new();
                while let Some(pair) = map.next_entry()? {
                    pairs.push(pair);
                }
                Ok(Object(pairs))
            }
        }
        deserializer.deserialize_map(Pairs)
    }
}

impl<'a> Object<'a> {
    fn of(body: &'a [u8]) -> Result<Self, Defect> {
        serde_json::from_slice(body).map_err(|_| NOT_JSON)
    }

    /// The value of a key; none where it is absent or null.
    fn get(&self, name: &str) -> Result<Option<&'a RawValue>, Defect> {
        let mut like_it = self.0.iter().filter(|(key, _)| is_taken_for(key, name));
        let Some((key, value)) = like_it.next() else {
            return Ok(None);
        };
        if key != name || like_it.next().is_some() {
            return Err(AMBIGUOUS);
        }
        Ok(Some(*value).filter(|value| value.get() != "null"))
    }

    fn read<T: Deserialize<'a>>(&self, name: &str) -> Result<Option<T>, Defect> {
        let value = self.get(name)?;
        let read = value.map(|value| serde_json::from_str(value.get()).map_err(|_| BAD_FIELD));
        read.transpose()
    }

    fn object(&self, name: &str) -> Result<Option<Self>, Defect> {
        self.read(name)
    }

    fn list(&self, name: &str) -> Result<Option<Vec<&'a RawValue>>, Defect> {
        self.read(name)
    }

    fn text(&self, name: &str) -> Result<Option<String>, Defect> {
        self.read(name)
    }

    fn number(&self, name: &str) -> Result<Option<u64>, Defect> {
        self.read(name)
    }
}

/// Whether Go's reader, which engines use, takes one key for the other: it folds case, also that of two letters beyond ASCII.
fn is_taken_for(key: &str, name: &str) -> bool {
    let folded = |c: char| match c {
        '\u{17f}' => 's',
        '\u{212a}' => 'k',
        c => c.to_ascii_lowercase(),
    };
    key.chars().map(folded).eq(name.chars().map(folded))
}

#[cfg(test)]
#[path = "manifest_tests.rs"]
mod tests;
