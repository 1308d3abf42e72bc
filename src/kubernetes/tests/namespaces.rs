//! One watch of several namespaces, each with an API server's answers of its own.

use super::*;

fn within(namespace: &str, name: &str, uid: &str, version: &str) -> Value {
    let mut object = board(name, uid, version);
    object["metadata"]["namespace"] = namespace.into();
    object
}

struct Two {
    rig: Rig,
    b: Script,
}

/// Watches the namespaces a and b; the script of the rig is a's.
fn two(a: Vec<Answer>, b: Vec<Answer>) -> Two {
    let ((of_a, script), (of_b, b)) = (scripted(a), scripted(b));
    let (stop, receiver) = Stop::new();
    let telemetry = Observability::new(receiver);
    telemetry.readiness.registered();
    let apis = vec![guarded(of_a, Some("a")), guarded(of_b, Some("b"))];
    let watch = spawn_watch(apis, Config::default(), |_| None, &telemetry);
    let rig = Rig {
        events: watch.subscribe(),
        watch,
        telemetry,
        stop,
        script,
    };
    Two { rig, b }
}

fn refused() -> Answer {
    let status =
        json!({"kind": "Status", "status": "Failure", "reason": "Forbidden", "code": 403, "message": "no right"});
    Answer::Json(403, status)
}

async fn names(rig: &mut Rig, count: usize) -> Vec<String> {
    let mut names = Vec::new();
    for _ in 0..count {
        names.push(rig.next().await.0);
    }
    names.sort();
    names
}

#[tokio::test(start_paused = true)]
async fn it_is_complete_once_every_namespace_was_listed() {
    let first = vec![
        list(&[within("a", "one", "1", "5")]),
        Answer::Watch(vec![line("ADDED", &within("a", "early", "2", "6"))]),
    ];
    let mut two = two(first, Vec::new());
    // All objects of a, without a list of b: no subscriber gets them yet, however late it subscribes.
    while two.rig.watch.store.len() < 2 {
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    assert!(!two.rig.watch.synced.is_true() && !two.rig.watch.is_complete());
    assert_eq!(
        two.rig.telemetry.readiness.missing(),
        ["leaderboards synced: the first list has not come yet"]
    );
    let mut late = two.rig.watch.subscribe();
    send(&two.b, vec![list(&[within("b", "two", "3", "7")])]);
    assert_eq!(names(&mut two.rig, 3).await, ["early", "one", "two"]);
    for _ in 0..3 {
        assert!(timeout(LIMIT, late.next()).await.expect("in time").is_some());
    }
    assert!(two.rig.watch.is_complete() && two.rig.telemetry.readiness.missing().is_empty());
}

#[tokio::test(start_paused = true)]
async fn a_list_of_one_namespace_takes_nothing_from_another() {
    let mut two = two(
        vec![list(&[within("a", "one", "1", "5"), within("a", "gone", "2", "5")])],
        vec![list(&[within("b", "two", "3", "7")])],
    );
    assert_eq!(names(&mut two.rig, 3).await, ["gone", "one", "two"]);
    two.rig
        .send(vec![Answer::Watch(vec![gone()]), list(&[within("a", "one", "1", "5")])]);
    assert_eq!(two.rig.next().await, event("gone", "5", true));
    assert_eq!(two.rig.watch.store.len(), 2);
    send(
        &two.b,
        vec![Answer::Watch(vec![line("DELETED", &within("b", "two", "3", "9"))])],
    );
    assert_eq!(two.rig.next().await, event("two", "9", true));
}

#[tokio::test(start_paused = true)]
async fn a_refusal_in_one_namespace_is_named_and_the_other_goes_on() {
    let mut two = two(vec![list(&[])], vec![refused()]);
    let said = "leaderboards synced: ";
    while !two.rig.telemetry.readiness.missing().join("").contains("(namespace b)") {
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    let missing = two.rig.telemetry.readiness.missing().join("");
    assert!(missing.starts_with(said) && missing.contains("no right"), "{missing}");
    send(&two.b, vec![list(&[within("b", "two", "3", "7")])]);
    assert_eq!(two.rig.next().await, event("two", "7", false));
    assert!(two.rig.telemetry.readiness.missing().is_empty());

    // A watch that is refused later makes all of it uncertain, until the next list.
    send(&two.b, vec![refused()]);
    while two.rig.watch.synced.is_true() {
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    two.rig
        .send(vec![Answer::Watch(vec![line("ADDED", &within("a", "one", "1", "8"))])]);
    assert_eq!(two.rig.next().await, event("one", "8", false), "a goes on");
    assert!(!two.rig.watch.synced.is_true());
    send(&two.b, vec![list(&[within("b", "two", "3", "7")])]);
    while !two.rig.watch.synced.is_true() {
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
}
