//! Opens an agent's status folder again after an agent has shut other users out of it.
//!
//! The kubelet makes the folder as root. An agent that runs as root owns it, as its runner does, and can take it from everybody else by
//! its mode or by an access control list. Its simulator and `logcopy` run as other users: they would wait for an end that they cannot
//! see. Called by `run` while no process of the agent lives.

use std::fs::{self, Permissions};
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

/// Such a list can name users who may not look, whatever the mode is.
const ACCESS_LIST: &str = "system.posix_acl_access";
/// Rights that let a reader look for names and watch, and the runner write.
const OPEN: u32 = 0o755;

/// Opens the folder again. A container that does not own it could not shut it either.
pub(crate) fn reopen(folder: &Path) {
    // Few folders have one, and some file systems keep none.
    let _ = rustix::fs::lremovexattr(folder, ACCESS_LIST);
    let Ok(metadata) = fs::symlink_metadata(folder) else {
        return;
    };
    let mode = metadata.permissions().mode() & 0o7777;
    if !metadata.is_dir() || mode & OPEN == OPEN {
        return;
    }
    match fs::set_permissions(folder, Permissions::from_mode(mode | OPEN)) {
        Ok(()) => crate::say(format_args!(
            "{} had the mode {mode:o}; it is open to the other containers again",
            folder.display()
        )),
        Err(error) => crate::say(format_args!("the mode of {} stays as it is: {error}", folder.display())),
    }
}
