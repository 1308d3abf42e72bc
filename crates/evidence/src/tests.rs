use std::fs;
use std::os::unix::fs::{PermissionsExt, symlink};

use super::*;

fn tree() -> (tempfile::TempDir, Tree) {
    let folder = tempfile::tempdir().unwrap();
    fs::create_dir_all(folder.path().join("agent/agent1")).unwrap();
    let tree = Tree::open(folder.path()).unwrap();
    (folder, tree)
}

#[test]
fn paths_that_lead_elsewhere_are_not_plain() {
    for bad in [
        "",
        "/etc/passwd",
        "a/../b",
        "..",
        ".",
        "a//b",
        "a/",
        "a\nb",
        &"x".repeat(481),
    ] {
        assert!(!is_plain(bad), "{bad:?}");
    }
    for good in ["a", "agent/agent1/leaderboard.log", "simulator/ü b/…", ".hidden"] {
        assert!(is_plain(good), "{good:?}");
    }
}

#[test]
fn links_pipes_and_folders_are_no_files() {
    let (folder, tree) = tree();
    let at = |name: &str| folder.path().join("agent/agent1").join(name);
    let outside = tempfile::tempdir().unwrap();
    fs::write(outside.path().join("secret"), "s").unwrap();
    symlink(outside.path().join("secret"), at("link")).unwrap();
    symlink(outside.path(), at("way")).unwrap();
    nix::unistd::mkfifo(&at("pipe"), Mode::from_bits_truncate(0o666)).unwrap();
    fs::create_dir(at("folder")).unwrap();
    fs::write(at("plain"), "p").unwrap();
    for name in ["link", "way/secret", "pipe", "folder"] {
        let error = tree.read(&format!("agent/agent1/{name}"), 10).unwrap_err();
        assert!(matches!(error, TreeError::NotRegular), "{name}: {error}");
        let flags = OFlag::O_RDONLY | OFlag::O_NONBLOCK | OFlag::O_NOFOLLOW;
        let by_steps = tree.step_by_step(&format!("agent/agent1/{name}"), flags);
        assert_eq!(by_steps.is_err(), name.starts_with(['l', 'w']), "{name}");
    }
    assert!(tree.read("agent/agent1/nothing", 10).unwrap().is_none());
    assert_eq!(tree.read("agent/agent1/plain", 1).unwrap().unwrap().0, b"p");
    let walk = tree.walk("agent/agent1", 100);
    assert_eq!(walk.files.keys().collect::<Vec<_>>(), ["agent/agent1/plain"]);
    assert_eq!(walk.left_out, 3);
}

#[test]
fn a_file_beyond_the_limit_is_not_read() {
    let (folder, tree) = tree();
    fs::write(folder.path().join("agent/x"), [0; 11]).unwrap();
    let error = tree.read("agent/x", 10).unwrap_err();
    assert!(matches!(error, TreeError::TooLarge { size: 11, limit: 10 }), "{error}");
}

#[test]
fn a_flood_of_files_costs_no_more_than_the_limit() {
    let (folder, tree) = tree();
    for i in 0..50 {
        fs::write(folder.path().join(format!("agent/agent1/{i}")), "").unwrap();
    }
    let walk = tree.walk("agent", 10);
    assert_eq!(walk.files.len(), 9);
    assert!(walk.left_out > 0 && walk.hides);
    assert_eq!(tree.walk("agent", 51).left_out, 0);
    assert_eq!(tree.walk("nothing", 10), Walk::default());
}

#[test]
fn what_is_made_here_is_for_every_user() {
    let (folder, tree) = tree();
    drop(tree.create("simulator/a/b.log").unwrap());
    tree.write("evalai/results.json", b"[]").unwrap();
    tree.write("evalai/results.json", b"[1]").unwrap();
    let mode = |path: &str| fs::metadata(folder.path().join(path)).unwrap().permissions().mode() & 0o7777;
    assert_eq!(
        [mode("simulator/a/b.log"), mode("simulator/a"), mode("simulator")],
        [0o666, 0o777, 0o777]
    );
    assert_eq!(fs::read(folder.path().join("evalai/results.json")).unwrap(), b"[1]");
    assert_eq!(tree.walk("evalai", 10).files.len(), 1);
}

#[test]
fn restored_files_never_go_through_a_link() {
    let (folder, tree) = tree();
    let outside = tempfile::tempdir().unwrap();
    symlink(outside.path(), folder.path().join("simulator")).unwrap();
    assert!(tree.create("simulator/x").is_err());
    assert!(tree.create("a/../../x").is_err());
    assert_eq!(fs::read_dir(outside.path()).unwrap().count(), 0);
}

#[test]
fn nothing_of_another_mount_is_read() {
    let tree = Tree::open(Path::new("/")).unwrap();
    let error = tree.file("proc/version").unwrap_err();
    assert!(matches!(error, TreeError::NotRegular), "{error}");
    assert_eq!(
        tree.walk("proc", 10).first,
        Some(("proc".to_owned(), LeftOut::NotRegular))
    );
}

#[test]
fn the_first_entry_that_is_left_out_is_named_with_the_reason() {
    type Make = fn(&Path);
    let deep = |many: usize| vec!["d"; many].join("/");
    let too_deep = deep(MAX_DEPTH + 1);
    let table: [(&str, Make, LeftOut, bool); 5] = [
        (
            "link",
            |at| symlink("/etc/passwd", at).unwrap(),
            LeftOut::NotRegular,
            false,
        ),
        ("way", |at| symlink("/etc", at).unwrap(), LeftOut::NotRegular, false),
        (
            "pipe",
            |at| nix::unistd::mkfifo(at, Mode::from_bits_truncate(0o666)).unwrap(),
            LeftOut::NotRegular,
            false,
        ),
        ("a\nb", |at| fs::write(at, "x").unwrap(), LeftOut::Name, true),
        (&too_deep, |at| fs::create_dir_all(at).unwrap(), LeftOut::Deep, true),
    ];
    for (name, make, why, hides) in table {
        let (folder, tree) = tree();
        make(&folder.path().join("agent").join(name));
        let walk = tree.walk("agent", 100);
        assert_eq!((walk.left_out, walk.first), (1, Some((format!("agent/{name}"), why))));
        assert_eq!(walk.hides, hides, "{name}");
    }
    let (folder, tree) = tree();
    fs::create_dir_all(folder.path().join("agent").join(deep(MAX_DEPTH))).unwrap();
    fs::write(folder.path().join("agent").join(deep(MAX_DEPTH)).join("x"), "x").unwrap();
    let walk = tree.walk("agent", 100);
    assert_eq!((walk.files.len(), walk.first), (1, None));
    for (errno, is_theirs) in [(Errno::EACCES, true), (Errno::EIO, false), (Errno::EMFILE, false)] {
        assert_eq!(LeftOut::Unreadable(errno).is_the_writers(), is_theirs, "{errno}");
    }
}

#[test]
fn a_folder_is_emptied_and_a_link_in_its_place_is_not_followed() {
    let (folder, tree) = tree();
    let at = |path: &str| folder.path().join(path);
    fs::create_dir_all(at("input/a/b")).unwrap();
    fs::write(at("input/a/x"), "x").unwrap();
    let outside = tempfile::tempdir().unwrap();
    fs::write(outside.path().join("kept"), "x").unwrap();
    symlink(outside.path(), at("input/way")).unwrap();
    for _ in 0..2 {
        tree.clear("input").unwrap();
        assert_eq!(fs::read_dir(at("input")).unwrap().count(), 0);
    }
    fs::remove_dir(at("input")).unwrap();
    symlink(outside.path(), at("input")).unwrap();
    let _ = tree.clear("input");
    assert!(outside.path().join("kept").exists());
    assert!(matches!(tree.clear("../x"), Err(TreeError::Path)));
}
