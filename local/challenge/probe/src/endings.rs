//! Attacks on the verdict and on the stored files. Each is a way for an agent to end, with the end that the submission must have.

/// Which image the attack comes in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Image {
    /// `challenge/agent:probe`
    Root,
    /// `challenge/agent:probe-user`
    User,
    /// `challenge/agent:probe-env`: it moves the runner's termination message by a variable of its own.
    Variable,
    /// `challenge/agent:probe-named`: it names its user.
    Named,
    /// `challenge/agent:probe-operator`: the user of the operator's own image.
    Operator,
}

impl Image {
    /// The image's tag.
    pub const fn tag(self) -> &'static str {
        match self {
            Self::Root => "probe",
            Self::User => "probe-user",
            Self::Variable => "probe-env",
            Self::Named => "probe-named",
            Self::Operator => "probe-operator",
        }
    }

    /// As whom it runs.
    pub const fn user(self) -> &'static str {
        match self {
            Self::Root => "root",
            Self::User | Self::Variable => "1000",
            Self::Named => "agent",
            Self::Operator => "65532",
        }
    }
}

/// The gain of an attack.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Gain {
    /// Nothing: it ends like any other failure of the agent, or like a run without it.
    None,
    /// It looks like honest work; the text is the host's countermeasure.
    Inherent(&'static str),
}

/// One way to end.
#[derive(Debug, Clone, Copy)]
pub struct Ending {
    /// Its name in `PROBE_ENDING`.
    pub id: &'static str,
    pub attack: &'static str,
    pub image: Image,
    /// Laid over the test's Leaderboard, as JSON.
    pub change: &'static str,
    /// State, reason, class, charged; number of Jobs.
    pub expected: &'static str,
    pub gain: Gain,
}

/// The variable that chooses.
pub const VARIABLE: &str = "PROBE_ENDING";

const CRASHED: &str = "Failed AgentCrashed (participant, charged); 1 Job";
const INVALID: &str = "Failed InvalidResults (participant, charged); 1 Job";
const FINISHED: &str = "Finished; 1 Job";
const IMAGE: &str = "Failed ImageInvalid (participant, charged); 1 Job";

const fn ending(id: &'static str, attack: &'static str, image: Image, expected: &'static str) -> Ending {
    Ending {
        id,
        attack,
        image,
        change: "{}",
        expected,
        gain: Gain::None,
    }
}

/// The agent crashes once, its forged start counts as another crash, and then it is an honest one.
const TWICE: &str = r#"{"retries": {"perWorker": 2}}"#;

/// Both pairs run, and each may come back once.
const TWO_PAIRS: &str = r#"{"evaluation": {"carla": {"pairs": 2}}, "retries": {"perWorker": 1}}"#;
const NOT_ROOT: &str = r#"{"agent": {"securityContext": {"runAsNonRoot": true}}}"#;

/// All endings, the longest first.
pub const ENDINGS: &[Ending] = &[
    Ending {
        change: TWO_PAIRS,
        ..ending(
            "port-behind",
            "take the port behind that of another pair's simulator, as soon as that has crashed with its agent",
            Image::User,
            CRASHED,
        )
    },
    Ending {
        change: TWICE,
        ..ending(
            "status-sparse",
            "a sparse status file of terabytes",
            Image::Root,
            FINISHED,
        )
    },
    Ending {
        change: TWICE,
        ..ending("status-content", "a status file with content", Image::User, FINISHED)
    },
    Ending {
        change: TWICE,
        ..ending(
            "status-pipe",
            "a named pipe in place of a status file",
            Image::User,
            FINISHED,
        )
    },
    Ending {
        change: TWICE,
        ..ending(
            "folder-deleted",
            "delete the own status files in each life, and the folder with them",
            Image::Root,
            CRASHED,
        )
    },
    Ending {
        change: r#"{"storage": {"s3": {"sizeLimit": "16Mi"}}}"#,
        ..ending(
            "growing-file",
            "a file that grows while it is stored",
            Image::User,
            FINISHED,
        )
    },
    ending(
        "replaced-log",
        "replace the log that is stored and shipped, again and again",
        Image::User,
        FINISHED,
    ),
    ending(
        "forge-message",
        "forge `notReady` and write-protect the termination message",
        Image::Root,
        CRASHED,
    ),
    ending(
        "forge-variable",
        "forge `notReady` and lead the runner's message elsewhere by the image's environment",
        Image::Variable,
        CRASHED,
    ),
    ending(
        "forge-limit",
        "forge `notReady` and take the runner's descriptors by prlimit",
        Image::User,
        CRASHED,
    ),
    ending("forge-peer", "forge `peerCrashed`", Image::Root, CRASHED),
    ending("forge-stopped", "forge `stopped`", Image::Root, CRASHED),
    ending("stop-runner", "end the runner by SIGTERM", Image::User, CRASHED),
    ending(
        "own-crash",
        "write the own crash mark, to blame the simulator",
        Image::User,
        CRASHED,
    ),
    ending("many-crashes", "write a thousand crash marks", Image::User, CRASHED),
    ending(
        "own-done",
        "write the own mark of the end before it",
        Image::User,
        INVALID,
    ),
    ending(
        "folder-shut",
        "make the own status folder unreadable, and end with results that say no more than that they are complete",
        Image::Root,
        INVALID,
    ),
    ending(
        "folder-listed",
        "forbid the own status folder to simulator and logcopy by an access control list, and crash",
        Image::Root,
        CRASHED,
    ),
    ending(
        "results-shut",
        "make the folder of the own results unreadable",
        Image::Root,
        INVALID,
    ),
    ending(
        "named-crash",
        "drive to the end, and then write into the results that the simulation crashed",
        Image::User,
        INVALID,
    ),
    Ending {
        change: NOT_ROOT,
        ..ending(
            "root-refused",
            "run as root where the Leaderboard sets `runAsNonRoot`",
            Image::Root,
            IMAGE,
        )
    },
    Ending {
        change: NOT_ROOT,
        ..ending(
            "user-named",
            "name the user instead of giving its number where the Leaderboard sets `runAsNonRoot`",
            Image::Named,
            IMAGE,
        )
    },
    ending(
        "survivors",
        "leave processes that outlive the agent and write its last message",
        Image::User,
        CRASHED,
    ),
    Ending {
        gain: Gain::Inherent(
            "the agent's own process computes its score; `verify: Refuse` finds clumsy forgeries only",
        ),
        ..ending(
            "own-score",
            "write better results than were driven",
            Image::User,
            FINISHED,
        )
    },
];

/// The one with this name.
pub fn named(id: &str) -> Option<&'static Ending> {
    ENDINGS.iter().find(|ending| ending.id == id)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    #[test]
    fn each_ending_has_a_name_of_its_own() {
        let ids: BTreeSet<_> = ENDINGS.iter().map(|ending| ending.id).collect();
        assert_eq!(ids.len(), ENDINGS.len());
        assert_eq!(named("survivors").map(|ending| ending.image), Some(Image::User));
        assert!(named("nothing").is_none());
    }
}
