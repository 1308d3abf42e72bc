//! `resume`: which submissions get a higher attempt, and the table that is shown before many of them do. Pure.

use clap::{ArgGroup, Args};
use jiff::Timestamp;
use kube::ResourceExt;
use leaderboard_api::{FailureClass, PlannedEvaluation, State, Submission};

use crate::change::Request;
use crate::cluster::Filter;
use crate::facts;
use crate::table::table;
use crate::text::{Frame, age, counted, wrap};

/// Which submissions.
#[derive(Args, Debug)]
#[allow(clippy::struct_excessive_bools, reason = "each is a flag of the command")]
#[command(group = ArgGroup::new("which").required(true).multiple(false).args(["names", "selector", "all"]))]
pub struct Resume {
    /// Names of submissions.
    #[arg(value_name = "NAME")]
    pub names: Vec<String>,
    /// Each Failed submission with these labels, such as `leaderboard.carla.org/phase=7`.
    #[arg(short = 'l', long, value_name = "LABELS")]
    pub selector: Option<String>,
    /// Each Failed submission of the namespace.
    #[arg(long)]
    pub all: bool,
    #[command(flatten)]
    pub filter: Filter,
    /// Only what nodes, network or storage have failed.
    #[arg(long, conflicts_with = "names")]
    pub infrastructure: bool,
    /// Only failures for these reasons, such as NodeLost,ImagePull.
    #[arg(long, value_delimiter = ',', value_name = "REASONS", conflicts_with = "names")]
    pub reason: Vec<String>,
    /// Choose live runs instead: each stores its results, stops, and goes on when its turn comes.
    #[arg(long, conflicts_with_all = ["infrastructure", "reason"])]
    pub restart: bool,
    /// Only print which ones.
    #[arg(long, conflicts_with = "names")]
    pub dry_run: bool,
    /// Do not ask.
    #[arg(short, long, conflicts_with = "names")]
    pub yes: bool,
    /// Wait for the end of each, and print each state until then.
    #[arg(long, conflicts_with_all = ["selector", "all"])]
    pub wait: bool,
}

impl Resume {
    /// The request to send for each submission.
    pub fn request(&self) -> Request {
        if self.restart {
            Request::Restart
        } else if self.names.len() == 1 {
            Request::Resume
        } else {
            Request::ResumeMany
        }
    }

    /// The command as a verb.
    pub fn verb(&self) -> &'static str {
        if self.restart { "restart" } else { "resume" }
    }

    /// The submissions that fit, by name. A check is made anew instead.
    pub fn chosen<'a>(&self, submissions: &'a [Submission]) -> Vec<&'a Submission> {
        let is_chosen = |one: &&Submission| {
            let fits = if self.restart {
                facts::is_run(one)
            } else {
                self.is_failure(one)
            };
            let is_going = one.metadata.deletion_timestamp.is_some() || facts::is_attempt_requested(one);
            fits && !is_going && !one.spec.check
        };
        let mut found: Vec<&Submission> = submissions.iter().filter(is_chosen).collect();
        found.sort_by_key(|one| one.name_any());
        found
    }

    fn is_failure(&self, one: &Submission) -> bool {
        let status = facts::status(one);
        let is_failed = status.known_state() == Some(State::Failed);
        status.failure.as_ref().filter(|_| is_failed).is_some_and(|failure| {
            let is_class = !self.infrastructure || failure.class == FailureClass::Infrastructure;
            is_class && (self.reason.is_empty() || self.reason.iter().any(|name| *name == failure.reason.as_str()))
        })
    }

    /// Lines for the case that none of `number` submissions fits.
    pub fn none(&self, number: usize, namespace: &str, frame: Frame) -> Vec<String> {
        let cause = if self.infrastructure {
            " because of the infrastructure"
        } else {
            ""
        };
        let reason = match self.reason.as_slice() {
            [] => String::new(),
            reasons => format!(" for {}", reasons.join(" or ")),
        };
        let what = if self.restart {
            "has a run to restart".to_owned()
        } else {
            format!("has failed{cause}{reason}")
        };
        let text = format!(
            "None of {} {what}. `kubectl leaderboard status -n {namespace}` lists all.",
            counted(number, "submission")
        );
        wrap(&text, frame.width)
    }
}

/// A table of the chosen submissions, with the class of each failure.
pub fn lines(chosen: &[&Submission], frame: Frame) -> Vec<String> {
    let rows: Vec<Vec<String>> = chosen.iter().map(|one| row(one, frame.now)).collect();
    let is_carlas = |one: &&Submission| matches!(evaluation(one), Some(PlannedEvaluation::Carla(_)));
    let image = if chosen.iter().any(is_carlas) {
        "SIMULATOR"
    } else {
        "EVALUATOR"
    };
    let head = ["NAME", "TEAM", "REASON", "CLASS", "SINCE", "NODE", image];
    table(&head, &rows, frame.width)
}

/// The table, and a sentence about the effect without `--dry-run`.
pub fn dry_run(verb: &str, chosen: &[&Submission], frame: Frame) -> Vec<String> {
    let mut lines = lines(chosen, frame);
    let number = counted(chosen.len(), "submission");
    lines.extend([
        String::new(),
        format!("Would {verb} {number}. Without --dry-run it does."),
    ]);
    lines
}

fn evaluation(one: &Submission) -> Option<&PlannedEvaluation> {
    facts::plan(one).map(|plan| &plan.evaluation)
}

fn row(one: &Submission, now: Timestamp) -> Vec<String> {
    let status = facts::status(one);
    let class = status.failure.as_ref().map_or("", |failure| failure.class.as_str());
    let image = evaluation(one).map(|evaluation| match evaluation {
        PlannedEvaluation::Carla(carla) => &carla.simulator_image,
        PlannedEvaluation::Container(container) => &container.image,
    });
    // The registry is the same for all, and the tag is what differs.
    let image = image.and_then(|image| image.rsplit('/').next());
    let reason = status.present_reason().map(|reason| reason.to_string());
    vec![
        one.name_any(),
        one.team_name().unwrap_or_default(),
        reason.unwrap_or_default(),
        class.to_owned(),
        facts::since(one).map(|at| age(at, now)).unwrap_or_default(),
        status.node_name.clone().unwrap_or_default(),
        image.unwrap_or_default().to_owned(),
    ]
}

/// Asks for a yes.
pub fn question(verb: &str, number: usize) -> String {
    let (first, rest) = verb.split_at(1);
    format!("{}{rest} {}?", first.to_uppercase(), counted(number, "submission"))
}

/// The sum after a line for each submission: how many were requested, and how many were refused.
pub fn summary(requested: usize, chosen: usize, namespace: &str, frame: Frame) -> Vec<String> {
    let refused = match chosen - requested {
        0 => String::new(),
        1 => " One was refused; its reason is above.".to_owned(),
        refused => format!(" {refused} were refused; the reasons are above."),
    };
    let text = format!(
        "Requested for {requested} of {}.{refused} To follow them: `kubectl leaderboard status -n {namespace}`.",
        counted(chosen, "submission")
    );
    wrap(&text, frame.width)
}
