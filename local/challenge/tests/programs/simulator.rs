//! The simulator alone.

use std::{
    io::{BufRead, BufReader, Read, Write},
    net::TcpStream,
};

use crate::support::{Folder, simulator};

#[test]
fn greets_each_connection_and_keeps_it() {
    let folder = Folder::new();
    let carla = simulator(&folder, "");
    let lines = |_| BufReader::new(TcpStream::connect(("127.0.0.1", carla.port)).unwrap());
    let mut connections = [0, 1].map(lines);
    for (number, connection) in connections.iter_mut().enumerate() {
        let mut line = String::new();
        connection.read_line(&mut line).unwrap();
        assert_eq!(line, "carla 0.9.15\n");
        connection
            .get_mut()
            .write_all(format!("route {number}\n").as_bytes())
            .unwrap();
        line.clear();
        connection.read_line(&mut line).unwrap();
        assert_eq!(line, format!("ok {number}\n"));
    }
    assert!(
        folder
            .read("Saved/Logs/CarlaUE4-0.log")
            .contains("route 1 begins, number 2 of this server")
    );
}

#[test]
fn crashes_once_over_restarts() {
    let folder = Folder::new();
    for crashes in [true, false] {
        let carla = simulator(&folder, "crash@1:once");
        let mut stream = TcpStream::connect(("127.0.0.1", carla.port)).unwrap();
        stream.write_all(b"route 0\n").unwrap();
        let mut said = BufReader::new(&mut stream);
        let mut line = String::new();
        said.read_line(&mut line).unwrap();
        if crashes {
            let mut rest = String::new();
            assert_eq!(said.read_to_string(&mut rest).unwrap_or_default(), 0);
            assert_eq!(carla.program.end().1.code(), Some(1));
        } else {
            line.clear();
            said.read_line(&mut line).unwrap();
            assert_eq!(line, "ok 0\n");
            carla.program.kill();
        }
    }
}
