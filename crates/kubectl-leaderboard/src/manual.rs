//! `man`: a manual page of each command, made of what `--help` shows.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::{Args, Command};

use crate::error::Error;
use crate::output::print;

/// Where the pages go.
#[derive(Args, Debug)]
pub struct Man {
    /// Folder of the pages; it is made if it is missing.
    folder: PathBuf,
}

/// Writes the pages.
pub fn write(command: Command, wanted: &Man) -> Result<ExitCode, Error> {
    let folder = &wanted.folder;
    let failed = |error| Error::File(folder.display().to_string(), error);
    std::fs::create_dir_all(folder).map_err(failed)?;
    clap_mangen::generate_to(command, folder).map_err(failed)?;
    print(&[format!("Wrote the manual pages to {}.", folder.display())]);
    Ok(ExitCode::SUCCESS)
}
