//! Tests of asking, with a clock that stands still until everything waits.

use tokio::sync::{mpsc, watch};

use super::state::{KEPT, State};
use super::*;
use leaderboard_base::shutdown::Stop;
use leaderboard_policy::ask::Rank;

const SECOND: Duration = Duration::from_secs(1);

#[derive(Clone, Debug, PartialEq)]
struct Question {
    number: u32,
    bucket: &'static str,
    takes: Duration,
    outcome: Outcome,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Outcome {
    Good,
    /// It is asked again every 30 s.
    Held,
    /// The answer to a question with a higher number is of another run.
    GoesOn,
    Fails,
}

impl Ask for Question {
    type Answer = u32;
    const AT_ONCE: usize = 3;
    const AT_ONCE_OF_A_SERVICE: usize = 2;
    const LONGEST: Duration = Duration::from_secs(10);

    fn service(&self) -> Service {
        let storage = serde_json::json!({"bucket": self.bucket});
        Service::bucket(&serde_json::from_value(storage).unwrap())
    }

    fn again(&self, result: &Result<u32, Failure>, failures: u32, _waited: Duration) -> Option<Duration> {
        match result {
            Err(_) => Some(3 * SECOND * 2_u32.pow(failures - 1)),
            Ok(_) if self.outcome == Outcome::Held => Some(30 * SECOND),
            Ok(_) => None,
        }
    }

    fn outdates(&self, older: &Self) -> bool {
        self.outcome == Outcome::GoesOn && older.number > self.number
    }
}

fn question(number: u32) -> Question {
    Question {
        number,
        bucket: "a",
        takes: SECOND,
        outcome: Outcome::Good,
    }
}

fn object(uid: &str) -> ObjectKey {
    ObjectKey {
        namespace: "n".into(),
        name: uid.into(),
        uid: uid.into(),
    }
}

struct World {
    /// The task ends when this is dropped.
    _stop: watch::Sender<bool>,
    asker: Asker<Question>,
    began: Instant,
    sent: Arc<Mutex<Vec<(String, u32, u64)>>>,
    woken: mpsc::UnboundedReceiver<String>,
}

impl World {
    fn new() -> Self {
        let sent = Arc::<Mutex<Vec<_>>>::default();
        let (woken, wakes) = mpsc::unbounded_channel();
        let wake = Box::new(move |object: &ObjectKey| woken.send(object.name.clone()).unwrap());
        let (began, noted) = (Instant::now(), Arc::clone(&sent));
        let ask = move |(), Asked { question, about, .. }: Asked<Question>| {
            let second = began.elapsed().as_secs();
            lock(&noted).push((about.uid, question.number, second));
            async move {
                tokio::time::sleep(question.takes).await;
                let why = || Failure::silent("no");
                (question.outcome != Outcome::Fails)
                    .then_some(question.number)
                    .ok_or_else(why)
            }
        };
        let (stop, signal) = Stop::new();
        let asker = Asker::start("test", &Tasks::new(signal), wake, (), ask);
        Self {
            _stop: stop,
            asker,
            began,
            sent,
            woken: wakes,
        }
    }

    fn want(&self, uid: &str, question: Question) {
        self.asker.want(&object(uid), question, LogSpan::default());
    }

    /// Everything that was sent since the last call: of which object, which question, and in which second.
    async fn sent_until(&self, second: u64) -> Vec<(String, u32, u64)> {
        // A little later, so that everything of that second has happened.
        let until = self.began + Duration::from_secs(second) + Duration::from_millis(50);
        tokio::time::sleep_until(until).await;
        std::mem::take(&mut lock(&self.sent))
    }

    fn woken(&mut self) -> Vec<String> {
        std::iter::from_fn(|| self.woken.try_recv().ok()).collect()
    }

    /// The number that was answered, to which question, and how many seconds ago that was sent.
    fn known(&self, uid: &str) -> Option<(Option<u32>, u32, u64)> {
        let last = self.asker.get(uid).last?;
        let found = last.result.as_ref().as_ref().ok().copied();
        Some((found, last.question.number, last.sent_ago.as_secs()))
    }

    fn waited(&self, uid: &str) -> Option<u64> {
        self.asker.get(uid).waited.map(|waited| waited.as_secs())
    }
}

fn sent(uid: &str, number: u32, second: u64) -> (String, u32, u64) {
    (uid.into(), number, second)
}

#[tokio::test(start_paused = true)]
async fn a_question_is_sent_once_and_its_answer_wakes_the_object() {
    let mut world = World::new();
    assert_eq!((world.known("u"), world.waited("u")), (None, None));
    world.want("u", question(7));
    world.want("u", question(7));
    assert_eq!(world.sent_until(0).await, [sent("u", 7, 0)]);
    assert_eq!((world.known("u"), world.waited("u")), (None, Some(0)));
    assert_eq!(world.sent_until(3).await, []);
    assert_eq!(world.woken(), ["u"]);
    assert_eq!(
        world.known("u"),
        Some((Some(7), 7, 3)),
        "it shows nothing of the last 3 s"
    );
    assert_eq!(world.waited("u"), None);
    world.want("u", question(7));
    assert_eq!(world.sent_until(100).await, []);
}

#[tokio::test(start_paused = true)]
async fn a_newer_question_replaces_one_that_waits_for_a_place() {
    let world = World::new();
    for uid in ["a", "b", "c"] {
        world.want(uid, question(1));
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
    world.want("c", question(2));
    world.want("c", question(3));
    assert_eq!(
        world.sent_until(1).await,
        [sent("a", 1, 0), sent("b", 1, 0), sent("c", 3, 1)]
    );
}

#[tokio::test(start_paused = true)]
async fn a_question_that_comes_during_a_read_makes_a_second_one() {
    let mut world = World::new();
    let slow = |number| Question {
        takes: 5 * SECOND,
        ..question(number)
    };
    world.want("u", slow(1));
    world.sent_until(2).await;
    world.want("u", slow(2));
    assert_eq!(world.sent_until(5).await, [sent("u", 2, 5)], "one at a time");
    assert_eq!(
        world.known("u"),
        Some((Some(1), 1, 5)),
        "it answers what was asked first"
    );
    assert!(world.asker.get("u").answer_to(&slow(2)).is_none());
    assert_eq!(world.waited("u"), Some(3), "the second question still waits");
    assert_eq!(world.woken(), ["u"]);
    world.sent_until(10).await;
    assert_eq!(world.known("u"), Some((Some(2), 2, 5)));
    assert_eq!((world.woken(), world.waited("u")), (vec!["u".to_owned()], None));
    assert!(world.asker.get("u").answer_to(&slow(2)).is_some());
}

#[tokio::test(start_paused = true)]
async fn a_question_that_comes_back_during_a_read_is_read_again() {
    let world = World::new();
    for number in [1, 2, 1] {
        world.want("u", question(number));
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
    assert_eq!(world.sent_until(4).await, [sent("u", 1, 0), sent("u", 1, 1)]);
}

#[tokio::test(start_paused = true)]
async fn the_last_answer_stays_readable_while_a_newer_question_waits() {
    let world = World::new();
    world.want("u", question(1));
    world.sent_until(2).await;
    world.want(
        "u",
        Question {
            outcome: Outcome::Fails,
            ..question(2)
        },
    );
    assert_eq!((world.known("u"), world.waited("u")), (Some((Some(1), 1, 2)), Some(0)));
    world.sent_until(4).await;
    assert_eq!((world.known("u"), world.waited("u")), (Some((None, 2, 2)), Some(2)));
    let looked = world.asker.get("u");
    let before = looked.known().map(|before| before.question.number);
    assert_eq!(before, Some(1), "also while the service is silent");
    assert_eq!(looked.silence.map(|silence| silence.lasts.as_secs()), Some(1));
}

#[tokio::test(start_paused = true)]
async fn reads_are_bounded_in_all_and_for_each_service_and_the_oldest_goes_first() {
    let world = World::new();
    let of = |bucket, number| Question {
        bucket,
        takes: 5 * SECOND,
        ..question(number)
    };
    for (uid, bucket) in [("1", "a"), ("2", "a"), ("3", "a"), ("4", "b"), ("5", "b")] {
        world.want(uid, of(bucket, 0));
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
    assert_eq!(
        world.sent_until(4).await,
        [sent("1", 0, 0), sent("2", 0, 0), sent("4", 0, 0)]
    );
    assert_eq!(world.sent_until(5).await, [sent("3", 0, 5), sent("5", 0, 5)]);
}

#[tokio::test(start_paused = true)]
async fn what_fails_is_asked_again_as_its_kind_decides() {
    let mut world = World::new();
    let fails = Question {
        outcome: Outcome::Fails,
        ..question(1)
    };
    world.want("u", fails.clone());
    // One second each, and pauses of 3, 6 and 12 s.
    assert_eq!(
        world.sent_until(24).await,
        [0, 4, 11, 24].map(|second| sent("u", 1, second))
    );
    assert_eq!(world.woken(), ["u"], "only news wakes it");
    world.want("u", question(2));
    world.sent_until(26).await;
    world.want("u", fails);
    let seconds: Vec<u64> = world.sent_until(32).await.into_iter().map(|(.., at)| at).collect();
    assert_eq!(seconds, [26, 30], "failures in a row are counted anew");
    let held = Question {
        outcome: Outcome::Held,
        ..question(3)
    };
    world.want("u", held);
    assert_eq!(
        world.sent_until(95).await,
        [32, 63, 94].map(|second| sent("u", 3, second))
    );
}

#[tokio::test(start_paused = true)]
async fn a_service_that_does_not_answer_in_time_has_failed() {
    let world = World::new();
    let hangs = Question {
        takes: 1000 * SECOND,
        ..question(1)
    };
    world.want("u", hangs.clone());
    world.sent_until(11).await;
    let looked = world.asker.get("u");
    let expected = Failure::silent("bucket a did not answer within 10 s");
    assert_eq!(*looked.answer_to(&hangs).unwrap().result, Err(expected));
}

#[tokio::test(start_paused = true)]
async fn who_is_forgotten_is_not_woken_and_its_read_keeps_its_place() {
    let mut world = World::new();
    world.want("a", question(1));
    world.want("b", question(1));
    world.sent_until(0).await;
    world.asker.forget("a");
    assert!(world.known("a").is_none() && world.waited("a").is_none());
    world.want("a", question(1));
    assert_eq!(world.sent_until(1).await, [sent("a", 1, 1)]);
    assert_eq!(world.woken(), ["b"], "the first answer is for what has been forgotten");
    assert!(world.known("a").is_none());
    world.sent_until(2).await;
    assert_eq!(world.woken(), ["a"]);
}

#[tokio::test(start_paused = true)]
async fn a_question_that_is_not_repeated_is_given_up() {
    let world = World::new();
    let held = Question {
        outcome: Outcome::Held,
        ..question(1)
    };
    world.want("u", held.clone());
    let kept = KEPT.as_secs();
    assert!(!world.sent_until(kept / 2).await.is_empty());
    world.want("u", held);
    assert!(!world.sent_until(kept).await.is_empty(), "it was repeated");
    world.sent_until(2 * kept).await;
    assert!(world.known("u").is_none());
    assert_eq!(world.sent_until(3 * kept).await, []);
}

#[tokio::test(start_paused = true)]
async fn what_a_newer_question_outdates_is_no_answer_also_when_it_is_asked_again() {
    let world = World::new();
    let goes_on = |number| Question {
        outcome: Outcome::GoesOn,
        ..question(number)
    };
    world.want("u", goes_on(2));
    world.sent_until(2).await;
    assert_eq!(world.known("u"), Some((Some(2), 2, 2)));
    world.want("u", goes_on(1));
    assert!(world.known("u").is_none(), "it is dropped at once");
    world.want("u", goes_on(2));
    assert_eq!(world.sent_until(4).await, [sent("u", 2, 2)]);
    // An earlier one that is under way is not taken in either.
    let slow = Question {
        takes: SECOND.mul_f64(1.5),
        ..goes_on(3)
    };
    world.want("u", slow);
    world.sent_until(5).await;
    world.want("u", goes_on(1));
    assert_eq!(world.sent_until(6).await, [sent("u", 1, 5)]);
    assert!(world.known("u").is_none());
    world.sent_until(7).await;
    assert_eq!(world.known("u"), Some((Some(1), 1, 1)));
}

/// A question with a rank, to a service that is asked once a second.
#[derive(Clone, Debug, PartialEq)]
struct Paced(u8);

impl Ask for Paced {
    type Answer = ();
    const AT_ONCE: usize = 9;
    const AT_ONCE_OF_A_SERVICE: usize = 9;
    const LONGEST: Duration = SECOND;
    const SPACING: Duration = SECOND;

    fn service(&self) -> Service {
        question(0).service()
    }

    fn again(&self, _result: &Result<(), Failure>, _failures: u32, _waited: Duration) -> Option<Duration> {
        None
    }

    fn rank(&self) -> Rank {
        (self.0, 0)
    }
}

#[test]
fn the_first_rank_goes_first_and_starts_keep_their_distance() {
    let (mut state, began) = (State::default(), Instant::now());
    for (place, rank) in [1, 1, 0].into_iter().enumerate() {
        let now = began + Duration::from_millis(place as u64);
        state.want(&object(&place.to_string()), Paced(rank), LogSpan::default(), now);
    }
    let mut order = Vec::new();
    for millis in (3..5000).step_by(100) {
        while let Some(work) = state.next(began + Duration::from_millis(millis)) {
            order.push((work.asked.about.uid, millis / 1000));
        }
    }
    assert_eq!(order, [("2".to_owned(), 0), ("0".to_owned(), 1), ("1".to_owned(), 2)]);
}
