//! The server's database in memory: look-ups, and saves of whole rows. Pure; the lock around it is `server`'s.
//!
//! A row is read by cloning it and saved whole, as the server's models are: what another request wrote in between is
//! lost. That is on purpose.

use std::collections::{BTreeMap, BTreeSet};

use jiff::Timestamp;
use serde::Serialize;
use serde_json::Value;

use crate::errors;
use crate::model::{Challenge, LeaderboardRow, Phase, Split, Status, Submission, Team, Token, TokenKind, User};
use crate::reply::Reply;
use crate::seed::Seed;

/// A message that was sent, for tests.
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

/// Everything the server holds.
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
    /// What the address of each input file has, and has to have, once the first such address has expired.
    pub signature: Option<u64>,
    /// Refresh tokens that profile pages gave in place of older ones, with their users; the newest last.
    renewed: Vec<(u64, String)>,
    /// Refresh tokens that are no longer valid.
    blacklist: BTreeSet<String>,
    /// Where each submission's row lies in the table: an update puts the row behind all others.
    #[serde(skip)]
    places: BTreeMap<u64, u64>,
    last_place: u64,
    next_submission: u64,
    last_row: u64,
    last_file: u64,
}

impl State {
    /// A server without a submission.
    pub fn new(seed: Seed) -> Self {
        Self {
            next_submission: seed.first_submission,
            seed,
            submissions: BTreeMap::new(),
            rows: BTreeMap::new(),
            files: BTreeMap::new(),
            published: Vec::new(),
            renewed: Vec::new(),
            blacklist: BTreeSet::new(),
            places: BTreeMap::new(),
            last_place: 0,
            last_row: 0,
            last_file: 0,
            signature: None,
        }
    }

    /// The user behind the value of an `Authorization` header, or none without one.
    pub fn authenticate(&self, header: Option<&str>) -> Result<Option<&User>, Reply> {
        let parts: Vec<_> = header.unwrap_or_default().split_whitespace().collect();
        let error = match parts.as_slice() {
            ["Bearer", token] => return self.bearer(token).map(Some),
            ["Bearer", ..] => &errors::BAD_AUTHORIZATION_HEADER,
            [scheme, rest @ ..] if scheme.eq_ignore_ascii_case("Token") => match rest {
                [] => &errors::KEY_MISSING,
                [key] => return self.key_owner(key).map(Some),
                _ => &errors::KEY_WITH_SPACES,
            },
            _ => return Ok(None),
        };
        Err(error.into())
    }

    fn bearer(&self, value: &str) -> Result<&User, Reply> {
        if self.blacklist.contains(value) {
            return Err((&errors::BLACKLISTED).into());
        }
        if let Some((user, _)) = self.renewed.iter().find(|(_, token)| token == value) {
            return self.user(*user).ok_or_else(|| (&errors::BAD_BEARER).into());
        }
        match self.token(|token| token.kind != TokenKind::Key && token.value == value) {
            Some((_, token)) if token.kind == TokenKind::Access => Err((&errors::ACCESS_TOKEN).into()),
            Some((user, token)) if !token.expired && user.active => Ok(user),
            _ => Err((&errors::BAD_BEARER).into()),
        }
    }

    fn key_owner(&self, value: &str) -> Result<&User, Reply> {
        match self.token(|token| token.kind == TokenKind::Key && token.value == value) {
            None => Err((&errors::INVALID_KEY).into()),
            Some((user, _)) if !user.active => Err((&errors::INACTIVE_USER).into()),
            Some((_, token)) if token.expired => Err((&errors::EXPIRED_KEY).into()),
            Some((user, _)) => Ok(user),
        }
    }

    fn token(&self, wanted: impl Fn(&Token) -> bool) -> Option<(&User, &Token)> {
        let tokens = |user| move |token| (user, token);
        let users = self.seed.users.iter();
        let mut all = users.flat_map(|user: &User| user.tokens.iter().map(tokens(user)));
        all.find(|(_, token)| wanted(token))
    }

    /// The refresh token that the user's profile page shows.
    pub fn refresh_token<'a>(&'a self, user: &'a User) -> Option<&'a str> {
        let renewed = self.renewed.iter().rev().find(|(id, _)| *id == user.id);
        let first = || {
            let mut tokens = user.tokens.iter();
            let found = tokens.find(|token| token.kind == TokenKind::Refresh && !token.expired);
            found.map(|token| token.value.as_str())
        };
        renewed.map(|(_, token)| token.as_str()).or_else(first)
    }

    /// Gives the user a new refresh token; the one before is blacklisted at once.
    pub fn renew_token(&mut self, user: &User) -> String {
        if let Some(old) = self.refresh_token(user).map(str::to_owned) {
            self.blacklist.insert(old);
        }
        let token = format!("local-{}-token-{}", user.username, self.renewed.len() + 2);
        self.renewed.push((user.id, token.clone()));
        token
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

    /// How many submissions of the team and phase count as under way; deleted ones do as well.
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
        self.last_place += 1;
        self.places.insert(submission.id, self.last_place);
        self.submissions.insert(submission.id, submission);
    }

    /// The submissions as they lie in the table, which is the order of a query that asks for none.
    pub fn table(&self) -> Vec<&Submission> {
        let mut rows: Vec<_> = self.submissions.values().collect();
        rows.sort_by_key(|row| self.places.get(&row.id));
        rows
    }

    /// Saves a submission as a new row: a new key, status submitted whatever it holds, the next number of its team in
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
        let row = self.submissions.get(&submission);
        let folder = row.and_then(|row| {
            let (challenge, phase) = self.phase(row.challenge_phase)?;
            Some(format!("challenge_{}/phase_{}/", challenge.id, phase.id))
        });
        let path = format!(
            "submission_files/{}submission_{submission}/{:08x}-0000-4000-8000-{:012x}.{extension}",
            folder.unwrap_or_default(),
            self.last_file,
            self.last_file
        );
        self.files.insert(path.clone(), content);
        path
    }

    /// Ends the life of every address of an input file that was handed out.
    pub fn expire_addresses(&mut self) {
        self.signature = Some(self.signature.unwrap_or_default() + 1);
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
        assert_eq!(name(Some("bearer local-host-token")), Ok(None));
        for (header, error) in [
            ("Bearer local-host-access-token", errors::ACCESS_TOKEN),
            ("Bearer local-late-token", errors::BAD_BEARER),
            ("Bearer ", errors::BAD_AUTHORIZATION_HEADER),
            ("Bearer local-host-token again", errors::BAD_AUTHORIZATION_HEADER),
            ("Token", errors::KEY_MISSING),
            ("Token a b", errors::KEY_WITH_SPACES),
            ("Bearer 0000000000000000000000000000000000000001", errors::BAD_BEARER),
            ("Token local-host-token", errors::INVALID_KEY),
            ("Token 0000000000000000000000000000000000000022", errors::INACTIVE_USER),
            ("Token 0000000000000000000000000000000000000023", errors::EXPIRED_KEY),
        ] {
            assert_eq!(name(Some(header)), Err(Reply::from(&error)), "{header}");
        }
    }
}
