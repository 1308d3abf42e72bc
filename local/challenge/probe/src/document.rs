//! docs/reference/probes.md, written from the tables that the tests run.

use std::fmt::Write as _;

use crate::endings::{ENDINGS, Gain};
use crate::exhaust::LIMITS;
use crate::objects::OBJECTS;
use crate::table::SECTIONS;

const HEAD: &str = "\
<!-- written from local/challenge/probe by `make docs`: change the tables there -->
# What a hostile image tries, and what comes of it

`make test` runs an image that tries each attack of this page, and fails if one gets through. The image runs as root and as
user 1000, under Leaderboard 1.0 and 2.0. Its own tables make this page, so each attack on it is tried.

| verdict | means |
|---|---|
| held | the operator's own Pods and rules refuse it in any cluster |
| by policy | the cluster decides: the named object or setting must be there, and be enforced |
| inherent | it works for every image and yields nothing that is secret; or it cannot be distinguished from honest work |

A host who gives containers more rights (`securityContext`, `podOverrides`) opens what this page calls held. A test does that on
purpose, to see that the probes find it.
";

const OBJECTS_HEAD: &str = "
## What only the cluster holds

The local cluster has no network plugin that enforces policies. So these attacks are not tried; the test checks the object
that would hold them. A Leaderboard measures in its Pods whether policies are enforced (condition `Isolated`;
`network.enforcement: Require` runs nothing where they are not).

| attack | verdict | by |
|---|---|---|
";

const ENDINGS_HEAD: &str = "
## Lies about the end, and files that are traps

Each is a submission of its own. A failure that is charged costs the participant an attempt; with more than one Job a
submission would have got another attempt at the host's cost.

| the agent's attempt | user | the end that the test demands | verdict |
|---|---|---|---|
";

const LIMITS_HEAD: &str = "
## Limits of the kernel that containers share

The image uses such a limit up for half a minute, while another team's run goes on next to it. The end is that of the other run. These
tests run alone, since every program of the machine feels them.

| the agent's attempt | user | the end of another team's run | verdict |
|---|---|---|---|
";

/// The whole page.
pub fn text() -> String {
    let mut text = HEAD.to_owned();
    for (title, probes) in SECTIONS {
        _ = write!(
            text,
            "\n## {title}\n\n| attack | verdict | because of |\n|---|---|---|\n"
        );
        for probe in probes {
            let (verdict, why) = (probe.expected.word(), probe.expected.why());
            _ = writeln!(text, "| {} | {verdict} | {why} |", probe.attack);
        }
    }
    text.push_str(OBJECTS_HEAD);
    for object in OBJECTS {
        _ = writeln!(text, "| {} | by policy | {} |", object.attack, object.by);
    }
    text.push_str(ENDINGS_HEAD);
    for ending in ENDINGS {
        let verdict = match ending.gain {
            Gain::None => "held".to_owned(),
            Gain::Inherent(why) => format!("inherent: {why}"),
        };
        let (attack, user, expected) = (ending.attack, ending.image.user(), ending.expected);
        _ = writeln!(text, "| {attack} | {user} | {expected} | {verdict} |");
    }
    text.push_str(LIMITS_HEAD);
    for limit in LIMITS {
        let (attack, user, neighbor) = (limit.attack, limit.image.user(), limit.neighbor);
        _ = writeln!(text, "| {attack} | {user} | {neighbor} | held |");
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    const PAGE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../../docs/reference/probes.md");

    /// `make docs` sets UPDATE_DOCS: the page is then written, not compared.
    #[test]
    fn the_documentation_shows_the_tables() {
        if std::env::var_os("UPDATE_DOCS").is_some() {
            std::fs::write(PAGE, text()).unwrap();
            return;
        }
        let found = std::fs::read_to_string(PAGE).unwrap();
        assert!(
            found == text(),
            "docs/reference/probes.md does not show the tables of local/challenge/probe: run `make docs`"
        );
    }
}
