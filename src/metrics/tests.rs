//! Names and labels of all families, and which program exports which.

use std::time::Duration;

use super::*;

/// One of everything.
fn all(program: Program) -> Metrics {
    let metrics = Metrics::new(program);
    let (ms, second) = (Duration::from_millis(20), Duration::from_secs(1));
    metrics.set_leading(Some(7));
    metrics.show(samples());
    metrics.reconciled("Submission", "ok", ms);
    metrics.work.reconcile_errors.of(["Submission", "conflict"]).inc();
    metrics
        .work
        .reconcile_wait
        .of(["Submission", "new"])
        .observe(ms.as_secs_f64());
    metrics.work.reconcile_wait.of(["Submission", "urgent"]);
    metrics.work.lease_errors.of(["timeout"]).inc();
    metrics.work.spans.of(["sent"]).inc_by(12);
    let watch = metrics.watch("Job", &Clock::system());
    watch.errors.inc();
    watch.event();
    metrics.set_oldest_message("https://q/1", Some(1_800_000_000_500));
    metrics
        .submissions
        .gpus_used("ns/board".into(), "sensors".into(), Some("7"), 400);
    let failure = ["ns/board", "Participant", "AgentCrashed"];
    metrics.submissions.failures.of(failure).inc();
    metrics.submissions.phases.of(["run"]).observe(3000.0);
    metrics.work.evalai_requests.of(["put_finished", "ok"]).inc();
    metrics
        .work
        .evalai_duration
        .of(["put_finished"])
        .observe(ms.as_secs_f64());
    metrics.shared.cloud_calls.of(["s3", "GetObject", "ok"]).inc();
    let duration = metrics.shared.cloud_call_duration.of(["s3", "GetObject"]);
    duration.observe(second.as_secs_f64());
    metrics.shared.messages.of(["created"]).inc();
    metrics.shared.message_wait.observe(2.0);
    metrics
}

/// A sample of each gauge of the leader.
fn samples() -> Samples {
    let mut samples = Samples::default();
    let board = ["ns/board"];
    samples.set(&leader::SUBMISSIONS, ["Running"], 2);
    samples.set(
        &leader::SUBMISSIONS_BY_REASON,
        ["Failed", "AgentCrashed", "Participant"],
        3,
    );
    samples.set(&leader::GPU_SECONDS, ["ns/board", "submission-1"], 240);
    samples.set(&leader::READY, board, 1);
    samples.set(&leader::OLDEST_PENDING, board, 9);
    samples.set(&leader::OLDEST_UNPUBLISHED, board, 4);
    samples.set(&leader::SLOTS_IN_USE, board, 3);
    samples.set(&leader::SLOTS_LIMIT, board, 8);
    samples.set(&leader::TOKEN_EXPIRY, board, 1_800_000_000);
    samples.set(&leader::VISIBLE_MESSAGES, board, 5);
    samples.set(&leader::IN_FLIGHT_MESSAGES, board, 2);
    samples.set(&leader::DEAD_LETTERS, board, 1);
    samples.set(&leader::ROWS_WAITING, board, 187);
    samples.set(&leader::EVALAI_BUDGET_USED, [], 50);
    samples.set(&leader::EVALAI_BUDGET_LIMIT, [], 54);
    samples.set(&leader::EVALAI_WAITING, [], 1);
    samples.set(&leader::RECONCILES_WAITING, ["Submission", "new"], 3);
    samples
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
        "leaderboard_queue_oldest_message_timestamp_seconds{queue=\"https://q/1\"} 1800000000",
        "leaderboard_gpu_seconds_total{leaderboard=\"ns/board\",track=\"sensors\"} 400",
        "leaderboard_team_gpu_seconds_total{leaderboard=\"ns/board\",team=\"7\"} 400",
        "leaderboard_submission_gpu_seconds{leaderboard=\"ns/board\",submission=\"submission-1\"} 240",
        "leaderboard_submission_failures_total{leaderboard=\"ns/board\",class=\"Participant\",reason=\"AgentCrashed\"} 1",
        "leaderboard_ready{leaderboard=\"ns/board\"} 1",
        "leaderboard_oldest_pending_seconds{leaderboard=\"ns/board\"} 9",
        "leaderboard_oldest_unpublished_seconds{leaderboard=\"ns/board\"} 4",
        "leaderboard_slots_in_use{leaderboard=\"ns/board\"} 3",
        "leaderboard_slots_limit{leaderboard=\"ns/board\"} 8",
        "leaderboard_evalai_token_expiry_timestamp_seconds{leaderboard=\"ns/board\"} 1800000000",
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
    let used = |board: &str, team: Option<&str>| metrics.submissions.gpus_used(board.into(), "map".into(), team, 2);
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

#[tokio::test]
async fn what_differs_with_each_run_has_its_name_too() {
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

#[tokio::test]
async fn a_bridge_exports_what_it_counts_and_nothing_of_a_controller() {
    let families = |text: &str| -> Vec<String> {
        let types = text.lines().filter_map(|line| line.strip_prefix("# TYPE "));
        let names = types.filter_map(|line| line.split(' ').next());
        let own = names.filter(|name| name.starts_with("leaderboard_"));
        own.map(str::to_owned).collect()
    };
    let bridge = families(&all(Program::Bridge).text().unwrap());
    let expected = [
        "leaderboard_runtime_workers",
        "leaderboard_runtime_tasks",
        "leaderboard_runtime_queued_tasks",
        "leaderboard_runtime_busy_seconds",
        "leaderboard_build",
        "leaderboard_watch_errors",
        "leaderboard_watch_unreadable_objects",
        "leaderboard_watch_last_event_timestamp_seconds",
        "leaderboard_cloud_calls",
        "leaderboard_cloud_call_duration_seconds",
        "leaderboard_queue_oldest_message_timestamp_seconds",
        "leaderboard_queue_messages",
        "leaderboard_queue_message_wait_duration_seconds",
    ];
    assert_eq!(bridge, expected);
    let controller = families(&all(Program::Controller).text().unwrap());
    assert!(controller.len() > 15 && expected.iter().all(|name| controller.contains(&(*name).to_owned())));
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
    for text in [
        metrics.text().unwrap(),
        Metrics::new(Program::Controller).text().unwrap(),
    ] {
        assert_eq!(gauges(&text), ["is_leader"], "{text}");
        assert!(text.contains("leaderboard_is_leader 0\n"), "{text}");
    }
}

#[test]
fn a_walk_replaces_all_that_the_one_before_has_shown() {
    let metrics = all(Program::Controller);
    let mut samples = Samples::default();
    samples.set(&leader::READY, ["ns/other"], 1);
    metrics.show(samples.clone());
    metrics.set_oldest_message("https://q/1", None);
    let text = metrics.text().unwrap();
    assert_eq!(gauges(&text), ["is_leader", "leader_term", "ready"], "{text}");
    assert!(
        text.contains("leaderboard_ready{leaderboard=\"ns/other\"} 1\n"),
        "{text}"
    );
    metrics.set_leading(None);
    metrics.show(samples);
    let text = metrics.text().unwrap();
    assert_eq!(
        gauges(&text),
        ["is_leader"],
        "one that ends after the lead shows nothing"
    );
}

#[test]
fn every_call_is_counted_once_also_one_that_was_abandoned() {
    let metrics = Arc::new(Metrics::new(Program::Controller));
    let meter = metrics.meter();
    meter.begin("s3", "GetObject").end("ok");
    drop(meter.clone().begin("evalai", "get_submission"));
    Meter::default().begin("s3", "GetObject").end("ok");
    let text = metrics.text().unwrap();
    for line in [
        "leaderboard_cloud_calls_total{service=\"s3\",op=\"GetObject\",outcome=\"ok\"} 1",
        "leaderboard_evalai_requests_total{op=\"get_submission\",outcome=\"abandoned\"} 1",
    ] {
        assert!(text.lines().any(|found| found == line), "{line} is missing in\n{text}");
    }
}
