//! Each rule of the queue by itself.

use super::*;

const LIMITS: Limits = Limits {
    reconciles: 16,
    creates: 8,
    creates_per_namespace: 4,
};

fn key(name: &str) -> Key {
    in_namespace("one", name)
}

fn in_namespace(namespace: &str, name: &str) -> Key {
    Key {
        namespace: namespace.into(),
        name: name.into(),
    }
}

fn seconds(seconds: u64) -> Duration {
    Duration::from_secs(seconds)
}

/// A queue and the present time.
struct Bench {
    state: State,
    now: Instant,
}

impl Bench {
    fn new(limits: Limits) -> Self {
        Self {
            state: State::new(limits),
            now: Instant::now(),
        }
    }

    fn add(&mut self, name: &str, class: Class) {
        self.state.add(key(name), class, self.now);
    }

    fn add_many(&mut self, names: &[&str], class: Class) {
        for name in names {
            self.add(name, class);
        }
    }

    fn begin(&mut self) -> Option<String> {
        Some(self.state.begin(self.now)?.key.name.to_string())
    }

    /// The names of all that begin, one after the other.
    fn one_by_one(&mut self) -> Vec<String> {
        let mut names = Vec::new();
        while let Some(begun) = self.state.begin(self.now) {
            self.state.finish(&begun.key, After::Gone, self.now);
            names.push(begun.key.name.to_string());
        }
        names
    }

    fn finish(&mut self, name: &str, after: After) {
        self.state.finish(&key(name), after, self.now);
    }
}

const LATER: After = After::In(Duration::from_mins(10), Class::Refresh);

#[test]
fn events_while_it_runs_make_exactly_one_more_reconcile_after_it() {
    let mut bench = Bench::new(LIMITS);
    bench.add_many(&["a", "a", "a"], Class::Refresh);
    assert_eq!(bench.begin().as_deref(), Some("a"));
    assert_eq!(bench.begin(), None, "three events at once are one reconcile");
    bench.add_many(&["a", "a"], Class::Refresh);
    assert_eq!(bench.begin(), None, "two at once of one object");
    bench.finish("a", LATER);
    assert_eq!(bench.begin().as_deref(), Some("a"));
    bench.finish("a", LATER);
    assert_eq!(bench.begin(), None);
}

#[test]
fn the_earliest_time_wins() {
    for (what, event_at, begins_at) in [
        ("nothing else happens", None, 30),
        ("an event comes before its time", Some(10), 10),
        ("an event comes at its time", Some(30), 30),
    ] {
        let mut bench = Bench::new(LIMITS);
        bench.add("a", Class::Refresh);
        bench.begin();
        bench.finish("a", After::In(seconds(30), Class::Refresh));
        let began = bench.now;
        assert_eq!(bench.state.next_time(), Some(began + seconds(30)));
        let mut found = None;
        for second in 0..60 {
            bench.now = began + seconds(second);
            if event_at == Some(second) {
                bench.add("a", Class::Refresh);
            }
            if bench.begin().is_some() {
                found = Some(second);
                bench.finish("a", LATER);
            }
        }
        assert_eq!(found, Some(begins_at), "{what}");
    }
}

#[test]
fn a_later_event_does_not_postpone_an_earlier_one() {
    let mut bench = Bench::new(LIMITS);
    bench.add("first", Class::Refresh);
    bench.now += seconds(1);
    bench.add_many(&["second", "first"], Class::Refresh);
    assert_eq!(bench.one_by_one(), ["first", "second"]);
}

#[test]
fn a_requeue_without_delay_is_ready_at_once() {
    let mut bench = Bench::new(LIMITS);
    bench.add("a", Class::Refresh);
    bench.begin();
    bench.finish("a", After::In(Duration::ZERO, Class::Refresh));
    assert_eq!(bench.begin().as_deref(), Some("a"));
}

#[test]
fn a_deleted_object_leaves_nothing_behind() {
    for stage in ["ready", "running, with an event", "waiting"] {
        let mut bench = Bench::new(LIMITS);
        bench.add("a", Class::New);
        if stage != "ready" {
            bench.begin();
        }
        match stage {
            "waiting" => bench.finish("a", LATER),
            _ => bench.add("a", Class::New),
        }
        bench.state.forget(&key("a"));
        bench.finish("a", LATER);
        assert_eq!(bench.begin(), None, "{stage}");
        let state = &bench.state;
        let left = (
            state.objects.len(),
            state.timers.len(),
            state.running,
            state.permits.taken,
        );
        assert_eq!((left, state.depth()), ((0, 0, 0, 0), [0; 3]), "{stage}");
    }
}

#[test]
fn an_object_of_the_same_name_is_reconciled_after_the_deleted_one() {
    let mut bench = Bench::new(LIMITS);
    bench.add("a", Class::New);
    bench.begin();
    bench.state.forget(&key("a"));
    bench.add("a", Class::New);
    bench.finish("a", After::Gone);
    assert_eq!(bench.begin().as_deref(), Some("a"));
}

#[test]
fn the_most_urgent_are_first_and_then_who_has_waited_longest() {
    let mut bench = Bench::new(LIMITS);
    bench.add_many(&["live 1", "live 2", "live 3"], Class::Refresh);
    bench.add_many(&["new 1", "new 2"], Class::New);
    bench.now += seconds(1);
    bench.add_many(&["end", "live 3"], Class::Urgent);
    bench.add("live 2", Class::New);
    assert_eq!(bench.state.depth(), [2, 3, 1]);
    // One that has become more urgent keeps the time since which it waits.
    assert_eq!(
        bench.one_by_one(),
        ["live 3", "end", "live 2", "new 1", "new 2", "live 1"]
    );
}

#[test]
fn while_an_end_is_awaited_every_event_is_urgent() {
    let mut bench = Bench::new(LIMITS);
    bench.add("ending", Class::Refresh);
    bench.begin();
    bench.finish("ending", After::In(seconds(500), Class::Urgent));
    bench.add_many(&["live", "ending"], Class::Refresh);
    assert_eq!(bench.one_by_one(), ["ending", "live"]);
}

#[test]
fn a_lower_class_that_has_waited_gets_each_fourth() {
    let mut bench = Bench::new(LIMITS);
    bench.add_many(&["live", "live too"], Class::Refresh);
    bench.now += seconds(4);
    bench.add_many(&["n1", "n2"], Class::New);
    bench.add_many(&["u1", "u2", "u3", "u4", "u5", "u6", "u7", "u8", "u9"], Class::Urgent);
    assert_eq!(bench.begin().as_deref(), Some("u1"), "nobody has waited long");
    bench.now += seconds(1);
    let order = bench.one_by_one();
    let expected = [
        "u2", "u3", "u4", "live", "u5", "u6", "u7", "live too", "u8", "u9", "n1", "n2",
    ];
    assert_eq!(order, expected);
}

#[test]
fn new_ones_begin_with_a_permit_in_all_and_by_namespace() {
    let mut bench = Bench::new(LIMITS);
    for namespace in ["one", "two", "three"] {
        for number in 0..10 {
            bench
                .state
                .add(in_namespace(namespace, &number.to_string()), Class::New, bench.now);
        }
    }
    let mut begun = Vec::new();
    while let Some(next) = bench.state.begin(bench.now) {
        begun.push(next.key);
    }
    let of = |namespace: &str| begun.iter().filter(|key| &*key.namespace == namespace).count();
    assert_eq!(
        [of("one"), of("two"), of("three")],
        [4, 4, 0],
        "who has waited longest is first"
    );
    // One in the first namespace turns out to create nothing, one in the second has created its Job.
    assert!(bench.state.may_continue(&begun[0], false));
    assert_eq!(&*bench.state.begin(bench.now).unwrap().key.namespace, "one");
    assert_eq!(bench.state.begin(bench.now), None, "all permits are taken");
    let second = begun.iter().find(|key| &*key.namespace == "two").unwrap();
    assert!(bench.state.may_continue(second, true));
    bench.state.finish(second, LATER, bench.now);
    assert_eq!(&*bench.state.begin(bench.now).unwrap().key.namespace, "two");
}

#[test]
fn who_finds_no_permit_waits_for_one_without_running() {
    let limits = Limits { creates: 1, ..LIMITS };
    let mut bench = Bench::new(limits);
    bench.add_many(&["retry", "other"], Class::Refresh);
    assert_eq!([bench.begin(), bench.begin()].map(Option::unwrap), ["retry", "other"]);
    assert!(bench.state.may_continue(&key("other"), true));
    assert!(!bench.state.may_continue(&key("retry"), true));
    bench.finish("retry", After::WithPermit);
    assert_eq!((bench.begin(), bench.state.depth()), (None, [0, 1, 0]));
    bench.finish("other", LATER);
    assert_eq!(bench.begin().as_deref(), Some("retry"));
    assert!(bench.state.may_continue(&key("retry"), true), "it came with a permit");
}

#[test]
fn a_stop_does_not_wait_for_a_permit() {
    let limits = Limits { creates: 0, ..LIMITS };
    let mut bench = Bench::new(limits);
    bench.add("a", Class::New);
    assert_eq!(bench.begin(), None);
    bench.add("a", Class::Urgent);
    assert_eq!(bench.begin().as_deref(), Some("a"));
}

#[test]
fn a_quarter_is_kept_free_for_urgent_ones() {
    for (reconciles, of_others) in [(1, 1), (4, 3), (16, 12)] {
        let mut bench = Bench::new(Limits { reconciles, ..LIMITS });
        for number in 0..20 {
            bench.add(&format!("live {number}"), Class::Refresh);
        }
        let begun = std::iter::from_fn(|| bench.begin()).count();
        assert_eq!(begun, of_others);
        for number in 0..20 {
            bench.add(&format!("end {number}"), Class::Urgent);
        }
        let begun = std::iter::from_fn(|| bench.begin()).count();
        assert_eq!(begun, reconciles - of_others);
    }
}
