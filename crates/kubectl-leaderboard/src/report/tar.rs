//! Files as a tar archive (POSIX ustar). Pure.

/// Bytes of a block.
const BLOCK: usize = 512;
/// What programs that open the archive may do with its files.
const MODE: &str = "0000644";

/// An archive of files with their names and texts. Names have fewer than 100 bytes.
pub(super) fn archive(files: &[(String, String)], time: i64) -> Vec<u8> {
    let mut archive = Vec::new();
    for (name, text) in files {
        archive.extend(header(name, text.len(), time));
        archive.extend(text.as_bytes());
        archive.resize(archive.len().next_multiple_of(BLOCK), 0);
    }
    // Two empty blocks end it.
    archive.resize(archive.len() + 2 * BLOCK, 0);
    archive
}

fn header(name: &str, size: usize, time: i64) -> [u8; BLOCK] {
    let mut block = [0; BLOCK];
    let mut put = |at: usize, text: &str| {
        for (byte, letter) in block.iter_mut().skip(at).zip(text.bytes()) {
            *byte = letter;
        }
    };
    put(0, name);
    put(100, MODE);
    put(108, "0000000");
    put(116, "0000000");
    put(124, &format!("{size:011o}"));
    put(136, &format!("{:011o}", time.max(0)));
    // The checksum is of a header with blanks in its place.
    put(148, "        ");
    put(156, "0");
    put(257, "ustar");
    put(263, "00");
    let sum: u32 = block.iter().copied().map(u32::from).sum();
    for (byte, letter) in block.iter_mut().skip(148).zip(format!("{sum:06o}\0 ").bytes()) {
        *byte = letter;
    }
    block
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write as _;
    use std::process::{Command, Stdio};

    #[test]
    fn tar_reads_it() {
        let long = "x".repeat(1000);
        let files = [
            ("about.txt".to_owned(), "one line\n".to_owned()),
            ("empty.json".to_owned(), String::new()),
            ("long.json".to_owned(), long.clone()),
        ];
        let archive = archive(&files, 1_793_527_200);
        assert_eq!(archive.len() % BLOCK, 0);
        let run = |arguments: &[&str]| {
            let mut command = Command::new("tar");
            let mut child = command
                .args(arguments)
                .stdin(Stdio::piped())
                .stdout(Stdio::piped())
                .spawn()
                .unwrap();
            child.stdin.take().unwrap().write_all(&archive).unwrap();
            let output = child.wait_with_output().unwrap();
            assert!(output.status.success());
            String::from_utf8(output.stdout).unwrap()
        };
        assert_eq!(run(&["-tf", "-"]), "about.txt\nempty.json\nlong.json\n");
        assert_eq!(run(&["-xOf", "-", "long.json"]), long);
    }
}
