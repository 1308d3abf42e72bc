//! Why one submission is in its state, and what to do next: from the objects to lines of text.
//!
//! Called by `main` for `why NAME`. Pure: knows no client, and the time is handed in. Meanings and next steps are those of
//! `leaderboard_api::reasons`.

mod next;

use jiff::Timestamp;
use kube::ResourceExt;
use serde_json::{Value, json};

use self::next::{next_steps, of_worker, verb};
use super::board::{self, Observed};
use super::bucket;
use super::facts::{self, class, command, has_ended, headline, is_attempt_requested, track};
use super::text::{Frame, Page, age, join, when};
use leaderboard_api::conditions::{self, Condition};
use leaderboard_api::names::FAILURE_LOG_KEY;
use leaderboard_api::reasons::Class;
use leaderboard_api::text::sentence;
use leaderboard_api::{
    Attempt, EndReason, FailureClass, LastEnd, Reason, ReasonName, Submission, SubmissionStatus, WorkerStatus, reasons,
};

/// The known facts of a submission, and the lines about it so far.
struct Explanation<'a> {
    submission: &'a Submission,
    status: &'a SubmissionStatus,
    leaderboard: Observed<'a>,
    now: Timestamp,
    page: Page,
    /// Next steps, which no other row repeats.
    steps: Vec<String>,
}

/// The explanation as JSON.
pub fn value(submission: &Submission, leaderboard: Observed<'_>) -> Value {
    let status = facts::status(submission);
    let problems = board::problems(&submission.spec.leaderboard_name, leaderboard);
    json!({
        "name": submission.name_any(),
        "namespace": submission.namespace(),
        "state": status.known_state(),
        "reason": status.reason,
        "meaning": status.reason.as_ref().map(meaning),
        "message": status.message,
        "failure": status.failure,
        "waiting": status.waiting,
        "leaderboardProblems": problems.into_iter().map(|(text, _)| text).collect::<Vec<_>>(),
        "nextSteps": next_steps(submission, leaderboard),
    })
}

/// All that is known of a submission.
pub fn explain(submission: &Submission, leaderboard: Observed<'_>, frame: Frame) -> Vec<String> {
    let mut explanation = Explanation {
        submission,
        status: facts::status(submission),
        leaderboard,
        now: frame.now,
        page: frame.page(),
        steps: next_steps(submission, leaderboard),
    };
    explanation.headline();
    explanation.page.gap();
    explanation.page.row("Track", &track(submission));
    explanation.reason();
    explanation.failure();
    explanation.line();
    explanation.attempt();
    explanation.run();
    explanation.systems();
    explanation.log();
    explanation.next();
    explanation.page.into_lines()
}

impl Explanation<'_> {
    fn headline(&mut self) {
        self.page.paragraph(&headline(self.submission, self.now));
        if let Some(at) = &self.submission.metadata.deletion_timestamp {
            let asked = when(at.0, self.now);
            self.page.paragraph(&format!(
                "It was deleted {asked}; the object is kept until every system has the result."
            ));
        }
        board::show_problems(&mut self.page, &self.submission.spec.leaderboard_name, self.leaderboard);
    }

    fn reason(&mut self) {
        let status = self.status;
        let stalled = conditions::get(&status.conditions, conditions::STALLED).filter(|c| c.is_true());
        let same = stalled.filter(|c| status.present_reason().as_ref() == Some(&c.reason));
        let since = same.map(|c| format!("Since {}.", when(c.last_transition_time.0, self.now)));
        let mut message = self.without_steps(status.message.as_deref().unwrap_or_default());
        if message.is_empty() {
            message = status.reason.as_ref().map(meaning).unwrap_or_default();
        }
        let text = facts::reason(status, &message);
        self.page.row("Reason", &join(&[&text, &since.unwrap_or_default()]));
        if let Some(other) = stalled.filter(|c| status.present_reason().as_ref() != Some(&c.reason)) {
            let since = when(other.last_transition_time.0, self.now);
            let text = format!("{} since {since}: {}", other.reason, sentence(&other.message));
            self.page.row("Stalled", &text);
        }
    }

    /// A message, without the next steps at its end.
    fn without_steps(&self, message: &str) -> String {
        let mut text = sentence(message);
        for step in &self.steps {
            if let Some(rest) = text.strip_suffix(step.as_str()) {
                text = rest.trim_end().to_owned();
            }
        }
        text
    }

    fn failure(&mut self) {
        let Some(failure) = &self.status.failure else { return };
        let worker = failure.worker.map(|worker| format!(" in worker {worker}"));
        let counts = match failure.class {
            FailureClass::Participant => "counts as an attempt",
            FailureClass::Infrastructure => "does not count as an attempt",
        };
        let text = format!("{}{}, {counts}.", class(failure.class), worker.unwrap_or_default());
        // While the run is being stopped, the reason above is that of the stop.
        if self.status.present_reason().as_ref() == Some(&failure.reason) {
            self.page.row("Class", &text);
        } else {
            self.page.row("Failure", &format!("{}: {text}", failure.reason));
        }
        if self.status.message.as_deref() != Some(failure.message.as_str()) {
            let message = self.without_steps(&failure.message);
            self.page.row("", &message);
        }
    }

    /// The position in the line, and the limits of the Leaderboard.
    fn line(&mut self) {
        if let Some(at) = &self.status.next_retry_time {
            let text = format!("the next Job is created {}.", when(at.0, self.now));
            self.page.row("Next try", &text);
        }
        let Some(waiting) = &self.status.waiting else { return };
        let board = self.leaderboard.leaderboard();
        let eta = match facts::eta(waiting) {
            Some(eta) => format!("starts in about {eta}"),
            None if board.is_some_and(|board| board.spec.paused) => {
                "no estimate while the Leaderboard is paused".to_owned()
            }
            None => "no estimate until runs of this track have ended".to_owned(),
        };
        let mut text = format!("position {}; {eta}.", waiting.position);
        if let Some(board) = board {
            let limits = board.spec.concurrency;
            let total = limits.total.map(|n| format!("concurrency.total is {n}"));
            let team = limits.per_team.map(|n| format!("concurrency.perTeam is {n}"));
            let facts: Vec<String> = [total, team].into_iter().flatten().collect();
            text = join(&[&text, &sentence(&facts.join(", "))]);
        }
        self.page.row("In line", &text);
    }

    fn attempt(&mut self) {
        let status = self.status;
        let Some(attempt) = status.attempt else { return };
        let mut parts = vec![attempt.to_string()];
        if status.retry > 0 {
            let of = self.leaderboard.leaderboard();
            let of = of.map(|l| format!(" of {}", l.spec.retries.infrastructure));
            let of = of.unwrap_or_default();
            parts.push(format!("{}{of} retries after infrastructure failures", status.retry));
        }
        if status.recreated > 0 {
            parts.push(format!("somebody else deleted its Job {} times", status.recreated));
        }
        if is_attempt_requested(self.submission) {
            let wanted = self.submission.spec.attempt;
            parts.push(format!("attempt {wanted} is requested and follows it"));
        }
        if self.submission.spec.cancel && !has_ended(self.submission) {
            parts.push("its cancellation is requested".to_owned());
        }
        if parts.len() > 1 || attempt > Attempt::FIRST {
            self.page.row("Attempt", &sentence(&parts.join("; ")));
        }
    }

    fn run(&mut self) {
        let status = self.status;
        let progress = status.progress.as_ref().map(|p| format!("{} {} done", p.text, p.unit));
        let score = status.score.as_ref().map(|score| {
            let so_far = if score.is_final { "" } else { " so far" };
            format!("{} {}{so_far}", score.name, score.text)
        });
        let parts: Vec<String> = [progress, score].into_iter().flatten().collect();
        self.page.row("Progress", &sentence(&parts.join(", ")));
        let failed = status.failure.as_ref().and_then(|failure| failure.worker);
        for worker in status.workers.iter().filter(|worker| worker.crashes > 0) {
            let text = crashes(worker, failed == Some(worker.id), self.now);
            self.page.row(&format!("Worker {}", worker.id), &text);
        }
        if !has_ended(self.submission) {
            let job = status.job_name.as_deref().unwrap_or_default();
            let node = status.node_name.as_ref().map(|node| format!("on node {node}"));
            self.page.row("Job", &join(&[job, &node.unwrap_or_default()]));
        }
        let results = status.results_url.as_deref().unwrap_or_default();
        self.page.whole("Results", results);
    }

    /// Which other systems have the result, and whether the scores can be trusted.
    fn systems(&mut self) {
        let logs = (conditions::LOGGED, "CloudWatch");
        let all = conditions::SYSTEMS.into_iter().chain([logs]);
        let all = all.filter_map(|(type_, system)| Some((system, conditions::get(&self.status.conditions, type_)?)));
        let (have, open): (Vec<_>, Vec<_>) = all.partition(|(_, condition)| condition.is_true());
        let (needless, open): (Vec<_>, Vec<_>) = open
            .into_iter()
            .partition(|(_, condition)| condition.reason == Reason::NotRequired);
        for (label, systems) in [("Delivered", have), ("Not needed", needless)] {
            let names: Vec<&str> = systems.into_iter().map(|(system, _)| system).collect();
            self.page.row(label, &sentence(&names.join(", ")));
        }
        for (system, condition) in open {
            self.page.row(system, &system_text(condition, system, self.now));
        }
        let plausible = conditions::get(&self.status.conditions, conditions::PLAUSIBLE);
        if let Some(doubt) = plausible.filter(|c| c.status == "False") {
            let text = format!("{}: {}", doubt.reason, sentence(&doubt.message));
            self.page.row("Scores", &text);
        }
    }

    /// Where the log of a failure is. It may reveal private data, so it is not shown: only who may read the bucket can read it.
    fn log(&mut self) {
        let Some(failure) = self.status.failure.as_ref().filter(|_| has_ended(self.submission)) else {
            return;
        };
        // Without an agent, no log is the participant's.
        let has_agent = facts::has_agent(self.status.plan.as_ref());
        let is_shown = |reason: &Reason| has_agent || reason.class() != Class::Participant;
        let log = failure.reason.known().filter(is_shown).and_then(Reason::log);
        let Some((log, results)) = log.zip(self.status.results_url.as_ref()) else {
            return;
        };
        let log = of_worker(log, failure.worker);
        let file = log.rsplit(", ").next().unwrap_or_default();
        // The next step may name it.
        let log = if self.steps.iter().any(|step| step.contains(file)) {
            "it"
        } else {
            &log
        };
        let text = format!("the last 10,000 characters of {log}. Hosts only: it may reveal private data.");
        self.page.row("Log", &text);
        let object = format!("{results}/{FAILURE_LOG_KEY}");
        let command = bucket::print(&object, facts::storage(self.submission));
        self.page.whole("", &command);
    }

    fn next(&mut self) {
        self.page.gap();
        let mut label = "Next";
        for text in &self.steps {
            self.page.row(label, text);
            label = "";
        }
        if let Some(verb) = verb(self.submission) {
            self.page.whole(label, &command(verb, self.submission));
        }
    }
}

pub(super) fn meaning(reason: &ReasonName) -> String {
    let known = reason.known();
    known.map_or_else(String::new, |reason| reasons::plain(reason.meaning()))
}

/// How a worker crashed. The count is left out beside a failure, whose message has the count at which the worker failed. Its containers
/// may end once more before the Job is gone.
fn crashes(worker: &WorkerStatus, is_failed: bool, now: Timestamp) -> String {
    let times = match worker.crashes {
        _ if is_failed => String::new(),
        1 => ", crashed once".to_owned(),
        count => format!(", crashed {count} times"),
    };
    let is_known = |last: &&LastEnd| ![EndReason::Unseen, EndReason::Unknown].contains(&last.reason);
    let known = worker.last.as_deref().filter(is_known);
    let last = known.map(|last| {
        let code = last.exit_code.map(|code| format!(" (exit code {code})"));
        let ago = last.time.as_ref().map(|time| format!(", {} ago", age(time.0, now)));
        let (code, ago) = (code.unwrap_or_default(), ago.unwrap_or_default());
        format!("; last end: {}{code}{ago}", last.reason)
    });
    let last = last.unwrap_or_default();
    format!("{} of {} done{times}{last}.", worker.done, worker.total)
}

fn system_text(condition: &Condition, system: &str, now: Timestamp) -> String {
    let meaning = meaning(&condition.reason).replacen("The other system", system, 1);
    let since = if condition.is_true() || condition.reason.is_one_of(&[Reason::NotRequired, Reason::Superseded]) {
        String::new()
    } else {
        format!("Since {}.", when(condition.last_transition_time.0, now))
    };
    let message = sentence(&condition.message);
    join(&[&format!("{}:", condition.reason), &meaning, &message, &since])
}
