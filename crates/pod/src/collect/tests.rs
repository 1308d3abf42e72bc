//! A stranger's image leaves anything at all.

use std::ffi::OsStr;
use std::fs;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::symlink;
use std::os::unix::net::UnixListener;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use leaderboard_api::{EvaluationMode, PlannedEvaluation};
use leaderboard_contract::run::STATUS_FOLDER;
use leaderboard_evaluation::fixtures;
use nix::errno::Errno;
use nix::sys::stat::Mode;
use nix::unistd::mkfifo;
use serde_json::json;

use super::*;

/// SHA-256 of `hello`, and of nothing.
const HELLO: &str = "2cf24dba5fb0a30e26e83b2ac5b9e29e1b161e5c1fa7425e73043362938b9824";
const EMPTY: &str = "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855";

/// A Pod whose agent has ended.
struct Pod {
    places: Places,
    run: Run,
    _folder: tempfile::TempDir,
}

impl Pod {
    fn new() -> Self {
        Self::within(1 << 30, 1000)
    }

    fn within(bytes: u64, files: i32) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let places = Places::below(folder.path());
        for made in [SUBMISSION_FOLDER, "input", "logcopy", STATUS_FOLDER] {
            fs::create_dir_all(places.logs.join(made)).unwrap();
        }
        fs::create_dir(folder.path().join("dev")).unwrap();
        let mut run = fixtures::run_of_mode(EvaluationMode::Batch);
        if let PlannedEvaluation::Container(plan) = &mut run.plan.evaluation {
            let bounds = json!({"maxBytes": bytes.to_string(), "maxFiles": files});
            plan.input = serde_json::from_value(bounds).unwrap();
        }
        Self {
            places,
            run,
            _folder: folder,
        }
    }

    fn at(&self, path: &str) -> PathBuf {
        self.places.logs.join(path)
    }

    fn left(&self) -> PathBuf {
        self.at(SUBMISSION_FOLDER)
    }

    /// The agent leaves a file.
    fn leave(&self, path: &str, text: &str) {
        let path = self.left().join(path);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, text).unwrap();
    }

    fn tree(&self) -> Tree {
        Tree::open(&self.places.logs).unwrap()
    }

    fn collect(&self) -> Result<(), CollectError> {
        collect(&self.run, &self.places)
    }

    /// The paths at `/input`.
    fn input(&self) -> Vec<String> {
        self.tree().walk("input", ENTRIES).files.into_keys().collect()
    }

    fn list(&self) -> Option<Collected> {
        Collected::parse(&fs::read(self.at(COLLECTED)).ok()?)
    }

    fn assert_nothing_is_there(&self, what: &str) {
        assert_eq!(self.input(), [""; 0], "{what}");
        assert!(self.list().is_none(), "{what}");
    }
}

fn stored(size: u64, sha256: &str) -> StoredFile {
    let sha256 = sha256.to_owned();
    StoredFile { size, sha256 }
}

#[test]
fn plain_files_are_copied_with_their_digests() {
    // As many files and bytes as may be.
    let pod = Pod::within(10, 3);
    pod.leave("predictions.csv", "hello");
    pod.leave("frames/ü 1/0001.json", "");
    fs::hard_link(pod.left().join("predictions.csv"), pod.left().join("same.csv")).unwrap();
    fs::create_dir(pod.left().join("no file in it")).unwrap();
    // What a copy that was cut has left.
    fs::write(pod.at("input/rest"), "x").unwrap();
    pod.collect().unwrap();
    let files = BTreeMap::from([
        ("frames/ü 1/0001.json".to_owned(), stored(0, EMPTY)),
        ("predictions.csv".to_owned(), stored(5, HELLO)),
        ("same.csv".to_owned(), stored(5, HELLO)),
    ]);
    assert_eq!(pod.list(), Some(Collected::new(files)));
    let paths = ["frames/ü 1/0001.json", "predictions.csv", "same.csv"];
    assert_eq!(pod.input(), paths.map(|path| format!("input/{path}")));
    assert_eq!(fs::read(pod.at("input/same.csv")).unwrap(), b"hello");
    let mode = fs::metadata(pod.at("input/same.csv")).unwrap().permissions().mode();
    assert_eq!(mode & 0o7777, 0o644);
}

#[test]
fn the_list_of_one_file_is_as_it_is_documented() {
    let pod = Pod::new();
    pod.leave("predictions.csv", "hello");
    pod.collect().unwrap();
    let text = fs::read_to_string(pod.at(COLLECTED)).unwrap();
    let expected = format!(r#"{{"schema":1,"files":{{"predictions.csv":{{"size":5,"sha256":"{HELLO}"}}}}}}"#);
    assert_eq!(text, expected);
}

fn sparse(at: &Path) {
    File::create(at.join("big.bin")).unwrap().set_len(10 << 30).unwrap();
}

fn folders(at: &Path, many: usize) {
    let deepest = at.join(vec!["d"; many].join("/"));
    fs::create_dir_all(&deepest).unwrap();
    fs::write(deepest.join("x"), "x").unwrap();
}

fn many_files(at: &Path) {
    for number in 0..1001 {
        fs::write(at.join(number.to_string()), "").unwrap();
    }
}

fn long_path(at: &Path) {
    let long = at.join(["l".repeat(250), "l".repeat(250)].join("/"));
    fs::create_dir_all(&long).unwrap();
}

/// The longest text that the path of a file can bring into a sentence.
fn long_name(at: &Path) {
    symlink("/etc/passwd", at.join("\u{1f600}".repeat(63))).unwrap();
}

type Leave = fn(&Path);

/// What an agent may leave, and a part of the reason for which it is refused.
const REFUSED: [(&str, Leave, &str); 17] = [
    ("nothing", |_| (), "has left no file"),
    (
        "no folder",
        |at| fs::remove_dir(at).unwrap(),
        "The agent has left no file",
    ),
    (
        "an empty folder",
        |at| fs::create_dir(at.join("empty")).unwrap(),
        "has left no file",
    ),
    (
        "a link to a file outside",
        |at| symlink("/etc/passwd", at.join("x.csv")).unwrap(),
        "x.csv in /submission can't be taken: it is neither a regular file nor a folder",
    ),
    (
        "a link to a folder",
        |at| symlink("/etc", at.join("way")).unwrap(),
        "way in /submission can't be taken: it is neither",
    ),
    (
        "a link to a file beside it",
        |at| {
            fs::write(at.join("a.csv"), "a").unwrap();
            symlink("a.csv", at.join("b.csv")).unwrap();
        },
        "b.csv in /submission can't be taken: it is neither",
    ),
    (
        "a link that leads nowhere",
        |at| symlink("nowhere", at.join("x")).unwrap(),
        "x in /submission can't be taken: it is neither",
    ),
    (
        "a pipe",
        |at| mkfifo(&at.join("pipe"), Mode::from_bits_truncate(0o666)).unwrap(),
        "pipe in /submission can't be taken: it is neither",
    ),
    (
        "a socket",
        |at| drop(UnixListener::bind(at.join("socket")).unwrap()),
        "socket in /submission can't be taken: it is neither",
    ),
    (
        "a sparse file of 10 GiB",
        sparse,
        "more than the 1073741824 bytes of evaluation.container.input.maxBytes, 10737418240 of them in big.bin",
    ),
    (
        "1001 files",
        many_files,
        "1001 files, more than the 1000 of evaluation.container.input.maxFiles",
    ),
    (
        "17 folders in each other",
        |at| folders(at, 17),
        "it lies in more than 16 folders",
    ),
    (
        "a control character",
        |at| fs::write(at.join("a\u{1b}[2Jb"), "x").unwrap(),
        "a\u{fffd}[2Jb in /submission can't be taken: its name",
    ),
    (
        "a line break",
        |at| fs::write(at.join("a\nb"), "x").unwrap(),
        "a b in /submission can't be taken: its name",
    ),
    (
        "no UTF-8",
        |at| fs::write(at.join(OsStr::from_bytes(b"a\xff")), "x").unwrap(),
        "a\u{fffd} in /submission can't be taken: its name",
    ),
    ("a path of 500 bytes", long_path, "or its path is too long"),
    ("a long name", long_name, "it is neither a regular file nor a folder"),
];

#[tokio::test]
async fn whatever_is_no_plain_file_within_the_bounds_is_the_participants_fault() {
    for (what, leave, why) in REFUSED {
        let pod = Pod::new();
        leave(&pod.left());
        // A copy that was cut.
        fs::write(pod.at("input/rest"), "x").unwrap();
        main(pod.run.clone(), pod.places.clone()).await.unwrap_err();
        let said = fs::read_to_string(&pod.places.termination_log).unwrap();
        // The share of each container, where there are 22.
        assert!(said.len() <= 550, "{what}: {} bytes", said.len());
        let verdict = WorkspaceVerdict::parse(&said).unwrap();
        assert_eq!(verdict.reason, WorkspaceReason::InputRefused, "{what}");
        let message = verdict.message;
        assert!(
            message.contains(why) && message.ends_with("submit again."),
            "{what}: {message}"
        );
        pod.assert_nothing_is_there(what);
    }
}

#[test]
fn sixteen_folders_are_as_deep_as_a_file_may_lie() {
    let pod = Pod::new();
    folders(&pod.left(), 16);
    pod.collect().unwrap();
    assert_eq!(pod.input(), [format!("input/{}/x", ["d"; 16].join("/"))]);
}

#[test]
fn one_byte_and_one_file_too_many_are_refused() {
    for (bytes, files, why) in [(9, 3, "more than the 9 bytes"), (10, 1, "2 files, more than the 1 of")] {
        let pod = Pod::within(bytes, files);
        pod.leave("a", "hello");
        pod.leave("b", "hello");
        let error = pod.collect().unwrap_err();
        assert!(error.to_string().contains(why), "{error}");
        pod.assert_nothing_is_there(why);
    }
}

#[test]
fn a_flood_of_folders_ends_at_a_number() {
    let pod = Pod::new();
    pod.leave("a", "a");
    for number in 0..ENTRIES {
        fs::create_dir(pod.left().join(format!("d{number}"))).unwrap();
    }
    let error = pod.collect().unwrap_err();
    assert!(
        error.to_string().contains("there are too many files and folders"),
        "{error}"
    );
}

#[test]
fn a_device_is_not_opened() {
    let pod = Pod::new();
    let node = Command::new("mknod")
        .arg(pod.left().join("zero"))
        .args(["c", "1", "5"])
        .stderr(Stdio::null())
        .status();
    if !node.unwrap().success() {
        println!("left out, as only root makes a device");
        return;
    }
    let error = pod.collect().unwrap_err();
    assert!(error.to_string().starts_with("zero in /submission"), "{error}");
}

/// Bytes of a file that grows whenever some are read.
struct Growing<'a>(&'a File, PathBuf);

impl Read for Growing<'_> {
    fn read(&mut self, into: &mut [u8]) -> io::Result<usize> {
        let mut more = File::options().append(true).open(&self.1)?;
        more.write_all(&[b'x'; 1024])?;
        self.0.read(into)
    }
}

#[test]
fn a_file_that_changes_while_it_is_copied_is_refused() {
    let changes: [Leave; 4] = [
        |at| fs::write(at, "hello, and more").unwrap(),
        |at| fs::write(at, "h").unwrap(),
        |at| fs::remove_file(at).unwrap(),
        |at| {
            fs::remove_file(at).unwrap();
            symlink("/etc/passwd", at).unwrap();
        },
    ];
    for change in changes {
        let pod = Pod::new();
        pod.leave("a", "hello");
        let files = find(&pod.tree(), &bounds(&pod.run)).unwrap();
        change(&pod.left().join("a"));
        let error = copy_all(&pod.tree(), &files).unwrap_err();
        assert_eq!(error.verdict().reason, WorkspaceReason::InputRefused, "{error}");
        assert!(pod.list().is_none());
    }
    let pod = Pod::new();
    pod.leave("a", "hello");
    let (file, stamp) = pod.tree().file("submission/a").unwrap().unwrap();
    let bytes = Growing(&file, pod.left().join("a"));
    let error = copy_from(&pod.tree(), "a", stamp, &file, bytes).unwrap_err();
    assert!(
        error
            .to_string()
            .contains("a in /submission can't be taken: it changed"),
        "{error}"
    );
    let copied = fs::metadata(pod.at("input/a")).unwrap().len();
    assert_eq!(copied, stamp.size + 1, "no more is copied than shows that it grew");
}

#[test]
fn what_is_copied_is_not_copied_again() {
    let pod = Pod::new();
    pod.leave("a", "hello");
    pod.collect().unwrap();
    // The agent of a Pod whose sandbox was made anew does not run again; if it did, it would change nothing.
    pod.leave("a", "other");
    pod.leave("b", "other");
    pod.collect().unwrap();
    assert_eq!(pod.input(), ["input/a"]);
    assert_eq!(fs::read(pod.at("input/a")).unwrap(), b"hello");
}

#[test]
fn copies_that_are_damaged_are_made_again_and_are_the_nodes_fault_where_they_cannot_be() {
    type Damage = fn(&Pod);
    let damages: [(&str, Damage); 4] = [
        ("other bytes", |pod| fs::write(pod.at("input/a"), "hallo").unwrap()),
        ("no copy", |pod| fs::remove_file(pod.at("input/a")).unwrap()),
        ("no bytes of the list", |pod| fs::write(pod.at(COLLECTED), "").unwrap()),
        ("another place", |pod| {
            let list = BTreeMap::from([("../submission/a".to_owned(), stored(5, HELLO))]);
            fs::write(pod.at(COLLECTED), Collected::new(list).to_json()).unwrap();
        }),
    ];
    for (what, damage) in damages {
        let pod = Pod::new();
        pod.leave("a", "hello");
        pod.collect().unwrap();
        damage(&pod);
        pod.collect().unwrap();
        assert_eq!(fs::read(pod.at("input/a")).unwrap(), b"hello", "{what}");
        // In a later Pod the agent has not run, since its files were there.
        fs::remove_file(pod.left().join("a")).unwrap();
        damage(&pod);
        for _ in 0..2 {
            let verdict = pod.collect().unwrap_err().verdict();
            assert_eq!(verdict.reason, WorkspaceReason::VolumeFailed, "{what}");
        }
    }
}

#[test]
fn a_run_that_is_to_stop_copies_nothing() {
    let pod = Pod::new();
    symlink("/etc/passwd", pod.left().join("x")).unwrap();
    StatusFile::Cancel.create(&pod.places.status()).unwrap();
    pod.collect().unwrap();
    pod.assert_nothing_is_there("cancelled");
}

#[test]
fn a_disk_that_fails_is_not_the_participants_fault() {
    let pod = Pod::new();
    pod.leave("a", "hello");
    let tree = pod.tree();
    let files = find(&tree, &bounds(&pod.run)).unwrap();
    for (errno, reason) in [
        (Errno::EIO, WorkspaceReason::VolumeFailed),
        (Errno::EMFILE, WorkspaceReason::VolumeFailed),
        (Errno::EACCES, WorkspaceReason::InputRefused),
    ] {
        *tree.disk.lock().unwrap() = Some(errno);
        let error = copy_all(&tree, &files).unwrap_err();
        assert_eq!(error.verdict().reason, reason, "{errno}: {error}");
    }
    // A folder is in the way of the copy.
    *tree.disk.lock().unwrap() = None;
    fs::remove_dir(pod.at("logcopy")).unwrap();
    fs::write(pod.at("logcopy"), "").unwrap();
    let error = copy_all(&tree, &files).unwrap_err();
    assert_eq!(error.verdict().reason, WorkspaceReason::VolumeFailed, "{error}");
}

#[test]
fn a_list_is_used_only_with_plain_paths_within_the_bounds() {
    let bounds: InputBounds = serde_json::from_value(json!({"maxBytes": "10", "maxFiles": 2})).unwrap();
    let list = |files: &[(&str, u64)]| {
        let files = files
            .iter()
            .map(|(path, size)| ((*path).to_owned(), stored(*size, HELLO)));
        Collected::new(files.collect()).to_json()
    };
    for (files, is_usable) in [
        (&[("a", 5), ("b/c", 5)][..], true),
        (&[], false),
        (&[("a", 5), ("b", 6)], false),
        (&[("a", u64::MAX), ("b", u64::MAX)], false),
        (&[("a", 1), ("b", 1), ("c", 1)], false),
        (&[("../x", 5)], false),
        (&[("/etc/x", 1)], false),
        (&[("a/../b", 1)], false),
        (&[("a//b", 1)], false),
        (&[("a/", 1)], false),
        (&[("", 1)], false),
        (&[("a\nb", 1)], false),
        (&[("a", 1), ("a/b", 1)], false),
    ] {
        assert_eq!(usable(&list(files), &bounds).is_some(), is_usable, "{files:?}");
    }
    assert_eq!(usable(b"{\"schema\": 2, \"files\": {}}", &bounds), None);
}
