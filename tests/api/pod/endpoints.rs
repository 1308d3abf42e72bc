//! The Pod's programs where their environment names another AWS than the Leaderboard does.

use leaderboard_contract::run::{ENV_POD_UID, ENV_RUN, LOGS, RUNNER_IN_IMAGE, TOOLS};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

use super::super::endpoints::Elsewhere;
use super::*;

#[tokio::test]
async fn objects_and_lines_go_where_the_leaderboard_sends_them() {
    let (mut pod, elsewhere) = (Pod::new().await, Elsewhere::start().await);
    let (endpoint, group) = (server().await.endpoint(), format!("group-{}", fastrand::u64(..)));
    pod.setting.run.plan.storage.s3.endpoint = Some(endpoint.clone());
    let logs = serde_json::json!({"cloudWatch": {"name": group, "endpoint": endpoint}});
    pod.setting.run.logs = serde_json::from_value(logs).unwrap();
    let logs = pod.aws.logs(None, Some(&endpoint));
    logs.create_log_group().log_group_name(&group).send().await.unwrap();

    // A Pod's mounts, below a folder.
    let root = pod.folder.path().join("root");
    let at = |path: &str| root.join(path.trim_start_matches('/'));
    for folder in [LOGS, TOOLS, "/usr/local/bin", "/podinfo", "/dev"] {
        fs::create_dir_all(at(folder)).unwrap();
    }
    fs::write(at(RUNNER_IN_IMAGE), "#!runner").unwrap();
    let run = serde_json::to_string(&pod.setting.run).unwrap();
    let log = |program: &str| pod.folder.path().join(program);
    let program = |name: &str| {
        let mut command = elsewhere.program(&log(name));
        command.arg(name).arg("--root").arg(&root);
        command.env(ENV_RUN, &run).env(ENV_POD_UID, "pod-1");
        command
    };
    let said = |name: &str| fs::read_to_string(log(name)).unwrap();

    let prepared = program("workspace").status().await.unwrap();
    assert!(prepared.success(), "{}", said("workspace"));
    assert_eq!(pod.owner().await, "pod-1");
    let agent = at(LOGS).join("agent/agent1");
    fs::create_dir_all(&agent).unwrap();
    fs::write(agent.join("leaderboard.log"), "a line\n").unwrap();
    let mut logcopy = program("logcopy").spawn().unwrap();
    pod.reported(|report| report.round >= 1).await;
    let id = Pid::from_raw(i32::try_from(logcopy.id().unwrap()).unwrap());
    kill(id, Signal::SIGTERM).unwrap();
    let ended = tokio::time::timeout(PATIENCE, logcopy.wait()).await;
    assert!(ended.unwrap().unwrap().success(), "{}", said("logcopy"));

    assert_eq!(pod.stored("agent/agent1/leaderboard.log").await.unwrap(), b"a line\n");
    let lines = logs
        .get_log_events()
        .log_group_name(&group)
        .log_stream_name("77/agent-1");
    let lines = lines.start_from_head(true).send().await.unwrap();
    let lines: Vec<_> = lines.events().iter().filter_map(|event| event.message()).collect();
    assert_eq!(lines, ["a line"]);
    assert_eq!(elsewhere.asked(), Vec::<String>::new());

    begins_with_its_program(&said("logcopy"));
}

/// The first line of a log shows which program of which version this was.
fn begins_with_its_program(log: &str) {
    let first = log.lines().next().unwrap_or_default();
    let first: serde_json::Value = serde_json::from_str(first).unwrap();
    assert_eq!(
        (&first["message"], &first["program"], &first["version"]),
        (&"starting".into(), &"logcopy".into(), &env!("CARGO_PKG_VERSION").into())
    );
}
