//! Commands about a run's objects in its bucket, for people to copy: the plugin itself reads no bucket.

use std::path::Path;

use leaderboard_api::S3Bucket;

use crate::aws;

/// Prints one object.
pub fn print(object: &str, storage: Option<&S3Bucket>) -> String {
    format!("aws s3 cp {} -{}", word(object), flags(storage))
}

/// Lists what a run has stored, or copies it into a folder.
pub fn folder(results: &str, folder: Option<&Path>, storage: Option<&S3Bucket>) -> String {
    let (from, flags) = (word(&format!("{results}/")), flags(storage));
    match folder {
        Some(folder) => format!(
            "aws s3 cp --recursive {from} {}{flags}",
            word(&folder.display().to_string())
        ),
        None => format!("aws s3 ls --recursive {from}{flags}"),
    }
}

/// A word of a command that people copy. An imported address is a text of a table's row, so a shell must not run any part of it.
fn word(text: &str) -> String {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || "/._:-=@+,".contains(c);
    if text.chars().all(is_plain) {
        text.to_owned()
    } else {
        format!("'{}'", text.replace('\'', r"'\''"))
    }
}

/// Where a bucket is, as flags of `aws`.
fn flags(storage: Option<&S3Bucket>) -> String {
    let flags = aws::place(storage).map(|(flag, value)| format!(" {flag} {}", word(value)));
    flags.collect()
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn no_part_of_an_address_is_a_command() {
        let hostile = "s3://b/$(reboot)';reboot;#";
        let quoted = r"'s3://b/$(reboot)'\'';reboot;#'";
        assert_eq!(print(hostile, None), format!("aws s3 cp {quoted} -"));
    }

    #[test]
    fn the_place_of_the_bucket_is_in_the_command() {
        let storage = json!({"bucket": "b", "region": "eu-west-1", "endpoint": "https://s3.example"});
        let storage: S3Bucket = serde_json::from_value(storage).unwrap();
        assert_eq!(
            print("s3://b/1/a.log", Some(&storage)),
            "aws s3 cp s3://b/1/a.log - --region eu-west-1 --endpoint-url https://s3.example"
        );
    }
}
