//! The recorder on a store of the test's own, under a paused clock.

use std::sync::atomic::{AtomicBool, Ordering};

use tokio::sync::watch;

use super::*;
use leaderboard_base::shutdown::Stop;

type Log = Arc<Mutex<Vec<(Duration, String, String)>>>;

/// Notes what is written and when; answers by script, then well.
struct Fake {
    begun: Instant,
    log: Log,
    answers: Arc<Mutex<Vec<Result<Written, TableError>>>>,
}

impl Store for Fake {
    fn write(&self, table: &api::Table, row: Arc<Row>) -> BoxFuture<'static, Result<Written, TableError>> {
        lock(&self.log).push((self.begun.elapsed(), table.name.clone(), row.progress.clone()));
        let answer = lock(&self.answers).pop().unwrap_or(Ok(Written::Stored));
        async move { answer }.boxed()
    }
}

struct Bench {
    recorder: Recorder,
    log: Log,
    wake: mpsc::UnboundedReceiver<ObjectKey>,
    fence: Arc<AtomicBool>,
    _shutdown: watch::Sender<bool>,
}

fn bench(answers: Vec<Result<Written, TableError>>) -> Bench {
    let (sender, wake) = mpsc::unbounded_channel();
    let (shutdown, stop) = Stop::new();
    let (log, fence) = (Log::default(), Arc::new(AtomicBool::new(true)));
    let fake = Fake {
        begun: Instant::now(),
        log: log.clone(),
        answers: Arc::new(Mutex::new(answers)),
    };
    let may_write = fence.clone();
    Bench {
        recorder: Recorder::with_store(
            Box::new(fake),
            move || may_write.load(Ordering::SeqCst),
            sender,
            Tasks::new(stop),
        ),
        log,
        wake,
        fence,
        _shutdown: shutdown,
    }
}

fn table(name: &str) -> api::Table {
    serde_json::from_value(serde_json::json!({"name": name})).unwrap()
}

fn key(name: &str) -> ObjectKey {
    ObjectKey {
        namespace: "ns".into(),
        name: name.into(),
        uid: "u".into(),
    }
}

fn row(progress: &str) -> Row {
    Row {
        attempt: 1,
        progress: progress.into(),
        ..Row::default()
    }
}

fn throttled() -> Result<Written, TableError> {
    Err(TableError::Passing {
        table: "t".into(),
        action: "UpdateItem",
        text: "slow down".into(),
    })
}

impl Bench {
    fn written(&self) -> Vec<(u64, String)> {
        lock(&self.log)
            .iter()
            .map(|(at, table, progress)| (at.as_secs(), format!("{table} {progress}")))
            .collect()
    }
}

#[tokio::test(start_paused = true)]
async fn a_table_is_written_at_most_every_two_seconds_and_the_newest_row_wins() {
    let mut bench = bench(vec![]);
    for step in 1..=50 {
        bench.recorder.record(
            &table("t"),
            &key("a"),
            row(&format!("{step}/50")),
            step == 50,
            LogSpan::default(),
        );
        bench
            .recorder
            .record(&table("u"), &key("b"), row("1/1"), true, LogSpan::default());
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    let mut woken = vec![bench.wake.recv().await.unwrap(), bench.wake.recv().await.unwrap()];
    woken.sort();
    assert_eq!(woken, [key("a"), key("b")]);
    let of = |name: &str| {
        bench
            .written()
            .into_iter()
            .filter(|(_, text)| text.starts_with(name))
            .collect::<Vec<_>>()
    };
    assert_eq!(of("u"), [(0, "u 1/1".to_owned())]);
    let (times, texts): (Vec<u64>, Vec<String>) = of("t").into_iter().unzip();
    assert_eq!(times, [0, 2, 4, 6]);
    assert_eq!((texts[0].as_str(), texts[3].as_str()), ("t 1/50", "t 50/50"));
    assert!(bench.recorder.view(&key("a")).unwrap().end_written);
}

#[tokio::test(start_paused = true)]
async fn nothing_is_written_while_the_fence_is_down() {
    let mut bench = bench(vec![]);
    bench.fence.store(false, Ordering::SeqCst);
    bench
        .recorder
        .record(&table("t"), &key("a"), row("1/1"), true, LogSpan::default());
    tokio::time::sleep(Duration::from_mins(1)).await;
    assert_eq!(bench.written(), []);
    bench.fence.store(true, Ordering::SeqCst);
    assert_eq!(bench.wake.recv().await, Some(key("a")));
    assert_eq!(bench.written().len(), 1);
}

#[tokio::test(start_paused = true)]
async fn a_sick_table_is_tried_ever_more_slowly_until_it_is_well() {
    let mut bench = bench((0..6).map(|_| throttled()).collect());
    bench
        .recorder
        .record(&table("t"), &key("a"), row("1/1"), true, LogSpan::default());
    assert_eq!(bench.wake.recv().await, Some(key("a")));
    let error = bench.recorder.view(&key("a")).unwrap().error.unwrap();
    assert_eq!(error, "table t: UpdateItem failed: slow down; it is retried");
    // The same failure again wakes nobody; the end does.
    assert_eq!(bench.wake.recv().await, Some(key("a")));
    assert!(bench.recorder.view(&key("a")).unwrap().end_written);
    let written = bench.written();
    assert_eq!(written.len(), 7);
    let total = written[6].0;
    assert!(
        (126..=252).contains(&total),
        "between half and all of 4+8+…+128 s: {total}"
    );
}

#[tokio::test(start_paused = true)]
async fn a_worker_that_panics_is_a_failed_task_of_the_process() {
    struct Broken;
    impl Store for Broken {
        fn write(&self, _table: &api::Table, _row: Arc<Row>) -> BoxFuture<'static, Result<Written, TableError>> {
            async { panic!("no such row") }.boxed()
        }
    }
    let (_stop, signal) = Stop::new();
    let tasks = Tasks::new(signal);
    let recorder = Recorder::with_store(Box::new(Broken), || true, mpsc::unbounded_channel().0, tasks.clone());
    recorder.record(&table("t"), &key("a"), row("1"), false, LogSpan::default());
    let failed = tokio::time::timeout(Duration::from_mins(1), tasks.failed())
        .await
        .unwrap();
    assert_eq!(
        (failed.task.as_str(), failed.why.as_str()),
        ("table t", "has panicked: no such row")
    );
}

#[tokio::test(start_paused = true)]
async fn a_running_submission_costs_a_write_for_each_step_of_its_progress_and_none_at_rest() {
    let bench = bench(vec![]);
    // A reconcile of a live run each 10 s: three new routes in ten minutes.
    for step in 0..60 {
        let progress = format!("{}/20", step / 20);
        bench
            .recorder
            .record(&table("t"), &key("a"), row(&progress), false, LogSpan::default());
        tokio::time::sleep(Duration::from_secs(10)).await;
    }
    assert_eq!(bench.written().len(), 3);
}

#[tokio::test(start_paused = true)]
async fn nothing_is_remembered_of_a_thousand_rows_that_are_written_and_forgotten() {
    let mut bench = bench(vec![]);
    let keys: Vec<ObjectKey> = (0..1000).map(|number| key(&format!("submission-{number}"))).collect();
    for key in &keys {
        bench
            .recorder
            .record(&table("t"), key, row("20/20"), true, LogSpan::default());
    }
    for _ in &keys {
        let key = bench.wake.recv().await.unwrap();
        assert!(bench.recorder.view(&key).unwrap().end_written);
        bench.recorder.forget(&key);
    }
    assert_eq!(lock(&bench.recorder.shared.ledger).len(), 0);
    tokio::time::sleep(2 * LINGERS).await;
    assert_eq!(lock(&bench.recorder.shared.tables).len(), 0, "the task of the table");
}

#[tokio::test(start_paused = true)]
async fn a_table_that_was_quiet_for_long_is_written_again() {
    let mut bench = bench(vec![]);
    for progress in ["1/2", "2/2"] {
        bench
            .recorder
            .record(&table("t"), &key("a"), row(progress), true, LogSpan::default());
        bench.wake.recv().await.unwrap();
        tokio::time::sleep(2 * LINGERS).await;
        assert!(lock(&bench.recorder.shared.tables).is_empty());
    }
    assert_eq!(bench.written().len(), 2);
}
