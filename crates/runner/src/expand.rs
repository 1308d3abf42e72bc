//! `$(NAME)` in the command's words, as Kubernetes expands it, but from the environment the runner has made. Pure; called
//! before the agent's command starts, so that no shell of the image can put other values in.

use std::ffi::{OsStr, OsString};
use std::os::unix::ffi::{OsStrExt, OsStringExt};

/// Replaces every `$(NAME)` whose name `lookup` knows; others stay. `$$(` gives a literal `$(`.
pub fn expand(word: &OsStr, lookup: impl Fn(&OsStr) -> Option<OsString>) -> OsString {
    let mut rest = word.as_bytes();
    let mut out = Vec::with_capacity(rest.len());
    while let Some((&first, tail)) = rest.split_first() {
        if rest.starts_with(b"$$(") {
            out.extend_from_slice(b"$(");
            rest = &rest[3..];
        } else if let Some((value, after)) = reference(rest, &lookup) {
            out.extend_from_slice(value.as_bytes());
            rest = after;
        } else {
            out.push(first);
            rest = tail;
        }
    }
    OsString::from_vec(out)
}

fn reference(text: &[u8], lookup: impl Fn(&OsStr) -> Option<OsString>) -> Option<(OsString, &[u8])> {
    let inner = text.strip_prefix(b"$(")?;
    let end = inner.iter().position(|byte| *byte == b')')?;
    let name = &inner[..end];
    let is_name = |byte: &u8| byte.is_ascii_alphanumeric() || matches!(byte, b'_' | b'-' | b'.');
    if name.is_empty() || !name.iter().all(is_name) {
        return None;
    }
    Some((lookup(OsStr::from_bytes(name))?, &inner[end + 1..]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_names_are_replaced_and_nothing_else() {
        let lookup = |name: &OsStr| match name.to_str()? {
            "PORT" => Some("2000".into()),
            "EMPTY" => Some(OsString::new()),
            "NESTED" => Some("$(PORT)".into()),
            "RAW" => Some(OsString::from_vec(vec![0xff])),
            _ => None,
        };
        let cases: [(&str, &[u8]); 14] = [
            ("--port=$(PORT)", b"--port=2000"),
            ("$(PORT)$(PORT)", b"20002000"),
            ("--resume=$(EMPTY)", b"--resume="),
            ("$(UNKNOWN)", b"$(UNKNOWN)"),
            ("$$(PORT)", b"$(PORT)"),
            ("$$$(PORT)", b"$$(PORT)"),
            ("echo $$ $PORT ${PORT}", b"echo $$ $PORT ${PORT}"),
            ("$(PORT", b"$(PORT"),
            ("$()", b"$()"),
            ("$(date +%s)$(PORT)", b"$(date +%s)2000"),
            ("$(NESTED)", b"$(PORT)"),
            ("$(RAW)", &[0xff]),
            ("$($(PORT))", b"$(2000)"),
            ("", b""),
        ];
        for (word, expected) in cases {
            assert_eq!(expand(OsStr::new(word), lookup).as_bytes(), expected, "{word}");
        }
    }
}
