//! The evaluator's command line, as argparse reads it in Leaderboard 1.0 and 2.0. Called by `challenge-agent`; knows no
//! file and no environment.

use std::{collections::HashMap, path::PathBuf};

/// The checkpoint format, which is also the Leaderboard's major version.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    V1,
    V2,
}

impl Format {
    /// `V1` or `V2`; anything else is not a format.
    pub fn parse(text: &str) -> Option<Self> {
        match text {
            "V1" => Some(Self::V1),
            "V2" => Some(Self::V2),
            _ => None,
        }
    }
}

/// Why a command line is refused. Argparse exits 2 on each of these.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
pub enum FlagError {
    #[error("no script given: this python3 only runs leaderboard_evaluator.py")]
    NoScript,
    #[error("unrecognized arguments: {0}")]
    Unrecognized(String),
    #[error("argument --{0}: expected one argument")]
    NoValue(String),
    #[error("the following arguments are required: --{0}")]
    Required(&'static str),
    #[error("argument --{flag}: invalid int value: '{value}'")]
    NotANumber { flag: &'static str, value: String },
}

/// The evaluator's command line.
#[derive(Debug, PartialEq, Eq)]
pub struct Invocation {
    /// The Python file that was to run.
    pub script: PathBuf,
    pub format: Format,
    pub port: u16,
    pub agent: PathBuf,
    pub track: String,
    pub routes: PathBuf,
    /// Empty means all routes.
    pub routes_subset: String,
    /// V1 only.
    pub scenarios: Option<PathBuf>,
    pub repetitions: usize,
    /// `type=bool`: any non-empty text is yes, `0` and `False` included.
    pub resume: bool,
    pub checkpoint: PathBuf,
    /// V2 only.
    pub debug_checkpoint: Option<PathBuf>,
}

const BOTH: &[&str] = &[
    "host",
    "port",
    "timeout",
    "routes",
    "routes-subset",
    "repetitions",
    "agent",
    "agent-config",
    "track",
    "resume",
    "checkpoint",
    "record",
    "debug",
];
const ONLY_V1: &[&str] = &["trafficManagerPort", "trafficManagerSeed", "scenarios"];
const ONLY_V2: &[&str] = &["traffic-manager-port", "traffic-manager-seed", "debug-checkpoint"];

/// Reads what follows `python3`. `format` overrides what the flags ask for.
pub fn parse(arguments: &[String], format: Option<Format>) -> Result<Invocation, FlagError> {
    let script = arguments
        .iter()
        .position(|one| !one.starts_with('-'))
        .ok_or(FlagError::NoScript)?;
    let mut values = values(&arguments[script + 1..])?;
    let format = format.unwrap_or_else(|| {
        if values.keys().any(|name| ONLY_V1.contains(&name.as_str())) {
            Format::V1
        } else {
            Format::V2
        }
    });
    let own = if format == Format::V1 { ONLY_V1 } else { ONLY_V2 };
    if let Some(name) = values
        .keys()
        .find(|name| !BOTH.contains(&name.as_str()) && !own.contains(&name.as_str()))
    {
        return Err(FlagError::Unrecognized(format!("--{name}")));
    }
    for flag in ["trafficManagerPort", "traffic-manager-port"] {
        number(&mut values, flag, 8000_u16)?;
    }
    let scenarios = values.remove("scenarios").map(PathBuf::from);
    if format == Format::V1 && scenarios.is_none() {
        return Err(FlagError::Required("scenarios"));
    }
    Ok(Invocation {
        script: PathBuf::from(&arguments[script]),
        format,
        port: number(&mut values, "port", 2000)?,
        agent: values.remove("agent").ok_or(FlagError::Required("agent"))?.into(),
        track: values.remove("track").unwrap_or_else(|| "SENSORS".to_owned()),
        routes: values.remove("routes").ok_or(FlagError::Required("routes"))?.into(),
        routes_subset: values.remove("routes-subset").unwrap_or_default(),
        scenarios,
        repetitions: number(&mut values, "repetitions", 1)?,
        resume: values.remove("resume").is_some_and(|text| !text.is_empty()),
        checkpoint: values
            .remove("checkpoint")
            .unwrap_or_else(|| "./simulation_results.json".to_owned())
            .into(),
        debug_checkpoint: values.remove("debug-checkpoint").map(PathBuf::from),
    })
}

/// `--name=value` and `--name value`; the last of a name wins.
fn values(arguments: &[String]) -> Result<HashMap<String, String>, FlagError> {
    let mut found = HashMap::new();
    let mut rest = arguments.iter();
    while let Some(argument) = rest.next() {
        let Some(flag) = argument.strip_prefix("--") else {
            return Err(FlagError::Unrecognized(argument.clone()));
        };
        let (name, value) = match flag.split_once('=') {
            Some((name, value)) => (name, value.to_owned()),
            None => match rest.next() {
                Some(value) if !value.starts_with("--") => (flag, value.clone()),
                _ => return Err(FlagError::NoValue(flag.to_owned())),
            },
        };
        found.insert(name.to_owned(), value);
    }
    Ok(found)
}

fn number<N: std::str::FromStr>(
    values: &mut HashMap<String, String>,
    flag: &'static str,
    default: N,
) -> Result<N, FlagError> {
    match values.remove(flag) {
        None => Ok(default),
        Some(value) => value.trim().parse().map_err(|_| FlagError::NotANumber { flag, value }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(extra: &[&str]) -> Vec<String> {
        ["-u", "/x/leaderboard_evaluator.py", "--agent=a.py", "--routes=r.xml"]
            .iter()
            .chain(extra)
            .map(|&one| one.to_owned())
            .collect()
    }

    #[test]
    fn resume_is_yes_for_any_text() {
        for (text, expected) in [("", false), ("1", true), ("0", true), ("False", true)] {
            let invocation = parse(&line(&[&format!("--resume={text}")]), None).unwrap();
            assert_eq!(invocation.resume, expected, "--resume={text}");
        }
        assert!(!parse(&line(&[]), None).unwrap().resume);
    }

    #[test]
    fn the_version_follows_from_the_flags() {
        let v2 = parse(
            &line(&["--traffic-manager-port", "2010", "--debug-checkpoint=d", "--port=2100"]),
            None,
        )
        .unwrap();
        assert_eq!((v2.format, v2.port), (Format::V2, 2100));
        let v1 = parse(&line(&["--trafficManagerPort=2010", "--scenarios=s.json"]), None).unwrap();
        assert_eq!((v1.format, v1.port), (Format::V1, 2000));
        assert_eq!(
            parse(&line(&["--scenarios=s"]), Some(Format::V2)),
            Err(FlagError::Unrecognized("--scenarios".into()))
        );
    }

    #[test]
    fn what_argparse_refuses_is_refused() {
        let cases: [(Vec<String>, FlagError); 6] = [
            (
                line(&["--trafficManagerPort=1", "--scenarios=s", "--debug-checkpoint=d"]),
                FlagError::Unrecognized("--debug-checkpoint".into()),
            ),
            (line(&["--trafficManagerPort=1"]), FlagError::Required("scenarios")),
            (
                line(&["--port=two"]),
                FlagError::NotANumber {
                    flag: "port",
                    value: "two".into(),
                },
            ),
            (line(&["--port"]), FlagError::NoValue("port".into())),
            (line(&["stray"]), FlagError::Unrecognized("stray".into())),
            (vec!["-u".into()], FlagError::NoScript),
        ];
        for (arguments, expected) in cases {
            assert_eq!(parse(&arguments, None), Err(expected), "{arguments:?}");
        }
    }
}
