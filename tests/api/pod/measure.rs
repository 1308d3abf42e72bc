//! Cost of storing a run, measured against the reference of `aws s3 sync`. It takes five minutes, so it runs only by name:
//! `cargo test --profile local --test api -- --ignored --nocapture what_storing_the_reference_costs`.

use super::*;

/// 60 files of 2 MB, of which 8 are logs that grow by 200 kB a round: `aws s3 sync` each round sends 1,280 MB for 166.4.
const FILES: usize = 60;
const LOGS: usize = 8;
const FILE: usize = 2_000_000;
const GROWTH: usize = 200_000;
const ROUNDS: usize = 30;
const PERIOD: u64 = 10;

fn path(file: usize) -> String {
    if file < LOGS {
        format!("simulator/Logs/CarlaUE4-{file}.log")
    } else {
        format!("simulator/recordings/{file}.log")
    }
}

#[tokio::test]
#[ignore = "measures for five minutes"]
async fn what_storing_the_reference_costs() {
    let bucket = server().await.bucket().await;
    let proxy = server().await.proxy().await;
    let mut pod = Pod::on(&proxy.endpoint(), &bucket, run(&bucket)).await;
    pod.setting.run.period_seconds = PERIOD;
    pod.prepare().await.unwrap();
    for file in 0..FILES {
        pod.put(&path(file), &noise(FILE, file as u64));
    }
    let (sent, requests) = (proxy.counts().sent, proxy.counts().requests);
    let logcopy = pod.logcopy();
    let mut tick = tokio::time::interval(Duration::from_secs(PERIOD));
    tick.tick().await;
    for round in 1..ROUNDS {
        tick.tick().await;
        for file in 0..LOGS {
            pod.append(&path(file), &noise(GROWTH, (round * FILES + file) as u64));
        }
        // Four routes in the run, so a result now and then.
        if round % 7 == 0 {
            let done = u32::try_from(round / 7).unwrap();
            pod.checkpoint(1 + (done - 1) / 2, 1 + (done - 1) % 2);
        }
    }
    logcopy.end().await;
    let mut size = 0;
    for key in pod.keys().await {
        let stored = pod.stored(&key).await.unwrap();
        size += stored.len();
        if key.starts_with("simulator/") {
            assert!(
                stored == fs::read(pod.path(&key)).unwrap(),
                "{key} reads back otherwise"
            );
        }
    }
    let sent = usize::try_from(proxy.counts().sent - sent).unwrap();
    let (seconds, hundredths) = ((ROUNDS as u64 - 1) * PERIOD, sent * 100 / size);
    println!(
        "upload: {} kB sent for {} kB: {}.{:02}x; {} requests an hour",
        sent / 1000,
        size / 1000,
        hundredths / 100,
        hundredths % 100,
        (proxy.counts().requests - requests) * 3600 / seconds
    );
    assert!(sent < 2 * size, "{sent} bytes for {size}");
}
