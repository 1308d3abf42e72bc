//! The status of a Leaderboard, as tables.

use serde_json::json;

use super::*;
use leaderboard_api::ReasonName;

fn leaderboard(name: &str, second: i64, phase: i64, server: &str, prefix: &str) -> Arc<Leaderboard> {
    let spec = json!({
        "evalai": {"apiServer": server, "challenge": 1, "token": {"secretKeyRef": {"name": "t", "key": "k"}}},
        "tracks": [{"name": "sensors", "phase": phase}],
        "evaluation": {"carla": {
            "version": "V2", "contents": {"image": "c"}, "simulator": {"image": "s"},
        }},
        "storage": {"s3": {"bucket": "bucket", "prefix": prefix}}, "deadlines": {"runSeconds": 86400},
    });
    let mut object = Leaderboard::new(name, serde_json::from_value(spec).unwrap());
    object.metadata.namespace = Some("ns".into());
    object.metadata.uid = Some(name.into());
    object.metadata.creation_timestamp = Some(Time(Timestamp::from_second(second).unwrap()));
    Arc::new(object)
}

fn view(mine: &Arc<Leaderboard>, all: &[Arc<Leaderboard>]) -> LeaderboardView {
    LeaderboardView {
        now: Timestamp::from_second(1000).unwrap(),
        leaderboard: Arc::clone(mine),
        all: all.to_vec(),
        counts: Counts::default(),
        gpu_use: Vec::new(),
        in_use: 0,
        named: None,
        results: None,
        image_note: None,
        pods: 0,
        policy: Policy::InPlace,
        measured: None,
        refusal: None,
        is_looked_at: true,
        invalid_pod: None,
        pod_notes: Vec::new(),
        claims: Claims::NotRequired,
        unreachable: None,
        place_notes: Vec::new(),
        evalai: EvalaiStanding::Fits { note: None },
        evalai_writes_from: None,
        usage: Some(EvalaiUse {
            requests_last_minute: 3,
            requests_per_minute: 54,
            backlog: None,
        }),
        rows_waiting: None,
    }
}

fn reason(plan: &LeaderboardPlan) -> (String, ReasonName) {
    let condition = conditions::get(&plan.status.conditions, conditions::READY).unwrap();
    (condition.status.to_string(), condition.reason.clone())
}

#[test]
fn of_two_with_the_same_phase_the_older_serves() {
    let old = leaderboard("old", 1, 7, "https://e", "a/");
    let new = leaderboard("new", 2, 7, "https://e/", "b/");
    let all = [Arc::clone(&old), Arc::clone(&new)];
    assert_eq!(
        reason(&decide(&view(&old, &all))),
        ("True".into(), Reason::Ready.into())
    );
    assert_eq!(
        reason(&decide(&view(&new, &all))),
        ("False".into(), Reason::PhaseConflict.into())
    );
}

#[test]
fn two_servers_may_not_share_a_prefix() {
    let old = leaderboard("old", 1, 7, "https://one", "a/");
    let new = leaderboard("new", 2, 8, "https://two", "a/");
    let all = [Arc::clone(&old), Arc::clone(&new)];
    assert_eq!(
        reason(&decide(&view(&new, &all))),
        ("False".into(), Reason::PrefixConflict.into())
    );
}

#[test]
fn two_namespaces_may_not_share_a_prefix_with_or_without_evalai() {
    let of = |name, namespace: &str, second, server: Option<&str>, prefix| {
        let mut object = leaderboard(name, second, second, server.unwrap_or("https://e"), prefix)
            .as_ref()
            .clone();
        object.metadata.namespace = Some(namespace.into());
        object.spec.evalai = object.spec.evalai.filter(|_| server.is_some());
        Arc::new(object)
    };
    let one = Some("https://one");
    let conflict = ("False".to_owned(), Reason::PrefixConflict.into());
    let cases = [
        (of("new", "other", 2, one, "a/"), true),
        (of("new", "other", 2, None, "a/"), true),
        (of("new", "other", 2, one, "b/"), false),
        (of("new", "ns", 2, one, "a/"), false),
        (of("new", "ns", 2, None, "a/"), false),
        (of("older", "other", 0, one, "a/"), false),
    ];
    for (mine, expected) in cases {
        let all = [of("old", "ns", 1, one, "a/"), Arc::clone(&mine)];
        let found = reason(&decide(&view(&mine, &all)));
        let (name, namespace) = (mine.name_any(), mine.namespace());
        assert_eq!(found == conflict, expected, "{name} {namespace:?} {found:?}");
    }
}

#[test]
fn it_stays_while_submissions_need_it() {
    let mut one = leaderboard("one", 1, 7, "https://e", "a/").as_ref().clone();
    one.metadata.finalizers = Some(vec![names::FINALIZER_LEADERBOARD.into()]);
    one.metadata.deletion_timestamp = Some(Time(Timestamp::from_second(900).unwrap()));
    let one = Arc::new(one);
    let mut seen = view(&one, &[]);
    seen.in_use = 2;
    let plan = decide(&seen);
    assert_eq!(plan.finalizer, None);
    assert!(conditions::is_true(&plan.status.conditions, conditions::TERMINATING));
    (seen.in_use, seen.pods) = (0, 1);
    let plan = decide(&seen);
    assert_eq!(plan.finalizer, None, "its policy goes with it");
    let shown = conditions::get(&plan.status.conditions, conditions::TERMINATING).unwrap();
    assert!(shown.message.starts_with("1 Pods still run"), "{}", shown.message);
    seen.pods = 0;
    assert_eq!(decide(&seen).finalizer, Some(false));
}

#[test]
fn what_is_surely_wrong_comes_before_what_may_be_wrong() {
    let one = leaderboard("one", 1, 7, "https://e", "a/");
    let unreachable = |truth| {
        Some(Unreachable {
            truth,
            reason: Reason::TableUnreachable,
            message: "It is not there.".into(),
        })
    };
    let fits = || EvalaiStanding::Fits { note: None };
    let missing = || EvalaiStanding::NoToken("x".into());
    let cases = [
        (unreachable(Truth::False), fits(), "False", Reason::TableUnreachable),
        (unreachable(Truth::False), missing(), "False", Reason::TableUnreachable),
        (unreachable(Truth::Unknown), fits(), "Unknown", Reason::TableUnreachable),
        (unreachable(Truth::Unknown), missing(), "False", Reason::TokenMissing),
        (
            unreachable(Truth::Unknown),
            EvalaiStanding::Unchecked(None),
            "Unknown",
            Reason::TableUnreachable,
        ),
        (None, fits(), "True", Reason::Ready),
    ];
    for (unreachable, evalai, status, expected) in cases {
        let seen = LeaderboardView {
            unreachable,
            evalai,
            ..view(&one, &[])
        };
        assert_eq!(reason(&decide(&seen)), (status.to_owned(), expected.into()), "{seen:?}");
        let broken = LeaderboardView {
            invalid_pod: Some("no".into()),
            ..seen
        };
        assert_eq!(
            reason(&decide(&broken)),
            ("False".to_owned(), Reason::InvalidPod.into())
        );
    }
}

#[test]
fn no_leaderboard_is_ready_whose_claims_cannot_be_made() {
    let one = leaderboard("one", 1, 7, "https://e", "a/");
    for (claims, expected, begin) in [
        (
            Claims::NotServed,
            Reason::ClaimsNotServed,
            "gpu.mode is Claim, and the API server does not serve",
        ),
        (
            Claims::Missing("No template.".into()),
            Reason::ClaimTemplateMissing,
            "No template.",
        ),
    ] {
        let seen = LeaderboardView {
            claims,
            ..view(&one, &[])
        };
        let plan = decide(&seen);
        assert_eq!(reason(&plan), ("False".to_owned(), expected.into()));
        let ready = conditions::get(&plan.status.conditions, conditions::READY).unwrap();
        assert!(ready.message.starts_with(begin), "{}", ready.message);
    }
    for claims in [Claims::NotRequired, Claims::InPlace] {
        let seen = LeaderboardView {
            claims,
            evalai: EvalaiStanding::NotRequired,
            ..view(&one, &[])
        };
        assert_eq!(reason(&decide(&seen)).0, "True");
    }
}

#[test]
fn a_leaderboard_shows_until_when_nothing_is_written_to_evalai() {
    let one = leaderboard("one", 1, 7, "https://e", "a/");
    let note = || Some("EvalAI's token ends on 2026-12-01.".to_owned());
    for (evalai, ready, message) in [
        (
            EvalaiStanding::Fits { note: None },
            "True",
            "Nothing is written to EvalAI before 00:17:55 UTC: the previous controller did not confirm its last requests, and \
             they may still be running. Nothing to do.",
        ),
        (
            EvalaiStanding::Fits { note: note() },
            "True",
            "EvalAI's token ends on 2026-12-01. Nothing is written to EvalAI before 00:17:55 UTC: the previous controller did \
             not confirm its last requests, and they may still be running. Nothing to do.",
        ),
        (EvalaiStanding::NoToken("x".into()), "False", "x"),
    ] {
        let seen = LeaderboardView {
            evalai,
            evalai_writes_from: Timestamp::from_second(1075).ok(),
            ..view(&one, &[])
        };
        let plan = decide(&seen);
        let condition = conditions::get(&plan.status.conditions, conditions::READY).unwrap();
        assert_eq!(
            (condition.status.as_str(), condition.message.as_str()),
            (ready, message)
        );
    }
}

#[test]
fn rows_that_wait_for_the_table_are_shown_while_there_are_some() {
    let one = leaderboard("one", 1, 7, "https://e", "a/");
    let seen = |rows_waiting| {
        let view = LeaderboardView {
            rows_waiting,
            ..view(&one, &[])
        };
        decide(&view).status.table
    };
    assert_eq!(seen(Some(187)), Some(TableUse { waiting: 187 }));
    assert_eq!((seen(Some(0)), seen(None)), (None, None));
}

#[test]
fn a_leaderboard_whose_runs_have_no_time_limit_shows_it() {
    let mut one = leaderboard("one", 1, 7, "https://e", "a/");
    let spec = &mut Arc::make_mut(&mut one).spec;
    spec.deadlines.run_seconds = None;
    let plan = decide(&view(&one, &[]));
    let ready = conditions::get(&plan.status.conditions, conditions::READY).unwrap();
    assert_eq!(
        ready.message,
        "Runs of the track sensors have no time limit: an agent that does not end keeps its nodes until it is cancelled; \
         set deadlines.runSeconds."
    );
    let evaluation = json!({"container": {"mode": "Predictions", "image": "e", "command": ["e"]}});
    let mut files = one.as_ref().clone();
    files.spec.evaluation = serde_json::from_value(evaluation).unwrap();
    let plan = decide(&view(&Arc::new(files), &[]));
    let ready = conditions::get(&plan.status.conditions, conditions::READY).unwrap();
    assert!(
        ready.message.contains("an evaluator that does not end"),
        "{}",
        ready.message
    );
    Arc::make_mut(&mut one).spec.tracks[0].deadlines = Some(leaderboard_api::TrackDeadlines {
        run_seconds: Some(7200),
        ..Default::default()
    });
    let plan = decide(&view(&one, &[]));
    assert_eq!(
        conditions::get(&plan.status.conditions, conditions::READY)
            .unwrap()
            .message,
        ""
    );
}

#[test]
fn a_leaderboard_that_is_ready_shows_what_its_pods_give_to_strangers() {
    let one = leaderboard("one", 1, 7, "https://e", "a/");
    let pod_notes = vec!["Unbounded: x.".to_owned(), "Agents can read Secret y.".to_owned()];
    for (evalai, truth, message) in [
        (
            EvalaiStanding::NotRequired,
            "True",
            "Images of 2 teams. Unbounded: x. Agents can read Secret y. Log group z.",
        ),
        (EvalaiStanding::NoToken("No token.".into()), "False", "No token."),
    ] {
        let seen = LeaderboardView {
            evalai,
            image_note: Some("Images of 2 teams.".to_owned()),
            pod_notes: pod_notes.clone(),
            place_notes: vec!["Log group z.".to_owned()],
            ..view(&one, &[])
        };
        let plan = decide(&seen);
        let ready = conditions::get(&plan.status.conditions, conditions::READY).unwrap();
        assert_eq!((ready.status.as_str(), ready.message.as_str()), (truth, message));
    }
}

#[test]
fn a_policy_that_is_not_in_place_is_why_nothing_can_run() {
    let one = leaderboard("one", 1, 7, "https://e", "a/");
    for (policy, ready, isolated) in [
        (Policy::InPlace, Reason::Ready, Reason::NotMeasured),
        (Policy::External, Reason::Ready, Reason::External),
        (Policy::Refused("No.".into()), Reason::NotIsolated, Reason::Forbidden),
        (
            Policy::NotApplied("No.".into()),
            Reason::NotIsolated,
            Reason::NotApplied,
        ),
    ] {
        let seen = LeaderboardView {
            policy,
            ..view(&one, &[])
        };
        let plan = decide(&seen);
        assert_eq!(reason(&plan).1, ready);
        let shown = conditions::get(&plan.status.conditions, conditions::ISOLATED).unwrap();
        assert_eq!(shown.reason, isolated);
    }
}

#[test]
fn what_is_wrong_with_evalai_is_shown() {
    let one = leaderboard("one", 1, 7, "https://e", "a/");
    let unread = |is_refused| EvalaiStanding::QueueUnread {
        is_refused,
        why: "x".into(),
    };
    let cases = [
        (EvalaiStanding::NoToken("x".into()), "False", Reason::TokenMissing),
        (EvalaiStanding::TokenRefused("x".into()), "False", Reason::TokenRefused),
        (EvalaiStanding::Misfit("x".into()), "False", Reason::LabelsDiffer),
        (unread(true), "False", Reason::QueueUnreachable),
        (unread(false), "Unknown", Reason::QueueUnreachable),
        (EvalaiStanding::Unchecked(None), "Unknown", Reason::AskingEvalAI),
        (EvalaiStanding::NotRequired, "True", Reason::Ready),
    ];
    for (evalai, status, expected) in cases {
        let seen = LeaderboardView {
            evalai,
            ..view(&one, &[])
        };
        assert_eq!(reason(&decide(&seen)), (status.to_owned(), expected.into()));
    }
}

#[test]
fn what_it_may_not_name_comes_before_what_else_is_wrong() {
    let one = leaderboard("one", 1, 7, "https://e", "a/");
    let mut seen = view(&one, &[]);
    seen.refusal = Some(Refusal {
        reason: Reason::NotAllowed,
        message: "no".into(),
    });
    seen.invalid_pod = Some("no Pod".into());
    assert_eq!(reason(&decide(&seen)), ("False".into(), Reason::NotAllowed.into()));
}

#[test]
fn before_the_first_look_only_what_is_surely_wrong_is_shown() {
    let mut one = leaderboard("one", 1, 7, "https://e", "a/").as_ref().clone();
    one.metadata.generation = Some(2);
    let unseen = |one: &Leaderboard| LeaderboardView {
        is_looked_at: false,
        evalai: EvalaiStanding::Unchecked(None),
        ..view(&Arc::new(one.clone()), &[])
    };
    let plan = decide(&unseen(&one));
    assert_eq!(reason(&plan), ("Unknown".into(), Reason::Checking.into()));
    assert_eq!(plan.status.observed_generation, None);

    let conditions = &mut one.status.get_or_insert_default().conditions;
    let now = Time(Timestamp::UNIX_EPOCH);
    conditions::set(
        conditions,
        conditions::READY,
        Truth::True,
        Reason::Ready,
        "As before.",
        Some(1),
        &now,
    );
    let before = conditions::get(conditions, conditions::READY).cloned();
    let mut seen = unseen(&one);
    let plan = decide(&seen);
    assert_eq!(
        conditions::get(&plan.status.conditions, conditions::READY).cloned(),
        before
    );
    seen.policy = Policy::NotApplied("No.".into());
    assert_eq!(reason(&decide(&seen)), ("False".into(), Reason::NotIsolated.into()));
    seen.is_looked_at = true;
    assert_eq!(decide(&seen).status.observed_generation, Some(2));
}

#[test]
fn a_track_shows_the_numbers_and_the_ranking_of_its_kind_of_evaluation() {
    let carla = leaderboard("carla", 1, 7, "https://a", "");
    let mut container = Leaderboard::clone(&carla);
    container.spec.evaluation = serde_json::from_value(json!({"container": {
        "mode": "Interactive", "image": "e", "command": ["/e"], "workers": 3,
    }}))
    .unwrap();
    let score = json!({"split": "test", "metric": "error", "order": "Ascending"});
    let own = json!({"workers": 2, "score": score});
    container.spec.tracks[0].container = Some(serde_json::from_value(own).unwrap());
    let shown = |board: Leaderboard| {
        let board = Arc::new(board);
        let mut tracks = decide(&view(&board, &[])).status.tracks;
        serde_json::to_value(tracks.remove(0)).unwrap()
    };
    let track = shown(Leaderboard::clone(&carla));
    assert_eq!(track["carla"], json!({"pairs": 4, "routes": 20, "repetitions": 1}));
    assert_eq!(track.get("container"), None);
    let track = shown(container);
    assert_eq!(
        (track.get("carla"), &track["container"]),
        (None, &json!({"workers": 2}))
    );
    assert_eq!(track["ranking"], json!({"metric": "test_error", "order": "Ascending"}));
}
