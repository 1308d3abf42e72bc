//! Copies of the files by which the Pod's containers resolve names, for the containers of strangers to read.
//!
//! The kubelet gives all containers of a Pod one /etc/hosts, and the container engine one /etc/resolv.conf and /etc/hostname, all writable: an
//! agent that runs as root could lead `logcopy` to an S3 of its own. Simulators and agents have these copies mounted over them, read-only.
//! Called by `workspace`.

use std::fs;
use std::io;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

use super::places::Places;
use super::workspace::error::WorkspaceError;
use leaderboard_contract::run::NAME_FILES;

/// Copies all of them, also when they are there already: a Pod whose node was restarted has another address.
pub(super) fn copy(places: &Places) -> Result<(), WorkspaceError> {
    for path in NAME_FILES.map(|path| path.trim_start_matches('/')) {
        let target = places.tools.join(path);
        copy_one(&places.root.join(path), &target).map_err(|error| {
            let path = target.display().to_string();
            WorkspaceError::NameFile { path, error }
        })?;
    }
    Ok(())
}

fn copy_one(source: &Path, target: &Path) -> io::Result<()> {
    let bytes = match fs::read(source) {
        // The kubelet would make a folder of a missing source, and no program could read that.
        Err(error) if error.kind() == io::ErrorKind::NotFound => Vec::new(),
        other => other?,
    };
    if let Some(folder) = target.parent() {
        fs::create_dir_all(folder)?;
        fs::set_permissions(folder, fs::Permissions::from_mode(0o755))?;
    }
    let temporary = target.with_extension("tmp");
    fs::write(&temporary, bytes)?;
    fs::set_permissions(&temporary, fs::Permissions::from_mode(0o644))?;
    fs::rename(&temporary, target)
}
