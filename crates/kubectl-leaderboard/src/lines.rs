//! The lines of a log that a stranger writes: of each the beginning is kept, however long it is. Pure, but for the reading.

use std::io;
use std::pin::Pin;

use futures::{AsyncRead, AsyncReadExt as _, Stream, TryStreamExt as _, stream};

/// Bytes of a line that are kept.
const LONGEST: usize = 64 << 10;
/// Stands for the rest of a longer one.
const MARK: &str = " … (cut at 64 KiB)";
/// Bytes that are read at once.
pub const PIECE: usize = 16 << 10;

/// Takes a log in pieces, and gives its lines.
#[derive(Debug, Default)]
pub struct Lines {
    line: Vec<u8>,
    is_cut: bool,
    is_begun: bool,
}

impl Lines {
    /// The lines that end in this piece. An empty one is the end of the log, and of its last line.
    pub fn take(&mut self, piece: &[u8]) -> Vec<String> {
        if piece.is_empty() {
            return self.end().into_iter().collect();
        }
        let mut ended = Vec::new();
        for part in piece.split_inclusive(|byte| *byte == b'\n') {
            self.is_begun = true;
            let (text, is_end) = part.strip_suffix(b"\n").map_or((part, false), |text| (text, true));
            let room = LONGEST.saturating_sub(self.line.len());
            self.is_cut |= text.len() > room;
            self.line.extend_from_slice(text.get(..room).unwrap_or(text));
            if is_end {
                ended.extend(self.end());
            }
        }
        ended
    }

    /// The last line, if no line break has ended it.
    fn end(&mut self) -> Option<String> {
        let Self { line, is_cut, is_begun } = std::mem::take(self);
        // A log is bytes: one that is no UTF-8 is shown all the same.
        let text = String::from_utf8_lossy(&line);
        is_begun.then(|| {
            if is_cut {
                format!("{text}{MARK}")
            } else {
                text.into_owned()
            }
        })
    }
}

/// The lines of what a reader gives.
pub fn of(reader: impl AsyncRead + Send + 'static) -> impl Stream<Item = io::Result<String>> + Send {
    let begun: Option<(Pin<Box<dyn AsyncRead + Send>>, Lines)> = Some((Box::pin(reader), Lines::default()));
    let pieces = stream::try_unfold(begun, |state| async move {
        let Some((mut reader, mut lines)) = state else {
            return Ok::<_, io::Error>(None);
        };
        let mut piece = vec![0; PIECE];
        let read = reader.read(&mut piece).await?;
        let ended = lines.take(piece.get(..read).unwrap_or_default());
        Ok(Some((ended, (read > 0).then_some((reader, lines)))))
    });
    pieces
        .map_ok(|lines: Vec<String>| stream::iter(lines.into_iter().map(Ok)))
        .try_flatten()
}

#[cfg(test)]
mod tests {
    use futures::io::Cursor;

    use super::*;

    async fn lines(text: &[u8]) -> Vec<String> {
        of(Cursor::new(text.to_vec())).try_collect().await.unwrap()
    }

    #[tokio::test]
    async fn a_log_comes_line_by_line_whatever_its_bytes_are() {
        assert_eq!(lines(b"").await, Vec::<String>::new());
        assert_eq!(lines(b"a\n\nb\n").await, ["a", "", "b"]);
        assert_eq!(lines(b"a\r\nlast\xff").await, ["a\r", "last\u{fffd}"]);
        let many = "0123456789\n".repeat(10_000);
        assert_eq!(lines(many.as_bytes()).await.len(), 10_000);
    }

    #[tokio::test]
    async fn a_line_without_an_end_is_cut_and_says_so_and_the_next_one_is_whole() {
        let long = "x".repeat(4 << 20);
        for end in ["\nnext\n", ""] {
            let found = lines(format!("{long}{end}").as_bytes()).await;
            assert_eq!(found[0], format!("{}{MARK}", "x".repeat(LONGEST)));
            assert_eq!(
                found.get(1).map(String::as_str),
                end.trim().split_terminator('\n').next()
            );
        }
        let just = "x".repeat(LONGEST);
        assert_eq!(lines(format!("{just}\n").as_bytes()).await, [just]);
    }

    #[test]
    fn no_more_than_a_line_is_kept_in_memory() {
        let mut lines = Lines::default();
        for _ in 0..1000 {
            assert!(lines.take(&[b'x'; PIECE]).is_empty());
        }
        assert!(lines.line.capacity() <= 2 * LONGEST, "{}", lines.line.capacity());
    }
}
