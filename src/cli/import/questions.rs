//! What a person still has to decide after an import: what no entry holds, and no decision sets. Pure.

use jiff::Timestamp;

use super::decisions::Decisions;
use super::entries::{BoardEntry, EVALAI, Entries};
use super::options::Options;
use crate::services::token::WARN_BEFORE;

const NO_ROLE: &str = "podIdentity: the role that may write to bucket and log group (--role-arn); without it the Pods have no \
                       credentials of their own";
const NO_EGRESS: &str = "network.egress: the addresses of the VPC's interface endpoints of S3, STS and CloudWatch Logs (--egress, each as \
                         address/32); where policies are enforced, nothing is stored without them";
const NO_TAINTS: &str = "tracks[].tolerations: do the GPU nodes have a taint (--taint)? The original's had none; with one that is not \
                         tolerated submissions stay Unschedulable";
const NO_DEAD_LETTERS: &str = "queue.deadLetterURL: a queue for messages that cannot be used (--dead-letter); the original had none, and \
                               without one they stay in the queue until it drops them";
/// Left out where the cluster shows that no program collects logs.
pub(super) const FLUENTD: &str = "logGroup: does the original's FluentD run on these nodes? Then each line is stored twice: leave logGroup out, or take \
                       the namespace out of FluentD's source (docs/migrate.md, Logs twice)";

/// What no entry holds, and the fields that answer it.
const ALWAYS: [(&[&str], &str); 4] = [
    (
        &["tracks[].nodeSelector"],
        "tracks[].nodeSelector: is g5.12xlarge still the instance type of the GPU nodes?",
    ),
    (
        &["concurrency"],
        "concurrency: how many submissions may run at once, in all and of one team",
    ),
    (
        &["simulator.resources", "agent.resources"],
        "resources: CPU, memory and disk of simulators and agents; the original requested one GPU and nothing else",
    ),
    (
        &["deadlines.runSeconds"],
        "deadlines.runSeconds: how long a run may take; 0 is no limit, as in the original",
    ),
];

/// Before the name of a field of each track.
const OF_TRACKS: &str = "tracks[].";

/// A question, and the fields that answer it.
struct Question {
    fields: Vec<&'static str>,
    text: String,
}

impl Question {
    fn new(field: &'static str, text: impl Into<String>) -> Self {
        Self {
            fields: vec![field],
            text: text.into(),
        }
    }

    fn is_decided(&self, board: &BoardEntry, decisions: &Decisions) -> bool {
        let is_set = |field: &&str| match field.strip_prefix(OF_TRACKS) {
            Some(field) => {
                let names: Vec<_> = board.tracks.iter().map(|track| board.track_name(track)).collect();
                decisions.set_tracks(board.board, field, names.iter().map(String::as_str))
            }
            None => decisions.set(board.board, field),
        };
        !self.fields.is_empty() && self.fields.iter().all(is_set)
    }
}

/// The questions that no decision answers for every Leaderboard.
pub(super) fn open(entries: &Entries, options: &Options, decisions: &Decisions, now: Timestamp) -> Vec<String> {
    let is_open = |question: &Question| !entries.boards.iter().all(|board| question.is_decided(board, decisions));
    let questions = all(entries, options, now).into_iter();
    questions.filter(is_open).map(|question| question.text).collect()
}

fn all(entries: &Entries, options: &Options, now: Timestamp) -> Vec<Question> {
    let mut questions = vec![token(entries, now), queue(options)];
    let mut ask = |is_open: bool, question: Question| {
        if is_open {
            questions.push(question);
        }
    };
    let has_queue = options.queue.is_some();
    ask(
        has_queue && options.dead_letter.is_none(),
        Question::new("queue.deadLetterURL", NO_DEAD_LETTERS),
    );
    ask(true, challenge(options));
    ask(options.role_arn.is_none(), Question::new("podIdentity", NO_ROLE));
    ask(options.egress.is_empty(), Question::new("network.egress", NO_EGRESS));
    for (fields, text) in ALWAYS {
        let (fields, text) = (fields.to_vec(), text.to_owned());
        ask(true, Question { fields, text });
    }
    let has_group = entries.boards.iter().any(|board| board.log_group.is_some());
    ask(has_group, Question::new("logGroup", FLUENTD));
    ask(
        options.taints.is_empty(),
        Question::new("tracks[].tolerations", NO_TAINTS),
    );
    let which = "which cluster gets which Leaderboard: apply only one of the two in each (--only prints one)";
    ask(
        options.two_operators && entries.boards.len() > 1,
        Question {
            fields: Vec::new(),
            text: which.to_owned(),
        },
    );
    questions
}

fn queue(options: &Options) -> Question {
    match &options.queue {
        None => Question::new(
            "queue.url",
            "queue: the URL of the SQS queue that EvalAI writes to (--queue), and its region",
        ),
        Some(queue) => Question::new(
            "queue.region",
            format!(
                "queue: is {} the region of the queue? The original's was in us-west-2, its participants' images in us-east-1",
                queue.arn.region()
            ),
        ),
    }
}

fn challenge(options: &Options) -> Question {
    let text = match options.challenge {
        Some(challenge) => format!("is {challenge} the challenge of these phases? No entry holds it"),
        None => "the id of the challenge (--challenge), which no entry holds".to_owned(),
    };
    Question::new("evalai.challenge", format!("evalai.challenge: {text}"))
}

/// A token that is none, or ends soon, is answered by another place for it alone.
fn token(entries: &Entries, now: Timestamp) -> Question {
    let (field, what) = match &entries.token {
        Err(why) => ("evalai.token.secretKeyRef", why.to_string()),
        Ok(Some(end)) if end.duration_since(now) <= WARN_BEFORE => (
            "evalai.token.secretKeyRef",
            format!(
                "the token ends on {}; renew it on EvalAI's profile page",
                end.strftime("%Y-%m-%d")
            ),
        ),
        Ok(_) => (
            "evalai.token",
            "may the operator's AWS identity read it (secretsmanager:GetSecretValue)? The token stays there".to_owned(),
        ),
    };
    Question::new(field, format!("the entry {EVALAI}: {what}"))
}
