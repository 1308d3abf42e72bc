//! Additions of the plan to the original: completeness against the plan, and the pod's refusals.
#![allow(clippy::unwrap_used, reason = "the helpers of a test may fail it")]

mod common;

use common::{Drive, assert_refusals, file, finished, merged, pod, read};
use leaderboard_results::{Format, Merged, Outcome, Plan, Refusal, Slice, Strictness, render};
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
    let refusal = merged(&plan, &[Some(b), Some(a)]).unwrap_err();
    let total = |found, expected| Refusal::Total {
        pair: 0,
        found,
        expected,
    };
    assert_eq!(refusal, total(3, 2));
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
    let refusal = merged(&plan, &[Some(twice([0, 0, 0, 1]))]).unwrap_err();
    assert_refusals("repetitions", &[("a route of 1.0 once more".to_owned(), refusal)]);
}

/// Edits of the second record of an honest file.
fn edits_of_a_record() -> Vec<(&'static str, Value)> {
    vec![
        ("", json!([])),
        ("/route_id", json!("RouteScenario_7_rep0")),
        ("/route_id", json!("RouteScenario_1_rep1")),
        ("/route_id", json!("RouteScenario_0_rep0")),
        ("/route_id", json!("RouteScenario_01_rep0")),
        ("/route_id", json!("<script>_1_rep0")),
        ("/route_id", json!(1)),
        ("/status", json!("Completed <b>")),
        ("/status", json!(null)),
        ("/scores/score_route", json!(100.5)),
        ("/scores/score_route", json!(-1)),
        ("/scores/score_route", json!("100")),
        ("/scores/score_route", json!(true)),
        ("/scores/score_penalty", json!(1.2)),
        ("/scores/score_composed", json!(1e200)),
        ("/meta/route_length", json!(-5)),
        ("/meta/duration_system", json!(1e12)),
        ("/meta/duration_system", json!(1e-320)),
        ("/infractions/red_light", json!({"a": 1})),
        ("/infractions/outside_route_lanes", json!(["a b c d e f g h NaN"])),
        ("/infractions/outside_route_lanes", json!(["no distance"])),
    ]
}

/// Edits of the rest of it.
fn edits_of_a_file() -> Vec<(&'static str, Value)> {
    vec![
        ("/sensors", json!(["carla_camera", "carla_depth"])),
        ("/sensors", json!("carla_camera")),
        ("/_checkpoint/progress", json!([3, 4])),
        ("/_checkpoint/progress", json!([3, 3.0])),
        ("/_checkpoint/progress", json!([3, -3])),
        ("/_checkpoint/progress", json!(["3", 3])),
        ("/_checkpoint/progress", json!([3, 3, 3])),
        ("/_checkpoint/records", json!({})),
        ("/_checkpoint", json!([1])),
    ]
}

/// How an honest file of three routes is refused with this in one place.
fn refused(plan: &Plan, place: &str, value: Value) -> Refusal {
    let mut edited = perfect(V2, 0..=2);
    *edited.pointer_mut(place).unwrap() = value;
    read(plan, 0, &edited).unwrap_err()
}

#[test]
fn a_pod_refuses_every_dishonest_edit_of_a_file() {
    let plan = pod(V2, 1, &[(0, 2)]);
    let of_record = |(place, value)| (format!("/_checkpoint/records/1{place}"), value);
    let of_file = |(place, value): (&str, Value)| (place.to_owned(), value);
    let edits = edits_of_a_record().into_iter().map(of_record);
    let edits = edits.chain(edits_of_a_file().into_iter().map(of_file));
    let mut refusals: Vec<_> = edits
        .map(|(place, value)| (format!("{place} = {value}"), refused(&plan, &place, value)))
        .collect();
    let mut longer: Vec<Value> = (0..4).map(|id| Drive::perfect(id).json(V2, 0)).collect();
    longer[3]["route_id"] = json!("RouteScenario_2_rep0");
    let refusal = read(&plan, 0, &file(3, &longer)).unwrap_err();
    refusals.push(("a record more".to_owned(), refusal));
    assert_refusals("edits", &refusals);
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
    let (plan, lenient) = (pod(V2, 1, &[(0, 2)]), Plan::lenient(V2));
    let records = vec![json!({}); 10_001];
    let large = vec![b' '; (64 << 20) + 1];
    let deep = format!("{}1{}", "[".repeat(100_000), "]".repeat(100_000));
    let bytes = |plan: &Plan, pair, bytes: &[u8]| leaderboard_results::read_worker(plan, pair, bytes).unwrap_err();
    // A byte of a text can become six when it is written.
    let mut worker = perfect(V2, 0..=0);
    worker["_checkpoint"]["records"][0]["long"] = json!(vec!["\u{7f}".repeat(1 << 20); 11]);
    let refusals = [
        (
            "a text",
            read(&plan, 0, &json!({"x": "y".repeat(1 << 21)})).unwrap_err(),
        ),
        ("records", read(&plan, 0, &file(3, &records)).unwrap_err()),
        (
            "sensors",
            refused(&lenient, "/sensors", json!(vec!["carla_gnss"; 1001])),
        ),
        (
            "route runs",
            refused(&lenient, "/_checkpoint/progress", json!([0, 1_000_001])),
        ),
        ("values", refused(&lenient, "/values", json!(vec![0; 500_001]))),
        ("depth", bytes(&plan, 0, deep.as_bytes())),
        ("bytes in a Pod", bytes(&plan, 0, &large)),
        ("bytes", bytes(&lenient, 0, &large)),
        ("no text", bytes(&plan, 1, b"{\"\xff\":1}")),
        ("what is written", merged(&lenient, &[Some(worker)]).unwrap_err()),
    ];
    assert_refusals("limits", &refusals.map(|(what, refusal)| (what.to_owned(), refusal)));
}

#[test]
fn different_sensors_are_refused() {
    let (plan, [a, mut b]) = two_pairs(V2);
    b["sensors"] = json!(["carla_lidar"]);
    let refusal = merged(&plan, &[Some(a.clone()), Some(b.clone())]).unwrap_err();
    assert_refusals("sensors", &[("other sensors of one pair".to_owned(), refusal)]);
    b["sensors"] = json!([]);
    assert!(merged(&plan, &[Some(a), Some(b)]).unwrap().is_final);
}

fn slices(slices: &[(u32, u32)]) -> Vec<Slice> {
    let slice = |&(first, last): &(u32, u32)| Slice { first, last };
    slices.iter().map(slice).collect()
}

#[test]
fn a_plan_that_contradicts_itself_is_refused() {
    let good = pod(V2, 1, &[(0, 1), (2, 4)]);
    assert!(good.check().is_ok());
    let plan = |change: fn(&mut Plan)| {
        let mut plan = good.clone();
        change(&mut plan);
        plan.check().unwrap_err()
    };
    let refusals = [
        ("routes", plan(|plan| plan.routes = 6)),
        ("repetitions", plan(|plan| plan.repetitions = 0)),
        ("a slice backwards", plan(|plan| plan.pairs = slices(&[(3, 1)]))),
        (
            "slices that overlap",
            plan(|plan| plan.pairs = slices(&[(0, 2), (2, 3)])),
        ),
        ("too many records", plan(|plan| plan.repetitions = u32::MAX)),
        ("a worker too few", merged(&good, &[None]).unwrap_err()),
    ];
    assert_refusals("plans", &refusals.map(|(what, refusal)| (what.to_owned(), refusal)));
}

#[test]
fn an_unpublishable_metric_is_refused() {
    let plan = pod(V1, 1, &[(0, 0)]);
    let mut drive = Drive::perfect(0).status("Failed");
    drive.route = 1e-320;
    drive.infractions = vec![("red_light", vec!["Agent ran a red light".to_owned()])];
    let refusal = merged(&plan, &[Some(finished(V1, &[drive]))]).unwrap_err();
    assert_refusals("metrics", &[("a rate that overflows".to_owned(), refusal)]);
}
