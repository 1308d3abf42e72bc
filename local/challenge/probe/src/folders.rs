//! Attacks of an agent that runs as root on its own status folder, which the kubelet made as root. Called by `modes`.

use std::ffi::{CStr, CString};
use std::fs;
use std::io;
use std::os::unix::ffi::OsStrExt as _;
use std::path::{Path, PathBuf};

use nix::libc;

use crate::call::{call, of};

/// An access control list's name as an extended attribute.
const ACCESS_LIST: &CStr = c"system.posix_acl_access";
/// The tags of its entries.
const OWNER: u16 = 0x01;
const USER: u16 = 0x02;
const GROUP: u16 = 0x04;
const MASK: u16 = 0x10;
const OTHERS: u16 = 0x20;

/// The status folder of a pair's agent.
pub(crate) fn of_agent(pair: u16) -> PathBuf {
    format!("/tmp/status/agent-{pair}").into()
}

/// Deletes all that is in it, and then tries to delete it or to move it away.
pub(crate) fn delete(folder: &Path) -> io::Result<()> {
    for entry in fs::read_dir(folder)? {
        fs::remove_file(entry?.path())?;
    }
    fs::remove_dir(folder).or_else(|_| fs::rename(folder, folder.with_extension("away")))
}

/// Takes it from these users, whatever its mode is.
pub(crate) fn forbid(folder: &Path, users: &[u32]) -> io::Result<()> {
    let path = CString::new(folder.as_os_str().as_bytes())?;
    let list = list(users);
    let arguments = [
        path.as_ptr().expose_provenance(),
        ACCESS_LIST.as_ptr().expose_provenance(),
        list.as_ptr().expose_provenance(),
        list.len(),
    ];
    call(libc::SYS_setxattr, of(arguments))?;
    Ok(())
}

/// An access control list as the kernel takes it: version 2, then tag, rights and user of each entry, by their tags and users.
fn list(users: &[u32]) -> Vec<u8> {
    const ALL: u16 = 7;
    const NOBODY: u32 = u32::MAX;
    let mut users = users.to_vec();
    users.sort_unstable();
    let mut entries = vec![(OWNER, ALL, NOBODY)];
    entries.extend(users.into_iter().map(|user| (USER, 0, user)));
    entries.extend([GROUP, MASK, OTHERS].map(|tag| (tag, ALL, NOBODY)));
    let mut bytes = 2_u32.to_le_bytes().to_vec();
    for (tag, rights, user) in entries {
        bytes.extend(tag.to_le_bytes());
        bytes.extend(rights.to_le_bytes());
        bytes.extend(user.to_le_bytes());
    }
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_list_is_one_that_the_kernel_takes() {
        let folder = std::env::temp_dir().join(format!("probe-folders-{}", std::process::id()));
        fs::create_dir(&folder).unwrap();
        let set = forbid(&folder, &[65532, 1000]);
        fs::remove_dir(&folder).unwrap();
        // A file system without such lists reports that; a list that is none would be an invalid argument.
        let code = set.err().and_then(|error| error.raw_os_error());
        assert!(matches!(code, None | Some(libc::EOPNOTSUPP)), "{code:?}");
    }
}
