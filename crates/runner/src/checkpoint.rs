//! The agent's checkpoint file: are the results complete, are there partial ones? The file is the agent's and hostile:
//! nothing is followed, nothing blocks, and what is read is bounded.
//!
//! Called before the agent's command starts and after all its processes have ended. The scores inside are not its matter.

use std::fmt;
use std::fs::{self, File, OpenOptions, Permissions};
use std::io::{self, BufReader, ErrorKind, Read};
use std::os::unix::fs::{OpenOptionsExt, PermissionsExt};
use std::path::Path;

use nix::fcntl::OFlag;
use serde::Deserialize;
use serde::de::{DeserializeSeed, Deserializer, IgnoredAny, MapAccess, SeqAccess, Visitor};
use thiserror::Error;

/// No larger checkpoint is read, in bytes.
pub(crate) const MAX_BYTES: u64 = 64 << 20;

/// Parts of a checkpoint.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Checkpoint {
    /// `_checkpoint.global_record` is an object with something in it: the evaluator came to its end.
    pub(crate) complete: bool,
    /// `_checkpoint.progress` is a list with something in it: there is something to resume.
    pub(crate) partial: bool,
    /// So many route runs are all that the file promises, and its evaluator has driven and counted each of them: started again, it would
    /// drive none.
    pub(crate) driven: Option<u32>,
}

/// Why there is no checkpoint to read.
#[derive(Debug, Error)]
pub(crate) enum Unreadable {
    #[error("there is no checkpoint file")]
    Missing,
    #[error("the checkpoint is not a regular file")]
    NotRegular,
    #[error("the checkpoint is larger than {} MiB", MAX_BYTES >> 20)]
    TooLarge,
    #[error("the checkpoint cannot be read: {0}")]
    Io(std::io::Error),
    #[error("the checkpoint is not a checkpoint's JSON (line {line}, column {column})")]
    Malformed { line: usize, column: usize },
}

/// Reads the checkpoint at `path`.
pub(crate) fn read(path: &Path) -> Result<Checkpoint, Unreadable> {
    parse(open(path)?)
}

/// Reads the checkpoint in an open file.
pub(crate) fn parse(file: File) -> Result<Checkpoint, Unreadable> {
    if file.metadata().map_err(Unreadable::Io)?.len() > MAX_BYTES {
        return Err(Unreadable::TooLarge);
    }
    let reader = PythonJson::of(BufReader::with_capacity(64 << 10, file.take(MAX_BYTES)));
    let document: Document = serde_json::from_reader(reader).map_err(|error| Unreadable::Malformed {
        line: error.line(),
        column: error.column(),
    })?;
    let Inner {
        global_record,
        progress,
        records,
    } = document.checkpoint;
    let (counted, found) = (progress.list(), records.list().length);
    let driven = match counted.first {
        [Some(done), Some(total)] if done == total && found >= total && !document.entry_status.goes_back() => {
            Some(total)
        }
        _ => None,
    };
    Ok(Checkpoint {
        complete: global_record == Filled::Object,
        partial: counted.length > 0,
        driven: driven.filter(|runs| *runs > 0),
    })
}

/// Makes the checkpoint readable for `logcopy`, which runs as another user. Only for when no process of the agent lives,
/// since the file is looked at first and changed afterwards.
pub(crate) fn make_readable(path: &Path) {
    let regular = fs::symlink_metadata(path).is_ok_and(|metadata| metadata.is_file());
    if regular && let Err(error) = fs::set_permissions(path, Permissions::from_mode(0o644)) {
        crate::say(format_args!("the mode of {} stays as it is: {error}", path.display()));
    }
}

/// Opens a regular file for reading, following nothing.
pub(crate) fn open(path: &Path) -> Result<File, Unreadable> {
    let flags = OFlag::O_NOFOLLOW | OFlag::O_NONBLOCK | OFlag::O_NOCTTY;
    // Looked at first, because opening a device can act; looked at again below, because it may have been swapped.
    match fs::symlink_metadata(path) {
        Ok(metadata) if metadata.is_file() => {}
        Ok(_) => return Err(Unreadable::NotRegular),
        Err(error) if error.kind() == ErrorKind::NotFound => return Err(Unreadable::Missing),
        Err(error) => return Err(Unreadable::Io(error)),
    }
    let file = OpenOptions::new()
        .read(true)
        .custom_flags(flags.bits())
        .open(path)
        .map_err(Unreadable::Io)?;
    if file.metadata().map_err(Unreadable::Io)?.is_file() {
        Ok(file)
    } else {
        Err(Unreadable::NotRegular)
    }
}

/// A new file in the place of whatever is there. `create_new` follows no link.
pub(crate) fn create(path: &Path) -> io::Result<File> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != ErrorKind::NotFound => return Err(error),
        _ => {}
    }
    let mut options = OpenOptions::new();
    options.read(true).write(true).create_new(true).mode(0o644).open(path)
}

/// Python writes `NaN` and `Infinity` where a number is none, and reads them; JSON has neither. No number counts here, so that each is
/// read as a 0 of the same length.
pub(crate) struct PythonJson<R> {
    inner: R,
    place: Place,
}

#[derive(Clone, Copy)]
enum Place {
    Outside,
    /// In such a word, with what is left of it.
    Word(&'static [u8]),
    Text,
    /// Behind a backslash.
    Escape,
}

impl<R> PythonJson<R> {
    pub(crate) fn of(inner: R) -> Self {
        Self {
            inner,
            place: Place::Outside,
        }
    }

    fn read_as(&mut self, byte: u8) -> u8 {
        let (place, shown) = match (self.place, byte) {
            (Place::Word([next, rest @ ..]), _) if byte == *next => (Place::Word(rest), b' '),
            // Another word: no JSON has this byte.
            (Place::Word([_, ..]), _) => (Place::Outside, 0),
            (Place::Text, b'\\') => (Place::Escape, byte),
            (Place::Text, b'"') => (Place::Outside, byte),
            (Place::Text | Place::Escape, _) | (_, b'"') => (Place::Text, byte),
            (_, b'N') => (Place::Word(b"aN"), b'0'),
            (_, b'I') => (Place::Word(b"nfinity"), b'0'),
            _ => (Place::Outside, byte),
        };
        self.place = place;
        shown
    }
}

impl<R: Read> Read for PythonJson<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let length = self.inner.read(buffer)?;
        for byte in buffer.iter_mut().take(length) {
            *byte = self.read_as(*byte);
        }
        Ok(length)
    }
}

#[derive(Deserialize)]
struct Document {
    #[serde(rename = "_checkpoint")]
    checkpoint: Inner,
    #[serde(default)]
    entry_status: Filled,
}

#[derive(Deserialize)]
struct Inner {
    #[serde(default)]
    global_record: Filled,
    #[serde(default)]
    progress: Filled,
    #[serde(default)]
    records: Filled,
}

/// The outermost shape of a value; what is inside is skipped without being kept, but for a list's first numbers.
#[derive(Debug, Default, PartialEq)]
enum Filled {
    Object,
    List(Listed),
    Number(u32),
    /// An entry status after which the evaluator does not go on from where it has counted: a crashed route is repeated, and an
    /// invalid file is begun anew.
    GoesBack,
    #[default]
    Nothing,
}

/// A list.
#[derive(Debug, Default, Clone, Copy, PartialEq)]
struct Listed {
    length: u32,
    first: [Option<u32>; 2],
}

impl Filled {
    fn list(&self) -> Listed {
        match self {
            Self::List(list) => *list,
            _ => Listed::default(),
        }
    }

    fn goes_back(&self) -> bool {
        *self == Self::GoesBack
    }
}

impl<'de> Deserialize<'de> for Filled {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(Shape { looks_inside: true })
    }
}

struct Shape {
    looks_inside: bool,
}

impl<'de> DeserializeSeed<'de> for Shape {
    type Value = Filled;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Filled, D::Error> {
        deserializer.deserialize_any(self)
    }
}

impl<'de> Visitor<'de> for Shape {
    type Value = Filled;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("any value")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Filled, A::Error> {
        let mut filled = Filled::Nothing;
        while map.next_entry::<IgnoredAny, IgnoredAny>()?.is_some() {
            filled = Filled::Object;
        }
        Ok(filled)
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<Filled, A::Error> {
        let mut found = Listed::default();
        let places = found.first.iter_mut().filter(|_| self.looks_inside);
        for place in places {
            let Some(element) = list.next_element_seed(Self { looks_inside: false })? else {
                return Ok(Filled::List(found));
            };
            found.length += 1;
            *place = match element {
                Filled::Number(number) => Some(number),
                _ => None,
            };
        }
        while list.next_element::<IgnoredAny>()?.is_some() {
            found.length = found.length.saturating_add(1);
        }
        Ok(Filled::List(found))
    }

    fn visit_bool<E>(self, _: bool) -> Result<Filled, E> {
        Ok(Filled::Nothing)
    }

    fn visit_i64<E>(self, _: i64) -> Result<Filled, E> {
        Ok(Filled::Nothing)
    }

    fn visit_u64<E>(self, number: u64) -> Result<Filled, E> {
        Ok(u32::try_from(number).map_or(Filled::Nothing, Filled::Number))
    }

    fn visit_f64<E>(self, _: f64) -> Result<Filled, E> {
        Ok(Filled::Nothing)
    }

    fn visit_str<E>(self, text: &str) -> Result<Filled, E> {
        Ok(match text {
            "Crashed" | "Invalid" => Filled::GoesBack,
            _ => Filled::Nothing,
        })
    }

    fn visit_unit<E>(self) -> Result<Filled, E> {
        Ok(Filled::Nothing)
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;
    use std::process::Command;

    use super::*;

    fn read_text(text: &str) -> Result<Checkpoint, Unreadable> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("agent_results.json");
        fs::write(&path, text).unwrap();
        read(&path)
    }

    #[test]
    fn the_record_and_the_progress_decide() {
        let cases = [
            (
                r#"{"_checkpoint": {"global_record": {"index": -1}, "progress": [5, 5]}}"#,
                true,
                true,
            ),
            (
                r#"{"_checkpoint": {"global_record": {}, "progress": [2, 5]}, "sensors": []}"#,
                false,
                true,
            ),
            (
                r#"{"_checkpoint": {"global_record": {}, "progress": [], "records": [{}]}}"#,
                false,
                false,
            ),
            (r#"{"_checkpoint": {}}"#, false, false),
            (
                r#"{"_checkpoint": {"global_record": null, "progress": "12"}}"#,
                false,
                false,
            ),
            (
                r#"{"_checkpoint": {"global_record": [1], "progress": {"a": 1}}}"#,
                false,
                false,
            ),
            (
                r#"{"_checkpoint": {"global_record": 1.5, "progress": true}}"#,
                false,
                false,
            ),
        ];
        for (text, complete, partial) in cases {
            let found = read_text(text).unwrap();
            assert_eq!(
                (found.complete, found.partial, found.driven),
                (complete, partial, None),
                "{text}"
            );
        }
    }

    #[test]
    fn all_routes_are_driven_where_the_evaluator_would_find_none_left() {
        let file = |status: &str, progress: &str, records: &str| {
            format!(
                r#"{{"_checkpoint": {{"global_record": {{}}, "progress": {progress}, "records": {records}}}, "entry_status": {status}}}"#
            )
        };
        let cases = [
            ("\"Started\"", "[2, 2]", "[{}, {}]", Some(2)),
            ("\"Finished\"", "[2, 2]", "[{}, {}]", Some(2)),
            ("\"Rejected\"", "[2, 2]", "[{}, {}]", Some(2)),
            ("\"\"", "[1, 1]", "[{}]", Some(1)),
            // A crashed route is repeated, and an invalid file is begun anew.
            ("\"Crashed\"", "[2, 2]", "[{}, {}]", None),
            ("\"Invalid\"", "[2, 2]", "[{}, {}]", None),
            ("\"Started\"", "[1, 2]", "[{}, {}]", None),
            ("\"Started\"", "[2, 2]", "[{}]", None),
            ("\"Started\"", "[0, 0]", "[]", None),
            ("\"Started\"", "[]", "[{}]", None),
            ("\"Started\"", "[NaN, 2]", "[{}, {}]", None),
            ("\"Started\"", "[2.0, 2.0]", "[{}, {}]", None),
            ("\"Started\"", "[[2], [2]]", "[{}, {}]", None),
            ("\"Started\"", "[4294967298, 4294967298]", "[{}, {}]", None),
            ("\"Started\"", "\"22\"", "{\"a\": 1, \"b\": 2}", None),
            ("7", "[1, 1, 9]", "[[[[]]]]", Some(1)),
        ];
        for (status, progress, records, driven) in cases {
            let text = file(status, progress, records);
            assert_eq!(read_text(&text).unwrap().driven, driven, "{text}");
        }
    }

    #[test]
    fn what_python_writes_for_no_number_is_no_half_of_a_file() {
        let checkpoint = |record: &str| {
            format!(r#"{{"_checkpoint": {{"global_record": {{}}, "progress": [1, 5], "records": [{record}]}}}}"#)
        };
        let of_python = r#"{"a": NaN, "b": [Infinity, -Infinity,NaN], "Infinity": "\"NaN", "c\\": NaN}"#;
        let partial = Checkpoint {
            complete: false,
            partial: true,
            driven: None,
        };
        assert_eq!(read_text(&checkpoint(of_python)).unwrap(), partial);
        let whole = checkpoint(of_python);
        for end in 0..whole.len() {
            let torn = read_text(&whole[..end]);
            assert!(matches!(torn, Err(Unreadable::Malformed { .. })), "{}", &whole[..end]);
        }
        for wrong in ["NoN", "nan", "Inf", "NaNN", "truNaN"] {
            let error = read_text(&checkpoint(wrong));
            assert!(matches!(error, Err(Unreadable::Malformed { .. })), "{wrong}");
        }
    }

    #[test]
    fn broken_files_are_malformed() {
        let half = r#"{"_checkpoint": {"global_record": {"index": -1}"#;
        let twice = r#"{"_checkpoint": {"global_record": {"a": 1}}} {}"#;
        let deep = format!(r#"{{"_checkpoint": {{"progress": {}"#, "[".repeat(1_000_000));
        for text in ["", "[]", "{}", "null", half, twice, &deep] {
            assert!(
                matches!(read_text(text), Err(Unreadable::Malformed { .. })),
                "{text:.40}"
            );
        }
    }

    #[test]
    fn only_a_regular_file_of_bounded_size_is_read() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        assert!(matches!(read(&at("missing")), Err(Unreadable::Missing)));
        assert!(matches!(read(folder.path()), Err(Unreadable::NotRegular)));

        fs::write(at("real"), r#"{"_checkpoint": {"global_record": {"a": 1}}}"#).unwrap();
        symlink(at("real"), at("link")).unwrap();
        assert!(matches!(read(&at("link")), Err(Unreadable::NotRegular)));

        assert!(Command::new("mkfifo").arg(at("fifo")).status().unwrap().success());
        assert!(matches!(read(&at("fifo")), Err(Unreadable::NotRegular)));

        File::create(at("sparse")).unwrap().set_len(10 << 30).unwrap();
        assert!(matches!(read(&at("sparse")), Err(Unreadable::TooLarge)));
        assert!(read(&at("real")).unwrap().complete);
    }

    #[test]
    fn the_mode_of_a_regular_file_is_opened_and_no_link_is_followed() {
        let folder = tempfile::tempdir().unwrap();
        let (real, link) = (folder.path().join("real"), folder.path().join("link"));
        fs::write(&real, "{}").unwrap();
        fs::set_permissions(&real, Permissions::from_mode(0o600)).unwrap();
        symlink(&real, &link).unwrap();
        let mode = || fs::metadata(&real).unwrap().permissions().mode() & 0o777;
        make_readable(&link);
        assert_eq!(mode(), 0o600);
        make_readable(&real);
        assert_eq!(mode(), 0o644);
    }
}
