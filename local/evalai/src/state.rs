//! The server's database in memory: look-ups, and saves of whole rows. Pure; the lock around it is `server`'s.
//!
//! A row is read by cloning it and saved whole, as the server's models are: what another request wrote in between is
//! lost. That is on purpose.

use std::collections::BTreeMap;

use jiff::Timestamp;
use serde::Serialize;
use serde_json::Value;

use crate::errors;
use crate::model::{Challenge, LeaderboardRow, Phase, Split, Status, Submission, Team, TokenKind, User};
use crate::reply::Reply;
use crate::seed::Seed;

/// A message that went out, for tests to look at.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Published {
    /// When.
    pub at: Timestamp,
    /// The queue's name.
    pub queue: String,
    /// The body.
    pub body: Value,
    /// `MessageGroupId`, of FIFO queues.
    pub group: Option<String>,
    /// `MessageDeduplicationId`, of FIFO queues.
    pub dedup: Option<String>,
}

/// Everything the server knows.
#[derive(Debug, Clone, Serialize)]
pub struct State {
    /// Users, teams and challenges.
    pub seed: Seed,
    /// Submissions by primary key.
    pub submissions: BTreeMap<u64, Submission>,
    /// Leaderboard rows by primary key.
    pub rows: BTreeMap<u64, LeaderboardRow>,
    /// Files by their path below `/media/`. Nothing ever leaves.
    #[serde(skip)]
    pub files: BTreeMap<String, Vec<u8>>,
    /// Every message that went out, oldest first.
    pub published: Vec<Published>,
    next_submission: u64,
    last_row: u64,
    last_file: u64,
}

impl State {
    /// A server nobody has submitted to.
    pub fn new(seed: Seed) -> Self {
        Self {
            next_submission: seed.first_submission,
            seed,
            submissions: BTreeMap::new(),
            rows: BTreeMap::new(),
            files: BTreeMap::new(),
            published: Vec::new(),
            last_row: 0,
            last_file: 0,
        }
    }

    /// The user behind the value of an `Authorization` header, or none without one.
    pub fn authenticate(&self, header: Option<&str>) -> Result<Option<&User>, Reply> {
        let Some((scheme, value)) = header.and_then(|header| header.split_once(' ')) else {
            return Ok(None);
        };
        let owner = |bearer: bool| {
            let tokens = |user| move |token| (user, token);
            let mut all = self
                .seed
                .users
                .iter()
                .flat_map(|user: &User| user.tokens.iter().map(tokens(user)));
            all.find(|(_, token)| token.value == value.trim() && (token.kind != TokenKind::Key) == bearer)
        };
        match (scheme, owner(scheme == "Bearer")) {
            ("Bearer", Some((_, token))) if token.kind == TokenKind::Access => Err((&errors::ACCESS_TOKEN).into()),
            ("Bearer", Some((user, token))) if !token.expired && user.active => Ok(Some(user)),
            ("Bearer", _) => Err((&errors::BAD_BEARER).into()),
            ("Token", None) => Err((&errors::INVALID_KEY).into()),
            ("Token", Some((user, _))) if !user.active => Err((&errors::INACTIVE_USER).into()),
            ("Token", Some((_, token))) if token.expired => Err((&errors::EXPIRED_KEY).into()),
            ("Token", Some((user, _))) => Ok(Some(user)),
            _ => Ok(None),
        }
    }

    /// A user by primary key.
    pub fn user(&self, id: u64) -> Option<&User> {
        self.seed.users.iter().find(|user| user.id == id)
    }

    /// Is the user a member of the challenge's host team? An unknown challenge has no hosts.
    pub fn is_host(&self, user: &User, challenge: u64) -> bool {
        self.challenge(challenge)
            .is_some_and(|challenge| challenge.hosts.contains(&user.id))
    }

    /// A challenge by primary key.
    pub fn challenge(&self, id: u64) -> Option<&Challenge> {
        self.seed.challenges.iter().find(|challenge| challenge.id == id)
    }

    /// A challenge by the name of its queue. Where several share one, as on a server in debug mode, a host's own first.
    pub fn challenge_of_queue(&self, queue: &str, user: &User) -> Option<&Challenge> {
        let mut sharing = self.seed.challenges.iter().filter(|challenge| challenge.queue == queue);
        sharing
            .clone()
            .find(|challenge| challenge.hosts.contains(&user.id))
            .or_else(|| sharing.next())
    }

    /// A phase by primary key, with its challenge.
    pub fn phase(&self, id: u64) -> Option<(&Challenge, &Phase)> {
        let mut phases = self
            .seed
            .challenges
            .iter()
            .flat_map(|c| c.phases.iter().map(move |phase| (c, phase)));
        phases.find(|(_, phase)| phase.id == id)
    }

    /// A phase split by primary key, with its challenge and phase.
    pub fn split(&self, id: u64) -> Option<(&Challenge, &Phase, &Split)> {
        let phases = self
            .seed
            .challenges
            .iter()
            .flat_map(|c| c.phases.iter().map(move |phase| (c, phase)));
        let mut splits = phases.flat_map(|(c, phase)| phase.splits.iter().map(move |split| (c, phase, split)));
        splits.find(|(_, _, split)| split.id == id)
    }

    /// A team by primary key.
    pub fn team(&self, id: u64) -> Option<&Team> {
        self.seed.teams.iter().find(|team| team.id == id)
    }

    /// The team a user is in.
    pub fn team_of(&self, user: &User) -> Option<&Team> {
        self.seed.teams.iter().find(|team| team.members.contains(&user.id))
    }

    /// The submission's challenge.
    pub fn challenge_of(&self, submission: &Submission) -> Option<&Challenge> {
        self.phase(submission.challenge_phase).map(|(challenge, _)| challenge)
    }

    /// A submission of the team and phase that counts as under way.
    pub fn in_progress(&self, team: u64, phase: u64) -> usize {
        let of_team = |s: &&Submission| s.participant_team == team && s.challenge_phase == phase;
        self.submissions
            .values()
            .filter(of_team)
            .filter(|s| s.status.in_progress())
            .count()
    }

    /// The leaderboard row of a submission on a split. Two of them raise in the server, hence the 500.
    pub fn row(&self, submission: u64, split: u64) -> Result<Option<&LeaderboardRow>, Reply> {
        let mut rows = self
            .rows
            .values()
            .filter(|row| row.submission == submission && row.split == split);
        match (rows.next(), rows.next()) {
            (_, Some(_)) => Err(Reply::server_error()),
            (row, None) => Ok(row),
        }
    }

    /// Saves a whole row, over the one of the same key if there is one. Key 0 is a new row.
    pub fn save_row(&mut self, mut row: LeaderboardRow) {
        if row.id == 0 {
            self.last_row += 1;
            row.id = self.last_row;
        }
        self.rows.insert(row.id, row);
    }

    /// Saves a whole submission over the one of the same key.
    pub fn save(&mut self, submission: Submission) {
        self.submissions.insert(submission.id, submission);
    }

    /// Saves a submission as a new row: a new key, status submitted whatever it says, the next number of its team in
    /// the phase. Hands the key back.
    pub fn insert(&mut self, mut submission: Submission) -> u64 {
        let of_team = |s: &&Submission| {
            s.participant_team == submission.participant_team && s.challenge_phase == submission.challenge_phase
        };
        let number = self
            .submissions
            .values()
            .rev()
            .filter(of_team)
            .map(|s| s.submission_number)
            .next();
        submission.submission_number = number.unwrap_or(0) + 1;
        submission.id = self.next_submission;
        submission.status = Status::Submitted;
        self.next_submission += 1;
        let id = submission.id;
        self.save(submission);
        id
    }

    /// Stores a file of a submission under a name of its own and hands the path below `/media/` back.
    pub fn store(&mut self, submission: u64, extension: &str, content: Vec<u8>) -> String {
        self.last_file += 1;
        let path = format!(
            "submission_files/submission_{submission}/{:08x}-0000-4000-8000-{:012x}.{extension}",
            self.last_file, self.last_file
        );
        self.files.insert(path.clone(), content);
        path
    }

    /// Forgets everything but the seed.
    pub fn reset(&mut self) {
        *self = Self::new(self.seed.clone());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tokens_are_looked_up_by_scheme() {
        let state = State::new(Seed::built_in().unwrap());
        let name = |header| {
            state
                .authenticate(header)
                .map(|user| user.map(|user| user.username.clone()))
        };
        assert_eq!(name(Some("Bearer local-host-token")), Ok(Some("host".to_owned())));
        assert_eq!(
            name(Some("Token 0000000000000000000000000000000000000001")),
            Ok(Some("host".to_owned()))
        );
        assert_eq!(name(None), Ok(None));
        assert_eq!(name(Some("Basic x")), Ok(None));
        for (header, error) in [
            ("Bearer local-host-access-token", errors::ACCESS_TOKEN),
            ("Bearer local-late-token", errors::BAD_BEARER),
            ("Bearer 0000000000000000000000000000000000000001", errors::BAD_BEARER),
            ("Token local-host-token", errors::INVALID_KEY),
            ("Token 0000000000000000000000000000000000000022", errors::INACTIVE_USER),
            ("Token 0000000000000000000000000000000000000023", errors::EXPIRED_KEY),
        ] {
            assert_eq!(name(Some(header)), Err(Reply::from(&error)), "{header}");
        }
    }
}
