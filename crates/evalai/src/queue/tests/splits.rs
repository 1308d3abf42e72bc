//! Results for the splits of a phase: what is sent of them, and when.

use super::*;
use crate::labels::Catalog;
use crate::queue::payloads::fitted;
use crate::row::Challenge;

fn with_split(split: &str) -> Target {
    Target {
        split: split.into(),
        ..target()
    }
}

/// The results that a request has.
fn results_of(ticket: &Ticket) -> &str {
    match &ticket.request {
        Request::Partial(_, payload) | Request::Final(_, _, payload) => &payload.result,
        other => panic!("{} has no results", other.name()),
    }
}

impl Bench {
    /// An update of submission 7, whose Leaderboard is this one.
    fn update_of(&mut self, board: &Target, update: DesiredUpdate) {
        let now = self.now();
        let subject = Subject {
            target: Arc::new(board.clone()),
            ..of(7, 1)
        };
        self.queue.update(&subject, update, now);
    }

    fn becomes(&mut self, leaderboard: &Key, board: &Target) {
        let now = self.now();
        self.queue.serve(leaderboard, board, now);
    }
}

#[test]
fn results_are_sent_for_the_split_of_their_leaderboard() {
    let (mut bench, val) = (Bench::new(), with_split("val"));
    bench.running(7);
    bench.update_of(&val, DesiredUpdate::Partial(results(41.0)));
    let sent = bench.read_and_write(7, "partial");
    assert!(results_of(&sent).contains(r#""split":"val""#), "{sent:?}");
    bench.update_of(&val, DesiredUpdate::Partial(results(41.0)));
    bench.wait(5.0);
    bench.expect_nothing();
    bench.update_of(&val, DesiredUpdate::Final(Outcome::Finished, results(43.0)));
    let sent = bench.read_and_write(7, "finished");
    assert!(results_of(&sent).contains(r#""split":"val""#), "{sent:?}");
    assert!(matches!(bench.view(7).end, Some(Ended::Published { .. })));
}

#[test]
fn a_result_that_was_refused_for_its_split_is_sent_once_its_leaderboard_names_another() {
    let mut bench = Bench::new();
    bench.running(7);
    bench.update_of(
        &with_split("vall"),
        DesiredUpdate::Final(Outcome::Finished, results(43.0)),
    );
    bench.get(7, row(7, Status::Running));
    let put = bench.expect("finished 7");
    bench.answer(&put, Reply::Written(Answer::Refused(refusal(About::Request, 400))));
    bench.wait(5.0);
    let other = Target {
        phases: [2].into(),
        ..with_split("val")
    };
    bench.becomes(&key(90), &other);
    bench.list("sweep of submitted", vec![]);
    bench.becomes(&key(100), &with_split("val"));
    let sent = bench.read_and_write(7, "finished");
    assert!(results_of(&sent).contains(r#""split":"val""#), "{sent:?}");
    assert!(matches!(bench.view(7).end, Some(Ended::Published { .. })));
}

#[test]
fn a_result_without_a_metric_is_sent_once_its_leaderboard_wants_it_no_more() {
    let mut bench = Bench::new();
    bench.running(7);
    let wants_more = Target {
        metrics: Metrics::Fixed(["Driving score".to_owned(), "Agent blocked".to_owned()].into()),
        ..target()
    };
    bench.update_of(&wants_more, DesiredUpdate::Final(Outcome::Finished, results(43.0)));
    bench.get(7, row(7, Status::Running));
    assert!(matches!(bench.view(7).end, Some(Ended::Refused(why)) if why.contains("lacks the metrics Agent blocked")));
    bench.wait(5.0);
    bench.expect_nothing();
    bench.becomes(&key(100), &target());
    bench.read_and_write(7, "finished");
    assert!(matches!(bench.view(7).end, Some(Ended::Published { .. })));
}

/// A Leaderboard whose labels are those that EvalAI lists, and which has the score in this split.
fn takes_what_is_listed(split: Option<&str>) -> Target {
    Target {
        metrics: Metrics::Listed(Arc::new([(1, split.map(str::to_owned))].into())),
        ..target()
    }
}

impl Bench {
    /// The next request that is no list, which has to be this one, within two minutes. Each list is empty.
    fn after_lists(&mut self, name: &str) -> Ticket {
        for _ in 0..120 {
            match self.next() {
                Some((found, ticket)) if found == name => return ticket,
                Some((found, ticket)) => {
                    assert!(found.contains("list") || found.contains("sweep"), "{found}");
                    self.answer(&ticket, Reply::Rows(Answer::Done(vec![])));
                }
                None => self.wait(1.0),
            }
        }
        panic!("{name} is not sent")
    }

    /// The check of the challenge, whose phase has leaderboards with these codenames and labels.
    fn checked(&mut self, listed: &[(&str, &[&str])]) {
        let phase = Phase {
            id: 1,
            shows_partial: false,
        };
        let splits = (1..).zip(listed).map(|(id, (_, labels))| split(id, labels));
        let codename = |codename: &&str| DatasetSplit {
            codename: (*codename).to_owned(),
        };
        let codenames = listed.iter().map(|(name, _)| Answer::Done(codename(name)));
        let lists = [
            ("phases", Reply::Phases(Answer::Done(vec![phase]))),
            ("splits", Reply::Splits(Answer::Done(splits.collect()))),
        ];
        let codenames = codenames.map(|codename| ("dataset split", Reply::DatasetSplit(codename)));
        for (name, reply) in lists.into_iter().chain(codenames) {
            // The budget of the token: a request a second.
            self.wait(2.0);
            let ticket = self.expect(name);
            self.answer(&ticket, reply);
        }
    }

    /// What is to be read of submission 7 next, within a minute. Each list is empty.
    fn wanted_payload(&mut self) -> Arc<Outline> {
        for _ in 0..60 {
            let now = self.now();
            match self.queue.next(now, true) {
                Next::Read(of, outline) => {
                    assert_eq!(of, key(7));
                    return outline;
                }
                Next::Send(ticket) => {
                    assert!(matches!(ticket.request, Request::List { .. }), "{ticket:?}");
                    self.answer(&ticket, Reply::Rows(Answer::Done(vec![])));
                }
                Next::Wait(_) => self.wait(1.0),
            }
        }
        panic!("no payload is read")
    }
}

/// A leaderboard of phase 1.
fn split(id: i64, labels: &[&str]) -> Split {
    Split {
        id,
        phase: 1,
        dataset_split: id,
        schema: Schema {
            labels: labels.iter().map(|label| (*label).to_owned()).collect(),
            default_order_by: None,
            metadata: serde_json::Value::Null,
        },
    }
}

#[test]
fn a_result_for_what_evalai_lists_waits_until_that_is_known_and_is_refused_if_it_lacks_something() {
    let (mut bench, board) = (Bench::new(), takes_what_is_listed(None));
    bench.running(7);
    bench.becomes(&key(100), &board);
    bench.update_of(&board, DesiredUpdate::Final(Outcome::Finished, results(43.0)));
    // The end goes first, and what EvalAI lists is not known yet.
    for list in ["sweep of submitted", "sweep of resuming"] {
        bench.list(list, vec![]);
    }
    let waits = |bench: &Bench| (bench.view(7).end, bench.view(7).last_error.is_some());
    assert_eq!(waits(&bench), (None, true), "it is no fault of the results");
    bench.checked(&[("leaderboard", &["Driving score", "Agent blocked"])]);
    let ticket = bench.after_lists("submission 7");
    bench.answer(&ticket, Reply::Row(Answer::Done(row(7, Status::Running))));
    let refused = "the split leaderboard of the results lacks the metrics Agent blocked";
    assert_eq!(bench.view(7).end, Some(Ended::Refused(refused.into())));
}

#[test]
fn an_end_without_results_needs_no_label_of_evalais() {
    let (mut bench, board) = (Bench::new(), takes_what_is_listed(None));
    bench.running(7);
    bench.update_of(&board, DesiredUpdate::Final(Outcome::Failed, results(43.0)));
    bench.read_and_write(7, "failed");
    assert!(matches!(bench.view(7).end, Some(Ended::Published { .. })));
}

const DEV: &str = r#"{"split":"dev","show_to_participant":true,"accuracies":{"accuracy":0.50,"loss":1e2}}"#;
const TEST: &str = r#"{"split":"test","show_to_participant":false,"accuracies":{"accuracy":0.1}}"#;

#[test]
fn results_are_sent_as_evalai_lists_the_splits_and_their_labels() {
    let (mut bench, board) = (Bench::new(), takes_what_is_listed(Some("dev")));
    bench.running(7);
    bench.becomes(&key(100), &board);
    for list in ["sweep of submitted", "sweep of resuming"] {
        bench.list(list, vec![]);
    }
    bench.checked(&[("test", &["accuracy"]), ("dev", &["accuracy"])]);
    bench.update_of(&board, DesiredUpdate::Final(Outcome::Finished, results(43.0)));
    let outline = bench.wanted_payload();
    let stored = Payload {
        result: format!("[{DEV},{TEST}]"),
        ..Payload::bare(&outline)
    };
    bench.found(7, Ok(stored));
    let get = bench.after_lists("submission 7");
    bench.answer(&get, Reply::Row(Answer::Done(row(7, Status::Running))));
    let put = bench.after_lists("finished 7");
    let dev = DEV.replace(r#","loss":1e2"#, "");
    assert_eq!(results_of(&put), format!("[{TEST},{dev}]"));
    bench.answer(&put, Reply::Written(Answer::Done(())));
    assert!(matches!(bench.view(7).end, Some(Ended::Published { .. })));
}

#[test]
fn texts_without_results_so_far_are_sent_whatever_evalai_lists() {
    let (mut bench, board) = (Bench::new(), takes_what_is_listed(None));
    bench.running(7);
    bench.update_of(&board, DesiredUpdate::Partial(results(41.0)));
    let outline = bench.wanted_payload();
    bench.found(7, Ok(Payload::bare(&outline)));
    let put = bench.read_and_write(7, "partial");
    assert_eq!(results_of(&put), "[]");
    assert_eq!((bench.view(7).partial_done, bench.view(7).last_error), (Some(41), None));
}

#[test]
fn results_fit_the_splits_of_their_leaderboard_or_are_not_sent() {
    let catalog = |names: [Option<&str>; 2]| Catalog {
        at: wall(0),
        phases: vec![],
        splits: vec![split(1, &["accuracy"]), split(2, &["loss", "accuracy"])],
        codenames: [(1, names[0]), (2, names[1])]
            .map(|(id, name)| (id, name.map(str::to_owned)))
            .into(),
        descending: BTreeMap::new(),
        settings: Challenge::default(),
    };
    let (of_evalai, fixed) = (takes_what_is_listed(None), with_split("val"));
    let (known, unnamed) = (catalog([Some("test"), Some("dev")]), catalog([Some("test"), None]));
    let (known, unnamed) = (Some(&known), Some(&unnamed));
    let own = DEV.replace(r#""accuracy":0.50,"loss":1e2"#, r#""loss":1e2,"accuracy":0.50"#);
    let (both, in_order, dev) = (format!("[{DEV},{TEST}]"), format!("[{TEST},{own}]"), format!("[{DEV}]"));
    let (both, in_order, dev) = (both.as_str(), in_order.as_str(), dev.as_str());
    let score = r#"[{"split":"leaderboard","accuracies":{"Driving score":1.50}}]"#;
    let of_val = r#"[{"split":"val","show_to_participant":false,"accuracies":{"Driving score":1.50}}]"#;
    for (target, catalog, result, is_partial, expected) in [
        (&of_evalai, known, both, false, Some(Ok(in_order))),
        (&of_evalai, known, both, true, Some(Ok(in_order))),
        (&of_evalai, known, dev, false, Some(Err("lack the split test"))),
        (&of_evalai, known, dev, true, Some(Err("lack the split test"))),
        (&of_evalai, unnamed, both, false, Some(Err("not the codename of each"))),
        (&of_evalai, None, both, false, None),
        (&of_evalai, None, both, true, None),
        (&of_evalai, None, "[]", true, Some(Ok("[]"))),
        (&of_evalai, unnamed, "[]", true, Some(Ok("[]"))),
        (&of_evalai, known, "[]", true, Some(Ok("[]"))),
        (&of_evalai, known, "[]", false, Some(Err("lack the split test"))),
        (&of_evalai, None, "[]", false, None),
        (&fixed, None, score, false, Some(Ok(of_val))),
        (&fixed, None, score, true, Some(Ok(of_val))),
        (&fixed, None, "[]", true, Some(Err("for 0 splits"))),
        (&fixed, None, "[]", false, Some(Err("for 0 splits"))),
    ] {
        let payload = Payload {
            result: result.to_owned(),
            stdout: "a summary".to_owned(),
            ..Payload::default()
        };
        let found = fitted(payload, target, 1, catalog, is_partial);
        let what = format!("{result} {is_partial}: {found:?}");
        let keeps_texts = |(payload, _): &(Payload, _)| payload.stdout == "a summary";
        assert!(found.as_ref().is_none_or(keeps_texts), "{what}");
        match (found, expected) {
            (None, None) => {}
            (Some((payload, None)), Some(Ok(sent))) => assert_eq!(payload.result, sent),
            (Some((_, Some(why))), Some(Err(part))) => assert!(why.contains(part), "{what}"),
            _ => panic!("{what}"),
        }
    }
}
