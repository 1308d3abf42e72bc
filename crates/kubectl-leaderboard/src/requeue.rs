//! `requeue`: which of many submissions a host puts back in line at nobody's cost, and the table that is shown before. Pure.
//!
//! Unlike `rerun`, which resumes only what is not charged anyway, it takes whatever the host chooses: failures that are charged, and runs.

use std::collections::BTreeSet;

use clap::{ArgGroup, Args, ValueEnum};
use jiff::tz::TimeZone;
use jiff::{Span, Timestamp};
use kube::ResourceExt;
use leaderboard_api::{FailureClass, State, Submission, reasons};

use crate::facts;
use crate::table::table;
use crate::text::{Frame, span};

/// Which submissions, and why.
#[derive(Args, Debug)]
#[command(group = ArgGroup::new("which").required(true).multiple(false).args(["names", "selector", "all"]))]
pub struct Requeue {
    /// Names of submissions.
    #[arg(value_name = "NAME")]
    pub names: Vec<String>,
    /// Labels of the submissions, such as `leaderboard.carla.org/phase=7`.
    #[arg(short = 'l', long, value_name = "LABELS")]
    pub selector: Option<String>,
    /// Every submission of the namespace.
    #[arg(long)]
    pub all: bool,
    /// Only those in these states [default: failed; of names: any].
    #[arg(long, value_enum, value_delimiter = ',', value_name = "STATES")]
    state: Vec<Which>,
    /// Only failures of this class.
    #[arg(long, value_enum)]
    class: Option<Class>,
    /// Only failures for these reasons, such as AgentCrashed,Idle.
    #[arg(long, value_delimiter = ',', value_name = "REASONS")]
    reason: Vec<String>,
    /// Only those that ended since then: 2h, 3d, or 2026-11-22T18:00Z. Runs are not left out.
    #[arg(long, value_name = "TIME", value_parser = since)]
    since: Option<Since>,
    /// Only those that ran with this image of the simulator: the whole name, or its end behind a slash, such as simulator:0.9.15-3.
    #[arg(long, value_name = "IMAGE")]
    simulator: Option<String>,
    /// Only those whose last Pod was on this node.
    #[arg(long)]
    node: Option<String>,
    /// Why, for people: it is shown by `why`, in the status and in an event.
    #[arg(long, value_name = "TEXT", value_parser = why)]
    pub why: Option<String>,
    /// Only print which ones.
    #[arg(long)]
    pub dry_run: bool,
    /// Do not ask.
    #[arg(short, long)]
    pub yes: bool,
}

/// States that can be chosen.
#[derive(ValueEnum, Clone, Copy, Debug, PartialEq, Eq)]
enum Which {
    Failed,
    /// Those that a person has cancelled.
    Cancelled,
    /// Those with a Job: it is stopped, and continued later.
    Running,
}

#[derive(ValueEnum, Clone, Copy, Debug, PartialEq, Eq)]
enum Class {
    Participant,
    Infrastructure,
}

/// The beginning of a time.
#[derive(Clone, Debug)]
enum Since {
    Ago(Span),
    At(Timestamp),
}

impl Since {
    fn at(&self, now: Timestamp) -> Timestamp {
        match self {
            // A day has 24 h in UTC. What is before all times includes all.
            Self::Ago(span) => {
                let then = now.to_zoned(TimeZone::UTC).checked_sub(*span);
                then.map_or(Timestamp::MIN, |then| then.timestamp())
            }
            Self::At(time) => *time,
        }
    }
}

fn since(text: &str) -> Result<Since, String> {
    if let Ok(time) = text.parse::<Timestamp>() {
        return Ok(Since::At(time));
    }
    let span: Span = text
        .parse()
        .map_err(|_| "neither a time such as 2026-11-22T18:00Z nor a length such as 2h or 3d".to_owned())?;
    Ok(Since::Ago(span.abs()))
}

/// The API server takes no more.
fn why(text: &str) -> Result<String, String> {
    match text.chars().count() {
        1..=256 => Ok(text.to_owned()),
        _ => Err("give 1 to 256 characters".to_owned()),
    }
}

impl Requeue {
    /// Those of the submissions that are chosen and can be requeued, by name.
    pub fn chosen<'a>(&self, submissions: &'a [Submission], now: Timestamp) -> Vec<&'a Submission> {
        let names: BTreeSet<&str> = self.names.iter().map(String::as_str).collect();
        let is_named = |one: &Submission| names.is_empty() || names.contains(one.name_any().as_str());
        let mut found: Vec<&Submission> = submissions
            .iter()
            .filter(|one| is_named(one) && self.is_chosen(one, now))
            .collect();
        found.sort_by_key(|one| one.name_any());
        // A name that is given twice is one submission.
        found.dedup_by_key(|one| one.name_any());
        found
    }

    fn is_chosen(&self, one: &Submission, now: Timestamp) -> bool {
        let Some(which) = which(one) else { return false };
        let states = match self.state.as_slice() {
            [] if self.names.is_empty() => &[Which::Failed][..],
            states => states,
        };
        let status = one.status.as_ref();
        let failure = status.and_then(|status| status.failure.as_ref());
        let plan = status.and_then(|status| status.plan.as_ref());
        let class = self.class.map(|class| match class {
            Class::Participant => FailureClass::Participant,
            Class::Infrastructure => FailureClass::Infrastructure,
        });
        let ended = status.and_then(|status| status.times.finished.as_ref());
        let is_recent = |since: &Since| which == Which::Running || ended.is_some_and(|at| at.0 >= since.at(now));
        let is_of = |image: &String| plan.is_some_and(|plan| is_image(&plan.simulator_image, image));
        let is_on = |node: &String| status.and_then(|status| status.node_name.as_ref()) == Some(node);
        (states.is_empty() || states.contains(&which))
            && class.is_none_or(|class| failure.is_some_and(|failure| failure.class == class))
            && (self.reason.is_empty() || failure.is_some_and(|failure| self.reason.contains(&failure.reason)))
            && self.since.as_ref().is_none_or(is_recent)
            && self.simulator.as_ref().is_none_or(is_of)
            && self.node.as_ref().is_none_or(is_on)
    }
}

/// The state of one that can be requeued. Checks are made anew instead, and what has finished is run again as another submission.
fn which(one: &Submission) -> Option<Which> {
    let status = one.status.as_ref()?;
    let is_settled = one.spec.check
        || one.metadata.deletion_timestamp.is_some()
        || facts::is_attempt_requested(one)
        || facts::is_requeue_requested(one);
    if is_settled {
        return None;
    }
    match facts::state(status)? {
        State::Failed => Some(Which::Failed),
        State::Cancelled if status.reason.as_deref() == Some(reasons::CANCELLED) => Some(Which::Cancelled),
        State::Pending | State::Running | State::Resumed if status.job_name.is_some() => Some(Which::Running),
        State::Pending | State::Running | State::Resumed | State::Cancelled | State::Finished => None,
    }
}

fn is_image(image: &str, wanted: &str) -> bool {
    image == wanted || image.ends_with(&format!("/{wanted}"))
}

/// What is requeued, with what each has cost.
pub fn lines(chosen: &[&Submission], frame: Frame) -> Vec<String> {
    let rows: Vec<Vec<String>> = chosen.iter().map(|one| row(one, frame.now)).collect();
    let head = [
        "NAME",
        "TEAM",
        "STATE",
        "REASON",
        "CHARGED",
        "SINCE",
        "NODE",
        "SIMULATOR",
    ];
    table(&head, &rows, frame.width)
}

/// What `verb` would do.
pub fn dry_run(verb: &str, chosen: &[&Submission], frame: Frame) -> Vec<String> {
    let mut lines = lines(chosen, frame);
    let number = counted(chosen.len());
    lines.extend([
        String::new(),
        format!("Would {verb} {number}. Without --dry-run it does."),
    ]);
    lines
}

fn row(one: &Submission, now: Timestamp) -> Vec<String> {
    let status = one.status.as_ref();
    let failure = status.and_then(|status| status.failure.as_ref());
    let charged = failure.map_or("", |failure| match failure.class {
        FailureClass::Participant => "yes",
        FailureClass::Infrastructure => "no",
    });
    let plan = status.and_then(|status| status.plan.as_ref());
    // The registry is the same for all, and the tag is what differs.
    let simulator = plan.and_then(|plan| plan.simulator_image.rsplit('/').next());
    let since = facts::since(one).map(|at| span(now.duration_since(at).as_secs()));
    vec![
        one.name_any(),
        facts::team(one).unwrap_or_default(),
        status.and_then(facts::state).map_or("", State::as_str).to_owned(),
        status
            .and_then(|status| status.reason.as_deref())
            .unwrap_or_default()
            .to_owned(),
        charged.to_owned(),
        since.unwrap_or_default(),
        status.and_then(|status| status.node_name.clone()).unwrap_or_default(),
        simulator.unwrap_or_default().to_owned(),
    ]
}

/// What has become of all, after a line of each.
pub fn summary(requested: usize, chosen: usize, namespace: &str, frame: Frame) -> Vec<String> {
    let refused = match chosen - requested {
        0 => String::new(),
        1 => " One was refused; its reason is above.".to_owned(),
        refused => format!(" {refused} were refused; the reasons are above."),
    };
    let mut page = frame.page();
    page.paragraph(&format!(
        "Requested for {requested} of {}.{refused} To follow them: `kubectl leaderboard status -n {namespace}`.",
        counted(chosen)
    ));
    page.into_lines()
}

/// What is shown where nothing is chosen of so many submissions.
pub fn none(number: usize, namespace: &str, frame: Frame) -> Vec<String> {
    let what = match number {
        1 => "The submission does not fit".to_owned(),
        number => format!("None of {number} submissions fits"),
    };
    let mut page = frame.page();
    page.paragraph(&format!(
        "{what}. Runs are requeued if they are named or with --state running; what waits or has finished is not. \
         `kubectl leaderboard status -n {namespace}` lists all."
    ));
    page.into_lines()
}

/// `1 submission`, `38 submissions`.
pub fn counted(number: usize) -> String {
    match number {
        1 => "1 submission".to_owned(),
        number => format!("{number} submissions"),
    }
}
