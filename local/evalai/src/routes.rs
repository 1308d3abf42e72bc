//! The API's paths, slashes and all. Pure: a path gives an endpoint, a redirect or nothing.

/// One endpoint with the keys in its path.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Endpoint {
    /// `accounts/user/get_auth_token`
    AuthToken,
    /// `accounts/user/refresh_auth_token`
    RenewToken,
    /// `jobs/submission/{pk}`
    Submission(u64),
    /// `jobs/submission/{pk}/update_started_at/`
    StartedAt(u64),
    /// `jobs/submissions/{pk}/re-run/`
    Rerun(u64),
    /// `jobs/submissions/{pk}/resume/`
    Resume(u64),
    /// `jobs/challenge/{c}/update_submission/`
    Update(u64),
    /// `jobs/challenges/{c}/update_partially_evaluated_submission/`
    Partial(u64),
    /// `jobs/challenges/{c}/submissions/{pk}/update_submission_meta/`
    Meta(u64, u64),
    /// `jobs/challenge/{c}/submission/`
    List(u64),
    /// `jobs/challenge/{c}/challenge_phase/{p}/submission/`
    Submit(u64, u64),
    /// `jobs/challenge/queues/{queue}/`
    QueueReceive(String),
    /// `jobs/queues/{queue}/`
    QueueDelete(String),
    /// `jobs/leaderboard_data/{pk}/`
    Row(u64),
    /// `jobs/phases/{p}/submission_count_by_status/`
    CountByStatus(u64),
    /// `jobs/challenge_phase_split/{s}/leaderboard/`
    Leaderboard(u64),
    /// `challenges/challenge/queues/{queue}/`
    ChallengeOfQueue(String),
    /// `challenges/challenge/{c}/`
    Challenge(u64),
    /// `challenges/challenge/{c}/challenge_phase/{p}`
    Phase(u64, u64),
    /// `challenges/{c}/phases/`
    Phases(u64),
    /// `challenges/{c}/challenge_phase_split`
    Splits(u64),
    /// `challenges/challenge/create/dataset_split/{d}/`
    DatasetSplit(u64),
    /// `challenges/challenge/create/challenge_phase_split/{s}/`
    PhaseSplit(u64),
}

impl Endpoint {
    /// The methods it takes.
    pub fn methods(&self) -> &'static [&'static str] {
        match self {
            Self::Submission(_) => &["GET", "DELETE"],
            Self::StartedAt(_) | Self::Meta(..) | Self::Row(_) => &["PATCH"],
            Self::Rerun(_) | Self::Resume(_) | Self::QueueDelete(_) => &["POST"],
            Self::Update(_) | Self::Partial(_) => &["PUT", "PATCH"],
            Self::Submit(..) => &["GET", "POST"],
            _ => &["GET"],
        }
    }

    /// May be read without signing in.
    pub fn is_public(&self) -> bool {
        matches!(
            self,
            Self::Leaderboard(_) | Self::Challenge(_) | Self::Phase(..) | Self::Splits(_) | Self::PhaseSplit(_)
        )
    }

    /// A user who signs in must have a confirmed e-mail address.
    pub fn wants_email(&self) -> bool {
        !matches!(self, Self::Leaderboard(_) | Self::Challenge(_) | Self::Splits(_))
    }

    /// Counts against the user's requests a minute.
    pub fn counts(&self) -> bool {
        !matches!(self, Self::Challenge(_) | Self::Splits(_))
    }
}

/// The target of a path.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Found {
    /// An endpoint.
    Endpoint(Endpoint),
    /// The path with the slash it lacks: a 301, on which clients drop the body.
    Redirect(String),
    /// Nothing.
    Nothing,
}

/// Finds the endpoint of a path.
pub fn find(path: &str) -> Found {
    let Some(rest) = path.strip_prefix("/api/") else {
        return Found::Nothing;
    };
    if let Some(endpoint) = endpoint(rest) {
        return Found::Endpoint(endpoint);
    }
    if !rest.ends_with('/') && endpoint(&format!("{rest}/")).is_some() {
        return Found::Redirect(format!("{path}/"));
    }
    Found::Nothing
}

fn endpoint(path: &str) -> Option<Endpoint> {
    let parts: Vec<&str> = path.split('/').collect();
    Some(match parts.as_slice() {
        ["accounts", "user", "get_auth_token"] => Endpoint::AuthToken,
        ["accounts", "user", "refresh_auth_token"] => Endpoint::RenewToken,
        ["jobs", "submission", pk] => Endpoint::Submission(key(pk)?),
        ["jobs", "submission", pk, "update_started_at", ""] => Endpoint::StartedAt(key(pk)?),
        ["jobs", "submissions", pk, "re-run", ""] => Endpoint::Rerun(key(pk)?),
        ["jobs", "submissions", pk, "resume", ""] => Endpoint::Resume(key(pk)?),
        ["jobs", "challenge", c, "update_submission", ""] => Endpoint::Update(key(c)?),
        ["jobs", "challenges", c, "update_partially_evaluated_submission", ""] => Endpoint::Partial(key(c)?),
        ["jobs", "challenges", c, "submissions", pk, "update_submission_meta", ""] => Endpoint::Meta(key(c)?, key(pk)?),
        ["jobs", "challenge", c, "submission", ""] => Endpoint::List(key(c)?),
        ["jobs", "challenge", c, "challenge_phase", p, "submission", ""] => Endpoint::Submit(key(c)?, key(p)?),
        ["jobs", "challenge", "queues", queue, ""] => Endpoint::QueueReceive(name(queue)?),
        ["jobs", "queues", queue, ""] => Endpoint::QueueDelete(name(queue)?),
        ["jobs", "leaderboard_data", pk, ""] => Endpoint::Row(key(pk)?),
        ["jobs", "phases", p, "submission_count_by_status", ""] => Endpoint::CountByStatus(key(p)?),
        ["jobs", "challenge_phase_split", s, "leaderboard", ""] => Endpoint::Leaderboard(key(s)?),
        ["challenges", "challenge", "queues", queue, ""] => Endpoint::ChallengeOfQueue(name(queue)?),
        ["challenges", "challenge", "create", "dataset_split", d, ""] => Endpoint::DatasetSplit(key(d)?),
        ["challenges", "challenge", "create", "challenge_phase_split", s, ""] => Endpoint::PhaseSplit(key(s)?),
        ["challenges", "challenge", c, ""] => Endpoint::Challenge(key(c)?),
        ["challenges", "challenge", c, "challenge_phase", p] => Endpoint::Phase(key(c)?, key(p)?),
        ["challenges", c, "phases", ""] => Endpoint::Phases(key(c)?),
        ["challenges", c, "challenge_phase_split"] => Endpoint::Splits(key(c)?),
        _ => return None,
    })
}

fn key(text: &str) -> Option<u64> {
    let digits = !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit());
    // A key too large for the database is a path all the same, and no row has it.
    digits.then(|| text.parse().unwrap_or(u64::MAX))
}

fn name(text: &str) -> Option<String> {
    let is_allowed = |char: char| char.is_alphanumeric() || matches!(char, '_' | '.' | '-');
    (!text.is_empty() && text.chars().all(is_allowed)).then(|| text.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slashes_are_exact() {
        let slash = |path: &str| Found::Redirect(format!("{path}/"));
        for (path, found) in [
            ("/api/jobs/submission/1", Found::Endpoint(Endpoint::Submission(1))),
            ("/api/jobs/submission/1/", Found::Nothing),
            ("/api/jobs/submission/x", Found::Nothing),
            ("/api/jobs/submission/+1", Found::Nothing),
            (
                "/api/jobs/submission/99999999999999999999",
                Found::Endpoint(Endpoint::Submission(u64::MAX)),
            ),
            (
                "/api/jobs/challenge/1/update_submission/",
                Found::Endpoint(Endpoint::Update(1)),
            ),
            (
                "/api/jobs/challenge/1/update_submission",
                slash("/api/jobs/challenge/1/update_submission"),
            ),
            (
                "/api/jobs/challenges/1/update_partially_evaluated_submission/",
                Found::Endpoint(Endpoint::Partial(1)),
            ),
            (
                "/api/jobs/challenge/1/update_partially_evaluated_submission/",
                Found::Nothing,
            ),
            (
                "/api/challenges/1/challenge_phase_split",
                Found::Endpoint(Endpoint::Splits(1)),
            ),
            ("/api/challenges/1/challenge_phase_split/", Found::Nothing),
            (
                "/api/challenges/challenge/1/challenge_phase/2",
                Found::Endpoint(Endpoint::Phase(1, 2)),
            ),
            (
                "/api/jobs/queues/a.fifo/",
                Found::Endpoint(Endpoint::QueueDelete("a.fifo".to_owned())),
            ),
            ("/jobs/submission/1", Found::Nothing),
        ] {
            assert_eq!(find(path), found, "{path}");
        }
    }
}
