//! Cost of storing a file, and its content when it is read back.

use super::*;

const LOG: &str = "agent/agent1/leaderboard.log";
/// Least size that a file counts, in bytes.
const PAGE: usize = 4096;

async fn sync(pod: &Pod, uploader: &mut Uploader, path: &str) -> Sent {
    let tree = Tree::open(pod.logs()).unwrap();
    let (_, stamp) = tree.file(path).unwrap().unwrap();
    let wanted = [Wanted::new(path, stamp, Haste::Now)];
    uploader.sync(&wanted, Window::default()).await.unwrap()
}

#[tokio::test]
async fn a_growing_log_costs_what_it_grew_and_reads_back_byte_for_byte() {
    let bucket = server().await.bucket().await;
    let proxy = server().await.proxy().await;
    let pod = Pod::on(&proxy.endpoint(), &bucket, run(&bucket)).await;
    let mut uploader = pod.uploader();
    let mut size = 0;
    for (step, target) in [1, 3, 5, 6, 7, 20, 21, 50].into_iter().enumerate() {
        let grown = target * MIB + step - size;
        pod.append(LOG, &noise(grown, step as u64));
        let appends = size >= 5 * MIB;
        size += grown;
        let before = proxy.counts().sent;
        assert_eq!(sync(&pod, &mut uploader, LOG).await.objects, 1);
        let cost = usize::try_from(proxy.counts().sent - before).unwrap();
        let aim = if appends { grown } else { size };
        assert!(cost <= aim + aim / 10 + 32_000, "{cost} bytes sent for {aim} at {size}");
        assert_eq!(
            pod.stored(LOG).await.unwrap(),
            fs::read(pod.path(LOG)).unwrap(),
            "{target} MiB"
        );
    }
}

#[tokio::test]
async fn an_unchanged_round_sends_nothing_even_after_a_restart() {
    let bucket = server().await.bucket().await;
    let proxy = server().await.proxy().await;
    let pod = Pod::on(&proxy.endpoint(), &bucket, run(&bucket)).await;
    pod.put(LOG, &noise(6 * MIB, 1));
    pod.put("simulator/empty", b"");
    let mut uploader = pod.uploader();
    for path in [LOG, "simulator/empty"] {
        assert_eq!(sync(&pod, &mut uploader, path).await.objects, 1);
    }
    let before = proxy.counts().sent;
    let mut restarted = pod.uploader();
    for uploader in [&mut uploader, &mut restarted] {
        for path in [LOG, "simulator/empty"] {
            assert_eq!(sync(&pod, uploader, path).await, Sent::default());
        }
    }
    File::open(pod.path("simulator/empty"))
        .unwrap()
        .set_modified(std::time::SystemTime::UNIX_EPOCH)
        .unwrap();
    assert_eq!(sync(&pod, &mut uploader, "simulator/empty").await.objects, 0);
    assert_eq!(proxy.counts().sent, before);
}

#[tokio::test]
async fn a_log_that_was_written_anew_is_stored_anew() {
    let pod = Pod::new().await;
    let mut uploader = pod.uploader();
    pod.put(LOG, &noise(6 * MIB, 1));
    sync(&pod, &mut uploader, LOG).await;
    // The file is longer, and has another beginning.
    pod.put(LOG, &noise(7 * MIB, 2));
    assert_eq!(sync(&pod, &mut uploader, LOG).await.objects, 1);
    assert_eq!(pod.stored(LOG).await.unwrap(), noise(7 * MIB, 2));
    pod.put(LOG, b"short");
    assert_eq!(sync(&pod, &mut uploader, LOG).await.objects, 1);
    assert_eq!(pod.stored(LOG).await.unwrap(), b"short");
}

#[tokio::test]
async fn the_limit_leaves_files_out_and_keeps_the_rest() {
    let pod = Pod::new().await;
    let tree = Arc::new(Tree::open(pod.logs()).unwrap());
    let mut uploader = Uploader::new(
        pod.archive.clone(),
        Arc::clone(&tree),
        Quota::new(8 * LEAST, 1, Host::Simulator),
    );
    // Three quarters are for all but the known logs, and a small file counts as a page.
    pod.put("simulator/large", &vec![0; 6 * PAGE]);
    pod.put("simulator/small", &[0; 20]);
    let wanted: Vec<Wanted> = ["simulator/small", "simulator/large"]
        .map(|path| Wanted::new(path, tree.file(path).unwrap().unwrap().1, Haste::Now))
        .into();
    let sent = uploader.sync(&wanted, Window::default()).await.unwrap();
    assert_eq!((sent.objects, sent.left_out), (1, 1));
    assert_eq!(pod.keys().await, ["simulator/small"]);
}

#[tokio::test]
async fn a_file_that_grows_after_it_was_counted_is_sent_as_far_as_it_was_counted() {
    let pod = Pod::new().await;
    let tree = Arc::new(Tree::open(pod.logs()).unwrap());
    let mut uploader = Uploader::new(
        pod.archive.clone(),
        Arc::clone(&tree),
        Quota::new(2 * LEAST, 1, Host::Simulator),
    );
    let path = "agent/agent1/x.log";
    pod.put(path, b"0123456789");
    let counted = Wanted::new(path, tree.file(path).unwrap().unwrap().1, Haste::Now);
    pod.append(path, &[b'x'; PAGE]);
    assert_eq!(uploader.sync(&[counted], Window::default()).await.unwrap().objects, 1);
    assert_eq!(pod.stored(path).await.unwrap(), b"0123456789");
    assert_eq!(uploader.memory().bytes(), 10);
    // The next round counts what it has become.
    let grown = Wanted::new(path, tree.file(path).unwrap().unwrap().1, Haste::Now);
    let sent = uploader.sync(&[grown], Window::default()).await.unwrap();
    assert_eq!((sent.objects, sent.left_out), (0, 1));
    pod.put(path, b"0123456789ab");
    let shrunk = Wanted::new(path, tree.file(path).unwrap().unwrap().1, Haste::Now);
    assert_eq!(uploader.sync(&[shrunk], Window::default()).await.unwrap().objects, 1);
    assert_eq!(pod.stored(path).await.unwrap(), b"0123456789ab");
}

#[tokio::test]
async fn two_files_under_one_key_are_stored_once_and_counted_once() {
    let pod = Pod::new().await;
    let tree = Arc::new(Tree::open(pod.logs()).unwrap());
    let mut uploader = Uploader::new(
        pod.archive.clone(),
        Arc::clone(&tree),
        Quota::new(8 * LEAST, 1, Host::Simulator),
    );
    let both = |first: &[u8], second: &[u8]| {
        pod.put("agent/agent1/first", first);
        pod.put("agent/agent1/second", second);
        let wanted = ["first", "second"].map(|name| {
            let path = format!("agent/agent1/{name}");
            let stamp = tree.file(&path).unwrap().unwrap().1;
            Wanted {
                key: "agent/agent1/key".to_owned(),
                ..Wanted::new(&path, stamp, Haste::Now)
            }
        });
        wanted.to_vec()
    };
    for (first, second) in [(&[b'1'; 90][..], &b"2"[..]), (b"1", b"22")] {
        let sent = uploader.sync(&both(first, second), Window::default()).await.unwrap();
        assert_eq!((sent.objects, sent.left_out), (1, 1));
        assert_eq!(pod.stored("agent/agent1/key").await.unwrap(), first);
    }
    assert_eq!(uploader.memory().bytes(), 1);
}

#[tokio::test]
async fn odd_names_are_stored_and_appended_to() {
    let pod = Pod::new().await;
    let mut uploader = pod.uploader();
    let path = "simulator/a b+c&d=é%20?#.log";
    pod.put(path, &noise(5 * MIB, 1));
    sync(&pod, &mut uploader, path).await;
    pod.append(path, b"more");
    sync(&pod, &mut uploader, path).await;
    assert_eq!(pod.stored(path).await.unwrap(), fs::read(pod.path(path)).unwrap());
}

#[tokio::test]
async fn results_from_memory_are_sent_when_they_change_and_not_again_after_a_restart() {
    let bucket = server().await.bucket().await;
    let proxy = server().await.proxy().await;
    let pod = Pod::on(&proxy.endpoint(), &bucket, run(&bucket)).await;
    let object = |text: &str| {
        BTreeMap::from([(
            "agent/agent1/agent_results.json".to_owned(),
            Object::new(text.to_owned()),
        )])
    };
    let first = object("first");
    let mut uploader = pod.uploader();
    assert_eq!(uploader.put(&first).await.unwrap().objects, 1);
    let before = proxy.counts().sent;
    for same in [&first, &object("first")] {
        assert_eq!(uploader.put(same).await.unwrap(), Sent::default());
        assert_eq!(pod.uploader().put(same).await.unwrap(), Sent::default());
    }
    assert_eq!(proxy.counts().sent, before);
    proxy.set_away(true);
    assert!(uploader.put(&object("second")).await.is_err());
    proxy.set_away(false);
    assert_eq!(uploader.put(&object("second")).await.unwrap().objects, 1);
    assert_eq!(pod.stored("agent/agent1/agent_results.json").await.unwrap(), b"second");
}
