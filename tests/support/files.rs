//! Waiting for a file that a program under test makes.

use std::path::Path;

use leaderboard_pod::watch::Watch;

/// Folders above a file that may not exist yet.
const DEPTH: usize = 3;

/// Waits until the file is there, without a limit of its own.
pub async fn until_there(file: &Path) {
    let watch = Watch::new(|_| true).unwrap();
    let folders: Vec<_> = file.ancestors().skip(1).take(DEPTH).collect();
    loop {
        // From the outside in: a folder that is made meanwhile wakes by the one around it.
        for folder in folders.iter().rev() {
            watch.add(folder);
        }
        if file.symlink_metadata().is_ok() {
            return;
        }
        watch.changed().await;
    }
}
