//! Errors of the kernel before the command runs: the image's, or the node's. Called by `launch` and `run`. Pure.

use std::io;

use nix::errno::Errno;

use crate::decide::Cause;
use crate::group::spawn_code;

/// The end that follows when a command cannot be started. An image is blamed for what only its files and variables bring about; it
/// has no part in anything else, which another node may not have.
pub(crate) fn of_spawn(error: &io::Error) -> Cause {
    match error.raw_os_error().map(Errno::from_raw) {
        // Without a number it is not the kernel's: a word of the command that no command can have.
        None
        | Some(
            Errno::ENOENT
            | Errno::ENOTDIR
            | Errno::EISDIR
            | Errno::ELOOP
            | Errno::ENAMETOOLONG
            | Errno::EACCES
            | Errno::EPERM
            | Errno::ENOEXEC
            | Errno::ELIBBAD
            | Errno::EINVAL
            | Errno::E2BIG,
        ) => Cause::CannotStart(spawn_code(error)),
        Some(Errno::EAGAIN) => Cause::NoProcess,
        Some(_) => Cause::NodeRefused,
    }
}

/// True if the node refuses a file, in any folder: it lacks open files, memory or disk, or its disk fails.
pub(crate) fn is_nodes(error: &io::Error) -> bool {
    let number = error.raw_os_error().map(Errno::from_raw);
    matches!(
        number,
        Some(Errno::ENFILE | Errno::EMFILE | Errno::ENOMEM | Errno::EAGAIN | Errno::ENOSPC | Errno::EIO)
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_image_is_blamed_only_for_what_it_alone_can_bring_about() {
        let of = |errno: Errno| of_spawn(&io::Error::from(errno));
        assert_eq!(of(Errno::ENOENT), Cause::CannotStart(127));
        for errno in [Errno::ENOEXEC, Errno::EACCES, Errno::ELOOP, Errno::E2BIG] {
            assert_eq!(of(errno), Cause::CannotStart(126), "{errno}");
        }
        for errno in [
            Errno::ENFILE,
            Errno::EMFILE,
            Errno::ENOMEM,
            Errno::EIO,
            Errno::ENOSPC,
            Errno::ESTALE,
        ] {
            assert_eq!(of(errno), Cause::NodeRefused, "{errno}");
        }
        assert_eq!(of(Errno::EAGAIN), Cause::NoProcess);
        assert_eq!(of_spawn(&io::Error::other("a NUL")), Cause::CannotStart(126));
    }

    #[test]
    fn a_folder_that_its_owner_has_spoiled_is_not_the_nodes_doing() {
        let is = |errno: Errno| is_nodes(&io::Error::from(errno));
        for errno in [Errno::ENFILE, Errno::EMFILE, Errno::EIO, Errno::ENOSPC] {
            assert!(is(errno), "{errno}");
        }
        for errno in [
            Errno::EACCES,
            Errno::ENOENT,
            Errno::EISDIR,
            Errno::ENOTDIR,
            Errno::EROFS,
        ] {
            assert!(!is(errno), "{errno}");
        }
    }
}
