//! An attack, and what must be seen of it.

use crate::seen::Seen;

/// The expected result of an attack, and why.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Expected {
    /// It fails, because of this.
    Held(&'static str),
    /// The cluster decides if it fails: by this.
    ByPolicy(&'static str),
    /// It works and is no leak: this is why.
    Inherent(&'static str),
}

impl Expected {
    /// Its word in the tables.
    pub const fn word(self) -> &'static str {
        match self {
            Self::Held(_) => "held",
            Self::ByPolicy(_) => "by policy",
            Self::Inherent(_) => "inherent",
        }
    }

    /// The thing that holds it, or the reason why it need not be held.
    pub const fn why(self) -> &'static str {
        match self {
            Self::Held(why) | Self::ByPolicy(why) | Self::Inherent(why) => why,
        }
    }

    /// True if this result is allowed. An inherent attack must work, or else the table shows less than is true.
    pub const fn allows(self, seen: &Seen) -> bool {
        matches!(
            (self, seen),
            (Self::Held(_), Seen::Denied(_))
                | (Self::ByPolicy(_), Seen::Denied(_) | Seen::Open(_))
                | (Self::Inherent(_), Seen::Open(_))
        )
    }
}

/// One attack that an image tries from within.
#[derive(Debug, Clone, Copy)]
pub struct Probe {
    pub id: &'static str,
    pub attack: &'static str,
    pub expected: Expected,
    /// With more rights than the operator gives (capabilities, no seccomp filter) it gets through, which shows that the probe
    /// would see it.
    pub opens_with_rights: bool,
    /// Tries it. Runs in a process of its own.
    pub run: fn() -> Seen,
}

pub(crate) const fn held(id: &'static str, attack: &'static str, by: &'static str, run: fn() -> Seen) -> Probe {
    Probe {
        id,
        attack,
        expected: Expected::Held(by),
        opens_with_rights: false,
        run,
    }
}

pub(crate) const fn by_policy(id: &'static str, attack: &'static str, of: &'static str, run: fn() -> Seen) -> Probe {
    Probe {
        expected: Expected::ByPolicy(of),
        ..held(id, attack, "", run)
    }
}

pub(crate) const fn inherent(id: &'static str, attack: &'static str, why: &'static str, run: fn() -> Seen) -> Probe {
    Probe {
        expected: Expected::Inherent(why),
        ..held(id, attack, "", run)
    }
}

impl Probe {
    pub(crate) const fn opens_with_rights(self) -> Self {
        Self {
            opens_with_rights: true,
            ..self
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_held_must_be_denied_and_nothing_may_be_unclear() {
        let (denied, open, unclear) = (
            Seen::Denied(String::new()),
            Seen::Open(String::new()),
            Seen::Unclear(String::new()),
        );
        for (expected, allowed) in [
            (Expected::Held("x"), [true, false, false]),
            (Expected::ByPolicy("x"), [true, true, false]),
            (Expected::Inherent("x"), [false, true, false]),
        ] {
            let found = [&denied, &open, &unclear].map(|seen| expected.allows(seen));
            assert_eq!(found, allowed, "{expected:?}");
        }
    }
}
