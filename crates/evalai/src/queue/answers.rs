//! Changes of the queue by an answer about one submission.
//!
//! Owned by `queue`; what concerns a whole challenge is in `lists`. Pure.

use std::sync::Arc;
use std::time::Duration;

use super::poll::pause;
use super::sub::{RETRY_END, Sub};
use super::{Busy, Now, Queue, Ticket};
use crate::answer::{About, Answer, Refusal, Silence};
use crate::request::{Reply, Request, SubmissionRef};
use crate::row::Row;
use crate::types::{Changed, Ended, ImageAnswer, Key, Outline};
use leaderboard_api::evalai_status::{Outcome, Status};
use leaderboard_base::backoff::Backoff;

/// After a refused token nothing is asked for so long, unless it is renewed.
const TOKEN_PAUSE: Duration = Duration::from_mins(1);

/// Waits after a write that EvalAI broke down over: results are to be there two minutes after an outage.
const OUTAGE: Backoff = Backoff::new(Duration::from_secs(30), Duration::from_secs(90));
/// So many such waits are well over an hour.
const OUTAGE_TRIES: u32 = 60;

impl Queue {
    /// Takes an answer in.
    pub fn answered(&mut self, ticket: &Ticket, reply: Reply, now: Now) {
        if ticket.request.counts() {
            let answer = reply.answer();
            self.note(&answer, &now);
            self.note_silence(&answer, &now);
        }
        if let Some(number) = ticket.number {
            return self.passed(number, ticket, reply, &now);
        }
        match (&ticket.request, reply) {
            (Request::Get(subject), Reply::Row(answer)) => self.took_row(subject, ticket.requested, answer, &now),
            (Request::Image(subject, _), Reply::Image(answer)) => self.took_image(subject, answer, &now),
            (request, Reply::Written(answer)) => self.wrote(request, answer, &now),
            (Request::List { challenge, purpose, .. }, Reply::Rows(answer)) => {
                self.took_list((*challenge, *purpose), ticket.requested, answer, &now);
            }
            (request, reply) => self.took_of_check(request, reply, &now),
        }
        self.tidy_lanes(&now);
    }

    /// The row of a submission shows what is no longer so: if its end is waited for, it is read again soon.
    pub fn outdate(&mut self, key: &Key) {
        if let Some(sub) = self.subs.get_mut(key) {
            sub.outdated = true;
        }
    }

    /// The row of a submission; none before its first read, and while it is known to be outdated.
    pub fn present_row(&self, key: &Key) -> Option<Arc<Row>> {
        let sub = self.subs.get(key).filter(|sub| !sub.outdated)?;
        sub.view.row.clone()
    }

    /// A write was not sent after all; it is chosen again.
    pub fn not_sent(&mut self, ticket: &Ticket) {
        if let Some(lane) = ticket
            .request
            .submission()
            .and_then(|subject| self.lanes.get_mut(&subject.pk))
        {
            lane.busy = None;
        }
    }

    /// Notes the part of every answer that is about the token.
    fn note(&mut self, answer: &Answer<()>, now: &Now) {
        match answer {
            Answer::Throttled(wait) => self.share.budget(|budget| budget.close_until(now.at + *wait)),
            Answer::Refused(refusal) if refusal.about == About::Token => {
                let news = self.token_refused.is_none();
                self.token_refused = Some((refusal.message.clone(), now.at + TOKEN_PAUSE));
                if news {
                    self.wake_leaderboards(|_| true);
                }
            }
            Answer::Done(()) if self.token_refused.take().is_some() => self.wake_leaderboards(|_| true),
            _ => {}
        }
    }

    fn took_row(&mut self, subject: &SubmissionRef, requested: Duration, answer: Answer<Row>, now: &Now) {
        let lane = self.lanes.entry(subject.pk).or_default();
        let for_write = lane.busy.take() == Some(Busy::ReadForWrite);
        let row = match answer {
            Answer::Done(row) if row.id == subject.pk => row,
            Answer::Done(_) => return self.went_wrong(subject, "EvalAI answered with another submission".into(), now),
            // Both are no failure of this submission's.
            Answer::Throttled(_) => return,
            Answer::Refused(refusal) if refusal.about == About::Token => return,
            Answer::Refused(refusal) if refusal.about == About::Missing => {
                let since = *lane.missing_since.get_or_insert(requested);
                let again = since + self.timing.missing;
                if requested < again {
                    let why = format!("{}; it is asked for again before that counts", refusal.message);
                    return self.change(subject, |sub| {
                        sub.read_failed(why, now);
                        sub.retry_at = again;
                    });
                }
                Row::missing(subject.pk)
            }
            other => return self.went_wrong(subject, other.error().unwrap_or_default(), now),
        };
        if lane.unsure && requested >= lane.hold_until {
            lane.unsure = false;
        }
        lane.checked = (for_write && !lane.unsure).then_some(now.at);
        self.spread(&Arc::new(row), requested, now, Sub::read_done);
    }

    /// Gives a row to every object of that submission.
    pub(super) fn spread(&mut self, row: &Arc<Row>, requested: Duration, now: &Now, mut also: impl FnMut(&mut Sub)) {
        if let Some(lane) = self.lanes.get_mut(&row.id).filter(|_| row.status != Status::Missing) {
            lane.missing_since = None;
        }
        let lane = self.lanes.get(&row.id);
        let calm = lane.is_none_or(|lane| lane.busy != Some(Busy::Write) && !lane.unsure);
        for key in self.pks.get(&row.id).cloned().unwrap_or_default() {
            let Some(sub) = self.subs.get_mut(&key) else { continue };
            let before = sub.view.last_error.clone();
            also(sub);
            let mut changed = before != sub.view.last_error;
            changed |= sub.take_row(row, requested, calm, now);
            if changed {
                self.changes.insert(Changed::Submission(key));
            }
        }
    }

    fn took_image(&mut self, subject: &SubmissionRef, answer: Answer<ImageAnswer>, now: &Now) {
        self.lanes.entry(subject.pk).or_default().busy = None;
        self.change(subject, |sub| {
            sub.view.image = Some(match answer {
                Answer::Done(image) => {
                    sub.view.last_error = None;
                    image
                }
                other => {
                    let why = other.error().unwrap_or_default();
                    sub.image_failed(why.clone(), now);
                    ImageAnswer::Unread(why)
                }
            });
        });
    }

    fn went_wrong(&mut self, subject: &SubmissionRef, why: String, now: &Now) {
        self.change(subject, |sub| sub.read_failed(why, now));
    }

    fn wrote(&mut self, request: &Request, answer: Answer<()>, now: &Now) {
        let Some(subject) = request.submission() else { return };
        self.lanes.entry(subject.pk).or_default().busy = None;
        let sent = self.sent_payload(&subject.key);
        match answer {
            Answer::Done(()) => self.change(subject, |sub| done(sub, request, sent.as_ref(), now)),
            Answer::Throttled(_) => {}
            Answer::Refused(refusal) => self.refused(subject, request, sent.as_ref(), refusal, now),
            Answer::Broken(why) => {
                self.change(subject, |sub| {
                    // Part of it may have been done.
                    (sub.outdated, sub.wrote_at) = (true, now.at);
                    drop_partial(sub, request, sent.as_ref());
                    sub.write_failed(why, broken_pause(sub.write_failures), now);
                });
            }
            Answer::Unanswered(silence) => self.unanswered(subject, silence, now),
        }
    }

    fn refused(
        &mut self,
        subject: &SubmissionRef,
        request: &Request,
        sent: Option<&Arc<Outline>>,
        refusal: Refusal,
        now: &Now,
    ) {
        self.change(subject, |sub| match (refusal.about, request) {
            (About::Token, _) => {}
            (About::Missing, _) => {
                // A row that reads go on finding must not take the budget of all others.
                sub.outdated = true;
                sub.write_failed(refusal.message, pause(sub.write_failures), now);
            }
            (About::Request, Request::Final(..)) => sub.refuse_end(refusal.message, now),
            (About::Request | About::Challenge, _) => {
                drop_partial(sub, request, sent);
                sub.write_failed(refusal.message, pause(sub.write_failures), now);
            }
        });
    }

    fn unanswered(&mut self, subject: &SubmissionRef, silence: Silence, now: &Now) {
        if !silence.sent {
            return self.change(subject, |sub| {
                sub.write_failed(silence.why, pause(sub.write_failures), now);
            });
        }
        let lane = self.lanes.entry(subject.pk).or_default();
        lane.hold_until = now.at + self.timing.hold;
        lane.unsure = true;
        self.change(subject, |sub| {
            (sub.outdated, sub.wrote_at) = (true, now.at);
            sub.view.last_error = Some(silence.why);
        });
    }

    /// Changes the object a request was about, if it is still at that attempt.
    fn change(&mut self, subject: &SubmissionRef, change: impl FnOnce(&mut Sub)) {
        let Some(sub) = self.subs.get_mut(&subject.key) else {
            return;
        };
        if sub.run.attempt != subject.attempt || sub.pk != subject.pk {
            // The write happened all the same.
            sub.outdated = true;
            return;
        }
        let before = sub.view.clone();
        change(sub);
        if sub.view != before {
            self.changes.insert(Changed::Submission(subject.key.clone()));
        }
    }
}

/// The wait before a write that EvalAI broke down over is retried: short while it may be an outage, whose end nobody
/// announces; long once it must be this row, which only EvalAI's administrators can fix.
fn broken_pause(failures: u32) -> Duration {
    if failures < OUTAGE_TRIES {
        OUTAGE.bound(failures.saturating_add(1))
    } else {
        RETRY_END
    }
}

fn done(sub: &mut Sub, request: &Request, sent: Option<&Arc<Outline>>, now: &Now) {
    match request {
        Request::Progress(_, progress, _) => {
            sub.wrote(progress.status(), now);
            sub.view.progress = sub.view.progress.max(Some(*progress));
            if sub.progress.as_ref().is_some_and(|wanted| wanted.what <= *progress) {
                sub.progress = None;
            }
        }
        Request::Partial(..) => {
            sub.wrote(Status::PartiallyEvaluated, now);
            drop_partial(sub, request, sent);
        }
        Request::Final(_, outcome, _) => {
            let (outcome, at) = (*outcome, now.wall);
            let wanted = sub.end.as_ref().map_or(outcome, |want| want.what.0);
            let deleted = sub.view.row.as_ref().map(|row| row.status);
            let deleted = deleted.filter(|status| *status == Status::Deleted);
            sub.wrote(Status::parse(outcome.as_str()), now);
            sub.close(if outcome == Outcome::Cancelled && wanted != outcome {
                Ended::Otherwise(deleted.unwrap_or(Status::Cancelled))
            } else {
                // A newer update that came meanwhile is too late: what EvalAI has stored stands.
                Ended::Published { outcome, at }
            });
        }
        _ => {}
    }
}

/// Partial results that were answered are not sent again, whatever the answer: newer ones come.
fn drop_partial(sub: &mut Sub, request: &Request, sent: Option<&Arc<Outline>>) {
    let Some(sent) = sent.filter(|_| matches!(request, Request::Partial(..))) else {
        return;
    };
    sub.view.partial_done = sent.stored.as_ref().map(|stored| stored.done);
    sub.partial.take_if(|wanted| wanted.what == *sent);
}
