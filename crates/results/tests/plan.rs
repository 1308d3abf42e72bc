//! What the plan adds to the original: completeness against the plan, and the pod's refusals.
#![allow(clippy::unwrap_used, reason = "the helpers of a test may fail it")]

mod common;

use common::{Drive, file, finished, merged, pod, read};
use leaderboard_results::{Format, Merged, Outcome, Plan, Slice, Strictness, Verify, render};
use serde_json::{Value, json};

const V1: Format = Format::V1;
const V2: Format = Format::V2;

fn perfect(format: Format, ids: std::ops::RangeInclusive<u32>) -> Value {
    finished(format, &ids.map(Drive::perfect).collect::<Vec<_>>())
}

fn two_pairs(format: Format) -> (Plan, [Value; 2]) {
    (
        pod(format, 1, &[(0, 1), (2, 4)]),
        [perfect(format, 0..=1), perfect(format, 2..=4)],
    )
}

fn stdout(plan: &Plan, merged: &Merged) -> String {
    render(plan, Some(merged)).unwrap().stdout_txt
}

#[test]
fn a_complete_run_is_final() {
    for format in [V1, V2] {
        let (plan, [a, b]) = two_pairs(format);
        let result = merged(&plan, &[Some(a), Some(b)]).unwrap();
        assert!(result.is_final && result.eligible);
        assert_eq!((result.done, result.total, result.outcome), (5, 5, Outcome::Finished));
        assert_eq!((result.score, result.partial_score), (Some(100.0), Some(100.0)));
        assert_eq!(result.entry_status, "Finished");
        assert!(stdout(&plan, &result).contains("- All 5 route have been completed\n"));
    }
}

#[test]
fn a_missing_worker_is_not_final() {
    for format in [V1, V2] {
        let (plan, [a, b]) = two_pairs(format);
        for files in [[Some(a.clone()), None], [None, Some(b)]] {
            let result = merged(&plan, &files).unwrap();
            assert!(!result.is_final && !result.eligible);
            assert_eq!(
                (result.total, result.outcome, result.score),
                (5, Outcome::Running, None)
            );
            assert_eq!(result.partial_score, Some(100.0));
        }
        let result = merged(&plan, &[Some(a.clone()), None]).unwrap();
        assert!(stdout(&plan, &result).contains("- Completed 2 out of the 5 routes\n"));
        assert_eq!(
            result
                .pairs
                .iter()
                .map(|pair| (pair.done, pair.total))
                .collect::<Vec<_>>(),
            [(2, 2), (0, 3)]
        );

        let original = Plan {
            as_original: true,
            ..plan
        };
        assert!(
            merged(&original, &[Some(a), None]).unwrap().is_final,
            "the original believes the files"
        );
    }
}

#[test]
fn one_pair_can_not_stand_in_for_another() {
    let (plan, [a, b]) = two_pairs(V2);
    let swapped = merged(&plan, &[Some(b), Some(a)]).unwrap_err().to_string();
    assert_eq!(
        swapped,
        "pair 1: the checkpoint is for 3 route runs, but this pair has 2"
    );
}

/// Only a pod refuses the file of a pair that did more than its share; elsewhere the sum alone must not make it final.
#[test]
fn one_pair_can_not_make_up_for_another() {
    for format in [V1, V2] {
        let (plan, _) = two_pairs(format);
        let plan = Plan {
            strictness: Strictness::Offline,
            ..plan
        };
        let result = merged(&plan, &[Some(perfect(format, 0..=2)), Some(perfect(format, 3..=4))]).unwrap();
        assert_eq!((result.done, result.total, result.is_final), (5, 5, false));
    }
}

#[test]
fn ids_need_not_begin_at_zero() {
    let plan = pod(V2, 2, &[(10, 10), (11, 11)]);
    let both = |id| finished(V2, &[Drive::perfect(id), Drive::perfect(id).repeated(1)]);
    let result = merged(&plan, &[Some(both(10)), Some(both(11))]).unwrap();
    assert!(result.is_final && result.eligible);
}

#[test]
fn repetitions_of_v1_share_their_id() {
    let plan = pod(V1, 2, &[(0, 1)]);
    let twice = |ids: [u32; 4]| finished(V1, &ids.map(Drive::perfect));
    assert!(merged(&plan, &[Some(twice([0, 0, 1, 1]))]).unwrap().is_final);
    let refusal = merged(&plan, &[Some(twice([0, 0, 0, 1]))]).unwrap_err().to_string();
    assert_eq!(
        refusal,
        "pair 1, route RouteScenario_0: the route run is there more often than it is driven"
    );
}

type Edit = (&'static str, Value, &'static str);

fn edits_of_routes() -> Vec<Edit> {
    vec![
        (
            "/route_id",
            json!("RouteScenario_7_rep0"),
            "record 1: it is not an object",
        ),
        (
            "/route_id",
            json!("RouteScenario_7_rep0"),
            "pair 1, route RouteScenario_7_rep0: the route is outside this pair's routes 0-2",
        ),
        (
            "/route_id",
            json!("RouteScenario_1_rep1"),
            "the run has only 1 repetitions",
        ),
        (
            "/route_id",
            json!("RouteScenario_0_rep0"),
            "more often than it is driven",
        ),
        (
            "/route_id",
            json!("RouteScenario_01_rep0"),
            "pair 1, record 2: its route_id is not of the form",
        ),
        (
            "/route_id",
            json!("<script>_1_rep0"),
            "pair 1, record 2: its route_id is not of the form",
        ),
        ("/route_id", json!(1), "`route_id` is not a text"),
        (
            "/status",
            json!("Completed <b>"),
            "route RouteScenario_1_rep0: its status is not one of the known ones",
        ),
        ("/status", json!(null), "`status` is not a text"),
    ]
}

fn edits_of_numbers() -> Vec<Edit> {
    vec![
        (
            "/scores/score_route",
            json!(100.5),
            "score_route is 100.5, which is not between 0.0 and 100.0",
        ),
        ("/scores/score_route", json!(-1), "score_route is -1.0, which"),
        ("/scores/score_route", json!("100"), "`score_route` is not a number"),
        ("/scores/score_route", json!(true), "`score_route` is not a number"),
        (
            "/scores/score_penalty",
            json!(1.2),
            "score_penalty is 1.2, which is not between 0.0 and 1.0",
        ),
        (
            "/scores/score_composed",
            json!(1e200),
            "score_composed is 1e+200, which",
        ),
        ("/meta/route_length", json!(-5), "route_length is -5.0, which"),
        (
            "/meta/duration_system",
            json!(1e12),
            "duration_system is 1000000000000.0, which",
        ),
        (
            "/meta/duration_system",
            json!(1e-320),
            "duration_system is 1e-320, which is not between 1e-06 and",
        ),
        (
            "/infractions/red_light",
            json!({"a": 1}),
            "`red_light` is not a list of messages",
        ),
        (
            "/infractions/outside_route_lanes",
            json!(["a b c d e f g h NaN"]),
            "outside_route_lanes is NaN",
        ),
        (
            "/infractions/outside_route_lanes",
            json!(["no distance"]),
            "does not hold the distance",
        ),
    ]
}

/// One edit of an honest file, and the words the participant gets.
#[test]
fn a_pod_refuses_with_a_reason() {
    let record = "/_checkpoint/records/1";
    let table = edits_of_routes().into_iter().chain(edits_of_numbers());
    let plan = pod(V2, 1, &[(0, 2)]);
    for (i, (place, value, words)) in table.enumerate() {
        let mut edited = perfect(V2, 0..=2);
        if i == 0 {
            edited["_checkpoint"]["records"][0] = json!([]);
        } else {
            *edited.pointer_mut(&format!("{record}{place}")).unwrap() = value;
        }
        let refusal = read(&plan, 0, &edited).unwrap_err();
        assert!(refusal.to_string().contains(words), "{place}: {refusal}");
        assert!(refusal.next_step().ends_with('.'));
    }
}

#[test]
fn a_pod_refuses_files_of_the_wrong_shape() {
    let plan = pod(V2, 1, &[(0, 2)]);
    let no_pair = "is not a pair of whole numbers";
    for (place, value, words) in [
        (
            "/sensors",
            json!(["carla_camera", "carla_depth"]),
            "pair 1: sensor 2 is not one of the known kinds",
        ),
        (
            "/sensors",
            json!("carla_camera"),
            "`sensors` in the checkpoint is not a list",
        ),
        (
            "/_checkpoint/progress",
            json!([3, 4]),
            "is for 4 route runs, but this pair has 3",
        ),
        ("/_checkpoint/progress", json!([3, 3.0]), no_pair),
        ("/_checkpoint/progress", json!([3, -3]), no_pair),
        ("/_checkpoint/progress", json!(["3", 3]), no_pair),
        ("/_checkpoint/progress", json!([3, 3, 3]), no_pair),
        (
            "/_checkpoint/records",
            json!({}),
            "`_checkpoint.records` in the checkpoint is not a list",
        ),
        (
            "/_checkpoint",
            json!([1]),
            "`_checkpoint` in the checkpoint is not an object",
        ),
    ] {
        let mut edited = perfect(V2, 0..=2);
        *edited.pointer_mut(place).unwrap() = value;
        let refusal = read(&plan, 0, &edited).unwrap_err().to_string();
        assert!(refusal.contains(words), "{place}: {refusal}");
    }
    let mut longer: Vec<Value> = (0..4).map(|id| Drive::perfect(id).json(V2, 0)).collect();
    longer[3]["route_id"] = json!("RouteScenario_2_rep0");
    let refusal = read(&plan, 0, &file(3, &longer)).unwrap_err().to_string();
    assert!(
        refusal.contains("more often than it is driven") || refusal.contains("4 records"),
        "{refusal}"
    );
}

#[test]
fn a_file_that_has_only_begun_is_no_file() {
    let plan = pod(V2, 1, &[(0, 2)]);
    let mut begun = file(3, &[]);
    assert!(read(&plan, 0, &begun).unwrap().is_some_and(|worker| worker.done() == 0));
    begun["_checkpoint"]["progress"] = json!([]);
    assert!(read(&plan, 0, &begun).unwrap().is_none());
    for nothing in [json!({}), json!([]), json!(null), json!(0), json!(""), json!(false)] {
        assert!(read(&plan, 0, &nothing).unwrap().is_none());
    }
}

#[test]
fn limits_are_refusals() {
    let plan = pod(V2, 1, &[(0, 2)]);
    let long = json!({"x": "y".repeat(1 << 21)});
    assert!(
        read(&plan, 0, &long)
            .unwrap_err()
            .to_string()
            .contains("a text longer than 1 MiB")
    );
    let records = vec![json!({}); 10_001];
    assert!(
        read(&plan, 0, &file(3, &records))
            .unwrap_err()
            .to_string()
            .contains("more than 10,000 records")
    );
    for (place, value, words) in [
        (
            "/sensors",
            json!(vec!["carla_gnss"; 1001]),
            "holds more than 1,000 sensors",
        ),
        (
            "/_checkpoint/progress",
            json!([0, 1_000_001]),
            "is not a pair of whole numbers",
        ),
        ("/values", json!(vec![0; 500_001]), "holds more than 500,000 values"),
    ] {
        let mut edited = perfect(V2, 0..=2);
        *edited.pointer_mut(place).unwrap() = value;
        let refusal = read(&Plan::lenient(V2), 0, &edited).unwrap_err().to_string();
        assert!(refusal.contains(words), "{refusal}");
    }
    let deep = format!("{}1{}", "[".repeat(100_000), "]".repeat(100_000));
    let refusal = leaderboard_results::read_worker(&plan, 0, deep.as_bytes())
        .unwrap_err()
        .to_string();
    assert_eq!(refusal, "pair 1: the checkpoint is nested deeper than 64 levels");
    let large = vec![b' '; (64 << 20) + 1];
    for (plan, most) in [(&plan, "33 MiB"), (&Plan::lenient(V2), "64 MiB")] {
        let refusal = leaderboard_results::read_worker(plan, 0, &large).unwrap_err();
        assert_eq!(
            refusal.to_string(),
            format!("pair 1: the checkpoint is larger than {most}")
        );
    }
    let refusal = leaderboard_results::read_worker(&plan, 1, b"{\"\xff\":1}")
        .unwrap_err()
        .to_string();
    assert_eq!(refusal, "pair 2: the checkpoint is not UTF-8 text");
}

/// A byte of a text can become six when it is written.
#[test]
fn what_is_written_has_a_limit_too() {
    let mut worker = perfect(V2, 0..=0);
    worker["_checkpoint"]["records"][0]["long"] = json!(vec!["\u{7f}".repeat(1 << 20); 11]);
    let refusal = merged(&Plan::lenient(V2), &[Some(worker)]).unwrap_err().to_string();
    assert_eq!(
        refusal,
        "the checkpoints together are too large: this would make the merged file larger than 64 MiB"
    );
}

#[test]
fn different_sensors_are_refused() {
    let (plan, [a, mut b]) = two_pairs(V2);
    b["sensors"] = json!(["carla_lidar"]);
    let refusal = merged(&plan, &[Some(a.clone()), Some(b.clone())])
        .unwrap_err()
        .to_string();
    assert_eq!(refusal, "pairs 1 and 2 have different sensor configurations");
    b["sensors"] = json!([]);
    assert!(merged(&plan, &[Some(a), Some(b)]).unwrap().is_final);
}

#[test]
fn a_plan_that_contradicts_itself_is_refused() {
    let good = pod(V2, 1, &[(0, 1), (2, 4)]);
    assert!(good.check().is_ok());
    let slices = |slices: &[(u32, u32)]| -> Vec<Slice> {
        slices
            .iter()
            .map(|(first, last)| Slice {
                first: *first,
                last: *last,
            })
            .collect()
    };
    for (plan, words) in [
        (
            Plan {
                routes: 6,
                ..good.clone()
            },
            "its slices hold 5 routes, but it says 6",
        ),
        (
            Plan {
                repetitions: 0,
                ..good.clone()
            },
            "no repetition",
        ),
        (
            Plan {
                pairs: slices(&[(3, 1)]),
                ..good.clone()
            },
            "written backwards",
        ),
        (
            Plan {
                pairs: slices(&[(0, 2), (2, 3)]),
                ..good.clone()
            },
            "the slices 0-2 and 2-3 overlap",
        ),
        (
            Plan {
                repetitions: u32::MAX,
                ..good.clone()
            },
            "more records than can be counted",
        ),
    ] {
        assert!(plan.check().unwrap_err().to_string().contains(words), "{words}");
    }
    let refusal = merged(&good, &[None]).unwrap_err().to_string();
    assert!(refusal.contains("it has 2 pairs, but there are 1 workers"), "{refusal}");
}

#[test]
fn an_unpublishable_metric_is_refused() {
    let plan = pod(V1, 1, &[(0, 0)]);
    let mut drive = Drive::perfect(0).status("Failed");
    drive.route = 1e-320;
    drive.infractions = vec![("red_light", vec!["Agent ran a red light".to_owned()])];
    let refusal = merged(&plan, &[Some(finished(V1, &[drive]))]).unwrap_err().to_string();
    assert_eq!(refusal, "the metric \"Red light infractions\" is not a finite number");
}

#[test]
fn plans_travel_as_json() {
    let plan = Plan {
        verify: Verify::Refuse,
        ..pod(V1, 5, &[(0, 4), (5, 9)])
    };
    let text = serde_json::to_string(&plan).unwrap();
    assert!(text.contains("\"format\":\"V1\"") && text.contains("\"strictness\":\"Pod\""));
    assert_eq!(serde_json::from_str::<Plan>(&text).unwrap(), plan);
}
