//! An evaluator's result file: whether it is complete, and the refusal of one that wrote none. The evaluator reads what strangers send, so
//! that the file is hostile as a checkpoint is: nothing is followed, nothing blocks, and what is read is bounded.
//!
//! Called by `run`, while the evaluator runs and once all its processes have ended. What the result holds is `logcopy`'s matter.

use std::fmt;
use std::fs::{self, File, Permissions};
use std::io::{self, BufReader, Read, Write};
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};

use serde::Deserialize;
use serde::de::IgnoredAny;

use crate::checkpoint::{self, PythonJson, Unreadable};
use crate::keep::{self, Stamp};

/// Exit code by which an evaluator refuses a submission without a text.
pub(crate) const REFUSED: i32 = 65;
/// No larger result is read, in bytes.
const MAX_BYTES: u64 = 1 << 20;
/// Bits without which `logcopy`, which runs as another user, reads nothing.
const READABLE: u32 = 0o444;
/// A refusal in the evaluator's place.
const REFUSAL: &str = r#"{"schema":1,"done":0,"total":0,"final":true,"splits":[],"refused":"The evaluator refused the submission."}
"#;

/// State of a result. Its text ends the sentence of a verdict.
#[derive(Debug)]
pub(crate) enum State {
    /// It is final, or the submission is refused.
    Complete,
    /// The evaluator is still at it.
    Partial,
    /// There is none to read.
    Unreadable(Unreadable),
    /// The evaluator refused the submission, and its refusal cannot be written.
    Unwritten(io::Error),
}

impl State {
    pub(crate) const fn is_complete(&self) -> bool {
        matches!(self, Self::Complete)
    }
}

impl fmt::Display for State {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Complete => f.write_str("its result is complete"),
            Self::Partial => f.write_str("its result is not final"),
            Self::Unreadable(Unreadable::Missing) => f.write_str("there is no result file"),
            Self::Unreadable(Unreadable::NotRegular) => f.write_str("the result is not a regular file"),
            Self::Unreadable(Unreadable::TooLarge) => write!(f, "the result is larger than {} MiB", MAX_BYTES >> 20),
            Self::Unreadable(Unreadable::Io(error)) => write!(f, "the result cannot be read: {error}"),
            Self::Unreadable(Unreadable::Malformed { line, column }) => {
                write!(f, "the result is not a result's JSON (line {line}, column {column})")
            }
            Self::Unwritten(error) => write!(f, "its refusal cannot be written: {error}"),
        }
    }
}

/// A result file that is looked at again and again, and read when it has changed.
#[derive(Debug)]
pub(crate) struct Watched {
    path: PathBuf,
    stamp: Option<Stamp>,
    is_complete: bool,
}

impl Watched {
    pub(crate) const fn new(path: PathBuf) -> Self {
        Self {
            path,
            stamp: None,
            is_complete: false,
        }
    }

    pub(crate) fn is_complete(&mut self) -> bool {
        let stamp = keep::stamp(&self.path);
        if stamp != self.stamp {
            self.stamp = stamp;
            self.is_complete = read(&self.path).is_complete();
        }
        self.is_complete
    }
}

#[derive(Deserialize)]
struct Document {
    #[serde(default)]
    r#final: bool,
    refused: Option<IgnoredAny>,
}

/// Reads the result, and makes it readable for `logcopy`.
pub(crate) fn read(path: &Path) -> State {
    match checkpoint::open(path).and_then(parse) {
        Ok(Document { r#final, refused }) if r#final || refused.is_some() => State::Complete,
        Ok(_) => State::Partial,
        Err(error) => State::Unreadable(error),
    }
}

/// True if it is final and refuses nothing.
pub(crate) fn is_final(path: &Path) -> bool {
    let found = checkpoint::open(path).and_then(parse);
    found.is_ok_and(|found| found.r#final && found.refused.is_none())
}

fn parse(file: File) -> Result<Document, Unreadable> {
    let metadata = file.metadata().map_err(Unreadable::Io)?;
    if metadata.len() > MAX_BYTES {
        return Err(Unreadable::TooLarge);
    }
    let mode = metadata.mode();
    if mode & READABLE != READABLE
        && let Err(error) = file.set_permissions(Permissions::from_mode(mode & 0o777 | READABLE))
    {
        crate::say(format_args!("the mode of the result stays as it is: {error}"));
    }
    let reader = PythonJson::of(BufReader::with_capacity(64 << 10, file.take(MAX_BYTES)));
    serde_json::from_reader(reader).map_err(|error| Unreadable::Malformed {
        line: error.line(),
        column: error.column(),
    })
}

/// Puts a refusal in the place of the result. `logcopy` reads no exit code.
pub(crate) fn refuse(path: &Path) -> io::Result<()> {
    let temporary = path.with_extension("json.refused");
    checkpoint::create(&temporary)?.write_all(REFUSAL.as_bytes())?;
    fs::rename(&temporary, path)
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;
    use std::process::Command;

    use super::*;

    fn state_of(text: &str) -> State {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("result.json");
        fs::write(&path, text).unwrap();
        read(&path)
    }

    #[test]
    fn a_result_is_complete_when_it_is_final_or_refused() {
        let cases = [
            (r#"{"schema":1,"done":3,"total":10,"final":true,"splits":[]}"#, true),
            (r#"{"final":false,"refused":"The file has no header."}"#, true),
            (r#"{"final":true,"refused":null}"#, true),
            // `logcopy` reports what is wrong with these.
            (r#"{"final":true,"splits":[{"metrics":{"a":NaN}}]}"#, true),
            (r#"{"refused":7}"#, true),
            (
                r#"{"schema":1,"done":3,"total":10,"final":false,"splits":[],"refused":null}"#,
                false,
            ),
            ("{}", false),
            (r#"{"splits":[{"final":true}],"message":"final"}"#, false),
        ];
        for (text, is_complete) in cases {
            assert_eq!(state_of(text).is_complete(), is_complete, "{text}");
        }
        for (text, expected) in [
            (cases[0].0, true),
            (cases[1].0, false),
            (cases[2].0, true),
            (cases[5].0, false),
            (REFUSAL, false),
        ] {
            let file = tempfile::NamedTempFile::new().unwrap();
            fs::write(file.path(), text).unwrap();
            assert_eq!(is_final(file.path()), expected, "{text}");
        }
        assert!(!is_final(Path::new("/nothing/is/here")));
        for text in [
            "",
            "[]",
            "null",
            r#"{"final":1}"#,
            r#"{"final":"true"}"#,
            r#"{"final":true"#,
            r#"{"final":true,"final":true}"#,
        ] {
            assert!(
                matches!(state_of(text), State::Unreadable(Unreadable::Malformed { .. })),
                "{text}"
            );
        }
    }

    #[test]
    fn only_a_regular_file_of_bounded_size_is_read() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        let text = |name: &str| read(&at(name)).to_string();
        assert_eq!(text("missing"), "there is no result file");
        fs::write(at("real"), r#"{"final":true}"#).unwrap();
        symlink(at("real"), at("link")).unwrap();
        assert!(Command::new("mkfifo").arg(at("pipe")).status().unwrap().success());
        fs::create_dir(at("folder")).unwrap();
        for name in ["link", "pipe", "folder"] {
            assert_eq!(text(name), "the result is not a regular file", "{name}");
        }
        File::create(at("sparse")).unwrap().set_len(MAX_BYTES + 1).unwrap();
        assert_eq!(text("sparse"), "the result is larger than 1 MiB");
    }

    #[test]
    fn a_result_of_mode_0600_becomes_readable() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("result.json");
        fs::write(&path, r#"{"final":false}"#).unwrap();
        fs::set_permissions(&path, Permissions::from_mode(0o600)).unwrap();
        assert!(!Watched::new(path.clone()).is_complete());
        assert_eq!(fs::metadata(path).unwrap().permissions().mode() & 0o777, 0o644);
    }

    #[test]
    fn a_watched_result_is_read_again_when_it_has_changed() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("result.json");
        let mut watched = Watched::new(path.clone());
        assert!(!watched.is_complete());
        for (text, is_complete) in [
            (r#"{"final":false}"#, false),
            (r#"{"final": true}"#, true),
            ("{", false),
        ] {
            let other = folder.path().join("other");
            fs::write(&other, text).unwrap();
            fs::rename(other, &path).unwrap();
            assert_eq!(watched.is_complete(), is_complete, "{text}");
        }
        fs::remove_file(path).unwrap();
        assert!(!watched.is_complete());
    }

    #[test]
    fn a_refusal_takes_the_place_of_a_partial_result_and_follows_no_link() {
        let folder = tempfile::tempdir().unwrap();
        let (path, outside) = (folder.path().join("result.json"), folder.path().join("outside"));
        fs::write(&outside, "precious").unwrap();
        for way in [folder.path().join("result.json.refused"), path.clone()] {
            symlink(&outside, way).unwrap();
        }
        refuse(&path).unwrap();
        assert!(read(&path).is_complete());
        let result: serde_json::Value = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
        assert_eq!(result["refused"], "The evaluator refused the submission.");
        assert_eq!(fs::read_to_string(outside).unwrap(), "precious");
        fs::remove_file(&path).unwrap();
        fs::create_dir(&path).unwrap();
        assert!(refuse(&path).is_err());
    }
}
