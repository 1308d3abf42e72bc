//! Submissions that are newer than the last backup come back from the table, by the commands of docs/availability.md.

use aws_sdk_dynamodb::types::AttributeValue;
use kube::runtime::wait::await_condition;

use super::*;

/// A text that a stranger writes.
const HOSTILE: &str = "a\"}}\n{\"kind\": \"Secret\"}\u{1b}[2J";

/// The table as `aws dynamodb scan --output json` prints it.
async fn scanned(world: &World, table: &str) -> Value {
    let client = world.aws.aws.dynamodb(None, Some(&world.aws.endpoint));
    let rows = client.scan().table_name(table).send().await.unwrap().items.unwrap();
    let typed = |value: AttributeValue| match value {
        AttributeValue::S(text) => json!({ "S": text }),
        AttributeValue::N(number) => json!({ "N": number }),
        other => panic!("{other:?}"),
    };
    let row = |item: std::collections::HashMap<String, AttributeValue>| -> serde_json::Map<String, Value> {
        item.into_iter().map(|(column, value)| (column, typed(value))).collect()
    };
    json!({"Items": rows.into_iter().map(row).collect::<Vec<_>>(), "Count": 0, "ScannedCount": 0})
}

async fn put(world: &World, table: &str, columns: &[(&str, &str)]) {
    let client = world.aws.aws.dynamodb(None, Some(&world.aws.endpoint));
    let mut request = client.put_item().table_name(table);
    for (column, text) in columns {
        let value = match *column {
            "attempt" => AttributeValue::N((*text).to_owned()),
            _ => AttributeValue::S((*text).to_owned()),
        };
        request = request.item(*column, value);
    }
    request.send().await.unwrap();
}

/// Rows of another program's run, of a failed one and of one that is written by a stranger.
async fn put_others(world: &World, [rows, local_rows]: &[String; 2]) {
    for (id, status, more) in [("7001", "RUNNING", &[][..]), ("7002", "FAILED", &[("attempt", "1")])] {
        let row = [
            ("team_id", "1"),
            ("submission_id", id),
            ("submission_status", status),
            ("track_id", "1"),
        ];
        put(world, rows, &[&row[..], more].concat()).await;
    }
    let hostile = [
        ("team_id", "9"),
        ("team_name", HOSTILE),
        ("submission_id", "local-hostile"),
        ("submission_status", "PENDING"),
        ("track_name", "SENSORS"),
        ("submitted_image_uri", "r/agent:1"),
        ("attempt", "1"),
    ];
    put(world, local_rows, &hostile).await;
}

/// The commands of the page for one Leaderboard, whose table `aws` prints from a file.
fn commands(world: &World, board: &str, file: &str) -> String {
    let page = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/availability.md");
    let page = std::fs::read_to_string(page).unwrap();
    let at = page.find("   aws dynamodb scan").unwrap();
    let (lines, _) = page[at..].split_once("```").unwrap();
    let lines = lines
        .replace("--arg board leaderboard-20", &format!("--arg board {board}"))
        .replace("--argjson challenge 2098", "--argjson challenge 1")
        .replace(
            "namespace: \"leaderboard\"",
            &format!("namespace: \"{}\"", world.namespace),
        );
    format!("cd \"$(dirname {file})\"; aws() {{ cat {file}; }}\n{lines}")
}

/// A Leaderboard of EvalAI and a local one, with their tables.
async fn boards(world: &World, tables: &[String; 2]) {
    for table in tables {
        make_table(&world.aws, table).await;
    }
    let spec = |table: &str| json!({"evaluation": {"carla": {"routes": ROUTES}}, "table": {"dynamoDB": {"name": table, "endpoint": world.aws.endpoint}}});
    world.leaderboard_with("lb", 1, "Hosts", &spec(&tables[0])).await;
    let mut local = spec(&tables[1]);
    local["evalai"] = Value::Null;
    local["tracks"] = json!([{"name": "sensors"}]);
    world.leaderboard_with("local", 1, "Hosts", &local).await;
}

/// Waits for the Job of a run's second attempt, which takes up the stored results.
async fn goes_on(world: &World, name: &str) {
    let is_there = |job: Option<&Job>| job.is_some();
    let job = format!("{name}-2");
    let made = await_condition(world.api::<Job>(), &job, is_there);
    let made = tokio::time::timeout(super::super::bridge::LIMIT, made).await;
    made.expect("its second attempt has a Job").unwrap();
    let status = world.api::<Submission>().get(name).await.unwrap().status.unwrap();
    assert!(status.plan.unwrap().resume, "{name} takes up what is stored");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn runs_that_are_newer_than_the_backup_go_on_from_their_rows() {
    let world = World::new().await;
    let tables = ["newer-rows", "newer-local-rows"].map(|name| world.aws.name(name));
    boards(&world, &tables).await;
    let controller = world.controller();
    let (pk, name) = world.submit("lb", 1).await;
    local_submission(&world, LOCAL_RUNNING).await;
    begin(&world, &pk.to_string(), &name).await;
    begin(&world, LOCAL_RUNNING, LOCAL_RUNNING).await;
    drop(controller);
    until_released(&world).await;
    put_others(&world, &tables).await;
    lose::<Submission>(&world).await;
    lose::<Job>(&world).await;
    lose::<Pod>(&world).await;
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("rows.json");
    for (board, table) in ["lb", "local"].into_iter().zip(&tables) {
        std::fs::write(&file, scanned(&world, table).await.to_string()).unwrap();
        shell(&world, &commands(&world, board, &file.display().to_string())).await;
    }
    let made = world
        .api::<Submission>()
        .list(&ListParams::default())
        .await
        .unwrap()
        .items;
    let names: Vec<_> = made.iter().map(ResourceExt::name_any).collect();
    assert_eq!(
        names,
        ["local-hostile", LOCAL_RUNNING, &name],
        "only runs of this operator without an end"
    );
    let team = made[0].spec.team.as_ref().unwrap();
    assert_eq!(team.name.as_deref(), Some(HOSTILE));

    let _controller = world.controller();
    for name in [name.as_str(), LOCAL_RUNNING] {
        goes_on(&world, name).await;
    }
}
