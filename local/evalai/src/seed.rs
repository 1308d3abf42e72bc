//! The server's database before the first submission: users, teams, challenges. Read from JSON, with a built-in default.

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::model::{Challenge, Team, User};

/// The declared part of the server's database.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Seed {
    /// The first submission's primary key.
    #[serde(default = "one")]
    pub first_submission: u64,
    /// Users who may sign in.
    pub users: Vec<User>,
    /// Teams that take part.
    pub teams: Vec<Team>,
    /// Challenges that they take part in.
    pub challenges: Vec<Challenge>,
}

/// A seed that can't be used.
#[derive(Debug, Error)]
pub enum SeedError {
    /// The file can't be read.
    #[error("cannot read the seed {path}: {source}; check the path given to --seed")]
    Read {
        /// The file.
        path: String,
        /// Why not.
        source: std::io::Error,
    },
    /// The file is no seed.
    #[error("the seed {path} is not valid: {source}; compare it with local/evalai/seed.json")]
    Parse {
        /// The file.
        path: String,
        /// The fault, with line and column.
        source: serde_json::Error,
    },
}

impl Seed {
    /// Reads a seed file.
    pub fn read(path: &str) -> Result<Self, SeedError> {
        let text = std::fs::read_to_string(path).map_err(|source| SeedError::Read {
            path: path.to_owned(),
            source,
        })?;
        Self::parse(&text).map_err(|source| SeedError::Parse {
            path: path.to_owned(),
            source,
        })
    }

    /// Reads a seed's text.
    pub fn parse(text: &str) -> Result<Self, serde_json::Error> {
        serde_json::from_str(text)
    }

    /// The built-in seed. Challenge 1 is `CARLA Leaderboard 2.0 (local)` (phases 1 SENSORS, 2 MAP), challenge 2 is 1.0 (phases 3, 4), and
    /// challenge 3 takes predictions. The teams are a and b.
    pub fn built_in() -> Result<Self, SeedError> {
        Self::parse(include_str!("../seed.json")).map_err(|source| SeedError::Parse {
            path: "built into the program".to_owned(),
            source,
        })
    }

    /// Gives every challenge the same queue, as a server in debug mode does. A URL stands for its last part.
    pub fn set_queue(&mut self, name_or_url: &str) {
        let name = name_or_url
            .trim_end_matches('/')
            .rsplit('/')
            .next()
            .unwrap_or(name_or_url);
        for challenge in &mut self.challenges {
            name.clone_into(&mut challenge.queue);
        }
    }
}

fn one() -> u64 {
    1
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_built_in_seed_has_both_leaderboards() {
        let seed = Seed::built_in().unwrap();
        let labels: Vec<_> = seed
            .challenges
            .iter()
            .map(|c| c.phases[0].splits[0].schema.labels.len())
            .collect();
        assert_eq!(labels, [15, 12, 1]);
        let phases: Vec<_> = seed
            .challenges
            .iter()
            .flat_map(|c| &c.phases)
            .map(|p| (p.id, &*p.codename))
            .collect();
        assert_eq!(
            phases,
            [
                (1, "SENSORS"),
                (2, "MAP"),
                (3, "SENSORS"),
                (4, "MAP"),
                (5, "predictions")
            ]
        );
    }

    #[test]
    fn a_queue_is_given_by_name_or_url() {
        for text in [
            "submissions.fifo",
            "http://127.0.0.1:4566/000000000000/submissions.fifo",
        ] {
            let mut seed = Seed::built_in().unwrap();
            seed.set_queue(text);
            assert!(
                seed.challenges
                    .iter()
                    .all(|challenge| challenge.queue == "submissions.fifo")
            );
        }
    }

    #[test]
    fn a_bad_seed_is_refused_with_its_place() {
        let error = Seed::read("no-such-seed.json").unwrap_err().to_string();
        assert!(
            error.contains("no-such-seed.json") && error.contains("--seed"),
            "{error}"
        );
    }
}
