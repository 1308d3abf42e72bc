//! The server of the simulation: it reads a record early and saves it late, answers, and loses answers.

use super::*;

impl World {
    pub(super) fn arrive(&mut self, ticket: Ticket) {
        let fault = if self.at < PEACE { self.rng.u8(0..100) } else { 100 };
        let silence = |sent| Silence {
            sent,
            why: "silence".into(),
        };
        let unanswered = |sent| match ticket.request {
            Request::Get(_) => Reply::Row(Answer::Unanswered(silence(sent))),
            Request::List { .. } => Reply::Rows(Answer::Unanswered(silence(sent))),
            _ => Reply::Written(Answer::Unanswered(silence(sent))),
        };
        let plain = |answer: Answer<()>| match ticket.request {
            Request::Get(_) => Reply::Row(answer.and_then(|()| Answer::Throttled(Duration::ZERO))),
            Request::List { .. } => Reply::Rows(answer.and_then(|()| Answer::Throttled(Duration::ZERO))),
            _ => Reply::Written(answer),
        };
        let written = ticket.request.is_write();
        let pk = ticket.request.submission().map(|subject| subject.pk);
        let (reply, after) = match fault {
            0 => (unanswered(false), Duration::ZERO),
            1 => (unanswered(true), Duration::from_secs(3)),
            2 => (plain(Answer::Throttled(Duration::from_secs(20))), WAY),
            3 => (plain(Answer::Broken("EvalAI answered 500".into())), WAY),
            _ if written => return self.work(ticket, fault < 10),
            4..8 => (unanswered(true), Duration::from_secs(30)),
            _ => (self.read(&ticket), self.random(0.01, READ_SECONDS)),
        };
        if let (true, Some(pk)) = (written, pk) {
            *self.working.get_mut(&pk).unwrap() -= 1;
        }
        self.push(self.at + after, Event::Answer(ticket, reply));
    }

    pub(super) fn read(&self, ticket: &Ticket) -> Reply {
        match &ticket.request {
            Request::Get(subject) => Reply::Row(Answer::Done(row(subject.pk, &self.table[&subject.pk]))),
            Request::List { purpose, .. } => {
                let status = if *purpose == Purpose::Cancel {
                    Status::Cancelled
                } else {
                    Status::Submitted
                };
                let of = self.table.iter().filter(|(_, record)| record.status == status);
                Reply::Rows(Answer::Done(of.map(|(pk, record)| row(*pk, record)).collect()))
            }
            other => panic!("{other:?} is not of this model"),
        }
    }

    /// Reads now, saves later; a lost answer may be worked on for a minute.
    pub(super) fn work(&mut self, ticket: Ticket, lost: bool) {
        let pk = ticket.request.submission().unwrap().pk;
        let read = self.table[&pk].clone();
        let mut save = read.clone();
        save.cancelled_at = None;
        match &ticket.request {
            Request::Progress(_, progress, job) => {
                save.status = progress.status();
                save.jobs.extend(job.iter().map(|job| job.to_lowercase()));
            }
            Request::Partial(..) => save.status = Status::PartiallyEvaluated,
            Request::Final(_, outcome, _) => save.status = Status::parse(outcome.as_str()),
            other => panic!("{other:?} is no write"),
        }
        if matches!(save.status, Status::Finished | Status::PartiallyEvaluated) && read.rows == 0 {
            save.rows = 1;
        }
        let work = Work {
            pk,
            kind: ticket.request.name(),
            attempt: self.actors[&pk].attempt,
            began: self.actors[&pk].began.unwrap_or_default(),
            sent: ticket.requested,
            checked: self.checked.remove(&pk).unwrap().0,
            read,
            save,
        };
        let takes = self.random(0.05, if lost { 60.0 } else { 2.0 });
        self.push(self.at + takes, Event::Save(work));
        let (reply, after) = if lost {
            let why = "EvalAI did not answer in time".into();
            (Answer::Unanswered(Silence { sent: true, why }), Duration::from_secs(65))
        } else {
            (Answer::Done(()), takes + WAY)
        };
        self.push(self.at + after, Event::Answer(ticket, Reply::Written(reply)));
    }

    pub(super) fn save(&mut self, work: &Work) {
        *self.working.get_mut(&work.pk).unwrap() -= 1;
        let record = self.table.get_mut(&work.pk).unwrap();
        if let (Status::Cancelled, Some(at)) = (record.status, record.cancelled_at)
            && !matches!(work.save.status, Status::Failed | Status::Cancelled)
            && at > work.began
            && (work.attempt == 1
                || record
                    .jobs
                    .contains(&format!("submission-{}-{}", work.pk, work.attempt)))
        {
            // A cancel while we write, or since the server made our read right before it, is overwritten; no other.
            assert!(
                at >= work.checked,
                "{} at {:?}, read at {:?}, undoes the cancel of {at:?}",
                work.kind,
                work.sent,
                work.checked
            );
            if at >= work.sent {
                self.lost.0 += 1;
            } else {
                self.lost.1 += 1;
            }
        }
        let doubled = work.read.rows == 0 && record.rows > 0;
        assert!(
            !doubled || work.save.rows == 0,
            "two rows on the leaderboard for submission {}",
            work.pk
        );
        *record = work.save.clone();
    }
}
