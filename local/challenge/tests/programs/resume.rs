//! Evaluators that are started again, step by step against the files of real ones. The files of 2.0 are in `contents`. Pair 4's simulation
//! crashes in its last route (`crashed`), and the pair is started again (`resumed`). An evaluator dies before its global record (`last`).
//! All evaluators are started once more on complete files (`done-1` to `done-4`).

use std::{fs, os::unix::process::ExitStatusExt};

use serde_json::{Value, json};

use crate::support::{Agent, Folder, contents, simulator};

/// The routes of the pairs in the real files.
const SUBSETS: [&str; 4] = ["0-3", "4-7", "8-11", "12-15"];

fn real(name: &str) -> String {
    fs::read_to_string(contents(&format!("leaderboard/data/real/{name}.json"))).unwrap()
}

/// An agent that resumes; V1 drives each route twice.
fn resumed(folder: &Folder, port: u16) -> Agent<'_> {
    Agent {
        folder,
        port,
        subset: SUBSETS[3],
        resume: "1",
        knobs: "",
        v1: false,
    }
}

/// A folder with the checkpoint of a real evaluator.
fn folder_with(name: &str) -> Folder {
    let folder = Folder::new();
    fs::write(folder.path("agent_results.json"), real(name)).unwrap();
    folder
}

/// The file without the content of its records, and without what follows from that.
fn shape(mut file: Value) -> Value {
    file["values"] = json!(file["values"].as_array().unwrap().len());
    file["sensors"] = json!(file["sensors"].as_array().unwrap().is_empty());
    let routes = &mut file["_checkpoint"];
    let keys: Vec<String> = routes["global_record"].as_object().unwrap().keys().cloned().collect();
    routes["global_record"] = json!(keys);
    for record in routes["records"].as_array_mut().unwrap() {
        let crashed = record["status"] == "Failed - Simulation crashed";
        *record = json!([record["index"], record["route_id"], crashed]);
    }
    file
}

fn shape_of(name: &str) -> Value {
    shape(serde_json::from_str(&real(name)).unwrap())
}

#[test]
fn a_simulation_that_crashes_in_the_last_route_leaves_what_a_real_one_leaves() {
    let folder = Folder::new();
    let carla = simulator(&folder, "crash@4");
    let first = Agent {
        resume: "",
        ..resumed(&folder, carla.port)
    };
    assert_eq!(first.run().code(), Some(255));
    assert_eq!(shape(folder.checkpoint()), shape_of("crashed"));
    // A world that one process has loaded keeps the next failure from being its last word.
    let folder = Folder::new();
    let carla = simulator(&folder, "");
    let first = Agent {
        resume: "",
        knobs: "no-world@4",
        ..resumed(&folder, carla.port)
    };
    assert_eq!(first.run().code(), Some(255));
    assert_eq!(shape(folder.checkpoint()), shape_of("crashed"));
}

#[test]
fn who_dies_while_it_loads_its_first_world_leaves_its_first_write_however_often() {
    let folder = folder_with("crashed");
    for knobs in ["", "crash-loading@1", ""] {
        let carla = simulator(&folder, knobs);
        let again = Agent {
            knobs: if knobs.is_empty() { "no-world@4" } else { "" },
            ..resumed(&folder, carla.port)
        };
        assert_eq!(again.run().code(), Some(1));
        assert_eq!(folder.read("agent_results.json"), real("resumed"));
    }
    let carla = simulator(&folder, "");
    assert!(resumed(&folder, carla.port).run().success());
    let mut expected = shape_of("done-4");
    expected["sensors"] = json!(false);
    assert_eq!(shape(folder.checkpoint()), expected);
    let mut kept: Value = serde_json::from_str(&real("crashed")).unwrap();
    let found = folder.checkpoint();
    for index in 0..3 {
        let record = kept["_checkpoint"]["records"][index].take();
        assert_eq!(
            found["_checkpoint"]["records"][index], record,
            "route {index} stays as it was"
        );
    }
}

#[test]
fn a_route_that_cannot_be_stopped_has_progress_and_no_record_and_costs_the_one_before() {
    let folder = Folder::new();
    let carla = simulator(&folder, "crash@4");
    let first = Agent {
        resume: "",
        knobs: "no-record@4",
        ..resumed(&folder, carla.port)
    };
    assert_eq!(first.run().code(), Some(255));
    let found = folder.checkpoint();
    let records = found["_checkpoint"]["records"].as_array().unwrap().len();
    assert_eq!(
        (&found["entry_status"], &found["_checkpoint"]["progress"], records),
        (&json!("Started"), &json!([4, 4]), 3)
    );
    let carla = simulator(&folder, "");
    let mut second = resumed(&folder, carla.port).start();
    second.until("> Resuming at route 3 of 4");
    assert!(second.end().1.success());
    let mut expected = shape_of("done-4");
    expected["sensors"] = json!(false);
    assert_eq!(shape(folder.checkpoint()), expected);
}

#[test]
fn a_repeated_route_is_out_of_the_file_while_it_is_driven() {
    let folder = folder_with("crashed");
    let carla = simulator(&folder, "");
    let mut second = Agent {
        knobs: "hang@4",
        ..resumed(&folder, carla.port)
    }
    .start();
    second.until("> Running the route");
    let found = folder.checkpoint();
    let records = found["_checkpoint"]["records"].as_array().unwrap().len();
    assert_eq!((records, &found["_checkpoint"]["progress"]), (3, &json!([3, 4])));
    assert!(!found["sensors"].as_array().unwrap().is_empty());
    second.kill();
}

#[test]
fn who_dies_before_its_global_record_makes_it_without_sensors_when_it_is_started_again() {
    let folder = Folder::new();
    let carla = simulator(&folder, "");
    let first = Agent {
        subset: SUBSETS[0],
        resume: "",
        knobs: "dies-after@4",
        ..resumed(&folder, carla.port)
    };
    assert_eq!(first.run().signal(), Some(6));
    assert_eq!(shape(folder.checkpoint()), shape_of("last"));

    let folder = folder_with("last");
    let again = Agent {
        subset: SUBSETS[0],
        ..resumed(&folder, carla.port)
    };
    assert!(again.run().success());
    assert_eq!(folder.read("agent_results.json"), real("done-1"));
}

#[test]
fn a_complete_file_without_sensors_stays_as_it_is() {
    for (pair, subset) in (1..).zip(SUBSETS) {
        let name = format!("done-{pair}");
        let folder = folder_with(&name);
        let carla = simulator(&folder, "");
        let again = Agent {
            subset,
            ..resumed(&folder, carla.port)
        };
        assert!(again.run().success());
        assert_eq!(folder.read("agent_results.json"), real(&name));
    }
}

#[test]
fn once_more_and_set_ups_that_fail_leave_complete_files_without_sensors() {
    let folder = Folder::new();
    let carla = simulator(&folder, "");
    let once_more = Agent {
        subset: SUBSETS[0],
        resume: "",
        knobs: "once-more",
        ..resumed(&folder, carla.port)
    };
    assert!(once_more.run().success());
    assert_eq!(shape(folder.checkpoint()), shape_of("done-1"));

    let folder = folder_with("crashed");
    let no_setup = Agent {
        knobs: "no-setup@4",
        ..resumed(&folder, carla.port)
    };
    assert!(no_setup.run().success());
    assert_eq!(shape(folder.checkpoint()), shape_of("done-4"));
    let record = folder.checkpoint()["_checkpoint"]["records"][3].take();
    assert_eq!(record["status"], "Failed - Agent couldn't be set up");
}

#[test]
fn a_replayed_file_ends_as_its_evaluator_did() {
    for (name, code) in [("crashed", 255), ("resumed", 1), ("last", 1), ("done-4", 0)] {
        let folder = Folder::new();
        let carla = simulator(&folder, "");
        let knobs = format!("replay=real/{name}.json");
        let replayed = Agent {
            knobs: &knobs,
            resume: "",
            ..resumed(&folder, carla.port)
        };
        assert_eq!(replayed.run().code(), Some(code), "{name}");
        assert_eq!(folder.read("agent_results.json"), real(name));
    }
    // It stands for the first process alone.
    let folder = folder_with("crashed");
    let carla = simulator(&folder, "");
    let again = Agent {
        knobs: "replay=real/last.json,no-world@4",
        ..resumed(&folder, carla.port)
    };
    assert_eq!(again.run().code(), Some(1));
    assert_eq!(folder.read("agent_results.json"), real("resumed"));
}

/// 1.0 edits its file: nothing of it is lost, and nothing is written before something changes.
#[test]
fn leaderboard_10_keeps_its_file_until_something_changes() {
    let folder = Folder::new();
    let carla = simulator(&folder, "crash@3");
    let v1 = |port, knobs, resume| Agent {
        v1: true,
        subset: "0-1",
        knobs,
        resume,
        ..resumed(&folder, port)
    };
    assert_eq!(v1(carla.port, "", "").run().code(), Some(255));
    let crashed = folder.checkpoint();
    let carla = simulator(&folder, "");
    let mut hanging = v1(carla.port, "hang@3", "1").start();
    hanging.until("> Running the route");
    assert_eq!(
        folder.checkpoint(),
        crashed,
        "the route that crashed stays until it is repeated"
    );
    hanging.kill();

    assert_eq!(v1(carla.port, "no-world@3", "1").run().code(), Some(255));
    let found = folder.checkpoint();
    assert_eq!(
        (&found["entry_status"], &found["_checkpoint"]["progress"]),
        (&json!("Crashed"), &json!([2, 4]))
    );

    assert_eq!(v1(carla.port, "dies-after@4", "1").run().signal(), Some(6));
    let last = folder.checkpoint();
    assert_eq!(
        (&last["entry_status"], &last["_checkpoint"]["progress"]),
        (&json!("Started"), &json!([4, 4]))
    );
    assert!(v1(carla.port, "", "1").run().success());
    let complete = folder.checkpoint();
    assert_eq!(
        (&complete["entry_status"], &complete["eligible"]),
        (&json!("Finished"), &json!(true))
    );
    assert_eq!(complete["sensors"], last["sensors"]);
    // It takes no text that it has read for its own `Completed`.
    let global = &complete["_checkpoint"]["global_record"];
    assert_eq!(global["status"], "Failed");
    assert_eq!(global["meta"]["exceptions"].as_array().unwrap().len(), 4);
    assert!(v1(carla.port, "", "1").run().success());
    assert_eq!(folder.checkpoint(), complete, "once more changes nothing");
}

#[test]
fn leaderboard_10_that_finds_nothing_to_resume_has_no_progress_before_its_first_route_ends() {
    let folder = Folder::new();
    let carla = simulator(&folder, "");
    let v1 = Agent {
        v1: true,
        subset: "0-1",
        knobs: "hang@1",
        ..resumed(&folder, carla.port)
    };
    let mut hanging = v1.start();
    hanging.until("> Running the route");
    let found = folder.checkpoint();
    assert_eq!(
        (&found["entry_status"], &found["_checkpoint"]["progress"]),
        (&json!(""), &json!([]))
    );
    hanging.kill();
}

#[test]
fn leaderboard_10_ends_with_0_when_its_run_raises() {
    let folder = Folder::new();
    let carla = simulator(&folder, "");
    let unknown = Agent {
        v1: true,
        subset: "18-22",
        resume: "",
        ..resumed(&folder, carla.port)
    };
    assert!(unknown.run().success());
    assert!(!folder.path("agent_results.json").exists());
}
