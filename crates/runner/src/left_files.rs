//! Files that an agent without a peer has left, made readable for the container that copies them. Called by `run`.
//!
//! That container runs as another user, who has no capabilities. Programs often leave files that their own user alone may read, such as
//! those of Python's `tempfile`. The runner has the agent's user and mounts, so it can change nothing here that the agent could not.

use std::fs::{self, Permissions};
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

/// Most files and folders that are looked at. `collect` takes no more of them.
pub(crate) const ENTRIES: usize = 20_000;

/// Lets all users read regular files and list folders below this one, at most so many. Links are not followed.
pub(crate) fn make_readable(folder: &Path, mut most: usize) {
    let mut paths = vec![folder.to_owned()];
    while let Some(path) = paths.pop() {
        let Ok(metadata) = fs::symlink_metadata(&path) else {
            continue;
        };
        let rights = match metadata.file_type() {
            kind if kind.is_dir() => 0o555,
            kind if kind.is_file() => 0o444,
            _ => continue,
        };
        let mode = metadata.permissions().mode() & 0o7777;
        // What fails is another user's. It may be readable as it is, and else `collect` names it.
        let _ = fs::set_permissions(&path, Permissions::from_mode(mode | rights));
        if metadata.is_dir() {
            for entry in fs::read_dir(&path).into_iter().flatten().flatten().take(most) {
                most -= 1;
                paths.push(entry.path());
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;
    use std::os::unix::net::UnixListener;

    use super::*;

    fn mode(path: &Path) -> u32 {
        fs::symlink_metadata(path).unwrap().permissions().mode() & 0o7777
    }

    #[test]
    fn files_and_folders_become_readable_and_nothing_else_changes() {
        let folder = tempfile::tempdir().unwrap();
        let at = |path: &str| folder.path().join(path);
        for path in ["left/in/deep", "other"] {
            fs::create_dir_all(at(path)).unwrap();
        }
        for path in [
            "outside",
            "other/file",
            "left/file",
            "left/in/tool",
            "left/in/deep/file",
        ] {
            fs::write(at(path), "").unwrap();
        }
        for (target, link) in [("outside", "left/link"), ("other", "left/in/link")] {
            symlink(at(target), at(link)).unwrap();
        }
        let _socket = UnixListener::bind(at("left/socket")).unwrap();
        // What is inside a folder comes before it.
        let cases = [
            ("outside", 0o600, 0o600),
            ("other/file", 0o600, 0o600),
            ("other", 0o700, 0o700),
            ("left/file", 0o640, 0o644),
            ("left/socket", 0o600, 0o600),
            ("left/in/tool", 0o700, 0o744),
            ("left/in/deep/file", 0, 0o444),
            ("left/in/deep", 0o200, 0o755),
            ("left/in", 0o300, 0o755),
            ("left", 0o700, 0o755),
        ];
        for (path, before, _) in cases {
            fs::set_permissions(at(path), Permissions::from_mode(before)).unwrap();
        }
        make_readable(&at("left"), ENTRIES);
        for (path, _, after) in cases {
            let found = mode(&at(path));
            assert_eq!(found, after, "{path}: {found:o}");
        }
    }

    #[test]
    fn no_more_entries_are_looked_at_than_the_bound() {
        let folder = tempfile::tempdir().unwrap();
        let files: Vec<_> = (0..5).map(|number| folder.path().join(number.to_string())).collect();
        for file in &files {
            fs::write(file, "").unwrap();
            fs::set_permissions(file, Permissions::from_mode(0o600)).unwrap();
        }
        make_readable(folder.path(), 3);
        assert_eq!(files.iter().filter(|file| mode(file) == 0o644).count(), 3);
    }
}
