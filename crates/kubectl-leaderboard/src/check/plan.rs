//! The Submission of a check: from the Leaderboard and what the person asks for to an object, or why there is none. Pure.

use kube::ResourceExt;
use leaderboard_api::check::NAME_PREFIX;
use leaderboard_api::{Leaderboard, names};
use serde_json::{Value, json};

/// Characters of the Leaderboard's name in the name of a check: with prefix and the API server's five letters at most 52.
const LONGEST: usize = 40;

/// What a person asks for.
#[derive(Clone, Copy, Debug, Default)]
pub struct Wanted<'a> {
    pub track: Option<&'a str>,
    pub image: Option<&'a str>,
}

/// The Submission to create, or why a check cannot begin, with the next step.
pub fn submission(leaderboard: &Leaderboard, wanted: Wanted<'_>) -> Result<Value, String> {
    let name = leaderboard.name_any();
    let known: Vec<&str> = leaderboard
        .spec
        .tracks
        .iter()
        .map(|track| track.name.as_str())
        .collect();
    let track = match wanted.track {
        Some(track) if !known.contains(&track) => {
            return Err(format!(
                "Leaderboard {name} has no track {track}. Give one of {}",
                known.join(", ")
            ));
        }
        Some(track) => track,
        None => known.first().copied().unwrap_or_default(),
    };
    let named = leaderboard.spec.check.as_ref().map(|check| check.image.as_str());
    let Some(image) = wanted.image.or(named) else {
        return Err(format!(
            "Leaderboard {name} names no image for a check. Give the image of an agent of your own with --image, or set \
             spec.check.image; examples/check-agent/Dockerfile makes one of the Leaderboard's NPC agent"
        ));
    };
    let short: String = name.chars().take(LONGEST).collect();
    Ok(json!({
        "apiVersion": format!("{}/{}", leaderboard_api::GROUP, leaderboard_api::VERSION),
        "kind": "Submission",
        "metadata": {
            "generateName": format!("{NAME_PREFIX}{}-", short.trim_end_matches('-')),
            "labels": {names::LABEL_LEADERBOARD: name},
        },
        "spec": {"leaderboardName": name, "track": track, "image": image, "check": true},
    }))
}

/// Why no single Leaderboard is meant where none is named, with the next step.
pub fn which(known: &[String], namespace: &str) -> String {
    match known {
        [] => format!("namespace {namespace} has no Leaderboard. Use -n for another namespace"),
        known => format!(
            "namespace {namespace} has several Leaderboards. Name one of {}",
            known.join(", ")
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn leaderboard(check: &Value) -> Leaderboard {
        let spec = json!({"tracks": [{"name": "sensors", "codename": "SENSORS"}, {"name": "map", "codename": "MAP"}],
                          "leaderboardVersion": "V2", "contents": {"image": "c"}, "simulator": {"image": "s"},
                          "storage": {"bucket": "b"}, "check": check});
        Leaderboard::new(
            &format!("{}-20", "carla".repeat(9)),
            serde_json::from_value(spec).unwrap(),
        )
    }

    #[test]
    fn track_and_image_have_defaults_and_a_name_fits_with_the_five_letters_of_the_api_server() {
        let board = leaderboard(&json!({"image": "host/baseline:1"}));
        let named = Wanted {
            track: Some("map"),
            image: Some("host/other:2"),
        };
        for (wanted, track, image) in [
            (Wanted::default(), "sensors", "host/baseline:1"),
            (named, "map", "host/other:2"),
        ] {
            let object = submission(&board, wanted).unwrap();
            assert_eq!(object["spec"]["track"], track);
            assert_eq!(object["spec"]["image"], image);
            assert_eq!(object["spec"]["check"], true);
            let name = object["metadata"]["generateName"].as_str().unwrap();
            assert!(
                name.starts_with("check-carla") && name.ends_with('-') && name.len() + 5 <= 52,
                "{name}"
            );
        }
    }

    #[test]
    fn what_is_missing_is_named_with_the_next_step() {
        let unknown = Wanted {
            track: Some("lidar"),
            image: None,
        };
        let without = leaderboard(&Value::Null);
        for (wanted, words) in [
            (unknown, "Give one of sensors, map"),
            (Wanted::default(), "with --image, or set spec.check.image"),
        ] {
            let why = submission(&without, wanted).unwrap_err();
            assert!(why.contains(words), "{why}");
        }
        let two = ["a".to_owned(), "b".to_owned()];
        assert!(which(&two, "carla").ends_with("Name one of a, b"));
        assert!(which(&[], "carla").starts_with("namespace carla has no Leaderboard."));
    }
}
