use jiff::Timestamp;
use leaderboard_api::{LeaderboardSpec, LeaderboardVersion};
use serde_json::json;

use super::*;
use crate::cli::import::entries::{Entries, parse};
use crate::cli::import::options::{Options, Queue};
use crate::cli::import::plan::{Import, PlanError, plan};
use crate::cli::import::print;
use crate::cli::import::samples::texts;
use crate::services::event_sources::QueueArn;

const URL: &str = "https://sqs.us-west-2.amazonaws.com/123456789012/leaderboard";

fn entries() -> Entries {
    parse(&texts(), &Board::ALL).unwrap()
}

fn options() -> Options {
    Options {
        namespace: "leaderboards".into(),
        service_account: "submission-worker".into(),
        role_arn: None,
        region: "us-west-2".into(),
        endpoint: None,
        challenge: None,
        queue: Some(Queue {
            url: URL.into(),
            arn: QueueArn::of_url(URL, None).unwrap(),
        }),
        dead_letter: None,
        egress: Vec::new(),
        taints: Vec::new(),
        two_operators: false,
    }
}

fn decided(text: &str) -> Decisions {
    Decisions::parse("decisions.yaml", text).unwrap()
}

fn planned(text: &str) -> Result<Import, PlanError> {
    plan(&entries(), &options(), &decided(text), Timestamp::UNIX_EPOCH)
}

/// The specs of 1.0 and 2.0.
fn specs(text: &str) -> [LeaderboardSpec; 2] {
    let import = planned(text).unwrap();
    let boards = import
        .documents
        .iter()
        .filter(|document| document.object["kind"] == "Leaderboard");
    let specs: Vec<LeaderboardSpec> = boards
        .map(|document| serde_json::from_value(document.object["spec"].clone()).unwrap())
        .collect();
    specs.try_into().unwrap()
}

#[test]
fn each_mistake_is_named_with_its_file_and_place() {
    for (text, wanted) in [
        (
            "all: {concurency: {total: 3}}",
            "all.concurency is no field of a Leaderboard; there are agent, check, ",
        ),
        (
            "leaderboard-20: {concurrency: {totl: 3}}",
            "leaderboard-20.concurrency.totl is no field of a Leaderboard; there are perTeam, total",
        ),
        (
            "all: {concurrency: {total: many}}",
            "all.concurrency.total is no whole number",
        ),
        ("all: {paused: 'yes'}", "all.paused is neither true nor false"),
        (
            "all: {storage: {bucket: 7}}",
            "all.storage.bucket is no text: write it in quotation marks",
        ),
        ("all: {agent: {images: agent}}", "all.agent.images is no list"),
        ("all: {network: Off}", "all.network is no object"),
        ("all: {gpu: {mode: Some}}", "all.gpu.mode is none of "),
        (
            "all: {agent: {resources: {requests: {cpu: 1.5}}}}",
            "all.agent.resources.requests.cpu is neither a whole number nor a text",
        ),
        (
            "all: {tracks: [{name: map, routefile: a}]}",
            "all.tracks[0].routefile is no field of a Leaderboard; there are ",
        ),
        (
            "all: {tracks: [{phase: 7}]}",
            "all.tracks[0] has no name: write that of the printed track",
        ),
        (
            "leaderboard-30: {}",
            "leaderboard-30 is none of all, leaderboard-10 and leaderboard-20",
        ),
        ("all: 7", "all is no object"),
        ("[all]", "the file is no object"),
    ] {
        let errors = Decisions::parse("decisions.yaml", text).unwrap_err();
        let errors: Vec<_> = errors.iter().map(ToString::to_string).collect();
        assert!(
            errors[0].starts_with(&format!("decisions.yaml: {wanted}")),
            "{text}: {errors:?}"
        );
        assert_eq!(errors.len(), 1, "{text}: {errors:?}");
    }
    let errors = Decisions::parse("decisions.yaml", "all: {paused: 1, pairs: no}").unwrap_err();
    assert_eq!(errors.len(), 2, "all that is wrong is named at once: {errors:?}");
    let error = &Decisions::parse("decisions.yaml", "all: {").unwrap_err()[0];
    assert!(error.to_string().starts_with("decisions.yaml is not YAML: "), "{error}");
}

#[test]
fn a_part_of_one_leaderboard_goes_before_that_of_both() {
    let [ten, twenty] = specs(
        "all: {evalai: {challenge: 2098}, concurrency: {total: 3, perTeam: 1}}\n\
         leaderboard-20: {concurrency: {total: 8}}",
    );
    for (spec, version, total) in [(ten, LeaderboardVersion::V1, 3), (twenty, LeaderboardVersion::V2, 8)] {
        assert_eq!(
            (spec.leaderboard_version, spec.evalai.unwrap().challenge),
            (version, 2098)
        );
        let concurrency = serde_json::to_value(spec.concurrency).unwrap();
        assert_eq!(concurrency, json!({"total": total, "perTeam": 1}));
    }
}

#[test]
fn null_removes_a_list_is_replaced_and_a_track_is_found_by_its_name() {
    let text = "
        all:
          evalai: {challenge: 2098}
          logGroup: null
          gpu: {mode: None, resourceName: null}
          simulator: {securityContext: null, resources: {requests: {cpu: null, memory: 20Gi}}}
          tracks: [{name: sensors, nodeSelector: {node.kubernetes.io/instance-type: g6.12xlarge}}]
        leaderboard-10:
          tracks: [{name: map, nodeSelector: null, tolerations: [{key: carla, operator: Exists}]}]";
    for (spec, selector) in specs(text)
        .into_iter()
        .zip([json!(null), json!({"node.kubernetes.io/instance-type": "g5.12xlarge"})])
    {
        let spec = serde_json::to_value(spec).unwrap();
        assert_eq!(
            (&spec["logGroup"], &spec["gpu"]),
            (&Value::Null, &json!({"mode": "None"}))
        );
        assert_eq!(spec["simulator"]["securityContext"], Value::Null);
        let requests = &spec["simulator"]["resources"]["requests"];
        assert_eq!(*requests, json!({"memory": "20Gi", "ephemeral-storage": "2Gi"}));
        let [sensors, map] = [&spec["tracks"][0], &spec["tracks"][1]];
        assert_eq!(
            sensors["nodeSelector"],
            json!({"node.kubernetes.io/instance-type": "g6.12xlarge"})
        );
        assert!(
            sensors["phase"].is_i64() && map["phase"].is_i64(),
            "the rest stays: {spec}"
        );
        assert_eq!(map["nodeSelector"], selector);
    }
}

#[test]
fn what_leads_to_no_leaderboard_is_refused_with_the_file() {
    for (text, wanted) in [
        ("all: {pairs: 2}", "--challenge is missing"),
        (
            "all: {evalai: {challenge: 1}, storage: null}",
            "the Leaderboard leaderboard-10 would not be one: missing field `storage`; look at what decisions.yaml removes",
        ),
        (
            "leaderboard-20: {evalai: {challenge: 1}, tracks: [{name: maps}]}",
            "decisions.yaml: leaderboard-20 has the track maps, which is none of map, sensors",
        ),
    ] {
        let error = planned(text).unwrap_err().to_string();
        assert!(error.starts_with(wanted), "{text}: {error}");
    }
    let only = parse(&texts(), &[Board::Twenty]).unwrap();
    let other = decided("all: {evalai: {challenge: 1}}\nleaderboard-10: {tracks: [{name: only-of-ten}]}");
    let import = plan(&only, &options(), &other, Timestamp::UNIX_EPOCH);
    assert!(
        import.is_ok(),
        "a part of a Leaderboard that is not made is not looked at"
    );
}

/// What docs/import.md shows to a host, and so complete.
fn of_the_page() -> String {
    let page = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/import.md");
    let page = std::fs::read_to_string(page).unwrap();
    let (_, rest) = page.split_once("> decisions.yaml <<END\n").unwrap();
    rest.split_once("\nEND\n").unwrap().0.to_owned()
}

#[test]
fn a_file_that_decides_everything_leaves_no_question() {
    let import = planned(&of_the_page()).unwrap();
    assert_eq!(import.decide, Vec::<String>::new());
    let text = print::yaml(&import, "Made by a test.", &[]).unwrap();
    assert!(
        text.contains("  # Decided in decisions.yaml.\n  concurrency:\n"),
        "{text}"
    );
    for gone in [
        "What a person must still decide",
        "The most nodes that",
        "a run has no time limit",
    ] {
        assert!(!text.contains(gone), "{gone}: {text}");
    }
}

#[test]
fn a_question_goes_when_every_leaderboard_has_its_answer() {
    let asks = |text: &str, what: &str| {
        let import = planned(&format!("{text}\nleaderboard-10: {{evalai: {{challenge: 2098}}}}\n"));
        import.map(|import| import.decide.iter().any(|line| line.starts_with(what)))
    };
    for (part, what) in [
        ("concurrency: {total: 2}", "concurrency:"),
        ("deadlines: {runSeconds: 7}", "deadlines.runSeconds:"),
        ("deadlines: null", "deadlines.runSeconds:"),
        ("logGroup: null", "logGroup:"),
        ("network: {egress: []}", "network.egress:"),
        ("podIdentity: {secretName: aws}", "podIdentity:"),
        ("queue: {region: us-west-2}", "queue: is"),
        ("queue: {deadLetterURL: null}", "queue.deadLetterURL:"),
        ("simulator: {resources: {}}, agent: {resources: {}}", "resources:"),
        (
            "tracks: [{name: sensors, nodeSelector: {a: b}}, {name: map, nodeSelector: null}]",
            "tracks[].nodeSelector:",
        ),
    ] {
        let both = format!("all: {{evalai: {{challenge: 2098}}, {part}}}");
        assert_eq!(asks(&both, what).ok(), Some(false), "{part}");
        let one = format!("all: {{evalai: {{challenge: 2098}}}}\nleaderboard-20: {{{part}}}");
        assert_eq!(asks(&one, what).ok(), Some(true), "{part} of one");
    }
    let half =
        "all: {evalai: {challenge: 2098}, simulator: {resources: {}}, tracks: [{name: map, nodeSelector: null}]}";
    for what in ["resources:", "tracks[].nodeSelector:"] {
        assert_eq!(asks(half, what).ok(), Some(true), "half of {what}");
    }
}

#[test]
fn a_bad_token_is_answered_by_another_place_for_it_alone() {
    let mut entries = entries();
    entries.token = Err(crate::services::token::TokenError::Access);
    for (token, is_asked) in [
        ("{secretsManager: {id: evalai}}", true),
        (
            "{secretsManager: null, secretKeyRef: {name: evalai, key: token}}",
            false,
        ),
    ] {
        let text = format!("all: {{evalai: {{challenge: 1, token: {token}}}}}");
        let import = plan(&entries, &options(), &decided(&text), Timestamp::UNIX_EPOCH).unwrap();
        let asked = import.decide.iter().any(|line| line.starts_with("the entry evalai:"));
        assert_eq!(asked, is_asked, "{token}");
    }
}

#[test]
fn the_charts_values_allow_what_the_decisions_name() {
    let values = |text: &str| planned(text).unwrap().values["leaderboards"][0].clone();
    let own = values("all: {evalai: {challenge: 1}}");
    assert_eq!(
        own,
        json!({"namespace": "leaderboards", "secretsManager": ["evalai"], "queues": [URL],
               "buckets": ["leaderboard-10", "leaderboard-20"], "tables": ["leaderboard-10", "leaderboard-20"],
               "logGroups": ["leaderboard-10", "leaderboard-20"]})
    );
    let other = values(
        "all:\n  table: null\n  logGroup: null\n  storage: {bucket: results, prefix: carla/}\n  \
         evalai: {challenge: 1, token: {secretsManager: null, secretKeyRef: {name: evalai, key: token}}}\n  \
         queue: {url: https://sqs.eu-west-1.amazonaws.com/123456789012/b, deadLetterURL: https://sqs.eu-west-1.amazonaws.com/123456789012/a}",
    );
    let queues = [
        "https://sqs.eu-west-1.amazonaws.com/123456789012/a",
        "https://sqs.eu-west-1.amazonaws.com/123456789012/b",
    ];
    assert_eq!(
        other,
        json!({"namespace": "leaderboards", "secretsManager": [], "secrets": ["evalai"], "queues": queues,
               "buckets": ["results/carla/"], "tables": [], "logGroups": []})
    );
}
