use super::*;
use crate::cli::import::entries::{Board, Entries, parse};
use crate::cli::import::print;
use crate::cli::import::samples::{texts, tracks};
use crate::services::event_sources::QueueArn;
use leaderboard_api::{Display, Foreign, GpuMode, LeaderboardSpec, effective};

fn entries() -> Entries {
    parse(&texts(), &Board::ALL).unwrap()
}

fn options() -> Options {
    let url = "https://sqs.us-west-2.amazonaws.com/123456789012/leaderboard";
    Options {
        namespace: "leaderboards".into(),
        service_account: "submission-worker".into(),
        role_arn: Some("arn:aws:iam::123456789012:role/leaderboard-submission-worker".into()),
        region: "us-west-2".into(),
        endpoint: None,
        challenge: Some(2098),
        queue: Some(Queue {
            url: url.into(),
            arn: QueueArn::of_url(url, None).unwrap(),
        }),
        dead_letter: None,
        egress: vec!["10.0.1.10/32".into()],
        taints: Vec::new(),
        two_operators: false,
    }
}

fn planned(entries: &Entries, options: &Options) -> Import {
    plan(entries, options, &Decisions::default(), Timestamp::UNIX_EPOCH).unwrap()
}

fn specs(import: &Import) -> Vec<LeaderboardSpec> {
    let boards = import
        .documents
        .iter()
        .filter(|document| document.object["kind"] == "Leaderboard");
    boards
        .map(|document| serde_json::from_value(document.object["spec"].clone()).unwrap())
        .collect()
}

#[test]
fn both_leaderboards_run_what_the_original_ran() {
    let import = planned(&entries(), &options());
    let kinds: Vec<_> = import
        .documents
        .iter()
        .map(|d| d.object["kind"].as_str().unwrap())
        .collect();
    assert_eq!(kinds, ["Namespace", "ServiceAccount", "Leaderboard", "Leaderboard"]);
    for (spec, (version, repetitions)) in specs(&import)
        .iter()
        .zip([(LeaderboardVersion::V1, 5), (LeaderboardVersion::V2, 1)])
    {
        assert_eq!(spec.leaderboard_version, version);
        assert_eq!(spec.deadlines.run_seconds, 0);
        assert_eq!(spec.evalai.as_ref().unwrap().requests_per_minute, 54);
        let scenarios = spec.tracks.iter().all(|track| track.scenarios_file.is_some());
        assert_eq!(scenarios, version == LeaderboardVersion::V1);
        assert_eq!(spec.simulator.security_context.as_ref().unwrap().privileged, Some(true));
        let gpu = spec.gpu.as_ref().unwrap();
        assert_eq!(gpu.mode, Some(GpuMode::NodeIndex));
        assert_eq!(gpu.resource_name.as_deref(), Some("nvidia.com/gpu"));
        let is_on_screen = spec.simulator.display == Display::X11Socket;
        assert_eq!(is_on_screen, version == LeaderboardVersion::V2);
        for track in &spec.tracks {
            let shape = effective::shape(spec, track);
            let slices: Vec<_> = shape.slices.iter().map(ToString::to_string).collect();
            assert_eq!(slices, ["0-4", "5-9", "10-14", "15-19"]);
            assert_eq!(shape.repetitions, repetitions);
            assert_eq!(track.node_selector["node.kubernetes.io/instance-type"], "g5.12xlarge");
        }
    }
}

#[test]
fn the_token_stays_where_it_is() {
    let import = planned(&entries(), &options());
    let text = print::yaml(&import, "Made by a test.", &[]).unwrap();
    assert!(!text.contains("local-host-token"), "{text}");
    for spec in specs(&import) {
        let token = spec.evalai.unwrap().token.secrets_manager.unwrap();
        assert_eq!((token.id.as_str(), token.key.as_str()), ("evalai", "auth_token"));
        assert_eq!(token.region.as_deref(), Some("us-west-2"));
    }
}

#[test]
fn what_is_printed_reads_back_as_it_was_planned() {
    let import = planned(&entries(), &options());
    for document in &import.documents {
        let text = print::document(document).unwrap();
        let read: Value = serde_saphyr::from_str(&text).unwrap();
        assert_eq!(read, document.object, "{text}");
    }
    let text = print::yaml(
        &import,
        "Made by a test.",
        &[("Other readers of the queue", vec!["none".into()])],
    )
    .unwrap();
    assert_eq!(text.matches("\n---\n").count(), 4);
    assert!(text.lines().all(|line| line.chars().count() <= 130), "{text}");
    for expected in [
        "# Made by a test.\n",
        "# - leaderboard-20: endpoint (the Step Function reached the cluster by it",
        "# - leaderboard-10: logcopy_image (logcopy is part of the operator's own image)",
        "# - queue.deadLetterURL: a queue for messages",
        "#   leaderboards:\n#   - buckets:\n#     - leaderboard-10\n",
        "\n#     namespace: leaderboards\n",
        "  # As in the original: privileged",
        "\nspec:\n  evalai:\n",
    ] {
        assert!(text.contains(expected), "{expected}: {text}");
    }
}

#[test]
fn the_documentation_shows_what_is_printed() {
    let egress = ["10.0.1.10/32", "10.0.1.11/32", "10.0.1.12/32"].map(str::to_owned);
    let options = Options {
        egress: egress.into(),
        ..options()
    };
    let import = planned(&entries(), &options);
    let shown = import
        .documents
        .iter()
        .filter(|d| d.object["metadata"]["name"] != "leaderboard-10");
    let shown: Vec<_> = shown.map(|document| print::document(document).unwrap()).collect();
    let page = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/import.md");
    let page = std::fs::read_to_string(page).unwrap();
    let wanted = format!("```yaml\n{}```\n", shown.join("---\n"));
    assert!(page.contains(&wanted), "docs/import.md does not show this:\n{wanted}");
    for line in import
        .decide
        .iter()
        .chain(import.dropped.iter().filter(|line| line.starts_with("leaderboard-20")))
    {
        assert!(page.contains(line.as_str()), "docs/import.md does not show: {line}");
    }
}

#[test]
fn every_track_tolerates_the_taints_that_are_given() {
    let of = |taints: &[&str]| {
        let taints = taints.iter().map(|taint| taint.parse().unwrap()).collect();
        planned(&entries(), &Options { taints, ..options() })
    };
    let asks = |import: &Import| {
        import
            .decide
            .iter()
            .any(|line| line.starts_with("tracks[].tolerations:"))
    };
    let (none, two) = (of(&[]), of(&["nvidia.com/gpu:NoSchedule", "carla=2:NoExecute"]));
    assert!(asks(&none) && !asks(&two));
    for (import, wanted) in [
        (&none, json!([])),
        (
            &two,
            json!([
                {"key": "nvidia.com/gpu", "operator": "Exists", "effect": "NoSchedule"},
                {"key": "carla", "operator": "Equal", "value": "2", "effect": "NoExecute"},
            ]),
        ),
    ] {
        for track in specs(import).iter().flat_map(|spec| &spec.tracks) {
            assert_eq!(json!(track.tolerations), wanted);
        }
    }
}

#[test]
fn two_operators_share_queue_and_requests() {
    let options = Options {
        two_operators: true,
        ..options()
    };
    let import = planned(&entries(), &options);
    for spec in specs(&import) {
        assert_eq!(spec.evalai.unwrap().requests_per_minute, 27);
        assert_eq!(spec.queue.unwrap().foreign, Foreign::Leave);
    }
    assert!(
        import
            .decide
            .iter()
            .any(|line| line.starts_with("which cluster gets which"))
    );
}

#[test]
fn what_is_not_given_is_left_out_and_asked_for() {
    let given = planned(&entries(), &options());
    let options = Options {
        queue: None,
        role_arn: None,
        egress: Vec::new(),
        ..options()
    };
    let mut entries = entries();
    for board in &mut entries.boards {
        board.log_group = None;
    }
    let import = planned(&entries, &options);
    for spec in specs(&import) {
        assert_eq!((spec.queue, spec.log_group, spec.pod_identity), (None, None, None));
        assert_eq!(spec.network.egress, []);
    }
    let text = print::yaml(&import, "", &[]).unwrap();
    assert!(
        text.contains("  # TODO: queue:") && text.contains("  # TODO: logGroup:"),
        "{text}"
    );
    let asks = |import: &Import, what: &str| import.decide.iter().any(|line| line.starts_with(what));
    for what in ["podIdentity:", "network.egress:", "queue: the URL"] {
        assert!(asks(&import, what) && !asks(&given, what), "{what}");
    }
    assert!(asks(&given, "logGroup: does the original's FluentD run"));
    assert!(!asks(&import, "logGroup:"), "there is none");
    for what in [
        "evalai.challenge:",
        "concurrency:",
        "resources:",
        "deadlines.runSeconds:",
    ] {
        assert!(asks(&import, what), "{what}");
    }
}

#[test]
fn two_phases_of_one_track_have_names_of_their_own() {
    let mut texts = texts();
    let phases = [
        ("1", "leaderboard-20-sensors"),
        ("2", "leaderboard-20-sensors"),
        ("3", "leaderboard-20-MAP_qualifier"),
    ];
    texts.insert("evalai-tracks", tracks(&phases));
    let entries = parse(&texts, &[Board::Twenty]).unwrap();
    let import = planned(&entries, &options());
    let spec = &specs(&import)[0];
    let tracks: Vec<_> = spec
        .tracks
        .iter()
        .map(|t| (t.name.as_str(), t.codename.as_str()))
        .collect();
    assert_eq!(
        tracks,
        [
            ("sensors-1", "SENSORS"),
            ("sensors-2", "SENSORS"),
            ("map-qualifier", "MAP_QUALIFIER")
        ]
    );
}

#[test]
fn tracks_whose_codenames_differ_in_what_no_name_has_are_named_by_their_phase() {
    let mut texts = texts();
    let phases = [("1", "leaderboard-20:map_x"), ("2", "leaderboard-20:map-x")];
    texts.insert("evalai-tracks", tracks(&phases));
    let entries = parse(&texts, &[Board::Twenty]).unwrap();
    let import = planned(&entries, &options());
    let tracks = specs(&import)[0].tracks.clone();
    let tracks: Vec<_> = tracks.iter().map(|t| (t.name.as_str(), t.codename.as_str())).collect();
    assert_eq!(tracks, [("map-x-1", "MAP_X"), ("map-x-2", "MAP-X")]);
}

#[test]
fn a_token_that_is_none_or_ends_soon_is_a_matter_for_a_person() {
    let mut entries = entries();
    let first = |entries: &Entries| planned(entries, &options()).decide[0].clone();
    assert!(first(&entries).contains("secretsmanager:GetSecretValue"));
    entries.token = Ok(Some(Timestamp::from_second(86_400).unwrap()));
    assert!(first(&entries).contains("the token ends on 1970-01-02"));
    entries.token = Err(crate::services::token::TokenError::Access);
    assert!(first(&entries).contains("access token"));
}
