//! Names and labels of all families, and which program exports which.

use std::time::Duration;

use super::*;

/// One of everything.
fn all(program: Program) -> Metrics {
    let metrics = Metrics::new(program);
    metrics.reconciled("Submission", "ok", Duration::from_millis(20));
    metrics.reconcile_failed("Submission", "conflict");
    let queue = metrics.queue("Submission", ["urgent", "new"]);
    queue.waiting([0, 3]);
    queue.began(1, Duration::from_millis(20));
    let watch = metrics.watch("Job");
    watch.failed();
    watch.event();
    metrics.set_leading(Some(7));
    metrics.lease_failed("timeout");
    metrics.set_submissions("Running", 2);
    metrics.set_standing(FAILED, 3);
    metrics.set_observed("SameEnd", 1);
    metrics.set_oldest_message("https://q/1", Some(1_800_000_000_500));
    metrics.set_repeating_teams(1);
    metrics.gpus_used("ns/board".into(), "sensors".into(), Some("7"), 400);
    metrics.set_live_gpu_use(&live(), 240);
    metrics.attempt_failed(FailedAttempt {
        leaderboard: "ns/board".into(),
        class: "Participant",
        reason: "AgentCrashed",
        is_charged: true,
    });
    let state = BoardState {
        is_ready: true,
        oldest_pending: Duration::from_secs(9),
        oldest_unpublished: Duration::from_secs(4),
    };
    metrics.set_leaderboard("ns/board", state);
    metrics.set_limits("ns/board", limits());
    metrics.phase_ended("run", Duration::from_mins(50));
    metrics.spans("sent", 12);
    metrics.evalai_request("put_finished", "ok", Duration::from_millis(20));
    metrics.set_evalai_load(50, 54, 1);
    metrics.cloud_call("s3", "GetObject", "ok", Duration::from_secs(1));
    metrics.sqs_message("created");
    metrics.sqs_message_waited(Duration::from_secs(2));
    metrics
}

const FAILED: Standing = Standing {
    state: "Failed",
    reason: "AgentCrashed",
    class: "Participant",
};

/// A submission that holds GPUs.
fn live() -> OfSubmission {
    OfSubmission {
        leaderboard: "ns/board".into(),
        submission: "submission-1".into(),
    }
}

/// A Leaderboard with everything that has a limit.
fn limits() -> LimitsState {
    LimitsState {
        slots_in_use: 3,
        slots: Some(8),
        token_ends: Some(jiff::Timestamp::from_second(1_800_000_000).unwrap()),
        queue: Some((5, 2)),
        dead_letters: Some(1),
        rows_waiting: Some(187),
    }
}

#[test]
fn every_metric_has_its_name_and_its_labels() {
    let text = all(Program::Controller).text().unwrap();
    for line in [
        "leaderboard_reconciles_total{kind=\"Submission\",outcome=\"ok\"} 1",
        "leaderboard_reconcile_duration_seconds_bucket{le=\"0.025\",kind=\"Submission\"} 1",
        "leaderboard_reconcile_errors_total{kind=\"Submission\",reason=\"conflict\"} 1",
        "leaderboard_reconciles_waiting{kind=\"Submission\",class=\"new\"} 3",
        "leaderboard_reconcile_wait_duration_seconds_bucket{le=\"0.025\",kind=\"Submission\",class=\"new\"} 1",
        "leaderboard_reconcile_wait_duration_seconds_count{kind=\"Submission\",class=\"urgent\"} 0",
        "leaderboard_watch_errors_total{kind=\"Job\"} 1",
        "leaderboard_watch_unreadable_objects{kind=\"Job\"} 0",
        "leaderboard_is_leader 1",
        "leaderboard_leader_term 7",
        "leaderboard_lease_errors_total{reason=\"timeout\"} 1",
        "leaderboard_submissions{state=\"Running\"} 2",
        "leaderboard_submissions_by_reason{state=\"Failed\",reason=\"AgentCrashed\",class=\"Participant\"} 3",
        "leaderboard_queue_oldest_message_timestamp_seconds{queue=\"https://q/1\"} 1800000000.5",
        "leaderboard_teams_with_repeated_infrastructure_failures 1",
        "leaderboard_gpu_seconds_total{leaderboard=\"ns/board\",track=\"sensors\"} 400",
        "leaderboard_team_gpu_seconds_total{leaderboard=\"ns/board\",team=\"7\"} 400",
        "leaderboard_submission_gpu_seconds{leaderboard=\"ns/board\",submission=\"submission-1\"} 240",
        "leaderboard_submission_failures_total{leaderboard=\"ns/board\",class=\"Participant\",reason=\"AgentCrashed\",charged=\"true\"} 1",
        "leaderboard_ready{leaderboard=\"ns/board\"} 1",
        "leaderboard_oldest_pending_seconds{leaderboard=\"ns/board\"} 9.0",
        "leaderboard_oldest_unpublished_seconds{leaderboard=\"ns/board\"} 4.0",
        "leaderboard_slots_in_use{leaderboard=\"ns/board\"} 3",
        "leaderboard_slots_limit{leaderboard=\"ns/board\"} 8",
        "leaderboard_evalai_token_expiry_timestamp_seconds{leaderboard=\"ns/board\"} 1800000000.0",
        "leaderboard_queue_visible_messages{leaderboard=\"ns/board\"} 5",
        "leaderboard_queue_in_flight_messages{leaderboard=\"ns/board\"} 2",
        "leaderboard_dead_letter_queue_messages{leaderboard=\"ns/board\"} 1",
        "leaderboard_table_rows_waiting{leaderboard=\"ns/board\"} 187",
        "leaderboard_submission_phase_duration_seconds_bucket{le=\"3600.0\",phase=\"run\"} 1",
        "leaderboard_submission_phase_duration_seconds_bucket{le=\"1800.0\",phase=\"run\"} 0",
        "leaderboard_trace_spans_total{outcome=\"sent\"} 12",
        "leaderboard_evalai_requests_total{op=\"put_finished\",outcome=\"ok\"} 1",
        "leaderboard_evalai_request_duration_seconds_bucket{le=\"0.025\",op=\"put_finished\"} 1",
        "leaderboard_evalai_budget_used 50",
        "leaderboard_evalai_budget_limit 54",
        "leaderboard_evalai_waiting 1",
        "leaderboard_cloud_calls_total{service=\"s3\",op=\"GetObject\",outcome=\"ok\"} 1",
        "leaderboard_cloud_call_duration_seconds_bucket{le=\"1.0\",service=\"s3\",op=\"GetObject\"} 1",
    ] {
        assert!(text.lines().any(|l| l == line), "{line} is missing in\n{text}");
    }
    assert!(text.ends_with("# EOF\n"));
}

#[test]
fn fifty_teams_of_a_leaderboard_have_a_sample_each_and_the_others_one() {
    let metrics = Metrics::new(Program::Controller);
    let used = |board: &str, team: Option<&str>| metrics.gpus_used(board.into(), "map".into(), team, 2);
    let teams: Vec<String> = (1..=200).map(|number| format!("Team {number}")).collect();
    for team in teams.iter().chain(&teams) {
        used("ns/board", Some(team));
    }
    used("ns/other", Some("Team 200"));
    used("ns/other", Some("two\nlines\u{1b}[2J\u{202e}"));
    used("ns/other", None);
    let text = metrics.text().unwrap();
    let samples: Vec<&str> = text
        .lines()
        .filter(|line| line.starts_with("leaderboard_team_gpu_seconds_total{"))
        .collect();
    assert_eq!(samples.len(), 50 + 1 + 2, "{samples:#?}");
    for line in [
        "leaderboard_team_gpu_seconds_total{leaderboard=\"ns/board\",team=\"Team 1\"} 4",
        "leaderboard_team_gpu_seconds_total{leaderboard=\"ns/board\",team=\"Team 50\"} 4",
        "leaderboard_team_gpu_seconds_total{leaderboard=\"ns/board\",team=\"other\"} 600",
        "leaderboard_team_gpu_seconds_total{leaderboard=\"ns/other\",team=\"Team 200\"} 2",
        "leaderboard_team_gpu_seconds_total{leaderboard=\"ns/other\",team=\"two lines\u{fffd}[2J\u{fffd}\"} 2",
        "leaderboard_gpu_seconds_total{leaderboard=\"ns/other\",track=\"map\"} 6",
    ] {
        assert!(text.lines().any(|found| found == line), "{line} is missing in\n{text}");
    }
}

#[test]
fn what_differs_with_each_run_has_its_name_too() {
    let text = all(Program::Controller).text().unwrap();
    for start in [
        concat!(
            "leaderboard_build_info{version=\"",
            env!("CARGO_PKG_VERSION"),
            "\",revision=\""
        ),
        "leaderboard_watch_last_event_timestamp_seconds{kind=\"Job\"} 1",
        "process_start_time_seconds 1",
        "process_cpu_seconds_total ",
        "process_resident_memory_bytes ",
        "process_open_fds ",
        "process_max_fds ",
        "leaderboard_runtime_workers ",
        "leaderboard_runtime_tasks ",
        "leaderboard_runtime_queued_tasks ",
        "leaderboard_runtime_busy_seconds_total ",
    ] {
        assert!(
            text.lines().any(|l| l.starts_with(start)),
            "{start} is missing in\n{text}"
        );
    }
}

#[test]
fn a_bridge_exports_what_it_counts_and_nothing_of_a_controller() {
    let families = |text: &str| -> Vec<String> {
        let types = text.lines().filter_map(|line| line.strip_prefix("# TYPE "));
        let names = types.filter_map(|line| line.split(' ').next());
        let own = names.filter(|name| name.starts_with("leaderboard_"));
        own.map(str::to_owned).collect()
    };
    let bridge = families(&all(Program::Bridge).text().unwrap());
    let expected = [
        "leaderboard_build",
        "leaderboard_watch_errors",
        "leaderboard_watch_unreadable_objects",
        "leaderboard_watch_last_event_timestamp_seconds",
        "leaderboard_cloud_calls",
        "leaderboard_cloud_call_duration_seconds",
        "leaderboard_runtime_workers",
        "leaderboard_runtime_tasks",
        "leaderboard_runtime_queued_tasks",
        "leaderboard_runtime_busy_seconds",
        "leaderboard_queue_oldest_message_timestamp_seconds",
        "leaderboard_sqs_messages",
        "leaderboard_sqs_message_wait_duration_seconds",
    ];
    assert_eq!(bridge, expected);
    let controller = families(&all(Program::Controller).text().unwrap());
    assert!(!controller.contains(&"leaderboard_sqs_messages".to_owned()));
    assert!(
        controller.len() > 15
            && expected[..11]
                .iter()
                .all(|name| controller.contains(&(*name).to_owned()))
    );
}

#[test]
fn durations_and_times_are_in_seconds() {
    let text = all(Program::Controller).text().unwrap();
    let histograms: Vec<_> = text
        .lines()
        .filter_map(|line| line.strip_prefix("# TYPE ")?.strip_suffix(" histogram"))
        .collect();
    assert!(histograms.len() >= 4, "{histograms:?}");
    assert_eq!(
        histograms.iter().find(|name| !name.ends_with("_duration_seconds")),
        None
    );
}

/// The families that are gauges and have samples, but for those of the process itself, its runtime and its watches.
fn gauges(text: &str) -> Vec<&str> {
    let types = text.lines().filter_map(|line| line.strip_prefix("# TYPE leaderboard_"));
    let gauges = types.filter_map(|line| line.strip_suffix(" gauge"));
    gauges
        .filter(|name| !name.starts_with("runtime_") && !name.starts_with("watch_"))
        .collect()
}

#[test]
fn who_does_not_lead_shows_nothing_that_only_the_leader_counts() {
    let metrics = all(Program::Controller);
    let text = metrics.text().unwrap();
    assert!(gauges(&text).len() >= 18, "{text}");
    metrics.set_leading(None);
    for text in [metrics.text().unwrap(), Metrics::default().text().unwrap()] {
        assert_eq!(gauges(&text), ["is_leader"], "{text}");
        assert!(text.contains("leaderboard_is_leader 0\n"), "{text}");
    }
}

#[test]
fn what_nobody_stands_for_and_an_empty_queue_have_no_samples() {
    let metrics = all(Program::Controller);
    metrics.set_standing(FAILED, 0);
    metrics.set_oldest_message("https://q/1", None);
    let text = metrics.text().unwrap();
    assert!(
        !text.contains("_by_reason{") && !text.contains("_oldest_message_timestamp_seconds{"),
        "{text}"
    );
}

#[test]
fn a_submission_that_holds_no_gpu_any_more_has_no_sample() {
    let metrics = all(Program::Controller);
    metrics.forget_live_gpu_use(&live());
    let text = metrics.text().unwrap();
    assert!(!text.contains("submission=\""), "{text}");
}

#[test]
fn a_leaderboard_that_is_gone_has_no_samples() {
    let metrics = all(Program::Controller);
    metrics.forget_leaderboard("ns/board");
    let text = metrics.text().unwrap();
    assert!(
        !text.contains("leaderboard_ready{") && !text.contains("_oldest_pending_seconds{"),
        "{text}"
    );
    assert!(!text.contains("{leaderboard=\"ns/board\"}"), "{text}");
}

#[test]
fn what_a_leaderboard_no_longer_has_is_no_longer_shown() {
    let metrics = all(Program::Controller);
    let state = LimitsState {
        slots_in_use: 1,
        ..LimitsState::default()
    };
    metrics.set_limits("ns/board", state);
    let text = metrics.text().unwrap();
    assert!(
        text.contains("leaderboard_slots_in_use{leaderboard=\"ns/board\"} 1\n"),
        "{text}"
    );
    for gone in [
        "slots_limit{",
        "token_expiry_timestamp_seconds{",
        "_messages{leaderboard",
        "rows_waiting{leaderboard",
    ] {
        assert!(!text.contains(gone), "{gone} in\n{text}");
    }
}
