//! `submit --file`: the person's own program `aws` puts a file into the bucket, and then the Submission that names it is created.
//!
//! Called by `changes`. `measured` reads the file.

use std::fs::{File, metadata};
use std::io::Read as _;
use std::path::Path;

use kube::ResourceExt;
use leaderboard_api::{Evaluation, Leaderboard, SubmittedFile, effective};
use serde_json::{Value, json};
use sha2::{Digest as _, Sha256};

use crate::aws::{self, Unread};
use crate::board::Observed;
use crate::cluster::Cluster;
use crate::commands::frame;
use crate::error::{Error, no_leaderboards};
use crate::foreign;
use crate::output::{ask, print};
use crate::submit::Submit;
use crate::text::wrap;

/// Key of the file below the prefix of its run.
const KEY: &str = "input/file";
/// Bytes that are read at once.
const PIECE: usize = 1 << 20;

/// Puts the file where the submission's Pods read it, and completes the object to create.
pub async fn upload(
    cluster: &Cluster,
    wanted: &Submit,
    path: &Path,
    leaderboard: Observed<'_>,
    object: &mut Value,
) -> Result<(), Error> {
    let Some(board) = leaderboard.leaderboard() else {
        return Err(no_leaderboards());
    };
    object["spec"]["input"] = json!(measured(path, board)?);
    let storage = &board.spec.storage.s3;
    let of = format!("Leaderboard {}", wanted.leaderboard);
    foreign::confirm(&of, Some(storage), wanted.endpoint.as_deref(), ask)?;
    // The name is part of the key. The API server chooses it, or refuses the object before anything is written.
    let tried = cluster.create(object, true).await?;
    (object["metadata"]["name"], object["metadata"]["generateName"]) = (json!(tried.name_any()), Value::Null);
    let address = format!("{}/{KEY}", effective::results_url(storage, &tried.run_id()));
    print(&wrap(
        &format!("Copying {} to {address}.", path.display()),
        frame().width,
    ));
    // A file that is named like a flag or like an address is a file all the same.
    let from = Path::new(".").join(path).display().to_string();
    let mut arguments = aws::copy(&from, &address, Some(storage));
    if let Some(key) = &storage.kms_key_arn {
        arguments.insert(2, "--sse=aws:kms".to_owned());
        arguments.insert(3, format!("--sse-kms-key-id={key}"));
    }
    aws::run(&arguments, |_| {}).await.map_err(|error| {
        Error::Unfit(match error {
            Unread::NoProgram => "the program aws is not on the PATH. Install it, and submit again".to_owned(),
            Unread::Failed(why) => {
                format!("cannot write {address}: {why}. Check that your AWS credentials may write to the bucket")
            }
        })
    })
}

/// Digest and size of a file that the Leaderboard takes.
fn measured(path: &Path, leaderboard: &Leaderboard) -> Result<SubmittedFile, Error> {
    let shown = path.display();
    let failed = |error| Error::Unread(shown.to_string(), error);
    let found = metadata(path).map_err(failed)?;
    if !found.is_file() {
        return Err(Error::Unfit(format!("{shown} is no regular file. Name another file")));
    }
    let most = match &leaderboard.spec.evaluation {
        Evaluation::Carla(_) => 0,
        Evaluation::Container(container) => container.input_bounds().max_bytes.bytes(),
    };
    if found.len() > most {
        return Err(Error::Unfit(format!(
            "{shown} has {} bytes. The Leaderboard takes at most {most} (evaluation.container.input.maxBytes): make the file smaller",
            found.len()
        )));
    }
    let mut file = File::open(path).map_err(failed)?;
    let (mut digest, mut bytes, mut piece) = (Sha256::new(), 0, vec![0; PIECE]);
    loop {
        let read = file.read(&mut piece).map_err(failed)?;
        if read == 0 {
            break;
        }
        digest.update(piece.get(..read).unwrap_or_default());
        bytes += i64::try_from(read).unwrap_or_default();
    }
    Ok(SubmittedFile {
        sha256: hex::encode(digest.finalize()),
        size: bytes,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A Leaderboard of files that have at most so many bytes.
    fn leaderboard(most: &str) -> Leaderboard {
        let container = json!({"mode": "Predictions", "image": "evaluator:1", "command": ["evaluate"], "input": {"maxBytes": most}});
        let spec = json!({
            "tracks": [{"name": "test", "container": {"score": {"metric": "accuracy"}}}],
            "evaluation": {"container": container}, "storage": {"s3": {"bucket": "results"}},
        });
        Leaderboard::new("digits", serde_json::from_value(spec).unwrap())
    }

    #[test]
    fn a_file_is_measured_and_what_the_leaderboard_does_not_take_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("predictions.csv");
        std::fs::write(&path, "abc").unwrap();
        let found = measured(&path, &leaderboard("3")).unwrap();
        let digest = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";
        assert_eq!((found.sha256.as_str(), found.size), (digest, 3));
        let missing = folder.path().join("missing");
        for (path, most, expected) in [
            (path.as_path(), "2", "has 3 bytes. The Leaderboard takes at most 2 "),
            (folder.path(), "1Gi", "is no regular file"),
            (missing.as_path(), "1Gi", "cannot read "),
        ] {
            let why = measured(path, &leaderboard(most)).unwrap_err().to_string();
            assert!(why.contains(expected), "{why}");
        }
    }

    /// Larger than what is read at once.
    #[test]
    fn a_file_is_measured_to_its_end() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("large");
        let content = vec![7; PIECE + 5];
        std::fs::write(&path, &content).unwrap();
        let found = measured(&path, &leaderboard("1Gi")).unwrap();
        assert_eq!(found.sha256, hex::encode(Sha256::digest(&content)));
        assert_eq!(found.size, i64::try_from(content.len()).unwrap());
    }
}
