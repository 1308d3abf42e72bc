//! The agent and the simulator as processes: what their files and exit codes are in each case.

use std::{
    fs,
    os::unix::{fs::PermissionsExt, process::ExitStatusExt},
    path::Path,
    process::Command,
};

use crate::support::{Agent, Folder, contents, simulator};
use serde_json::{Value, json};

fn agent(folder: &Folder, port: u16) -> Agent<'_> {
    Agent {
        folder,
        port,
        subset: "0-4",
        resume: "",
        knobs: "",
        v1: false,
    }
}

/// The text of an undisturbed run's file.
fn undisturbed(subset: &str, v1: bool) -> String {
    let folder = Folder::new();
    let carla = simulator(&folder, "");
    assert!(
        Agent {
            subset,
            v1,
            ..agent(&folder, carla.port)
        }
        .run()
        .success()
    );
    folder.read("agent_results.json")
}

/// To the byte; 1.0 counts each route of an earlier process as failed in its global record.
fn assert_same(found: &str, undisturbed: &str, v1: bool) {
    if !v1 {
        assert_eq!(found, undisturbed);
        return;
    }
    let but_that = |text: &str| {
        let mut file: Value = serde_json::from_str(text).unwrap();
        let global = file["_checkpoint"]["global_record"].as_object_mut().unwrap();
        global.remove("status");
        global["meta"].as_object_mut().unwrap().remove("exceptions");
        file
    };
    assert_eq!(but_that(found), but_that(undisturbed));
}

fn state(checkpoint: &Value) -> (&Value, &Value, usize, bool) {
    let routes = &checkpoint["_checkpoint"];
    let global = routes["global_record"].as_object().unwrap();
    let records = routes["records"].as_array().unwrap().len();
    (
        &checkpoint["entry_status"],
        &routes["progress"],
        records,
        !global.is_empty(),
    )
}

#[test]
fn five_routes_are_driven_and_recorded() {
    let text = undisturbed("0-4", false);
    let checkpoint: Value = serde_json::from_str(&text).unwrap();
    assert_eq!(state(&checkpoint), (&json!("Finished"), &json!([5, 5]), 5, true));
    let global = &checkpoint["_checkpoint"]["global_record"];
    // 100, 70, 60, 100 and 42 points; 1 + 1.2 + 0.9 + 1.5 + 1.2 = 5.8 km.
    assert_eq!(
        global["scores_mean"],
        json!({"score_composed": 74.4, "score_route": 92.0, "score_penalty": 0.8})
    );
    assert_eq!(global["infractions"]["red_light"], json!(0.172));
    assert_eq!(
        global["meta"]["exceptions"],
        json!([["RouteScenario_4_rep0", 4, "Failed - Agent timed out"]])
    );
    assert_eq!(checkpoint["values"][0], "74.4");
    assert_eq!(
        (checkpoint["values"].as_array().unwrap().len(), &checkpoint["eligible"]),
        (15, &json!(true))
    );
    assert_eq!(
        checkpoint["_checkpoint"]["records"][0]["scores"]["score_route"],
        json!(100)
    );
    let at = |key: &str| text.find(&format!("\"{key}\"")).unwrap();
    let keys = [
        "_checkpoint",
        "global_record",
        "progress",
        "records",
        "entry_status",
        "eligible",
        "sensors",
        "values",
    ];
    assert!(keys.windows(2).all(|pair| at(pair[0]) < at(pair[1])), "insertion order");
    assert!(text.ends_with("\n    ]\n}"));
}

#[test]
fn an_empty_subset_runs_everything_and_the_expected_result_is_its_own() {
    let checkpoint: Value = serde_json::from_str(&undisturbed("", false)).unwrap();
    let expected: Value = serde_json::from_str(include_str!("../../expected.json")).unwrap();
    let global = &checkpoint["_checkpoint"]["global_record"];
    assert_eq!(
        state(&checkpoint),
        (&expected["entry_status"], &json!([20, 20]), 20, true)
    );
    for part in ["status", "scores_mean", "scores_std_dev", "infractions", "meta"] {
        assert_eq!(global[part], expected["global_record"][part], "{part}");
    }
    assert_eq!(checkpoint["values"], expected["values"]);
}

#[test]
fn a_killed_run_resumes_to_the_same_file() {
    for v1 in [false, true] {
        let folder = Folder::new();
        let carla = simulator(&folder, "");
        let mut first = Agent {
            v1,
            knobs: "hang@3",
            ..agent(&folder, carla.port)
        }
        .start();
        first.until("Preparing RouteScenario_0");
        for _ in 0..3 {
            first.until("> Running the route");
        }
        first.kill();
        assert_eq!(folder.checkpoint()["_checkpoint"]["progress"][0], 2);
        let mut second = Agent {
            v1,
            resume: "1",
            ..agent(&folder, carla.port)
        }
        .start();
        second.until("> Resuming at route 3 of");
        assert!(second.end().1.success());
        assert_same(&folder.read("agent_results.json"), &undisturbed("0-4", v1), v1);
    }
}

#[test]
fn without_the_flag_a_run_starts_over() {
    let folder = Folder::new();
    let carla = simulator(&folder, "");
    assert!(agent(&folder, carla.port).run().success());
    assert_eq!(
        Agent {
            knobs: "crash@1",
            ..agent(&folder, carla.port)
        }
        .run()
        .signal(),
        Some(6)
    );
    assert_eq!(
        state(&folder.checkpoint()),
        (&json!("Started"), &json!([0, 5]), 0, false)
    );
    // Another slice's file is not taken up either.
    assert!(
        Agent {
            subset: "5-9",
            resume: "0",
            ..agent(&folder, carla.port)
        }
        .run()
        .success()
    );
    assert_eq!(
        folder.checkpoint()["_checkpoint"]["records"][0]["route_id"],
        "RouteScenario_5_rep0"
    );
}

#[test]
fn a_crash_of_the_agent_once_and_always() {
    let folder = Folder::new();
    let carla = simulator(&folder, "");
    for (knobs, expected) in [("crash@3:once", [Some(6), None]), ("crash@4", [Some(6), Some(6)])] {
        for (resume, signal) in ["", "1"].into_iter().zip(expected) {
            assert_eq!(
                Agent {
                    resume,
                    knobs,
                    ..agent(&folder, carla.port)
                }
                .run()
                .signal(),
                signal,
                "{knobs}"
            );
        }
    }
    assert_eq!(
        state(&folder.checkpoint()),
        (&json!("Started"), &json!([3, 5]), 3, false)
    );
}

#[test]
fn a_crash_of_the_simulator_is_recorded_and_repeated() {
    for (v1, progress) in [(false, 3), (true, 2)] {
        let folder = Folder::new();
        let carla = simulator(&folder, "crash@3");
        let status = Agent {
            v1,
            ..agent(&folder, carla.port)
        }
        .run();
        assert_eq!((status.code(), carla.program.end().1.code()), (Some(255), Some(1)));
        let checkpoint = folder.checkpoint();
        let total = if v1 { 10 } else { 5 };
        assert_eq!(
            state(&checkpoint),
            (&json!("Crashed"), &json!([progress, total]), 3, false)
        );
        assert_eq!(
            checkpoint["_checkpoint"]["records"][2]["status"],
            "Failed - Simulation crashed"
        );
        let carla = simulator(&folder, "");
        assert!(
            Agent {
                v1,
                resume: "1",
                ..agent(&folder, carla.port)
            }
            .run()
            .success()
        );
        assert_same(&folder.read("agent_results.json"), &undisturbed("0-4", v1), v1);
    }
}

#[test]
fn v1_sorts_its_keys_and_adds_up_rates() {
    let text = undisturbed("0-4", true);
    let checkpoint: Value = serde_json::from_str(&text).unwrap();
    let mut sorted = checkpoint.clone();
    sorted.sort_all_objects();
    assert_eq!(text.replace([' ', '\n'], ""), sorted.to_string().replace(' ', ""));
    assert_eq!(
        state(&checkpoint),
        (&json!("Finished with agent errors"), &json!([10, 10]), 10, true)
    );
    let global = &checkpoint["_checkpoint"]["global_record"];
    // Two repetitions of one collision on 0.9 km.
    assert_eq!(
        global["infractions"]["collisions_vehicle"],
        json!(1.0 / 0.9 + 1.0 / 0.9)
    );
    assert_eq!(
        (
            &global["infractions"]["yield_emergency_vehicle_infractions"],
            &checkpoint["values"][4]
        ),
        (&Value::Null, &json!("2.222"))
    );
    assert_eq!(checkpoint["_checkpoint"]["records"][1]["route_id"], "RouteScenario_0");
}

#[test]
fn the_expected_v1_result_is_its_own() {
    let folder = Folder::new();
    let carla = simulator(&folder, "");
    let worker = Agent {
        v1: true,
        subset: "",
        ..agent(&folder, carla.port)
    };
    assert!(
        worker
            .command()
            .arg("--repetitions=5")
            .env("ROUTE_MS", "0")
            .output()
            .unwrap()
            .status
            .success()
    );
    let (checkpoint, expected) = (folder.checkpoint(), include_str!("../../expected-v1.json"));
    let expected: Value = serde_json::from_str(expected).unwrap();
    for part in ["entry_status", "eligible", "values"] {
        assert_eq!(checkpoint[part], expected[part], "{part}");
    }
    assert_eq!(checkpoint["_checkpoint"]["progress"], expected["progress"]);
    let (global, metrics) = (&checkpoint["_checkpoint"]["global_record"], &expected["metrics"]);
    for (score, metric) in [
        ("score_composed", "Driving score"),
        ("score_route", "Route completion"),
        ("score_penalty", "Infraction penalty"),
    ] {
        let (own, expected) = (
            global["scores"][score].as_f64().unwrap(),
            metrics[metric].as_f64().unwrap(),
        );
        assert!((own - expected).abs() < 1e-9, "{metric}: {own} {expected}");
    }
}

#[test]
fn no_simulator_no_checkpoint() {
    let folder = Folder::new();
    let carla = simulator(&folder, "hang");
    assert_eq!(agent(&folder, carla.port).run().code(), Some(1));
    assert!(!folder.path("agent_results.json").exists());
}

#[test]
fn refused_sensors_stop_the_run_and_a_restart_refuses_the_next() {
    let folder = Folder::new();
    let carla = simulator(&folder, "");
    assert_eq!(
        Agent {
            knobs: "reject@2",
            ..agent(&folder, carla.port)
        }
        .run()
        .code(),
        Some(255)
    );
    assert_eq!(
        state(&folder.checkpoint()),
        (&json!("Rejected"), &json!([2, 5]), 2, false)
    );
    assert_eq!(
        Agent {
            knobs: "reject@3",
            resume: "1",
            ..agent(&folder, carla.port)
        }
        .run()
        .code(),
        Some(255)
    );
    assert_eq!(
        state(&folder.checkpoint()),
        (&json!("Rejected"), &json!([3, 5]), 3, false)
    );
}

#[test]
fn an_early_end_has_a_global_record_over_too_few_routes() {
    let folder = Folder::new();
    let carla = simulator(&folder, "");
    let early = Agent {
        knobs: "early@2",
        ..agent(&folder, carla.port)
    };
    assert!(early.run().success());
    assert_eq!(
        state(&folder.checkpoint()),
        (&json!("Finished"), &json!([2, 5]), 2, true)
    );
}

#[test]
fn files_an_uploader_must_survive() {
    let run = |knobs: &str| {
        let folder = Folder::new();
        let carla = simulator(&folder, "");
        assert!(
            Agent {
                knobs,
                ..agent(&folder, carla.port)
            }
            .run()
            .success(),
            "{knobs}"
        );
        folder
    };
    let file = |folder: &Folder| fs::symlink_metadata(folder.path("agent_results.json")).unwrap();
    assert!(file(&run("symlink=/etc/hostname")).is_symlink());
    let fifo = file(&run("fifo"));
    assert!(!fifo.is_file() && !fifo.is_dir() && !fifo.is_symlink());
    assert_eq!(file(&run("mode0600")).permissions().mode() & 0o777, 0o600);
    assert_eq!(file(&run("huge@5")).len(), 65 << 20);
    assert!(run("deep@2").read("agent_results.json").starts_with("[[[["));
    assert!(
        run("nan@2")
            .read("agent_results.json")
            .contains("\"score_composed\": NaN")
    );
    assert_eq!(run("nonsense@1").checkpoint()["_checkpoint"]["global_record"], 7);
    let forged = run("forge").checkpoint();
    let record = &forged["_checkpoint"]["records"][1];
    assert_eq!(
        (&record["scores"]["score_composed"], &record["num_infractions"]),
        (&json!(100.0), &json!(1))
    );
}

#[test]
fn the_log_holds_whatever_the_agent_prints() {
    let folder = Folder::new();
    let carla = simulator(&folder, "");
    let (log, _) = Agent {
        knobs: "spam=100000,print-env",
        ..agent(&folder, carla.port)
    }
    .start()
    .end();
    assert!(log.len() > 100_000 && log.contains("AGENT_KNOBS=spam=100000"));
    let (log, status) = Agent {
        knobs: "print-routes",
        ..agent(&folder, carla.port)
    }
    .start()
    .end();
    assert!(log.contains("<route id=\"19\"") && status.signal() == Some(6));
}

#[test]
fn what_the_wiring_must_provide() {
    let folder = Folder::new();
    let carla = simulator(&folder, "");
    let run = |change: &dyn Fn(&mut Command)| {
        let mut command = agent(&folder, carla.port).command();
        change(&mut command);
        let output = command.output().unwrap();
        (output.status.code(), String::from_utf8(output.stderr).unwrap())
    };
    let variable = |name: &str, value: &Path| run(&|command| _ = command.env(name, value));
    let argument = |text: &str| run(&|command| _ = command.arg(text));
    let without_modules = variable("PYTHONPATH", &contents("leaderboard"));
    assert!(without_modules.0 == Some(1) && without_modules.1.contains("No module named 'srunner'"));
    let without_agent = argument("--agent=/nowhere/agent.py");
    assert!(without_agent.0 == Some(1) && without_agent.1.contains("No module named 'agent'"));
    let unknown_knob = variable("AGENT_KNOBS", Path::new("sing"));
    assert!(unknown_knob.0 == Some(2) && unknown_knob.1.contains("there is no knob `sing`"));
    let no_route = argument("--routes-subset=18-22");
    assert!(no_route.0 == Some(1) && no_route.1.contains("Couldn't find the route '22'"));
}
