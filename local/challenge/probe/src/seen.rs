//! The result of a probe, and the one line of the log that shows it.

use std::fmt;
use std::io;

use nix::errno::Errno;

/// The result of an attack.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Seen {
    /// It was refused, or there was nothing to take.
    Denied(String),
    /// It got through.
    Open(String),
    /// The probe itself did not work, so nothing is known.
    Unclear(String),
}

/// Begins each line of a probe.
const MARK: &str = "probe";

impl Seen {
    /// The result of a system call. It is denied if the kernel or a filter of the runtime forbids it. Any other error has come past the
    /// check, also one about wrong arguments.
    pub(crate) fn of_call<T>(result: &Result<T, Errno>) -> Self {
        match result {
            Ok(_) => Self::Open("done".to_owned()),
            Err(errno) => Self::of_errno(*errno),
        }
    }

    pub(crate) fn of_io<T>(result: &io::Result<T>) -> Self {
        match result {
            Ok(_) => Self::Open("done".to_owned()),
            Err(error) => match error.raw_os_error() {
                Some(number) => Self::of_errno(Errno::from_raw(number)),
                None => Self::Unclear(error.to_string()),
            },
        }
    }

    pub(crate) fn of_errno(errno: Errno) -> Self {
        match errno {
            Errno::EPERM
            | Errno::EACCES
            | Errno::EROFS
            | Errno::EXDEV
            | Errno::ENOSYS
            | Errno::EAFNOSUPPORT
            | Errno::ESOCKTNOSUPPORT => Self::Denied(format!("{errno:?}")),
            other => Self::Open(format!("{other:?}")),
        }
    }

    /// Denied if nothing was found, open with what was.
    pub(crate) fn of_finds(finds: &[String], nothing: &str) -> Self {
        if finds.is_empty() {
            Self::Denied(nothing.to_owned())
        } else {
            Self::Open(finds.join(" "))
        }
    }

    /// The result of several ways to one end: open if one is, else unclear if one is.
    pub(crate) fn of_all(all: impl IntoIterator<Item = (String, Self)>) -> Self {
        let (mut open, mut unclear, mut denied) = (Vec::new(), Vec::new(), Vec::new());
        for (way, seen) in all {
            match seen {
                Self::Open(detail) => open.push(format!("{way}: {detail}")),
                Self::Unclear(detail) => unclear.push(format!("{way}: {detail}")),
                Self::Denied(detail) => denied.push(detail),
            }
        }
        denied.dedup();
        if !open.is_empty() {
            Self::Open(open.join(", "))
        } else if !unclear.is_empty() {
            Self::Unclear(unclear.join(", "))
        } else if denied.is_empty() {
            Self::Unclear("no way was tried".to_owned())
        } else {
            Self::Denied(denied.join(", "))
        }
    }

    const fn word(&self) -> &'static str {
        match self {
            Self::Denied(_) => "denied",
            Self::Open(_) => "open",
            Self::Unclear(_) => "unclear",
        }
    }

    fn detail(&self) -> &str {
        match self {
            Self::Denied(detail) | Self::Open(detail) | Self::Unclear(detail) => detail,
        }
    }
}

/// `denied EPERM`
impl fmt::Display for Seen {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {}", self.word(), self.detail())
    }
}

/// The line of a probe: `probe <id> denied|open|unclear <detail>`.
pub fn line(id: &str, seen: &Seen) -> String {
    let detail: String = seen
        .detail()
        .chars()
        .map(|letter| if letter.is_control() { ' ' } else { letter })
        .collect();
    format!("{MARK} {id} {} {detail}", seen.word())
}

/// Reads a line; `None` for one of anybody else.
pub fn parse(line: &str) -> Option<(&str, Seen)> {
    let mut parts = line.splitn(4, ' ');
    if parts.next() != Some(MARK) {
        return None;
    }
    let (id, word) = (parts.next()?, parts.next()?);
    let detail = parts.next().unwrap_or_default().to_owned();
    let seen = match word {
        "denied" => Seen::Denied(detail),
        "open" => Seen::Open(detail),
        "unclear" => Seen::Unclear(detail),
        _ => return None,
    };
    Some((id, seen))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_shows_what_was_seen_and_is_read_back() {
        for seen in [
            Seen::Denied("EPERM".into()),
            Seen::Open("fd 3, done".into()),
            Seen::Unclear(String::new()),
        ] {
            assert_eq!(parse(&line("mount", &seen)), Some(("mount", seen)));
        }
        let two_lines = Seen::Open("a\nprobe mount denied EPERM".into());
        assert!(!line("mount", &two_lines).contains('\n'));
        assert_eq!(parse("========= Preparing RouteScenario_0"), None);
        assert_eq!(parse("probe mount maybe"), None);
    }

    #[test]
    fn only_a_refusal_is_denied() {
        for (errno, is_denied) in [
            (Errno::EPERM, true),
            (Errno::EROFS, true),
            (Errno::ENOSYS, true),
            (Errno::EINVAL, false),
            (Errno::EFAULT, false),
            (Errno::ENOENT, false),
        ] {
            assert_eq!(matches!(Seen::of_errno(errno), Seen::Denied(_)), is_denied, "{errno}");
        }
        assert_eq!(Seen::of_call(&Ok(3)), Seen::Open("done".into()));
        let two = |second| Seen::of_all([("a".to_owned(), Seen::Denied("EPERM".into())), ("b".to_owned(), second)]);
        assert_eq!(two(Seen::Denied("EPERM".into())), Seen::Denied("EPERM".into()));
        assert_eq!(two(Seen::Open("done".into())), Seen::Open("b: done".into()));
        assert_eq!(two(Seen::Unclear("?".into())), Seen::Unclear("b: ?".into()));
        assert!(matches!(Seen::of_all([]), Seen::Unclear(_)));
    }
}
