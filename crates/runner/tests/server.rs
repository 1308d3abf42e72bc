//! Findings of a simulator's runner about its server by the network: whose listener has its ports, whether it hangs, and how many
//! connections it had.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on fails")]

mod support;

use std::io::Read;
use std::net::{TcpListener, TcpStream};
use std::process::{Command, Stdio};

use leaderboard_protocol::files::{Mark, Member, Pair, StatusFile};
use leaderboard_protocol::verdict::What;
use support::{Pod, SIMULATOR};

#[test]
fn a_listener_of_another_container_is_no_readiness() {
    let pod = Pod::new();
    let _other = TcpListener::bind(("127.0.0.1", pod.port)).unwrap();
    let options = ["--ready-seconds=1", "--peer-seconds=0"];
    let mut simulator = pod.simulator_running(&["sleep", "1000"], &options);
    assert_eq!(simulator.code(), 1);
    assert_eq!(simulator.verdict().what, What::NotReady, "no agent has begun yet");
    assert_eq!(pod.files(SIMULATOR), ["simulator-1.crash0"]);
    let expected = format!("a process of another container has port {}", pod.port);
    assert_eq!(
        simulator.stderr().matches(&expected).count(),
        1,
        "{}",
        simulator.stderr()
    );
}

#[test]
fn a_port_that_another_container_has_taken_is_reported() {
    let pod = Pod::new();
    agents_may_run(&pod);
    let _other = TcpListener::bind(("127.0.0.1", pod.port)).unwrap();
    let (server, port) = (pod.path("server.py"), pod.port.to_string());
    let server = ["python3", server.to_str().unwrap(), &port];
    let mut simulator = pod.simulator_running(&server, &["--peer-seconds=0"]);
    assert_eq!(simulator.code(), 1);
    let verdict = simulator.verdict();
    assert_eq!((verdict.what, verdict.exit_code), (What::PortTaken, Some(1)));
    assert_eq!(pod.files(SIMULATOR), ["simulator-1.crash0"]);
}

/// Another simulator of the Pod is ready, so that its agent may run.
fn agents_may_run(pod: &Pod) {
    let other = Member {
        pair: Pair::new(2).unwrap(),
        ..SIMULATOR
    };
    pod.write(StatusFile::Of(other, Mark::Start(0)));
}

fn not_ready_while_agents_run(pod: &Pod) -> support::Container {
    agents_may_run(pod);
    pod.simulator_running(&["sleep", "1000"], &["--ready-seconds=1", "--peer-seconds=0"])
}

#[test]
fn a_port_behind_the_servers_own_that_another_container_has_taken_is_reported() {
    let pod = Pod::new();
    let next = pod.port + 1;
    let _other = TcpListener::bind(("127.0.0.1", next)).unwrap();
    agents_may_run(&pod);
    let mut simulator = pod.simulator_running(&["sh", "-c", "exit 1"], &["--peer-seconds=0"]);
    assert_eq!(simulator.code(), 1);
    let verdict = simulator.verdict();
    assert_eq!((verdict.what, verdict.exit_code), (What::PortTaken, Some(1)));
    let expected = format!("another process of the Pod has port {next}, which the server needs");
    assert_eq!(verdict.why, expected);
}

/// No table of the kernel shows such a socket.
#[test]
fn a_port_that_another_container_has_without_listening_is_reported_when_the_server_is_not_ready() {
    let holds = "import socket, sys
held = socket.socket()
held.bind(('0.0.0.0', int(sys.argv[1])))
print('held', flush=True)
sys.stdin.read()";
    // A port that was used a moment ago can be listened on, and not held like this.
    let held = (0..20).find_map(|_| {
        let pod = Pod::new();
        let mut holder = Command::new("python3")
            .args(["-c", holds, &pod.port.to_string()])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let is_held = holder.stdout.as_mut().unwrap().read_exact(&mut [0; 5]).is_ok();
        if !is_held {
            holder.wait().unwrap();
        }
        is_held.then_some((pod, holder))
    });
    let (pod, mut holder) = held.expect("one of the ports can be held");
    let mut simulator = not_ready_while_agents_run(&pod);
    assert_eq!(simulator.code(), 1);
    let found = simulator.verdict().what;
    drop(holder.stdin.take());
    holder.wait().unwrap();
    assert_eq!(found, What::PortTaken);
}

#[test]
fn a_server_that_is_not_ready_and_whose_ports_are_free_has_failed_by_itself() {
    let pod = Pod::new();
    let mut simulator = not_ready_while_agents_run(&pod);
    assert_eq!(simulator.code(), 1);
    assert_eq!(simulator.verdict().what, What::NotReady);
}

#[test]
fn connections_that_exhaust_a_server_are_named_at_its_end() {
    let pod = Pod::new();
    let accepts = "import socket, sys
server = socket.socket()
server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
server.bind(('127.0.0.1', int(sys.argv[1])))
server.listen(1000)
taken = []
while len(taken) < 300:
    end = server.accept()[0]
    # The runner's own looks end at once.
    end.settimeout(0.05)
    try:
        if end.recv(1): taken.append(end)
    except TimeoutError: taken.append(end)
sys.exit(3)";
    let server = ["python3", "-c", accepts, &pod.port.to_string()];
    let mut simulator = pod.simulator_running(&server, &["--peer-seconds=0"]);
    pod.until(SIMULATOR, Mark::Start(0));
    let connect = |_| TcpStream::connect(("127.0.0.1", pod.port)).unwrap();
    let _ends: Vec<TcpStream> = (0..300).map(connect).collect();
    assert_eq!(simulator.code(), 1);
    let why = simulator.verdict().why;
    assert!(
        why.starts_with("the command exited with code 3; ") && why.ends_with(" connections to its port were open"),
        "{why}"
    );
}

#[test]
fn a_server_that_hangs_when_its_agent_crashes_is_reported() {
    let pod = Pod::new();
    let hangs = "import socket, sys, time
server = socket.socket()
server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
server.bind(('127.0.0.1', int(sys.argv[1])))
server.listen()
time.sleep(1000)";
    let server = ["python3", "-c", hangs, &pod.port.to_string()];
    let (mut simulator, mut agent) = (
        pod.simulator_running(&server, &["--answer-seconds=1"]),
        pod.agent("exit 3"),
    );
    assert_eq!((simulator.code(), agent.code()), (1, 1));
    assert_eq!(simulator.verdict().what, What::ServerSilent);
    assert_eq!(agent.verdict().what, What::Exited);
}
