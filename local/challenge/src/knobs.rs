//! The text of `AGENT_KNOBS` and `SIM_KNOBS`: which faults a run is to show. Parsed once by each program; what a knob
//! does is the programs' business.

use std::{fs::OpenOptions, io::ErrorKind, path::Path, sync::OnceLock};

/// Port of the first pair's simulator; each further pair lies this much higher.
const FIRST_PORT: u16 = 2000;
const PORT_STEP: u16 = 100;

/// How a knob is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Shape {
    /// `name`
    Plain,
    /// `name@K`, `name@K:once`, `name@K:always`: at the K-th route, counted from 1.
    At,
    /// `name` or `name@K…`
    PlainOrAt,
    /// `name=VALUE`
    Value,
}

/// One line of a program's table of knobs.
pub type Known = (&'static str, Shape);

/// Why a text of knobs is refused.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
pub enum KnobError {
    #[error("there is no knob `{0}`; known are: {1}")]
    Unknown(String, String),
    #[error(
        "knob `{0}` is not written as it should be: name, name@ROUTE[:once|:always] with ROUTE from 1, or name=VALUE"
    )]
    Malformed(String),
    #[error("pair={0} is not a number from 1 to 100")]
    Pair(String),
}

#[derive(Debug, PartialEq, Eq)]
struct Knob {
    name: &'static str,
    at: Option<usize>,
    /// For `:once`: the name of its marker.
    marker: Option<String>,
    /// For `:once`: whether it is this process in which it happens.
    ours: OnceLock<bool>,
    value: String,
}

impl Knob {
    fn plain(name: &'static str) -> Self {
        Self {
            name,
            at: None,
            marker: None,
            ours: OnceLock::new(),
            value: String::new(),
        }
    }

    /// True without `:once`; with it, in the one process that leaves the marker.
    fn may_happen(&self, markers: &Path) -> bool {
        self.marker
            .as_ref()
            .is_none_or(|marker| *self.ours.get_or_init(|| first_time(&markers.join(marker))))
    }
}

/// The knobs of this pair.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct Knobs(Vec<Knob>);

impl Knobs {
    /// Reads comma separated knobs. `pair=N` keeps them for the pair whose simulator has that port; groups for different
    /// pairs are separated by semicolons (`pair=1,crash@2;pair=3,hang@1`).
    pub fn parse(text: &str, known: &[Known], port: u16) -> Result<Self, KnobError> {
        let mut all = Vec::new();
        for group in text.split(';') {
            let (mut knobs, mut ours) = (Vec::new(), true);
            for item in group.split(',').map(str::trim).filter(|item| !item.is_empty()) {
                match item.strip_prefix("pair=") {
                    Some(pair) => ours = port_of(pair)? == port,
                    None => knobs.push(knob(item, known, port)?),
                }
            }
            if ours {
                all.append(&mut knobs);
            }
        }
        Ok(Self(all))
    }

    /// Is `name` there without a route?
    pub fn has(&self, name: &str) -> bool {
        self.0.iter().any(|knob| knob.name == name && knob.at.is_none())
    }

    /// The value of `name=VALUE`.
    pub fn value(&self, name: &str) -> Option<&str> {
        self.0
            .iter()
            .find(|knob| knob.name == name)
            .map(|knob| knob.value.as_str())
    }

    /// Does `name` happen at this route (counted from 1)? With `:once` a marker file in `markers` (one per pair) keeps it
    /// from happening in any later process.
    pub fn fires(&self, name: &str, route: usize, markers: &Path) -> bool {
        self.0
            .iter()
            .any(|knob| knob.name == name && knob.at == Some(route) && knob.may_happen(markers))
    }

    /// Does `name` hold at this route, having begun at it or at an earlier one? With `:once` only in the first process.
    pub fn holds(&self, name: &str, route: usize, markers: &Path) -> bool {
        self.0
            .iter()
            .any(|knob| knob.name == name && knob.at <= Some(route) && knob.may_happen(markers))
    }
}

/// A marker that can't be written counts as the first time: the fault is then seen too often, never missed.
fn first_time(marker: &Path) -> bool {
    match OpenOptions::new().write(true).create_new(true).open(marker) {
        Ok(_) => true,
        Err(error) if error.kind() == ErrorKind::AlreadyExists => false,
        Err(error) => {
            eprintln!(
                "the marker {} can't be written, so `once` has no effect: {error}",
                marker.display()
            );
            true
        }
    }
}

fn port_of(pair: &str) -> Result<u16, KnobError> {
    match pair.parse::<u16>() {
        Ok(number @ 1..=100) => Ok(FIRST_PORT + PORT_STEP * (number - 1)),
        _ => Err(KnobError::Pair(pair.to_owned())),
    }
}

fn knob(item: &str, known: &[Known], port: u16) -> Result<Knob, KnobError> {
    let end = item.find(['@', '=', ':']).unwrap_or(item.len());
    let (name, rest) = item.split_at(end);
    let Some(&(name, shape)) = known.iter().find(|(one, _)| *one == name) else {
        let names: Vec<_> = known.iter().map(|(one, _)| *one).collect();
        return Err(KnobError::Unknown(name.to_owned(), names.join(", ")));
    };
    match shape {
        Shape::Plain | Shape::PlainOrAt if rest.is_empty() => Some(Knob::plain(name)),
        Shape::Value => rest.strip_prefix('=').map(|value| Knob {
            value: value.to_owned(),
            ..Knob::plain(name)
        }),
        Shape::At | Shape::PlainOrAt => rest.strip_prefix('@').and_then(|rest| {
            let (at, when) = rest.split_once(':').unwrap_or((rest, "always"));
            let at = at.parse().ok().filter(|&at| at > 0)?;
            let marker = (when == "once").then(|| format!(".{name}-{at}-{port}.happened"));
            matches!(when, "once" | "always").then(|| Knob {
                at: Some(at),
                marker,
                ..Knob::plain(name)
            })
        }),
        Shape::Plain => None,
    }
    .ok_or_else(|| KnobError::Malformed(item.to_owned()))
}

#[cfg(test)]
mod tests {
    use super::*;

    const KNOWN: &[Known] = &[
        ("crash", Shape::At),
        ("forge", Shape::Plain),
        ("spam", Shape::Value),
        ("hang", Shape::PlainOrAt),
    ];

    #[test]
    fn a_pair_only_gets_its_own_knobs() {
        let text = "pair=1,crash@2; pair=3,forge,spam=10";
        for (port, crash, forge) in [(2000, true, false), (2100, false, false), (2200, false, true)] {
            let knobs = Knobs::parse(text, KNOWN, port).unwrap();
            assert_eq!(
                (knobs.fires("crash", 2, Path::new("/")), knobs.has("forge")),
                (crash, forge),
                "port {port}"
            );
        }
        assert_eq!(Knobs::parse(text, KNOWN, 2200).unwrap().value("spam"), Some("10"));
    }

    #[test]
    fn once_is_one_process() {
        let folder = std::env::temp_dir().join(format!("knobs-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let parse = |port| Knobs::parse("crash@2:once,hang@2", KNOWN, port).unwrap();
        let first = parse(2000);
        assert!(!first.fires("crash", 1, &folder));
        assert!(first.fires("crash", 2, &folder) && first.holds("crash", 3, &folder));
        let later = parse(2000);
        assert!(!later.fires("crash", 2, &folder) && !later.holds("crash", 3, &folder));
        assert!(later.fires("hang", 2, &folder) && later.holds("hang", 3, &folder));
        assert!(!later.holds("hang", 1, &folder) && !later.has("hang"));
        assert!(
            parse(2100).fires("crash", 2, &folder),
            "another pair has its own marker"
        );
        std::fs::remove_dir_all(&folder).unwrap();
    }

    #[test]
    fn nonsense_is_refused() {
        for text in [
            "crash",
            "crash@0",
            "crash@x",
            "crash@1:twice",
            "forge@1",
            "spam",
            "forge=1",
        ] {
            assert_eq!(
                Knobs::parse(text, KNOWN, 2000),
                Err(KnobError::Malformed(text.to_owned()))
            );
        }
        assert!(matches!(Knobs::parse("sing", KNOWN, 2000), Err(KnobError::Unknown(name, _)) if name == "sing"));
        assert_eq!(
            Knobs::parse("pair=0,forge", KNOWN, 2000),
            Err(KnobError::Pair("0".into()))
        );
    }
}
