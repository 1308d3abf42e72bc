use leaderboard_api::{Display, GpuMode, Leaderboard, LeaderboardSpec, LeaderboardVersion, effective};
use serde_json::json;

use super::*;
use crate::import::entries::{Entries, answers, parse};
use crate::import::samples_tests::{TOKEN, Texts, answer, board, entries, texts};
use crate::tests::golden::assert_golden;

const URL: &str = "https://sqs.us-west-2.amazonaws.com/123456789012/leaderboard";

fn yaml_of(entries: &Entries) -> String {
    let wanted = Import {
        files: vec![],
        challenge: 2098,
        queue: URL.parse().unwrap(),
    };
    yaml(&parse(entries).unwrap(), &wanted, "leaderboard")
}

fn printed(texts: &Texts) -> String {
    yaml_of(&entries(texts))
}

fn documents(text: &str) -> Vec<Value> {
    serde_saphyr::from_multiple(text).unwrap()
}

fn specs(text: &str) -> Vec<LeaderboardSpec> {
    let boards = documents(text)
        .into_iter()
        .filter(|object| object["kind"] == "Leaderboard");
    let read = |object| serde_json::from_value::<Leaderboard>(object).unwrap().spec;
    boards.map(read).collect()
}

#[test]
fn the_manifests_are_printed_as_their_file_shows() {
    let text = printed(&texts());
    assert_golden("import", &text);
    assert!(text.lines().all(|line| line.chars().count() <= 120), "{text}");
    assert!(!text.contains(TOKEN), "the token stays where it is");
    let kinds: Vec<_> = documents(&text).iter().map(|object| object["kind"].clone()).collect();
    assert_eq!(kinds, ["Namespace", "ServiceAccount", "Leaderboard", "Leaderboard"]);
}

#[test]
fn the_documentation_shows_what_is_printed() {
    let mut all = texts();
    all.remove("leaderboard-10");
    let text = printed(&all);
    let (_, manifests) = text.split_once("---\n").unwrap();
    let page = include_str!("../../../../../docs/import.md");
    let wanted = format!("```yaml\n{manifests}```\n");
    assert!(page.contains(&wanted), "docs/import.md does not show this:\n{wanted}");
}

#[test]
fn both_leaderboards_run_what_the_original_ran() {
    let specs = specs(&printed(&texts()));
    assert_eq!(specs.len(), 2);
    for (spec, (version, repetitions)) in specs
        .iter()
        .zip([(LeaderboardVersion::V1, 5), (LeaderboardVersion::V2, 1)])
    {
        let carla = spec.evaluation.carla().unwrap();
        assert_eq!(carla.version, version);
        assert_eq!(spec.deadlines.run_seconds, None);
        let evalai = spec.evalai.as_ref().unwrap();
        assert_eq!((evalai.challenge, evalai.requests_per_minute), (2098, 54));
        let token = evalai.token.secrets_manager.as_ref().unwrap();
        assert_eq!((token.id.as_str(), token.key.as_str()), ("evalai", "auth_token"));
        assert_eq!(token.region.as_deref(), Some("us-west-2"));
        let queue = spec.sqs().unwrap();
        assert_eq!((queue.url.as_str(), queue.region.as_deref()), (URL, Some("us-west-2")));
        let scenarios = spec.tracks.iter().all(|track| track.carla.scenarios_file.is_some());
        assert_eq!(scenarios, version == LeaderboardVersion::V1);
        assert_eq!(
            carla.simulator.security_context.as_ref().unwrap().privileged,
            Some(true)
        );
        let gpu = spec.gpu.as_ref().unwrap();
        assert_eq!(gpu.mode, Some(GpuMode::NodeIndex));
        assert_eq!(gpu.resource_name.as_deref(), Some("nvidia.com/gpu"));
        let is_on_screen = carla.simulator.display == Display::X11Socket;
        assert_eq!(is_on_screen, version == LeaderboardVersion::V2);
        for track in &spec.tracks {
            let shape = effective::shape(carla, track);
            let slices: Vec<_> = shape.slices.iter().map(ToString::to_string).collect();
            assert_eq!(slices, ["0-4", "5-9", "10-14", "15-19"]);
            assert_eq!(shape.repetitions, repetitions);
            assert_eq!(track.node_selector["node.kubernetes.io/instance-type"], "g5.12xlarge");
            let taint = json!([{"key": "nvidia.com/gpu", "operator": "Exists", "effect": "NoSchedule"}]);
            assert_eq!(json!(track.tolerations), taint);
        }
    }
}

#[test]
fn an_entry_without_a_log_group_leaves_a_comment() {
    let mut all = texts();
    let twenty = all.get_mut("leaderboard-20").unwrap();
    twenty.as_object_mut().unwrap().remove("cloudwatch_log_group");
    let text = printed(&all);
    assert!(
        text.contains("  # To decide: logs.cloudWatch, a group of CloudWatch Logs;"),
        "{text}"
    );
    let groups: Vec<_> = specs(&text).iter().map(|spec| spec.logs.is_some()).collect();
    assert_eq!(groups, [true, false]);
    assert!(text.contains("#     logGroups: [\"leaderboard-10\"]\n"), "{text}");
}

#[test]
fn two_phases_of_one_track_have_names_of_their_own() {
    let names = |phases: Value| {
        let mut all = texts();
        all.remove("leaderboard-10");
        all.insert("evalai-tracks", phases);
        let tracks = specs(&printed(&all)).remove(0).tracks;
        tracks
            .into_iter()
            .map(|track| (track.name, track.carla.codename.unwrap()))
            .collect::<Vec<_>>()
    };
    let all = |names: &[(&str, &str)]| -> Vec<(String, String)> {
        names
            .iter()
            .map(|(name, code)| ((*name).to_owned(), (*code).to_owned()))
            .collect()
    };
    assert_eq!(
        names(json!({
            "1": "leaderboard-20-sensors", "2": "leaderboard-20-sensors", "3": "leaderboard-20-MAP_qualifier",
        })),
        all(&[
            ("sensors-1", "SENSORS"),
            ("sensors-2", "SENSORS"),
            ("map-qualifier", "MAP_QUALIFIER")
        ])
    );
    // Their codenames differ in what no name has.
    assert_eq!(
        names(json!({"1": "leaderboard-20:map_x", "2": "leaderboard-20:map-x"})),
        all(&[("map-x-1", "MAP_X"), ("map-x-2", "MAP-X")])
    );
}

#[test]
fn a_queue_is_a_url_and_names_its_region_where_it_is_of_aws() {
    for (url, region) in [
        (URL, Some("us-west-2")),
        (
            "https://sqs.cn-north-1.amazonaws.com.cn/123456789012/a",
            Some("cn-north-1"),
        ),
        ("http://127.0.0.1:4566/123456789012/a", None),
    ] {
        assert_eq!(url.parse::<Queue>().unwrap().region(), region, "{url}");
    }
    for text in [
        "",
        "leaderboard",
        "https://sqs.us-west-2.amazonaws.com/leaderboard",
        "https://a/1/b c",
        "https://a/1/b\n",
    ] {
        let refused = text.parse::<Queue>().unwrap_err();
        assert!(
            refused.starts_with("a queue's URL is such as https://sqs."),
            "{text}: {refused}"
        );
    }
}

/// YAML 1.1, which kubectl reads, takes these for a boolean, a number, nothing or more than a text.
const ODD: [&str; 12] = [
    "y", "No", "on", "null", "1", "0x1F", "017", "1e3", "12.30", "#a", "a#b", "-",
];

#[test]
fn a_text_of_an_entry_is_one_value_and_stays_a_text_for_kubectl_too() {
    for text in ODD {
        let mut all = texts();
        all.remove("leaderboard-10");
        for key in ["s3_bucket", "dynamodb_submissions_table", "cloudwatch_log_group"] {
            all.get_mut("leaderboard-20").unwrap()[key] = json!(text);
        }
        let yaml = printed(&all);
        let spec = specs(&yaml).remove(0);
        assert_eq!(
            (
                spec.storage.s3.bucket.as_str(),
                spec.table.unwrap().dynamo_db.name.as_str()
            ),
            (text, text),
            "{yaml}"
        );
        assert!(yaml.contains(&format!("    bucket: \"{text}\"\n")), "{yaml}");
    }
}

#[test]
fn no_text_of_an_entry_ends_a_comment_or_commands_a_terminal() {
    for hostile in [
        "a\nkind: Secret",
        "a\r\nb",
        "a\u{85}b",
        "a\u{2028}b",
        "a\u{1b}[2Jb",
        "a\u{202e}b",
        "a\u{7}b",
        "a\": {",
    ] {
        // The name of a key is the one text that is no value.
        let mut twenty = board("20");
        twenty[hostile] = json!("x");
        let mut all = entries(&texts());
        all.append(&mut answers(&answer("leaderboard-20", &twenty.to_string()).to_string()).unwrap());
        let yaml = yaml_of(&all);
        assert_eq!(documents(&yaml).len(), 4, "{yaml}");
        let is_odd = |c: char| c != '\n' && (c.is_control() || "\u{85}\u{2028}\u{2029}\u{202e}".contains(c));
        assert!(!yaml.contains(is_odd), "{yaml:?}");
        for (entry, key) in [
            ("evalai", "api_server"),
            ("evalai-tracks", "4172"),
            ("leaderboard-20", "simulator_image"),
            ("leaderboard-20", "s3_bucket"),
            ("leaderboard-20", "dynamodb_submissions_table"),
            ("leaderboard-20", "cloudwatch_log_group"),
        ] {
            let mut all = texts();
            all.get_mut(entry).unwrap()[key] = json!(hostile);
            assert!(parse(&entries(&all)).is_err(), "{key}: {hostile:?}");
        }
    }
}
