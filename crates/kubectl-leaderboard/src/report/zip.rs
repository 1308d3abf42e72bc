//! Files as a zip archive, which every system opens, uncompressed. Pure.

use jiff::Timestamp;
use jiff::civil::DateTime;
use jiff::tz::Offset;

const LOCAL_HEADER: u32 = 0x0403_4b50;
const ENTRY: u32 = 0x0201_4b50;
const END: u32 = 0x0605_4b50;
/// The oldest version of the format that a reader must know.
const VERSION: u16 = 10;
/// Made by a version 2.0 on Unix, whose modes the entries have.
const MADE_BY: u16 = 0x0314;
/// Names are UTF-8.
const FLAGS: u16 = 0x0800;
/// What programs that open the archive may do with its files: a plain file, 0644.
const MODE: u32 = 0o100_644 << 16;

/// An archive of files with their names and texts. All of it has less than 4 GiB.
pub(super) fn archive(files: &[(String, String)], time: Timestamp) -> Vec<u8> {
    let (mut archive, mut entries) = (Vec::new(), Vec::new());
    let time = dos_time(Offset::UTC.to_datetime(time));
    for (name, text) in files {
        let shared = shared_header(name, text, time);
        let offset = number(archive.len());
        entries.extend(ENTRY.to_le_bytes());
        entries.extend(MADE_BY.to_le_bytes());
        entries.extend(&shared);
        // No comment, the first disk, no attributes of DOS.
        entries.extend([0; 6]);
        entries.extend(MODE.to_le_bytes());
        entries.extend(offset.to_le_bytes());
        entries.extend(name.as_bytes());
        archive.extend(LOCAL_HEADER.to_le_bytes());
        archive.extend(&shared);
        archive.extend(name.as_bytes());
        archive.extend(text.as_bytes());
    }
    let (offset, count) = (number(archive.len()), short(files.len()));
    archive.extend(&entries);
    archive.extend(END.to_le_bytes());
    // One disk.
    archive.extend([0; 4]);
    archive.extend([count.to_le_bytes(), count.to_le_bytes()].concat());
    archive.extend(number(entries.len()).to_le_bytes());
    archive.extend(offset.to_le_bytes());
    // No comment.
    archive.extend([0; 2]);
    archive
}

/// What stands in front of a file and in its entry at the end alike.
fn shared_header(name: &str, text: &str, (date, time): (u16, u16)) -> Vec<u8> {
    let size = number(text.len());
    let shorts = [VERSION, FLAGS, 0, time, date];
    let mut header: Vec<u8> = shorts.iter().flat_map(|short| short.to_le_bytes()).collect();
    // Uncompressed: both sizes are the same.
    for long in [checksum(text.as_bytes()), size, size] {
        header.extend(long.to_le_bytes());
    }
    header.extend(short(name.len()).to_le_bytes());
    // No further fields.
    header.extend([0; 2]);
    header
}

/// Date and time as DOS has them: from 1980, every other second.
fn dos_time(time: DateTime) -> (u16, u16) {
    let part = |number: i8| u16::try_from(number).unwrap_or_default();
    let year = u16::try_from(time.year() - 1980).unwrap_or_default();
    (
        (year << 9) | (part(time.month()) << 5) | part(time.day()),
        (part(time.hour()) << 11) | (part(time.minute()) << 5) | (part(time.second()) / 2),
    )
}

fn number(length: usize) -> u32 {
    u32::try_from(length).unwrap_or(u32::MAX)
}

fn short(length: usize) -> u16 {
    u16::try_from(length).unwrap_or(u16::MAX)
}

/// CRC-32, as zip and gzip have it.
fn checksum(bytes: &[u8]) -> u32 {
    let step = |crc: u32, _| (crc >> 1) ^ (0xedb8_8320 & (crc & 1).wrapping_neg());
    !bytes
        .iter()
        .fold(!0, |crc, byte| (0..8).fold(crc ^ u32::from(*byte), step))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write as _;
    use std::process::{Command, Stdio};

    /// What another program makes of the archive: names, sizes, times, and whether every checksum is right.
    const READER: &str = "import io, sys, zipfile
archive = zipfile.ZipFile(io.BytesIO(sys.stdin.buffer.read()))
assert archive.testzip() is None
for one in archive.infolist():
    print(one.filename, one.file_size, oct(one.external_attr >> 16), *one.date_time)
print(archive.read('long.json').decode()[-5:])
";

    #[test]
    fn another_program_reads_it() {
        let files = [
            ("about.txt".to_owned(), "one line\n".to_owned()),
            ("empty.json".to_owned(), String::new()),
            ("long.json".to_owned(), format!("{}é end", "x".repeat(1000))),
        ];
        let archive = archive(&files, "2026-11-23T23:48:55Z".parse().unwrap());
        let mut reader = Command::new("python3");
        let reader = reader.args(["-c", READER]).stdin(Stdio::piped()).stdout(Stdio::piped());
        let mut child = reader.spawn().unwrap();
        child.stdin.take().unwrap().write_all(&archive).unwrap();
        let output = child.wait_with_output().unwrap();
        assert!(output.status.success());
        assert_eq!(
            String::from_utf8(output.stdout).unwrap(),
            "about.txt 9 0o100644 2026 11 23 23 48 54\n\
             empty.json 0 0o100644 2026 11 23 23 48 54\n\
             long.json 1006 0o100644 2026 11 23 23 48 54\né end\n"
        );
    }

    #[test]
    fn its_checksum_is_the_one_of_the_format() {
        assert_eq!(checksum(b"123456789"), 0xcbf4_3926);
        assert_eq!(checksum(b""), 0);
    }
}
