//! The logs of our own programs in the Pod: JSON lines on standard output and, up to a size, in a file of the `logs` volume.
//! logcopy sends both files to CloudWatch, and stores its own like any other log of the run.
//!
//! Called by the entry points of the programs in the Pod, once, before anything else.

use std::fs::{File, OpenOptions};
use std::io::{self, Write};
use std::path::Path;
use std::sync::Mutex;

use tracing_subscriber::EnvFilter;
use tracing_subscriber::fmt::writer::MakeWriterExt;

/// Bytes it may have.
const LIMIT: u64 = 16 << 20;
/// The last line: there is more than this file holds.
const LAST_LINE: &[u8] =
    b"{\"level\":\"WARN\",\"message\":\"this file has reached its limit; standard output goes on\"}\n";

/// A file that stops growing at a limit.
#[derive(Debug)]
pub struct Limited {
    file: File,
    /// Bytes that still fit.
    left: u64,
}

impl Limited {
    /// Goes on with the file, if there is one.
    pub fn open(path: &Path, limit: u64) -> io::Result<Self> {
        if let Some(folder) = path.parent() {
            std::fs::create_dir_all(folder)?;
        }
        let file = OpenOptions::new().append(true).create(true).open(path)?;
        let left = limit.saturating_sub(file.metadata()?.len());
        Ok(Self { file, left })
    }
}

impl Write for Limited {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if self.left == 0 {
            return Ok(bytes.len());
        }
        if let Some(left) = self.left.checked_sub(bytes.len() as u64) {
            self.left = left;
            self.file.write_all(bytes)?;
        } else {
            self.left = 0;
            self.file.write_all(LAST_LINE)?;
        }
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

/// Starts logging of this process: standard output, and the file `name` below the volume's root. `RUST_LOG` chooses what.
pub fn start(logs: &Path, name: &str) {
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("info"));
    let json = tracing_subscriber::fmt()
        .json()
        .flatten_event(true)
        .with_env_filter(filter);
    let file = Limited::open(&logs.join(name), LIMIT);
    // A second call in one process changes nothing, and logging is no reason to fail.
    let _ = match file {
        Ok(file) => json.with_writer(io::stdout.and(Mutex::new(file))).try_init(),
        Err(error) => {
            let started = json.try_init();
            tracing::warn!("{name} can't be written, standard output has everything: {error}");
            started
        }
    };
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_file_ends_with_a_note_at_its_limit() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("logcopy/logcopy.log");
        let mut log = Limited::open(&path, 10).unwrap();
        log.write_all(b"12345\n").unwrap();
        log = Limited::open(&path, 10).unwrap();
        log.write_all(b"123456\n").unwrap();
        log.write_all(b"1\n").unwrap();
        let text = std::fs::read(&path).unwrap();
        assert_eq!(text, [b"12345\n", LAST_LINE].concat());
    }
}
