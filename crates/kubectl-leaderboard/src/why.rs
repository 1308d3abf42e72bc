//! Why one submission is in its state, and what to do next: from what the API server has to lines of text.
//!
//! Called by `mod` for `why NAME`. Pure: knows no client, and the time is handed in. What it says of a reason is `steps`'.

use jiff::Timestamp;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::{Condition, Time};
use kube::ResourceExt;

use super::board::{self, Sight};
use super::steps;
use super::text::{Page, join, span, when};
use leaderboard_api::conditions;
use leaderboard_api::names::FAILURE_LOG_KEY;
use leaderboard_api::text::sentence;
use leaderboard_api::{Failure, FailureClass, PairStatus, Rerun, State, Submission, SubmissionStatus, reasons};

/// What is known, and what is said of it so far.
struct Story<'a> {
    submission: &'a Submission,
    status: &'a SubmissionStatus,
    leaderboard: Sight<'a>,
    now: Timestamp,
    page: Page,
}

/// All that there is to say of a submission.
pub fn explain(submission: &Submission, leaderboard: Sight<'_>, now: Timestamp) -> Vec<String> {
    let unseen = SubmissionStatus::default();
    let mut story = Story {
        submission,
        status: submission.status.as_ref().unwrap_or(&unseen),
        leaderboard,
        now,
        page: Page::default(),
    };
    story.headline();
    story.page.gap();
    story.belongs_to();
    story.reason();
    story.rerun();
    story.failure();
    story.line();
    story.attempt();
    story.run();
    story.systems();
    story.log();
    story.next();
    story.page.into_lines()
}

/// Since when a submission is in its state.
pub(super) fn since(submission: &Submission) -> Option<Timestamp> {
    let status = submission.status.as_ref()?;
    let moved = |type_: &str, truth: &str| {
        let found = conditions::get(&status.conditions, type_).filter(|c| c.status == truth);
        found.map(|c| c.last_transition_time.0)
    };
    let time = |time: &Option<Time>| time.as_ref().map(|t| t.0);
    let times = &status.times;
    let found = match status.state? {
        State::Finished | State::Failed | State::Cancelled => {
            time(&times.finished).or_else(|| moved(conditions::FINISHED, "True"))
        }
        State::Running | State::Resumed if times.stopping.is_some() => time(&times.stopping),
        State::Running | State::Resumed => moved(conditions::RUNNING, "True")
            .or_else(|| moved(conditions::RUNNING, "False"))
            .or_else(|| time(&times.started)),
        // The attempt begins with this condition.
        State::Pending => moved(conditions::FINISHED, "False").or_else(|| time(&times.accepted)),
    };
    found.or_else(|| submission.creation_timestamp().map(|t| t.0))
}

/// Whether an attempt has come to its end and no higher one is wished.
pub(super) fn has_ended(submission: &Submission) -> bool {
    let status = submission.status.as_ref();
    status.is_some_and(|s| conditions::is_true(&s.conditions, conditions::FINISHED)) && !is_attempt_wished(submission)
}

/// Whether a higher attempt is wished than the operator has begun.
pub(super) fn is_attempt_wished(submission: &Submission) -> bool {
    let begun = submission.status.as_ref().and_then(|s| s.attempt);
    begun.is_some_and(|begun| submission.spec.attempt > begun)
}

/// A command of this plugin for a submission, as a person types it.
pub(super) fn command(verb: &str, submission: &Submission) -> String {
    let namespace = submission.namespace().map(|n| format!(" -n {n}")).unwrap_or_default();
    format!("kubectl leaderboard {verb} {}{namespace}", submission.name_any())
}

/// The class of a failure, and whether it is charged.
pub(super) fn class(failure: &Failure) -> &'static str {
    match (failure.class, failure.charged) {
        (FailureClass::Participant, true) => "the participant's, charged",
        (FailureClass::Participant, false) => "the participant's, not charged",
        (FailureClass::Infrastructure, true) => "the infrastructure's, charged",
        (FailureClass::Infrastructure, false) => "the infrastructure's, not charged",
    }
}

impl Story<'_> {
    fn headline(&mut self) {
        let name = self.submission.name_any();
        let since = since(self.submission).map(|at| when(at, self.now));
        let made = self.submission.creation_timestamp().map(|t| when(t.0, self.now));
        let words = match (self.status.state, since) {
            (Some(state), Some(since)) => format!("{name} is {} since {since}.", state.as_str()),
            (Some(state), None) => format!("{name} is {}.", state.as_str()),
            (None, _) => {
                let made = made.map(|made| format!(", made {made}")).unwrap_or_default();
                format!("{name} is new{made}: the operator has not looked at it yet.")
            }
        };
        self.page.say(&words);
        if let Some(at) = &self.submission.metadata.deletion_timestamp {
            let asked = when(at.0, self.now);
            self.page.say(&format!(
                "It was deleted {asked}; it goes when every system has its end."
            ));
        }
        for trouble in board::troubles(&self.submission.spec.leaderboard_name, self.leaderboard) {
            self.page.say(&trouble.words);
        }
    }

    fn belongs_to(&mut self) {
        let spec = &self.submission.spec;
        let track = self.status.track.as_deref().or(spec.track.as_deref());
        let team = self.status.team.as_ref().or(spec.team.as_ref());
        let team = team.and_then(|team| team.name.as_deref().or(team.id.as_deref()));
        let mut words = match track {
            Some(track) => format!("{track} of Leaderboard {}", spec.leaderboard_name),
            None => format!("not known yet, of Leaderboard {}", spec.leaderboard_name),
        };
        if let Some(team) = team {
            words = format!("{words}, by {team}");
        }
        if let Some(evalai) = spec.evalai {
            words = format!(
                "{words}; submission {} of phase {} in EvalAI",
                evalai.submission, evalai.phase
            );
        }
        self.page.row("Track", &words);
    }

    fn reason(&mut self) {
        let Some(reason) = &self.status.reason else { return };
        let stalled = conditions::get(&self.status.conditions, conditions::STALLED).filter(|c| c.status == "True");
        let same = stalled.filter(|c| c.reason == *reason);
        let since = same.map(|c| format!("Since {}.", when(c.last_transition_time.0, self.now)));
        let words = [
            &format!("{reason}:"),
            &steps::meaning(reason),
            &since.unwrap_or_default(),
        ];
        self.page.row("Reason", &join(&words.map(String::as_str)));
        self.page
            .row("Message", self.status.message.as_deref().unwrap_or_default());
        if let Some(other) = stalled.filter(|c| c.reason != *reason) {
            let since = when(other.last_transition_time.0, self.now);
            let words = format!("{} since {since}: {}", other.reason, sentence(&other.message));
            self.page.row("Stalled", &words);
        }
    }

    /// The other submission of a re-run in EvalAI.
    fn rerun(&mut self) {
        let ago = |rerun: &Rerun| {
            let time = rerun.time.as_ref().map(|time| when(time.0, self.now));
            time.map(|time| format!(", {time}")).unwrap_or_default()
        };
        let of = self.status.rerun_of.as_ref();
        let of = of.map(|rerun| format!("of {}{}.", rerun.submission_name, ago(rerun)));
        let again = self.status.rerun_as.as_ref();
        let again = again.map(|rerun| {
            let name = &rerun.submission_name;
            format!("as {name}{}; EvalAI has cancelled this one.", ago(rerun))
        });
        for words in [of, again].into_iter().flatten() {
            self.page.row("Re-run", &words);
        }
    }

    fn failure(&mut self) {
        let Some(failure) = &self.status.failure else { return };
        let pair = failure.pair.map(|pair| format!(", in pair {pair}")).unwrap_or_default();
        let words = format!("{}, {}{pair}.", failure.reason, class(failure));
        self.page.row("Failure", &words);
        // While it is being stopped the message above speaks of the stop.
        if self.status.message.as_deref() != Some(failure.message.as_str()) {
            self.page.row("", &failure.message);
        }
    }

    /// The place in line, and what the Leaderboard lets run at once.
    fn line(&mut self) {
        if let Some(at) = &self.status.next_retry_time {
            let words = format!("its next Job is made {}.", when(at.0, self.now));
            self.page.row("Next try", &words);
        }
        let Some(waiting) = &self.status.waiting else { return };
        let eta = match &waiting.eta {
            Some(eta) => format!("it starts in about {eta}"),
            None if self.leaderboard.is_paused() => "no estimate while the Leaderboard is paused".to_owned(),
            None => "no estimate until runs of this track have ended".to_owned(),
        };
        let mut words = format!("place {}; {eta}.", waiting.position);
        if let Some(leaderboard) = self.leaderboard.leaderboard() {
            let counts = leaderboard.status.as_ref().and_then(|s| s.counts);
            let concurrency = leaderboard.spec.concurrency;
            let now = counts.map(|c| format!("{} run, {} wait", c.running, c.pending));
            let total = concurrency.total.map(|n| format!("concurrency.total is {n}"));
            let team = concurrency.per_team.map(|n| format!("concurrency.perTeam is {n}"));
            let facts: Vec<String> = [now, total, team].into_iter().flatten().collect();
            words = join(&[&words, &sentence(&facts.join(", "))]);
        }
        self.page.row("In line", &words);
    }

    fn attempt(&mut self) {
        let status = self.status;
        let Some(attempt) = status.attempt else { return };
        let mut words = attempt.to_string();
        if status.retry > 0 {
            let of = self.leaderboard.leaderboard();
            let of = of.map(|l| format!(" of {}", l.spec.retries.infrastructure));
            words = format!(
                "{words}; {}{} retries after failures of the infrastructure, which cost nothing",
                status.retry,
                of.unwrap_or_default()
            );
        }
        if status.recreated > 0 {
            words = format!(
                "{words}; its Job was deleted by somebody else {} times",
                status.recreated
            );
        }
        if is_attempt_wished(self.submission) {
            let wanted = self.submission.spec.attempt;
            words = format!("{words}; attempt {wanted} is wished and begins when the operator takes it up");
        }
        if self.submission.spec.cancel && !has_ended(self.submission) {
            words = format!("{words}; it is to be cancelled");
        }
        self.page.row("Attempt", &sentence(&words));
    }

    fn run(&mut self) {
        let status = self.status;
        let progress = status.progress.as_ref().map(|p| format!("{} done", p.text));
        let score = status.score.as_ref().map(|score| {
            let so_far = if score.starts_with('~') { " so far" } else { "" };
            format!("driving score {score}{so_far}")
        });
        let parts: Vec<String> = [progress, score].into_iter().flatten().collect();
        self.page.row("Routes", &sentence(&parts.join(", ")));
        for pair in status.pairs.iter().filter(|pair| pair.crashes > 0) {
            let words = crashes(pair, self.now);
            self.page.row(&format!("Pair {}", pair.id), &words);
        }
        if !has_ended(self.submission) {
            let job = status.job_name.as_deref().unwrap_or_default();
            let node = status.node_name.as_ref().map(|node| format!("on node {node}"));
            self.page.row("Job", &join(&[job, &node.unwrap_or_default()]));
        }
        if let Some(results) = &status.results_url {
            self.page.whole("Results", results);
        }
    }

    /// What the other systems know of the end, and whether the scores are to be trusted.
    fn systems(&mut self) {
        let systems = [
            (conditions::ARCHIVED, "S3"),
            (conditions::PUBLISHED, "EvalAI"),
            (conditions::RECORDED, "DynamoDB"),
        ];
        for (type_, system) in systems {
            if let Some(condition) = conditions::get(&self.status.conditions, type_) {
                self.page.row(system, &system_words(condition, system, self.now));
            }
        }
        let plausible = conditions::get(&self.status.conditions, conditions::PLAUSIBLE);
        if let Some(doubt) = plausible.filter(|c| c.status == "False") {
            let words = format!("{}: {}", doubt.reason, sentence(&doubt.message));
            self.page.row("Scores", &words);
        }
    }

    /// Where the log of a failure is. It may hold private routes, so it is read by those alone who may read the bucket.
    fn log(&mut self) {
        let Some(failure) = self.status.failure.as_ref().filter(|_| has_ended(self.submission)) else {
            return;
        };
        let (Some(whose), Some(results)) = (steps::log_of(&failure.reason), &self.status.results_url) else {
            return self
                .page
                .row("Log", "none explains it: the message says what is known.");
        };
        let whose = of_pair(&whose, failure.pair);
        let words = format!("{} For hosts alone, since it may show the routes:", sentence(&whose));
        self.page.row("Log", &words);
        let storage = self.status.plan.as_ref().map(|plan| &plan.storage);
        let flag = |name: &str, value: Option<&String>| value.map(|v| format!(" {name} {v}")).unwrap_or_default();
        let region = flag("--region", storage.and_then(|s| s.region.as_ref()));
        let endpoint = flag("--endpoint-url", storage.and_then(|s| s.endpoint.as_ref()));
        let command = format!("aws s3 cp {results}/{FAILURE_LOG_KEY} -{region}{endpoint}");
        self.page.whole("", &command);
    }

    fn next(&mut self) {
        self.page.gap();
        let mut label = "Next";
        for words in next_steps(self.submission, self.status, self.leaderboard) {
            self.page.row(label, &words);
            label = "";
        }
        if let Some(verb) = verb(self.submission, self.status) {
            self.page.whole(label, &command(verb, self.submission));
        }
    }
}

/// Words of the documentation about the pair that failed.
fn of_pair(words: &str, pair: Option<i32>) -> String {
    let Some(pair) = pair else { return words.to_owned() };
    let number = pair.to_string();
    words
        .replace("failure.pair", &format!("pair {number}"))
        .replace("<n>", &number)
}

fn crashes(pair: &PairStatus, now: Timestamp) -> String {
    let times = if pair.crashes == 1 {
        "crashed once".to_owned()
    } else {
        format!("crashed {} times", pair.crashes)
    };
    let last = pair.last.as_ref().map(|last| {
        let code = last.exit_code.map(|code| format!(" (exit code {code})"));
        let ago = last.time.as_ref().map(|time| {
            let seconds = now.duration_since(time.0).as_secs();
            format!(", {} ago", span(seconds))
        });
        let (code, ago) = (code.unwrap_or_default(), ago.unwrap_or_default());
        format!("; the last end: {}{code}{ago}", last.reason)
    });
    let last = last.unwrap_or_default();
    format!("{} of {} routes, {times}{last}.", pair.done, pair.total)
}

fn system_words(condition: &Condition, system: &str, now: Timestamp) -> String {
    let meaning = steps::meaning(&condition.reason).replacen("The other system", system, 1);
    let since = match (condition.status.as_str(), condition.reason.as_str()) {
        ("True", _) | (_, reasons::NOT_REQUIRED) => String::new(),
        _ => format!("Since {}.", when(condition.last_transition_time.0, now)),
    };
    let message = sentence(&condition.message);
    join(&[&format!("{}:", condition.reason), &meaning, &message, &since])
}

/// What to do next, the reason's step first.
fn next_steps(submission: &Submission, status: &SubmissionStatus, leaderboard: Sight<'_>) -> Vec<String> {
    let mut reasons: Vec<&str> = status.reason.as_deref().into_iter().collect();
    // While it is being stopped the reason speaks of the stop.
    reasons.extend(status.failure.as_ref().map(|failure| failure.reason.as_str()));
    let doubt = conditions::get(&status.conditions, conditions::PLAUSIBLE).filter(|c| c.status == "False");
    reasons.extend(doubt.map(|c| c.reason.as_str()));
    let troubles = if has_ended(submission) {
        Vec::new()
    } else {
        board::troubles(&submission.spec.leaderboard_name, leaderboard)
    };
    reasons.extend(troubles.iter().filter_map(|trouble| trouble.reason.as_deref()));
    let pair = status.failure.as_ref().and_then(|failure| failure.pair);
    let mut steps: Vec<String> = Vec::new();
    let of_failure = |reason: &str| after_failure(submission, status, reason);
    let next = |reason| of_failure(reason).or_else(|| steps::of(reason).map(|step| step.next));
    for next in reasons.into_iter().filter_map(next).map(|next| of_pair(&next, pair)) {
        if !steps.contains(&next) {
            steps.push(next);
        }
    }
    if status.state.is_none() && troubles.is_empty() {
        steps.push("Nothing; if it lasts for a minute, look whether the operator runs.".to_owned());
    }
    steps
}

/// The next step of a failure whose reason is also one of a wait, of which the documentation's row speaks.
fn after_failure(submission: &Submission, status: &SubmissionStatus, reason: &str) -> Option<String> {
    const BOTH: [&str; 2] = [reasons::NOT_ISOLATED, reasons::PHASE_DIFFERS];
    status
        .failure
        .as_ref()
        .filter(|failure| failure.reason == reason && BOTH.contains(&reason))?;
    let then = if has_ended(submission) { ", then resume it" } else { "" };
    Some(format!("Do what the message says{then}."))
}

/// The command of this plugin that carries the next step out.
fn verb(submission: &Submission, status: &SubmissionStatus) -> Option<&'static str> {
    if submission.metadata.deletion_timestamp.is_some() {
        return None;
    }
    let reason = status.reason.as_deref().unwrap_or_default();
    if has_ended(submission) {
        let is_infrastructure = |f: &Failure| f.class == FailureClass::Infrastructure;
        let is_mendable = status.failure.as_ref().is_some_and(is_infrastructure);
        return (is_mendable || reason == reasons::CANCELLED).then_some("resume");
    }
    [reasons::TRACK_NOT_FOUND, reasons::IMAGE_MISSING, reasons::PHASE_DIFFERS]
        .contains(&reason)
        .then_some("cancel")
}
