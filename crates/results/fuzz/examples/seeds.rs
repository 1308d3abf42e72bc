//! Writes what the corpora began with: the stored cases without their blanks, and files made to be refused.
//!
//! `cargo run --example seeds`, then `cargo fuzz cmin` to keep what adds anything.
#![allow(clippy::unwrap_used, reason = "a tool for people")]

use std::fs;
use std::path::Path;

fn main() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let cases = root.join("../tests/cases");
    let put = |target: &str, name: &str, bytes: &[u8]| {
        let folder = root.join("corpus").join(target);
        fs::create_dir_all(&folder).unwrap();
        fs::write(folder.join(name), bytes).unwrap();
    };
    for format in ["v1", "v2"] {
        for number in 1..=41 {
            let case = format!("{format}/case{number:02}");
            let files: Vec<Vec<u8>> = (1..=4)
                .map(|i| fs::read(cases.join(&case).join(format!("in{i}.json"))).unwrap_or_default())
                .map(|file| without_blanks(&file))
                .collect();
            for (i, file) in files.iter().enumerate() {
                put("checkpoint", &format!("{format}-{number:02}-{i}"), file);
            }
            // Warn, one repetition; every other case as the original.
            let switches = if number % 2 == 0 { b'D' } else { b'E' };
            let merge = [&[switches], files.join(&0).as_slice()].concat();
            put("merge", &format!("{format}-{number:02}"), &merge);
        }
    }
    for (i, text) in hostile().into_iter().enumerate() {
        put("checkpoint", &format!("hostile-{i:02}"), text.as_bytes());
        let merge = format!("D{text}\0{}", file("0", "RouteScenario_1_rep0"));
        put("merge", &format!("hostile-{i:02}"), merge.as_bytes());
    }
}

fn without_blanks(json: &[u8]) -> Vec<u8> {
    let (mut in_text, mut escaped) = (false, false);
    let keep = |byte: &u8| {
        let kept = in_text || !b" \n\r\t".contains(byte);
        if *byte == b'"' && !escaped {
            in_text = !in_text;
        }
        escaped = in_text && *byte == b'\\' && !escaped;
        kept
    };
    json.iter().copied().filter(keep).collect()
}

fn file(score: &str, id: &str) -> String {
    let infractions = [
        "collisions_layout",
        "collisions_pedestrian",
        "collisions_vehicle",
        "red_light",
        "stop_infraction",
    ]
    .into_iter()
    .chain([
        "outside_route_lanes",
        "min_speed_infractions",
        "yield_emergency_vehicle_infractions",
    ])
    .chain(["scenario_timeouts", "route_dev", "vehicle_blocked", "route_timeout"])
    .map(|name| format!("\"{name}\":[]"))
    .collect::<Vec<_>>()
    .join(",");
    format!(
        "{{\"_checkpoint\":{{\"global_record\":{{}},\"progress\":[1,1],\"records\":[{{\"index\":0,\"route_id\":\"{id}\",\
         \"status\":\"Completed\",\"num_infractions\":0,\"infractions\":{{{infractions}}},\"scores\":{{\"score_route\":100,\
         \"score_penalty\":1.0,\"score_composed\":{score}}},\"meta\":{{\"route_length\":12.5,\"duration_game\":1.0,\
         \"duration_system\":2.0}}}}]}},\"entry_status\":\"Crashed\",\"eligible\":false,\"sensors\":[\"carla_gnss\"],\
         \"values\":[],\"labels\":[]}}"
    )
}

fn hostile() -> Vec<String> {
    let mut texts: Vec<String> = [
        "NaN",
        "-Infinity",
        "1e999",
        "1e200",
        "-1",
        "true",
        "\"100\"",
        "null",
        "9007199254740993",
    ]
    .into_iter()
    .map(|score| file(score, "RouteScenario_0_rep0"))
    .collect();
    for id in [
        "RouteScenario_0",
        "RouteScenario_-1_rep0",
        "RouteScenario_99999999999_rep0",
        "<b>_1_rep2",
        "\\ud800_1_rep0",
        "_",
        "",
    ] {
        texts.push(file("100.0", id));
    }
    for (nested, depth) in [("[", 60), ("[", 70), ("{\"a\":", 60), ("{\"a\":", 70)] {
        let close = if nested == "[" { "]" } else { "}" };
        texts.push(format!("{}1{}", nested.repeat(depth), close.repeat(depth)));
    }
    texts.extend(
        [
            "",
            "{",
            "{}",
            "[1]",
            "{\"_checkpoint\":{\"records\":[],\"progress\":[]},\"sensors\":[]}",
            "{\"_checkpoint\":{\"records\":[1],\"progress\":[0,1]},\"sensors\":\"x\"}",
            "{\"_checkpoint\":{\"records\":{},\"progress\":[0,1e0]},\"sensors\":[1]}",
            "{\"_checkpoint\":{\"records\":[],\"progress\":[0,1000001]},\"sensors\":[]}",
            "{\"a\":1,\"a\":2,\"\\u0061\":3}",
            "\u{feff}{}",
            "\"\\ud83d\\ude97\\udc00\"",
        ]
        .map(str::to_owned),
    );
    texts.push("9".repeat(5000));
    texts
}
